"""The file formats of a log: npz, Parquet and CSV. All three contain the whole log.

A log in a file is arrays over time and "facts": everything else, as JSON. `Log.load` checks what they mean.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from armctl.core import units
from armctl.core.errors import InputError, NotInstalledError
from armctl.core.validation import Array

PER_JOINT = ("q", "v", "q_ref", "v_ref", "a_ref", "tau", "tau_cmd")
# Arrays that a log may lack, with the names of their columns if they have a fixed number.
_OPTIONAL: dict[str, tuple[str, ...]] = {"qpos": (), "wrench": ("fx", "fy", "fz", "tx", "ty", "tz")}
_AXES = {"tip": "xyz", "tip_quat": "wxyz", "tip_ref": "xyz", "tip_ref_quat": "wxyz"}
_UNIT_RATES = {"q": "", "v": "/s", "q_ref": "", "v_ref": "/s", "a_ref": "/s^2"}
_CSV_MARK = "# armctl log "  # begins the first line of a CSV; the facts follow
_PARQUET_KEY = b"armctl log"
_MAX_CSV_BYTES = 4_000_000_000


class Content(NamedTuple):
    """What a file of a log holds.

    Attributes:
        arrays: The arrays of the log by name; those over time have a row per tick.
        facts: Everything else by name, such as it is in JSON.
    """

    arrays: dict[str, Array]
    facts: dict[str, Any]


class Column(NamedTuple):
    """One column of a flat table: the array of the log and the place in it, its name and its unit."""

    array: str
    place: int
    name: str
    unit: str


def widths(arrays: Mapping[str, Array]) -> dict[str, int]:
    """The number of columns of each optional array that a log has."""
    return {name: arrays[name].shape[1] for name in _OPTIONAL if len(arrays[name])}


def columns(joint_names: Sequence[str], joint_units: Sequence[str], optional: Mapping[str, int]) -> list[Column]:
    """The columns of a flat table: "t", "q/joint1", ..., "tip/x", ..., "qpos/0"; `optional` as from `widths`."""
    torque_units = units.of_torque(joint_units)
    out = [Column("t", 0, "t", "s")]
    for array in PER_JOINT:
        for i, joint in enumerate(joint_names):
            unit = f"{joint_units[i]}{_UNIT_RATES[array]}" if array in _UNIT_RATES else torque_units[i]
            out.append(Column(array, i, f"{array}/{joint}", unit))
    for array, axes in _AXES.items():
        unit = "" if array.endswith("quat") else "m"
        out += [Column(array, i, f"{array}/{axis}", unit) for i, axis in enumerate(axes)]
    for array, width in optional.items():
        for i in range(width):
            axis = _OPTIONAL[array][i] if _OPTIONAL[array] else str(i)
            out.append(Column(array, i, f"{array}/{axis}", _unit_of_wrench(axis) if array == "wrench" else ""))
    return out


def _unit_of_wrench(axis: str) -> str:
    return "N" if axis.startswith("f") else "N m"


def flat(arrays: Mapping[str, Array], layout: Sequence[Column]) -> dict[str, Array]:
    """The arrays over time as vectors by the names of their columns."""
    out = {}
    for column in layout:
        values = arrays[column.array]
        out[column.name] = values if values.ndim == 1 else values[:, column.place]
    return out


def save(path: Path, content: Content) -> None:
    """Writes a file in the format of its file extension."""
    WRITERS[path.suffix](path, content)


def load(path: Path) -> Content:
    """Reads a file in the format of its file extension.

    Raises:
        InputError: Another file extension, or no log that armctl wrote; what damaged bytes raise otherwise depends on the
            format.
        NotInstalledError: A Parquet file, and pyarrow is not installed.
    """
    if path.suffix not in _READERS:
        raise InputError(f"it ends in {path.suffix!r:.20}, expected one of {', '.join(_READERS)}")
    return _READERS[path.suffix](path)


def _save_npz(path: Path, content: Content) -> None:
    np.savez_compressed(path, allow_pickle=False, meta=np.array(json.dumps(content.facts)), **content.arrays)


def _load_npz(path: Path) -> Content:
    with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
        arrays = {k: data[k] for k in data.files if k != "meta"}
        facts = json.loads(str(data["meta"]))
    if not isinstance(facts, dict):
        raise InputError("its head is not a table")
    return Content(arrays, facts)


def _save_csv(path: Path, content: Content) -> None:
    facts, layout = _tabular(content)
    table = np.column_stack(list(flat(content.arrays, layout).values()))
    with path.open("w", newline="", encoding="utf-8") as file:
        file.write(f"{_CSV_MARK}{json.dumps(facts)}\n")
        writer = csv.writer(file)
        writer.writerow([column.name for column in layout])
        writer.writerows(table.tolist())


def _load_csv(path: Path) -> Content:
    if path.stat().st_size > _MAX_CSV_BYTES:
        raise InputError(f"it is larger than {_MAX_CSV_BYTES / 1e9:g} GB")
    with path.open(encoding="utf-8", newline="") as file:
        first = file.readline(_MAX_CSV_BYTES)
        if not first.startswith(_CSV_MARK):
            raise InputError("Log.from_csv reads recordings of other programs")
        facts = json.loads(first.removeprefix(_CSV_MARK))
        header = next(csv.reader(file), [])
        body = file.read()
    table = np.loadtxt(io.StringIO(body), delimiter=",", ndmin=2) if body.strip() else np.zeros((0, len(header)))
    return _untabular(facts, header, table.T)


def _save_parquet(path: Path, content: Content) -> None:
    arrow, parquet = _pyarrow()
    facts, layout = _tabular(content)
    fields = [arrow.field(column.name, arrow.float64(), metadata={"unit": column.unit}) for column in layout]
    schema = arrow.schema(fields, metadata={_PARQUET_KEY: json.dumps(facts)})
    table = arrow.table([arrow.array(column) for column in flat(content.arrays, layout).values()], schema=schema)
    # Neighbouring samples differ little: their bytes, stream by stream, are what zstd compresses best.
    how = {"use_byte_stream_split": True, "use_dictionary": False, "write_statistics": False}
    buffer = arrow.BufferOutputStream()
    parquet.write_table(table, buffer, compression="zstd", **how)
    path.write_bytes(buffer.getvalue())  # Python reports a full disk in the usual words, pyarrow does not


def _load_parquet(path: Path) -> Content:
    _, parquet = _pyarrow()
    table = parquet.read_table(path, memory_map=False)
    metadata = table.schema.metadata or {}
    if _PARQUET_KEY not in metadata:
        raise InputError("its metadata contain no log")
    return _untabular(json.loads(metadata[_PARQUET_KEY]), table.column_names, [each.to_numpy() for each in table.columns])


def _pyarrow() -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise NotInstalledError.of_extra("Parquet files need pyarrow", "study") from None
    return pyarrow, pyarrow.parquet


def _tabular(content: Content) -> tuple[dict[str, Any], list[Column]]:
    """The facts, with the arrays that are not over time among them, and the columns of the arrays over time."""
    arrays = content.arrays
    optional = widths(arrays)
    layout = columns(content.facts["joint_names"], content.facts["units"], optional)
    over_time = {column.array for column in layout} | set(_OPTIONAL)
    constant = {name: values.tolist() for name, values in arrays.items() if name not in over_time}
    return {**content.facts, "arrays": constant, "optional": optional}, layout


def _untabular(facts: Any, header: Sequence[str], table: Sequence[Any] | Array) -> Content:
    """The inverse of `_tabular` and `flat`."""
    if not isinstance(facts, dict) or not isinstance(facts.get("arrays"), dict):
        raise InputError("its head is not a table")
    constant = facts.pop("arrays")
    optional = facts.pop("optional")
    if not all(isinstance(width, int) and 0 <= width <= len(header) for width in optional.values()):
        raise InputError("its columns are not counted")
    layout = columns(facts["joint_names"], facts["units"], optional)
    if [column.name for column in layout] != list(header) or len(table) != len(header):
        raise InputError("its columns are not those of its joints")
    names = dict.fromkeys(column.array for column in layout)
    arrays: dict[str, list[Array]] = {name: [] for name in names}
    for column, values in zip(layout, table, strict=True):
        arrays[column.array].append(np.asarray(values))
    stacked = {name: np.column_stack(parts) for name, parts in arrays.items()}
    stacked["t"] = stacked["t"][:, 0]
    for name in _OPTIONAL.keys() - stacked.keys():
        stacked[name] = np.zeros((0, len(_OPTIONAL[name])))
    return Content(stacked | {name: np.array(values, dtype=np.float64) for name, values in constant.items()}, facts)


WRITERS: dict[str, Callable[[Path, Content], None]] = {".npz": _save_npz, ".parquet": _save_parquet, ".csv": _save_csv}
_READERS: dict[str, Callable[[Path], Content]] = {".npz": _load_npz, ".parquet": _load_parquet, ".csv": _load_csv}
