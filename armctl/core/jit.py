"""Compiling scalar loops with numba. Import this only in a function that needs it, because numba takes long to load."""

from __future__ import annotations

import hashlib
import os
import pickle
import sys
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from numba.core import types
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.ccallback import CFunc
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompileResult, Flags, compile_extra
from numba.core.dispatcher import Dispatcher
from numba.core.registry import CPUDispatcher
from numba.core.typing.templates import make_concrete_template

from armctl.core.compiler_shortcuts import compiler_shortcuts
from armctl.core.errors import ArmctlWarning
from armctl.core.python_kernel import PythonKernel, UnfinishedError

_SILENT_S = 2.0  # so long a process compiles before it tells why its user waits
_DIGEST_SIZE = hashlib.sha256().digest_size


class _DamagedFileError(Exception):
    """A cache file does not hold what was written."""


class _CheckedFile(IndexDataCacheFile):
    """numba's cache files, with a digest before the compiled code: damaged code would otherwise be executed."""

    def _save_data(self, name: str, data: object) -> None:
        content = self._dump(data)
        with self._open_for_write(self._data_path(name)) as file:
            file.write(hashlib.sha256(content).digest() + content)

    def _load_data(self, name: str) -> object:
        with open(self._data_path(name), "rb") as file:
            digest = file.read(_DIGEST_SIZE)
            content = file.read()
        if hashlib.sha256(content).digest() != digest:
            raise _DamagedFileError(f"{name} is damaged")
        return pickle.loads(content)


class _TolerantCache(FunctionCache):
    """numba's cache on disk. Where it cannot be read or written, the function is compiled in this process."""

    _warned = False

    def __init__(self, function: Callable):
        super().__init__(function)
        own = self._cache_file
        self._cache_file = _CheckedFile(own._cache_path, f"{self._impl.filename_base}.armctl", _source_stamp(function))

    def load_overload(self, sig: object, target_context: object) -> object:
        """The compiled code of a signature, or None. A damaged cache is emptied, so that it is written again."""
        try:
            return super().load_overload(sig, target_context)
        except Exception as error:  # numba unpickles the files: damaged ones may raise anything
            self._warn(error)
        with suppress(OSError):  # the folder may not be writable either
            self.flush()
        return None

    def has(self, sig: object, target_context: Any) -> bool:
        """Whether there may be compiled code of a signature; also where the cache is damaged, which loading finds out."""
        try:
            return self._index_key(sig, target_context.codegen()) in self._cache_file._load_index()
        except Exception:  # as in `load_overload`
            return True

    def save_overload(self, sig: object, data: object) -> None:
        """Saves compiled code if there is a place for it."""
        try:
            super().save_overload(sig, data)
        except (OSError, pickle.PickleError, EOFError) as error:
            self._warn(error)

    def _warn(self, error: Exception) -> None:
        """One warning for all functions of this process."""
        if _TolerantCache._warned:
            return
        _TolerantCache._warned = True
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        warnings.warn(
            f"the cache of compiled code in {self.cache_path:.150} cannot be used ({reason:.120}); armctl compiles again",
            ArmctlWarning,
            stacklevel=2,
        )


def _source_stamp(function: Callable) -> list[tuple[float, int]]:
    """Time and size of the files of a function and of all compiled functions that it calls; numba looks at its own only."""
    functions = [function]
    for known in functions:
        called = [known.__globals__.get(name) for name in known.__code__.co_names]
        functions += [each.py_func for each in called if isinstance(each, Dispatcher) and each.py_func not in functions]
    files = sorted({known.__code__.co_filename for known in functions})
    return [(status.st_mtime, status.st_size) for status in map(os.stat, files)]


class _CalledCode(JITCodeLibrary):
    """The code of a function that compiled code calls. It stays as it is: its callers optimize it as a part of themselves."""

    def finalize(self) -> None:
        """Adds the code of the functions that this one calls."""
        self._raise_if_finalized()
        for library in dict.fromkeys(self._linking_libraries):
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalized = True


