"""Paths of the joints that a caller gives: splines, functions with derivatives, points, recorded motions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.limits import Limits
from armctl.core.validation import Array, matrix, vector
from armctl.model.arm.arm import Arm
from armctl.plan.motion.timing.waypoint_path import arc_lengths
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.piecewise import Pieces, hermite, jerk, sample
from armctl.plan.motion.trajectory.ros import accelerations_at

_ORDERS = 4  # derivatives of order 0 to 3
_PATH_SAMPLES = 400  # of a path that is checked
_STANDING = 0.05  # of the mean rate of a path: where it is slower at an end, its parameter is a bad one
_TURNING = 1e-4  # of the mean rate: where a path is slower inside, it stands still
_MAX_KNOTS = 200  # of a path that is described by its length
_FINE = 20  # places between two nodes of a path that is described by its length
_MIN_NODE_DISTANCE = 1e-7  # of the length of a path
_QUADRATURE = np.polynomial.legendre.leggauss(5)  # points in [-1, 1] and weights of Gauss and Legendre's rule
_SAME_POINT = 1e-9  # rad (m)
_JUMP = 1e-6  # of the largest value of a derivative
_DIFFERENCE = 1e-5  # of the length, of the differences that derivatives are compared with
_DERIVATIVE_TOLERANCE = 0.02  # of the largest difference: mistakes are larger, rounding is smaller
_NAMES = ("position", "first derivative", "second derivative")
_KINDS = "give a spline of SciPy, a function path(s, order) of its derivatives 0 to 3, (k, n) points, or a JointTrajectory"


class SplineLike(Protocol):
    """What has derivatives as SciPy's splines have them."""

    def __call__(self, s: Array, order: int, /) -> Any: ...


class GivenPath(NamedTuple):
    """A path of n joints over a parameter that starts at 0, with the places where its third derivative may jump."""

    evaluate: Callable[[Array], tuple[Array, Array, Array, Array]]
    length: float  # of the parameter
    knots: Array  # (k,) increasing, 0 and the length among them

    def derivatives(self, s: Array) -> tuple[Array, Array, Array, Array]:
        """q and its first three derivatives, each (T, n), at parameters (T,)."""
        return self.evaluate(s)


def read_path(
    arm: Arm,
    path: ArrayLike | SplineLike | JointTrajectory,
    interval: tuple[float, float] | None,
    parameters: ArrayLike | None,
    derivatives: ArrayLike | None,
) -> GivenPath:
    """A caller's path, checked: of the arm's joints, finite, smooth, inside the position limits, and never standing still."""
    if isinstance(path, JointTrajectory):
        _refuse(
            interval is not None or parameters is not None or derivatives is not None, "a JointTrajectory has its own times"
        )
        if path.joint_names != arm.joint_names:
            raise InputError(
                f"path: it moves {', '.join(path.joint_names):.120}, but the arm has {', '.join(arm.joint_names):.120}"
            )
        given = _of_pieces(path.pieces)
    elif callable(path):
        _refuse(parameters is not None or derivatives is not None, "parameters and derivatives belong to points")
        given = _of_function(arm, path, interval)
    else:
        _refuse(interval is not None, "an interval belongs to a function of a parameter; points have `parameters`")
        given = _of_points(arm, path, parameters, derivatives)
    _require_smooth(given)
    return _regular(given, arm.limits)


def _refuse(is_wrong: bool, why: str) -> None:
    if is_wrong:
        raise InputError(f"path: {why}")


def _of_pieces(pieces: Pieces) -> GivenPath:
    def evaluate(s: Array) -> tuple[Array, Array, Array, Array]:
        inside = np.clip(s, 0.0, pieces.knots[-1])  # of rounding; a motion has no velocity outside
        q, v, a = sample(pieces, inside)
        return q, v, a, jerk(pieces, inside)

    return GivenPath(evaluate, float(pieces.knots[-1]), np.unique(pieces.knots))


