"""Compiling scalar loops with numba. Import this only where a function needs it: numba takes long to load."""

from __future__ import annotations

from collections.abc import Callable

import numba


def njit(function: Callable) -> Callable:
    """Compiles, with a cache on disk wherever a folder for it can be written.

    Args:
        function: Scalar loops over arrays.

    Returns:
        The compiled function.
    """
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:  # numba finds no writable folder: compile in every process
        return numba.njit(nogil=True, error_model="numpy")(function)
