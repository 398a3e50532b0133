"""IkResult: what an IK solver found, and how far off it measured it to be."""

from __future__ import annotations

from dataclasses import dataclass

from armctl.arrays import Array


@dataclass(frozen=True, eq=False, slots=True)
class IkResult:
    """The outcome of one IK problem. `q` is finite and inside the joint limits, also where `ok` is False.

    Attributes:
        ok: Whether both errors are inside the tolerance and everything else that was asked for holds.
        q: (n,) rad, the solution, or the best effort.
        position_error: m, measured with the arm's own forward kinematics.
        orientation_error: rad, measured likewise; 0 where no orientation was asked for.
        reason: Why `ok` is False, in words; empty where it is True.
        iterations: Steps of the solver, over all its starts.
        starts: From how many positions it started.
    """

    ok: bool
    q: Array
    position_error: float
    orientation_error: float
    reason: str
    iterations: int
    starts: int

    def __str__(self) -> str:
        if self.ok:
            return f"solved within {1e3 * self.position_error:.2g} mm and {self.orientation_error:.2g} rad"
        return f"not solved: {self.reason}"
