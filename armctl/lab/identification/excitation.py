"""Excitation: a motion that shows the parameters of an arm, a payload's mass and centre, or a frequency response."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError, LimitError, PlanError
from armctl.core.limits import check_speed
from armctl.core.validation import Array, choice, instance, number
from armctl.lab.identification.arm_excitation import (
    LIMIT_MARGIN,
    MAX_DISTANCE,
    TORQUE_SHARE,
    Excitation,
    arm_excitation,
    excitation_along,
)
from armctl.lab.identification.multisine import multisine_excitation
from armctl.lab.identification.regressor import condition_number
from armctl.model.arm.arm import Arm, check_arm
from armctl.model.arm.dynamics import Dynamics
from armctl.model.collision.checkers import collision_checker
from armctl.plan.motion.move_through import move_through
from armctl.plan.motion.torque_limits import check_torque
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory

if TYPE_CHECKING:
    from armctl.model.collision.checker import CollisionChecker

_SPEEDS = {"arm": 0.9, "payload": 0.6, "frequency": 0.9}  # by default
_PAYLOAD_PARAMETERS = 4  # mass and first moment
_MAX_PAYLOAD_KG = 1e6
_SETS = 120  # of configurations, from which the motion is chosen
_SIZES = 4  # sets of size k keep within 0.5^k of the range around home
_CONFIGURATIONS = 5  # in a set
_MAX_FAILED_PLANS = 2  # for each size; more failures have their reason in the arm and not in the set
_REGULARIZATION = 1e-6  # of the information matrix, so that its determinant exists where a parameter is not shown
_SPEED_FACTORS = (1.0, 0.7, 0.5)  # tried one after another until the torques are small enough
_SECONDS = 5.0  # by default
_MIN_SECONDS = 1.0
_MAX_SECONDS = 120.0
_CONDITION_SAMPLES = 100
_CHECK_INTERVAL_S = 0.02  # between checks for collisions, at full speed
_COLLIDES = "it touches something on every path that was tried"
_TOO_HEAVY = "its weight there is more than the motors hold"


class _Set(NamedTuple):
    """Waypoints (k, n) from home to home, and how close to home they keep: 0 is the farthest."""

    size: int
    waypoints: Array


def excitation(
    arm: Arm,
    payload: float = 1.0,
    *,
    duration: float | None = None,
    for_: str = "payload",
    speed: float | None = None,
    seed: int = 0,
    start: ArrayLike | None = None,
    joint: int | str | None = None,
) -> Excitation:
    """A motion for identification: from home, so that every joint moves and is loaded differently, and back.

    It keeps all limits, torque included, and touches nothing. For a payload it goes through random configurations, in the
    order in which their static torques tell mass and centre apart (the determinant of the information matrix). For the arm it
    is the most informative of several such motions, by the dynamic regressor of all base parameters, and a proof with 5 mm
    of clearance covers the whole motion. For a frequency response it is a multisine of all joints around one configuration,
    with the same proof.

    Args:
        payload: kg, the largest mass that its tip may be holding; only for a payload.
        duration: s, of a motion for the arm, 5 by default, or for a frequency response, where a longer one has
            narrower bounds; one for a payload takes as long as it needs.
        for_: "arm" for `identify`, "payload" for `identify_payload`, "frequency" for `FrequencyResponse.from_log`.
        speed: Fraction of the full speed, in (0, 1]; for the arm the largest that the motion may have, for a frequency
            response that of the limits on acceleration and jerk. By default 0.6 for a payload, otherwise 0.9.
        seed: Seed of the configurations or phases.
        start: (n,) rad, the first and last configuration of a motion for the arm or a frequency response. By default it is
            home. If no motion for the arm from home is safe, armctl warns and takes another one, `motion(0.0).q`.
        joint: The only joint to move, by name or index, for a frequency response while all others are held; all by default.

    Returns:
        The motion, at rest at both ends, with its condition number.

    Raises:
        InputError: It is not an arm, or another argument is out of its bounds.
        ModelError: For the arm: a joint follows another one, or no clearance can be proved in this scene.
        LimitError: The start is outside the limits.
        PlanError: There is no such motion.
    """
    check_arm(arm)
    payload = number("payload", payload, 0.0, _MAX_PAYLOAD_KG)
    for_ = choice("for_", for_, tuple(_SPEEDS))
    if duration is not None:
        duration = number("duration", duration, _MIN_SECONDS, _MAX_SECONDS)
    speed = check_speed(_SPEEDS[for_] if speed is None else speed)
    instance("seed", seed, (int, np.integer), "give an integer")
    number("seed", seed, 0)
    if start is not None and for_ == "payload":
        raise InputError("start: a motion for a payload starts at home; leave it out, or use for_='arm'")
    if joint is not None and for_ != "frequency":
        raise InputError("joint: a motion that identifies parameters moves all joints; leave it out, or use for_='frequency'")
    begin = None if start is None else arm.checked("start", start)
    if for_ == "frequency":
        return multisine_excitation(arm, duration, speed, int(seed), begin, joint)
    if for_ == "arm":
        return arm_excitation(arm, _SECONDS if duration is None else duration, speed, int(seed), begin)
    motion = _payload_excitation(arm, payload, speed, int(seed))
    return excitation_along(motion, excites="payload", condition_number=_condition_number(arm, motion))


def _condition_number(arm: Arm, motion: JointTrajectory) -> float:
    """The condition number of a payload's mass and first moment along a motion, columns of equal length."""
    if not arm.joint_map.is_plain:
        return float("inf")
    dynamics = Dynamics(arm.model, arm.pinocchio_model)
    states = motion.sample(np.linspace(0.0, motion.duration, _CONDITION_SAMPLES))[:3]
    Y = np.array(
        [
            dynamics.payload_regressor(*row)[:, :_PAYLOAD_PARAMETERS] / arm.limits.tau_max[:, None]
            for row in zip(*states, strict=True)
        ]
    )
    return condition_number(Y.reshape(-1, _PAYLOAD_PARAMETERS))


