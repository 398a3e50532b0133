"""MoveResult: how a move ended."""

from __future__ import annotations

from dataclasses import dataclass

from armctl.core.log import Log


@dataclass(frozen=True, eq=False)
class MoveResult:
    """How a move ended.

    Attributes:
        ok: Whether the tip is at the target and at rest.
        position_error: m, measured in the simulation.
        orientation_error: rad, measured likewise; 0 where no orientation was asked for.
        duration: s of simulated time.
        reason: Why it was not reached, in words; empty if it was.
        log: Every tick of it; None where nothing moved.
    """

    ok: bool
    position_error: float
    orientation_error: float
    duration: float
    reason: str
    log: Log | None

    def __bool__(self) -> bool:
        return self.ok

    def __str__(self) -> str:
        if self.ok:
            return f"reached within {max(1e3 * self.position_error, 0.01):.2g} mm in {self.duration:.2f} s"
        return f"not reached: {self.reason}"
