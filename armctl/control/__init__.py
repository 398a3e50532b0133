"""Controllers: one method `torque(state, setpoint)`."""

from collections.abc import Callable
from functools import partial

from armctl.control.computed_torque import ComputedTorque
from armctl.control.computed_torque_learning import ComputedTorqueLearning
from armctl.control.computed_torque_observer import ComputedTorqueObserver
from armctl.control.computed_torque_qp import ComputedTorqueQP
from armctl.control.impedance import Impedance
from armctl.control.interface import Controller
from armctl.control.lqr import LQR
from armctl.control.mpc import MPC
from armctl.control.operational_space import OperationalSpace
from armctl.control.pd import PD, PDFeedforward, PDGravity
from armctl.core.errors import UnknownNameError
from armctl.model.arm.arm import Arm

CONTROLLERS: dict[str, Callable[[Arm], Controller]] = {
    "pd": PD,
    "pd-feedforward": PDFeedforward,
    "pd-gravity": PDGravity,
    "computed-torque": ComputedTorque,
    "computed-torque-textbook": partial(ComputedTorque, form="textbook"),
    "computed-torque-observer": ComputedTorqueObserver,
    "computed-torque-learning": ComputedTorqueLearning,
    "qp": ComputedTorqueQP,
    "lqr": LQR,
    "mpc": MPC,
    "operational-space": OperationalSpace,
    "impedance": Impedance,
}


def controller_by_name(name: str, arm: Arm) -> Controller:
    """A controller with its default gains, by its name in `CONTROLLERS`."""
    if name not in CONTROLLERS:
        raise UnknownNameError.of("controller", name, CONTROLLERS)
    return CONTROLLERS[name](arm)
