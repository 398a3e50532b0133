"""Damaged files: what a file holds loads and is usable, or one sentence says why not, whatever bytes the file contains."""

import io
import json
import math
import re
import shutil
import warnings
import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from arms import arm_of
from synthetic import FIRST, SECOND, THIRD, TOOL, urdf

import armctl
from armctl import InputError, JointTrajectory, Log, Reachability, Report, Simulation

CASES = 150
HOSTILE = [
    None,
    True,
    -1,
    0,
    1e308,
    -1e308,
    math.nan,
    math.inf,
    10**400,
    "",
    "x",
    "x" * 3000,
    [],
    [1],
    ["a"],
    {},
    {"a": 1},
    [[]],
    "\ud800",
]


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("whole")
    arm = armctl.load("robot_arm_3dof")
    sim = Simulation(arm)
    motion = armctl.move_j(arm, arm.home, arm.home + 0.1)
    log = sim.run(motion)
    log.save(folder / "log.npz")
    motion.save(folder / "trajectory.npz")
    armctl.reachability(arm, 0.3).save(folder / "reachability.npz")
    return {name: (folder / f"{name}.npz").read_bytes() for name in USES}


def use_log(path: Path) -> None:
    log = Log.load(path)
    report = Report.from_log(log)
    json.loads(json.dumps(report.to_dict()))
    assert str(report)
    assert armctl.table([report])


def use_trajectory(path: Path) -> None:
    motion = JointTrajectory.load(path)
    assert math.isfinite(motion.duration)
    assert motion.duration >= 0
    for column in motion.sample(np.linspace(0, motion.duration, 20))[:3]:
        assert np.isfinite(column).all()
    motion.check_limits()


def use_reachability(path: Path) -> None:
    reached = Reachability.load(path)
    assert str(reached)
    json.loads(json.dumps(reached.to_dict()))
    assert np.isfinite(reached.cloud()[0]).all()


USES = {"log": use_log, "trajectory": use_trajectory, "reachability": use_reachability}


def damaged_bytes(whole: bytes, rng: np.random.Generator) -> bytes:
    data = bytearray(whole)
    kind = rng.integers(5)
    if kind == 0:
        return bytes(data[: rng.integers(len(data))])
    if kind == 1:
        return rng.bytes(int(rng.integers(2000)))
    if kind == 2:
        at = int(rng.integers(len(data)))
        return bytes(data[:at] + rng.bytes(int(rng.integers(1, 100))) + data[at:])
    # Most of the bytes are compressed data; the names, sizes and flags of the archive are near its end.
    first = 0 if kind == 3 else max(0, len(data) - 1500)
    for at in rng.integers(first, len(data), rng.integers(1, 8)):
        data[at] = rng.integers(256)
    return bytes(data)


