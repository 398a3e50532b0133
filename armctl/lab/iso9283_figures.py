"""The figures of ISO 9283:1998 from attained positions, orientations and speeds. Each function names its clause."""

from typing import NamedTuple

import numpy as np

from armctl.core.log import Log
from armctl.core.pose import matrix_from_quat, rotation_vector
from armctl.core.validation import Array

# Normal to the commanded path, in the middle of equal sections: 5 %, 15 %, ... 95 % of it. Start and stop are outside.
PLANES = 10
PLANES_OF_WHOLE = 1000  # so many that the figures depend no longer on where they are
_END_SHARE = 0.25  # of the path at each end, where the speed is not evaluated (8.6.1)


class Spread(NamedTuple):
    """How accurate and how repeatable a figure is."""

    accuracy: float  # the mean of the attained values minus the commanded value
    repeatability: float  # three standard deviations


class Stabilisation(NamedTuple):
    """Clauses 7.4 and 7.5: s from the first entry into the band to the last, and m of overshoot after the first."""

    time: float
    overshoot: float


class PathSpeed(NamedTuple):
    """Clause 8.6, path velocity characteristics, as fractions of the commanded speed."""

    accuracy: float  # AV, the mean attained speed minus the commanded one
    repeatability: float  # RV, three standard deviations of the mean speeds of the cycles
    fluctuation: float  # FV, the largest difference between two speeds within one cycle


class Corner(NamedTuple):
    """Clause 8.5, cornering deviations, m."""

    round_off: float  # CR, the smallest distance of the attained path from the corner
    overshoot: float  # CO, the largest deviation from the second line behind the rounded corner


def accuracy(offsets: Array) -> Spread:
    """Clauses 7.2, AP and RP, or 8.2 and 8.3, AT and RT: the worst of the k poses or planes, by offsets (cycles, k, 3) m."""
    mean = offsets.mean(axis=0)
    apart = np.linalg.norm(offsets - mean, axis=2)
    repeatability = apart.mean(axis=0) + 3 * apart.std(axis=0, ddof=1)
    return Spread(float(np.linalg.norm(mean, axis=1).max()), float(repeatability.max()))


def orientation(angles: Array) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Clause 7.2, AP_a, AP_b, AP_c and RP_a, RP_b, RP_c: the worst of k poses, by angles (cycles, k, 3) rad about x, y, z."""
    worst_accuracy = np.abs(angles.mean(axis=0)).max(axis=0)
    worst_repeatability = 3 * angles.std(axis=0, ddof=1).max(axis=0)
    return tuple(worst_accuracy.tolist()), tuple(worst_repeatability.tolist())


def turn_between(quat_ref: Array, quat: Array) -> Array:
    """(3,) rad, the rotation vector from a reference orientation to an attained one, world axes; quaternions (4,) wxyz."""
    return rotation_vector(matrix_from_quat(quat) @ matrix_from_quat(quat_ref).T)


def distance(first: Array, second: Array, commanded: float) -> Spread:
    """Clause 7.3, AD and RD: the distance between two attained poses, each (cycles, 3) m, against the commanded one, m."""
    distances = np.linalg.norm(first - second, axis=1)
    return Spread(float(distances.mean() - commanded), float(3 * distances.std(ddof=1)))


def drift(offsets: Array) -> float:
    """Clause 7.6, the drift of pose accuracy, m, from the first to the last third of cycles, by offsets (cycles, k, 3) m."""
    third = max(1, len(offsets) // 3)
    first = np.linalg.norm(offsets[:third].mean(axis=0), axis=1)
    last = np.linalg.norm(offsets[-third:].mean(axis=0), axis=1)
    return float(np.abs(last - first).max())


def stabilisation(log: Log, band: float) -> Stabilisation:
    """Clauses 7.4 and 7.5 of one pose: the tip is stable within `band` m around the attained position."""
    apart = np.linalg.norm(log.tip - log.tip[-1], axis=1)
    inside = apart <= band
    first_inside = int(inside.argmax())
    last_outside = -1 if inside.all() else int(np.flatnonzero(~inside)[-1])
    if last_outside < first_inside:
        return Stabilisation(0.0, 0.0)
    return Stabilisation((last_outside + 1 - first_inside) * log.dt, float(apart[first_inside:].max()))


def posing_time(log: Log, band: float) -> float:
    """Clause 9, s from the command until the tip stays within `band` m around the attained position."""
    outside = np.flatnonzero(np.linalg.norm(log.tip - log.tip[-1], axis=1) > band)
    return 0.0 if len(outside) == 0 else float((outside[-1] + 1) * log.dt)


def deviations_in_planes(log: Log, start: Array, end: Array, duration: float, count: int = PLANES) -> Array:
    """(count, 3) m, where a path attains the planes normal to the commanded line, minus the line (8.1, 8.2).

    The planes are in the middle of equal sections of the line from `start` to `end`, (3,) m. The first `duration` seconds of
    the log are the motion.
    """
    length = np.linalg.norm(end - start)
    line = (end - start) / length
    offsets = log.tip[log.t <= duration] - start
    along = offsets @ line
    across = offsets - along[:, None] * line
    # The tip may move back by a rounding error; interpolation needs increasing distances.
    increasing = np.concatenate([[True], along[1:] > np.maximum.accumulate(along)[:-1]])
    planes = (np.arange(count) + 0.5) / count * length
    return np.column_stack([np.interp(planes, along[increasing], across[increasing, axis]) for axis in range(3)])


def path_speed(logs: list[Log], start: Array, end: Array, duration: float, commanded: float) -> PathSpeed:
    """Clause 8.6 in the middle half of a line, over all cycles; arguments as for `deviations_in_planes`, `commanded` in m/s."""
    line = (end - start) / np.linalg.norm(end - start)
    means = []
    fluctuation = 0.0
    for log in logs:
        position = (log.tip[log.t <= duration] - start) @ line
        share = position / np.linalg.norm(end - start)
        speed = np.gradient(position, log.dt)[(share > _END_SHARE) & (share < 1 - _END_SHARE)]
        means.append(speed.mean())
        fluctuation = max(fluctuation, float(np.ptp(speed)))
    return PathSpeed(
        accuracy=float(np.mean(means) / commanded - 1),
        repeatability=float(3 * np.std(means, ddof=1) / commanded),
        fluctuation=fluctuation / commanded,
    )


def cornering(logs: list[Log], corner: Array, end: Array, blend: float) -> Corner:
    """Clause 8.5: the worst of all cycles around a corner that is rounded within `blend` m; the second line ends at `end`."""
    line = (end - corner) / np.linalg.norm(end - corner)
    round_off = 0.0
    overshoot = 0.0
    for log in logs:
        from_corner = log.tip - corner
        distances = np.linalg.norm(from_corner, axis=1)
        nearest = int(distances.argmin())
        round_off = max(round_off, float(distances[nearest]))
        behind = from_corner[nearest:]
        along = behind @ line
        deviation = np.linalg.norm(behind - along[:, None] * line, axis=1)[along > blend]
        overshoot = max(overshoot, float(deviation.max(initial=0.0)))
    return Corner(round_off, overshoot)
