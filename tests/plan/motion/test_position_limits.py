"""Position limits of profiles between any two states, judged by the exact extremes of their polynomials."""

from collections.abc import Iterator

import numpy as np
import pytest
from synthetic import Shape, serial_arm

import armctl
from armctl.plan.motion.timing.otg import JointState, Profile, ProfileSolver
from armctl.plan.motion.trajectory.piecewise import Pieces

N = 3
FAR = 100.0
HAIR = 1e-7  # rad; the ends of ruckig's phases are accurate to 1e-8


def extremes(pieces: Pieces) -> tuple[np.ndarray, np.ndarray]:
    """The least and largest position of each joint, at the ends of the pieces and where their velocity is zero."""
    low = np.full(N, np.inf)
    high = np.full(N, -np.inf)
    for duration, coefficients in zip(np.diff(pieces.knots), pieces.coefficients, strict=True):
        for joint in range(N):
            polynomial = np.polynomial.Polynomial(coefficients[:4, joint])
            turns = polynomial.deriv().roots()
            turns = turns[np.isreal(turns)].real
            positions = polynomial(np.concatenate([[0.0, duration], turns[(turns > 0.0) & (turns < duration)]]))
            low[joint] = min(low[joint], positions.min())
            high[joint] = max(high[joint], positions.max())
    return low, high


def random_profiles(count: int) -> Iterator[tuple[Profile, JointState]]:
    """Profiles between moving states, with joints that arrive together or each by itself."""
    rng = np.random.default_rng(0)
    while count:
        v_max = rng.uniform(0.5, 3.0, N)
        a_max = rng.uniform(1.0, 20.0, N)
        solver = ProfileSolver(v_max, a_max, a_max * 10 ** rng.uniform(0.0, 3.0, N))
        together = bool(rng.integers(2))
        v_goal = 0.5 * rng.uniform(-1, 1, N) * v_max * together  # joints that arrive earlier than others must rest
        start = JointState(rng.uniform(-1, 1, N).tolist(), (0.9 * rng.uniform(-1, 1, N) * v_max).tolist(), N * [0.0])
        goal = JointState(rng.uniform(-1, 1, N).tolist(), v_goal.tolist(), N * [0.0])
        profile = solver.solve(start, goal, together)
        if profile is not None:
            yield profile, start
            count -= 1


def test_a_profile_is_inside_exactly_the_limits_that_it_reaches():
    for profile, start in random_profiles(100):
        low, high = extremes(profile.pieces(start))
        assert profile.stays_inside((low - HAIR).tolist(), (high + HAIR).tolist())
        for joint in range(N):
            above_least = np.full(N, -FAR)
            above_least[joint] = low[joint] + HAIR
            below_most = np.full(N, FAR)
            below_most[joint] = high[joint] - HAIR
            assert not profile.stays_inside(above_least.tolist(), N * [FAR])
            assert not profile.stays_inside(N * [-FAR], below_most.tolist())


def test_online_motions_from_random_states_near_the_limits_stay_inside(tmp_path):
    base = serial_arm(tmp_path, Shape(0.3, 2.0, 100.0, joints=N))
    rng = np.random.default_rng(1)
    made = 0
    for _ in range(90):
        span = rng.uniform(0.05, 2.0, N)
        a_max = rng.uniform(2.0, 20.0, N)
        limits = armctl.Limits(
            q_min=-span,
            q_max=span,
            v_max=rng.uniform(0.5, 3.0, N),
            a_max=a_max,
            j_max=a_max * 10 ** rng.uniform(0.5, 3.0, N),
            tau_max=base.limits.tau_max,
        )
        arm = base.with_limits(limits)
        q = np.where(rng.uniform(size=N) < 0.7, np.sign(rng.normal(size=N)) * (1 - 10 ** rng.uniform(-4, -1, N)), 0.0) * span
        v = rng.uniform(-1, 1, N) * rng.uniform() * limits.v_max
        try:
            motion = armctl.OnlineMotion(arm, armctl.Setpoint(q, v, 0.0 * v))
            motion.go_to(np.where(rng.uniform(size=N) < 0.5, q, rng.uniform(-span, span)))
        except (armctl.LimitError, armctl.PlanError):
            continue
        low, high = extremes(motion.pieces)
        assert (low >= -span - 1e-8).all()
        assert (high <= span + 1e-8).all()
        made += 1
    assert made > 40


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_start_is_refused_exactly_where_its_fastest_stop_leaves_the_limits(tmp_path, side):
    """At the jerk J the speed v stops within v sqrt(v / J) if no limit of the acceleration is reached."""
    base = serial_arm(tmp_path, Shape(0.3, 2.0, 100.0, joints=N))
    j_max = 50.0
    v = 0.7
    way = v * np.sqrt(v / j_max)
    many = np.full(N, 100.0)
    limits = armctl.Limits(-np.ones(N), np.ones(N), many, many, np.full(N, j_max), base.limits.tau_max)
    arm = base.with_limits(limits)
    at = np.array([0.0, side * (1.0 - way), 0.0])
    hair = side * 1e-6 * np.array([0.0, 1.0, 0.0])
    moving = side * v * np.array([0.0, 1.0, 0.0])
    assert armctl.OnlineMotion(arm, armctl.Setpoint(at - hair, moving, 0.0 * moving)).time_left > 0.0
    with pytest.raises(armctl.LimitError, match="cannot stop inside its position limits"):
        armctl.OnlineMotion(arm, armctl.Setpoint(at + hair, moving, 0.0 * moving))


@pytest.mark.parametrize("seed", [2490, 2672])
def test_the_pieces_of_a_motion_are_the_motion_that_is_made(tmp_path, seed):
    """With these seeds, some goal is only reached inside the limits if each joint moves by itself and stands at its end."""
    base = serial_arm(tmp_path, Shape(0.3, 2.0, 100.0, joints=N))
    rng = np.random.default_rng(seed)
    a_max = rng.uniform(2, 20, N)
    span = rng.uniform(0.05, 2, N)
    limits = armctl.Limits(-span, span, rng.uniform(0.5, 3, N), a_max, a_max * 10 ** rng.uniform(0, 2, N), base.limits.tau_max)
    motion = armctl.OnlineMotion(base.with_limits(limits), np.zeros(N))
    for _ in range(4):
        goal = span * rng.choice([-1, 1], N) if rng.random() < 0.7 else rng.uniform(-span, span)
        motion.go_to(goal)
        pieces = motion.pieces
        leave = rng.uniform(0, motion.time_left)
        for time in np.linspace(0.0, leave, 20)[1:]:
            made = motion.step(leave / 19).q
            piece = np.searchsorted(pieces.knots, time, side="right") - 1
            planned = (time - pieces.knots[piece]) ** np.arange(6) @ pieces.coefficients[piece]
            assert made == pytest.approx(planned, abs=1e-6)
        low, high = extremes(pieces)
        assert (low >= -span - 1e-8).all()
        assert (high <= span + 1e-8).all()