def _of_points(arm: Arm, path: ArrayLike, parameters: ArrayLike | None, derivatives: ArrayLike | None) -> GivenPath:
    """The cubic spline through points, or with derivatives a spline of degree five that has them."""
    from scipy.interpolate import CubicSpline

    try:
        q = matrix("path", path, arm.n)
    except InputError as error:
        raise InputError(f"{error}; {_KINDS}") from None
    arm.check_units("path", q)
    at = None if parameters is None else vector("parameters", parameters, len(q))
    slopes = None if derivatives is None else matrix("derivatives", derivatives, arm.n)
    if at is not None and (np.diff(at) <= 0.0).any():
        raise InputError("parameters: they must increase from point to point")
    if slopes is not None and (at is None or slopes.shape != q.shape):
        raise InputError(f"derivatives: {len(slopes)} rows for {len(q)} points; each point needs one, and its parameter")
    apart = np.append(True, np.abs(np.diff(q, axis=0)).max(axis=1) > _SAME_POINT)
    if at is None:
        q = q[apart]
    if len(q) < 2 or not apart[1:].any():
        raise InputError(f"path: expected at least two points that differ, got {len(q)}; {_KINDS}")
    lengths = arc_lengths(q, arm.limits) if at is None else at - at[0]
    if slopes is None:
        spline = CubicSpline(lengths, q)
        return _of_pieces(hermite(lengths, q, spline(lengths, 1), spline(lengths, 2)))
    return _of_pieces(hermite(lengths, q, slopes, accelerations_at(lengths, q, slopes)))


def _of_function(arm: Arm, path: SplineLike, interval: tuple[float, float] | None) -> GivenPath:
    begin, end = _interval_of(path) if interval is None else vector("interval", interval, 2).tolist()
    if not end > begin:
        raise InputError(f"interval: its end, {end:g}, is not above its start, {begin:g}")

    def evaluate(s: Array) -> tuple[Array, Array, Array, Array]:
        at = np.clip(begin + s, begin, end)
        return tuple(_evaluated(path, at, order, arm.n) for order in range(_ORDERS))  # type: ignore[return-value]

    inner = np.unique(np.asarray(_breaks_of(path), dtype=np.float64)) - begin
    length = end - begin
    knots = np.concatenate([[0.0], inner[(inner > 0.0) & (inner < length)], [length]])
    given = GivenPath(evaluate, length, knots)
    _require_derivatives(given)
    return given


