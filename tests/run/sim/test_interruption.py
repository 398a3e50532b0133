"""Runs that end early, by Ctrl-C or a failing controller: what was recorded stays, and the simulation can go on."""

import os
import subprocess
import sys
import textwrap

import numpy as np
import pytest
from synthetic import limb, mjcf, motors

import armctl
from armctl import ComputedTorque, InputError, Simulation, SimulationError

GOAL = [0.5, 0.5, -1.0]


class Failing(ComputedTorque):
    """Computed torque that raises an exception from a time on, until it is repaired."""

    def __init__(self, arm: armctl.Arm, error: BaseException, after: float = 0.1):
        super().__init__(arm)
        self.error = error
        self.after = after
        self.is_broken = True

    def torque(self, state, setpoint):
        if self.is_broken and state.t > self.after - 1e-9:
            raise self.error
        return super().torque(state, setpoint)


COMMANDS = {
    "run": lambda sim: sim.run(armctl.move_j(sim.arm, sim.arm.home, GOAL)),
    "move_j": lambda sim: sim.move_j(GOAL),
    "move_to": lambda sim: sim.move_to([0.4, -0.1, 0.3]),
    "move_l": lambda sim: sim.move_l(sim.tip.position + np.array([0.0, 0.1, 0.0])),
    "follow": lambda sim: sim.follow(lambda t: [0.4, 0.1 * t, 0.3], duration=1.0),
    "step": lambda sim: [sim.step() for _ in range(100)],
}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("error", [KeyboardInterrupt(), ZeroDivisionError("division by zero")], ids=lambda e: type(e).__name__)
def test_the_log_contains_what_was_recorded_and_the_next_command_continues(bundled: armctl.Arm, command: str, error):
    controller = Failing(bundled, error)
    sim = Simulation(bundled, controller)
    with pytest.raises((KeyboardInterrupt, SimulationError)) as caught:
        COMMANDS[command](sim)
    assert sim.log is not None
    assert len(sim.log) == 50
    assert sim.log.q.shape == (50, 3)
    assert np.isfinite(sim.log.q).all()
    assert np.isfinite(sim.log.tau).all()
    if isinstance(error, KeyboardInterrupt):
        assert sim.log.failure == "interrupted at 0.100 s by KeyboardInterrupt"
    else:
        assert sim.log.failure == "the controller computed-torque failed at 0.100 s: division by zero"
        assert caught.value.log is sim.log
    controller.is_broken = False
    result = sim.move_to([0.3, 0.2, 0.3])
    assert result.ok, result
    assert result.log.failure == ""


def test_the_simulation_can_be_reset_after_an_interruption(bundled: armctl.Arm):
    controller = Failing(bundled, KeyboardInterrupt())
    sim = Simulation(bundled, controller)
    with pytest.raises(KeyboardInterrupt):
        sim.move_j(GOAL)
    sim.reset()
    controller.is_broken = False
    again = sim.move_j(GOAL)
    fresh = Simulation(bundled).move_j(GOAL)
    assert np.array_equal(again.log.q, fresh.log.q)


def test_ctrl_c_leaves_all_ticks_until_then(tmp_path):
    """A real SIGINT in another process, in the middle of a long motion."""
    script = tmp_path / "script.py"
    script.write_text(
        textwrap.dedent(
            """
            import signal, sys, threading, os, time
            signal.signal(signal.SIGINT, signal.default_int_handler)
            import numpy as np
            import armctl
            arm = armctl.load("robot_arm_3dof")
            sim = armctl.Simulation(arm)
            sim.move_j(arm.home)
            def interrupt():
                while sim.data.time < 5.0:
                    time.sleep(0.001)
                os.kill(os.getpid(), signal.SIGINT)
            threading.Thread(target=interrupt, daemon=True).start()
            try:
                sim.run(armctl.move_j(arm, arm.home, [0.5, 0.5, -1.0]), dwell=1000.0)
            except KeyboardInterrupt:
                print(len(sim.log), bool(np.isfinite(sim.log.q).all()), repr(sim.log.failure))
                print(sim.move_to([0.3, 0.2, 0.3]).ok, sim.data.time > 5.0)
            """
        )
    )
    run = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=300, env=os.environ, check=False)
    assert run.returncode == 0, run.stderr
    first, second = run.stdout.splitlines()
    count, finite, failure = first.split(maxsplit=2)
    assert int(count) > 2000
    assert finite == "True"
    assert failure.startswith("'interrupted at ")
    assert second == "True True"


