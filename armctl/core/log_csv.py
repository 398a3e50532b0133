"""The recording of a real robot from a CSV file: time, positions and torques, on an even time grid.

Velocities are not read, since robots report them filtered and delayed. They follow from the positions by a zero-phase filter.
"""

import csv
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TextIO

import numpy as np

from armctl.core.atomic import file_path
from armctl.core.defaults import MAX_FILE_VALUE
from armctl.core.errors import InputError
from armctl.core.file_reading import check_size, reading
from armctl.core.filtering import choose_cutoff, derivatives, low_pass
from armctl.core.validation import Array, BoolArray, shown

Columns = Mapping[str, str | Sequence[str]]
Units = Mapping[str, str | Sequence[str]]

_QUANTITIES = ("t", "q", "tau")
_DEFAULT_COLUMNS: dict[str, str] = {"t": "t", "q": "q*", "tau": "tau*"}
_UNITS: dict[str, dict[str, float]] = {
    "t": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "q": {"rad": 1.0, "deg": np.pi / 180, "m": 1.0, "mm": 1e-3},
    "tau": {"N m": 1.0, "mN m": 1e-3, "N": 1.0, "N mm": 1e-3},
}
_DEFAULT_UNITS = {"t": "s", "q": "rad", "tau": "N m"}
_SLIDE_UNITS = ("m", "mm")
MAX_TABLE_BYTES = 2_000_000_000
_MAX_ROWS = 20_000_000  # on the even time grid; more is taken for a wrong unit of time
_MIN_CSV_ROWS = 50
_MAX_GAP_S = 0.1  # over which positions are interpolated
_MAX_GAP_STEPS = 5.0  # a slow recording may have longer steps throughout
_MAX_REPEATS = 3  # equal rows in sequence that are a repeated transmission; more are an arm at rest


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A recording on an even time grid."""

    joint_names: tuple[str, ...]  # the n names of the position columns
    units: tuple[str, ...]  # the unit of each joint, "rad" or "m"
    dt: float  # s, the interval of the grid
    t: Array  # (T,) s, from 0
    q: Array  # (T, n) rad, not filtered
    v: Array  # (T, n) rad/s, of the filtered positions
    tau: Array  # (T, n) N m, not filtered
    cutoff: float  # hz, of the zero-phase filter
    repeated: int  # the number of repeated rows that were left out

    def __str__(self) -> str:
        return f"a recording; {self.repeated} repeated rows left out, velocity by a zero-phase filter of {self.cutoff:.3g} Hz"


def read_recording(path: str | os.PathLike[str], columns: Columns | None, units: Units | None) -> Recording:
    """Reads a recording; `Log.from_csv` explains the columns and the units. InputError if it is none."""
    path = file_path("path", path)
    wanted = _merged("columns", columns, _DEFAULT_COLUMNS)
    of_units = _checked_units(units)
    with reading(path, "no recording"):
        names, table = _read_table(path, wanted)
        return _on_even_grid(names, table, _unit_of_each_column(names, of_units))


def _merged(what: str, given: object, defaults: Mapping[str, str]) -> dict[str, str | list[str]]:
    """The caller's entries, and the defaults for those that are missing."""
    if given is not None and not isinstance(given, Mapping):
        raise InputError(f"{what}: {shown(given)} is not a table; {dict(defaults)} is the default")
    out: dict[str, str | list[str]] = dict(defaults)
    for key, value in (given or {}).items():
        if key not in _QUANTITIES:
            raise InputError(f"{what}: {shown(key)} is not one of {', '.join(_QUANTITIES)}")
        if isinstance(value, str):
            out[key] = value
        elif isinstance(value, Sequence) and value and all(isinstance(name, str) for name in value):
            out[key] = list(value)
        else:
            raise InputError(f"{what}: {key}: {shown(value)} is neither a name nor a list of names")
    return out


def _checked_units(units: Units | None) -> dict[str, str | list[str]]:
    """The units of each quantity, all of them known."""
    names = _merged("units", units, _DEFAULT_UNITS)
    for quantity, given in names.items():
        for unit in [given] if isinstance(given, str) else given:
            if unit not in _UNITS[quantity]:
                raise InputError(f"units: {quantity}: expected one of {', '.join(_UNITS[quantity])}, got {shown(unit)}")
    return names


def _unit_of_each_column(names: Mapping[str, list[str]], units: Mapping[str, str | list[str]]) -> dict[str, list[str]]:
    """The unit of every column of each quantity."""
    out: dict[str, list[str]] = {}
    for quantity, columns in names.items():
        given = units[quantity]
        out[quantity] = [given] * len(columns) if isinstance(given, str) else given
        if len(out[quantity]) != len(columns):
            raise InputError(f"units: {quantity}: expected one unit or {len(columns)}, got {len(given)}")
    return out


def _read_table(path: os.PathLike[str], wanted: Mapping[str, str | list[str]]) -> tuple[dict[str, list[str]], Array]:
    """The names of the columns of each quantity, and their numbers (T, 1 + 2 n)."""
    check_size(os.path.getsize(path), MAX_TABLE_BYTES)
    with open(path, encoding="utf-8-sig", newline="") as file:
        header, delimiter = read_header(file)
        names = {quantity: _matching(quantity, wanted[quantity], header) for quantity in _QUANTITIES}
        if len(names["t"]) != 1:
            raise InputError(f"expected 1 column for t, found {len(names['t'])}")
        if len(names["q"]) != len(names["tau"]):
            counts = f"{len(names['q'])} for q and {len(names['tau'])} for tau"
            raise InputError(f"expected equal numbers of columns, found {counts}")
        order = [header.index(name) for quantity in _QUANTITIES for name in names[quantity]]
        rows = csv.reader(file, delimiter=delimiter)
        return names, read_numbers(rows, order, len(header), _MIN_CSV_ROWS)


