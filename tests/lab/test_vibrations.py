"""Margins name badly damped modes that move a joint, and the torque noise of encoders; both as simulated."""

from dataclasses import replace

import numpy as np
import pytest
from arms import some_of
from synthetic import BENT, SHAPES, serial_arm

import armctl
from armctl.control import controller_by_name
from armctl.core.trajectory import Setpoint
from armctl.lab.identification.frequency_response import Excited, standstill

IDEAL = armctl.Plant(timestep=0.001)
ARMS = {"light": replace(BENT["six joints"], joints=2, home="0.1 0.5"), "heavy": replace(SHAPES["heavy"], joints=2)}


@pytest.fixture(scope="module", params=some_of(ARMS, ["light"]))
def arm(request, tmp_path_factory):
    return serial_arm(tmp_path_factory.mktemp("arm"), ARMS[request.param])


def springs(arm, resonance):
    """Springs at which each link resonates, Hz, with its rotor locked."""
    link = arm.mass_matrix(arm.home).diagonal()
    return {"elasticity": link * (2 * np.pi * resonance) ** 2, "rotor_inertia": 0.5 * link}


def elastic(arm, resonance, damping=0.01):
    return replace(IDEAL, **springs(arm, resonance), elastic_damping=damping, continuous=True)


def swings(arm, law, loop, plant):
    """How often a joint swings by more than 2 % of its displacement after a step of torque on it; the most of all joints."""
    rest = np.zeros(arm.n)
    found = []
    for joint in range(arm.n):
        positions = []
        for size in (0.0, 1e-3 * arm.limits.tau_max[joint]):
            step = size * np.eye(arm.n)[joint]
            held = Excited(law, loop.holding_torque, 0, np.zeros(1))
            sim = armctl.Simulation(arm, held, replace(plant, joint_torque=lambda q, v, t, step=step: step * (t > 0.05)))
            sim.reset(loop.q)
            seen = sim.measured_state._replace(t=-1.0)
            held.torque(seen, Setpoint(seen.q, rest, rest, rest, rest))
            sim.reset(loop.q)
            log = sim.run(standstill(arm, seen.q, 1.0))
            assert not log.failure
            positions.append(log.q[:, joint])
        y = positions[1] - positions[0]
        turning = np.flatnonzero(np.diff(y)[1:] * np.diff(y)[:-1] < 0) + 1
        found.append(int((np.abs(np.diff(y[turning])) > 0.02 * np.abs(y).max()).sum()))
    return max(found)


@pytest.mark.parametrize("law", some_of(["pd-gravity", "computed-torque", "computed-torque-observer"], ["pd-gravity"]))
@pytest.mark.parametrize(("resonance", "damping"), [(6.0, 0.01), (12.0, 0.3)])
def test_a_predicted_vibration_is_that_of_the_simulation(arm, law, resonance, damping):
    plant = elastic(arm, resonance, damping)
    controller = controller_by_name(law, arm)
    loop = armctl.linearize(arm, controller, arm.home, plant)
    found = armctl.margins(arm, controller, [arm.home], [plant])
    least = loop.least_damped()
    assert (found.damping.value, found.frequency) == tuple(least)
    count = swings(arm, controller, loop, plant)
    if found.ok:
        assert count < 12, least  # five oscillations fall to 4 % with a damping ratio of 0.1
    else:
        assert count >= 4, least
        assert "the closed loop vibrates" in found.reason


def test_a_notch_at_the_resonance_of_the_links_decides_whether_a_law_vibrates(tmp_path):
    """With encoders at the links; the notch is as wide as in `propose_filter`."""
    arm = serial_arm(tmp_path, ARMS["light"])
    plant = replace(elastic(arm, 8.0, 0.02), encoder_side="link")
    found = armctl.propose_filter(arm, "pd-gravity", arm.home, plant, delay_margin=2e-3, peak_sensitivity=2.5)
    assert found.ok, found.reason
    loops = [armctl.linearize(arm, law, arm.home, plant) for law in ("pd-gravity", found.controller)]
    assert not loops[0].is_stable
    assert loops[0].least_damped().damping_ratio == 0.0
    count = swings(arm, found.controller, loops[1], plant)
    assert (loops[1].least_damped().damping_ratio < 0.1) == (count > 10)


def test_modes_that_move_no_joint_raise_no_alarm(arm):
    """Springs of 100 Hz ring with a hundredth of the displacement, and the notch of a filter only in the torque."""
    plant = elastic(arm, 100.0, 0.02)
    law = armctl.ComputedTorque(arm, bandwidth=10.0)
    loop = armctl.linearize(arm, law, arm.home, plant)
    assert loop.modes()[0, 1] < 0.1 < loop.least_damped().damping_ratio
    assert swings(arm, law, loop, plant) < 4
    assert armctl.margins(arm, law, [arm.home], [plant]).ok


