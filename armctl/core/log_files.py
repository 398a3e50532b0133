"""The file formats of a log: npz, Parquet and CSV. All three contain the whole log.

A log in a file is arrays over time and "facts": everything else, as JSON. `Log.load` checks what they mean.
"""

import csv
import io
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from armctl.core.errors import InputError
from armctl.core.file_reading import check_size, pyarrow, read_npz, read_parquet
from armctl.core.log_columns import QUANTITIES, LogColumn, columns, flat, widths
from armctl.core.validation import Array

_CSV_MARK = "# armctl log "  # begins the first line of a CSV; the facts follow
_PARQUET_KEY = b"armctl log"
_MAX_BYTES = 4_000_000_000  # unpacked: two hours of seven joints at 1 kHz


class LogContent(NamedTuple):
    """What a file of a log holds: its arrays, those over time with a row per tick, and everything else as it is in JSON."""

    arrays: dict[str, Array]
    facts: dict[str, Any]


def save(path: Path, content: LogContent) -> None:
    WRITERS[path.suffix](path, content)


def load(path: Path) -> LogContent:
    """Reads a file in the format of its file extension; what damaged bytes raise depends on the format."""
    if path.suffix not in _READERS:
        raise InputError(f"it ends in {path.suffix!r:.20}, expected one of {', '.join(_READERS)}")
    return _READERS[path.suffix](path)


def _save_npz(path: Path, content: LogContent) -> None:
    np.savez_compressed(path, allow_pickle=False, meta=np.array(json.dumps(content.facts)), **content.arrays)


def _load_npz(path: Path) -> LogContent:
    arrays = read_npz(path, _MAX_BYTES)
    facts = json.loads(str(arrays.pop("meta")))
    if not isinstance(facts, dict):
        raise InputError("its head is not a table")
    return LogContent(arrays, facts)


def _save_csv(path: Path, content: LogContent) -> None:
    facts, layout = _tabular(content)
    table = np.column_stack(list(flat(content.arrays, layout).values()))
    with path.open("w", newline="", encoding="utf-8") as file:
        file.write(f"{_CSV_MARK}{json.dumps(facts)}\n")
        writer = csv.writer(file)
        writer.writerow([column.name for column in layout])
        writer.writerows(table.tolist())


def _load_csv(path: Path) -> LogContent:
    check_size(path.stat().st_size, _MAX_BYTES)
    with path.open(encoding="utf-8", newline="") as file:
        first = file.readline(_MAX_BYTES)
        if not first.startswith(_CSV_MARK):
            raise InputError("Log.from_csv reads recordings of other programs")
        facts = json.loads(first.removeprefix(_CSV_MARK))
        header = next(csv.reader(file), [])
        body = file.read()
    table = np.loadtxt(io.StringIO(body), delimiter=",", ndmin=2) if body.strip() else np.zeros((0, len(header)))
    return _untabular(facts, header, table.T)


def _save_parquet(path: Path, content: LogContent) -> None:
    arrow, parquet = pyarrow()
    facts, layout = _tabular(content)
    fields = [arrow.field(column.name, arrow.float64(), metadata={"unit": column.unit}) for column in layout]
    schema = arrow.schema(fields, metadata={_PARQUET_KEY: json.dumps(facts)})
    table = arrow.table([arrow.array(column) for column in flat(content.arrays, layout).values()], schema=schema)
    # Neighbouring samples differ little: their bytes, stream by stream, are what zstd compresses best.
    how = {"use_byte_stream_split": True, "use_dictionary": False, "write_statistics": False}
    buffer = arrow.BufferOutputStream()
    parquet.write_table(table, buffer, compression="zstd", **how)
    path.write_bytes(buffer.getvalue())  # Python reports a full disk in the usual words, pyarrow does not


def _load_parquet(path: Path) -> LogContent:
    table = read_parquet(path, _MAX_BYTES)
    metadata = table.schema.metadata or {}
    if _PARQUET_KEY not in metadata:
        raise InputError("its metadata contain no log")
    return _untabular(json.loads(metadata[_PARQUET_KEY]), table.column_names, [each.to_numpy() for each in table.columns])


def _tabular(content: LogContent) -> tuple[dict[str, Any], list[LogColumn]]:
    """The facts, with the arrays that are not over time among them, and the columns of the arrays over time."""
    arrays = content.arrays
    optional = widths(arrays)
    layout = columns(content.facts["joint_names"], content.facts["units"], optional, content.facts.get("tip_names", ()))
    constant = {name: values.tolist() for name, values in arrays.items() if name != "t" and name not in QUANTITIES}
    return {**content.facts, "arrays": constant, "optional": optional}, layout


def _untabular(facts: Any, header: Sequence[str], table: Sequence[Any] | Array) -> LogContent:
    if not isinstance(facts, dict) or not isinstance(facts.get("arrays"), dict):
        raise InputError("its head is not a table")
    constant = facts.pop("arrays")
    optional = facts.pop("optional")
    if not all(isinstance(width, int) and 0 <= width <= len(header) for width in optional.values()):
        raise InputError("its columns are not counted")
    layout = columns(facts["joint_names"], facts["units"], optional, facts.get("tip_names", ()))
    if [column.name for column in layout] != list(header) or len(table) != len(header):
        raise InputError("its columns are not those of its joints")
    names = dict.fromkeys(column.array for column in layout)
    arrays: dict[str, list[Array]] = {name: [] for name in names}
    for column, values in zip(layout, table, strict=True):
        arrays[column.array].append(np.asarray(values))
    stacked = {name: np.column_stack(parts) for name, parts in arrays.items()}
    stacked["t"] = stacked["t"][:, 0]
    others = len(facts.get("tip_names", ())) - 1
    for name in QUANTITIES.keys() - stacked.keys():
        quantity = QUANTITIES[name]
        if not quantity.is_per_tip or others > 0:
            stacked[name] = np.zeros((0, len(quantity.axes) * (others if quantity.is_per_tip else 1)))
    return LogContent(stacked | {name: np.array(values, dtype=np.float64) for name, values in constant.items()}, facts)


WRITERS: dict[str, Callable[[Path, LogContent], None]] = {".npz": _save_npz, ".parquet": _save_parquet, ".csv": _save_csv}
_READERS: dict[str, Callable[[Path], LogContent]] = {".npz": _load_npz, ".parquet": _load_parquet, ".csv": _load_csv}