def _require_derivatives(path: GivenPath) -> None:
    """Refuses derivatives that are not those of the positions, by central differences. Raises InputError."""
    h = _DIFFERENCE * path.length
    s = np.linspace(2 * h, path.length - 2 * h, _PATH_SAMPLES // 2)
    s = s[np.abs(s[:, None] - path.knots).min(axis=1) > 2 * h]  # the third derivative may jump at knots
    if not len(s):
        return
    here = path.derivatives(s)
    before = path.derivatives(s - h)
    after = path.derivatives(s + h)
    for order in range(1, _ORDERS):
        difference = (after[order - 1] - before[order - 1]) / (2 * h)
        scale = np.abs(difference).max() + np.ptp(here[0], axis=0).max() / path.length**order
        off = np.abs(difference - here[order])
        k, i = np.unravel_index(int(off.argmax()), off.shape)
        if off[k, i] > _DERIVATIVE_TOLERANCE * scale:
            raise InputError(
                f"path: path(s, {order}) of joint {i} at {s[k]:.6g} after its start is {here[order][k, i]:.4g}, but "
                f"differences of path(s, {order - 1}) give {difference[k, i]:.4g}; return the derivative of that order"
            )


def _interval_of(path: Any) -> tuple[float, float]:
    """Where a path is defined: SciPy's splines and the paths of toppra say so."""
    for name in ("path_interval", "x"):
        known = np.asarray(getattr(path, name, ()), dtype=np.float64)
        if known.ndim == 1 and len(known) >= 2:
            return float(known[0]), float(known[-1])
    if hasattr(path, "t") and hasattr(path, "k"):
        return float(path.t[path.k]), float(path.t[-path.k - 1])
    raise InputError("interval: the path does not say where it begins and ends; give interval=(start, end) of its parameter")


def _breaks_of(path: Any) -> Array:
    """Where the third derivative of a spline may jump."""
    for name in ("x", "t"):
        known = getattr(path, name, None)
        if isinstance(known, np.ndarray):
            return known
    return np.empty(0)


def _evaluated(path: SplineLike, s: Array, order: int, n: int) -> Array:
    try:
        value = np.asarray(path(s, order), dtype=np.float64)
    except Exception as error:  # a caller's function may raise anything
        text = f"{type(error).__name__}: {error}"
        raise InputError(
            f"path: path(s, {order}) for an array of parameters failed with {text:.160}; it must return its derivative of "
            f"order {order}, (T, {n})"
        ) from None
    if value.shape != (len(s), n):
        raise InputError(f"path: path(s, {order}) for {len(s)} parameters has shape {value.shape}, expected {(len(s), n)}")
    if not np.isfinite(value).all():
        raise InputError(f"path: path(s, {order}) at {s[int((~np.isfinite(value)).any(axis=1).argmax())]:g} is not finite")
    return value


def _require_smooth(path: GivenPath) -> None:
    """Refuses a path whose curvature jumps, for which no jerk is enough. Raises InputError."""
    values = path.derivatives(np.linspace(0.0, path.length, _PATH_SAMPLES))
    inner = path.knots[1:-1]
    if not len(inner):
        return
    at = path.derivatives(inner)
    before = path.derivatives(np.nextafter(inner, 0.0))
    for order, name in enumerate(_NAMES):
        jump = np.abs(at[order] - before[order])
        jumps = jump.max(axis=1) > _JUMP * (np.abs(values[order]).max() + np.ptp(values[0], axis=0).max() / path.length**order)
        if jumps.any():
            where = inner[int(jumps.argmax())]
            raise InputError(
                f"path: its {name} jumps at {where:g} after its start, which takes an infinite jerk; use a smoother spline, or "
                "time the parts and join them with `then`"
            )


def _regular(path: GivenPath, limits: Limits) -> GivenPath:
    """The path itself, or where its parameter hardly moves it at an end, as time does in a motion from rest, by its length."""
    s = np.union1d(np.linspace(0.0, path.length, _PATH_SAMPLES + 1), path.knots)
    rate = _rate(path, s, limits)
    mean = float(np.trapezoid(rate, s) / path.length)
    if mean == 0.0:
        raise InputError("path: it stays where it is; give a path that moves")
    moving = np.flatnonzero(rate >= _STANDING * mean)
    within = slice(moving[0], moving[-1] + 1)
    if rate[within].min() < _TURNING * mean:
        where = s[within][int(rate[within].argmin())]
        raise InputError(
            f"path: it stands still or turns back at {where:.6g} after its start; time the parts before and behind, and join "
            "them with `then`"
        )
    return path if len(s) == within.stop - within.start else _by_length(path, limits)


def _rate(path: GivenPath, s: Array, limits: Limits) -> Array:
    """(T,) how fast the path moves at parameters (T,): the velocity limits of the joints are the unit."""
    return np.linalg.norm(path.derivatives(s)[1] / limits.v_max, axis=1)


def _by_length(path: GivenPath, limits: Limits) -> GivenPath:
    """The same path over its length. With rate r: dq/dl = q' / r, and d2q/dl2 = (q'' - dq/dl r') / r^2.

    Quintics between nodes have these derivatives. At an end where the path stands still they are unknown: a cubic ends there.
    """
    fine = np.unique(np.concatenate([np.linspace(0.0, path.length, _FINE * _PATH_SAMPLES + 1), path.knots]))
    covered = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(path.derivatives(fine)[0] / limits.v_max, axis=0), axis=1)))
    even = np.interp(np.linspace(0.0, covered[-1], _PATH_SAMPLES + 1), covered, fine)
    # Thousands of knots, as of a motion along a curve, are where polynomials meet and no jumps that count.
    inner_knots = path.knots if len(path.knots) <= _MAX_KNOTS else path.knots[[0, -1]]
    s = np.union1d(even, inner_knots)
    s = s[np.append(True, np.diff(np.interp(s, fine, covered)) > _MIN_NODE_DISTANCE * covered[-1])]
    s[-1] = path.length
    steps = np.diff(s)[:, None]
    places, weights = _QUADRATURE
    rates = _rate(path, (s[:-1, None] + 0.5 * steps * (places + 1)).ravel(), limits).reshape(len(steps), -1)
    lengths = np.append(0.0, np.cumsum(0.5 * steps[:, 0] * (rates @ weights)))
    q, q1, q2, _ = path.derivatives(s)
    slope = np.empty_like(q)
    curvature = np.empty_like(q)
    inner = slice(1, -1)
    v = q1[inner] / limits.v_max
    rate = np.linalg.norm(v, axis=1, keepdims=True)
    growth = (v * q2[inner] / limits.v_max).sum(axis=1, keepdims=True) / rate
    slope[inner] = q1[inner] / rate
    curvature[inner] = (q2[inner] - slope[inner] * growth) / rate**2
    for end, beside in ((0, 1), (-1, -2)):
        h = lengths[end] - lengths[beside]
        third = 6 * (q[end] - q[beside] - h * slope[beside] - 0.5 * h**2 * curvature[beside]) / h**3
        slope[end] = slope[beside] + h * (curvature[beside] + 0.5 * h * third)
        curvature[end] = curvature[beside] + h * third
    knots = np.interp(inner_knots, s, lengths)
    return _of_pieces(hermite(lengths, q, slope, curvature))._replace(knots=knots)
