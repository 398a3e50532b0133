"""The chain and the error model of the compiled core agree with Pinocchio and with differences, and refuse wrong arguments."""

import numpy as np
import pytest
from arms import ARMS, arm_of, some_of

from armctl import Arm, InputError, _core
from armctl._core import ROTATION_WEIGHT, AxesRelation, Constraint
from armctl.plan.ik.problem import ik_chain

pytestmark = pytest.mark.core


def configurations(arm: Arm, count: int) -> np.ndarray:
    return arm.limits.random(arm.home, count, np.random.default_rng(12))


def numbers_of(arm: Arm, q: np.ndarray) -> np.ndarray:
    position, rotation = arm.pinocchio_model.tip(q)
    return np.concatenate([rotation.ravel(), position])


@pytest.mark.parametrize("name", some_of(ARMS))
def test_the_chain_is_pinocchio(name: str):
    arm = arm_of(name)
    chain = ik_chain(arm)
    n = arm.n
    J = np.empty((6, n))
    tolerance = 1e-12 * max(1.0, chain.reach)
    model = _core.IkErrorModel(chain.core)
    for q in configurations(arm, 20):
        size = model.linearize(numbers_of(arm, q), Constraint.POSE, 0.0, q / chain.unit, np.empty((n, n)), np.empty(n), J)
        assert size < 1e-12
        in_si = J / chain.unit * np.array([chain.reach] * 3 + [1 / ROTATION_WEIGHT] * 3)[:, None]
        assert np.abs(in_si - arm.jacobian(q)).max() < tolerance


@pytest.mark.parametrize("constraint", [Constraint.POSE, Constraint.POSITION, Constraint.FREE_Y])
def test_the_error_model_is_the_derivative_of_half_the_squared_error(constraint: Constraint):
    arm = arm_of("ur5e")
    model = _core.IkErrorModel(ik_chain(arm).core)
    n = arm.n
    H = np.empty((n, n))
    gradient = np.empty(n)
    J = np.empty((6, n))

    def size(q: np.ndarray, target: np.ndarray) -> float:
        return model.linearize(target, constraint, 0.0, q, H, gradient, J)

    for q in configurations(arm, 5):
        target = numbers_of(arm, arm.limits.clamp(q + 0.05))
        step = 1e-6
        slope = [(size(q + dq, target) ** 2 - size(q - dq, target) ** 2) / (4 * step) for dq in step * np.eye(n)]
        size(q, target)
        assert np.abs(gradient + slope).max() < 1e-8


def test_the_curvature_of_a_point_is_the_derivative_of_its_gradient():
    arm = arm_of("ur5e")
    model = _core.IkErrorModel(ik_chain(arm).core)
    n = arm.n
    H = np.empty((n, n))
    J = np.empty((6, n))

    def gradient(q: np.ndarray, target: np.ndarray) -> np.ndarray:
        out = np.empty(n)
        model.linearize(target, Constraint.POSITION, 0.0, q, H, out, J)
        return out

    for q in configurations(arm, 5):
        target = numbers_of(arm, arm.home)
        step = 1e-6
        columns = [(gradient(q - dq, target) - gradient(q + dq, target)) / (2 * step) for dq in step * np.eye(n)]
        gradient(q, target)
        assert np.abs(H - np.array(columns)).max() < 1e-8


def test_arrays_of_wrong_lengths_are_refused_by_name():
    arm = arm_of("ur5e")
    core = ik_chain(arm).core
    target = numbers_of(arm, arm.home)
    q = arm.home.copy()
    with pytest.raises(InputError, match=r"^q0: need an array of shape \(6,\), got \(5,\)$"):
        core.search_one(target.reshape(4, 3), Constraint.POSE, 1e-5, 1e-4, q[:5].copy(), 10, 0, q)
    with pytest.raises(InputError, match=r"^q: need a contiguous, writable array of type float64$"):
        core.search_one(target.reshape(4, 3), Constraint.POSE, 1e-5, 1e-4, q, 10, 0, arm.home)
    with pytest.raises(InputError, match=r"^squared_errors: need an array of shape \(1,\), got \(2,\)$"):
        core.refine(target[None], Constraint.POSE, 1.0, q[None], 0.0, q[None].copy(), np.empty(2))
    assert not core.contains(q[:5].copy())
    assert not core.contains(np.full(6, np.nan))
    assert not core.contains(q.astype(np.float32))
    assert core.contains(q)


def test_joints_that_do_not_exist_are_refused():
    arrays = {
        "rotations": np.tile(np.eye(3), (3, 1, 1)),
        "translations": np.full((3, 3), 0.1),
        "slides": np.zeros(2, np.int64),
        "ratios": np.ones(2),
        "low": -np.ones(2),
        "high": np.ones(2),
        "period": np.zeros(2),
        "reach": 1.0,
    }
    with pytest.raises(InputError, match=r"^unknowns: 2 is not one of 2$"):
        _core.Chain(unknowns=np.array([0, 2]), **arrays)
    with pytest.raises(InputError, match=r"^unknowns: this argument is missing$"):
        _core.Chain(**arrays)
    special = {
        "relation": AxesRelation.MEET,
        "first": 0,
        "others": np.array([0, 1, 1]),
        "pair_relation": AxesRelation.MEET,
        "pair_first": 0,
        "distances_to_points": np.zeros(2),
    }
    with pytest.raises(InputError, match=r"^first: 2 is not one of 2$"):
        _core.Chain(unknowns=np.array([0, 1]), **arrays, **special)
    chain = _core.Chain(unknowns=np.array([0, 1]), **arrays)
    with pytest.raises(InputError, match=r"^chain: expected special axes of six hinges, or of seven with one that is held$"):
        _core.ClosedForm(chain, None)
