"""armctl.jax computes what the controllers and the free-space plant of armctl compute, and can be mapped and differentiated."""

import importlib
import importlib.util
import sys

import numpy as np
import pinocchio as pin
import pytest
from synthetic import BENT, TIED, serial_arm

import armctl

pytest.importorskip("jax", reason="JAX is not installed; install armctl with its extra [jax]")

import jax
import jax.numpy as jnp

import armctl.jax as aj
from armctl.jax.control import rotation_vector

TOLERANCE = 1e-12
ARMS = ("rubbing", "a telescope, and a hinge tied to it")


@pytest.fixture(autouse=True)
def float64():
    before = jax.config.read("jax_enable_x64")
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", before)


@pytest.fixture(params=ARMS)
def arm(request, load, tmp_path) -> armctl.Arm:
    if request.param in TIED:
        bodies, rest, how, _ = TIED[request.param]
        return load(bodies, rest, **how)
    return serial_arm(tmp_path, BENT[request.param], "implicit" if request.param == "rubbing" else "implicitfast")


def states(arm):
    """Some measured states with references near them: (q, v, reference)."""
    rng = np.random.default_rng(0)
    for q in arm.limits.random(arm.limits.clamp(arm.home), 3, rng):
        v, away, v_ref, a_ref, v_tick = rng.uniform(-1.0, 1.0, (5, arm.n))
        yield q, v, aj.Reference(q + 0.1 * away, v_ref, a_ref, v_tick, a_ref + 1.0)


def relative_error(value, expected):
    return np.abs(np.asarray(value) - expected).max() / max(1.0, np.abs(expected).max())


@pytest.mark.parametrize("continuous", [False, True])
def test_laws_and_dynamics_are_those_of_the_controllers_and_the_arm(arm, continuous):
    if continuous and arm.n > 3:
        pytest.skip("the arm with three joints shows it")
    pd = armctl.PD(arm)
    computed = armctl.ComputedTorque(arm)
    task = armctl.OperationalSpace(arm)
    gains = (aj.PDGains.of(pd, arm.dt), aj.ComputedTorqueGains.of(computed, arm.dt), aj.OperationalSpaceGains.of(task))
    model = aj.arm_model(arm, continuous=continuous)

    @jax.jit
    def functions(q, v, reference):
        torques = [
            aj.pd(gains[0], q, v, reference),
            aj.computed_torque(model, gains[1], q, v, reference),
            aj.operational_space(model, gains[2], q, v, reference),
        ]
        return torques, [aj.mass_matrix(model, q), aj.gravity(model, q), aj.tip_pose(model, q)[0], aj.tip_jacobian(model, q)]

    for q, v, reference in states(arm):
        state = armctl.State(q, v, 0.0, arm.dt, continuous)
        setpoint = armctl.Setpoint(reference.q, reference.v, reference.a, v_tick=reference.v_tick, a_tick=reference.a_tick)
        torques, quantities = functions(q, v, reference)
        for torque, controller in zip(torques, (pd, computed, task), strict=True):
            # The tip of an arm with three joints cannot move in all directions: it inverts a matrix of condition 1e6.
            bound = 1e3 * TOLERANCE if controller is task and arm.n < 6 else TOLERANCE
            assert relative_error(torque, controller.torque(state, setpoint)) < bound, controller.name
        expected = (arm.mass_matrix(q), arm.gravity(q), arm.fk(q).position, arm.jacobian(q))
        for value, wanted in zip(quantities, expected, strict=True):
            assert relative_error(value, wanted) < TOLERANCE


@pytest.fixture
def planar(tmp_path) -> armctl.Arm:
    return serial_arm(tmp_path, BENT["planar"])


