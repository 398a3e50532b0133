"""MuJoCo's C library for compiled code: functions by address, where contacts are, and calls that survive its errors."""

from __future__ import annotations

import ctypes
import threading
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from armctl.core.errors import ModelError
from armctl.core.validation import BoolArray

_ERROR_SIZE = 500
# The simulation of the pool in which compiled code is called; compiled code works on other models.
_EMPTY_MODEL = '<mujoco><size memory="64K"/></mujoco>'
# Some bodies that rest on the ground, with different numbers of contacts.
_RESTING = """<mujoco><size memory="1M"/><worldbody><geom type="plane" size="9 9 1"/>{}</worldbody></mujoco>"""
_SPHERE = '<body pos="{} 0 0.09"><freejoint/><geom size="0.1"/></body>'
_BOX = '<body pos="{} 1 0.09"><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>'
_OPTION_INTEGERS = 13
_FLAG_VALUES = (21, 42)
_COUNTS = ((1, 1), (3, 1), (0, 2), (2, 3))  # spheres and boxes


class ContactLayout(NamedTuple):
    """Where MjData keeps the geoms of its contacts, in bytes.

    Attributes:
        size: Offset of `ncon` in mjData.
        array: Offset of the pointer `contact` in mjData.
        stride: Size of an mjContact.
        geoms: Offset of `geom` in mjContact.
    """

    size: int
    array: int
    stride: int
    geoms: int


class _BatchConfig(ctypes.Structure):
    """mjBatchConfig of mjbatch.h."""

    _fields_ = (("nthread", ctypes.c_int), ("persistent", ctypes.c_ubyte))


@cache
def library() -> ctypes.CDLL:
    """MuJoCo's library, which the Python package has loaded already.

    Raises:
        ModelError: The installed package has no library.
    """
    folder = Path(mujoco.__file__).parent
    for pattern in ("libmujoco*.so*", "libmujoco*.dylib", "mujoco.dll"):
        for path in sorted(folder.glob(pattern)):
            return ctypes.CDLL(str(path))
    raise ModelError(f"mujoco: {folder} contains no MuJoCo library")


def release_loading_memory() -> None:
    """Frees the files that MuJoCo keeps for the next load, and returns freed memory to the system where it can be done.

    After the Panda was loaded, this is half of the memory of the process.
    """
    functions = library()
    functions.mj_getCache.restype = ctypes.c_void_p
    functions.mj_clearCache.argtypes = [ctypes.c_void_p]
    functions.mj_clearCache(functions.mj_getCache())
    with suppress(OSError, AttributeError):  # only glibc keeps freed memory and has this function
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def address_of(function: str) -> int:
    """The address of a function of MuJoCo."""
    return ctypes.cast(getattr(library(), function), ctypes.c_void_p).value or 0


@cache
def contact_layout() -> ContactLayout:
    """Where contacts are in this release, found by value in small models: MuJoCo publishes no offsets to Python.

    Raises:
        ModelError: They were not found.
    """
    is_count: BoolArray = np.ones(0, bool)
    layouts = set()
    for spheres, boxes in _COUNTS:
        bodies = [_SPHERE.format(k) for k in range(spheres)] + [_BOX.format(k) for k in range(boxes)]
        model = mujoco.MjModel.from_xml_string(_RESTING.format("".join(bodies)))
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        first = data.contact[0].geom.ctypes.data
        stride = data.contact.geom.strides[0]
        array = 0
        while not first - stride < _word(data, array) <= first:
            array += ctypes.sizeof(ctypes.c_void_p)
        layout = (array, stride, first - _word(data, array))
        words = np.ctypeslib.as_array((ctypes.c_int32 * (array // 4)).from_address(data._address))
        found = words == data.ncon
        data.qpos[2::7] += 1.0  # all bodies up: statistics, such as the largest number of contacts, stay
        mujoco.mj_forward(model, data)
        found &= words == 0
        is_count = is_count & found if layouts else found
        layouts.add(layout)
    counts = np.flatnonzero(is_count)
    if len(layouts) != 1 or len(counts) != 1:
        raise ModelError(f"mujoco {mujoco.__version__}: the contacts of MjData were not found; use the release armctl asks for")
    return ContactLayout(4 * int(counts[0]), *layouts.pop())


@cache
def disable_flags_offset() -> int:
    """The offset of `opt.disableflags` in mjModel, in bytes, found by value: it is one of the integers behind the arrays.

    Raises:
        ModelError: It was not found.
    """
    model = mujoco.MjModel.from_xml_string(_EMPTY_MODEL)
    begin = model.opt.o_friction.ctypes.data + model.opt.o_friction.nbytes
    integers = np.ctypeslib.as_array((ctypes.c_int32 * _OPTION_INTEGERS).from_address(begin))
    is_found = np.ones(len(integers), bool)
    for value in _FLAG_VALUES:
        model.opt.disableflags = value
        is_found &= integers == value
    if is_found.sum() != 1:
        raise ModelError(f"mujoco {mujoco.__version__}: the options of MjModel were not found; use the release armctl asks for")
    return begin + integers.itemsize * int(is_found.argmax()) - model._address


def _word(data: mujoco.MjData, offset: int) -> int:
    return ctypes.c_size_t.from_address(data._address + offset).value


class _Guard:
    """A pool of MuJoCo with one simulation."""

    def __init__(self) -> None:
        self._model = mujoco.MjModel.from_xml_string(_EMPTY_MODEL)
        functions = library()
        functions.mjb_makeBatch.restype = ctypes.c_void_p
        functions.mjb_error.restype = ctypes.c_char_p
        functions.mjb_deleteBatch.argtypes = [ctypes.c_void_p]
        error = ctypes.create_string_buffer(_ERROR_SIZE)
        config = _BatchConfig(1, 0)
        address = ctypes.c_void_p(self._model._address)
        self._pool = functions.mjb_makeBatch(address, 1, ctypes.byref(config), error, _ERROR_SIZE)
        if not self._pool:
            raise ModelError(f"mujoco: {error.value.decode(errors='replace'):.300}")
        self._functions = functions
        self._delete = functions.mjb_deleteBatch  # at the end of the interpreter, modules may be gone before this object is

    def call(self, function: int, argument: int) -> str:
        """Calls a C function `(model, data, sim, argument)`, which gets model and data of the pool.

        Returns:
            The message of the error by which MuJoCo ended the call; empty if it returned.
        """
        pool = ctypes.c_void_p(self._pool)
        failed = self._functions.mjb_apply(pool, None, 0, ctypes.c_void_p(function), ctypes.c_void_p(argument), 0)
        return self._functions.mjb_error(pool, 0).decode(errors="replace") if failed else ""

    def __del__(self) -> None:
        if getattr(self, "_pool", None):
            self._delete(self._pool)


class _Guards(threading.local):
    """A guard for each thread. It has no `__del__` itself: in a thread without a guard that would make one."""

    def __init__(self) -> None:
        self.guard = _Guard()


@cache
def _guards() -> _Guards:
    return _Guards()


def guarded_call(function: int, argument: int) -> str:
    """Calls compiled code without the GIL, inside `mjb_apply`, so that an error of MuJoCo does not end the process.

    Args:
        function: The address of a C function `(model, data, sim, argument)`; it works on what `argument` points to.
        argument: An address.

    Returns:
        The message of the error by which MuJoCo ended the call; empty if it returned.
    """
    return _guards().guard.call(function, argument)
