"""Wrong calls across the library: each is one clear sentence of armctl's own, and on the command line exit status 2."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from arms import arm_of

import armctl
from armctl.cli.main import main
from armctl.core.log import Log
from armctl.plan.motion.move_cartesian import move_path
from armctl.run.execution.recorder import MOST_TICKS


@cache
def arm() -> armctl.Arm:
    return arm_of("robot_arm_3dof")


@cache
def motion() -> armctl.Trajectory:
    return armctl.move_j(arm(), arm().home, arm().home + 0.1)


CALLS: dict[str, tuple[Callable[[], object], str]] = {
    "an arm's name": (lambda: armctl.simulate("panda", "pd", motion()), "arm: expected Arm, got 'panda'; armctl.load"),  # type: ignore
    "no controller": (lambda: armctl.simulate(arm(), None, motion()), "controller: None has no method torque"),  # type: ignore
    "a class": (lambda: armctl.simulate(arm(), armctl.PD, motion()), "has no method torque.*armctl.PD.arm. has"),  # type: ignore
    "no motion": (lambda: armctl.simulate(arm(), "pd", None), "trajectory: None is not a trajectory"),  # type: ignore
    "a position": (lambda: armctl.simulate(arm(), "pd", arm().home), "trajectory: array.* is not a trajectory"),  # type: ignore
    "a plant's name": (lambda: armctl.simulate(arm(), "pd", motion(), "friction"), "plant: expected Plant, got 'friction'"),  # type: ignore
    "a plant's name to Simulation": (lambda: armctl.Simulation(arm(), plant=3), "plant: expected Plant, got 3"),  # type: ignore
    "days": (
        lambda: armctl.simulate(arm(), "pd", motion(), dwell=1e9),
        f"ticks of .* s, at most {MOST_TICKS:,} fit into a log",
    ),
    "a motion to report": (lambda: armctl.Report.from_log(motion()), "log: expected Log, got .*; armctl.simulate"),  # type: ignore
    "a motion to identify": (lambda: armctl.identify_payload(arm(), motion()), "log: expected Log, got .*"),  # type: ignore
    "nothing to compare": (lambda: armctl.compare(arm(), [], motion()), "a list of at least one of each"),
    "one name to compare": (lambda: armctl.compare(arm(), "pd", motion()), "a list of at least one of each"),
    "a pose for a path": (lambda: move_path(arm(), arm().home, armctl.Pose([0, 0, 1])), "path: expected a list of .* got Pose"),  # type: ignore
    "one number for a path": (
        lambda: armctl.Simulation(arm()).move_path(np.array(1.0)),
        "path: expected a list of lines, .* got array",
    ),
    "one number in allow": (
        lambda: armctl.move_free(arm(), arm().home, arm().home, allow=np.array(1.0)),
        "allow: expected pairs of names, got array",
    ),
    "a number for a name": (lambda: armctl.World().add(3, armctl.Box([1, 1, 1]), [0, 0, 0]), "name: expected str, got 3"),  # type: ignore
    "complex joints": (lambda: arm().fk(arm().home + 1j), "q: array.* is not an array of numbers"),
    "a huge integer": (lambda: arm().fk([0, 0, 10**400]), "q: .* is not an array of numbers"),
    "an arm's name to a controller": (
        lambda: armctl.PD(arm().name),
        "arm: expected Arm, got 'robot_arm_3dof'; armctl.load.'robot_arm_3dof'",
    ),  # type: ignore
    "an arm's name to computed torque": (lambda: armctl.ComputedTorque(arm().name), "arm: expected Arm, got .*; armctl.load"),  # type: ignore
    "an arm's name to a motion": (lambda: armctl.move_j(arm().name, [0, 0, 0], [0, 0, 0]), "arm: expected Arm, got .*"),  # type: ignore
    "an arm's name to a line": (lambda: armctl.move_l(arm().name, [0, 0, 0], [0, 0, 0]), "arm: expected Arm, got .*"),  # type: ignore
    "a position to check": (lambda: armctl.check_torque(arm(), arm().home), "trajectory: .* is not a trajectory"),  # type: ignore
    "an arm's name to identify": (lambda: armctl.identify_payload(arm().name, None), "arm: expected Arm, got .*"),  # type: ignore
    "an arm's name to excite": (lambda: armctl.excitation(arm().name), "arm: expected Arm, got .*"),  # type: ignore
    "a position to run": (lambda: armctl.Simulation(arm()).run([0, 0, 0]), "trajectory: .* is not a trajectory; armctl.move_j"),  # type: ignore
    "a report before any move": (
        lambda: armctl.Report.from_log(armctl.Simulation(arm()).log),
        "got None; .* every move of a Sim",
    ),  # type: ignore
    "no time to follow": (
        lambda: armctl.Simulation(arm()).follow(lambda t: [0.3, 0.0, 0.5], duration=0.0),
        r"duration: expected a number at least 0\.00",
    ),
    "an arm's name to the cycles of the standard": (lambda: armctl.iso9283_cycles(arm().name), "arm: expected Arm, got .*"),  # type: ignore
    "filters in an array": (
        lambda: armctl.TorqueFilter(arm(), armctl.PD(arm()), np.array(1.0)),  # type: ignore
        "filters: .* is no filter; armctl.Notch",
    ),
    "rows of many lengths": (
        lambda: armctl.Impedance(arm(), error_max=[[1.0], [1.0, 2.0]]),
        "error_max: .* is not an array of numbers",
    ),
    "angles after a point": (
        lambda: armctl.Simulation(arm()).move_to([0.3, 0.2, 0.3, 3.14, 0.0, 0.0]),
        r"target: expected 3 numbers, got 6; Pose\(point, rpy=angles\) adds angles",
    ),
    "no path": (lambda: move_path(arm(), arm().home, None), "path: expected a list of .* got None"),  # type: ignore
}


@pytest.mark.parametrize("name", CALLS)
def test_a_wrong_call_is_one_clear_sentence(name: str):
    call, sentence = CALLS[name]
    with pytest.raises(armctl.InputError, match=sentence) as caught:
        call()
    assert "\n" not in str(caught.value)


class Unprintable:
    def __repr__(self) -> str:
        raise RuntimeError("no text")


NAMES: dict[str, tuple[Callable[[], object], str]] = {
    "a body to follow": (lambda: armctl.Simulation(arm()).follow("\ud800"), "unknown body "),
    "a tip": (lambda: armctl.load("robot_arm_3dof", tip="\ud800"), "unknown site, body or geom "),
    "a body in allow": (
        lambda: armctl.move_free(arm(), arm().home, arm().home, allow=[("\ud800", "x")]),
        "unknown body or geom in allow ",
    ),
    "an array for a tip": (lambda: arm().fk(arm().home, [0.0, 1.0]), "tip of robot_arm_3dof: "),  # type: ignore
    "no gripper's tip": (
        lambda: armctl.Simulation(arm()).gripper_at(Unprintable()),
        "tip of robot_arm_3dof: an object of type Unprintable is not a name",
    ),  # type: ignore
}


@pytest.mark.parametrize("name", NAMES)
def test_a_text_that_cannot_be_a_name_is_an_unknown_name(name: str):
    call, sentence = NAMES[name]
    with pytest.raises(armctl.UnknownNameError, match=f"^{sentence}"):
        call()


@pytest.mark.parametrize("timestep", [0.0, -1.0, np.nan])
def test_a_time_step_that_was_changed_to_no_time_is_refused(timestep: float):
    changed = armctl.load("robot_arm_3dof")
    changed.model.opt.timestep = timestep
    for call in (lambda: armctl.Simulation(changed), lambda: armctl.simulate(changed, "pd", motion())):
        with pytest.raises(armctl.InputError, match=r"^model\.opt\.timestep: expected"):
            call()


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return armctl.simulate(arm(), "pd", motion()).save(tmp_path / "log.npz")


def test_a_file_that_is_half_a_log_is_no_log(log: Path):
    content = log.read_bytes()
    for part in (content[: len(content) // 2], b"", b"hello"):
        log.write_bytes(part)
        with pytest.raises(armctl.InputError, match="no log that armctl wrote"):
            Log.load(log)


def test_a_log_whose_columns_differ_in_length_is_no_log(log: Path):
    with np.load(log) as data:
        columns = dict(data)
    np.savez(log, allow_pickle=False, **(columns | {"q": columns["q"][:3]}))
    with pytest.raises(armctl.InputError, match="float64 of shape"):
        Log.load(log)


LINES = {
    "reach robot_arm_3dof --out FILE": "FILE/log.npz: cannot be written: File exists",
    "reach robot_arm_3dof --out FILE/run": "FILE/run/log.npz: cannot be written: Not a directory",
    "simulate robot_arm_3dof --ctrl 0 0 0 --out FILE": "FILE/log.npz: cannot be written: File exists",
    "simulate robot_arm_3dof --ctrl 0 0 0 --duration 1e9": "fit into a log",
    "compare robot_arm_3dof --controllers ,": "expected a list of at least one of each",
    "compare robot_arm_3dof --threads 0": "threads: expected a number at least 1, got 0",
    "info FILE": "FILE: the name of a model ends in .xml or .urdf",
    "info FOLDER": "FOLDER: a folder, not an .xml or .urdf file",
    "info ./nothing": "known names; `armctl robots` lists them",
    "info robot_arm_3dof --tool nothing": "unknown tool 'nothing'",
}


@pytest.mark.parametrize("line", LINES)
def test_a_wrong_line_is_one_clear_sentence_and_status_2(line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "file").write_text("taken")
    here = {"FILE": str(tmp_path / "file"), "FOLDER": str(tmp_path)}
    words, sentence = line, LINES[line]
    for word, path in here.items():
        words, sentence = words.replace(word, path), sentence.replace(word, path)
    assert main(words.split()) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert sentence in said[-1]
    assert said[-1].startswith("armctl: ")