def damaged_header(whole: bytes, rng: np.random.Generator) -> bytes:
    """A sound archive whose members have damaged bytes, mostly in their NumPy headers."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(whole)) as old, zipfile.ZipFile(out, "w") as new:
        names = old.namelist()
        chosen = names[rng.integers(len(names))]
        for name in names:
            data = bytearray(old.read(name))
            if name == chosen:
                for at in rng.integers(0, min(len(data), 128), rng.integers(1, 6)):
                    data[at] = rng.choice([rng.integers(256), 48, 57, 40, 41, 92, 39])
            new.writestr(name, bytes(data))
    return out.getvalue()


def wrong_meaning(whole: bytes, rng: np.random.Generator) -> bytes:
    """A sound archive with sound arrays that do not mean what they should."""
    with np.load(io.BytesIO(whole), allow_pickle=False) as data:
        arrays = {name: data[name] for name in data.files}
    name = list(arrays)[rng.integers(len(arrays))]
    if "meta" in arrays and rng.random() < 0.4:
        meta = json.loads(str(arrays["meta"]))
        key = list(meta)[rng.integers(len(meta))]
        kind = rng.integers(3)
        if kind == 0:
            del meta[key]
        else:
            meta[key if kind == 1 else "unknown"] = HOSTILE[rng.integers(len(HOSTILE))]
        arrays["meta"] = np.array(json.dumps(meta))
    else:
        arrays[name] = changed(arrays[name], rng)
        if arrays[name] is None:
            del arrays[name]
    out = io.BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()


def changed(array: np.ndarray, rng: np.random.Generator):
    kind = rng.integers(9)
    if kind == 0:
        return None
    if kind == 1:
        return array[..., None]
    if kind == 2:
        return array[:-1] if array.ndim else np.zeros(3)
    if kind == 3:
        if array.dtype.kind != "f":
            return np.zeros(2)
        with np.errstate(invalid="ignore"):  # of numbers that are not finite
            return array.astype([np.float32, np.int64, complex, "U5", bool][rng.integers(5)])
    if kind == 4:
        return array[::-1] if array.ndim else np.array("")
    if kind == 5:
        return np.array(HOSTILE[rng.integers(2, 8)])
    if kind == 6:
        return np.zeros((0,) * array.ndim)
    if array.dtype.kind != "f" or not array.size:
        return np.full(array.shape, np.nan)
    out = array.copy()
    out.flat[rng.integers(out.size, size=rng.integers(1, 5))] = [math.nan, math.inf, 1e300, -1e300, -1.0, 0.0][rng.integers(6)]
    return out


DAMAGES = {"bytes": damaged_bytes, "headers": damaged_header, "meaning": wrong_meaning}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("kind", USES)
def test_a_damaged_file_is_usable_or_rejected_in_one_sentence(files, tmp_path, fuzz_cases, kind: str, damage: str):
    path = tmp_path / f"{kind}.npz"
    messages = []
    for rng in fuzz_cases(CASES):
        path.write_bytes(DAMAGES[damage](files[kind], rng))
        try:
            with warnings.catch_warnings():
                for kind_of_warning in (SyntaxWarning, DeprecationWarning):  # NumPy's, for a header with a backslash
                    warnings.simplefilter("ignore", kind_of_warning)
                USES[kind](path)
        except InputError as error:
            messages.append(str(error))
    assert len(messages) > CASES / 4, "the damage does no harm"
    assert max(map(len, messages)) <= 400
    assert not any("\n" in message for message in messages)


@pytest.mark.parametrize("kind", USES)
def test_the_whole_file_is_usable(files, tmp_path, kind: str):
    path = tmp_path / f"{kind}.npz"
    path.write_bytes(files[kind])
    USES[kind](path)


NUMBERS = [
    b"0",
    b"-1",
    b"nan",
    b".inf",
    b"1e308",
    b"1e-320",
    b"9" * 400,
    b"",
    b"x",
    b"[]",
    b"{}",
    b"null",
    b"true",
    b"\xff",
    b"- -",
    b"*a",
]
OTHER_CASES = 40


@pytest.fixture(scope="module")
def other_files(tmp_path_factory) -> dict[str, bytes]:
    """Files of other formats, by their names."""
    folder = tmp_path_factory.mktemp("other")
    arm = armctl.load("robot_arm_3dof")
    motion = armctl.move_j(arm, arm.home, arm.home + 0.1)
    motion.to_ros(folder / "ros.yaml", 0.1)
    motion.to_ros(folder / "ros.json", 0.1)
    log = Simulation(arm).run(motion)
    log.save(folder / "log.csv")
    log.save(folder / "log.parquet")
    result = study().run(folder=folder, progress=False)
    result.save(folder / "study.parquet")
    (folder / "arm.xacro").write_text(XACRO)
    return {name: (folder / name).read_bytes() for name in OTHER_USES}


XACRO = (
    urdf(FIRST, SECOND, THIRD, TOOL)
    .replace("<robot", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"', 1)
    .replace("</robot>", '<xacro:property name="mass" value="${2 * 0.5}"/></robot>')
)


def study() -> armctl.Study:
    factors = {"payload": armctl.Range(0.0, 0.2)}
    return armctl.Study("study", robot="robot_arm_3dof", controllers=["pd"], factors=factors, samples=2)


def use_ros(path: Path) -> None:
    motion = JointTrajectory.from_ros(path, arm_of("robot_arm_3dof"))
    assert math.isfinite(motion.duration)
    for column in motion.sample(np.linspace(0, motion.duration, 20))[:3]:
        assert np.isfinite(column).all()


def use_store(path: Path) -> None:
    for result in (study().result(path.parent), study().run(folder=path.parent, progress=False)):
        assert str(result)
        assert str(result.summary())
    assert result.ok


def use_study(path: Path) -> None:
    result = armctl.StudyResult.load(path)
    assert str(result)
    with suppress(armctl.ArmctlError):  # runs may be missing
        assert str(result.summary())


def use_model(path: Path) -> None:
    arm = armctl.load(path)
    assert np.isfinite(arm.fk(arm.home).position).all()


OTHER_USES = {
    "ros.yaml": use_ros,
    "ros.json": use_ros,
    "log.csv": use_log,
    "log.parquet": use_log,
    "study.sqlite": use_store,
    "study.parquet": use_study,
    "arm.xacro": use_model,
}


def damaged_text(whole: bytes, rng: np.random.Generator) -> bytes:
    """One to three numbers or words replaced, or lines deleted or repeated."""
    data = whole
    for _ in range(rng.integers(1, 4)):
        found = list(re.finditer(rb"-?\d+\.?\d*|\w+", data))
        lines = data.split(b"\n")
        k = int(rng.integers(len(lines)))
        kind = rng.integers(4)
        if kind < 2 and found:
            match = found[rng.integers(len(found))]
            data = data[: match.start()] + NUMBERS[rng.integers(len(NUMBERS))] + data[match.end() :]
        elif kind == 2:
            data = b"\n".join(lines[:k] + lines[k + 1 :])
        else:
            data = b"\n".join(lines[: k + 1] + lines[k:])
    return data


@pytest.mark.parametrize("name", OTHER_USES)
def test_a_damaged_file_of_any_format_is_usable_or_rejected_in_one_sentence(
    other_files, tmp_path, fuzz_cases, monkeypatch, name: str
):
    if name == "arm.xacro":
        pytest.importorskip("xacrodoc")
        monkeypatch.chdir(tmp_path)
    messages = []
    for case, rng in enumerate(fuzz_cases(OTHER_CASES)):
        folder = tmp_path / str(case)
        folder.mkdir()
        path = folder / name
        damage = damaged_text if rng.random() < 0.6 else damaged_bytes
        path.write_bytes(damage(other_files[name], rng))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # of armctl, and of MuJoCo about the damaged model
                OTHER_USES[name](path)
        except armctl.ArmctlError as error:
            messages.append(str(error))
        except Exception as error:
            raise AssertionError(f"case {case}: {type(error).__name__}: {error}") from error
        shutil.rmtree(folder)
    assert len(messages) > OTHER_CASES / 8, "the damage does no harm"
    assert max(map(len, messages)) <= 400
    assert not any("\n" in message for message in messages)
