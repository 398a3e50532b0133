"""The stream in a process of its own: what becomes of the arm when the planner is killed, stopped, busy, or loses the link."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from arms import arm_of

import armctl
from armctl.run.links.process import RemoteHost

GOAL = [1.2, 0.3, -1.0]
PLANNER = f"""
import sys, armctl
arm = armctl.load("robot_arm_3dof")
link = armctl.links.PlantLink(arm, real_time=True, record=sys.argv[1], plant=armctl.Plant(timestep=0.004))
with armctl.Robot(arm, link, speed=0.5, tip_speed=0.5) as robot:
    print(*robot.arm.limits.a_max, *robot.arm.limits.j_max, flush=True)
    robot.move_j({GOAL})
"""
DT = 0.004


def rows_of(record: Path) -> tuple[np.ndarray, np.ndarray]:
    """The ticks and the positions of all rows that were sent."""
    rows = np.fromfile(record).reshape(-1, 4)
    return np.rint(rows[:, 0] / DT).astype(int), rows[:, 1:]


def wait_until(condition, seconds: float = 30.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def stopped_planner(record: Path, how: signal.Signals) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ends a planner in the middle of a move; its limits of acceleration and jerk, and the rows that were sent in all."""
    with subprocess.Popen([sys.executable, "-c", PLANNER, str(record)], stdout=subprocess.PIPE, text=True) as planner:
        assert planner.stdout is not None
        limits = np.array(planner.stdout.readline().split(), dtype=float)
        wait_until(lambda: record.stat().st_size > 40 * 4 * 8 and np.ptp(rows_of(record)[1][-2:]) > 1e-3)
        planner.send_signal(how)
        sizes = [0]

        def at_rest() -> bool:
            time.sleep(0.2)
            sizes.append(record.stat().st_size)
            return sizes[-1] == sizes[-2]

        wait_until(at_rest)
        planner.kill()
        return limits, *rows_of(record)


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "stopped"])
def test_without_a_planner_the_arm_brakes_on_its_path_within_the_limits_of_the_plan(tmp_path: Path, how: signal.Signals):
    record = tmp_path / "rows"
    limits, tick, q = stopped_planner(record, how)
    assert np.ptp(q[-10:], axis=0).max() == 0.0
    assert q[-1][0] < GOAL[0] - 0.01  # it did not go on to its goal
    start = arm_of("robot_arm_3dof").home
    along = (q - start) @ (np.array(GOAL) - start) / np.sum(np.square(np.array(GOAL) - start))
    assert np.abs(q - start - along[:, None] * (np.array(GOAL) - start)).max() < 1e-9  # the path of move_j is straight
    v = np.diff(q, axis=0) / (DT * np.diff(tick))[:, None]
    successive = np.diff(tick) == 1  # a busy machine loses ticks
    a = np.abs(np.diff(v, axis=0)[successive[1:] & successive[:-1]]) / DT
    assert len(a) > 20
    assert (a <= 1.001 * limits[:3]).all()
    fastest = int(np.abs(v).max(axis=1).argmax())
    ramp = (np.abs(v[fastest]) / limits[:3]).max() + (limits[:3] / limits[3:]).max()
    at_rest = int(np.flatnonzero(np.abs(v).max(axis=1))[-1]) + 1
    lease = 0.5 if how is signal.SIGSTOP else 0.0
    assert DT * (tick[at_rest] - tick[fastest]) <= lease + 1.05 * ramp + 0.2  # a word takes some time


class Cut(armctl.links.PlantLink):
    """Its cable is pulled at row 100."""

    def wait(self):
        if self.sent == 100:
            raise armctl.LinkError("connection reset by the robot")
        return super().wait()


def test_a_pulled_cable_is_a_fault():
    arm = arm_of("robot_arm_3dof")
    robot = armctl.Robot(arm, Cut(arm), speed=0.5, tip_speed=1.0)
    result = robot.move_j(GOAL)
    assert result.reason == "connection reset by the robot"
    assert len(result.log) == 100
    assert robot.move_j(GOAL).reason.startswith("connection reset by the robot; call robot.recover()")


