"""Limits of torque, velocity and position by a quadratic program."""

from dataclasses import replace

import daqp
import numpy as np
import pytest
from synthetic import BENT, serial_arm

import armctl
from armctl import _core
from armctl._core import UNBOUNDED
from armctl.core.trajectory import Setpoint


class Clipped:
    """Computed torque, clipped."""

    name = "clipped"

    def __init__(self, arm):
        self.law = armctl.ComputedTorque(arm)
        self.tau_max = arm.limits.tau_max

    def torque(self, state, setpoint):
        return np.clip(self.law.torque(state, setpoint), -self.tau_max, self.tau_max)


class Swing:
    """All joints swing by an amplitude, rad, and back."""

    def __init__(self, arm, amplitude, duration):
        self.home = arm.home
        self.amplitude = amplitude
        self.duration = duration

    def __call__(self, t):
        return Setpoint(*(column[0] for column in self.sample([t])[:3]))

    def sample(self, times):
        w = 2 * np.pi / self.duration
        phase = w * np.clip(times, 0.0, self.duration)[:, None]
        half = 0.5 * np.broadcast_to(self.amplitude, self.home.shape)
        return Setpoint(self.home + half * (1 - np.cos(phase)), half * w * np.sin(phase), half * w**2 * np.cos(phase))


@pytest.fixture
def six(tmp_path):
    return serial_arm(tmp_path, BENT["six joints"])


def run(arm, law, motion, dt=0.001):
    return armctl.simulate(arm, law, motion, armctl.Plant(timestep=dt), dwell=0.5)


def weakened(arm, motion, share):
    """The arm with motors that give a share of the torque that a motion needs beyond holding the arm."""
    setpoints = motion.sample(np.arange(0.0, motion.duration, 0.002))
    holding = np.max([np.abs(arm.gravity(q)) for q in setpoints.q], axis=0)
    needed = np.max([np.abs(arm.inverse_dynamics(q, v, a)) for q, v, a in zip(*setpoints[:3], strict=True)], axis=0)
    tau_max = arm.limits.tau_max.copy()
    tau_max[1] = holding[1] + share * (needed[1] - holding[1])
    return arm.with_limits(replace(arm.limits, tau_max=tau_max))


def test_the_tip_leaves_its_path_by_less_than_a_quarter_of_what_clipping_costs(six):
    motion = Swing(six, 0.4, 1.2)
    weak = weakened(six, motion, 0.8)
    error = {}
    for law in (Clipped(weak), armctl.ComputedTorqueQP(weak)):
        log = run(weak, law, motion)
        assert (np.abs(log.tau_cmd) <= weak.limits.tau_max).all()
        error[law.name] = np.linalg.norm(log.tip - log.tip_ref, axis=1).max()
    assert error["clipped"] > 1e-4
    assert error["qp"] < 0.25 * error["clipped"]


@pytest.mark.parametrize("dt", [0.001, 0.004])
def test_no_limit_is_exceeded_by_a_reference_that_exceeds_all(six, dt):
    limits = six.limits
    far = np.array([2.5, 0.3, 0.0, -0.2, 2.2, -3.0])
    log = run(six, "qp", Swing(six, far - six.home, 1.0), dt)
    assert not log.failure
    assert np.abs(log.v_ref).max() > limits.v_max.min()
    assert (np.abs(log.v) <= limits.v_max * (1 + 1e-6)).all()
    assert limits.contains(log.q, tolerance=1e-6)
    assert (np.abs(log.tau_cmd) <= limits.tau_max).all()


def test_limits_that_exclude_each_other_are_violated_least(six):
    """The arm moves at twice the speed limit when the run begins."""
    fast = replace(six.limits, v_max=np.full(6, 0.1))
    arm = six.with_limits(fast)
    simulation = armctl.Simulation(arm, "qp", armctl.Plant(timestep=0.001))
    simulation.reset(arm.home, np.full(6, 0.2))
    log = simulation.run(armctl.move_j(arm, arm.home, arm.home + 0.01))
    assert not log.failure
    assert (np.abs(log.tau_cmd) <= arm.limits.tau_max).all()
    assert (np.abs(log.v[-100:]) <= 0.1 * (1 + 1e-6)).all()
    assert np.abs(log.q[-1] - log.q_ref[-1]).max() < 1e-2


# As in armctl/cpp/laws/computed_torque_qp.hpp.
VIOLATION_WEIGHT = 1e4
ROTATION_WEIGHT = 0.03
JOINT_WEIGHT = 0.003
BRAKE_SHARE = 0.8
MIN_BRAKE_SHARE = 0.05


def daqp_solution(H, f, M, lower, upper):
    """The minimum of x H x / 2 + f x with x and M x within their bounds (2n,), or None if there is no such x."""
    x, _, status, _ = daqp.solve(H, f, M, upper, lower)
    return x if status == 1 else None


