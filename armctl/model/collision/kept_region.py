"""The region in which the tip stays during a whole motion: a cone of an axis, a plane, an arc."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from armctl.core.pose import Pose
from armctl.core.region import RegionPart
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm

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
        return float(self._excesses(self.part.coordinates(self.arm.fk(q))).max())

    def why_outside(self, q: Array) -> str:
        """Which coordinate of the tip at q (n,) is out of bounds or at one, and by how much; empty if none is."""
        coordinates = self.part.coordinates(self.arm.fk(q))
        excesses = self._excesses(coordinates)
        worst = int(excesses.argmax())
        excess = float(excesses[worst])
        if excess <= -_EDGE:
            return ""
        low, high = self.part.coordinate_bounds[worst]
        name, unit = self.part.coordinate_names[worst]
        where = f"its {name} is {coordinates[worst]:.6g} {unit}"
        allowed = f"[{0.0 if name == 'tilt' else low:.6g}, {high:.6g}]"
        if excess > _EDGE:
            return f"the tip is outside the region: {where}, {excess:.3g} {unit} outside {allowed}"
        return f"the tip is at the edge of the region: {where}, expected it at least {_EDGE:g} {unit} inside {allowed}"

    def _excesses(self, coordinates: Array) -> Array:
        bounds = self.part.coordinate_bounds
        return np.maximum(bounds[:, 0] - coordinates, coordinates - bounds[:, 1])
