"""Compiling scalar loops with numba. Import this only in a function that needs it, because numba takes long to load."""

from __future__ import annotations

import hashlib
import os
import pickle
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, ClassVar

from numba.core import types
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.ccallback import CFunc
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompileResult, Flags, compile_extra
from numba.core.dispatcher import Dispatcher
from numba.core.errors import NumbaRuntimeError
from numba.core.lowering import BaseLower
from numba.core.registry import CPUDispatcher
from numba.core.runtime.context import NRTContext
from numba.core.typing.templates import make_concrete_template

from armctl.core.compiler_shortcuts import compiler_shortcuts
from armctl.core.errors import ArmctlWarning
from armctl.core.python_kernel import PythonKernel, UnfinishedError

_lower = BaseLower.lower
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
        called: What compiled code calls, by the types of the arguments, and whether it borrows.
        borrows: Whether the code is that of `njit_borrowing`.
        python: The function in Python, for its first calls; None if it is compiled at once.
    """

    _cache: Any
    _compiled_s = 0.0  # by this process
    _has_told = False
    _is_borrowing = False  # what is compiled now, under numba's lock
    _own: ClassVar[set[Callable]] = set()  # the functions of armctl; those of numba serve others, too

    def __init__(self, *arguments: Any, **options: Any):
        super().__init__(*arguments, **options)
        self.called: dict[tuple[tuple, bool], CompileResult] = {}
        self.borrows = False
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
        Kernel._own.add(self.py_func)
        with compiler_shortcuts(), _borrowing(self.borrows):
            code = super().compile(sig)
        if self.stats.cache_misses[sig]:
            Kernel._compiled_s += time.monotonic() - began
            _tell_once()
        return code

    def add_overload(self, cres: Any) -> None:
        """Takes code that is compiled, and not yet saved, or that comes from the cache."""
        if self.borrows and self.stats.cache_misses[cres.signature.args]:
            _check_borrowing(self.py_func.__name__, cres.library)
        super().add_overload(cres)

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """What numba asks for when it compiles a call: the signature for these types of arguments."""
        signature, args = self.fold_argument_types(args, kws)
        args = tuple(map(types.unliteral, args))
        key = (args, Kernel._is_borrowing)
        if key not in self.called:
            self.called[key] = self._compile_called(args)
        template = make_concrete_template(self.py_func.__name__, self, [self.called[key].signature])
        return template, signature, args, {}

    def get_overload(self, sig: Any) -> Any:
        """The key under which numba finds the code for a call."""
        return self.called[tuple(sig), Kernel._is_borrowing].fndesc

    def _compile_called(self, args: tuple) -> CompileResult:
        flags: Any = Flags()
        target: Any = self.targetctx
        self.targetdescr.options.parse_as_flags(flags, self.targetoptions)
        flags.no_compile = True
        flags.no_cpython_wrapper = True
        flags.no_cfunc_wrapper = True
        Kernel._own.add(self.py_func)
        library = _CalledCode(target.codegen(), self.py_func.__qualname__)
        result = compile_extra(self.typingctx, target, self.py_func, args, None, flags, {}, library)
        target.insert_user_function(result.fndesc, result.fndesc, [library])
        return result


@contextmanager
def _borrowing(borrows: bool) -> Iterator[None]:
    """While it is open, numba compiles code that borrows all arrays, or code that does not."""
    before = Kernel._is_borrowing
    Kernel._is_borrowing = borrows
    BaseLower.lower = _lower_without_counts if borrows else _lower
    try:
        yield
    finally:
        Kernel._is_borrowing = before
        BaseLower.lower = _lower_without_counts if before else _lower


def _lower_without_counts(self: BaseLower) -> None:
    """Makes the code of a function without reference counts; those of its wrapper, which Python calls, stay."""
    if self.func_ir.func_id.func not in Kernel._own:
        _lower(self)
        return
    context: Any = NRTContext
    incref = context.incref
    decref = context.decref
    context.incref = _count_nothing
    context.decref = _count_nothing
    try:
        _lower(self)
    finally:
        context.incref = incref
        context.decref = decref


def _count_nothing(*_: Any) -> None:
    pass


def _check_borrowing(name: str, library: Any) -> None:
    """Memory that borrowing code allocates would never be freed."""
    if "NRT_MemInfo_alloc" in library.get_llvm_str():
        raise NumbaRuntimeError(f"{name} allocates memory, which a function of njit_borrowing must not do")


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


def njit_inlined(function: Callable) -> Callable:
    """As `njit`, for a small function that becomes a part of each caller's code.

    LLVM leaves many calls in long kernels, and each passes the seven numbers of every array.
    """
    compiled: Any = njit(function)
    compiled.targetoptions["forceinline"] = True
    return compiled


def njit_at_once(function: Callable) -> Any:
    """As `njit`, for a function that Python computes with other bits; it is compiled at its first call."""
    options = {"nopython": True, "nogil": True, "error_model": "numpy", "boundscheck": None}
    compiled: Any = Kernel(function, targetoptions=options)
    with suppress(RuntimeError, OSError):  # no source file, or no folder that can be written: compile in every process
        compiled._cache = _TolerantCache(function)
    return compiled


def njit_borrowing(function: Callable) -> Callable:
    """As `njit`, for a function that works on its caller's arrays: it and what it calls allocate and return none.

    numba counts the references to every array and every part of one. Without that, small functions take up to half of the time.
    """
    compiled: Any = njit(function)
    compiled.borrows = True
    return compiled


class CFunction(CFunc):
    """A C function that is compiled when its address is needed.

    Attributes:
        borrows: Whether it is compiled as by `njit_borrowing`.
    """

    borrows = False
    _wrapper_address: int | None
    _cache: Any
    _sig: Any
    _targetdescr: Any

    @property
    def address(self) -> int:
        """The address of the compiled code."""
        if self._wrapper_address is None:
            own: Any = self
            Kernel._own.add(own._pyfunc)
            with compiler_shortcuts(), _borrowing(self.borrows):
                self.compile()
        assert self._wrapper_address is not None
        return self._wrapper_address

    def _compile_uncached(self) -> CompileResult:
        inherited: Any = super()
        result = inherited._compile_uncached()
        if self.borrows:
            own: Any = self
            result.library._ensure_finalized()
            _check_borrowing(own._pyfunc.__name__, result.library)
        return result

    def has_code(self) -> bool:
        """Whether compiled code is loaded or in the cache."""
        if self._wrapper_address is not None:
            return True
        return isinstance(self._cache, _TolerantCache) and self._cache.has(self._sig, self._targetdescr.target_context)


def c_function(signature: Any, *, borrows: bool = False) -> Callable[[Callable], CFunction]:
    """Decorates a function that becomes a C function of this signature; the cache is that of `njit`. It must not raise.

    Args:
        signature: Types of the result and of the arguments.
        borrows: Whether it is compiled as by `njit_borrowing`.
    """

    def compiled(function: Callable) -> CFunction:
        options = {"nopython": True, "error_model": "numpy"}
        c_function = CFunction(function, (signature.args, signature.return_type), {}, options)
        c_function.borrows = borrows
        with suppress(RuntimeError, OSError):
            c_function._cache = _TolerantCache(function)
        return c_function

    return compiled
