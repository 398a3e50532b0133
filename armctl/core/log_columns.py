"""The arrays over time of a log, with their columns and units: the one list that `Log`, its files and the recorder use."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from armctl.core import units
from armctl.core.validation import Array


class Quantity(NamedTuple):
    """An array over time."""

    unit: str  # the unit of its columns, in which "joint" stands for rad or m, and "torque" for N m or N
    axes: tuple[str, ...] = ()  # the names of its columns; empty for one column per joint, or per position of the model
    is_optional: bool = False  # whether a log may lack it
    is_per_tip: bool = False  # whether it has these axes for each tip but the first

    @property
    def is_per_joint(self) -> bool:
        return self.unit.startswith(("joint", "torque"))


_QUATERNION = Quantity("", tuple("wxyz"))
_POINT = Quantity("m", tuple("xyz"))
POSE_AXES = ("x", "y", "z", "qw", "qx", "qy", "qz")
_POSES = Quantity("pose", POSE_AXES, is_optional=True, is_per_tip=True)
QUANTITIES = {
    "q": Quantity("joint"),
    "v": Quantity("joint/s"),
    "q_ref": Quantity("joint"),
    "v_ref": Quantity("joint/s"),
    "a_ref": Quantity("joint/s^2"),
    "tau": Quantity("torque"),
    "tau_cmd": Quantity("torque"),
    "tip": _POINT,
    "tip_quat": _QUATERNION,
    "tip_ref": _POINT,
    "tip_ref_quat": _QUATERNION,
    "qpos": Quantity("", is_optional=True),
    "wrench": Quantity("wrench", ("fx", "fy", "fz", "tx", "ty", "tz"), is_optional=True),
    "other_tips": _POSES,
    "other_tips_ref": _POSES,
}
_PER_JOINT = tuple(name for name, quantity in QUANTITIES.items() if quantity.is_per_joint)
REFERENCES = tuple(name for name in _PER_JOINT if name.endswith("_ref"))
STATES = tuple(name for name in _PER_JOINT if name not in REFERENCES)


class LogColumn(NamedTuple):
    """One column of a flat table: the array of the log and the place in it, its name and its unit."""

    array: str
    place: int
    name: str
    unit: str


def widths(arrays: Mapping[str, Array]) -> dict[str, int]:
    """The number of columns of each optional array that a log has."""
    optional = [name for name, each in QUANTITIES.items() if each.is_optional and len(arrays.get(name, ()))]
    return {name: arrays[name].shape[1] for name in optional}


def columns(
    joint_names: Sequence[str], joint_units: Sequence[str], optional: Mapping[str, int], tip_names: Sequence[str] = ()
) -> list[LogColumn]:
    """The columns of a flat table: "t", "q/joint1", ..., "tip/x", ..., "qpos/0"; `optional` as from `widths`."""
    torque_units = units.of_torque(joint_units)
    out = [LogColumn("t", 0, "t", "s")]
    for array, quantity in QUANTITIES.items():
        if quantity.is_optional and array not in optional:
            continue
        axes = joint_names if quantity.is_per_joint else quantity.axes or [str(i) for i in range(optional[array])]
        if quantity.is_per_tip:
            axes = [f"{tip}/{axis}" for tip in tip_names[1:] for axis in quantity.axes]
        for i, axis in enumerate(axes):
            unit = quantity.unit
            if quantity.is_per_joint:
                unit = unit.replace("joint", joint_units[i]).replace("torque", torque_units[i])
            elif unit == "wrench":
                unit = "N" if axis.startswith("f") else "N m"
            elif unit == "pose":
                unit = "m" if axis.rpartition("/")[2] in _POINT.axes else ""
            out.append(LogColumn(array, i, f"{array}/{axis}", unit))
    return out


def flat(arrays: Mapping[str, Array], layout: Sequence[LogColumn]) -> dict[str, Array]:
    """The arrays over time as vectors by the names of their columns."""
    out = {}
    for column in layout:
        values = arrays[column.array]
        out[column.name] = values if values.ndim == 1 else values[:, column.place]
    return out