def test_a_failing_gripper_move_leaves_its_ticks(tmp_path):
    finger = (
        '<body name="{0}"><joint name="{0}" type="slide" axis="0 {1} 0" range="0 0.04" armature="0.05" damping="1"/>'
        '<geom type="box" size="0.01 0.004 0.02" pos="0 {2} 0.06" mass="0.02"/></body>'
    )
    fingers = finger.format("left", 1, 0.004) + finger.format("right", -1, -0.004)
    path = tmp_path / "gripper.xml"
    grip = '<position joint="left" kp="200" kv="20" ctrlrange="0 0.04"/>'
    equality = '<equality><joint joint1="left" joint2="right" polycoef="0 1 0 0 0"/></equality>'
    path.write_text(
        mjcf(limb("a b", fingers + '<site name="grasp" pos="0 0 0.06"/>'), motors("a b grip", grip=grip) + equality)
    )
    arm = armctl.load(path)
    controller = Failing(arm, ZeroDivisionError("division by zero"))
    sim = Simulation(arm, controller)
    with pytest.raises(SimulationError, match=r"failed at 0\.10\d s: division by zero") as caught:
        sim.gripper.move(0.03)
    assert caught.value.log is sim.log
    controller.is_broken = False
    result = sim.gripper.move(0.03)
    assert type(bool(result)) is bool
    assert result.ok is True


@pytest.mark.parametrize("bad", [None, ["a", "b", "c"], np.zeros(3) * 1j, np.zeros(4), np.zeros((3, 2)), 1.0, [True] * 3])
def test_a_torque_that_is_no_vector_of_numbers_is_an_error_with_the_log(bundled: armctl.Arm, bad):
    class Wrong(ComputedTorque):
        def torque(self, state, setpoint):
            return bad if state.t > 0.05 else super().torque(state, setpoint)

    with pytest.raises(SimulationError, match=r"failed at 0\.05\d s: (torque: |could not broadcast)") as caught:
        armctl.simulate(bundled, Wrong(bundled), armctl.move_j(bundled, bundled.home, GOAL))
    assert len(caught.value.log) > 20


def test_lists_and_integers_are_good_torques(bundled: armctl.Arm):
    class Listing(ComputedTorque):
        def torque(self, state, setpoint):
            return [0, 1, 2]

    log = armctl.simulate(bundled, Listing(bundled), armctl.move_j(bundled, bundled.home, bundled.home), dwell=0.01)
    assert np.array_equal(log.tau_cmd, np.tile([0.0, 1.0, 2.0], (len(log), 1)))


def test_a_motion_of_another_arm_is_rejected_and_the_simulation_stays_usable(bundled: armctl.Arm, load):
    other = load(limb("a b c"), motors("a b c"))
    shorter = load(limb("a b"), motors("a b"))
    sim = Simulation(bundled)
    for arm, sentence in ((other, "planned for the joints a, b, c, but"), (shorter, "planned for the joints a, b, but")):
        motion = armctl.move_j(arm, arm.home, arm.home + 0.1)
        with pytest.raises(InputError, match=sentence):
            sim.run(motion)
        with pytest.raises(InputError, match=sentence):
            armctl.simulate(bundled, "pd", motion)
    assert sim.log is None
    assert sim.move_to([0.3, 0.2, 0.3])


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda sim: sim.follow(5), "target: 5 is neither the name of a body nor a function of the time"),
        (lambda sim: sim.follow(lambda t: [1, 2]), "target: expected 3 numbers, got 2"),
        (lambda sim: sim.follow(duration=-1), "duration: expected .*got -1"),
        (lambda sim: sim.follow(duration=1e12), "at most 10,000,000 fit into a log"),
        (lambda sim: sim.run(armctl.move_j(sim.arm, sim.arm.home, GOAL), dwell=1e9), "at most 10,000,000 fit into a log"),
        (lambda sim: sim.run(armctl.move_j(sim.arm, sim.arm.home, GOAL), dwell="1"), "dwell: '1' is not a number"),
        (lambda sim: sim.move_to([9, 9, 9], speed=0), "speed: expected .*got 0"),
        (lambda sim: sim.move_j(GOAL, speed=1.5), "speed: expected .*got 1.5"),
        (lambda sim: sim.move_path(3), "path: expected a list of lines, arcs, poses or points, got 3"),
        (lambda sim: setattr(sim, "controller", 3), "controller: 3 has no method torque"),
    ],
)
def test_a_wrong_command_is_one_sentence_and_changes_nothing(bundled: armctl.Arm, call, sentence: str):
    sim = Simulation(bundled)
    with pytest.raises(InputError, match=sentence) as caught:
        call(sim)
    assert len(str(caught.value)) <= 400
    assert sim.state.t == 0.0
    assert sim.move_to([0.3, 0.2, 0.3])
