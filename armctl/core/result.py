"""Results: Verdict, the base of those that say whether they are ok, and MoveResult, how a move ended."""

from __future__ import annotations

import html
from dataclasses import dataclass

from armctl.core.errors import few_names
from armctl.core.log import Contact, Log


class Verdict:
    """A result that is true if it is ok."""

    __slots__ = ()
    ok: bool

    def __bool__(self) -> bool:
        return self.ok


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
    """

    ok: bool
    position_error: float
    orientation_error: float
    duration: float
    reason: str
    log: Log | None
    unchecked_links: tuple[str, ...] = ()

    def __str__(self) -> str:
        if not self.ok:
            return f"not reached: {self.reason}"
        reached = f"reached within {max(1e3 * self.position_error, 0.01):.2g} mm in {self.duration:.2f} s"
        touched = ", ".join(dict.fromkeys(contact.other for contact in self.contacts))
        if self.unchecked_links:
            reached += f"; contacts not checkable, no collision shape for {few_names(self.unchecked_links)}"
        return f"{reached}; touched {touched}" if touched else reached

    def _repr_html_(self) -> str:
        return f"<p>{'&#10003;' if self.ok else '&#10007;'} {html.escape(str(self))}</p>"

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """What the arm touched; empty if it touched nothing or did not move."""
        return () if self.log is None else self.log.contacts
