"""IkResult and IkBatch: the configurations that an IK solver found, and their measured errors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from armctl.core.result import Verdict
from armctl.core.target import RegionMember
from armctl.core.units import length_text
from armctl.core.validation import Array, BoolArray, IntArray, TextArray, frozen

FAR_M = 10.0  # more than any arm reaches: such a target was probably meant in millimetres
# rad, and m of an arm that reaches 1 m or more, else reaches. An unreachable target is rarely missed by so little, but a search
# near a singular configuration ends there: rounding of 1e-16 moves the joints by its square root.
NEAR_ROUNDING = 1e-6


@dataclass(frozen=True, eq=False, slots=True)
class IkResult(Verdict):
    """The result of one IK problem. `q` is finite and inside the joint limits, also if `ok` is False.

    `bool(result)` is `result.ok`. Two results are equal only if they are the same object.

    Attributes:
        ok: Whether both errors are inside the tolerances and the other conditions of the call hold.
        q: (n,) rad (m for a slide joint), read-only: the solution, or the best approximation.
        position_error: m, measured with the arm's own forward kinematics.
        orientation_error: rad, measured likewise; 0 if the orientation is not constrained.
        reason: Why `ok` is False, in words; empty if it is True.
        iterations: Solver steps over all starts.
        starts: From how many configurations the solver started.
        branch: The branch of the configuration `q`, such as "shoulder+ elbow- wrist+": the signs of the factors of
            the Jacobian's determinant, which change only at a singularity, where they are "0". None for an arm without a
            closed form.
        tip_errors: Of targets by tip, the position error, m, and the orientation error, rad, of each of them; then the two
            errors above are the largest ones. Empty for a single target.
        member: Of a region as the target, the pose that was chosen; None for another target.
    """

    ok: bool
    q: Array
    position_error: float
    orientation_error: float
    reason: str
    iterations: int
    starts: int
    branch: str | None = None
    tip_errors: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    member: RegionMember | None = None

    def __str__(self) -> str:
        if self.ok:
            return f"solved within {length_text(self.position_error)} and {self.orientation_error:.2g} rad"
        return f"not solved: {self.reason}"


BATCH_ARRAYS: Mapping[str, type] = {  # and their types
    "ok": np.bool_,
    "q": np.float64,
    "position_error": np.float64,
    "orientation_error": np.float64,
    "reason": object,
    "iterations": np.int64,
    "starts": np.int64,
}


@dataclass(frozen=True, eq=False, slots=True)
class IkBatch:
    """The results of N IK problems: the fields of IkResult as arrays. Its length is N, and `batch[i]` is an IkResult.

    `bool(batch)` tells whether all N are solved.

    Attributes:
        ok: (N,) bool.
        q: (N, n) rad (m for a slide joint).
        position_error: (N,) m.
        orientation_error: (N,) rad.
        reason: (N,) strings.
        iterations: (N,) int.
        starts: (N,) int.
        branch: N strings or None.
        is_complete: Whether the rows are proved to be all solutions of one target; only `solve_ik_all` sets it.
    """

    ok: BoolArray
    q: Array
    position_error: Array
    orientation_error: Array
    reason: TextArray
    iterations: IntArray
    starts: IntArray
    branch: tuple[str | None, ...]
    is_complete: bool = False

    def __len__(self) -> int:
        return len(self.q)

    def __bool__(self) -> bool:
        return bool(self.ok.all())

    def __getitem__(self, i: int) -> IkResult:
        return IkResult(
            ok=bool(self.ok[i]),
            q=self.q[i],
            position_error=float(self.position_error[i]),
            orientation_error=float(self.orientation_error[i]),
            reason=self.reason[i],
            iterations=int(self.iterations[i]),
            starts=int(self.starts[i]),
            branch=self.branch[i],
        )

    def __str__(self) -> str:
        return f"{int(self.ok.sum())} of {len(self)} solved"


def batch_of(results: Iterable[IkResult], n: int) -> IkBatch:
    """The results of single problems of an arm with n joints as those of a batch."""
    found = list(results)
    columns = {name: np.array([getattr(each, name) for each in found], kind) for name, kind in BATCH_ARRAYS.items()}
    columns["q"] = columns["q"].reshape(len(found), n)
    arrays: dict[str, Any] = {name: frozen(column) for name, column in columns.items()}
    return IkBatch(**arrays, branch=tuple(each.branch for each in found))


def no_solution_without_contact(starts: int, contact: str) -> str:
    """Why all solutions of so many starts count for nothing; the last one's contact."""
    return f"no solution without contact found in {starts} starts: {contact}"


def failure_reason(out_of_reach: bool, position_error: float, orientation_error: float, starts: int, reach: float) -> str:
    """Why a best approximation with these errors, m and rad, is not a solution for an arm of this reach, m."""
    if position_error <= NEAR_ROUNDING * min(reach, 1.0) and orientation_error <= NEAR_ROUNDING:
        errors = f"{position_error:.2g} m and {orientation_error:.2g} rad"
        return f"reached up to {errors}, which is near rounding; give larger tolerances"
    if out_of_reach:
        units = "; positions are in metres" if position_error > FAR_M else ""
        return f"out of reach by {length_text(position_error)}{units}"
    if orientation_error > 0:
        least = f"{orientation_error:.3g} rad off in the best of {starts} starts"
        return f"the point is reachable, but not with this orientation: {least}"
    return f"no solution within the joint limits found in {starts} starts"