def test_a_batch_of_closed_loops_is_simulated_and_differentiated(planar):
    trajectory = armctl.move_j(planar, planar.home, planar.home + 0.05)
    reference = aj.tick_reference(trajectory, planar.dt)
    gains = aj.PDGains.of(armctl.PD(planar), planar.dt)
    differences = [armctl.Plant(viscous_friction=0.2, free_space=True), armctl.Plant(payload=0.5, free_space=True)]
    plants = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(aj.free_plant(planar, each) for each in differences))

    def run(plant, stiffness):
        own = gains._replace(stiffness=stiffness * gains.stiffness)
        start = (reference.q[0], reference.v[0])
        return aj.follow(plant, lambda q, v, row: aj.pd(own, q, v, row), *start, reference)

    def squared_error(stiffness):
        motions = jax.vmap(run, in_axes=(0, None))(plants, stiffness)
        return jnp.sum((1e3 * (motions.q - reference.q)) ** 2), motions

    slope_of = jax.jit(jax.value_and_grad(squared_error, has_aux=True))
    (_, motions), slope = slope_of(1.0)
    for plant, q, tau in zip(differences, motions.q, motions.tau, strict=True):
        log = armctl.simulate(planar, armctl.PD(planar), trajectory, plant, dwell=0.0)
        assert relative_error(q, log.q[: len(q)]) < TOLERANCE
        assert relative_error(tau, log.tau[: len(q)]) < 1e2 * TOLERANCE  # a torque amplifies rounding errors of q by 1e4
    step = 1e-5
    difference = (slope_of(1.0 + step)[0][0] - slope_of(1.0 - step)[0][0]) / (2.0 * step)
    assert float(slope) == pytest.approx(float(difference), rel=1e-6)
    assert slope < 0.0  # a stiffer loop sags less


def test_the_motors_of_the_free_plant_keep_within_their_limits(planar):
    plant = aj.free_plant(planar)
    step = jax.jit(aj.free_step)
    still = jnp.zeros(planar.n)
    q, v = step(plant, jnp.asarray(planar.home), still, plant.torque_max)
    assert np.array_equal(step(plant, jnp.asarray(planar.home), still, 2.0 * plant.torque_max), (q, v))
    assert not np.array_equal(step(plant, jnp.asarray(planar.home), still, 0.9 * plant.torque_max)[1], v)


def test_rotation_vectors_are_those_of_pinocchio_also_of_half_a_turn():
    vectors = np.array([[0.0, 0.0, 0.0], [1e-9, -2e-9, 0.0], [0.3, -1.0, 0.2], [3.1, 0.2, -0.3], [0.0, -3.14159, 1e-3]])
    rotations = np.array([pin.exp3(vector) for vector in vectors])
    found = jax.jit(jax.vmap(rotation_vector))(rotations)
    assert np.abs(found - np.array([pin.log3(rotation) for rotation in rotations])).max() < TOLERANCE
    assert np.isfinite(jax.jit(jax.vmap(jax.jacrev(rotation_vector)))(rotations)).all()


def test_what_has_no_counterpart_is_refused(planar, tmp_path):
    rubbing = serial_arm(tmp_path, BENT["rubbing"])
    for call, message in (
        (lambda: aj.PDGains.of(armctl.PDGravity(planar), 1e-3), "expected armctl.PD"),
        (lambda: aj.ComputedTorqueGains.of(armctl.PD(planar), 1e-3), "expected armctl.ComputedTorque"),
        (lambda: aj.ComputedTorqueGains.of(armctl.ComputedTorque(planar, integral=True), 1e-3), "without integral action"),
        (lambda: aj.OperationalSpaceGains.of(armctl.PD(planar)), "OperationalSpace"),
        (lambda: aj.free_plant(rubbing), "dry friction"),
        (lambda: aj.free_plant(planar, armctl.Plant(delay=1)), "put them into the law"),
        (lambda: aj.arm_model(planar, dt=-1.0), "dt"),
    ):
        with pytest.raises(armctl.InputError, match=message):
            call()


def test_without_jax_a_sentence_names_what_to_install(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.delitem(sys.modules, "armctl.jax")
    with pytest.raises(armctl.NotInstalledError, match=r"needs JAX; install armctl with its extra \[jax\]"):
        importlib.import_module("armctl.jax")
