"""Files survive kill -9, a full disk and two writers: the old file or the new one remains, complete, and a message names it.

The file runs itself as a program that forks: `python test_data_safety.py GROUP SEED FOLDER`.
"""

import io
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from arms import some_of

import armctl
from armctl.lab.comparison_html import write_comparison
from armctl.report.render.renderer import gl_context

KILLS = 2
LONGEST_DELAY_S = 0.5
READS = 20  # while two processes write
SAME_COLOR = 10.0  # of 255, any value of any frame; the two films differ by 121


def comparison(log: armctl.Log, path: Path) -> None:
    write_comparison([armctl.Report.from_log(log)], path.parent, "A motion")


def film(log: armctl.Log, path: Path) -> None:
    armctl.record(log, armctl.load("robot_arm_3dof"), path, size=(48, 48), speed=4.0)


def still(log: armctl.Log, path: Path) -> None:
    armctl.still(log, armctl.load("robot_arm_3dof"), path, size=(96, 64))


@cache
def motion(controller: str) -> armctl.JointTrajectory:
    arm = armctl.load("robot_arm_3dof")
    return armctl.move_j(arm, arm.home, arm.home + (0.1 if controller == "pd" else 0.2))


@cache
def reached(controller: str) -> armctl.Reachability:
    return armctl.reachability(armctl.load("robot_arm_3dof"), 0.4 if controller == "pd" else 0.5)


def small_study() -> armctl.Study:
    return armctl.Study(
        "trial", robot="robot_arm_3dof", controllers=["pd"], factors={"payload": armctl.Range(0.0, 0.2)}, samples=4
    )


@cache
def studied(controller: str) -> armctl.StudyResult:
    with TemporaryDirectory() as folder:
        samples = 2 if controller == "pd" else 4
        return replace(small_study(), samples=samples).run(folder=folder, progress=False)


WRITERS: dict[str, Callable[[armctl.Log, Path], object]] = {
    "run.npz": lambda log, path: log.save(path),
    "run.csv": lambda log, path: log.save(path),
    "run.parquet": lambda log, path: log.save(path),
    "run.mcap": lambda log, path: log.save(path),
    "motion.npz": lambda log, path: motion(log.controller).save(path),
    "motion.csv": lambda log, path: motion(log.controller).to_csv(path),
    "motion.yaml": lambda log, path: motion(log.controller).to_ros(path, 0.1),
    "reached.npz": lambda log, path: reached(log.controller).save(path),
    "study.parquet": lambda log, path: studied(log.controller).save(path),
    "study.csv": lambda log, path: studied(log.controller).save(path),
    "plot.png": lambda log, path: armctl.four_panels(log, path),
    "plot.svg": lambda log, path: armctl.overlay([log], path),
    "comparison.html": comparison,
    "comparison.json": comparison,
    "film.gif": film,
    "film.mp4": film,
    "still.png": still,
}


def two_logs() -> list[armctl.Log]:
    arm = armctl.load("robot_arm_3dof")
    return [armctl.simulate(arm, name, armctl.move_j(arm, arm.home, arm.home + 0.05)) for name in ("pd", "computed-torque")]


def survive_kills(path: Path, logs: list[armctl.Log], versions: list[bytes], rng: np.random.Generator) -> None:
    """Forked processes write two versions in turn and are killed at random moments."""
    write = WRITERS[path.name]
    for _ in range(KILLS):
        process = os.fork()
        if process == 0:
            while True:
                for log in reversed(logs):
                    write(log, path)
        time.sleep(LONGEST_DELAY_S * rng.random())
        os.kill(process, 9)
        os.waitpid(process, 0)
        assert is_one_of(path.read_bytes(), versions), "the file is neither the old one nor the new one"


def is_one_of(file: bytes, versions: list[bytes]) -> bool:
    """Whether a file is one of two. Encoded films may differ in the last bits of their colors, so their frames are compared."""
    if file in versions or file[4:8] != b"ftyp":
        return file in versions
    import av

    films = [
        np.array([frame.to_ndarray(format="rgb24") for frame in av.open(io.BytesIO(data)).decode(video=0)], float)
        for data in (file, *versions)
    ]
    return any(film.shape == films[0].shape and np.abs(film - films[0]).max() < SAME_COLOR for film in films[1:])


