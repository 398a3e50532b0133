"""The compiled core of motions, judged by sampling, by Pinocchio, and by what its bindings refuse."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import armctl
from armctl import _core
from armctl.core.pose import rotation_vector
from armctl.motion.trajectory.limit_check import limit_excess

pytestmark = pytest.mark.core


@given(seed=st.integers(0, 10_000), degree=st.integers(0, 8), order=st.integers(0, 3))
def test_the_excess_over_a_limit_is_that_of_dense_samples(seed, degree, order):
    rng = np.random.default_rng(seed)
    order = min(order, degree)
    coefficients = rng.normal(size=(3, degree + 1, 2))
    steps = rng.uniform(0.1, 1.0, 3)
    high = rng.uniform(-1.0, 3.0, 2)
    excess = limit_excess(coefficients, steps, order, -high - 2.0, high)
    for k, step in enumerate(steps):
        derivative = np.polynomial.polynomial.polyder(coefficients[k], order)
        values = np.polynomial.polynomial.polyval(np.linspace(0.0, step, 5001), derivative)
        outside = np.maximum(values - high[:, None], -high[:, None] - 2.0 - values).max(axis=1)
        assert np.allclose(np.maximum(excess[k], 0.0), np.maximum(outside, 0.0), rtol=1e-5, atol=1e-5 * np.abs(values).max())


def states(arm: armctl.Arm, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    return (
        arm.limits.random(arm.limits.clamp(arm.home), count, rng),
        rng.normal(size=(count, arm.n)),
        rng.normal(size=(count, arm.n)),
    )


def test_torques_and_twists_along_a_motion_are_those_of_pinocchio(arm: armctl.Arm):
    q, v, a = states(arm, 4)
    torques = np.empty_like(q)
    holding = np.empty_like(q)
    twists = np.empty((len(q), 6))
    _core.inverse_dynamics_along(arm.core_model, q, v, a, torques)
    _core.gravity_along(arm.core_model, q, holding)
    _core.tip_twists_along(arm.core_model, q, v, twists)
    for k in range(len(q)):
        assert torques[k] == pytest.approx(arm.inverse_dynamics(q[k], v[k], a[k]), rel=1e-9, abs=1e-9)
        assert holding[k] == pytest.approx(arm.inverse_dynamics(q[k], 0 * v[k], 0 * a[k]), rel=1e-9, abs=1e-9)
        assert twists[k] == pytest.approx(arm.jacobian(q[k]) @ v[k], rel=1e-9, abs=1e-9)


def test_a_follower_makes_the_twist_and_ends_each_step_at_the_pose(arm: armctl.Arm):
    rng = np.random.default_rng(2)
    follower = _core.TipFollower(
        model=arm.core_model, q_min=arm.limits.q_min, q_max=arm.limits.q_max, centering=0.0, oriented=True
    )
    arrived = 0
    for q in states(arm, 10)[0]:
        way = rng.normal(size=arm.n)
        twist = arm.jacobian(q) @ way
        slope = np.empty(arm.n)
        follower.slope(q, twist, slope)
        if np.linalg.matrix_rank(arm.jacobian(q), tol=1e-2) == min(6, arm.n):
            assert arm.jacobian(q) @ slope == pytest.approx(twist, rel=1e-5, abs=1e-5)
        goal = arm.fk(q + 1e-3 * way)
        moved = np.empty(arm.n)
        rotation = np.ascontiguousarray(goal.rotation)
        if follower.step(q, slope, 1e-3, twist, twist, goal.position, rotation, moved):
            arrived += 1
            tip = arm.fk(moved)
            assert np.linalg.norm(tip.position - goal.position) < 1e-9
            assert np.linalg.norm(rotation_vector(tip.rotation.T @ goal.rotation)) < 1e-9
            assert follower.distance(moved, goal.position, rotation) < 1e-9
    assert arrived > 0


def waypoints() -> tuple[_core.WaypointTiming, np.ndarray]:
    q = np.random.default_rng(0).normal(size=(12, 7))
    v_bound = np.ones_like(q)
    a_bound = np.full_like(q, 5.0)
    for bound in (v_bound, a_bound):
        bound[[0, -1]] = 0.0
    ones = np.ones(7)
    return _core.WaypointTiming(q=q, v_max=ones, a_max=5 * ones, j_max=50 * ones, v_bound=v_bound, a_bound=a_bound), q


def test_threads_that_share_a_problem_get_the_same_bits():
    timing, q = waypoints()

    def solved(_: int) -> bytes:
        v = np.empty_like(q)
        a = np.empty_like(q)
        durations = np.full(len(q) - 1, 20.0)
        timing.solve(durations, v, a)
        return v.tobytes() + a.tobytes() + durations.tobytes()

    with ThreadPoolExecutor(4) as pool:
        assert len(set(pool.map(solved, range(16)))) == 1


def test_arrays_of_wrong_shapes_are_refused_by_name():
    timing, q = waypoints()
    with pytest.raises(armctl.InputError, match=r"durations: need an array of shape \(11,\)"):
        timing.solve(np.ones(12), np.empty_like(q), np.empty_like(q))
    with pytest.raises(armctl.InputError, match="a: need an array of shape"):
        timing.solve(np.ones(11), np.empty_like(q), np.empty((12, 6)))
    one = np.ones((1, 1))
    with pytest.raises(armctl.InputError, match="coefficients: need polynomials of a degree from 3 to 15"):
        limit_excess(np.ones((1, 3, 1)), np.ones(1), 3, -one, one)
    with pytest.raises(armctl.InputError, match="coefficients: need an array with at least 3 dimensions"):
        _core.polynomial_extremes(one, 0, one, one)


def test_a_piece_outside_the_intervals_is_refused():
    one = np.ones((2, 1))
    rows = {"q1": one, "q2": one, "j_max": one, "alpha": one, "beta": one, "delta": one, "low": -one, "high": one}
    pieces = {"q3_after": one[:1], "q3_before": one[:1], "begin": np.zeros(1), "end": np.ones(1), "b_max": np.ones(2)}
    for interval in (-1, 1):
        with pytest.raises(armctl.InputError, match="interval: every number"):
            _core.PathTiming(interval_length=1.0, interval=np.array([interval]), **rows, **pieces)
