"""What the kernels of all controllers share: the rows of a reference, and small loops. See `KernelController`."""

from __future__ import annotations

from armctl.core.jit import njit

# Rows of the reference of a tick, as the fields of a `Setpoint`.
Q_REF = 0
V_REF = 1
A_REF = 2
V_TICK = 3
A_TICK = 4


@njit
def clipped(value, bound):
    """A value within [-bound, bound]."""
    return min(max(value, -bound), bound)
