"""sim.step: one tick at a time, for loops that callers write themselves."""

from dataclasses import replace

import numpy as np
import pytest
from motions import Still, Sway
from synthetic import limb, mjcf, motors

import armctl
from armctl import ComputedTorque, InputError, Plant, Push, Simulation, SimulationError
from armctl.core.trajectory import Setpoint, TickReference
from armctl.run.execution.recorder import ticks_for

PLANTS = {
    "nominal": Plant(),
    "payload and friction": Plant(payload=0.5, coulomb_friction=0.1),
    "delay and noise": Plant(delay=2, encoder_noise=1e-4, velocity_noise=1e-3),
    "a push": Plant(pushes=Push(0.05, 0.1, force=[0.0, 5.0, 0.0])),
    "continuous": Plant(continuous=True),
    "another tick": Plant(timestep=1e-3),
}


@pytest.fixture
def two_joints(load) -> armctl.Arm:
    return load(limb("a b", '<site name="tip" pos="0.1 0 0"/>'), motors("a b"))


def stepped(sim: Simulation, motion: armctl.Trajectory) -> armctl.Log:
    """The log of a loop around `sim.step` that does what `sim.run` does."""
    controller = ComputedTorque(sim.arm)
    reference = TickReference.from_trajectory(motion, sim.dt, ticks_for(motion.duration, sim.dt), sim.state.continuous)
    state = sim.measured_state
    for row in zip(*reference, strict=True):
        state = sim.step(controller.torque(state, Setpoint(*row)))
    assert sim.log is not None
    return sim.log


@pytest.mark.parametrize("name", PLANTS)
def test_a_loop_of_steps_with_a_controllers_torque_is_a_run_to_the_bit(bundled: armctl.Arm, name: str):
    motion = Sway(bundled)
    run = Simulation(bundled, plant=PLANTS[name]).run(motion)
    steps = stepped(Simulation(bundled, plant=PLANTS[name]), motion)
    assert len(run) > 100
    for column in ("t", "q", "v", "tau", "tau_cmd", "qpos", "tip"):
        assert np.array_equal(getattr(run, column), getattr(steps, column)), column


def test_a_step_without_a_torque_holds_the_last_reference(bundled: armctl.Arm):
    sim = Simulation(bundled)
    sim.move_j([0.3, 0.2, -0.4])
    for _ in range(100):
        state = sim.step()
    assert np.abs(state.q - [0.3, 0.2, -0.4]).max() < 1e-9
    assert sim.log is not None
    assert len(sim.log) == 100
    assert sim.log.controller == "computed-torque"
    assert np.array_equal(sim.log.q_ref, np.tile(sim.log.q_ref[0], (100, 1)))
    assert armctl.Report.from_log(sim.log).ok


def test_a_step_returns_the_state_after_the_tick_and_the_log_has_the_one_before(bundled: armctl.Arm):
    sim = Simulation(bundled)
    before = sim.state
    after = sim.step([5.0, 0.0, 0.0])
    assert after.t == pytest.approx(sim.dt)
    assert np.array_equal(after.q, sim.state.q)
    assert not np.array_equal(after.q, before.q)
    assert np.array_equal(sim.log.q, [before.q])
    assert np.array_equal(sim.log.tau_cmd, [[5.0, 0.0, 0.0]])
    assert sim.log.controller == "external"
    assert sim.log.is_open_loop


def test_a_torque_beyond_the_motor_is_limited_and_the_log_shows_both(bundled: armctl.Arm):
    sim = Simulation(bundled)
    sim.step([1e4, 0.0, 0.0])
    assert sim.log.tau_cmd[0, 0] == 1e4
    assert sim.log.tau[0, 0] == pytest.approx(bundled.limits.tau_max[0])


def test_the_next_move_starts_where_steps_with_a_torque_left_the_arm(bundled: armctl.Arm):
    sim = Simulation(bundled)
    for _ in range(50):
        sim.step([20.0, 0.0, 0.0])
    reached = sim.state.q
    assert abs(reached[0]) > 0.01
    result = sim.move_j(bundled.home)
    assert result.ok
    assert np.abs(result.log.q_ref[0] - reached).max() < 1e-12


