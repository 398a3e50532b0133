"""Random motions of every kind with limits scaled by 1e-3 to 1e3: no limit is violated, and only PlanError is raised.

Each motion is checked twice, by code that no planner uses: by the roots of its polynomials, and by 1 kHz differences of its
samples.
"""

from collections import Counter
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from arms import ARMS, arm_of
from motion_check import DIFFERENCE_TOLERANCE, POSITION_TOLERANCE, RATIO_TOLERANCE, violation

import armctl

MAX_LISTED = 50  # violations; the test goes on after one
SUITE_ARMS = ("robot_arm_3dof", "gantry")


def scaled_limits(arm: armctl.Arm, rng: np.random.Generator) -> armctl.Arm:
    """The arm with its speed, acceleration and jerk limits scaled by 1e-3 to 1e3, together or each joint by itself."""
    shape = (3, arm.n) if rng.random() < 0.5 else (3, 1)
    v, a, j = 10.0 ** rng.uniform(-3, 3, shape)
    limits = arm.limits
    scaled = replace(limits, v_max=v * limits.v_max, a_max=a * limits.a_max, j_max=j * limits.j_max)
    return arm.with_limits(replace(scaled, tau_max=np.full(arm.n, np.inf)))


def random_q(arm: armctl.Arm, rng: np.random.Generator, count: int = 1) -> np.ndarray:
    """Configurations anywhere inside the limits, some joints exactly at a limit."""
    q = arm.limits.random(arm.home, count, rng)
    at_limit = rng.random(q.shape) < 0.1
    side = np.where(rng.random(q.shape) < 0.5, arm.limits.q_min, arm.limits.q_max)
    return np.where(at_limit & np.isfinite(side), side, q)


def near_point(arm: armctl.Arm, rng: np.random.Generator, q: np.ndarray) -> np.ndarray:
    """A point up to 0.2 m from the tip, in a direction in which the tip can move."""
    direction = arm.jacobian(q)[:3] @ rng.normal(size=arm.n)
    length = np.linalg.norm(direction)
    return arm.fk(q).position + rng.uniform(0.01, 0.2) * direction / (length if length > 1e-9 else 1.0)


def offset(arm: armctl.Arm, rng: np.random.Generator, q: np.ndarray) -> np.ndarray:
    """Some centimetres, (3,) m, in directions in which the tip can move."""
    axes, stretch, _ = np.linalg.svd(arm.jacobian(q)[:3], full_matrices=False)
    possible = axes[:, stretch > 1e-6]
    return possible @ (possible.T @ rng.normal(0.0, 0.05, 3))


def move_j(arm, rng):
    start, goal = random_q(arm, rng, 2)
    if rng.random() < 0.3:
        goal = arm.limits.clamp(start + 10.0 ** rng.uniform(-12, 0) * rng.normal(size=arm.n))
    return armctl.move_j(arm, start, goal, speed=rng.choice([1.0, 0.3]))


def move_j_moving(arm, rng):
    """A straight move that starts in motion."""
    start, goal = random_q(arm, rng, 2)
    way = goal - start
    v = rng.uniform(0, 0.8) * way * (arm.limits.v_max / np.maximum(np.abs(way), 1e-9)).min()
    return armctl.move_j(arm, armctl.Setpoint(start, v, np.zeros(arm.n)), goal)


def move_j_free(arm, rng):
    start, goal = random_q(arm, rng, 2)
    return armctl.move_j(arm, start, goal, straight=False)


def move_j_free_moving(arm, rng):
    start, goal = random_q(arm, rng, 2)
    v = 10.0 ** rng.uniform(-4, 0) * rng.uniform(-0.9, 0.9, arm.n) * arm.limits.v_max
    return armctl.move_j(arm, armctl.Setpoint(start, v, np.zeros(arm.n)), goal, straight=False)


def move_through(arm, rng):
    q = random_q(arm, rng, int(rng.integers(2, 7)))
    if rng.random() < 0.4:  # a walk of small steps, some of them tiny
        steps = 10.0 ** rng.uniform(-11, 0, (len(q), 1)) * rng.normal(size=q.shape)
        q = arm.limits.clamp(q[0] + np.cumsum(steps, axis=0))
    return armctl.move_through(arm, q)


def move_l(arm, rng):
    q = random_q(arm, rng)[0]
    target = near_point(arm, rng, q)
    if arm.n >= 6 and rng.random() < 0.5:
        target = armctl.Pose(target, quat=arm.fk(q).quat)
    return armctl.move_l(arm, q, target, tip_speed=rng.choice([None, 0.05]))


def move_c(arm, rng):
    q = random_q(arm, rng)[0]
    via = near_point(arm, rng, q)
    return armctl.move_c(arm, q, via, via + offset(arm, rng, q))


