"""The compiled core of motions, judged by sampling, by Pinocchio, and by what its bindings refuse."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import armctl
from armctl import _core
from armctl.core.pose import rotation_vector
from armctl.plan.motion.trajectory.limit_check import limit_excess

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
    _core.inverse_dynamics(arm.core_model, q, v, a, torques)
    _core.gravity(arm.core_model, q, holding)
    _core.tip_twists(arm.core_model, q, v, twists)
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
        if follower.step(q, slope, 1e-3, twist, goal.position, rotation, moved):
            arrived += 1
            tip = arm.fk(moved)
            assert np.linalg.norm(tip.position - goal.position) < 1e-9
            assert np.linalg.norm(rotation_vector(tip.rotation.T @ goal.rotation)) < 1e-9
    assert arrived > 0


def fastest(motion: np.ndarray, **changes: np.ndarray) -> np.ndarray:
    """The fastest motion through 12 waypoints of 7 joints."""
    q = np.random.default_rng(0).normal(size=(12, 7))
    v_bound = np.ones_like(q)
    a_bound = np.full_like(q, 5.0)
    for bound in (v_bound, a_bound):
        bound[[0, -1]] = 0.0
    ones = np.ones(7)
    arguments = {"q": q, "v_max": ones, "a_max": 5 * ones, "j_max": 50 * ones, "v_bound": v_bound, "a_bound": a_bound}
    _core.make_fastest(motion, False, **(arguments | changes))
    return motion


def slow_motion() -> np.ndarray:
    motion = np.zeros((12, 15))
    motion[:, -1] = 20.0
    return motion.ravel()[:-1]


def test_threads_get_the_same_bits():
    with ThreadPoolExecutor(4) as pool:
        assert len(set(pool.map(lambda _: fastest(slow_motion()).tobytes(), range(16)))) == 1


def test_arrays_of_wrong_shapes_are_refused_by_name():
    with pytest.raises(armctl.InputError, match=r"motion: need an array of shape \(179,\)"):
        fastest(np.ones(12))
    with pytest.raises(armctl.InputError, match="a_bound: need an array of shape"):
        fastest(slow_motion(), a_bound=np.ones((12, 6)))
    with pytest.raises(armctl.InputError, match="q: this argument is missing"):
        _core.make_fastest(slow_motion(), False, v_max=np.ones(7))


def test_a_point_outside_the_intervals_is_refused():
    row = np.ones((1, 3))
    one = np.ones(1)
    force = {"force_end": np.array([1]), "force_weights": row, "damping": one, "low": -one, "high": one}
    jerk = {"jerk_end": np.array([1]), "jerk_weights": row, "j_max": one}
    for interval in (-1, 1):
        with pytest.raises(armctl.InputError, match=f"interval: {interval} is not one of 1"):
            _core.fastest_path_speed(
                np.ones(3), 1.0, False, interval=np.array([interval]), weights=row, b_max=one, **force, **jerk
            )
    force["force_end"] = np.array([2])
    with pytest.raises(armctl.InputError, match="force_end: 2 is not one of 2"):
        _core.fastest_path_speed(np.ones(3), 1.0, False, interval=np.array([0]), weights=row, b_max=one, **force, **jerk)
