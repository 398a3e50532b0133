"""Every controller on every installed arm at 1, 2 and 4 ms, and properties of single controllers."""

from dataclasses import replace

import numpy as np
import pytest
from motions import Still, Sway
from synthetic import limb, motors

import armctl
from armctl.control import CONTROLLERS, controller_by_name
from armctl.control.gains import bandwidth_gains, sample_configurations
from armctl.core.trajectory import Setpoint, TickReference

TICKS = (0.001, 0.002, 0.004)
EXACT = (
    "pd-feedforward",
    "computed-torque",
    "computed-torque-observer",
    "computed-torque-learning",
    "qp",
    "operational-space",
    "impedance",
)
WITH_MEMORY = ("computed-torque", "computed-torque-observer", "computed-torque-learning")

every_controller = pytest.mark.parametrize("name", CONTROLLERS)
every_tick = pytest.mark.parametrize("dt", TICKS)


@every_tick
@every_controller
def test_follows_a_motion_without_chatter(arm, name, dt):
    log = armctl.simulate(arm, name, Sway(arm), armctl.Plant(timestep=dt), dwell=0.2)
    error = np.abs(log.q - log.q_ref).max()
    assert not log.failure
    assert np.isfinite(log.tau_cmd).all()
    if name not in ("pd", "pd-gravity"):  # whose errors are torques over gains, which delay margins bound
        assert error < (1e-8 if name in EXACT else 2e-2), error
    # 0.1 s is enough for all but PD on arms with light wrists at 4 ms: the delay margin leaves a bandwidth of some rad/s.
    jitter = np.abs(np.diff(log.v[-10:], axis=0)).max() / dt
    assert jitter < 25.0, f"{jitter} rad/s^2 at the end"


@every_tick
@every_controller
def test_holds_still_at_rest(arm, name, dt):
    log = armctl.simulate(arm, name, Still(arm.home), armctl.Plant(timestep=dt), dwell=0.0)
    moved = np.abs(log.q - arm.home).max()
    assert moved < (0.3 if name == "pd" else 1e-9), moved  # PD has a steady-state error under gravity


@every_controller
def test_comes_back_after_a_kick(arm, name):
    simulation = armctl.Simulation(arm, name, armctl.Plant(timestep=0.004))
    kick = np.minimum(0.2, 0.05 * arm.limits.v_max)
    simulation.reset(arm.home, kick)
    log = simulation.run(Still(arm.home, 4.0))
    assert not log.failure
    assert np.abs(log.v[-1]).max() < 0.5 * kick.max()


@every_tick
def test_the_observer_is_stable_with_a_delay_of_two_ticks(bent, dt):
    plant = armctl.Plant(timestep=dt, delay=2, mass_scale=1.2, encoder_noise=1e-5)
    log = armctl.simulate(bent, "computed-torque-observer", Sway(bent), plant, dwell=1.0)
    end = log.t > log.t[-1] - 0.2
    assert not log.failure
    assert np.abs(log.q - log.q_ref)[end].max() < 2e-3
    assert np.abs(log.v[end]).max() < 0.1


def test_the_observer_does_not_mistake_clipped_torque_for_a_disturbance(bundled):
    controller = armctl.ComputedTorqueObserver(bundled)
    simulation = armctl.Simulation(bundled, controller, armctl.Plant(timestep=0.001))
    log = simulation.run(Still(bundled.home + np.array([2.0, 0.0, 0.0]), 0.2))
    clipped = (np.abs(log.tau_cmd) - bundled.limits.tau_max).max()
    assert clipped > 0.0
    # What is left comes from the torque of damping at the reference, which the prediction of the motion leaves out.
    assert np.abs(controller.disturbance).max() < 1e-3 * clipped


