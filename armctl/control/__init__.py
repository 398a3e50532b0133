"""Controllers: one file each, one method `torque(state, setpoint)`."""

from armctl.arm import Arm
from armctl.control.computed_torque import ComputedTorque
from armctl.control.contract import Controller, State, controller_name
from armctl.control.pd import PD
from armctl.errors import UnknownNameError

CONTROLLERS = {"pd": PD, "computed-torque": ComputedTorque}


def controller_by_name(name: str, arm: Arm) -> Controller:
    """A controller with its default gains.

    Args:
        name: Its name, one of `CONTROLLERS`.
        arm: The arm it is for.

    Returns:
        The controller.

    Raises:
        UnknownNameError: There is none of that name.
    """
    if name not in CONTROLLERS:
        raise UnknownNameError.of("controller", name, CONTROLLERS)
    return CONTROLLERS[name](arm)


__all__ = ["CONTROLLERS", "PD", "ComputedTorque", "Controller", "State", "controller_by_name", "controller_name"]