def test_the_program_runs_through_the_process_and_a_busy_planner_changes_nothing():
    arm = arm_of("robot_arm_3dof")
    link = armctl.links.PlantLink(arm, real_time=True, plant=armctl.Plant(timestep=0.004))
    with armctl.Robot(arm, link, speed=0.5, tip_speed=1.0) as robot:
        result = robot.move_j([0.4, 0.2, -1.2])
        assert result, result.reason
        assert result.position_error < 1e-3
        center = robot.tip.position
        log = robot.follow(lambda t: center + 0.02 * np.sin([0.0, 2 * t, t]), duration=0.6)
        assert log.failure == "" or "sent nothing" in log.failure  # on a busy machine
        with pytest.raises(armctl.ModelError, match="gripper"):
            robot.gripper.open()
        process = robot._host._process
    assert process.returncode == 0


def test_a_late_planner_leaves_the_arm_at_rest_and_it_goes_on_or_says_why():
    arm = arm_of("robot_arm_3dof")
    link = armctl.links.PlantLink(arm, real_time=True, plant=armctl.Plant(timestep=0.004))
    with armctl.Robot(arm, link, speed=0.5, tip_speed=1.0) as robot:
        center = robot.tip.position

        def late(t: float) -> np.ndarray:
            if t > 0.2:
                time.sleep(1.0)
            return center + 0.05 * np.sin([0.0, 2 * t, t])

        log = robot.follow(late, duration=1.0)
        assert robot.late_ticks > 0 or "sent nothing for 0.5 s" in log.failure
        assert np.ptp(log.q_ref[-2:], axis=0).max() < 1e-4
        assert robot.fault == ""
        assert robot.move_j([0.2, 0.1, -1.4])


def test_the_death_of_the_process_is_a_fault():
    arm = arm_of("robot_arm_3dof")
    link = armctl.links.PlantLink(arm, real_time=True, plant=armctl.Plant(timestep=0.004))
    robot = armctl.Robot(arm, link)
    assert isinstance(robot._host, RemoteHost)
    os.kill(robot._host._process.pid, signal.SIGKILL)
    robot._host._process.wait()
    with pytest.raises(armctl.LinkError, match="make a new Robot"):
        robot.move_j([0.2, 0.1, -1.4])
    robot.close()


def test_an_answer_that_ctrl_c_left_behind_is_not_taken_for_the_next_one():
    arm = arm_of("robot_arm_3dof")
    with armctl.Robot(arm, armctl.links.PlantLink(arm, real_time=True)) as robot:
        host = robot._host
        assert isinstance(host, RemoteHost)
        connection = host._connection

        class Interrupted:
            """The connection, on which Ctrl-C comes before the answer."""

            send = staticmethod(connection.send)

            def poll(self, seconds: float) -> bool:
                raise KeyboardInterrupt

        host._connection = Interrupted()
        with pytest.raises(KeyboardInterrupt):
            host.stop("enough")
        host._connection = connection
        assert host.poll().tick == -1
        assert robot.move_j([0.2, 0.1, -1.1])


def test_what_the_maker_raises_in_the_process_is_one_sentence():
    arm = arm_of("robot_arm_3dof")
    link = armctl.links.PlantLink(arm, real_time=True, record="/proc/no-such-folder/rows")
    with pytest.raises(armctl.LinkError, match="FileNotFoundError"):
        armctl.Robot(arm, link)


def test_the_command_line_checks_a_robot(capsys):
    from armctl.cli.main import main

    status = main(["robot", "check", "here", "--link", "plant", "--duration", "0.3"])
    said = capsys.readouterr().out
    assert "tip of the model 0.000 mm from that of the robot" in said
    assert "ticks lost" in said
    assert (status == 0) == said.endswith(": ok\n")
    assert main(["robot", "check", "/dev/null", "--link", "so101", "--model", "robot_arm_3dof"]) == 2