@pytest.mark.parametrize("law", [armctl.ComputedTorqueObserver, armctl.ComputedTorqueLearning])
def test_torque_that_a_robot_cuts_off_is_no_disturbance_if_the_law_is_told(bundled, law):
    """Motors that give the weight alone hold the arm, which the law wants elsewhere."""
    q = np.array(bundled.home)
    still = np.zeros(bundled.n)
    weight = bundled.gravity(q)
    estimated = []
    for is_told in (False, True):
        controller = law(bundled)
        for tick in range(300):
            state = armctl.State(q, still, 1e-3 * tick, 1e-3, True)
            wanted = controller.torque(state, Setpoint(q + 0.1, still, still))
            if is_told:
                controller.applied(weight)
        estimated.append(float(np.abs(controller.disturbance).max()))
        assert np.abs(wanted - weight).max() > 1.0
    assert estimated[0] > 1.0
    assert estimated[1] < 0.05 * estimated[0]  # that of damping at the reference, which the prediction of the motion leaves out


def test_an_arm_that_a_robot_holds_back_is_not_expected_to_move_if_the_law_is_told(bundled):
    q = np.array(bundled.home)
    still = np.zeros(bundled.n)
    wanted = Setpoint(q + 0.1, still, still)
    first = armctl.ComputedTorque(bundled).torque(armctl.State(q, still, 0.0, 1e-3, True), wanted)
    change = []
    for is_told in (False, True):
        controller = armctl.ComputedTorque(bundled)
        for tick in range(300):
            last = controller.torque(armctl.State(q, still, 1e-3 * tick, 1e-3, True), wanted)
            if is_told:
                controller.applied(bundled.gravity(q))
        change.append(float(np.abs(last - first).max()))
    assert change[0] > 1.0
    assert change[1] < 0.05 * change[0]


@every_controller
def test_the_same_run_gives_the_same_bits(bundled, name):
    controller = controller_by_name(name, bundled)
    first = armctl.simulate(bundled, controller, Sway(bundled))
    second = armctl.simulate(bundled, controller, Sway(bundled))
    assert np.array_equal(first.q, second.q)
    assert np.array_equal(first.tau_cmd, second.tau_cmd)


@pytest.mark.parametrize("name", WITH_MEMORY)
def test_memory_is_reset_when_time_jumps(redundant, name):
    arm = redundant
    controller = controller_by_name(name, arm)
    fresh = controller_by_name(name, arm)
    still = np.zeros(arm.n)
    setpoint = Setpoint(arm.home + 0.01, still, still, still, still)
    for k in range(20):
        controller.torque(armctl.State(arm.home, still, 0.001 * k, 0.001), setpoint)
    later = armctl.State(arm.home, still, 7.0, 0.001)
    follows = armctl.State(arm.home, still, 0.020, 0.001)
    expected = fresh.torque(later, setpoint)
    assert not np.array_equal(controller.torque(follows, setpoint), expected)
    assert np.array_equal(controller.torque(later, setpoint), expected)


@every_controller
def test_works_without_tick_differences(name, bundled):
    controller = controller_by_name(name, bundled)
    zero = np.zeros(bundled.n)
    tau = controller.torque(armctl.State(bundled.home, zero), Setpoint(bundled.home, zero, zero))
    assert np.isfinite(tau).all()
    assert tau.shape == (bundled.n,)
    half = controller_by_name(name, bundled)  # without both differences there are none
    assert np.array_equal(half.torque(armctl.State(bundled.home, zero), Setpoint(bundled.home, zero, zero, zero)), tau)


