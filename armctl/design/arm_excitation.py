"""A motion that excites all parameters of an arm, chosen by the information that it gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from armctl.collision.checkers import collision_checker
from armctl.collision.clearance import clearance_of
from armctl.core.errors import LimitError, PlanError
from armctl.core.validation import Array, IntArray
from armctl.design.regressor import ArmRegressor, FrictionShape, pivoted_qr
from armctl.motion import JointTrajectory, check_torque, move_through
from armctl.robot.arm import Arm

_SECONDS_PER_CONFIGURATION = 0.75  # at first; then by the durations of the motions
_MIN_CONFIGURATIONS = 3
_TRIES = 60
_CANDIDATES = 6  # safe motions, of which the best is taken
_SIZES = (1.0, 0.8, 0.6, 0.4)  # of the range around home, in turn: wide sets touch something more often
_MAX_DISTANCE = 1.5  # rad (m) from home
_LIMIT_MARGIN = 0.05  # of a joint's range
_TORQUE_SHARE = 0.9  # of the limits; the controller needs the rest
_CLEARANCE_M = 0.005  # for the error of the controller
_SCORE_SAMPLES = 100
_SMOOTHING_SPEED = 0.02  # rad/s, of Coulomb friction in the score
_REGULARIZATION = 1e-6  # of the information matrix, so that its determinant exists
_PATH_SAMPLES = 10  # between two configurations, for a first check for collisions


@dataclass(frozen=True, eq=False)
class Excitation(JointTrajectory):
    """A motion for identification, and how well it is conditioned.

    Attributes:
        excites: "arm" or "payload".
        condition_number: Of the regressor of the parameters in question along the motion, with columns of equal length.
        clearance: m, for an arm: the proved distance from everything during the whole motion.
    """

    excites: str = "payload"
    condition_number: float = float("nan")
    clearance: float = float("nan")


class _Score(NamedTuple):
    """How well a motion shows the parameters.

    Attributes:
        information: The logarithm of the determinant of the information matrix; more is better.
        condition: The condition number of the regressor with columns of equal length.
    """

    information: float
    condition: float


def arm_excitation(arm: Arm, seconds: float, speed: float, seed: int) -> Excitation:
    """The most informative of several safe motions through random configurations, from home to home."""
    regressor = ArmRegressor(arm, "coulomb+viscous")
    base = _base_columns(regressor)
    checker = collision_checker(arm)
    checker.require_provable()
    rng = np.random.default_rng(seed)
    count = max(_MIN_CONFIGURATIONS, round(seconds / _SECONDS_PER_CONFIGURATION))
    best: Excitation | None = None
    best_information = -np.inf
    found = 0
    reason = "every path that was tried touches something"
    for attempt in range(_TRIES):
        waypoints = _waypoints(arm, count, _SIZES[attempt % len(_SIZES)], rng)
        if checker.along(np.linspace(waypoints[:-1], waypoints[1:], _PATH_SAMPLES).reshape(-1, arm.n)):
            continue
        try:
            fastest = move_through(arm, waypoints)
        except (PlanError, LimitError) as error:
            reason = str(error)
            continue
        factor = fastest.duration / seconds
        if factor > speed:
            reason = f"a motion through {count} configurations takes more than {seconds:g} s"
            count = max(_MIN_CONFIGURATIONS, min(count - 1, int(count * speed / factor)))
            continue
        motion = fastest.scaled(factor)
        torque = check_torque(arm, motion)
        if torque.ratio > _TORQUE_SHARE:
            reason = str(torque)
            continue
        clearance = clearance_of(checker, motion, _CLEARANCE_M)
        if not clearance:
            reason = clearance.reason
            continue
        found += 1
        score = _score(regressor, base, motion)
        if score.information > best_information:
            best_information = score.information
            best = _excitation(motion, score.condition, clearance.distance)
        if found == _CANDIDATES:
            break
    if best is None:
        raise PlanError(f"{arm.name:.80}: no motion from home excites all parameters safely: {reason:.200}")
    return best


def _excitation(motion: JointTrajectory, condition: float, clearance: float) -> Excitation:
    return Excitation(
        motion.knots,
        motion.coefficients,
        motion.joint_names,
        motion.limits,
        motion.slowed,
        motion.units,
        excites="arm",
        condition_number=condition,
        clearance=clearance,
    )


def _waypoints(arm: Arm, count: int, size: float, rng: np.random.Generator) -> Array:
    """Random configurations around home, which is the first and the last; (count + 2, n)."""
    limits = arm.limits
    home = limits.clamp(arm.home)
    low = np.clip(limits.q_min, home - _MAX_DISTANCE, home)
    high = np.clip(limits.q_max, home, home + _MAX_DISTANCE)
    margin = _LIMIT_MARGIN * (high - low)
    between = home + size * (rng.uniform(low + margin, high - margin, (count, arm.n)) - home)
    return np.vstack([home, between, home])


def _base_columns(regressor: ArmRegressor) -> IntArray:
    """The parameters that lead the base parameters."""
    rows = regressor.rows(*regressor.random_states(), _shape(regressor.arm.n)) / regressor.torque_scale()[:, None]
    _, order, rank = pivoted_qr(rows.reshape(-1, regressor.layout.size) * regressor.prior)
    return order[:rank]


def _shape(n: int) -> FrictionShape:
    return FrictionShape(np.full(n, _SMOOTHING_SPEED), np.full(n, _SMOOTHING_SPEED))


def _score(regressor: ArmRegressor, base: IntArray, motion: JointTrajectory) -> _Score:
    """The score of the base parameters along a motion, torques in units of typical ones."""
    states = motion.sample(np.linspace(0.0, motion.duration, _SCORE_SAMPLES))
    rows = regressor.rows(states.q, states.v, states.a, _shape(regressor.arm.n)) / regressor.torque_scale()[:, None]
    W = (rows.reshape(-1, regressor.layout.size) * regressor.prior)[:, base]
    information = float(np.linalg.slogdet(W.T @ W + _REGULARIZATION * np.eye(len(base)))[1])
    lengths = np.linalg.norm(W, axis=0)
    if not (lengths > 0).all():
        return _Score(information, float("inf"))
    singular = np.linalg.svd(W / lengths, compute_uv=False)
    return _Score(information, float(singular[0] / max(singular[-1], np.finfo(float).tiny)))
