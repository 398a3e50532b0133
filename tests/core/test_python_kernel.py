"""Kernels that run in Python until it pays to compile them have the same bits, types and arguments afterwards."""

import collections
import hashlib
import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba.core.caching import NullCache
from synthetic import BENT, serial_arm

import armctl
from armctl.control import CONTROLLERS, controller_by_name
from armctl.control.qp_kernel import last_program
from armctl.core import jit, python_kernel
from armctl.core.jit import njit
from armctl.core.python_kernel import COMPILE_AT_ONCE, PythonKernel

MOST_CALLS = 3  # of a kernel that are compared
MOVE = """
import hashlib, json, sys, warnings
warnings.simplefilter("error")
import armctl
from armctl.core import python_kernel
from numba.core import event
python_kernel._SECONDS = 1e9
with event.install_recorder("numba:compile") as recorder:
    simulation = armctl.Simulation(armctl.load("robot_arm_3dof"))
    result = simulation.move_to(simulation.target)
log = result.log
digest = hashlib.sha256(b"".join(getattr(log, name).tobytes() for name in ("q", "v", "tau", "q_ref", "tip"))).hexdigest()
print(json.dumps([bool(result), str(result), digest, sum(each.is_start for _, each in recorder.buffer)]))
"""


@njit
def halved(x):
    return 0.5 * x


def compiled(kernel: Any) -> bool:
    return bool(kernel.overloads)


@njit
def measured(values, scale):
    """A number, an integer, a truth value, and a number that Python would give as an integer of NumPy."""
    total = 0.0
    for i in range(len(values)):
        values[i] = halved(values[i])
        total += math.sqrt(values[i])
    return total / scale, len(values), values[0] > 1.0, (total, np.int64(3))


@njit
def quotient(values):
    values[0] += 1.0
    return 1.0 / math.sqrt(values[1])


@pytest.fixture
def in_python(monkeypatch: pytest.MonkeyPatch):
    """A fresh kernel without a cache, which runs in Python first."""
    monkeypatch.delenv(COMPILE_AT_ONCE)
    monkeypatch.setattr(python_kernel, "_SECONDS", 1e9)

    def fresh(kernel) -> jit.Kernel:
        made: Any = njit(kernel.py_func)
        made._cache = NullCache()
        return made

    return fresh


def test_the_first_calls_run_in_python_and_give_numbers_as_compiled_code_does(in_python, monkeypatch):
    kernel = in_python(measured)
    arrays = [np.array([4.0, 9.0]), np.array([4.0, 9.0])]
    results = [kernel(arrays[0], 2.0)]
    assert not compiled(kernel)
    monkeypatch.setenv(COMPILE_AT_ONCE, "1")
    results.append(measured(arrays[1], 2.0))
    assert compiled(measured)
    assert results[0] == results[1]
    assert [[type(each) for each in result] for result in results] == [[float, int, bool, tuple]] * 2
    assert arrays[0].tobytes() == arrays[1].tobytes()


def test_where_python_raises_the_arguments_are_restored_and_the_kernel_is_compiled(in_python):
    kernel = in_python(quotient)
    values = np.zeros(2)
    assert kernel(values) == math.inf
    assert compiled(kernel)
    assert values[0] == 1.0


def test_a_kernel_is_compiled_when_its_time_in_python_is_over(in_python, monkeypatch):
    monkeypatch.setattr(python_kernel, "_SECONDS", 1e-9)  # over before the first call of another kernel
    kernel = in_python(measured)
    values = np.array([4.0, 9.0])
    assert kernel(values, 2.0)[1] == 2
    assert values.tolist() == [2.0, 4.5]
    assert compiled(kernel)