def _payload_excitation(arm: Arm, payload: float, speed: float, seed: int) -> JointTrajectory:
    loaded = arm.with_payload(payload)
    collisions = collision_checker(arm)
    collisions.require_provable_among_obstacles()
    held = _holding_check(loaded)
    reason = _COLLIDES if held(arm.home) else _TOO_HEAVY
    failed = [0] * _SIZES
    for size, waypoints in _ranked_sets(arm, np.random.default_rng(seed)) if reason == _COLLIDES else ():
        if failed[size] == _MAX_FAILED_PLANS:
            continue
        between = np.linspace(waypoints[:-1], waypoints[1:], 10).reshape(-1, arm.n)
        if not all(held(q) for q in between):
            reason = _TOO_HEAVY
            continue
        if collisions.along(between):
            continue
        try:
            motion, reason = _motion_through(arm, loaded, collisions, waypoints, speed)
        except (PlanError, LimitError) as error:
            reason = str(error)
        else:
            if motion is not None:
                return motion
        failed[size] += 1
    raise PlanError(f"{arm.name}: no motion from home shows a payload of {payload:g} kg safely: {reason:.200}")


def _holding_check(loaded: Arm) -> Callable[[Array], bool]:
    """Whether the motors hold an arm still at a configuration, with some torque left."""
    dynamics = Dynamics(loaded.model, loaded.pinocchio_model)
    bound = TORQUE_SHARE * loaded.limits.tau_max
    return lambda q: bool((np.abs(dynamics.gravity(q)) + dynamics.friction_loss <= bound).all())


def _motion_through(
    arm: Arm, loaded: Arm, collisions: CollisionChecker, waypoints: Array, speed: float
) -> tuple[JointTrajectory | None, str]:
    """The motion through waypoints that the motors can follow with and without the payload, or why there is none."""
    fastest = move_through(loaded, waypoints)
    if collisions.along(fastest.sample(np.arange(0.0, fastest.duration, _CHECK_INTERVAL_S * speed)).q):
        return None, _COLLIDES
    for factor in _SPEED_FACTORS:
        motion = fastest.scaled(factor * speed)
        if max(check_torque(each, motion).ratio for each in (arm, loaded)) < TORQUE_SHARE:
            return motion, ""
    return None, f"it takes more than {100 * TORQUE_SHARE:g} % of the torque limits on every path that was tried"


def _ranked_sets(arm: Arm, rng: np.random.Generator) -> list[_Set]:
    """Random sets, those first whose static torques determine a payload's four parameters best."""
    limits = arm.limits
    low = np.clip(limits.q_min, arm.home - MAX_DISTANCE, arm.home + MAX_DISTANCE)
    high = np.clip(limits.q_max, arm.home - MAX_DISTANCE, arm.home + MAX_DISTANCE)
    margin = LIMIT_MARGIN * (high - low)
    low = low + margin
    high = high - margin
    home = limits.clamp(arm.home)
    zero = np.zeros(arm.n)
    dynamics = Dynamics(arm.model, arm.pinocchio_model)
    scores = []
    sets = []
    for k in range(_SETS):
        size = k % _SIZES
        between = home + 0.5**size * (rng.uniform(low, high, (_CONFIGURATIONS, arm.n)) - home)
        held = [dynamics.payload_regressor(q, zero, zero)[:, :_PAYLOAD_PARAMETERS] for q in between]
        Y = np.vstack([each / limits.tau_max[:, None] for each in held])
        scores.append(float(np.linalg.slogdet(Y.T @ Y + _REGULARIZATION * np.eye(_PAYLOAD_PARAMETERS))[1]))
        sets.append(_Set(size, np.vstack([home, between, home])))
    order = sorted(range(_SETS), key=lambda k: -scores[k])
    return [sets[k] for k in order]