def torque_of_daqp(program, torque, tau_max):
    """The torque of a program; if limits contradict each other, those of velocity and position become costs."""
    H, M, lower, upper = program
    n = len(torque)
    deviation = daqp_solution(H, np.zeros(n), M, lower, upper)
    if deviation is None:
        nearest = np.clip(0.0, lower[:n], upper[:n])
        weights = np.where(nearest != 0.0, VIOLATION_WEIGHT * np.trace(H), 0.0)
        is_free = np.concatenate([nearest != 0.0, np.zeros(n, bool)])
        lower = np.where(is_free, -UNBOUNDED, lower)
        upper = np.where(is_free, UNBOUNDED, upper)
        deviation = daqp_solution(H + np.diag(weights), -weights * nearest, M, lower, upper)
    if deviation is None:
        deviation = np.zeros(n)
    return np.clip(torque + M @ deviation, -tau_max, tau_max)


def stopping_speed(distance, deceleration, dt):
    """The highest speed s after a step of dt from which a joint stops within a distance, s dt / 2 + s^2 / (2 deceleration)."""
    half = 0.5 * deceleration * dt
    rest = np.maximum(distance, 0.0)
    return np.minimum(np.sqrt(half**2 + 2.0 * deceleration * rest) - half, rest / dt)


def program_at(arm, gains, q, v, torque):
    """H, M, lower and upper of the deviation from the acceleration that needs a torque, for one step of MuJoCo."""
    n = arm.n
    model = arm.core_model.for_period(gains["dt"], False)
    accelerations = np.vstack([np.zeros(n), np.eye(n)])
    torques = np.empty((n + 1, n))
    _core.inverse_dynamics(model, np.tile(q, (n + 1, 1)), np.tile(v, (n + 1, 1)), accelerations, torques)
    bias = torques[0]
    M = (torques[1:] - bias).T
    desired = np.linalg.solve(M, torque - bias)
    J = arm.jacobian(q)
    J[3:] *= ROTATION_WEIGHT * gains["length"]
    H = J.T @ J + (JOINT_WEIGHT * gains["length"]) ** 2 * np.eye(n)
    limits = arm.limits
    brake = BRAKE_SHARE * (limits.tau_max + np.array([[1.0], [-1.0]]) * bias)
    down, up = np.minimum(limits.a_max, np.maximum(brake, MIN_BRAKE_SHARE * limits.tau_max) / np.diag(M))
    highest = np.minimum(limits.v_max, stopping_speed(limits.q_max - q, down, gains["dt"]))
    lowest = -np.minimum(limits.v_max, stopping_speed(q - limits.q_min, up, gains["dt"]))
    lower = np.concatenate([(lowest - v) / gains["dt"] - desired, -limits.tau_max - torque])
    upper = np.concatenate([(highest - v) / gains["dt"] - desired, limits.tau_max - torque])
    return H, M, lower, upper


def test_the_law_gives_the_torque_of_daqp_wherever_the_arm_is(six):
    """Also beyond its limits: in about half of these states, constraints contradict each other."""
    rng = np.random.default_rng(0)
    limits = replace(six.limits, tau_max=0.3 * six.limits.tau_max)
    arm = six.with_limits(limits)
    controller = armctl.ComputedTorqueQP(arm)
    law = controller.make_law(0.001, False)
    gains = controller._law_gains(0.001, False)
    far = np.full(six.n, UNBOUNDED)
    unlimited = _core.ComputedTorqueQP(
        arm.core_model.for_period(0.001, False),
        **gains | {"q_min": -far, "q_max": far, "v_max": far, "a_max": far, "torque_limit": far},
    )
    tau = np.zeros(six.n)
    torque = np.zeros(six.n)
    still = np.zeros(six.n)
    programs = 0
    at_limit = 0
    for _ in range(300):
        q = rng.uniform(-1.02, 1.02, six.n) * limits.q_max
        v = rng.normal(size=six.n) * rng.choice([0.1, 0.5, 1.2]) * limits.v_max
        q_ref = q + rng.normal(size=six.n) * rng.choice([1e-3, 0.1, 1.0])
        for each, result in ((law, tau), (unlimited, torque)):
            each.torque(q, v, np.array([q_ref, still, still, still, still]), np.zeros(0), result)
        program = program_at(arm, gains, q, v, torque)
        programs += bool((program[2] > 0.0).any() or (program[3] < 0.0).any())
        assert np.abs(tau - torque_of_daqp(program, torque, limits.tau_max)).max() <= 1e-7 * limits.tau_max.max()
        at_limit += bool((np.abs(tau) == limits.tau_max).any())
    assert programs > 200
    assert at_limit > 100
