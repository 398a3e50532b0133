"""Results: Verdict, the base of those that say whether they are ok, and MoveResult, how a move ended."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from armctl.core.errors import few_names, pairs_in_words
from armctl.core.log import Contact, Log
from armctl.core.target import RegionMember

_NOTED_M = 1e-3  # a result names a clearance that is less


class Verdict:
    """A result that is true if it is ok."""

    __slots__ = ()
    ok: bool

    def __bool__(self) -> bool:
        return self.ok


def left_out_text(pairs: Sequence[tuple[str, str]]) -> str:
    """What a proof left out, for the end of a sentence; empty if it left out nothing that a simulation keeps."""
    return f"; not proved, since they always touch: {pairs_in_words(pairs)}" if pairs else ""


@dataclass(frozen=True, eq=False)
class MoveResult(Verdict):
    """The result of a move. `bool(result)` is `result.ok`.

    Attributes:
        ok: Whether the tip is at the target and at rest.
        position_error: m, measured in the simulation.
        orientation_error: rad, measured likewise; 0 if any orientation is accepted.
        duration: s of simulated time.
        reason: The reason if it is not ok; empty if it is.
        log: Every tick of it; None if nothing moved.
        unchecked_links: The links of the arm without a collision shape that they need: no contact was excluded, and a
            simulation sees none. Empty if all have one.
        clearance: m, how much the planned motion is proved to keep from everything; infinite if nothing can touch, NaN if no
            motion was proved.
        left_out: Pairs of names of bodies that touch by design, and that the proof of the motion left out though a simulation
            keeps their contact. `load` takes such contacts out of the model where it can.
        member: Of a region as the target, the pose that the motion goes to; None for another target, or without a motion.
        tip_errors: By tip the distance, m, and the angle, rad, from its target, where the targets were by tip; else empty.
    """

    ok: bool
    position_error: float
    orientation_error: float
    duration: float
    reason: str
    log: Log | None
    unchecked_links: tuple[str, ...] = ()
    clearance: float = math.nan
    left_out: tuple[tuple[str, str], ...] = ()
    member: RegionMember | None = None
    tip_errors: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def __str__(self) -> str:
        if not self.ok:
            return f"not reached: {self.reason}"
        reached = f"reached within {max(1e3 * self.position_error, 0.01):.2g} mm in {self.duration:.2f} s"
        touched = ", ".join(dict.fromkeys(contact.other for contact in self.contacts))
        if self.unchecked_links:
            reached += f"; contacts not checkable, no collision shape for {few_names(self.unchecked_links)}"
        if self.clearance < _NOTED_M:
            reached += f"; proved to keep only {1e3 * self.clearance:.2g} mm"
        if self.member is not None:
            reached += f", {self.member}"
        reached += left_out_text(self.left_out)
        return f"{reached}; touched {touched}" if touched else reached

    def _repr_html_(self) -> str:
        return f"<p>{'&#10003;' if self.ok else '&#10007;'} {html.escape(str(self))}</p>"

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """What the arm touched; empty if it touched nothing or did not move."""
        return () if self.log is None else self.log.contacts


@dataclass(frozen=True)
class GripResult(Verdict):
    """The result of a movement of the gripper. `bool(result)` is `result.ok`.

    Attributes:
        ok: Whether the gripper grasped something, or reached the requested width.
        grasped: Whether something is held between the pads.
        held: The body that is held; empty if none. Only a body that moves can be held: a loose one, or the handle of a door.
        width: m between the pads.
        force: N, the contact force on the held body; the smaller of the two sides.
        duration: s of simulated time.
        reason: The reason if it is not ok; empty if it is.
    """

    ok: bool
    grasped: bool
    held: str
    width: float
    force: float
    duration: float
    reason: str

    def __str__(self) -> str:
        if self.grasped:
            done = f"grasped {self.held!r} with {self.force:.3g} N, {1e3 * self.width:.3g} mm wide"
            return done if self.ok else f"{done}; {self.reason}"
        return f"open {1e3 * self.width:.3g} mm" if self.ok else self.reason
