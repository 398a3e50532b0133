"""Every loader refuses a file that is larger than what it reads, before the memory is taken."""

import io
import struct
import tracemalloc
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

import armctl

MAX_MEMORY_BYTES = 10e6
MAX_TEXT_BYTES = {"motion.yaml": 450e6, "robot.urdf": 250e6, "study.toml": 30e6}  # which are read up to the limit


def sparse(path: Path) -> None:
    """Five gigabytes that take no space on the disk."""
    with path.open("wb") as file:
        file.truncate(5 * 10**9)


def archive(path: Path) -> None:
    """An archive that names a size of four gigabytes, in its directory, for each of its two arrays."""
    with zipfile.ZipFile(path, "w") as file:
        for name in ("a.npy", "b.npy"):
            file.writestr(name, b"")
    whole = bytearray(path.read_bytes())
    place = -1
    while (place := whole.find(b"PK\x01\x02", place + 1)) >= 0:
        whole[place + 24 : place + 28] = struct.pack("<I", 2**32 - 2)
    path.write_bytes(whole)


@cache
def empty_table() -> bytes:
    arrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    columns = [arrow.nulls(1_100_000)] * 1000
    file = io.BytesIO()
    parquet.write_table(arrow.table(columns, names=[f"c{i}" for i in range(1000)]), file, write_statistics=False)
    return file.getvalue()


def table(path: Path) -> None:
    """A table of a thousand columns with a million rows, which is small as a file."""
    path.write_bytes(empty_table())


LOADERS: dict[str, tuple[Callable[[Path], None], Callable[[Path, armctl.Arm], object]]] = {
    "log.npz": (archive, lambda path, arm: armctl.Log.load(path)),
    "log.csv": (sparse, lambda path, arm: armctl.Log.load(path)),
    "recording.csv": (sparse, lambda path, arm: armctl.Log.from_csv(path)),
    "log.parquet": (table, lambda path, arm: armctl.Log.load(path)),
    "motion.npz": (archive, lambda path, arm: armctl.JointTrajectory.load(path)),
    "motion.yaml": (sparse, lambda path, arm: armctl.JointTrajectory.from_ros(path, arm)),
    "map.npz": (archive, lambda path, arm: armctl.Reachability.load(path)),
    "study.toml": (sparse, lambda path, arm: armctl.Study.from_file(path)),
    "study.parquet": (table, lambda path, arm: armctl.StudyResult.load(path)),
    "robot.urdf": (sparse, lambda path, arm: armctl.load(path)),
}


@pytest.mark.parametrize("name", LOADERS)
def test_a_file_that_is_too_large_is_refused_in_one_sentence(bundled, tmp_path, name: str):
    write, read = LOADERS[name]
    path = tmp_path / name
    write(path)
    tracemalloc.start()
    try:
        with pytest.raises(armctl.ArmctlError, match=rf"{name}.* it is larger than \d+ MB$"):
            read(path, bundled)
        assert tracemalloc.get_traced_memory()[1] < MAX_TEXT_BYTES.get(name, MAX_MEMORY_BYTES)
    finally:
        tracemalloc.stop()