def move_path(arm, rng):
    q = random_q(arm, rng)[0]
    first = near_point(arm, rng, q)
    return armctl.move_path(arm, q, [first, first + offset(arm, rng, q), first + offset(arm, rng, q)], blend=0.004)


def scaled(arm, rng):
    return move_j_free(arm, rng).scaled(10.0 ** rng.uniform(-3, 0))


def stopped_at(arm, rng):
    motion = (move_j, move_j_free, move_through, move_l)[int(rng.integers(4))](arm, rng)
    return motion.stopped_at(rng.uniform(0, motion.duration))


def overridden(arm, rng):
    motion = (move_j, move_j_free, move_through, move_l)[int(rng.integers(4))](arm, rng)
    return motion.overridden(rng.uniform(0, motion.duration), 10.0 ** rng.uniform(-2, 0.5))


PLANNERS = (
    move_j,
    move_j_moving,
    move_j_free,
    move_j_free_moving,
    move_through,
    move_l,
    move_c,
    move_path,
    scaled,
    stopped_at,
    overridden,
)


def expected(error: Exception, plan) -> bool:
    """Whether a planner may raise this: PlanError, or an error that names what is wrong with the random arguments."""
    if isinstance(error, armctl.LimitError):
        return plan in (move_j_moving, move_j_free_moving) and str(error).startswith("q_start")
    wrong_argument = {move_c: "on one line", move_path: "of the shorter side"}
    return isinstance(error, armctl.PlanError) or (plan in wrong_argument and wrong_argument[plan] in str(error))


@pytest.mark.parametrize("plan", PLANNERS, ids=lambda plan: plan.__name__)
def test_a_random_motion_keeps_its_limits_or_is_refused(plan, fuzz_cases, fuzz_seconds, fuzz_motions, fuzz_first):
    names = ARMS if fuzz_seconds else [name for name in ARMS if name in SUITE_ARMS]
    arms = [arm_of(name) for name in names]
    tally = Counter()
    violations = []
    for case, rng in enumerate(fuzz_cases(fuzz_motions * len(arms)), start=fuzz_first):
        arm = scaled_limits(arms[case % len(arms)], rng)
        try:
            motion = plan(arm, rng)
        except Exception as error:
            if expected(error, plan):
                tally["refused"] += 1
            else:
                violations.append(f"case {case}, {arm.name}: {type(error).__name__}: {error}")
            continue
        found = violation(motion, arm.limits)
        if found:
            violations.append(f"case {case}, {arm.name}: {motion}: {found}")
        tally["planned"] += 1
    assert not violations, f"{len(violations)} of {dict(tally)}:\n" + "\n".join(violations[:MAX_LISTED])
    assert tally["planned"] >= tally["refused"] / 4, tally
    print(plan.__name__, dict(tally))


def online_violation(arm, rng) -> str:
    """What an online motion to six goals, some of them given on the way, violates; or nothing."""
    limits = arm.limits
    motion = armctl.OnlineMotion(arm, random_q(arm, rng)[0])
    samples = [motion.setpoint[:3]]
    for _ in range(6):
        with suppress(armctl.PlanError):
            motion.go_to(random_q(arm, rng)[0])
        samples += [motion.step(1e-3)[:3] for _ in range(int(rng.integers(1, 200)))]
    q, v, a = (np.array(x) for x in zip(*samples, strict=True))
    if not limits.contains(q, POSITION_TOLERANCE):
        return "position"
    for order, (x, bound) in enumerate(((v, limits.v_max), (a, limits.a_max)), start=1):
        if (np.abs(x) > bound * (1 + RATIO_TOLERANCE)).any():
            return f"derivative {order}"
    for order, (x, bound) in enumerate(((q, limits.v_max), (v, limits.a_max), (a, limits.j_max)), start=1):
        rounding = 1e-12 + 1e-12 * np.abs(x).max()
        if (np.abs(np.diff(x, axis=0)) > (1 + DIFFERENCE_TOLERANCE) * 1e-3 * bound + rounding).any():
            return f"derivative {order} by differences"
    return ""


def test_online_motion_keeps_its_limits_whatever_the_goals(fuzz_cases, fuzz_seconds, fuzz_motions, fuzz_first):
    names = ARMS if fuzz_seconds else [name for name in ARMS if name in SUITE_ARMS]
    arms = [arm_of(name) for name in names]
    violations = []
    for case, rng in enumerate(fuzz_cases(fuzz_motions * len(arms)), start=fuzz_first):
        arm = scaled_limits(arms[case % len(arms)], rng)
        found = online_violation(arm, rng)
        if found:
            violations.append(f"case {case}, {arm.name}: {found}")
    assert not violations, "\n".join([f"{len(violations)} violations", *violations[:MAX_LISTED]])
