"""The link to an SO-101, on a simulated bus of servos in a process of its own."""

import json
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from arms import HELPERS, arm_of
from synthetic import Shape, serial_arm

import armctl

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
COUNTS = 4096 / (2 * np.pi)
START = np.array([2100, 1900, 2300, 2000, 2048])


class Bus:
    """The process of the servos."""

    def __init__(self) -> None:
        command = [sys.executable, str(HELPERS / "servo_bus.py"), *map(str, START)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        self.port = self.process.stdout.readline().strip()

    def say(self, words: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{words}\n")
        self.process.stdin.flush()

    def servos(self) -> np.ndarray:
        """Position, greatest speed, torque switch and goal of each servo."""
        assert self.process.stdout is not None
        self.say("show")
        return np.array(json.loads(self.process.stdout.readline()))


@pytest.fixture
def bus() -> Iterator[Bus]:
    process = Bus()
    with process.process:
        yield process
        process.process.kill()


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> armctl.Arm:
    shape = Shape(0.1, 0.3, 10.0, range="-1.9 1.9", joint='damping="0.1" armature="0.02"', joints=5, home="0 0.3 0.6 0.3 0")
    with warnings.catch_warnings(action="ignore", category=armctl.ArmctlWarning):
        return serial_arm(tmp_path_factory.mktemp("so101"), shape, shapes="visual")


@pytest.fixture
def calibration(tmp_path) -> Path:
    return write_calibration(tmp_path / "arm.json")


def write_calibration(path: Path, **changes) -> Path:
    rows = {
        name: {"id": i + 1, "drive_mode": 0, "homing_offset": 100, "range_min": 810, "range_max": 3286, **changes}
        for i, name in enumerate(JOINTS)
    }
    path.write_text(json.dumps(rows))
    return path


def angles(counts: np.ndarray) -> np.ndarray:
    return (counts - 2048) / COUNTS


@pytest.mark.full
def test_a_move_and_a_chunk_of_targets_end_where_they_lead(bus: Bus, arm: armctl.Arm, calibration: Path):
    with armctl.Robot(arm, armctl.links.SO101(arm, bus.port, calibration), speed=0.6, tip_speed=0.5) as robot:
        assert robot.state.q == pytest.approx(angles(START), abs=2e-3)
        result = robot.move_j([0.2, 0.2, 0.5, 0.2, 0.1], avoid=True)
        assert result, result.reason
        assert np.isnan(result.log.tau).all()
        assert angles(bus.servos()[:, 0]) == pytest.approx([0.2, 0.2, 0.5, 0.2, 0.1], abs=5e-3)
        rows = angles(bus.servos()[:, 0]) + np.linspace(0.0, 0.2, 20)[:, None]
        with robot.streaming() as run:  # one chunk has no deadline after its start, which a busy computer would miss
            run.stream.push_chunk(0.05 * np.arange(1, 21), rows)
            assert run.advance(run.stream.time_left) == ""
        assert angles(bus.servos()[:, 0]) == pytest.approx(rows[-1], abs=2e-2)  # the servos settle
    assert (bus.servos()[:, 2] == 1).all()  # the torque stays on: the arm would fall


def test_the_torque_is_switched_on_where_the_joints_are(bus: Bus, arm: armctl.Arm, calibration: Path):
    armctl.Robot(arm, armctl.links.SO101(arm, bus.port, calibration)).close()
    servos = bus.servos()
    assert servos[:, 3] == pytest.approx(START)
    assert servos[:, 1].max() < 50  # counts/s; 2000 towards the goal that was left in the servo


def test_a_blocked_joint_holds_where_it_is(bus: Bus, arm: armctl.Arm, calibration: Path):
    with armctl.Robot(arm, armctl.links.SO101(arm, bus.port, calibration), speed=0.6, tip_speed=0.5) as robot:
        bus.say("block 1 60")
        result = robot.move_j(angles(START) + np.array([0.9, 0.0, 0.0, 0.0, 0.0]))
        assert result.reason.endswith("is blocked; the arm holds where it is")
        servos = bus.servos()
        assert servos[0, 3] == pytest.approx(servos[0, 0], abs=2)
        assert (servos[:, 2] == 1).all()
        assert "recover" in robot.move_j(angles(START)).reason
        robot.recover()
        assert robot.move_j(angles(START))


def test_a_garbled_answer_is_asked_for_again(bus: Bus, arm: armctl.Arm, calibration: Path):
    with armctl.Robot(arm, armctl.links.SO101(arm, bus.port, calibration)) as robot:
        bus.say("garble 2")
        assert robot.move_j(angles(START) + 0.05)
        bus.say("garble 99")
        with pytest.raises(armctl.LinkError, match="servo 1 does not answer"):
            robot.move_j(angles(START))


def test_a_bus_that_falls_silent_is_a_fault(bus: Bus, arm: armctl.Arm, calibration: Path):
    with armctl.Robot(arm, armctl.links.SO101(arm, bus.port, calibration)) as robot:
        bus.say("mute")
        with pytest.raises(armctl.LinkError, match="does not answer"):
            robot.move_j([0.2, 0.2, 0.5, 0.2, 0.1])


def test_without_a_calibration_that_fits_nothing_is_opened(bus: Bus, arm: armctl.Arm, tmp_path: Path):
    with pytest.raises(armctl.InputError, match="run lerobot-calibrate"):
        armctl.links.SO101(arm, bus.port, tmp_path / "missing.json")
    (tmp_path / "bad.json").write_text("no json")
    with pytest.raises(armctl.InputError, match="no JSON"):
        armctl.links.SO101(arm, bus.port, tmp_path / "bad.json")
    (tmp_path / "large.json").write_text("{" + " " * 10**6 + "}")
    with pytest.raises(armctl.InputError, match="it is larger than 1 MB"):
        armctl.links.SO101(arm, bus.port, tmp_path / "large.json")
    with pytest.raises(armctl.InputError, match="shoulder_pan has the id 300; ids of servos are from 0 to 253"):
        armctl.links.SO101(arm, bus.port, write_calibration(tmp_path / "id.json", id=300))
    with pytest.raises(armctl.InputError, match="no row 'shoulder_pan'"):
        armctl.links.SO101(arm, bus.port, write_calibration(tmp_path / "infinite.json", range_max=np.inf))
    (tmp_path / "empty.json").write_text("{}")
    with pytest.raises(armctl.InputError, match="no row 'shoulder_pan'"):
        armctl.links.SO101(arm, bus.port, tmp_path / "empty.json")
    with pytest.raises(armctl.InputError, match=r"shoulder_pan travels 0\.77 rad"):
        armctl.links.SO101(arm, bus.port, write_calibration(tmp_path / "narrow.json", range_min=1800, range_max=2300))
    other = armctl.links.SO101(arm, bus.port, write_calibration(tmp_path / "other.json", homing_offset=-40))
    with pytest.raises(armctl.LinkError, match="homing offset 100, the calibration file -40"):
        armctl.Robot(arm, other)
    assert (bus.servos()[:, 2] == 0).all()


def test_another_arm_or_no_port_is_refused(arm: armctl.Arm, calibration: Path):
    with pytest.raises(armctl.InputError, match="has 3 joints, an SO-101 has 5"):
        armctl.links.SO101(arm_of("robot_arm_3dof"), "/dev/null", calibration)
    with pytest.raises(armctl.LinkError, match="cannot be opened"):
        armctl.Robot(arm, armctl.links.SO101(arm, "/dev/no-such-port", calibration))