def test_a_damped_mode_is_that_of_the_differential_equation(tmp_path):
    """Rotor, spring and link of one joint under PD: the eigenvalues of the textbook's matrix."""
    arm = serial_arm(tmp_path, replace(BENT["six joints"], joints=1, home="0.3", joint=""))
    inertia = float(arm.mass_matrix(arm.home)[0, 0])
    stiffness, rotor = inertia * 50.0**2, 0.5 * inertia
    plant = armctl.Plant(timestep=2e-4, elasticity=stiffness, rotor_inertia=rotor, elastic_damping=0.0, continuous=True)
    kp, kd = 3000.0 * inertia, 4.0 * inertia
    law = armctl.PD(arm, stiffness=kp, damping=kd)
    mass, damping = np.diag([inertia, rotor]), np.diag([0.0, kd])
    springs = np.array([[stiffness, -stiffness], [-stiffness, stiffness + kp]])
    inverse = np.linalg.inv(mass)
    poles = np.linalg.eigvals(np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ springs, -inverse @ damping]]))
    worst = max(poles[poles.imag > 0], key=lambda pole: pole.real / abs(pole))
    least = armctl.linearize(arm, law, arm.home, plant).least_damped()
    assert least.frequency == pytest.approx(worst.imag, rel=0.01)
    assert least.damping_ratio == pytest.approx(-worst.real / abs(worst), rel=0.1)


@pytest.mark.parametrize("law", ["pd-gravity", "computed-torque-observer", "lqr"])
@pytest.mark.parametrize(
    "sensing",
    [
        {"encoder_bits": 15},
        {"encoder_bits": 18, "continuous": True, "delay": 2},
        {"encoder_bits": 17, "velocity": "true"},
        {"encoder_noise": 1e-5},
        {"encoder_noise": 2e-5, "velocity_noise": 1e-3, "sensor_delay": 1},
    ],
    ids=str,
)
def test_predicted_torque_noise_is_that_of_a_moving_arm(arm, law, sensing):
    plant = replace(IDEAL, **sensing)
    turn = np.random.default_rng(31).uniform(0.05, 0.1, arm.n)
    motion = armctl.move_j(arm, arm.home - turn, arm.home + turn)  # too short for a constant speed
    noisy, silent = (armctl.simulate(arm, law, motion, each, dwell=0.0) for each in (plant, IDEAL))
    ticks = slice(20, len(noisy) - 20)
    tau = noisy.tau[ticks] - silent.tau[ticks]
    simulated = np.sqrt(np.mean((tau[1:-1] - 0.5 * (tau[:-2] + tau[2:])) ** 2, axis=0))
    predicted = armctl.linearize(arm, law, arm.home, plant).chatter()
    assert simulated == pytest.approx(predicted, rel=0.35)
    worst = armctl.margins(arm, law, [arm.home], [plant])
    assert worst.chatter.value == pytest.approx(np.sqrt(np.mean(predicted**2)))
    assert "torque noise" in str(worst) or not worst.ok


def test_torque_noise_follows_the_step_of_the_encoder_and_is_zero_without(arm):
    coarse, fine, exact = (
        armctl.linearize(arm, "pd", arm.home, replace(IDEAL, encoder_bits=bits)).chatter() for bits in (12, 16, 0)
    )
    assert coarse == pytest.approx(16 * fine)
    assert not exact.any()
    assert np.isinf(armctl.linearize(arm, armctl.PD(arm, stiffness=0.0, damping=1e7), arm.home, IDEAL).chatter(1e-5)).all()


@pytest.mark.full
@pytest.mark.parametrize("shape", ["light", pytest.param("heavy", marks=pytest.mark.nightly)])
def test_a_comparison_and_a_tuning_name_the_least_damping_of_a_law_that_vibrates(tmp_path, shape):
    arm = serial_arm(tmp_path, ARMS[shape])
    motion = armctl.move_j(arm, arm.home, arm.home + 0.1)
    vibrating = armctl.compare(arm, ["pd-gravity"], motion, [elastic(arm, 6.0)], configurations=1)
    assert ("least damping" in armctl.table(vibrating)) == (vibrating[0].damping_ratio < 0.1)
    assert "least damping" not in armctl.table(armctl.compare(arm, ["pd-gravity"], motion, [IDEAL], configurations=1))
    rigid, soft = (
        armctl.tune(arm, "computed-torque", 3e-3, 1.9, configurations=[arm.home], plants=[p])
        for p in (IDEAL, elastic(arm, 6.0))
    )
    assert "vibrates" not in str(rigid.before)
    assert ("vibrates" in str(soft.before)) == (soft.before.damping_ratio < 0.1)
    assert soft.to_dict()["before"]["damping_ratio"] == soft.before.damping_ratio