def read_header(file: TextIO) -> tuple[list[str], str]:
    """The names of the columns of a table, and what separates them."""
    first = file.readline()
    while first.startswith("#"):  # comments, such as the first line of a log that armctl wrote
        first = file.readline()
    delimiter = max(",;\t", key=first.count)
    return [name.strip() for name in next(csv.reader([first], delimiter=delimiter), [])], delimiter


def _matching(quantity: str, wanted: str | list[str], header: list[str]) -> list[str]:
    """The columns of a quantity. "*" in a name stands for a joint's number or name, in the order of the file."""
    if len(set(header)) < len(header):
        raise InputError("its first row has two columns of one name")
    if isinstance(wanted, str) and "*" in wanted:
        before, _, after = wanted.partition("*")
        pattern = re.compile(re.escape(before) + r"(_?\d+|_.+|\[\d+\])" + re.escape(after))
        found = [name for name in header if pattern.fullmatch(name) and not name.startswith(("q_ref_", "tau_cmd_"))]
    else:
        found = [wanted] if isinstance(wanted, str) else wanted
    missing = [name for name in found if name not in header]
    if missing or not found:
        name = missing[0] if missing else str(wanted)
        raise InputError(f"there is no column {name!r:.40} for {quantity}; its columns are {', '.join(header):.120}")
    if len(set(found)) < len(found):
        raise InputError(f"columns: {quantity}: a name is given twice")
    return found


def read_numbers(rows: Iterable[list[str]], order: list[int], width: int, least: int) -> Array:
    """Some columns of a table of so many, (T, k) finite numbers in at least so many rows. InputError for what is none."""
    table = []
    for line, row in enumerate(rows, start=2):
        if not row or (len(row) == 1 and not row[0].strip()):
            continue
        if len(row) != width:
            raise InputError(f"line {line} has {len(row)} columns, the first line {width}")
        try:
            table.append([float(row[k]) for k in order])
        except ValueError:
            text = next((row[k] for k in order if not _is_number(row[k])), "")
            raise InputError(f"line {line}: {text!r:.40} is not a number") from None
    if len(table) < least:
        raise InputError(f"expected at least {least} rows, found {len(table)}")
    out = np.array(table)
    bad = ~np.isfinite(out).all(axis=1)
    if bad.any():
        raise InputError(f"a number in row {int(bad.argmax()) + 1} is not finite")
    return out


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _on_even_grid(names: Mapping[str, list[str]], table: Array, units: Mapping[str, list[str]]) -> Recording:
    """Repeated rows left out, the rest interpolated on a grid of the median interval."""
    n = len(names["q"])
    scales = np.array([_UNITS[quantity][unit] for quantity in _QUANTITIES for unit in units[quantity]])
    table = table * scales
    t = table[:, 0]
    if (np.diff(t) < 0).any():
        row = int((np.diff(t) < 0).argmax()) + 2
        raise InputError(f"t: the time of row {row} is before that of row {row - 1}")
    new = ~_is_repeated(t, table[:, 1:])
    t = t[new] - t[0]
    values = table[new, 1:]
    if len(t) < _MIN_CSV_ROWS:
        raise InputError(f"only {len(t)} rows differ from the one before, expected at least {_MIN_CSV_ROWS}")
    if np.abs(values).max() > MAX_FILE_VALUE:
        raise InputError(f"a position or torque is above {MAX_FILE_VALUE:g} in SI units")
    steps = np.diff(t)
    dt = float(np.median(steps))
    gap = int(steps.argmax())
    if steps[gap] > max(_MAX_GAP_S, _MAX_GAP_STEPS * dt):
        raise InputError(f"t: nothing is recorded for {steps[gap]:.3g} s after {t[gap]:.3f} s; give one run without a gap")
    count = int(t[-1] / dt) + 1
    if count > _MAX_ROWS:
        raise InputError(f"t: the median interval of {dt:.3g} s is too short for {t[-1]:.3g} s; check the unit of time")
    grid = np.asarray(dt * np.arange(count), dtype=np.float64)
    even = np.column_stack([np.interp(grid, t, column) for column in values.T])
    q = even[:, :n]
    cutoff = choose_cutoff(q, dt)
    velocity, _ = derivatives(low_pass(q, cutoff, dt), dt)
    return Recording(
        joint_names=tuple(names["q"]),
        units=tuple("m" if unit in _SLIDE_UNITS else "rad" for unit in units["q"]),
        dt=dt,
        t=grid,
        q=q,
        v=velocity,
        tau=even[:, n:],
        cutoff=cutoff,
        repeated=int((~new).sum()),
    )


def _is_repeated(t: Array, values: Array) -> BoolArray:
    """(T,) bool, rows with the time of the row before, and short runs of rows with its values."""
    same_time = np.concatenate([[False], np.diff(t) == 0])
    same_values = np.concatenate([[False], (np.diff(values, axis=0) == 0).all(axis=1)])
    repeated = same_time.copy()
    for start, end in np.flatnonzero(np.diff(same_values, prepend=False, append=False)).reshape(-1, 2):
        if end - start <= _MAX_REPEATS:
            repeated[start:end] = True
    return repeated
