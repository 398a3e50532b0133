"""MuJoCo's C library: what the compiled core calls of it."""

import ctypes
from contextlib import suppress
from functools import cache
from pathlib import Path

import mujoco

from armctl import _core
from armctl.core.errors import ModelError

# The model of the batch in which the core calls MuJoCo; each thread copies it, and works on other models.
_EMPTY_MODEL = '<mujoco><size memory="64K"/></mujoco>'


@cache
def library() -> ctypes.CDLL:
    """MuJoCo's library, which the Python package has loaded already."""
    folder = Path(mujoco.__file__).parent
    for pattern in ("libmujoco*.so*", "libmujoco*.dylib", "mujoco.dll"):
        for path in sorted(folder.glob(pattern)):
            return ctypes.CDLL(str(path))
    raise ModelError(f"mujoco: {folder} contains no MuJoCo library")


def release_loading_memory() -> None:
    """Frees the files that MuJoCo keeps for the next load: after the Panda, half of the memory. glibc's freed memory too."""
    functions = library()
    functions.mj_getCache.restype = ctypes.c_void_p
    functions.mj_clearCache.argtypes = [ctypes.c_void_p]
    functions.mj_clearCache(functions.mj_getCache())
    with suppress(OSError, AttributeError):  # only glibc keeps freed memory and has this function
        ctypes.CDLL("libc.so.6").malloc_trim(0)


@cache
def mujoco_api() -> _core.MujocoApi:
    """What the compiled core calls of MuJoCo. Threads that ask at the same time may get different objects."""
    from armctl.run.sim.mujoco_structs import contact_layout, repair_layout

    contacts = contact_layout()
    repairs = repair_layout()
    return _core.MujocoApi(
        step=_address_of("mj_step"),
        rne_post_constraint=_address_of("mj_rnePostConstraint"),
        make_batch=_address_of("mjb_makeBatch"),
        delete_batch=_address_of("mjb_deleteBatch"),
        apply=_address_of("mjb_apply"),
        error=_address_of("mjb_error"),
        empty_model=mujoco.MjModel.from_xml_string(_EMPTY_MODEL),
        contact_count=contacts.size,
        contact_array=contacts.array,
        contact_stride=contacts.stride,
        contact_geoms=contacts.geoms,
        contact_exclude=contacts.exclude,
        repair_first=repairs.first,
        repair_stride=repairs.stride,
    )


def _address_of(function: str) -> int:
    return ctypes.cast(getattr(library(), function), ctypes.c_void_p).value or 0
