"""The link to a Franka Research 3, on franky-sim, a simulator of its controller; it knows no faults and no limits."""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from arms import HELPERS, arm_of

import armctl
from armctl.run.links.franka import FR3, FR3_TORQUE

pytestmark = pytest.mark.full
pytest.importorskip("pylibfranka")
pytest.importorskip("franky_sim")
HAND = """<mujoco model="hand"><worldbody><body name="hand">
<geom type="box" size="0.03 0.1 0.03" pos="0 0 0.03" mass="0.73"/><site name="tool_tip" pos="0 0 0.1034"/>
</body></worldbody></mujoco>"""
SOMEWHERE = [-0.3, 0.1, 0.3, -1.6, 0.1, 1.8, 0.7]


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """The simulated controller on an address of this test process: its ports are fixed."""
    worker = os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")
    host = f"127.0.7.{1 + int(worker)}"
    command = [sys.executable, str(HELPERS / "franky_server.py"), host]
    usual = os.getpriority(os.PRIO_PROCESS, 0)
    with contextlib.suppress(PermissionError):  # controller and stream must run each millisecond, also beside other tests
        os.setpriority(os.PRIO_PROCESS, 0, usual - 10)
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as server:
        assert server.stdout is not None
        assert server.stdout.readline() == "ready\n"
        yield host
        server.kill()
    os.setpriority(os.PRIO_PROCESS, 0, usual)


@pytest.fixture(scope="module")
def arm(address: str, tmp_path_factory) -> armctl.Arm:
    """The model with the tool that the simulated controller has set, a hand of 103.4 mm; without it, it is refused."""
    bare = arm_of("fr3")
    with pytest.raises(armctl.LinkError, match=r"103\.4 mm from the tip that the robot computes"):
        armctl.Robot(bare, armctl.links.Franka(address, real_time=False))
    folder = tmp_path_factory.mktemp("tool")
    (folder / "hand.xml").write_text(HAND)
    return armctl.load("fr3", tool=folder / "hand.xml")


def test_moves_reach_their_targets_and_the_hand_moves(address: str, arm: armctl.Arm):
    with armctl.Robot(arm, armctl.links.Franka(address, real_time=False), speed=0.5, tip_speed=0.5) as robot:
        assert robot.state.q.shape == (7,)
        moves = [
            lambda: robot.move_j(arm.home),
            lambda: robot.move_j(SOMEWHERE),
            lambda: robot.move_to([0.45, 0.2, 0.4]),
            lambda: robot.move_l(armctl.Pose(robot.tip.position + np.array([0.0, 0.0, 0.1]), robot.tip.quat)),
            lambda: robot.move_j(arm.home),
        ]
        for move in moves:
            result = move()
            assert result, result.reason
            assert result.position_error < 2e-3
            assert np.isfinite(result.log.tau).all()
        far = robot.move_l(armctl.Pose([1.5, 0.0, 0.2], robot.tip.quat))
        assert "%" in far.reason
        assert robot.gripper.open()
        nothing = robot.gripper.grasp(20.0)
        assert not nothing
        assert nothing.reason.startswith("closed on nothing")


@pytest.mark.parametrize("law", ["pd-gravity", "computed-torque"])
def test_a_law_moves_the_robot_by_torques_and_the_log_has_them(address: str, arm: armctl.Arm, law: str):
    torque = replace(FR3_TORQUE, adds_friction=False, delay=1e-3)  # the simulated controller adds gravity only
    link = armctl.links.Franka(address, real_time=False, torque=torque)
    with armctl.Robot(arm, link, speed=0.3, tip_speed=0.5, controller=law) as robot:
        for goal in (arm.home, SOMEWHERE, arm.home):
            result = robot.move_j(goal)
            assert result.position_error < 3e-3
            assert result or (law == "pd-gravity" and "from the target" in result.reason)  # friction that it does not know
            log = result.log
            assert (log.controller, log.torques) == (law, "both")
            assert np.abs(log.q - log.q_ref).max() < 0.05
            assert np.median(np.abs(log.tau - log.tau_cmd).max(axis=1)) < 0.3
    with armctl.Robot(arm, armctl.links.Franka(address, real_time=False), speed=0.3) as robot:
        assert robot.move_j(SOMEWHERE)  # by its own servo, from where the law left it


def test_what_is_planned_passes_the_check_and_full_limits_do_not():
    arm = arm_of("fr3")
    rng = np.random.default_rng(1)
    for _ in range(20):
        q = arm.limits.random(arm.home, 2, rng)
        full = armctl.move_j(arm, *q)
        rows = full.sample(1e-3 * np.arange(int(1e3 * full.duration) + 2)).q
        assert FR3.refusal(rows, rows[:1].repeat(3, axis=0), 1e-3) != ""


def test_no_robot_at_the_address_is_one_sentence():
    with pytest.raises(armctl.LinkError, match=r"127\.0\.7\.250: cannot be opened: "):
        armctl.Robot(arm_of("fr3"), armctl.links.Franka("127.0.7.250", real_time=False))


def test_a_wrong_argument_is_refused():
    with pytest.raises(armctl.InputError, match="host"):
        armctl.links.Franka("")
    with pytest.raises(armctl.InputError, match="payload"):
        armctl.links.Franka("127.0.0.1", payload=-1.0)
