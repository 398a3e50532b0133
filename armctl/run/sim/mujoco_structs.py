"""Where MuJoCo keeps contacts and warnings, from the fields of its structs that `mujoco.introspect` lists.

Import this only in a function that needs it, because the lists take long to load.
"""

import ctypes
from functools import cache
from typing import Any, NamedTuple

import mujoco
from mujoco.introspect.ast_nodes import ArrayType, PointerType
from mujoco.introspect.structs import STRUCTS

from armctl.core.errors import ModelError

_ONE_JOINT = '<mujoco><worldbody><body><joint/><geom size="1"/></body></worldbody></mujoco>'
_C_TYPES = {
    "int": ctypes.c_int,
    "mjtNum": ctypes.c_double,
    "mjtSize": ctypes.c_int64,
    "mjtBool": ctypes.c_ubyte,
    "size_t": ctypes.c_size_t,
    "uintptr_t": ctypes.c_size_t,
    "uint64_t": ctypes.c_uint64,
}


class ContactLayout(NamedTuple):
    """Where MjData keeps its contacts, in bytes."""

    size: int  # offset of `ncon` in mjData
    array: int  # offset of the pointer `contact` in mjData
    stride: int  # size of an mjContact
    geoms: int  # offset of `geom` in mjContact
    exclude: int  # offset of `exclude` in mjContact


class RepairLayout(NamedTuple):
    """Where MjData counts what MuJoCo repaired, in bytes: mjWARN_BADQPOS, BADQVEL, BADQACC and BADCTRL."""

    first: int  # offset of the first count in mjData
    stride: int  # size of an mjWarningStat


@cache
def repair_layout() -> RepairLayout:
    """Where these counts are in this release; ModelError if MjData is not laid out as its structs are listed."""
    contact_layout()
    kinds = [int(getattr(mujoco.mjtWarning, f"mjWARN_{name}")) for name in ("BADQPOS", "BADQVEL", "BADQACC", "BADCTRL")]
    if kinds != list(range(kinds[0], kinds[0] + 4)):
        raise ModelError(f"mujoco {mujoco.__version__}: its warnings have another order; use the release armctl asks for")
    stat = _struct("mjWarningStat")
    stride = ctypes.sizeof(stat)
    return RepairLayout(_struct("mjData").warning.offset + kinds[0] * stride + stat.number.offset, stride)


@cache
def contact_layout() -> ContactLayout:
    """Where contacts are in this release, by its structs; ModelError if MjData is not laid out as they are listed."""
    data_struct = _struct("mjData")
    contact_struct = _struct("mjContact")
    data = mujoco.MjData(mujoco.MjModel.from_xml_string(_ONE_JOINT))
    if data_struct.from_address(data._address).qpos != data.qpos.ctypes.data:
        raise ModelError(f"mujoco {mujoco.__version__}: MjData has another layout; use the release armctl asks for")
    return ContactLayout(
        size=data_struct.ncon.offset,
        array=data_struct.contact.offset,
        stride=ctypes.sizeof(contact_struct),
        geoms=contact_struct.geom.offset,
        exclude=contact_struct.exclude.offset,
    )


@cache
def _struct(name: str) -> Any:
    """A struct of MuJoCo, with the fields that the package lists."""
    listed: Any = STRUCTS[name].fields  # the structs read here have no anonymous unions
    fields = [(each.name, _c_type(each.type)) for each in listed]
    return type(name, (ctypes.Structure,), {"_fields_": fields})


def _c_type(listed: Any) -> Any:
    if isinstance(listed, PointerType):
        return ctypes.c_void_p
    if isinstance(listed, ArrayType):
        kind = _c_type(listed.inner_type)
        for extent in reversed(listed.extents):
            kind = kind * extent
        return kind
    return _C_TYPES.get(listed.name) or _struct(listed.name)
