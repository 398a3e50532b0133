"""Disturbance observer: the torque that, besides the commanded one, explains the motion of the last tick.

An observer of first order, d = LP[ID(q, v, (v_next - v) / dt) - tau], after Ohnishi, Shibata, Murakami, "Motion control for
advanced mechatronics" (1996), with the inverse dynamics of the whole arm instead of a nominal inertia of each joint. Its model
has no dry friction. The law is in `computed_torque_kernel`.
"""

from __future__ import annotations

import math

# rad. Without a low-pass the observer diverges with a delay of two control periods. A low-pass faster than this diverges with a
# delay of two periods in addition to the observer's own delay of one. With light wrists two periods can be too much at this
# bound, too: `armctl.margins` measures it.
MAX_BANDWIDTH_TIMES_DT = 0.3


def low_pass_weight(bandwidth: float, dt: float) -> float:
    """The weight of the newest value in the observer's low-pass.

    Args:
        bandwidth: rad/s of the low-pass, used if the control period is short enough for it.
        dt: s, the control period.

    Returns:
        The weight, 0 to 0.26.
    """
    return -math.expm1(-min(bandwidth * dt, MAX_BANDWIDTH_TIMES_DT))
