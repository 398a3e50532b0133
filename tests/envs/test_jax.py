"""armctl.jax computes what the controllers of armctl compute, and can be mapped and differentiated."""

import importlib
import importlib.util
import sys

import numpy as np
import pinocchio as pin
import pytest
from arms import some_of
from synthetic import BENT, TIED, serial_arm

import armctl

pytest.importorskip("jax", reason="JAX is not installed; install armctl with its extra [jax]")

import jax
import jax.numpy as jnp

from armctl import jax as aj
from armctl.envs.jax.control import rotation_vector

TOLERANCE = 1e-12
ARMS = ("rubbing", "a telescope, and a hinge tied to it")


@pytest.fixture(autouse=True)
def float64():
    before = jax.config.read("jax_enable_x64")
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", before)


@pytest.fixture(params=some_of(ARMS, ["rubbing"]))
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
    gains = (
        aj.PDGains.from_controller(pd, arm.dt),
        aj.ComputedTorqueGains.from_controller(computed, arm.dt),
        aj.OperationalSpaceGains.from_controller(task),
    )
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


@pytest.mark.nightly
def test_a_batch_of_closed_loops_is_simulated_and_differentiated(planar):
    trajectory = armctl.move_j(planar, planar.home, planar.home + 0.05)
    reference = aj.tick_reference(trajectory, planar.dt)
    gains = aj.PDGains.from_controller(armctl.PD(planar), planar.dt)
    model = aj.arm_model(planar)
    loads = (0.0, -5.0)  # N, in the plane of the arm

    def run(load, stiffness):
        own = gains._replace(stiffness=stiffness * gains.stiffness)

        def tick(state, row):
            q, v = state
            tau = aj.pd(own, q, v, row)
            applied = aj.tip_jacobian(model, q)[2] * load
            after = v + planar.dt * aj.forward_dynamics(model, q, v, tau + applied)
            return (q + planar.dt * after, after), (q, tau)

        return jax.lax.scan(tick, (reference.q[0], reference.v[0]), reference)[1]

    def squared_error(stiffness):
        q, tau = jax.vmap(run, in_axes=(0, None))(jnp.array(loads), stiffness)
        return jnp.sum((1e3 * (q - reference.q)) ** 2), (q, tau)

    slope_of = jax.jit(jax.value_and_grad(squared_error, has_aux=True))
    (_, motions), slope = slope_of(1.0)
    for load, q, tau in zip(loads, *motions, strict=True):
        push = armctl.Push(0.0, 100.0, force=[0.0, 0.0, load])
        log = armctl.simulate(planar, armctl.PD(planar), trajectory, armctl.Plant(pushes=push), dwell=0.0)
        assert relative_error(q, log.q[: len(q)]) < TOLERANCE
        assert relative_error(tau, log.tau[: len(q)]) < 1e2 * TOLERANCE  # a torque amplifies rounding errors of q by 1e4
    step = 1e-5
    difference = (slope_of(1.0 + step)[0][0] - slope_of(1.0 - step)[0][0]) / (2.0 * step)
    assert float(slope) == pytest.approx(float(difference), rel=1e-6)
    assert slope < 0.0  # a stiffer loop sags less


@pytest.mark.full
def test_rotation_vectors_are_those_of_pinocchio_also_of_half_a_turn():
    vectors = np.array([[0.0, 0.0, 0.0], [1e-9, -2e-9, 0.0], [0.3, -1.0, 0.2], [3.1, 0.2, -0.3], [0.0, -3.14159, 1e-3]])
    rotations = np.array([pin.exp3(vector) for vector in vectors])
    found = jax.jit(jax.vmap(rotation_vector))(rotations)
    assert np.abs(found - np.array([pin.log3(rotation) for rotation in rotations])).max() < TOLERANCE
    assert np.isfinite(jax.jit(jax.vmap(jax.jacrev(rotation_vector)))(rotations)).all()


def test_what_has_no_counterpart_is_refused(planar):
    for call, message in (
        (lambda: aj.PDGains.from_controller(armctl.PDGravity(planar), 1e-3), "expected armctl.PD"),
        (lambda: aj.ComputedTorqueGains.from_controller(armctl.PD(planar), 1e-3), "expected armctl.ComputedTorque"),
        (
            lambda: aj.ComputedTorqueGains.from_controller(armctl.ComputedTorque(planar, form="textbook"), 1e-3),
            "form='discrete'",
        ),
        (lambda: aj.OperationalSpaceGains.from_controller(armctl.PD(planar)), "OperationalSpace"),
        (lambda: aj.arm_model(planar, dt=-1.0), "dt"),
    ):
        with pytest.raises(armctl.InputError, match=message):
            call()


WRONG = {
    "the arm as model": (lambda arm, model, q: aj.tip_jacobian(arm, q), "model: expected ArmModel"),
    "a list": (
        lambda arm, model, q: aj.mass_matrix(model, [0.0, 0.0]),
        r"q: \[0\.0, 0\.0\] is not an array of numbers; jax\.numpy\.asarray makes one",
    ),
    "a text": (lambda arm, model, q: aj.gravity(model, "q"), "q: 'q' is not an array of numbers"),
    "texts": (lambda arm, model, q: aj.gravity(model, np.array(["a", "b"])), "q: .* is not an array of numbers"),
    "too long": (lambda arm, model, q: aj.tip_pose(model, np.zeros(5)), r"q: expected an array of shape \(3,\), .*\(5,\)"),
    "a matrix": (lambda arm, model, q: aj.inverse_dynamics(model, q, q, np.zeros((2, 2))), r"a: expected an array of shape"),
    "no gains": (lambda arm, model, q: aj.pd(None, q, q, aj.Reference(q, q, q, q, q)), "gains: expected PDGains"),
    "no gain": (
        lambda arm, model, q: aj.pd(aj.PDGains(q, "x"), q, q, aj.Reference(q, q, q, q, q)),
        "gains.damping: 'x' is not an array",
    ),
    "no reference": (lambda arm, model, q: aj.pd(aj.PDGains(q, q), q, q, q), "reference: expected Reference"),
    "a reference of no numbers": (
        lambda arm, model, q: aj.pd(aj.PDGains(1.0, 1.0), q, q, aj.Reference(q, None, q, q, q)),
        "reference.v: None is not an array",
    ),
    "no trajectory": (lambda arm, model, q: aj.tick_reference(q, 0.01), "trajectory: .* is not a trajectory"),
}


@pytest.mark.parametrize(("call", "message"), WRONG.values(), ids=WRONG)
def test_a_wrong_argument_is_one_sentence(planar, call, message: str):
    with pytest.raises(armctl.InputError, match=message):
        call(planar, aj.arm_model(planar), np.zeros(planar.n))


def test_without_jax_a_sentence_names_what_to_install(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.delitem(sys.modules, "armctl.envs.jax")
    with pytest.raises(armctl.NotInstalledError, match=r"needs JAX; install armctl with its extra \[jax\]"):
        importlib.import_module("armctl.envs.jax")