def test_an_unknown_controller_has_a_suggestion(bundled):
    with pytest.raises(armctl.UnknownNameError, match="did you mean 'pd-gravity'"):
        controller_by_name("pd-gravty", bundled)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda arm: armctl.PD(arm, stiffness=[1.0, 2.0]), "stiffness: expected 3 numbers, got 2"),
        (lambda arm: armctl.PD(arm, damping=[-1.0, 2.0, 1.0]), "damping: every value must be at least 0, got -1"),
        (lambda arm: armctl.PDGravity(arm, bandwidth=-1.0), "bandwidth: expected a number in"),
        (lambda arm: armctl.PD(arm, bandwidth="20"), "bandwidth: '20' is not a number"),
        (lambda arm: armctl.PD(arm, stiffness="20"), "stiffness: '20' is not a"),
        (lambda arm: armctl.PD(arm, stiffness=5.0, bandwidth="20"), "bandwidth: '20' is not a number"),
        (lambda arm: armctl.PD(arm, damping=-2.0), "damping: every value must be at least 0, got -2"),
        (lambda arm: armctl.PD(arm, stiffness=[1.0, float("nan"), 1.0]), "stiffness: element .1. is nan"),
        (lambda arm: armctl.PDGravity(arm, damping_ratio=[1.0]), "damping_ratio: .1.0. is not a number"),
        (lambda arm: armctl.ComputedTorqueObserver(arm, observer_bandwidth="9"), "observer_bandwidth: '9' is not a number"),
        (lambda arm: armctl.Impedance(arm, posture_stiffness=-1.0), "posture_stiffness: every value must be at least 0"),
        (lambda arm: armctl.ComputedTorqueObserver(arm, bandwidth=1j), "bandwidth: 1j is not a number"),
        (lambda arm: armctl.ComputedTorque(arm, form="exact"), "form: expected one of discrete, textbook, got 'exact'"),
        (lambda arm: armctl.ComputedTorque(arm, bandwidth=float("nan")), "bandwidth: expected a finite number, got nan"),
        (lambda arm: armctl.OperationalSpace(arm, posture_bandwidth=-2.0), "posture_bandwidth: expected .*got -2"),
        (lambda arm: armctl.Impedance(arm, stiffness=np.ones(3)), "stiffness: expected 6 numbers, got 3"),
    ],
)
def test_wrong_gains_are_refused_in_one_sentence(bundled, make, sentence):
    with pytest.raises(armctl.InputError, match=sentence):
        make(bundled)


@every_controller
def test_a_controller_of_no_arm_is_rejected(name):
    with pytest.raises(armctl.InputError, match="arm: expected Arm, got 'panda'"):
        controller_by_name(name, "panda")


@pytest.mark.parametrize(
    ("controller", "gain", "size"),
    [
        (armctl.PD, "stiffness", 3),
        (armctl.PD, "damping", 3),
        (armctl.PDGravity, "stiffness", 3),
        (armctl.Impedance, "stiffness", 6),
        (armctl.Impedance, "posture_stiffness", 3),
    ],
)
@pytest.mark.parametrize("value", [7, 7.0, np.float64(7.0), np.array(7.0)])
def test_one_number_is_the_gain_of_all_joints(bundled, controller, gain, size, value):
    single = controller(bundled, **{gain: value})
    assert np.array_equal(getattr(single, gain), np.full(size, 7.0))
    state = armctl.State(bundled.home + 0.1, np.ones(bundled.n), 0.0, 0.001)
    setpoint = Setpoint(bundled.home, np.zeros(bundled.n), np.zeros(bundled.n))
    listed = controller(bundled, **{gain: [7.0] * size})
    assert np.array_equal(single.torque(state, setpoint), listed.torque(state, setpoint))


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"state": "x"}, "state: expected State, got 'x'; armctl.State"),
        ({"state": None}, "state: expected State, got None"),
        ({"setpoint": [0.0, 0.0, 0.0]}, "setpoint: expected Setpoint, got .*; armctl.Setpoint"),
        ({"state": armctl.State("q", np.zeros(3))}, "state.q: 'q' is not a vector of floats"),
        ({"state": armctl.State([0.0, 0.0, 0.0], None)}, "state.q: .* is not a vector of floats"),
        ({"setpoint": Setpoint(np.zeros(3), None, np.zeros(3))}, "setpoint.v: None is not a vector of floats"),
        ({"state": armctl.State(np.zeros(2), np.zeros(2))}, "must have the same length, got {'state.q': 2"),
    ],
)
@every_controller
def test_wrong_arguments_of_torque_are_rejected_in_one_sentence(bundled, name, wrong, sentence):
    zero = np.zeros(bundled.n)
    arguments = {"state": armctl.State(bundled.home, zero), "setpoint": Setpoint(bundled.home, zero, zero), **wrong}
    with pytest.raises(armctl.InputError, match=sentence):
        controller_by_name(name, bundled).torque(**arguments)


