"""A cache of compiled code that cannot be used leads to compilation and one warning, never to an error."""

import gc
import io
import math
import os
import re
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
from numba import types

from armctl.core import compiler_shortcuts, jit
from armctl.core.jit import c_function, njit, njit_borrowing

KERNEL = """
from armctl.core.jit import njit

@njit
def double(x):
    return 2 * x

@njit
def triple(x):
    return x + double(x)
"""
CALL = """
import sys, warnings
sys.path.insert(0, {folder!r})
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    {before}
    import kernels
    print(kernels.triple(2.0), kernels.double(1.0))
    print(sum(kernels.triple.stats.cache_hits.values()))
for warning in caught:
    print(warning.category.__name__, warning.message)
"""


class Outcome:
    """What a fresh process printed: the results, the cache hits of `triple`, and the warnings."""

    def __init__(self, folder: Path, before: str = "pass"):
        (folder / "kernels.py").exists() or (folder / "kernels.py").write_text(KERNEL)
        code = CALL.format(folder=str(folder), before=before)
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "cache")}
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stderr
        self.results, self.hits, *self.warnings = done.stdout.strip().split("\n")


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[Path, bytes]]:
    """The folder of a first process, and the files of its cache."""
    folder = tmp_path_factory.mktemp("compiled")
    outcome = Outcome(folder)
    assert (outcome.results, outcome.hits, outcome.warnings) == ("6.0 2.0", "0", [])
    return folder, {path: path.read_bytes() for path in (folder / "cache").rglob("*.nb*")}


@pytest.fixture
def compiled(first: tuple[Path, dict[Path, bytes]]) -> Path:
    """That folder, with the cache as the first process left it."""
    folder, cache = first
    for path in (folder / "cache").rglob("*.nb*"):
        path.unlink()
    for path, content in cache.items():
        path.write_bytes(content)
    return folder


def files(folder: Path, ending: str) -> list[Path]:
    found = sorted((folder / "cache").rglob(f"*.{ending}"))
    assert len(found) == 2
    return found


def test_the_second_process_takes_the_code_from_the_cache(compiled: Path):
    second = Outcome(compiled)
    assert (second.results, second.hits, second.warnings) == ("6.0 2.0", "1", [])


def test_a_change_of_a_called_function_in_another_file_compiles_its_callers_again(tmp_path: Path):
    (tmp_path / "called.py").write_text("from armctl.core.jit import njit\n@njit\ndef half(x):\n    return 0.5 * x\n")
    calling = "from armctl.core.jit import njit\nfrom called import half\n@njit\ndef double(x):\n    return 4 * half(x)\n"
    (tmp_path / "kernels.py").write_text(calling + "@njit\ndef triple(x):\n    return x + double(x)\n")
    assert Outcome(tmp_path).results == "6.0 2.0"
    (tmp_path / "called.py").write_text("from armctl.core.jit import njit\n@njit\ndef half(x):\n    return 0.75 * x\n")
    assert Outcome(tmp_path).results == "8.0 3.0"


def test_what_only_compiled_code_calls_is_compiled_once_for_all_constants_and_not_for_python():
    code = "@njit\ndef power(x, k):\n    return x**k\n@njit\ndef total(x):\n    return power(x, 2) + power(x, 3)\n"
    namespace: dict = {"njit": njit}
    exec(code, namespace)
    power = namespace["power"]
    assert namespace["total"](2.0) == 12.0
    assert len(power.called) == 1
    assert power.signatures == []
    assert power(2.0, 2) == 4.0
    assert len(power.signatures) == 1


def _norm(v, w, pair):
    total = 0.0
    for i in range(v.shape[0]):
        total += abs(v[i] * w[0, i]) + min(v[i], 2.0) * math.sqrt(float(i)) + pair[1]
        v[i] = -w[-1, 0]
    return total, v.shape[0] + len(pair)


