"""Kernels that run as plain Python: for a few calls, this takes less time than to compile them.

A kernel gives the same bits either way. Compiled code neither reorders nor contracts floating-point operations, and numba and
Python take the functions of `math` from the same library. Kernels therefore use `math` instead of NumPy's functions of scalars,
which may differ in the last bit, and products instead of powers. Where Python raises and compiled code does not, as at a
division by zero, the arguments are restored and the kernel is compiled.
"""

from __future__ import annotations

import functools
import os
import time
from collections.abc import Callable
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np

COMPILE_AT_ONCE = "ARMCTL_COMPILE_AT_ONCE"  # environment variable: for tests, benchmarks, and `armctl warmup`
_SECONDS = 0.5  # of one kernel in one process; it then pays to compile it, which takes one to four seconds


def compiles_at_once() -> bool:
    """Whether every kernel is compiled at its first call."""
    return bool(os.environ.get(COMPILE_AT_ONCE))


class UnfinishedError(Exception):
    """A kernel did not finish in Python; its arguments are as before the call."""


class PythonKernel:
    """A kernel as a Python function, for a limited time in all calls together."""

    _deadline = 0.0  # of the call that runs; threads may prolong each other's, which costs time only

    def __init__(self, function: Callable, kernel_type: type):
        """The Python function of a kernel.

        Args:
            function: What the kernel compiles.
            kernel_type: The type of all kernels: those that this one calls run in Python as well.
        """
        self._seconds_left = _SECONDS
        self._original = function
        self._kernel_type = kernel_type

    @property
    def has_time(self) -> bool:
        """Whether the kernel is worth another call in Python."""
        return self._seconds_left > 0.0 and not compiles_at_once()

    def __call__(self, *args: Any) -> Any:
        """Runs the kernel.

        Returns:
            What the compiled kernel returns.

        Raises:
            UnfinishedError: The time is over, or Python raised an exception.
        """
        saved: list[tuple[np.ndarray, np.ndarray]] = []
        _save(args, saved)
        began = time.perf_counter()
        PythonKernel._deadline = began + self._seconds_left
        try:
            with np.errstate(all="ignore"):
                result = self._function(*args)
        except Exception as error:
            self._seconds_left = 0.0
            for array, copy in saved:
                np.copyto(array, copy)
            raise UnfinishedError from error
        self._seconds_left -= time.perf_counter() - began
        return _native(result)

    @functools.cached_property
    def _function(self) -> Callable:
        return _python_function(self._original, self._kernel_type)


class _Names(NamedTuple):
    """The global names of a module, and the same with Python functions instead of kernels."""

    original: dict[str, Any]
    in_python: dict[str, Any]


_modules: dict[int, _Names] = {}  # by the identity of the original names


def _python_function(function: Any, kernel_type: type) -> Callable:
    """A function that calls the Python functions of kernels instead of the kernels."""
    original = function.__globals__
    if id(original) not in _modules:
        names = _Names(original, dict(original))
        _modules[id(original)] = names
        for name, value in original.items():
            if isinstance(value, kernel_type):
                names.in_python[name] = _interruptible(_python_function(value.py_func, kernel_type))
    globals_in_python = _modules[id(original)].in_python
    return FunctionType(function.__code__, globals_in_python, function.__name__, function.__defaults__, function.__closure__)


def _interruptible(function: Callable) -> Callable:
    """A function that is not begun after the deadline."""

    def interruptible(*args: Any) -> Any:
        if time.perf_counter() > PythonKernel._deadline:
            raise UnfinishedError
        return function(*args)

    return interruptible


def _save(args: tuple, saved: list[tuple[np.ndarray, np.ndarray]]) -> None:
    """Appends all arrays that a kernel may change, and copies of them."""
    for each in args:
        if isinstance(each, tuple):
            _save(each, saved)
        elif isinstance(each, np.ndarray) and each.flags.writeable:
            saved.append((each, each.copy()))


def _native(result: Any) -> Any:
    """Numbers of NumPy as those of Python, as compiled code returns them."""
    if isinstance(result, np.generic):
        return result.item()
    if isinstance(result, tuple):
        numbers = tuple(map(_native, result))
        named_tuple: Any = type(result)
        return numbers if named_tuple is tuple else named_tuple._make(numbers)
    return result
