"""Computed torque with integral action: its gains, its margin, and what it removes."""

import numpy as np
import pytest
from scipy.linalg import solve_continuous_are
from synthetic import BENT, serial_arm

import armctl
from armctl.analysis.comparison import out_and_back
from armctl.control.integral_gains import integral_gains


@pytest.mark.parametrize("inertia_ratio", [1.0, 3.0, 4.0])
def test_the_gains_solve_the_riccati_equation_and_are_stable_with_twice_the_inertia_ratio(inertia_ratio):
    gains = integral_gains(0.0, 5e-3, False, inertia_ratio)
    w = np.sqrt(gains.kd**2 - 2 * gains.kp)
    chain = np.diag([1.0, 1.0], 1)
    weights = np.diag([gains.ki**2, 2 * w**4, w**2])
    heavy = 2 * inertia_ratio
    assert np.roots([heavy, gains.kd, gains.kp, gains.ki]).real.max() < 0.0
    P = solve_continuous_are(chain, np.array([[0.0], [0.0], [1.0]]), weights, np.eye(1))
    assert P[2] == pytest.approx([gains.ki, gains.kp, gains.kd], rel=1e-9)


@pytest.mark.parametrize(("dt", "margin"), [(0.001, 5e-3), (0.004, 10e-3)])
def test_the_loop_has_the_delay_margin_that_was_asked_for(tmp_path, dt, margin):
    arm = serial_arm(tmp_path, BENT["six joints"])
    law = armctl.ComputedTorque(arm, integral=True, delay_margin=5e-3)
    worst = armctl.margins(arm, law, poses=3, plants=[armctl.Plant(timestep=dt)])
    assert margin <= worst.delay.value < 1.1 * margin
    assert worst.peak_sensitivity.value < 1.7


def test_an_unknown_payload_costs_less_than_a_thirtieth_of_the_error(bent):
    motion = out_and_back(bent, 0.2).scaled(0.5)
    plant = armctl.Plant(timestep=0.001, payload=0.5)
    error = {
        name: armctl.Report.from_log(armctl.simulate(bent, name, motion, plant)).joint_rms_rad
        for name in ("computed-torque", "computed-torque-integral")
    }
    assert error["computed-torque-integral"] < error["computed-torque"] / 30


def test_the_integral_stops_while_a_motor_is_at_its_limit(bundled):
    still = np.zeros(bundled.n)
    law = armctl.ComputedTorque(bundled, integral=True)
    setpoint = armctl.Setpoint(bundled.home + np.array([1.0, 0.0, 0.0]), still, still)
    for k in range(50):
        tau = law.torque(armctl.State(bundled.home, still, 0.001 * k, 0.001), setpoint)
    assert tau[0] > bundled.limits.tau_max[0]
    again = armctl.ComputedTorque(bundled, integral=True).torque(armctl.State(bundled.home, still, 0.0, 0.001), setpoint)
    assert tau == pytest.approx(again, rel=1e-12)
