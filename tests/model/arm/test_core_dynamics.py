"""The dynamics of the compiled core agree with Pinocchio, and with MuJoCo's discrete step, on every arm at random states."""

import numpy as np
import pytest
from pinocchio_step import PinocchioStep

import armctl
from armctl import _core
from armctl.model.arm.dynamics import Dynamics, core_model

pytestmark = pytest.mark.core

TOLERANCE = 1e-9  # relative, as between Pinocchio and MuJoCo
DT = 0.002


def states(arm: armctl.Arm, count: int = 5):
    rng = np.random.default_rng(11)
    for q in arm.limits.random(arm.limits.clamp(arm.home), count, rng):
        yield q, *(10.0 ** rng.uniform(-3, 0.5) * rng.normal(size=(2, arm.n)))


def assert_equal(values: np.ndarray, reference: np.ndarray):
    assert np.abs(values - reference).max() <= TOLERANCE * max(1.0, np.abs(reference).max())


@pytest.fixture
def reference(arm: armctl.Arm) -> Dynamics:
    return Dynamics(arm.model, arm.pinocchio_model)


def test_torques_in_continuous_time_are_those_of_pinocchio(arm: armctl.Arm, reference: Dynamics):
    model = core_model(arm.model, arm.pinocchio_model)
    tau = np.zeros(arm.n)
    for q, v, a in states(arm):
        _core.gravity(model, q[None], tau[None])
        assert_equal(tau, reference.gravity(q))
        _core.inverse_dynamics(model, q[None], v[None], a[None], tau[None])
        assert_equal(tau, reference.inverse_dynamics(q, v, a))


def test_torques_of_a_step_are_those_of_pinocchio_with_implicit_forces(arm: armctl.Arm):
    reference = PinocchioStep(arm, DT)
    model = core_model(arm.model, arm.pinocchio_model).for_period(DT, False)
    feedforward = _core.PDFeedforward(model, stiffness=np.zeros(arm.n), damping=np.zeros(arm.n))
    tau = np.zeros(arm.n)
    for q, v, a in states(arm):
        _core.inverse_dynamics(model, q[None], v[None], a[None], tau[None])
        assert_equal(tau, reference.inverse_dynamics(q, v, a))
        with_friction = np.zeros(arm.n)
        feedforward.torque(q, v, np.array([q, v, a, v, a]), np.zeros(0), with_friction)
        assert_equal(with_friction - tau, reference.friction(q, v, a))


def test_torques_of_a_continuous_motion_are_those_in_the_middle_of_the_period(arm: armctl.Arm, reference: Dynamics):
    model = core_model(arm.model, arm.pinocchio_model).for_period(DT, True)
    tau = np.zeros(arm.n)
    for q, v, a in states(arm):
        _core.inverse_dynamics(model, q[None], v[None], a[None], tau[None])
        assert_equal(tau, reference.inverse_dynamics(q + 0.5 * DT * v, v + 0.5 * DT * a, a))


def test_the_mass_matrix_is_that_of_pinocchio(arm: armctl.Arm, reference: Dynamics):
    model = core_model(arm.model, arm.pinocchio_model)
    M = np.zeros((arm.n, arm.n))
    for q, _, _ in states(arm):
        _core.mass_matrices(model, q[None], M.reshape(1, -1))
        assert_equal(M, reference.mass_matrix(q))


def test_the_tip_is_that_of_pinocchio(arm: armctl.Arm):
    model = core_model(arm.model, arm.pinocchio_model)
    J = np.zeros((6, arm.n))
    position = np.zeros(3)
    rotation = np.zeros((3, 3))
    quat = np.zeros(4)
    for q, _, _ in states(arm):
        _core.tip_jacobians(model, q[None], J.reshape(1, -1))
        _core.tips(model, q[None], position[None], rotation.reshape(1, -1))
        expected_position, expected_rotation = arm.pinocchio_model.tip(q)
        assert_equal(position, expected_position)
        assert_equal(rotation, expected_rotation)
        assert_equal(J, arm.pinocchio_model.jacobian(q))
        _core.quaternions(rotation[None], quat[None])
        assert_equal(armctl.Pose(position, quat=quat).rotation, expected_rotation)
