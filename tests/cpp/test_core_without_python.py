"""The compiled core as a library of C++: a program that uses it without Python, and what its headers know."""

import os
import shutil
import subprocess
from pathlib import Path

import mujoco
import pytest

pytestmark = pytest.mark.core

HERE = Path(__file__).parent
CORE = HERE.parents[1] / "armctl" / "cpp"
MUJOCO = Path(mujoco.__file__).parent


def test_a_program_in_cpp_uses_the_core_without_python(tmp_path: Path):
    compiler = os.environ.get("CXX") or shutil.which("c++")
    libraries = [*MUJOCO.glob("libmujoco.so*"), *MUJOCO.glob("libmujoco*.dylib")]
    if compiler is None or not libraries:
        pytest.skip("there is no C++ compiler, or none of the kind that MuJoCo's library is for")
    sanitizers = ["-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=undefined"]
    program = tmp_path / "core_test"
    command = [compiler, "-std=c++20", "-O1", "-ffp-contract=off"]
    command += sanitizers if "ARMCTL_SANITIZED_CORE" in os.environ else []
    command += [f"-I{CORE}", f"-I{MUJOCO / 'include'}", str(HERE / "core_test.cpp"), "-o", str(program)]
    command += [str(libraries[0]), f"-Wl,-rpath,{MUJOCO}"]
    # The sanitizers' library that `make sanitize` loads first is for the Python of this test.
    environment = {name: value for name, value in os.environ.items() if name != "LD_PRELOAD"}
    built = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    done = subprocess.run([program], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_only_the_bindings_of_the_core_know_python():
    headers = [path for path in CORE.rglob("*.?pp") if path.parent.name != "bindings"]
    assert len(headers) > 40
    for path in headers:
        text = path.read_text(encoding="utf-8")
        assert "nanobind" not in text, path
        assert "Python.h" not in text, path


def test_the_stub_names_every_argument_of_the_core():
    stub = (CORE.parent / "_core.pyi").read_text(encoding="utf-8")
    assert "**" not in stub
    assert "def __init__(self, *, stiffness: numpy.ndarray, damping: numpy.ndarray) -> None" in stub