class Kernel(CPUDispatcher):
    """A compiled function of which numba makes machine code only if Python calls it, not if only compiled code does.

    numba's own dispatcher makes machine code of every function, with wrappers for calls from Python and C, and optimizes it
    again in each of its callers, which takes half of the time. It also compiles a function again for each integer constant
    among its arguments. A function must not call itself.

    A function whose code is not in the cache runs as Python first, and is compiled when that has taken some time.

    Attributes:
        called: What compiled code calls, by the types of the arguments.
        python: The function in Python, for its first calls; None if it is compiled at once.
    """

    _cache: Any
    _compiled_s = 0.0  # by this process
    _has_told = False

    def __init__(self, *arguments: Any, **options: Any):
        super().__init__(*arguments, **options)
        self.called: dict[tuple, CompileResult] = {}
        self.python: PythonKernel | None = None
        self._missing: set[tuple] = set()  # types of arguments whose code is not in the cache

    def has_code(self, sig: tuple) -> bool:
        """Whether compiled code for these types of arguments is loaded or in the cache."""
        return sig in self.overloads or (isinstance(self._cache, _TolerantCache) and self._cache.has(sig, self.targetctx))

    def _compile_for_args(self, *args: Any, **kws: Any) -> Any:
        """What numba asks for at a call for which no code is loaded: a function that it then calls."""
        if self.python is not None and self.python.has_time:
            sig = tuple(map(self.typeof_pyval, args))
            if sig in self._missing or not self.has_code(sig):
                self._missing.add(sig)
                return self._run_in_python
        dispatcher: Any = super()
        return dispatcher._compile_for_args(*args, **kws)

    def _run_in_python(self, *args: Any) -> Any:
        assert self.python is not None
        try:
            return self.python(*args)
        except UnfinishedError:
            return self(*args)  # compiles

    def compile(self, sig: Any) -> Any:
        """The code for these types of arguments, from the cache if it is there."""
        began = time.monotonic()
        with compiler_shortcuts():
            code = super().compile(sig)
        if self.stats.cache_misses[sig]:
            Kernel._compiled_s += time.monotonic() - began
            _tell_once()
        return code

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """What numba asks for when it compiles a call: the signature for these types of arguments."""
        signature, args = self.fold_argument_types(args, kws)
        args = tuple(map(types.unliteral, args))
        if args not in self.called:
            self.called[args] = self._compile_called(args)
        template = make_concrete_template(self.py_func.__name__, self, [self.called[args].signature])
        return template, signature, args, {}

    def get_overload(self, sig: Any) -> Any:
        """The key under which numba finds the code for a call."""
        return self.called[tuple(sig)].fndesc

    def _compile_called(self, args: tuple) -> CompileResult:
        flags: Any = Flags()
        target: Any = self.targetctx
        self.targetdescr.options.parse_as_flags(flags, self.targetoptions)
        flags.no_compile = True
        flags.no_cpython_wrapper = True
        flags.no_cfunc_wrapper = True
        library = _CalledCode(target.codegen(), self.py_func.__qualname__)
        result = compile_extra(self.typingctx, target, self.py_func, args, None, flags, {}, library)
        target.insert_user_function(result.fndesc, result.fndesc, [library])
        return result


def _tell_once() -> None:
    """Tells a user at a terminal that armctl compiles."""
    if Kernel._has_told or Kernel._compiled_s < _SILENT_S or sys.stderr is None or not sys.stderr.isatty():
        return
    Kernel._has_told = True
    print("armctl compiles for this computer, once: half a minute, on a slow one several minutes", file=sys.stderr, flush=True)


def njit(function: Callable) -> Callable:
    """The compiled function, with a cache on disk if there is a folder for it. Its first calls may run in Python."""
    compiled = njit_at_once(function)
    compiled.python = PythonKernel(function, Kernel)
    return compiled


def njit_at_once(function: Callable) -> Any:
    """As `njit`, for a function that Python computes with other bits; it is compiled at its first call."""
    options = {"nopython": True, "nogil": True, "error_model": "numpy", "boundscheck": None}
    compiled: Any = Kernel(function, targetoptions=options)
    with suppress(RuntimeError, OSError):  # no source file, or no folder that can be written: compile in every process
        compiled._cache = _TolerantCache(function)
    return compiled


class CFunction(CFunc):
    """A C function that is compiled when its address is needed."""

    _wrapper_address: int | None
    _cache: Any
    _sig: Any
    _targetdescr: Any

    @property
    def address(self) -> int:
        """The address of the compiled code."""
        if self._wrapper_address is None:
            with compiler_shortcuts():
                self.compile()
        assert self._wrapper_address is not None
        return self._wrapper_address

    def has_code(self) -> bool:
        """Whether compiled code is loaded or in the cache."""
        if self._wrapper_address is not None:
            return True
        return isinstance(self._cache, _TolerantCache) and self._cache.has(self._sig, self._targetdescr.target_context)


def c_function(signature: Any) -> Callable[[Callable], CFunction]:
    """Decorates a function that becomes a C function of this signature; the cache is that of `njit`. It must not raise."""

    def compiled(function: Callable) -> CFunction:
        options = {"nopython": True, "error_model": "numpy"}
        c_function = CFunction(function, (signature.args, signature.return_type), {}, options)
        with suppress(RuntimeError, OSError):
            c_function._cache = _TolerantCache(function)
        return c_function

    return compiled
