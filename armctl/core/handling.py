"""What picking and placing return: the grasp that was chosen, whether the body is held, and where it was put."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armctl.core.pose import Pose
from armctl.core.result import GripResult, MoveResult, Verdict
from armctl.core.validation import Array

_STEEP = 0.87  # the cosine of 30 degrees, up to which a direction counts as vertical
_FLAT = 0.5  # the cosine of 60 degrees, from which on it counts as level


@dataclass(frozen=True, eq=False)
class Grasp:
    """How a gripper holds a body.

    Attributes:
        tip: T_world_tip when it closes.
        width: m between the pads when they touch the body.
        pointing: (3,) the direction of the fingers, in the world.
        closing: (3,) the direction in which they close, likewise.
    """

    tip: Pose
    width: float
    pointing: Array
    closing: Array

    def __str__(self) -> str:
        down = -float(self.pointing[2])
        if abs(down) >= _STEEP:
            side = "from above" if down > 0.0 else "from below"
        elif abs(down) <= _FLAT:
            side = "from the side"
        else:
            side = "from obliquely above" if down > 0.0 else "from obliquely below"
        return f"{side}, {1e3 * self.width:.3g} mm wide"


class _Handled(Verdict):
    """What the results of `pick` and `place` have in common."""

    body: str
    grip: GripResult | None
    moves: tuple[MoveResult, ...]

    @property
    def duration(self) -> float:
        """How long the moves and the gripper took, s."""
        return sum(move.duration for move in self.moves) + (0.0 if self.grip is None else self.grip.duration)

    @property
    def touched(self) -> tuple[str, ...]:
        """What the arm touched besides the body."""
        contacts = (contact for move in self.moves for contact in move.contacts)
        others = (each.other for each in contacts if self.body not in (each.body, each.other))
        return tuple(dict.fromkeys(others))

    def _done(self) -> str:
        """How long it took, and what was touched."""
        return f"in {self.duration:.2f} s" + (f"; touched {', '.join(self.touched)}" if self.touched else "")


@dataclass(frozen=True, eq=False)
class PickResult(_Handled):
    """The result of `pick`. `bool(result)` is `result.ok`.

    Attributes:
        ok: Whether the body is held and lifted.
        body: Its name.
        reason: The reason if it is not ok; empty if it is.
        held: Whether the body is in the gripper at the end, lifted or not.
        grasp: The grasp that was chosen; None if there is none that the arm can make.
        grip: How the gripper closed; None if it did not.
        moves: The moves of the arm, in their order.
    """

    ok: bool
    body: str
    reason: str
    held: bool = False
    grasp: Grasp | None = None
    grip: GripResult | None = None
    moves: tuple[MoveResult, ...] = ()

    def __str__(self) -> str:
        if not self.ok:
            return f"{self.body} is not picked: {self.reason}"
        return f"holds {self.body} {self.grasp}, picked {self._done()}"


@dataclass(frozen=True, eq=False)
class PlaceResult(_Handled):
    """The result of `place`. `bool(result)` is `result.ok`.

    Attributes:
        ok: Whether the body stands where it was to be put, and the gripper is away.
        body: Its name.
        reason: The reason if it is not ok; empty if it is.
        pose: T_world_body, where it was to be put; None if the arm can put it nowhere there.
        position_error: m, how far it is from there; NaN where a robot does not see it.
        orientation_error: rad, likewise.
        grip: How the gripper opened; None if it did not.
        moves: The moves of the arm, in their order.
    """

    ok: bool
    body: str
    reason: str
    pose: Pose | None = None
    position_error: float = np.nan
    orientation_error: float = np.nan
    grip: GripResult | None = None
    moves: tuple[MoveResult, ...] = ()

    def __str__(self) -> str:
        if not self.ok:
            return f"{self.body} is not placed: {self.reason}"
        within = "" if np.isnan(self.position_error) else f" within {1e3 * self.position_error:.2g} mm"
        return f"placed {self.body}{within} {self._done()}"
