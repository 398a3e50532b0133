"""Random motions on franka-sim, which enforces the limits of Franka's controller: `make franka-sim` runs this.

A command that the controller refuses although the check passed it is a fault of the check, unless ticks were lost meanwhile:
the controller then continues the last rows, and the row after the gap is a step. The checks of its server are therefore also
asked without a network.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import mujoco_menagerie as menagerie
import numpy as np
import pytest
from arms import HELPERS, arm_of

import armctl

DT = 1e-3  # s, Franka's tick
PYTHON = Path(os.environ.get("FRANKA_SIM_PYTHON", Path(__file__).parents[3] / ".franka-sim" / "bin" / "python"))
ADDRESS = "127.0.9.1"
MOTIONS = 30  # at each speed
COMMAND_REFUSED = "joint_motion_generator"
LOST_BY_THE_CONTROLLER = "communication_constraints"

pytestmark = pytest.mark.skipif(not PYTHON.is_file(), reason="`make franka-sim` makes the environment of the simulator")


@pytest.fixture(scope="module")
def address():
    pytest.importorskip("pylibfranka")
    arm_of("fr3")  # skips where its model is not installed
    model = menagerie.get("franka_fr3").path() / "fr3.xml"
    command = [PYTHON, HELPERS / "franka_sim_server.py", ADDRESS]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | {"FR3_MJCF": str(model)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment) as server:
        assert server.stdout is not None
        assert server.stdout.readline() == "ready\n"
        yield ADDRESS
        server.kill()


@pytest.mark.parametrize("speed", [0.3, 0.8])
def test_no_command_is_refused_that_the_check_passed(address: str, speed: float):
    arm = armctl.load("fr3", tip="fr3_link7")  # the simulator's end effector
    rng = np.random.default_rng(0)
    refused = []
    known: set[str] = set()  # the simulator repeats the errors of earlier motions
    without_loss = 0
    with armctl.Robot(arm, armctl.links.Franka(address, real_time=False), speed=speed, tip_speed=3.0) as robot:
        low = robot.arm.limits.q_min + 0.1
        high = robot.arm.limits.q_max - 0.1
        for _ in range(MOTIONS):
            lost = robot.lost_ticks
            result = robot.move_j(np.clip(arm.limits.random(arm.home, 1, rng)[0], low, high))
            late = LOST_BY_THE_CONTROLLER in result.reason or result.reason.endswith("late")
            if robot.lost_ticks == lost and result.log is not None and len(result.log) and not late:
                without_loss += 1
                new = [name for name in re.findall(r"\w+_\w+", result.reason) if name not in known]
                known.update(new)
                if new and new[0].startswith(COMMAND_REFUSED):
                    refused.append(result.reason)
            if robot.fault:
                robot.recover()
    print(f"speed {speed}: {without_loss} of {MOTIONS} motions without a lost tick, {len(refused)} refused", file=sys.stderr)
    assert without_loss > 0, "every motion lost a tick: the computer is too busy for this test"
    assert refused == []


def judged(streams: list[np.ndarray], folder: Path) -> list[str]:
    """What the simulator's checks say of streams whose rows are never late."""
    np.savez(folder / "streams.npz", *streams)
    command = [PYTHON, HELPERS / "franka_sim_judge.py", folder / "streams.npz"]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    output = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
    return output.splitlines()


def streams_of(speed: float, count: int, seed: int) -> list[np.ndarray]:
    """(T, 7) rad each, the rows of random motions that our check passes."""
    arm = arm_of("fr3")
    link = armctl.links.PlantLink(arm, armctl.Plant(timestep=DT), envelope=armctl.links.Franka.envelope)
    robot = armctl.Robot(arm, link, speed=speed, tip_speed=3.0)
    rng = np.random.default_rng(seed)
    streams = []
    while len(streams) < count:
        result = robot.move_j(robot.arm.limits.random(arm.home, 1, rng)[0])
        if result.log is not None and len(result.log):
            assert result, result.reason
            streams.append(result.log.q_ref)
    return streams


@pytest.mark.parametrize("speed", [0.3, 0.8])
def test_without_a_network_its_checks_pass_what_ours_pass(speed: float, tmp_path: Path):
    assert judged(streams_of(speed, 60, seed=7), tmp_path) == ["passed"] * 60


def test_without_a_network_its_checks_and_ours_refuse_the_same(tmp_path: Path):
    envelope = armctl.links.Franka.envelope
    assert envelope is not None
    faster = [stream[::ticks] for stream in streams_of(0.3, 40, seed=8) for ticks in (2, 3)]
    ours = [not envelope.refusal(stream[1:], np.repeat(stream[:1], 3, axis=0), DT) for stream in faster]
    theirs = [line == "passed" for line in judged(faster, tmp_path)]
    assert ours == theirs
    assert 0 < sum(ours) < len(ours)
