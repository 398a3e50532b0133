"""Impedance whose stiffness changes, admittance, and torques that change at a limited rate."""

import numpy as np
import pytest
from motions import Still, Sway
from synthetic import BENT, serial_arm

import armctl

FORCE = np.array([2.0, -1.0, 1.5])  # N
STIFFNESS = np.array([400.0, 500.0, 600.0, 20.0, 20.0, 20.0])


@pytest.fixture(scope="module")
def six_joints(tmp_path_factory):
    return serial_arm(tmp_path_factory.mktemp("arm"), BENT["six joints"])


def pushed(arm, controller, seconds=1.0, **plant):
    push = armctl.Push(0.0, 60.0, force=FORCE)
    return armctl.simulate(arm, controller, Still(arm.home, seconds), armctl.Plant(timestep=0.001, pushes=push, **plant))


def displacement(log):
    return log.tip[-1] - log.tip_ref[-1]


def test_stiffness_follows_a_function_of_the_time(six_joints):
    # The arm's own damping, 1 N m s/rad, adds to the controller's: the slowest mode decays with 0.9 rad/s, then with half.
    softer = armctl.Impedance(six_joints, stiffness=lambda t: STIFFNESS if t < 4.0 else 0.5 * STIFFNESS)
    log = pushed(six_joints, softer, 12.0)
    before = log.tip[log.t < 4.0][-1] - log.tip_ref[-1]
    assert before == pytest.approx(FORCE / STIFFNESS[:3], rel=0.06)
    assert displacement(log) == pytest.approx(2 * FORCE / STIFFNESS[:3], rel=0.06)


def test_stiffness_can_be_replaced_between_two_commands(six_joints):
    controller = armctl.Impedance(six_joints, stiffness=STIFFNESS)
    controller.stiffness = 2 * STIFFNESS
    log = pushed(six_joints, controller, 4.0)  # the slowest mode, slowed by the arm's own damping, decays with 1.9 rad/s
    assert displacement(log) == pytest.approx(FORCE / (2 * STIFFNESS[:3]), rel=0.02)
    with pytest.raises(armctl.InputError, match="stiffness: every value must be at least 0"):
        controller.stiffness = -1.0


def test_a_wrong_function_of_the_time_is_reported(six_joints):
    with pytest.raises(armctl.SimulationError, match="stiffness: expected 6 numbers, got 2"):
        pushed(six_joints, armctl.Impedance(six_joints, stiffness=lambda t: [1.0, 2.0]), 0.01)


def test_a_clipped_error_bounds_the_force_of_the_spring(six_joints):
    q = six_joints.home
    zero = np.zeros(six_joints.n)
    target = armctl.Setpoint(q + 0.2, zero, zero)
    state = armctl.State(q, zero, 0.0, 0.001)
    bound = np.array([0.002, 0.002, 0.002, 0.01, 0.01, 0.01])
    gains = {"stiffness": STIFFNESS, "posture_stiffness": 0.0}
    clipped = armctl.Impedance(six_joints, error_max=bound, **gains).torque(state, target)
    free = armctl.Impedance(six_joints, **gains).torque(state, target)
    wrench = np.linalg.solve(six_joints.jacobian(q).T, clipped - six_joints.gravity(q))
    assert np.abs(wrench) == pytest.approx(STIFFNESS * bound)
    assert np.linalg.norm(free) > 2 * np.linalg.norm(clipped - six_joints.gravity(q))


def test_an_admittance_yields_as_its_spring_says(six_joints):
    controller = armctl.Admittance(six_joints, stiffness=STIFFNESS)
    log = pushed(six_joints, controller)
    assert displacement(log) == pytest.approx(FORCE / STIFFNESS[:3], abs=1e-4)
    assert controller.offset[:3] == pytest.approx(FORCE / STIFFNESS[:3], rel=0.02)


def test_an_admittance_yields_in_spite_of_dry_friction_and_an_impedance_does_not(six_joints):
    expected = FORCE / STIFFNESS[:3]
    errors = [
        np.linalg.norm(displacement(pushed(six_joints, controller, 0.8, coulomb_friction=2.0)) - expected)
        for controller in (
            armctl.Admittance(six_joints, stiffness=STIFFNESS),
            armctl.Impedance(six_joints, stiffness=STIFFNESS),
        )
    ]
    assert errors[0] < 0.3 * np.linalg.norm(expected)
    assert errors[1] > 0.6 * np.linalg.norm(expected)


def test_an_admittance_without_spring_stays_where_it_was_moved(six_joints):
    push = armctl.Push(0.0, 0.3, force=FORCE)
    log = armctl.simulate(
        six_joints,
        armctl.Admittance(six_joints, stiffness=0.0),
        Still(six_joints.home, 1.2),
        armctl.Plant(timestep=0.001, pushes=push),
    )
    late = log.tip[log.t > 1.0]
    assert np.linalg.norm(displacement(log)) > 5e-3
    assert np.ptp(late, axis=0).max() < 1e-4


def test_an_admittance_follows_its_reference_without_forces(six_joints):
    log = armctl.simulate(six_joints, armctl.Admittance(six_joints), Sway(six_joints), armctl.Plant(timestep=0.001))
    assert np.abs(log.q - log.q_ref).max() < 1e-8


@pytest.mark.parametrize(
    ("gains", "what"), [({"mass": 0.0}, "mass"), ({"damping": -1.0}, "damping"), ({"stiffness": [1.0]}, "st")]
)
def test_wrong_admittances_are_rejected(six_joints, gains, what):
    with pytest.raises(armctl.InputError, match=what):
        armctl.Admittance(six_joints, **gains)


def test_torques_change_no_faster_than_allowed(six_joints):
    rate = 2000.0  # N m/s
    jump = Still(six_joints.home + 0.05, 0.2)
    plant = armctl.Plant(timestep=0.001)
    steps = {}
    for name, controller in {
        "free": armctl.PDGravity(six_joints),
        "limited": armctl.TorqueRateLimit(six_joints, armctl.PDGravity(six_joints), rate),
    }.items():
        simulation = armctl.Simulation(six_joints, controller, plant)
        simulation.run(Still(six_joints.home, 0.01))
        log = simulation.run(jump)
        steps[name] = np.abs(np.diff(np.vstack([six_joints.gravity(six_joints.home), log.tau_cmd]), axis=0)).max()
    assert steps["free"] > 5.0
    assert steps["limited"] <= rate * 0.001 + 1e-9


def test_a_rate_limit_needs_a_controller_and_passes_on_what_it_needs(six_joints):
    limited = armctl.TorqueRateLimit(six_joints, armctl.HybridForce(six_joints, {"z": 1.0}), 1000.0)
    assert limited.needs_wrench
    assert limited.name == "hybrid-force"
    with pytest.raises(armctl.InputError, match="has no method torque"):
        armctl.TorqueRateLimit(six_joints, "pd", 1000.0)