@pytest.mark.parametrize("limits", [(3.5, 6.0), (-6.0, -3.5), (-9.0, 9.0)])
def test_sampled_configurations_are_inside_joint_ranges_beyond_half_a_turn(load, limits):
    low, high = limits
    arm = load(limb("a b c").replace('range="-2 2"', f'range="{low} {high}"'), motors("a b c"))
    q = sample_configurations(arm)
    assert q.shape == (67, 3)
    assert arm.limits.contains(q[1:])
    assert (np.ptp(q[1:], axis=0) > 0.9 * (high - low)).all()
    assert all(np.isfinite(controller_by_name(name, arm).torque(*at_rest(arm))).all() for name in CONTROLLERS)


def at_rest(arm):
    q = arm.limits.clamp(arm.home)
    zero = np.zeros(arm.n)
    return armctl.State(q, zero, 0.0, 0.001), Setpoint(q, zero, zero)


def test_gains_of_an_arm_with_a_singular_mass_matrix_are_a_model_error(bundled, monkeypatch):
    monkeypatch.setattr("armctl.model.arm.dynamics.Dynamics.mass_matrix", lambda self, q: np.zeros((3, 3)))
    with pytest.raises(armctl.ModelError, match="the mass matrix is singular"):
        armctl.PD(replace(bundled))  # another object: what is known of an arm is computed once


def test_gains_of_a_bandwidth_scale_with_the_effective_inertia(arm):
    gains = bandwidth_gains(arm, 10.0)
    effective = [1 / np.diag(np.linalg.inv(arm.mass_matrix(q))) for q in sample_configurations(arm)]
    median = np.median(effective, axis=0)
    assert np.allclose(gains.stiffness, 100.0 * median)
    assert np.allclose(gains.damping, 20.0 * median)


def test_an_impedance_yields_by_force_over_stiffness(redundant):
    arm = redundant
    zero = np.zeros(arm.n)
    K = np.array([400.0, 500.0, 600.0, 30.0, 30.0, 30.0])
    controller = armctl.Impedance(arm, stiffness=K)
    q = arm.home + 1e-5 * np.array([1.0, -2.0, 3.0, 1.0, -1.0, 2.0, 1.0])
    tau = controller.torque(armctl.State(q, zero), Setpoint(arm.home, zero, zero))
    J = arm.jacobian(q)
    M = arm.mass_matrix(q)
    displacement = J @ (q - arm.home)
    wrench = np.linalg.solve(J @ np.linalg.solve(M, J.T), J @ np.linalg.solve(M, tau - arm.gravity(q)))
    assert np.abs(wrench + K * displacement).max() < 1e-3 * np.abs(K * displacement).max()


def test_operational_space_moves_the_tip_like_a_spring_for_any_posture(redundant):
    arm = redundant
    zero = np.zeros(arm.n)
    controller = armctl.OperationalSpace(arm, bandwidth=30.0, posture_bandwidth=0.0)
    q = arm.home + 1e-4 * np.array([1.0, -2.0, 3.0, 1.0, -1.0, 2.0, 1.0])
    tau = controller.torque(armctl.State(q, zero), Setpoint(arm.home, zero, zero))
    J = arm.jacobian(q)
    tip_acceleration = J @ np.linalg.solve(arm.mass_matrix(q), tau - arm.gravity(q))
    expected = 900.0 * J @ (arm.home - q)
    assert np.abs(tip_acceleration - expected).max() < 1e-3 * np.abs(expected).max()


def test_the_sampled_reference_is_the_velocity_that_a_discrete_arm_measures(bundled):
    reference = TickReference.from_trajectory(Sway(bundled), 0.002, 50)
    assert np.allclose(reference.v_tick[1:], np.diff(reference.q, axis=0) / 0.002)
