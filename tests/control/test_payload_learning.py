"""The payload that a controller learns: regressor, estimate, error, and the loop that stays as it is."""

import numpy as np
import pytest
from motions import Still
from synthetic import BENT, serial_arm

import armctl
from armctl import _core
from armctl.core.trajectory import Setpoint

OBSERVER = "computed-torque-observer"
LEARNING = "computed-torque-learning"


class Repeated:
    """The same way out and back, three times."""

    def __init__(self, arm):
        goal = arm.limits.clamp(arm.home + 0.5)
        self.out = armctl.move_j(arm, arm.home, goal)
        self.back = armctl.move_j(arm, goal, arm.home)
        self.period = self.out.duration + self.back.duration + 0.2
        self.duration = 3 * self.period

    def __call__(self, t):
        return Setpoint(*(column[0] for column in self.sample([t])[:3]))

    def sample(self, times):
        phase = np.clip(times, 0.0, self.duration - 1e-9) % self.period
        out = self.out.sample(phase)
        back = self.back.sample(np.maximum(phase - self.out.duration - 0.1, 0.0))
        first = (phase < self.out.duration + 0.1)[:, None]
        return Setpoint(*(np.where(first, a, b) for a, b in zip(out[:3], back[:3], strict=True)))


@pytest.fixture
def light_wrist(tmp_path):
    return serial_arm(tmp_path, BENT["redundant"])


def error_of_third_motion(arm, name, **plant):
    motion = Repeated(arm)
    simulation = armctl.Simulation(arm, name, armctl.Plant(payload=0.5, payload_center=[0.03, 0.02, 0.05], **plant))
    log = simulation.run(motion)
    assert not log.failure
    third = log.t > 2 * motion.period
    return np.sqrt(np.mean((log.q - log.q_ref)[third] ** 2)), simulation


@pytest.mark.parametrize("continuous", [False, True])
def test_the_regressor_gives_the_torque_of_a_body_at_the_tip(light_wrist, continuous):
    arm = light_wrist
    center = np.array([0.03, -0.02, 0.05])
    loaded = arm.with_payload(0.7, center)
    moments = np.outer(center, center)[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    parameters = 0.7 * np.concatenate([[1.0], center, moments])
    rng = np.random.default_rng(0)
    models = [each.core_model.for_period(0.002, continuous) for each in (arm, loaded)]
    law = armctl.ComputedTorqueLearning(arm).make_law(0.002, continuous)
    unknowns = 10 + 1 + arm.n
    first = 5 * arm.n + 1 + unknowns  # of the regressor in the memory, behind the observer's numbers and the estimate
    tau = np.zeros((2, arm.n))
    for _ in range(5):
        q, v, a = rng.uniform(-1.0, 1.0, (3, arm.n))
        for row, model in zip(tau, models, strict=True):
            _core.inverse_dynamics(model, q[None], v[None], a[None], row[None])
        law.torque(q, v, np.array([q, v, a, v, a]), np.zeros(0), np.empty(arm.n))
        Y = law.memory[first : first + arm.n * (unknowns + 1)].reshape(arm.n, unknowns + 1)[:, :10]
        assert Y @ parameters == pytest.approx(tau[1] - tau[0], abs=1e-9)


def test_before_the_first_tick_nothing_is_learnt(light_wrist):
    law = armctl.ComputedTorqueLearning(light_wrist)
    assert (law.payload.tolist(), law.delay, law.friction.tolist()) == ([0.0] * 4, 0.0, [0.0] * light_wrist.n)


@pytest.mark.parametrize("dt", [0.001, 0.004])
def test_the_third_motion_has_a_tenth_of_the_error(light_wrist, dt):
    observed, _ = error_of_third_motion(light_wrist, OBSERVER, timestep=dt)
    learnt, simulation = error_of_third_motion(light_wrist, LEARNING, timestep=dt)
    assert learnt < 0.1 * observed
    mass, *moment = simulation.controller.payload
    assert mass == pytest.approx(0.5, rel=0.02)
    assert moment == pytest.approx([0.015, 0.01, 0.025], abs=0.003)


def test_friction_is_learnt_in_spite_of_noise_and_delay(light_wrist):
    disturbed = {"timestep": 0.002, "delay": 1, "encoder_noise": 1e-5, "coulomb_friction": 0.2}
    observed, _ = error_of_third_motion(light_wrist, OBSERVER, **disturbed)
    learnt, simulation = error_of_third_motion(light_wrist, LEARNING, **disturbed)
    assert learnt < 0.5 * observed
    assert simulation.controller.friction == pytest.approx(0.2, abs=0.02)


@pytest.mark.parametrize("delay", [0, 1, 2])
def test_the_delay_of_the_motors_is_learnt(light_wrist, delay):
    disturbed = {"timestep": 0.004, "delay": delay, "encoder_noise": 1e-5}
    observed, _ = error_of_third_motion(light_wrist, OBSERVER, **disturbed)
    learnt, simulation = error_of_third_motion(light_wrist, LEARNING, **disturbed)
    assert simulation.controller.delay == pytest.approx(0.004 * delay, rel=0.1, abs=1e-4)
    assert simulation.controller.payload[0] == pytest.approx(0.5, rel=0.02)
    assert learnt < 0.1 * observed


def test_the_estimate_changes_only_while_the_reference_moves(light_wrist):
    arm = light_wrist
    law = armctl.control.controller_by_name(LEARNING, arm)
    simulation = armctl.Simulation(arm, law, armctl.Plant(timestep=0.001, payload=0.5))
    simulation.run(Still(arm.home, 0.3))
    assert not law.payload.any()
    simulation.run(armctl.move_j(arm, arm.home, arm.home + 0.1))
    simulation.run(Still(arm.home + 0.1, 0.1))
    learnt = law.payload
    simulation.run(Still(arm.home + 0.1, 0.3))
    assert learnt.any()
    assert np.array_equal(law.payload, learnt)


def test_the_loop_at_rest_is_that_of_the_observer(light_wrist):
    plant = armctl.Plant(timestep=0.001)
    observed = armctl.linearize(light_wrist, OBSERVER, light_wrist.home, plant)
    learning = armctl.linearize(light_wrist, LEARNING, light_wrist.home, plant)
    w = np.geomspace(1.0, 1000.0, 20)
    assert learning.transfer(w) == pytest.approx(observed.transfer(w), rel=1e-4, abs=1e-6)
