"""Every controller on every arm at hand at 1, 2 and 4 ms: one row a controller. And what each of them promises."""

import numpy as np
import pytest
from arms import arm_of
from motions import Still, Sway

import armctl
from armctl.control import CONTROLLERS, controller_by_name
from armctl.control.gains import joint_inertia, pd_gains
from armctl.core.trajectory import Setpoint, TickReference

TICKS = (0.001, 0.002, 0.004)
EXACT = ("computed-torque", "computed-torque-observer", "operational-space", "impedance", "adaptive")
WITH_MEMORY = ("pid-gravity", "computed-torque-observer", "adaptive")

every_controller = pytest.mark.parametrize("name", CONTROLLERS)
every_tick = pytest.mark.parametrize("dt", TICKS)


@every_tick
@every_controller
def test_follows_a_motion_without_chatter(arm, name, dt):
    log = armctl.simulate(arm, name, Sway(arm), armctl.Plant(timestep=dt), dwell=0.1)
    error = np.abs(log.q - log.q_ref).max()
    assert not log.failure
    assert np.isfinite(log.tau_cmd).all()
    assert error < (1e-8 if name in EXACT else 2e-2 if name == "computed-torque-textbook" else 0.3), error
    jitter = np.abs(np.diff(log.v[-10:], axis=0)).max() / dt
    assert jitter < 20.0, f"{jitter} rad/s^2 at the end"


@every_tick
@every_controller
def test_holds_still_at_rest(arm, name, dt):
    log = armctl.simulate(arm, name, Still(arm.home), armctl.Plant(timestep=dt), dwell=0.0)
    moved = np.abs(log.q - arm.home).max()
    assert moved < (0.3 if name == "pd" else 1e-9), moved  # PD alone sags under the arm's weight


@every_controller
def test_comes_back_after_a_kick(arm, name):
    plant, motion = armctl.Plant(timestep=0.004), Still(arm.home, 4.0)
    simulation = armctl.Simulation(arm, name, plant)
    kick = np.minimum(0.2, 0.05 * arm.limits.v_max)
    simulation.reset(arm.home, kick)
    log = simulation.run(motion)
    assert not log.failure
    assert np.abs(log.v[-1]).max() < 0.5 * kick.max()


@every_tick
@pytest.mark.parametrize("robot", ["robot_arm_3dof", "panda", "iiwa14", "so_arm100", "gen3"])
def test_an_observer_bears_a_delay_of_two_ticks(robot, dt):
    arm = arm_of(robot)
    plant = armctl.Plant(timestep=dt, delay=2, mass_scale=1.2, encoder_noise=1e-5, velocity_noise=1e-3)
    log = armctl.simulate(arm, "computed-torque-observer", Sway(arm), plant, dwell=1.0)
    end = log.t > log.t[-1] - 0.2
    assert not log.failure
    assert np.abs(log.q - log.q_ref)[end].max() < 2e-3
    assert np.abs(log.v[end]).max() < 0.1


def test_an_observer_knows_what_a_motor_cannot_have_done(bundled):
    """Asked for far more than the limits, the observer must not take what was cut off for a disturbance."""
    zero, controller = np.zeros(bundled.n), armctl.ComputedTorque(bundled, observer_bandwidth=200.0)
    simulation = armctl.Simulation(bundled, controller, armctl.Plant(timestep=0.001))
    log = simulation.run(Still(bundled.home + np.array([2.0, 0.0, 0.0]), 0.2))
    assert (np.abs(log.tau_cmd) > bundled.limits.tau_max).any()
    assert np.abs(controller._observer.estimate - zero).max() < 1e-6


@every_controller
def test_the_same_run_gives_the_same_bits(bundled, name):
    controller = controller_by_name(name, bundled)
    first, second = (armctl.simulate(bundled, controller, Sway(bundled)) for _ in range(2))
    assert np.array_equal(first.q, second.q)
    assert np.array_equal(first.tau_cmd, second.tau_cmd)


@pytest.mark.parametrize("name", WITH_MEMORY)
def test_memory_starts_afresh_when_time_jumps(name):
    arm = arm_of("panda")
    controller, fresh = controller_by_name(name, arm), controller_by_name(name, arm)
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
    controller, zero = controller_by_name(name, bundled), np.zeros(bundled.n)
    tau = controller.torque(armctl.State(bundled.home, zero), Setpoint(bundled.home, zero, zero))
    assert np.isfinite(tau).all()
    assert tau.shape == (bundled.n,)