def test_the_first_motion_compiles_nothing_and_has_the_bits_of_the_next_ones(tmp_path: Path):
    environment = {name: value for name, value in os.environ.items() if name != COMPILE_AT_ONCE}
    environment["NUMBA_CACHE_DIR"] = str(tmp_path)
    done = subprocess.run([sys.executable, "-c", MOVE], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    ok, words, digest, compiled = json.loads(done.stdout)
    simulation = armctl.Simulation(armctl.load("robot_arm_3dof"))
    result = simulation.move_to(simulation.target)
    log = result.log
    assert ok
    assert log is not None
    assert compiled == 0
    assert words == str(result)
    assert digest == hashlib.sha256(b"".join(getattr(log, n).tobytes() for n in ("q", "v", "tau", "q_ref", "tip"))).hexdigest()


class Comparison:
    """Runs kernels that Python calls both ways, and compares what they return and what they write."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch):
        monkeypatch.delenv(COMPILE_AT_ONCE)
        monkeypatch.setattr(python_kernel, "_SECONDS", 1e9)
        self._compiled = jit.CPUDispatcher.__call__
        self.calls = collections.Counter()
        comparison = self

        def both_ways(kernel: jit.Kernel, *args):
            name = kernel.py_func.__name__
            if kernel.python is None or comparison.calls[name] == MOST_CALLS:
                return comparison._compiled(kernel, *args)
            return comparison._compare(kernel, args, name)

        monkeypatch.setattr(jit.Kernel, "__call__", both_ways, raising=False)
        dispatcher: Any = jit.CPUDispatcher
        monkeypatch.setattr(jit.Kernel, "_compile_for_args", dispatcher._compile_for_args)

    def _compare(self, kernel: jit.Kernel, args: tuple, name: str):
        saved = []
        python_kernel._save(args, saved)
        result = PythonKernel(kernel.py_func, jit.Kernel)(*args)
        written = [array.copy() for array, _ in saved]
        for array, copy in saved:
            np.copyto(array, copy)
        compiled = self._compiled(kernel, *args)
        assert repr(compiled) == repr(result), name  # it tells apart what == does not: 0.0 and -0.0, 1 and True
        for (array, _), copy in zip(saved, written, strict=True):
            assert array.tobytes() == copy.tobytes(), name
        self.calls[name] += 1
        return compiled


def test_kernels_of_motions_give_the_same_bits_in_python(monkeypatch, tmp_path: Path):
    scene = armctl.Scene().add_box("wall", [0.02, 0.02, 0.5], [0.3, 0.0, 0.25])
    arm = armctl.load("robot_arm_3dof", scene=scene)
    bent = serial_arm(tmp_path, BENT["rubbing"])
    comparison = Comparison(monkeypatch)
    tip = arm.fk(arm.home).position
    for target in (tip + 0.05, 3 * tip):
        armctl.solve_ik(arm, target, arm.home + 0.3)
    armctl.solve_ik(bent, bent.fk(bent.home + 0.3), bent.home, free_axis="z")
    armctl.move_l(arm, arm.home, tip + np.array([0.0, 0.03, 0.0]), tip_speed=0.2)
    armctl.move_through(arm, [arm.home, arm.home + 0.2, arm.home - 0.1])
    armctl.check_clearance(arm, armctl.move_free(arm, [-0.8, 0.9, -1.2], [0.8, 0.9, -1.2]))
    expected = {"search_one", "search", "refine", "residual", "all_hits", "prove_motion", "torques", "closest_approach"}
    assert expected <= set(comparison.calls)


def test_control_laws_give_the_same_bits_in_python(monkeypatch, tmp_path: Path):
    """Also where limits are exceeded, and the law of `qp` solves a program."""
    arm = serial_arm(tmp_path, BENT["rubbing"])
    comparison = Comparison(monkeypatch)
    far = armctl.Setpoint(arm.home + 1.0, np.full(arm.n, 0.3), np.full(arm.n, 2.0))
    controllers = {name: controller_by_name(name, arm) for name in CONTROLLERS}
    for controller in controllers.values():
        for tick in range(2):
            controller.torque(armctl.State(arm.home + 0.01 * tick, np.full(arm.n, 0.2), 0.001 * tick, 0.001), far)
    assert {controller.kernel.py_func.__name__ for controller in controllers.values()} <= set(comparison.calls)
    assert last_program(controllers["qp"].memory, arm.n) is not None