def test_the_log_covers_the_steps_since_the_last_run_or_reset(bundled: armctl.Arm):
    sim = Simulation(bundled)
    for _ in range(3):
        sim.step()
    assert len(sim.log) == 3
    sim.run(armctl.move_j(bundled, bundled.home, bundled.home))
    assert len(sim.log) == 1
    sim.step()
    sim.step()
    assert len(sim.log) == 2
    sim.reset()
    assert len(sim.log) == 2
    sim.step()
    assert len(sim.log) == 1


def test_many_steps_are_all_in_the_log(two_joints: armctl.Arm):
    sim = Simulation(two_joints)
    states = [sim.step() for _ in range(2500)]
    assert len(sim.log) == 2500
    assert np.array_equal(sim.log.q[1:], [state.q for state in states[:-1]])
    assert np.array_equal(sim.log.t, sim.dt * np.arange(2500))


@pytest.mark.parametrize(
    ("torque", "sentence"),
    [
        ([1.0], "torque: expected 3 numbers, got 1"),
        ([np.nan, 0, 0], r"torque: element \[0\] is nan"),
        (["1", "2", "3"], "torque: .* is not an array of numbers"),
        ([1j, 0, 0], "torque: .* is not an array of numbers"),
        (5.0, "torque: expected .*got a single number"),
    ],
)
def test_a_wrong_torque_is_one_sentence_and_nothing_is_simulated(bundled: armctl.Arm, torque, sentence: str):
    sim = Simulation(bundled)
    with pytest.raises(InputError, match=sentence):
        sim.step(torque)
    assert sim.state.t == 0.0
    assert sim.log is None


def test_a_step_that_diverges_raises_with_the_log_and_only_reset_helps(tmp_path):
    path = tmp_path / "light.xml"
    path.write_text(
        mjcf(limb("a").replace('mass="0.5"', 'mass="1e-6"').replace("range=", 'limited="false" range='), motors("a"))
    )
    arm = armctl.load(path)
    sim = Simulation(arm)
    with pytest.raises(SimulationError, match=r"diverged at .* s: a moves at") as caught:
        [sim.step(arm.limits.tau_max) for _ in range(10_000)]
    assert caught.value.log is sim.log
    assert 0 < len(sim.log) < 10_000
    assert "diverged" in sim.log.failure
    with pytest.raises(SimulationError, match=r"call reset\(\) to start again"):
        sim.step()
    assert "reset()" in sim.move_j(arm.home).reason
    sim.reset()
    assert sim.step().t == pytest.approx(sim.dt)


def test_a_viewer_sees_steps_at_its_own_interval(bundled: armctl.Arm):
    class Counting:
        interval = 0.01

        def __init__(self):
            self.seconds = []

        def after_reset(self, data):
            pass

        def before_run(self):
            pass

        def after_ticks(self, data, seconds):
            self.seconds.append(seconds)

    from armctl.core import hooks

    watching, opened = Counting(), hooks.open_viewer
    hooks.open_viewer = lambda arm: watching
    try:
        sim = Simulation(bundled, viewer=True)
    finally:
        hooks.open_viewer = opened
    for _ in range(25):
        sim.step()
    assert watching.seconds == pytest.approx([0.01] * 5)


def test_a_controller_that_foresees_its_reference_holds_as_in_a_run(bundled: armctl.Arm):
    arm = bundled
    weak = arm.with_limits(replace(arm.limits, tau_max=0.3 * arm.limits.tau_max))
    sim = armctl.Simulation(weak, armctl.MPC(weak))
    sim.reset(v=[1.0, -1.0, 1.0])
    for _ in range(100):
        sim.step()
    stepped = sim.log.tau_cmd
    sim.reset(v=[1.0, -1.0, 1.0])
    held = sim.run(Still(arm.home, 0.0), dwell=100 * sim.dt)
    assert np.array_equal(stepped, held.tau_cmd[:100])
