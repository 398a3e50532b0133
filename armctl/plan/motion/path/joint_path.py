"""From a path of the tip to a path of the joints: dense inverse kinematics on one branch, computed before the arm moves.

The joints follow the path's twist through the Jacobian's weighted pseudo-inverse (Chan and Dubey, "A weighted least-norm
solution based scheme for avoiding joint limits", IEEE Trans. Robotics and Automation 11(2), 1995) by the midpoint
rule, and Newton's method brings the tip back onto the path at each step. A spline of degree five joins the steps.

Where a joint would leave its limits although the arm has more joints than the path needs, the walk is repeated with a
self-motion towards the middle of the joint ranges (A. Liégeois, "Automatic supervisory control of the configuration and
behavior of multibody mechanisms", IEEE Trans. Systems, Man and Cybernetics 7(12), 1977).
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from armctl import _core
from armctl.core.errors import PlanError
from armctl.core.pose import rotation_angle
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.plan.ik.solve import solve_ik
from armctl.plan.motion.path.path_segments import PathSegment

_MAX_JOINT_STEP = 0.02  # rad (m), of any joint
_MIN_STEPS = 60  # of a path
_MIN_STEP_FRACTION = 1e-6  # of the path
_SHORT_STEP_FRACTION = 1 / 64  # of the step that was tried first
_MAX_SHORT_STEPS = 30  # more of them mean that the path cannot be followed
_PATH_TOLERANCE = 1e-6  # m and rad, of the spline between the steps
_MAX_SPLINE_DEVIATION = 0.5  # of the longest step: the spline from the middle of the chord
_MIN_FINENESS = 0.25  # factor on the length of the steps
SPLINE_DEGREE = 5  # the least of which the third derivative has no jumps
_CENTERINGS = (0.0, 2.0, 20.0)  # tried in turn: over the path, a free self-motion would shrink offsets from the middle by e^-k


class JointPath(NamedTuple):
    """Joint positions along a path, as a spline."""

    spline: object  # scipy's B-spline, (n,) rad over the length, m
    length: float  # m

    @classmethod
    def through(cls, lengths: Array, q: Array, degree: int = SPLINE_DEGREE) -> JointPath:
        """The spline through joint positions (k, n) at increasing lengths (k,), from 0; more of them than its degree."""
        from scipy.interpolate import make_interp_spline

        return cls(make_interp_spline(lengths, q, k=degree), float(lengths[-1]))

    def derivatives(self, s: Array) -> tuple[Array, Array, Array, Array]:
        """q, dq/ds, d2q/ds2 and d3q/ds3, each (T, n), at lengths (T,) m."""
        return tuple(self.spline(s, order) for order in range(4))  # type: ignore[operator, return-value]


def joint_path_along(arm: Arm, what: str, path: PathSegment, q_start: Array, oriented: bool) -> JointPath:
    """The joints that keep the tip on a path, which starts at q_start; with its orientation if `oriented`.

    Raises PlanError where it leaves the reach or the limits, or passes a singularity that the joints cannot. `what` is planned.
    """
    refusals: list[_LimitsLeft] = []
    for centering in _CENTERINGS if arm.n > _rows(oriented) else _CENTERINGS[:1]:
        try:
            return _walked(_Tracker(arm, what, path, oriented, centering), q_start)
        except _LimitsLeft as refusal:
            refusals.append(refusal)
    raise PlanError(str(refusals[0]))


class _LimitsLeft(PlanError):
    """A joint would leave its limits."""


def _rows(oriented: bool) -> int:
    """How many velocities of the tip a path prescribes."""
    return 6 if oriented else 3


def _walked(tracker: _Tracker, q_start: Array) -> JointPath:
    """The path of one walk, in steps that are fine enough for its spline."""
    fineness = 1.0
    while True:
        lengths, q = tracker.run(q_start, fineness)
        joint_path = JointPath.through(lengths, q)
        between = 0.5 * (lengths[1:] + lengths[:-1])
        q_between = np.asarray(joint_path.spline(between))  # type: ignore[operator]
        stray = np.abs(q_between - 0.5 * (q[1:] + q[:-1])).max(axis=1)
        if stray.max() <= _MAX_SPLINE_DEVIATION * _MAX_JOINT_STEP:
            if fineness <= _MIN_FINENESS or tracker.distances(q_between, between).max() <= _PATH_TOLERANCE:
                return joint_path
        elif fineness <= _MIN_FINENESS:
            raise tracker.stuck(q[stray.argmax()], float(lengths[stray.argmax()]))
        fineness *= 0.5


class _Tracker:
    """One walk along a path."""

    def __init__(self, arm: Arm, what: str, path: PathSegment, oriented: bool, centering: float):
        self.arm = arm
        self.what = what
        self.path = path
        self.rows = _rows(oriented)
        self._follower = _core.TipFollower(
            model=arm.core_model,
            q_min=arm.limits.q_min,
            q_max=arm.limits.q_max,
            centering=centering / path.length,
            oriented=oriented,
        )
        self._place = lru_cache(maxsize=1)(path.at)  # two steps that follow each other meet in one place

    def run(self, q: Array, fineness: float) -> tuple[Array, Array]:
        """Lengths (k,) and joint positions (k, n) along the path."""
        total = self.path.length
        longest = fineness * total / _MIN_STEPS
        s = 0.0
        lengths = [0.0]
        configurations = [q]
        short_steps = 0
        while s < total:
            slope = self._slope(q, s)
            h = min(longest, fineness * _MAX_JOINT_STEP / max(float(np.abs(slope).max()), 1e-12), total - s)
            tried = h
            stepped = self._step(q, s, h, slope)
            while stepped is None and h > _MIN_STEP_FRACTION * total:
                h *= 0.5
                stepped = self._step(q, s, h, slope)
            short_steps += h < _SHORT_STEP_FRACTION * tried
            if stepped is None or h < min(_MIN_STEP_FRACTION * total, total - s) or short_steps > _MAX_SHORT_STEPS:
                raise self.stuck(q, s)
            q = stepped
            s = total if total - s - h < 1e-9 * total else s + h
            self._require_limits(q, s)
            lengths.append(s)
            configurations.append(q)
        return np.array(lengths), np.array(configurations)

    def distances(self, q: Array, s: Array) -> Array:
        """How far the tip is from the path, (T,) m and rad, at positions (T, n) and lengths (T,)."""
        found = np.empty((len(s), 2))
        for k, (length, position, rotation) in enumerate(zip(s, *self.arm.fk_many(q), strict=True)):
            place = self.path.at(length)
            found[k] = np.linalg.norm(place.position - position), rotation_angle(rotation.T @ place.rotation)
        return np.linalg.norm(found[:, : self.rows // 3], axis=1)

    def _step(self, q: Array, s: float, h: float, slope: Array) -> Array | None:
        """The joints a step further, or None where Newton's method does not get there."""
        end = self._place(s + h)
        moved = np.empty_like(q)
        arrived = self._follower.step(
            q,
            slope,
            length=h,
            halfway=self.path.at(s + h / 2).twist[: self.rows],
            position=end.position,
            rotation=np.ascontiguousarray(end.rotation),
            moved=moved,
        )
        return moved if arrived else None

    def _slope(self, q: Array, s: float) -> Array:
        v = np.empty_like(q)
        self._follower.slope(q, self._place(s).twist[: self.rows], v)
        return v

    def _require_limits(self, q: Array, s: float) -> None:
        limits = self.arm.limits
        outside = (q < limits.q_min - 1e-9) | (q > limits.q_max + 1e-9)
        if outside.any():
            i = int(outside.argmax())
            advice = "start from another joint position for the same tip pose"
            if self.rows == 6:
                advice += ", or let the orientation be free with target=[x, y, z]"
            raise _LimitsLeft(
                f"{self._where(s)} {self.arm.joint_names[i]} would leave its limits "
                f"[{limits.q_min[i]:.3f}, {limits.q_max[i]:.3f}] {self.arm.units[i]}; {self._why_not_its_end() or advice}"
            )

    def stuck(self, q: Array, s: float) -> PlanError:
        """The error at a place that the arm cannot pass, (n,) rad and m along the path."""
        J = self.arm.pinocchio_model.jacobian(q)[: self.rows]
        needed = np.abs(self._slope(q, s))
        i = int(needed.argmax())
        weakest = float(np.linalg.svd(J, compute_uv=False)[-1])
        return PlanError(
            f"{self._where(s)} the arm can follow no further: it is stretched out or folded (smallest singular value "
            f"{weakest:.2g}), and {self.arm.joint_names[i]} would have to turn at once; "
            f"{self._why_not_its_end() or 'bring the path nearer, or go round with move_j'}"
        )

    def _why_not_its_end(self) -> str:
        """What is wrong with the path's last point, if the tip cannot be there at all: then no other way there helps."""
        end = solve_ik(self.arm, self.path.at(self.path.length).position)
        return "" if end.ok else f"the end of the path: {end.reason}"

    def _where(self, s: float) -> str:
        x, y, z = self.path.at(s).position
        return f"{self.what}: at {100 * s / self.path.length:.1f} % of the path, tip at [{x:.3f}, {y:.3f}, {z:.3f}] m,"
