"""The region in which the tip stays during a whole motion: a cone of an axis, a plane, an arc."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from armctl.core.errors import InputError, UnknownNameError
from armctl.core.pose import Pose
from armctl.core.region import Region, RegionPart
from armctl.core.validation import Array, number, shown
from armctl.model.arm.arm import Arm, check_one_tip

KEEP_WITHIN_RAD = 0.1
_MIN_KEEP_WITHIN_RAD = 1e-3
_MAX_KEEP_WITHIN_RAD = 0.5 * np.pi
_MIN_THICKNESS = 1e-4  # m or rad, of a region: a proof of a line in a thinner one has too many intervals
_EDGE = 1e-5  # m or rad: a tip so near to a limit cannot leave it for a proof


@dataclass(frozen=True, eq=False)
class KeptRegion:
    """A region of one part in which the tip stays.

    Attributes:
        arm: The arm whose tip it is.
        part: Where the tip stays.
        q: (n,) rad, a configuration: its tip shows how the tip sits on the last link.
        axis: "x", "y" or "z", if only the tilt of this axis is limited, by its direction at q; else None.
    """

    arm: Arm
    part: RegionPart
    q: Array
    axis: str | None = None

    @cached_property
    def tip(self) -> Pose:
        """T_world_tip at `q`."""
        return self.arm.fk(self.q)

    @property
    def only_tilts(self) -> bool:
        """Whether the region limits nothing but the tilt of an axis."""
        return self.part.free is not None and not np.isfinite(self.part.bounds[:3]).any()

    def excess(self, q: Array) -> float:
        """m or rad, how far the tip at q (n,) is outside in its worst coordinate; negative inside."""
        coordinates = self.part.coordinates(self.arm.fk(q))
        bounds = self.part.coordinate_bounds
        return float(np.maximum(bounds[:, 0] - coordinates, coordinates - bounds[:, 1]).max())

    def why_outside(self, q: Array) -> str:
        """Which coordinate of the tip at q (n,) is out of bounds or at one, and by how much; empty if none is."""
        excess = self.excess(q)
        if excess <= -_EDGE:
            return ""
        coordinates = self.part.coordinates(self.arm.fk(q))
        bounds = self.part.coordinate_bounds
        worst = int(np.maximum(bounds[:, 0] - coordinates, coordinates - bounds[:, 1]).argmax())
        name, unit = self.part.coordinate_names[worst]
        low = 0.0 if name == "tilt" else bounds[worst, 0]
        high = bounds[worst, 1]
        where = f"its {name} is {coordinates[worst]:.6g} {unit}"
        allowed = f"[{low:.6g}, {high:.6g}]"
        if excess > _EDGE:
            return f"the tip is outside the region: {where}, {excess:.3g} {unit} outside {allowed}"
        return f"the tip is at the edge of the region: {where}, expected it at least {_EDGE:g} {unit} inside {allowed}"


def read_kept_region(arm: Arm, keep: str | Region | None, keep_within: float, q: Array) -> KeptRegion | None:
    """What the tip keeps: "x", "y" or "z", an axis with its direction at q (n,) within an angle, or a Region; None for None."""
    within = number("keep_within", keep_within, _MIN_KEEP_WITHIN_RAD, _MAX_KEEP_WITHIN_RAD)
    if keep is None:
        return None
    if isinstance(keep, Region):
        if within != KEEP_WITHIN_RAD:
            raise InputError("keep_within: it belongs to keep='z'; a region has bounds or a cone of its own")
        return KeptRegion(arm=arm, part=_checked_part(arm, keep), q=q)
    if not isinstance(keep, str):
        raise UnknownNameError.from_known("axis to keep", shown(keep), ["x", "y", "z"])
    if keep not in ("x", "y", "z"):
        raise UnknownNameError.from_known("axis to keep", f"{keep:.80}", ["x", "y", "z"])
    upright = Region.upright(arm.fk(q), keep, cone=within)
    return KeptRegion(arm=arm, part=upright.parts[0], q=q, axis=keep)


def _checked_part(arm: Arm, region: Region) -> RegionPart:
    """The part of a region in which a tip can stay during a motion. InputError if there is none."""
    check_one_tip(arm)
    if len(region) > 1:
        raise InputError(
            f"keep: the region is a union of {len(region)} parts; the tip can stay in one part only, give region[0]"
        )
    (part,) = region.parts
    if part.free is not None and part.cone < _MIN_KEEP_WITHIN_RAD:
        raise InputError(f"keep: the cone of the region is {part.cone:g} rad; give at least {_MIN_KEEP_WITHIN_RAD:g} rad")
    widths = part.coordinate_bounds[:, 1] - part.coordinate_bounds[:, 0]
    for (name, unit), width in zip(part.coordinate_names, widths.tolist(), strict=True):
        if width < _MIN_THICKNESS:
            raise InputError(
                f"keep: the region is {width:g} {unit} thick in {name}, and no motion of joints stays in it; "
                f"give bounds at least {_MIN_THICKNESS:g} {unit} apart"
            )
    return part
