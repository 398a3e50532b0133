"""IkResult: what an IK solver found, and how far off it measured it to be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from armctl.core.validation import Array, BoolArray, IntArray, TextArray


class IkResult(NamedTuple):
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

    __eq__, __ne__, __hash__ = object.__eq__, object.__ne__, object.__hash__  # each is itself alone: arrays have no one answer

    def __str__(self) -> str:
        if self.ok:
            return f"solved within {1e3 * self.position_error:.2g} mm and {self.orientation_error:.2g} rad"
        return f"not solved: {self.reason}"


@dataclass(frozen=True, eq=False, slots=True)
class IkBatch:
    """The outcome of N IK problems: the fields of IkResult as arrays. Its length is N, and `batch[i]` is one IkResult.

    Attributes:
        ok: (N,) bool.
        q: (N, n) rad.
        position_error: (N,) m.
        orientation_error: (N,) rad.
        reason: (N,) strings.
        iterations: (N,) int.
        starts: (N,) int.
    """

    ok: BoolArray
    q: Array
    position_error: Array
    orientation_error: Array
    reason: TextArray
    iterations: IntArray
    starts: IntArray

    def __len__(self) -> int:
        return len(self.ok)

    def __getitem__(self, i: int) -> IkResult:
        return IkResult(
            bool(self.ok[i]),
            self.q[i],
            float(self.position_error[i]),
            float(self.orientation_error[i]),
            self.reason[i],
            int(self.iterations[i]),
            int(self.starts[i]),
        )

    def __str__(self) -> str:
        return f"{int(self.ok.sum())} of {len(self)} solved"


def why_not(out_of_reach: bool, position_error: float, starts: int) -> str:
    """The reason of a failure in words.

    Args:
        out_of_reach: Whether the tip cannot come to its point at all.
        position_error: m by which it misses it.
        starts: From how many positions the solver started.

    Returns:
        Such as "0.312 m out of reach".
    """
    if not out_of_reach:
        return f"no solution within the joint limits found in {starts} starts"
    return f"{position_error:.3g} m out of reach" if position_error < 1e3 else f"{position_error:.0f} m out of reach"
