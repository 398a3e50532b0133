"""Whether profiles of ruckig stay between two positions, by their turning points; in plain Python, for real time."""

import math

import ruckig


def turns_inside(profile: ruckig.Profile, low: float, high: float) -> bool:
    """Whether a joint stays between two positions at the turning points of every phase of its profile."""
    q = profile.p
    v = profile.v
    a = profile.a
    j = profile.j
    t = profile.t
    for k in range(7):
        if v[k] * v[k + 1] < 0 or a[k] * a[k + 1] < 0:
            for u in _turning_times(v[k], a[k], j[k]):
                if 0 < u < t[k] and not low <= q[k] + u * (v[k] + u * (a[k] / 2 + u * j[k] / 6)) <= high:
                    return False
    return True


def brakes_inside(brake: ruckig.BrakeProfile, end: float, low: float, high: float) -> bool:
    """Whether a joint stays between two positions while it brakes into its limits, in one or two phases."""
    q = brake.p
    positions = [q[0], end]
    for k in range(2):
        if brake.t[k] > 0.0:
            positions.append(q[k])
            for u in _turning_times(brake.v[k], brake.a[k], brake.j[k]):
                if 0 < u < brake.t[k]:
                    positions.append(q[k] + u * (brake.v[k] + u * (brake.a[k] / 2 + u * brake.j[k] / 6)))
    return low <= min(positions) and max(positions) <= high


def _turning_times(v: float, a: float, j: float) -> tuple[float, ...]:
    """When a joint with this velocity, acceleration and constant jerk stands still."""
    if j == 0.0:
        return (-v / a,) if a else ()
    root = a * a - 2 * j * v
    if root < 0:
        return ()
    half = -(a + math.copysign(math.sqrt(root), a))  # no cancellation: both terms have the same sign
    return (half / j, 2 * v / half) if half else ()