def survive_a_full_disk(path: Path, logs: list[armctl.Log], versions: list[bytes], rng: np.random.Generator) -> None:
    """A limit on the size of files stops the writer at the first byte and at a random one, as a full disk does."""
    import resource

    write = WRITERS[path.name]
    old = path.read_bytes()
    before = sorted(path.parent.iterdir())
    for limit in (0, int(rng.integers(1, min(map(len, versions))))):
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
        try:
            write(logs[1], path)
        except armctl.ArmctlError as error:
            message = str(error)
        else:
            message = "no error"
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        assert message.endswith(": cannot be written: File too large"), message
        assert str(path.with_suffix("")) in message
        assert path.read_bytes() == old, "the old file is damaged"
        assert sorted(path.parent.iterdir()) == before, "a temporary file is left"


def survive_two_writers(path: Path, logs: list[armctl.Log], versions: list[bytes], rng: np.random.Generator) -> None:
    """Two processes write one file all the time; whoever reads it finds the file of one of them."""
    write = WRITERS[path.name]
    writers = []
    for log in logs:
        process = os.fork()
        if process == 0:
            while True:
                write(log, path)
        writers.append(process)
    found = []
    for _ in range(READS):
        time.sleep(LONGEST_DELAY_S * rng.random() / READS)
        found.append(path.read_bytes())
    for process in writers:
        os.kill(process, 9)
        os.waitpid(process, 0)
    assert all(is_one_of(file, versions) for file in found), "the file is neither that of one nor of the other"


def whole_files(kind: str, logs: list[armctl.Log], folder: Path) -> list[bytes]:
    files = []
    for k, log in enumerate(logs):
        path = folder / str(k) / kind
        WRITERS[kind](log, path)
        files.append(path.read_bytes())
    assert files[0] != files[1]
    return files


GROUPS = {
    "logs": ["run.npz", "run.csv", "run.parquet", "run.mcap"],
    "motions and results": ["motion.npz", "motion.csv", "motion.yaml", "reached.npz", "study.parquet", "study.csv"],
    "plots and pages": ["plot.png", "plot.svg", "comparison.html", "comparison.json"],
    "films": ["film.gif", "film.mp4", "still.png"],
}
FIRST_TRIALS = (survive_a_full_disk, survive_kills)
TRIALS = {
    "logs": (*FIRST_TRIALS, survive_two_writers),
    "motions and results": (*FIRST_TRIALS, survive_two_writers),
    "plots and pages": FIRST_TRIALS,
    "films": FIRST_TRIALS,
}


def can_draw() -> bool:
    try:
        gl_context(16, 16).free()
    except armctl.NotInstalledError:
        return False
    return True


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
@pytest.mark.parametrize("group", some_of(GROUPS, [], ["logs"]))
def test_files_survive(tmp_path, group: str):
    if group == "films":
        pytest.importorskip("av", reason="no encoder")
        if not can_draw():
            pytest.skip("no OpenGL without a screen")
    command = [sys.executable, __file__, group, "1", str(tmp_path)]
    environment = os.environ | {"PYTHONPATH": ":".join(sys.path), "MPLBACKEND": "agg"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=environment)
    assert done.stdout.split() == GROUPS[group], done.stderr[-2000:]


FULL_DISK = """
import resource, sys, armctl
factors = {"payload": armctl.Range(0.0, 0.2)}
study = armctl.Study("trial", robot="robot_arm_3dof", controllers=["pd"], factors=factors, samples=64)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), resource.RLIM_INFINITY))
try:
    study.run(folder=sys.argv[1], progress=False)
except armctl.ArmctlError as error:
    print(error)
"""


@pytest.mark.skipif(os.name != "posix", reason="limits of POSIX")
@pytest.mark.parametrize("limit", some_of([0, 5000, 40_000], [], [5000]))
def test_a_study_on_a_full_disk_is_one_sentence_and_continues(tmp_path, limit: int):
    command = [sys.executable, "-c", FULL_DISK, str(tmp_path), str(limit)]
    environment = os.environ | {"PYTHONPATH": ":".join(sys.path)}
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=environment)
    assert "trial.sqlite: cannot be used: " in done.stdout, done.stderr[-2000:]
    assert "Traceback" not in done.stderr
    again = replace(small_study(), samples=64).run(folder=tmp_path, progress=False)
    assert again.ok
    assert len(again) == 64


if __name__ == "__main__":
    two = two_logs()
    for each in GROUPS[sys.argv[1]]:
        folder_of_kind = Path(sys.argv[3]) / each
        whole = whole_files(each, two, folder_of_kind)
        used = folder_of_kind / "used" / each
        WRITERS[each](two[0], used)
        for trial in TRIALS[sys.argv[1]]:
            trial(used, two, whole, np.random.default_rng(int(sys.argv[2])))
        print(each, flush=True)
