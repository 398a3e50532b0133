"""A motion that excites all parameters of an arm, chosen by the information that it gives."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from armctl.core.errors import ArmctlWarning, LimitError, PlanError
from armctl.core.validation import Array, IntArray
from armctl.lab.identification.regressor import ArmRegressor, FrictionShape, condition_number, pivoted_qr
from armctl.model.arm.arm import Arm
from armctl.model.collision.checkers import collision_checker
from armctl.model.collision.clearance import clearance_of
from armctl.plan.motion.move_through import move_through
from armctl.plan.motion.torque_limits import check_torque
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory

if TYPE_CHECKING:
    from armctl.model.collision.checker import CollisionChecker

_SECONDS_PER_CONFIGURATION = 0.75  # at first; then by the durations of the motions
_MIN_CONFIGURATIONS = 3
_TRIES = 200
_CANDIDATES = 20  # safe motions, of which the best is taken
_SIZES = (1.0, 0.8, 0.6, 0.4)  # of the range around the start, in turn: wide sets touch something more often
MAX_DISTANCE = 1.5  # rad (m) from the start
_MAX_OTHER_STARTS = 5
LIMIT_MARGIN = 0.05  # of a joint's range
TORQUE_SHARE = 0.9  # of the limits; the controller needs the rest
CLEARANCE_M = 0.005  # for the error of the controller
NOT_PROVED = float("nan")  # m
_SCORE_SAMPLES = 100
_SMOOTHING_SPEED = 0.02  # rad/s, of Coulomb friction in the score
_NOISE_SHARE = 2e-3  # of the torque limits, or of typical torques of joints without limits: noise of a sample in the score
_PATH_SAMPLES = 10  # between two configurations, for a first check for collisions


@dataclass(frozen=True, eq=False)
class Multisine:
    """Where the measured periods of a motion are, and what they contain."""

    joints: tuple[int, ...]
    period: float  # s
    starts: Array  # (M,) s, where a measured period begins, each with its own phases
    lines: IntArray  # the excited multiples of 1 / period, all odd


@dataclass(frozen=True, eq=False)
class Excitation(JointTrajectory):
    """A motion for identification, and how well it is conditioned.

    Attributes:
        excites: "arm", "payload" or "frequency".
        condition_number: Of the regressor of the parameters in question along the motion, with columns of equal length.
        clearance: m, for an arm and a frequency response: the proved distance from everything during the whole motion; nan for
            an arm with links that have no shape.
        multisine: For a frequency response: its measured periods and frequencies.
    """

    excites: str = "payload"
    condition_number: float = float("nan")
    clearance: float = NOT_PROVED
    multisine: Multisine | None = None


class _Score(NamedTuple):
    # The mean over the joints of the logarithm of the variance of the torques of random states after a fit to the motion; less
    # is better.
    uncertainty: float
    condition: float  # the condition number of the regressor with columns of equal length


def arm_excitation(arm: Arm, duration: float, speed: float, seed: int, start: Array | None = None) -> Excitation:
    """The most informative of several safe motions, from `start` or home; else, with a warning, from near home."""
    score_of = _Scorer(arm)
    checker = collision_checker(arm)
    checker.require_provable_among_obstacles()
    if start is not None:
        return _from(start, arm, checker, score_of, duration, speed, seed)
    home = arm.limits.clamp(arm.home)
    try:
        return _from(home, arm, checker, score_of, duration, speed, seed)
    except PlanError as error:
        from_home = error
    for other in _other_starts(arm, checker, np.random.default_rng(seed)):
        try:
            motion = _from(other, arm, checker, score_of, duration, speed, seed)
        except PlanError:
            continue
        at = ", ".join(f"{position:.3g}" for position in other)
        warnings.warn(
            f"{arm.name:.80}: the motion starts at q = [{at}], as none from home is safe; move there first",
            ArmctlWarning,
            stacklevel=3,
        )
        return motion
    raise from_home


def _other_starts(arm: Arm, checker: CollisionChecker, rng: np.random.Generator) -> Iterator[Array]:
    """Configurations that are clear of everything, those close to home first."""
    found = 0
    for attempt in range(_TRIES):
        q = _waypoints(arm, arm.limits.clamp(arm.home), 1, (attempt + 1) / _TRIES, rng)[1]
        if not checker.at(q, CLEARANCE_M):
            found += 1
            yield q
        if found == _MAX_OTHER_STARTS:
            return


def _from(
    start: Array, arm: Arm, checker: CollisionChecker, score_of: _Scorer, duration: float, speed: float, seed: int
) -> Excitation:
    rng = np.random.default_rng(seed)
    near = checker.at(start, CLEARANCE_M)
    if near:
        raise PlanError(f"{arm.name:.80}: no motion from q = {np.round(start, 3)} is safe: {near:.200} within 5 mm")
    count = max(_MIN_CONFIGURATIONS, round(duration / _SECONDS_PER_CONFIGURATION))
    best: Excitation | None = None
    least = np.inf
    found = 0
    reason = "every path that was tried touches something"
    for attempt in range(_TRIES):
        waypoints = _clear(_waypoints(arm, start, count, _SIZES[attempt % len(_SIZES)], rng), checker)
        if len(waypoints) < _MIN_CONFIGURATIONS + 2:
            continue
        try:
            fastest = move_through(arm, waypoints)
        except (PlanError, LimitError) as error:
            reason = str(error)
            continue
        factor = fastest.duration / duration
        if factor > speed:
            reason = f"a motion through {count} configurations takes more than {duration:g} s"
            count = max(_MIN_CONFIGURATIONS, min(count - 1, int(count * speed / factor)))
            continue
        if factor < speed * count / (count + 1):
            count += 1
        motion = fastest.scaled(factor)
        torque = check_torque(arm, motion)
        if torque.ratio > TORQUE_SHARE:
            reason = str(torque)
            continue
        clearance = clearance_of(checker, motion, CLEARANCE_M)
        if not clearance:
            reason = clearance.reason
            continue
        found += 1
        score = score_of(motion)
        if score.uncertainty < least:
            least = score.uncertainty
            best = excitation_along(motion, "arm", score.condition, NOT_PROVED if checker.not_checkable else clearance.distance)
        if found == _CANDIDATES:
            break
    if best is None:
        raise PlanError(f"{arm.name:.80}: no motion from q = {np.round(start, 3)} excites all parameters safely: {reason:.200}")
    return best


def excitation_along(
    motion: JointTrajectory, excites: str, condition_number: float, clearance: float = NOT_PROVED
) -> Excitation:
    return Excitation(
        knots=motion.knots,
        coefficients=motion.coefficients,
        joint_names=motion.joint_names,
        limits=motion.limits,
        slowed=motion.slowed,
        units=motion.units,
        excites=excites,
        condition_number=condition_number,
        clearance=clearance,
    )


def _waypoints(arm: Arm, start: Array, count: int, size: float, rng: np.random.Generator) -> Array:
    """Random configurations around a start, which is the first and the last; (count + 2, n)."""
    limits = arm.limits
    low = np.clip(limits.q_min, start - MAX_DISTANCE, start)
    high = np.clip(limits.q_max, start, start + MAX_DISTANCE)
    margin = LIMIT_MARGIN * (high - low)
    between = start + size * (rng.uniform(low + margin, high - margin, (count, arm.n)) - start)
    return np.vstack([start, between, start])


def _clear(waypoints: Array, checker: CollisionChecker) -> Array:
    """The waypoints without those that no straight way reaches from the one before; the first and the last stay.

    A long motion has many, so that nearly every set as a whole would touch something.
    """

    def touches(a: Array, b: Array) -> bool:
        return bool(checker.along(np.linspace(a, b, _PATH_SAMPLES)))

    clear = [waypoints[0]]
    for waypoint in waypoints[1:-1]:
        if not touches(clear[-1], waypoint):
            clear.append(waypoint)
    while len(clear) > 1 and touches(clear[-1], waypoints[-1]):
        clear.pop()
    return np.vstack([*clear, waypoints[-1]])


class _Scorer:
    def __init__(self, arm: Arm):
        self._regressor = ArmRegressor(arm, "coulomb+viscous")
        typical = self._regressor.torque_scale()
        limits = arm.limits.tau_max
        self._noise = _NOISE_SHARE * np.where(np.isfinite(limits), limits, typical)
        speed = np.full(arm.n, _SMOOTHING_SPEED)
        self._shape = FrictionShape(speed, speed)
        rows = self._regressor.rows(*self._regressor.random_states(), self._shape) * self._regressor.prior
        self._targets = rows
        _, order, rank = pivoted_qr((rows / typical[:, None]).reshape(-1, rows.shape[2]))
        self._base = order[:rank]

    def __call__(self, motion: JointTrajectory) -> _Score:
        states = motion.sample(np.linspace(0.0, motion.duration, _SCORE_SAMPLES))
        rows = self._regressor.rows(states.q, states.v, states.a, self._shape) / self._noise[:, None]
        W = rows.reshape(-1, rows.shape[2]) * self._regressor.prior
        factor = np.linalg.cholesky(W.T @ W + np.eye(W.shape[1]))
        spread = np.linalg.solve(factor, self._targets.reshape(-1, W.shape[1]).T)
        variance = (spread**2).sum(axis=0).reshape(-1, len(self._noise)).mean(axis=0)
        uncertainty = float(np.log(variance).mean())
        return _Score(uncertainty, condition_number(W[:, self._base]))
