"""What a controller returned instead of a torque, and the exception that names the controller."""

from armctl.control.interface import Controller
from armctl.core.errors import InputError
from armctl.core.validation import Array, shown, vector


class ControllerFailure(Exception):
    """A controller raised an exception or returned no torque; the exception is the cause. Of several arms it names the tip."""

    def __init__(self, controller: Controller, tip: str = ""):
        super().__init__(controller, tip)
        self.controller = controller
        self.tip = tip


def checked_torque(tau: object, n: int) -> Array:
    """A controller's torque as a vector of n floats; it need not be finite."""
    if tau is None:
        raise InputError(f"torque: expected {n} numbers, but the controller returned None")
    try:
        return vector("torque", tau, n, finite=False)  # type: ignore[arg-type]
    except TypeError:
        raise InputError(f"torque: expected {n} numbers, but the controller returned {shown(tau)}") from None
