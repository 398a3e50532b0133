"""Damaged files: a log or a trajectory loads and is usable, or one sentence says why not, whatever bytes the file contains."""

import io
import json
import math
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest

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
        return (
            array.astype([np.float32, np.int64, complex, "U5", bool][rng.integers(5)])
            if array.dtype.kind == "f"
            else np.zeros(2)
        )
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