def test_an_unknown_controller_has_a_suggestion(bundled):
    with pytest.raises(armctl.UnknownNameError, match="did you mean 'pd-gravity'"):
        controller_by_name("pd-gravty", bundled)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda arm: armctl.PD(arm, stiffness=[1.0, 2.0]), "stiffness: 2 numbers given, 3 wanted"),
        (lambda arm: armctl.PD(arm, damping=[-1.0, 2.0, 1.0]), "least damping: -1 given"),
        (lambda arm: armctl.PDGravity(arm, bandwidth=-1.0), "bandwidth: -1 given, a number at least 0"),
        (lambda arm: armctl.PIDGravity(arm, integral_gain=[1.0]), "integral_gain: 1 numbers given, 3 wanted"),
        (lambda arm: armctl.ComputedTorque(arm, form="exact"), "form: 'exact' given, one of discrete, textbook"),
        (lambda arm: armctl.ComputedTorque(arm, form="textbook", observer_bandwidth=9.0), "needs form='discrete'"),
        (lambda arm: armctl.ComputedTorque(arm, bandwidth=float("nan")), "bandwidth: nan given, a finite number"),
        (lambda arm: armctl.OperationalSpace(arm, posture_bandwidth=-2.0), "posture_bandwidth: -2 given"),
        (lambda arm: armctl.Impedance(arm, stiffness=np.ones(3)), "stiffness: 3 numbers given, 6 wanted"),
        (lambda arm: armctl.Adaptive(arm, adaptation_rate=-1.0), "adaptation_rate: -1 given"),
    ],
)
def test_wrong_gains_are_refused_in_one_sentence(bundled, make, sentence):
    with pytest.raises(armctl.InputError, match=sentence):
        make(bundled)


def test_gains_scale_with_what_a_joint_feels(arm):
    stiffness, damping = pd_gains(arm, 10.0)
    least = joint_inertia(arm).min(axis=0)
    assert (stiffness >= 100.0 * least * (1 - 1e-12)).all()
    assert (damping * 0.004 <= 0.5 * least * (1 + 1e-9)).all()


def test_the_integral_does_not_wind_up(bundled):
    """Held at its torque limit for a second, a PID that winds up would overshoot for about as long."""
    zero = np.zeros(bundled.n)
    pid = armctl.PIDGravity(bundled)
    far = Setpoint(bundled.home + np.array([100.0, 0.0, 0.0]), zero, zero)
    for k in range(1000):
        pid.torque(armctl.State(bundled.home, zero, 0.001 * k, 0.001), far)
    there = Setpoint(bundled.home, zero, zero)
    tau = pid.torque(armctl.State(bundled.home, zero, 1.0, 0.001), there)
    at_rest = armctl.PDGravity(bundled).torque(armctl.State(bundled.home, zero), there)
    assert np.abs(tau - at_rest).max() < 1e-9


def test_an_impedance_gives_way_by_force_over_stiffness():
    arm = arm_of("panda")
    zero, K = np.zeros(arm.n), np.array([400.0, 500.0, 600.0, 30.0, 30.0, 30.0])
    controller = armctl.Impedance(arm, stiffness=K)
    q = arm.home + 1e-5 * np.array([1.0, -2.0, 3.0, 1.0, -1.0, 2.0, 1.0])
    tau = controller.torque(armctl.State(q, zero), Setpoint(arm.home, zero, zero))
    weight = controller._dynamics.gravity(q)
    J = arm.jacobian(q)
    moved = J @ (q - arm.home)
    M = controller._dynamics.mass_matrix(q)
    felt = np.linalg.solve(J @ np.linalg.solve(M, J.T), J @ np.linalg.solve(M, tau - weight))  # the wrench at the tip
    assert np.abs(felt + K * moved).max() < 1e-3 * np.abs(K * moved).max()


def test_operational_space_moves_the_tip_like_a_spring_whatever_the_posture_does():
    arm = arm_of("panda")
    zero = np.zeros(arm.n)
    controller = armctl.OperationalSpace(arm, bandwidth=30.0, posture_bandwidth=0.0)
    q = arm.home + 1e-4 * np.array([1.0, -2.0, 3.0, 1.0, -1.0, 2.0, 1.0])
    tau = controller.torque(armctl.State(q, zero), Setpoint(arm.home, zero, zero))
    M, J = controller._dynamics.mass_matrix(q), arm.jacobian(q)
    tip_acceleration = J @ np.linalg.solve(M, tau - controller._dynamics.gravity(q))
    wanted = 900.0 * J @ (arm.home - q)
    assert np.abs(tip_acceleration - wanted).max() < 1e-3 * np.abs(wanted).max()


def test_the_reference_on_ticks_is_what_a_discrete_arm_measures(bundled):
    reference = TickReference.of(Sway(bundled), 0.002, 50)
    assert np.allclose(reference.v_tick[1:], np.diff(reference.q, axis=0) / 0.002)
