"""The compiled core checks its arguments, was built from the sources beside it, and has types that are up to date."""

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import armctl
from armctl import InputError, _core
from armctl.core.compiled_core import build_problem, source_checksum

pytestmark = pytest.mark.core

PACKAGE = Path(armctl.__file__).parent
SOURCES = PACKAGE / "cpp"


def read_only(array: np.ndarray) -> np.ndarray:
    array.flags.writeable = False
    return array


@pytest.mark.parametrize(
    ("rotations", "quats", "message"),
    [
        (np.zeros((2, 3, 3)), np.zeros((2, 1)), r"quats: need an array of shape \(2, 4\), got \(2, 1\)"),
        (np.zeros((2, 9)), np.zeros((2, 4)), r"rotations: need an array of shape \(2, 3, 3\), got \(2, 9\)"),
        (np.zeros((2, 3, 3)), np.zeros(2), r"quats: need an array of shape \(2, 4\), got \(2,\)"),
        (np.array(1.0), np.zeros((1, 4)), r"rotations: need an array with at least one dimension"),
        (np.zeros((2, 3, 3)), np.zeros((2, 4), dtype=np.float32), "quats: need a contiguous, writable array of type float64"),
        (np.zeros((2, 3, 3)), np.zeros((2, 4), dtype=np.int64), "quats: need a contiguous, writable array of type float64"),
        (np.zeros((2, 3, 3)), np.zeros((2, 8))[:, ::2], "quats: need a contiguous, writable array of type float64"),
        (np.zeros((2, 3, 3)), read_only(np.zeros((2, 4))), "quats: need a contiguous, writable array of type float64"),
        (np.zeros((2, 3, 3), order="F"), np.zeros((2, 4)), "rotations: need a contiguous array of type float64"),
        ([[1.0]], np.zeros((1, 4)), "rotations: need a contiguous array of type float64"),
    ],
)
def test_a_wrong_array_is_an_input_error_that_names_it(rotations, quats, message: str):
    with pytest.raises(InputError, match=f"^{message}$"):
        _core.quaternions(rotations, quats)


def test_an_array_that_is_only_read_may_be_read_only():
    quats = np.zeros((1, 4))
    _core.quaternions(read_only(np.eye(3)[None]), quats)
    assert quats.tolist() == [[1.0, 0.0, 0.0, 0.0]]


def test_a_program_that_ends_while_a_thread_has_an_object_of_the_core_prints_nothing():
    program = """
import threading
from armctl import _core

def hold(delay, begun):
    begun.set()
    threading.Event().wait()

begun = threading.Event()
threading.Thread(target=hold, args=(_core.Delay(1, 1), begun), daemon=True).start()
begun.wait()
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert ended.stdout + ended.stderr == ""


def test_the_memory_of_an_array_is_released():
    x = bytearray(32)
    array = memoryview(x).cast("d", (1, 4))
    _core.quaternions(np.eye(3)[None], array)
    array.release()
    x.extend(b"a bytearray whose memory somebody still uses cannot grow")
    assert len(x) > 32


def test_a_parent_behind_its_joint_is_an_input_error(bundled: armctl.Arm):
    from armctl.model.arm.dynamics import core_model

    assert core_model(bundled.model, bundled.pinocchio_model).n == 3
    m = 1
    arrays = {
        name: np.zeros((m, *shape))
        for name, shape in {
            "rotations": (3, 3), "translations": (3,), "masses": (), "centers": (3,), "inertias": (6,), "lifted_masses": (),
            "lifted_moments": (3,), "stiffness": (3,), "spring_rest": (), "offsets": (), "ratio": (m,), "armature": (),
            "damping": (3,), "friction_loss": (), "friction_gain": (), "friction_rate": (),
        }.items()
    }  # fmt: skip
    arrays |= {"gravity": np.zeros(3), "tip_rotation": np.eye(3), "tip_translation": np.zeros(3)}
    arrays |= {"slides": np.zeros(m, dtype=np.int64)}
    options = {"implicit_damping": False, "implicit_coriolis": False}
    with pytest.raises(InputError, match="parents: 1 is not one of 1"):
        _core.ArmModel(**arrays, **options, parents=np.array([0]), chain_length=1)
    with pytest.raises(InputError, match="chain_length: 1 is not one of 1"):
        _core.ArmModel(**arrays, **options, parents=np.array([-1]), chain_length=2)


def test_a_build_from_other_sources_is_a_problem_in_one_sentence(tmp_path: Path):
    shutil.copytree(SOURCES, tmp_path / "cpp")
    checksum = source_checksum(str(SOURCES))
    extension = str(tmp_path / "_core.so")
    assert build_problem(extension, checksum) == ""
    (tmp_path / "cpp" / "vectors.cpp").write_text("int x;\n", encoding="utf-8")
    assert "was built from other sources" in build_problem(extension, checksum)
    assert "run `make core`" in build_problem(extension, checksum)


def test_an_installed_core_has_no_sources_to_compare_with(tmp_path: Path):
    assert build_problem(str(tmp_path / "_core.so"), 0) == ""


def test_an_extension_beside_other_sources_cannot_be_imported(tmp_path: Path):
    (tmp_path / "cpp").mkdir()
    (tmp_path / "cpp" / "other.cpp").write_text("int x;\n", encoding="utf-8")
    extension = shutil.copy(str(_core.__file__), tmp_path)
    spec = importlib.util.spec_from_file_location("armctl._core", extension)
    with pytest.raises(ImportError, match=f"^{extension} was built from other sources than those in {tmp_path / 'cpp'}; run"):
        spec.loader.exec_module(importlib.util.module_from_spec(spec))


def test_the_types_are_those_of_the_extension(tmp_path: Path):
    stub = tmp_path / "_core.pyi"
    subprocess.run([sys.executable, "-m", "nanobind.stubgen", "-q", "-m", "armctl._core", "-o", stub], check=True)
    subprocess.run([sys.executable, "-m", "ruff", "format", "--quiet", "--line-length", "128", stub], check=True)
    assert (PACKAGE / "_core.pyi").read_text(encoding="utf-8") == stub.read_text(encoding="utf-8"), "run `make stubs`"
