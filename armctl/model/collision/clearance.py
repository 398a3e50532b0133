"""check_clearance: a proof that a whole motion keeps its distance, and how near it comes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np

from armctl._core import MAX_DEGREE
from armctl.core.errors import InputError
from armctl.core.region import Region
from armctl.core.result import Verdict, left_out_text
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, number
from armctl.model.arm.arm import Arm, check_arm
from armctl.model.collision.checker import CollisionChecker
from armctl.model.collision.checkers import KEEP_WITHIN_RAD, collision_checker, read_kept_region
from armctl.model.collision.kept_region import KeptRegion
from armctl.model.collision.world_snapshot import WorldLike

_NO_PAIRS_M = np.inf
_UNKNOWN = np.nan
_UNDECIDED_M = 3e-4  # a distance that exceeds the clearance by more was not the reason why a proof stopped


@runtime_checkable
class PiecewiseTrajectory(Protocol):
    """A trajectory of polynomial pieces, such as every planner of armctl returns."""

    @property
    def knots(self) -> Array: ...  # (K + 1,) s

    @property
    def coefficients(self) -> Array: ...  # (K, degree + 1, n) of each piece, by powers of the time since its knot

    @property
    def joint_names(self) -> tuple[str, ...]: ...

    @property
    def duration(self) -> float: ...  # s

    def __call__(self, t: float) -> Setpoint: ...


@dataclass(frozen=True)
class ClearanceCheck(Verdict):
    """The smallest distance of an arm from itself and from its scene during a motion.

    Attributes:
        ok: Whether the motion is proved to keep more than the clearance at all times.
        distance: m. If ok, a proved lower bound of the distance over the whole continuous motion, at most 0.2 mm below a
            distance that is attained. Otherwise a distance that occurs, negative where geoms overlap; NaN if a link has no
            collision shape, so that nothing is known.
        time: s, when the arm is nearest (if not ok: when it is too near); NaN likewise.
        first: One body of the nearest pair; empty if nothing can touch, the tip leaves its region, or a link has no shape.
        second: The other.
        clearance: The required clearance, m.
        reason: Why it is not ok, in one sentence; empty if it is.
        left_out: Pairs of names of bodies that touch by design, and that the proof leaves out though a simulation keeps their
            contact.
    """

    ok: bool
    distance: float
    time: float
    first: str
    second: str
    clearance: float
    reason: str
    left_out: tuple[tuple[str, str], ...] = ()

    def __str__(self) -> str:
        if not self.ok:
            return self.reason
        if not self.first:
            return f"nothing can touch{left_out_text(self.left_out)}"
        nearest = f"at least {1e3 * self.distance:.2f} mm, between {self.first} and {self.second} at {self.time:.3f} s"
        return f"{nearest}{left_out_text(self.left_out)}"


def check_clearance(
    arm: Arm,
    trajectory: PiecewiseTrajectory,
    clearance: float = 0.0,
    allow: Iterable[tuple[str, str]] = (),
    *,
    keep: str | Region | None = None,
    keep_within: float = KEEP_WITHIN_RAD,
    world: WorldLike | None = None,
) -> ClearanceCheck:
    """Proves that a motion keeps more than a clearance, by bisection with bounds of each link's motion, never by samples.

    The geometry is MuJoCo's: convex hulls and primitives, everything outside the arm's chain at home. Each geom is larger by
    its contact margin, since MuJoCo's contacts act as soon as the margins meet. Pairs that touch by design are left out, and so
    are neighboring links that are proved apart over the whole range of their joint. An arm with links that need a collision
    shape and have none (`arm.unchecked_links`) is not ok, whatever it does. The proof is of the planned motion: choose the
    clearance for tracking errors and bodies that move.

    Args:
        arm: The arm, in its scene.
        trajectory: The motion, of polynomial pieces.
        clearance: m, at least 0.
        allow: Pairs of names of bodies or geoms that may touch.
        keep: "x", "y" or "z": the axis of the tip that must keep the direction it has at the start, as for a glass; or a Region
            of one part in which the tip must stay: a plane, an arc, a cone.
        keep_within: rad that this axis may tilt.
        world: What is around the arm besides its scene: a World, or a snapshot of one.

    Returns:
        The check: whether the proof succeeds, and the closest approach.

    Raises:
        InputError: An argument of the wrong kind, a negative clearance, or a motion of other joints.
        ModelError: The scene has a height field or signed distance field that the arm could touch.
        UnknownNameError: The model has no body or geom of a name in `allow`, or there is no such axis.
    """
    check_arm(arm)
    clearance = number("clearance", clearance, 0.0)
    if not isinstance(trajectory, PiecewiseTrajectory):
        raise InputError(
            f"trajectory: {trajectory!r:.80} is not a motion of polynomial pieces; armctl.move_j(arm, arm.home, q) is one"
        )
    if trajectory.joint_names != arm.joint_names:
        raise InputError(
            f"trajectory: it moves {', '.join(trajectory.joint_names)[:80]}, the arm has {', '.join(arm.joint_names)[:80]}"
        )
    kept = read_kept_region(arm, keep, keep_within, trajectory(0.0).q)
    checker = collision_checker(arm, allow=allow, world=world)
    if checker.not_checkable:
        return ClearanceCheck(
            ok=False, distance=_UNKNOWN, time=_UNKNOWN, first="", second="", clearance=clearance, reason=checker.not_checkable
        )
    return clearance_of(checker, trajectory, clearance, kept)


def clearance_of(
    checker: CollisionChecker, trajectory: PiecewiseTrajectory, clearance: float, keep: KeptRegion | None = None
) -> ClearanceCheck:
    """As `check_clearance`, with a checker that is at hand, and of the shapes that there are."""
    return replace(_clearance_of(checker, trajectory, clearance, keep), left_out=checker.left_out)


def _clearance_of(
    checker: CollisionChecker, trajectory: PiecewiseTrajectory, clearance: float, keep: KeptRegion | None
) -> ClearanceCheck:
    checker.require_convex()
    if trajectory.coefficients.shape[1] > MAX_DEGREE + 1:
        raise InputError(
            f"trajectory: expected polynomials of degree at most {MAX_DEGREE}, got {trajectory.coefficients.shape[1] - 1}"
        )
    approach = checker.closest_approach(trajectory.knots, trajectory.coefficients, clearance, keep)
    hit = approach.nearest
    has_pairs = bool(len(checker.geometry.pairs))
    if approach.bound >= 0.0 and not has_pairs:
        return ClearanceCheck(ok=True, distance=_NO_PAIRS_M, time=0.0, first="", second="", clearance=clearance, reason="")
    if approach.bound >= 0.0:
        first, second = checker.names(hit.pair)
        return ClearanceCheck(
            ok=True, distance=approach.bound, time=hit.time, first=first, second=second, clearance=clearance, reason=""
        )
    if keep is not None and checker.leaves_region(hit):
        if keep.axis is None:
            what = f"{keep.why_outside(trajectory(hit.time).q)}, at {hit.time:.3f} s"
        else:
            what = f"the tip's {keep.axis} axis tilts by more than {keep.part.cone:.3g} rad, at {hit.time:.3f} s"
        return ClearanceCheck(
            ok=False,
            distance=approach.distance if has_pairs else _NO_PAIRS_M,
            time=hit.time,
            first="",
            second="",
            clearance=clearance,
            reason=what,
        )
    if checker.opens(hit):
        return ClearanceCheck(
            ok=False,
            distance=_UNKNOWN,
            time=hit.time,
            first="",
            second="",
            clearance=clearance,
            reason=f"{checker.refusal(hit)}, at {hit.time:.3f} s",
        )
    q = trajectory(hit.time).q
    pair, distance = checker.nearest(q)
    first, second = checker.names(pair)
    if distance > clearance + _UNDECIDED_M:
        what = f"the motion is too long for a proof; {second} comes within {1e3 * distance:.2f} mm of {first}"
    elif distance > 0.0:
        what = f"{second} comes within {1e3 * distance:.2f} mm of {first}, {1e3 * clearance:.2f} mm are required"
    else:
        distance = -max(checker.depth(q, pair), 0.0)
        what = f"{second} is {-1e3 * distance:.1f} mm inside {first}"
    return ClearanceCheck(
        ok=False,
        distance=distance,
        time=hit.time,
        first=first,
        second=second,
        clearance=clearance,
        reason=f"{what}, at {hit.time:.3f} s",
    )