def test_functions_that_borrow_arrays_count_no_references_and_share_helpers_with_functions_that_count():
    @njit
    def half(x):
        return x[: x.shape[0] // 2]

    @njit_borrowing
    def double(x):
        part = half(x)
        for i in range(part.shape[0]):
            part[i] *= 2.0

    @njit
    def copied_half(x):
        return half(np.concatenate((x, x)))

    x = np.arange(6.0)
    double(x)
    assert x.tolist() == [0.0, 2.0, 4.0, 3.0, 4.0, 5.0]
    references = sys.getrefcount(x)
    for _ in range(100):
        double(x)
        assert copied_half(x).tolist() == x.tolist()
    assert sys.getrefcount(x) == references
    code = double.overloads[double.signatures[0]].library.get_llvm_str()
    assert "NRT_incref" not in code


def test_a_function_that_borrows_arrays_cannot_allocate_one():
    @njit_borrowing
    def allocate(n):
        return np.zeros(n).sum()

    with pytest.raises(numba.NumbaError, match="allocate allocates memory"):
        allocate(3)


def test_a_c_function_that_borrows_arrays_cannot_allocate_one():
    @c_function(types.float64(types.int64), borrows=True)
    def allocate(n):
        return np.zeros(n).sum()

    with pytest.raises(numba.NumbaError, match="allocate allocates memory"):
        _ = allocate.address


def test_the_shortcuts_in_numbas_compiler_lead_to_the_same_code_and_are_removed_afterwards():
    originals = [(owner, name, getattr(owner, name)) for owner, name, _ in compiler_shortcuts._REPLACEMENTS]
    threshold = gc.get_threshold()
    signature = "(float64[::1], float64[:, ::1], UniTuple(float64, 2))"
    plain = numba.njit(signature)(_norm)
    with compiler_shortcuts.compiler_shortcuts():
        first = numba.njit(signature)(_norm)
        again = numba.njit(signature)(_norm)  # with what the first one left
    codes = [re.sub(r"(B\d+)?v\d+", "", next(iter(each.inspect_asm().values()))) for each in (plain, first, again)]
    assert "sqrt" in codes[0]
    assert codes[0] == codes[1] == codes[2]
    assert [(owner, name, getattr(owner, name)) for owner, name, _ in originals] == originals
    assert gc.get_threshold() == threshold


def test_a_user_at_a_terminal_reads_once_why_the_first_motion_takes_long(monkeypatch: pytest.MonkeyPatch):
    terminal = io.StringIO()
    terminal.isatty = lambda: True  # type: ignore[method-assign]
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(jit, "_SILENT_S", 0.0)
    monkeypatch.setattr(jit.Kernel, "_has_told", False)
    namespace: dict = {"njit": njit}
    exec("@njit\ndef half(x):\n    return 0.5 * x\n", namespace)
    assert (namespace["half"](3.0), namespace["half"](3)) == (1.5, 1.5)
    assert terminal.getvalue().count("armctl compiles for this computer, once") == 1


@pytest.mark.parametrize("content", [b"", b"\x80\x04rubbish" * 40, os.urandom(4000)], ids=["empty", "rubbish", "random"])
@pytest.mark.parametrize("ending", ["nbi", "nbc"])
def test_a_damaged_cache_leads_to_one_warning_and_is_written_again(compiled: Path, ending: str, content: bytes):
    for path in files(compiled, ending):
        path.write_bytes(content)
    damaged = Outcome(compiled)
    assert damaged.results == "6.0 2.0"
    assert len(damaged.warnings) == 1
    assert damaged.warnings[0].startswith("ArmctlWarning the cache of compiled code in ")
    assert len(damaged.warnings[0]) <= 400
    after = Outcome(compiled)
    assert (after.results, after.hits, after.warnings) == ("6.0 2.0", "1", [])


def test_a_single_changed_byte_of_compiled_code_is_not_executed(compiled: Path):
    for path in files(compiled, "nbc"):
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 0x40
        path.write_bytes(content)
    damaged = Outcome(compiled)
    assert damaged.results == "6.0 2.0"
    assert "is damaged" in damaged.warnings[0]


def test_a_full_disk_leads_to_one_warning(tmp_path: Path):
    full = "from armctl.core.jit import _CheckedFile as file; import errno"
    fail = "file._open_for_write = lambda *_: (_ for _ in ()).throw(OSError(errno.ENOSPC, 'No space left on device'))"
    outcome = Outcome(tmp_path, f"{full}; {fail}")
    assert outcome.results == "6.0 2.0"
    assert len(outcome.warnings) == 1
    assert "No space left on device" in outcome.warnings[0]


@pytest.mark.parametrize("change", ["self._version = '0.1'", "self._source_stamp = (0.0, 1)"], ids=["numba", "source"])
def test_a_cache_of_another_version_is_written_again(tmp_path: Path, change: str):
    foreign = "import armctl.core.jit as jit; save = jit._CheckedFile._save_index"
    wrap = f"jit._CheckedFile._save_index = lambda self, entries: (exec({change!r}), save(self, entries))[1]"
    Outcome(tmp_path, f"{foreign}; {wrap}")
    other = Outcome(tmp_path)
    assert (other.results, other.hits, other.warnings) == ("6.0 2.0", "0", [])
    assert Outcome(tmp_path).hits == "1"
