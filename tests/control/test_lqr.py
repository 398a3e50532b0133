"""The linear quadratic regulator: its gains are those of python-control, and its loop is the one that the gains predict."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic import BENT, serial_arm

import armctl

WEIGHTS = [{}, {"integral_time": 0.0}, {"max_error": 0.01, "max_velocity": 1.0}, {"max_error": 0.01, "integral_time": 0.0}]


@pytest.fixture(params=["six joints", "redundant"])
def arm(request, tmp_path):
    return serial_arm(tmp_path, BENT[request.param])


@pytest.fixture
def six(tmp_path):
    return serial_arm(tmp_path, BENT["six joints"])


def relative_difference(x, y):
    return np.abs(x - y).max() / np.abs(y).max()


@pytest.mark.parametrize("continuous", [False, True])
@pytest.mark.parametrize("weights", WEIGHTS, ids=["inertias", "no integral", "Bryson", "Bryson, no integral"])
def test_the_gains_are_those_of_python_control(arm, weights, continuous):
    q = arm.limits.random(arm.home, 1, np.random.default_rng(3))[0]
    (found,) = armctl.LQR(arm, q=q, **weights).gains(0.002, continuous)
    import control  # takes a second

    K, P, _ = control.dlqr(found.A, found.B, found.Q, found.R, found.N)
    assert relative_difference(found.K, K) < 1e-9
    assert relative_difference(found.P, P) < 1e-9


def test_the_linear_model_is_that_of_the_simulated_arm(arm):
    (found,) = armctl.LQR(arm, integral_time=0.0).gains()
    linear = armctl.linear_arm(arm, arm.home)
    assert np.abs(found.A - linear.A).max() < 1e-8
    assert relative_difference(found.B, linear.B) < 1e-8


@pytest.mark.parametrize("weights", WEIGHTS[1::2], ids=["inertias", "Bryson"])
def test_the_law_applies_the_gains_at_its_configuration(arm, weights):
    """Without observer and integral, the law is tau = -K x for small errors."""
    q = arm.limits.random(arm.home, 1, np.random.default_rng(5))[0]
    law = armctl.LQR(arm, q=q, observer_bandwidth=0.0, **weights)
    rest = np.zeros(arm.n)
    setpoint = armctl.Setpoint(q, rest, rest)
    slope = []
    for step in 1e-6 * np.eye(2 * arm.n):
        ahead, behind = (
            law.torque(armctl.State(q + s * step[: arm.n], s * step[arm.n :], 0.0, arm.dt), setpoint) for s in (1, -1)
        )
        slope.append((ahead - behind) / 2e-6)
    assert relative_difference(-np.array(slope).T, law.gains()[0].K) < 1e-6


def test_bryson_weights_are_the_inverse_squares(arm):
    (found,) = armctl.LQR(arm, max_error=0.1, max_velocity=2.0, max_torque=np.full(arm.n, 5.0), integral_time=0.5).gains()
    assert np.allclose(np.diag(found.Q), np.repeat([100.0, 0.25, 400.0], arm.n))
    assert np.allclose(found.R, 0.04 * np.eye(arm.n))


def test_by_default_the_poles_are_at_the_bandwidth(arm):
    """A unit mass with Q = w^4 and R = 1 has its poles at w, 45 degrees from the real axis."""
    law = armctl.LQR(arm, integral_time=0.0)
    (found,) = law.gains(1e-4)
    poles = np.log(np.linalg.eigvals(found.A - found.B @ found.K)) / 1e-4
    bandwidth = law.effective_gains(1e-4)["bandwidth"]
    assert poles.real == pytest.approx(np.full(2 * arm.n, -bandwidth / np.sqrt(2)), rel=0.03)
    assert np.abs(poles.imag) == pytest.approx(np.full(2 * arm.n, bandwidth / np.sqrt(2)), rel=0.03)


# Gains that forget the end of a motion within an interval, and on a short motion those that do not.
@pytest.mark.parametrize(("distance", "max_error"), [(0.3, 0.01), (0.05, 5.0)])
def test_gains_along_a_motion_follow_from_the_riccati_recursion(arm, distance, max_error):
    motion = armctl.move_j(arm, arm.home, arm.limits.clamp(arm.home + distance))
    nodes = armctl.LQR(arm, motion, max_error=max_error).gains()
    interval = motion.duration / (len(nodes) - 1)
    assert np.abs(nodes[0].K - nodes[-1].K).max() > 0.03 * distance * np.abs(nodes[0].K).max()
    P = nodes[-1].P
    for node in nodes[-2:-4:-1]:
        K = node.K
        for _ in range(round(interval / arm.dt)):
            K = np.linalg.solve(node.R + node.B.T @ P @ node.B, node.B.T @ P @ node.A + node.N.T)
            P = node.Q + node.A.T @ P @ node.A - (node.N + node.A.T @ P @ node.B) @ K
        assert relative_difference(node.K, K) < 1e-8


def test_gains_along_a_motion_track_an_arm_with_a_payload(arm):
    motion = armctl.move_j(arm, arm.home, arm.limits.clamp(arm.home + 0.3))
    plant = armctl.Plant(payload=0.2, encoder_noise=1e-5)
    error = {}
    for law in (armctl.LQR(arm, motion), armctl.PDFeedforward(arm)):
        log = armctl.simulate(arm, law, motion, plant)
        assert not log.failure
        error[law.name] = np.sqrt(np.mean((log.q - log.q_ref) ** 2))
        assert not law.is_time_varying
    assert error["lqr"] < 0.5 * error["pd-feedforward"]


def test_the_default_margins_hold_and_a_longer_one_is_asked_for(six):
    plants = [armctl.Plant(timestep=0.001)]
    default = armctl.margins(six, "lqr", 3, plants)
    slow = armctl.margins(six, armctl.LQR(six, delay_margin=0.02), 3, plants)
    assert default.delay.value >= 5e-3
    assert slow.delay.value >= 0.02
    assert max(default.peak_sensitivity.value, slow.peak_sensitivity.value) <= 1.7


@pytest.mark.nightly
def test_tuning_yields_less_to_disturbances(six):
    tuned = armctl.tune(six, "lqr", configurations=2, plants=[armctl.Plant(timestep=0.002)])
    assert tuned, tuned.reason
    assert isinstance(tuned.controller, armctl.LQR)
    assert tuned.after.compliance < 0.8 * tuned.before.compliance
    assert tuned.after.delay_margin >= 5e-3


def test_the_integral_waits_while_a_motor_is_saturated(arm):
    weak = arm.with_limits(replace(arm.limits, tau_max=1.05 * np.maximum(np.abs(arm.gravity(arm.home)), 0.1)))
    law = armctl.LQR(weak)
    rest = np.zeros(arm.n)
    far = armctl.Setpoint(arm.home + 0.5, rest, rest)
    for k in range(100):
        law.torque(armctl.State(arm.home, rest, k * arm.dt, arm.dt), far)
    assert (law.memory[-arm.n :] == 0.0).all()
    law.torque(armctl.State(arm.home, rest, 0.0, arm.dt), armctl.Setpoint(arm.home + 1e-6, rest, rest))
    assert (law.memory[-arm.n :] != 0.0).all()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"max_error": -0.1}, "max_error: every value must be at least 0"),
        ({"max_error": [0.1, 0.0, 0.1, 0.1, 0.1, 0.1]}, "max_error: every joint needs one above 0"),
        ({"max_error": 1e30, "max_torque": 1e-100}, "no gains minimize the cost"),
        ({"delay_margin": 2.0}, "delay_margin: expected a number in"),
        ({"bandwidth": 0.0}, "bandwidth: expected a number in"),
    ],
)
def test_wrong_arguments_are_explained(six, wrong, message):
    with pytest.raises(armctl.InputError, match=message):
        armctl.LQR(six, **wrong).gains()


def test_a_motion_and_a_configuration_exclude_each_other(arm):
    motion = armctl.move_j(arm, arm.home, arm.limits.clamp(arm.home + 0.3))
    with pytest.raises(armctl.InputError, match="give a motion or a configuration, not both"):
        armctl.LQR(arm, motion, q=arm.home)
    with pytest.raises(armctl.InputError, match="dt: need a control period above 0"):
        armctl.LQR(arm).gains(0.0)
