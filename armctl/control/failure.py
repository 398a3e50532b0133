"""What a controller returned, checked."""

from armctl.core.errors import InputError
from armctl.core.validation import Array, shown, vector


def checked_torque(tau: object, n: int) -> Array:
    """A controller's torque as a vector of n floats; it need not be finite."""
    if tau is None:
        raise InputError(f"torque: expected {n} numbers, but the controller returned None")
    try:
        return vector("torque", tau, n, finite=False)  # type: ignore[arg-type]
    except TypeError:
        raise InputError(f"torque: expected {n} numbers, but the controller returned {shown(tau)}") from None
