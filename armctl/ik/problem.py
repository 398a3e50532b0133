"""An IK problem in numbers: the chain packed for the compiled solver, the targets, and the residual that judges an answer."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import NamedTuple
from weakref import finalize

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.limits import Limits
from armctl.core.pose import Pose
from armctl.core.target import Target, TargetLike
from armctl.core.validation import Array, BoolArray, IntArray, choice, frozen, integer, matrix, number, shown, vector
from armctl.ik.geometry import ClosedForm, closed_form_of
from armctl.robot.arm import Arm, check_arm

_FREE_AXES = {"x": 0, "y": 1, "z": 2}
MIN_TOLERANCE = 1e-12  # m or rad: below it rounding decides
_LIMIT_ROUNDING = 1e-9  # rad or m: a start that much outside the limits is moved to the limit
_NO_BRANCHES = (None,) * 28


@dataclass(frozen=True, eq=False)
class PackedChain:
    """A serial chain as the compiled solver takes it, with lengths in units of the reach.

    Attributes:
        rows: (k + 1, 20), one row per joint and a last one for the tip; `armctl.ik.kernel` names the columns.
        reach: m, the length of the arm stretched out, which is the unit of length.
        unit: (n,) one unit of each joint of the arm: 1 rad, or the reach for a slide joint.
        has_slides: Whether there is a slide joint.
        limits: The arm's limits.
        home: (n,) the arm's home, in the solver's units.
        kernel: `armctl.ik.kernel`, which is faster to read here than to look up.
        closed_form: The closed form of its inverse kinematics, or None.
        branch_names: (28,) what the branches are called that the kernels number.
    """

    rows: Array
    reach: float
    unit: Array
    has_slides: bool
    limits: Limits
    home: Array
    kernel: ModuleType
    closed_form: ClosedForm | None
    branch_names: tuple[str | None, ...]

    def branches(self, q: Array) -> list[str | None]:
        """The branches of configurations (N, n) in rad."""
        return [self.branch_names[number] for number in self.branch_numbers(q)]

    def branch_numbers(self, q: Array) -> IntArray:
        """The kernel's numbers of the branches of configurations (N, n) in rad."""
        numbers = np.full(len(q), self.kernel.NO_BRANCH)
        if self.closed_form is not None:
            self.kernel.branches(self.rows, np.ascontiguousarray(q), numbers)
        return numbers

    def to_units(self, q: Array) -> Array:
        """Configurations (N, n) in the solver's units."""
        return q / self.unit if self.has_slides else q

    def from_units(self, q: Array) -> Array:
        """Configurations (N, n) from the solver's units, inside the joint limits."""
        return self.limits.clamp(q * self.unit) if self.has_slides else q


class Problem(NamedTuple):
    """N targets for one arm, all with the same constraint.

    Attributes:
        arm: The arm.
        chain: Its packed chain.
        constraint: Which parts of the tip's pose are constrained: POSE, POSITION, or FREE_X and the next two numbers, as
            `armctl.ik.kernel` defines them.
        targets: (N, 12) rotation row by row, position.
        q0: (N, n) rad, where to start.
        position_tolerance: m.
        orientation_tolerance: rad.
        seed: The seed of the random starts.
    """

    arm: Arm
    chain: PackedChain
    constraint: int
    targets: Array
    q0: Array
    position_tolerance: float
    orientation_tolerance: float
    seed: int

    def select(self, rows: IntArray) -> Problem:
        """The problem of some of the targets, given by their numbers (K,)."""
        return self._replace(targets=self.targets[rows], q0=self.q0[rows])

    def residual(self, q: Array) -> tuple[float, float]:
        """Position error, m, and orientation error, rad, at q (n,) for the first target, by the arm's forward kinematics."""
        position, rotation = self.arm.pinocchio_model.tip(q)
        return compiled().residual(self.constraint, self.targets[0], position, rotation)

    def residuals(self, q: Array) -> tuple[Array, Array]:
        """Position errors (N,), m, and orientation errors (N,), rad, of each row of q (N, n) for its target."""
        positions, rotations = self.arm.pinocchio_model.tips(q)
        position_errors = np.empty(len(q))
        orientation_errors = np.empty(len(q))
        compiled().residuals(self.constraint, self.targets, positions, rotations, position_errors, orientation_errors)
        return position_errors, orientation_errors


@cache
def compiled() -> ModuleType:
    """The compiled kernels; numba is imported when they are first used."""
    from armctl.ik import kernel

    return kernel


def read_target(target: TargetLike, free_axis: str | None) -> tuple[int, Array]:
    """The constraint of a target and its numbers (12,): rotation row by row (zeros for a point), position.

    It is checked unless it is a Pose or a Target, which were checked when they were made.
    """
    if isinstance(target, Target):
        target = target.position if target.pose is None else target.pose
    if isinstance(target, Pose):
        return constraint_of(True, free_axis), target.rows.reshape(12)
    constraint = constraint_of(False, free_axis)
    numbers = np.zeros(12)
    numbers[9:] = vector("target", target, 3)
    return constraint, frozen(numbers)


def constraint_of(is_pose: bool, free_axis: str | None) -> int:
    """Which parts of the tip's pose are constrained; an InputError if there is no such axis, or an axis beside a point."""
    if free_axis is None:
        return compiled().POSE if is_pose else compiled().POSITION
    choice("free_axis", free_axis, _FREE_AXES)
    if not is_pose:
        raise InputError("free_axis: a point leaves every axis free; give a Pose as the target")
    return compiled().FREE_X + _FREE_AXES[free_axis]


def read_problem(
    arm: Arm,
    constraint: int,
    targets: Array,
    q0: ArrayLike | None,
    position_tolerance: float,
    orientation_tolerance: float,
    seed: int,
) -> Problem:
    """The problem of a call with targets (N, 12), checked; q0 is (n,), (N, n) or None for the arm's home."""
    chain = packed_chain(arm)
    return Problem(
        arm,
        chain,
        constraint,
        targets,
        read_starts(arm, q0, len(targets)),
        read_tolerance("position_tolerance", position_tolerance),
        read_tolerance("orientation_tolerance", orientation_tolerance),
        read_seed(seed),
    )


def read_tolerance(what: str, value: float) -> float:
    """A checked tolerance, m or rad."""
    return number(what, value, MIN_TOLERANCE)


def read_seed(seed: int) -> int:
    """A checked seed, as the kernels take it."""
    if type(seed) is not int or seed < 0:
        seed = integer("seed", seed, 0)
    return seed % 2**63


def read_starts(arm: Arm, q0: ArrayLike | None, count: int) -> Array:
    """Where to start for each of `count` targets, (count, n), read-only."""
    if q0 is None:
        return arm.home[None] if count == 1 else np.broadcast_to(arm.home, (count, arm.n))
    try:
        dimensions = np.ndim(q0)
    except Exception:  # an object's own conversion may raise anything
        raise InputError(f"q0: {shown(q0)} is not an array of numbers") from None
    if dimensions < 2:
        start = arm.checked("q0", q0)
        return start[None] if count == 1 else np.broadcast_to(start, (count, arm.n))
    rows = matrix("q0", q0, arm.n)
    if len(rows) != count:
        raise InputError(f"q0: {len(rows)} rows given for {count} targets")
    lowest = arm.limits.q_min - _LIMIT_ROUNDING
    highest = arm.limits.q_max + _LIMIT_ROUNDING
    outside = ~((rows >= lowest) & (rows <= highest)).all(axis=1)
    for row in rows[outside]:
        arm.checked("q0", row)
    return frozen(arm.limits.clamp(rows))


# By id, because a look-up in a WeakKeyDictionary takes four times as long. An arm's entry ends with the arm.
_packed_chains: dict[int, PackedChain] = {}


def packed_chain(arm: Arm) -> PackedChain:
    """The packed chain of an arm, made once for each arm; an InputError if it is no arm."""
    chain = _packed_chains.get(id(arm))
    if chain is None:
        check_arm(arm)
        chain = _pack(arm)
        _packed_chains[id(arm)] = chain
        finalize(arm, _packed_chains.pop, id(arm), None)
    return chain


def _pack(arm: Arm) -> PackedChain:
    kernel = compiled()
    body = arm.pinocchio_model
    limits = arm.limits
    joint_map = arm.joint_map
    n = arm.n
    ratio = joint_map.ratio[: body.chain_length]
    slides = body.is_slide[joint_map.leaders]
    offsets = _joint_transforms(joint_map.offset[: body.chain_length], body.is_slide)
    links = np.concatenate([body.placements @ offsets, body.T_last_tip[None]])
    farthest = np.maximum(np.abs(limits.q_min), np.abs(limits.q_max))
    travel = np.where(body.is_slide, np.abs(ratio) @ np.where(np.isfinite(farthest), farthest, 0.0), 0.0)
    reach = float(np.linalg.norm(links[1:, :3, 3], axis=1).sum() + travel.sum()) or 1.0
    unit = np.where(slides, reach, 1.0)
    moves_several_joints = np.count_nonzero(ratio, axis=0) > 1
    rows = np.zeros((body.chain_length + 1, kernel.CHAIN_COLUMNS))
    rows[:, :9] = links[:, :3, :3].reshape(-1, 9)
    rows[:, 9:12] = links[:, :3, 3] / reach
    rows[:-1, kernel.IS_SLIDE] = body.is_slide
    rows[:-1, kernel.LEADER] = np.abs(ratio).argmax(axis=1)
    rows[:-1, kernel.RATIO] = (ratio @ unit) / np.where(body.is_slide, reach, 1.0)
    rows[:n, kernel.LOW] = limits.q_min / unit
    rows[:n, kernel.HIGH] = limits.q_max / unit
    rows[:n, kernel.PERIOD] = np.where(slides | moves_several_joints, 0.0, 2 * np.pi)
    rows[:n, kernel.FREE_LOW] = np.where(rows[:n, kernel.PERIOD] > 0, -np.inf, rows[:n, kernel.LOW])
    rows[:n, kernel.FREE_HIGH] = np.where(rows[:n, kernel.PERIOD] > 0, np.inf, rows[:n, kernel.HIGH])
    closed_form = _closed_form(rows, n) if body.chain_length == n and (rows[:n, kernel.PERIOD] > 0).all() else None
    return PackedChain(
        rows=frozen(rows),
        reach=reach,
        unit=frozen(unit),
        has_slides=bool(slides.any()),
        limits=limits,
        home=frozen(arm.home / unit),
        kernel=kernel,
        closed_form=closed_form,
        branch_names=_NO_BRANCHES if closed_form is None else closed_form.branch_names,
    )


def _closed_form(rows: Array, n: int) -> ClosedForm | None:
    """The closed form of a packed chain of n hinges, if it has one; then its structure is written into the rows."""
    kernel = compiled()
    if not (rows[:n, kernel.RATIO] == 1.0).all():
        return None
    rotation = np.eye(3)
    position = np.zeros(3)
    frames = np.empty((n + 1, 12))
    for k in range(n + 1):
        position = position + rotation @ rows[k, 9:12]
        rotation = rotation @ rows[k, :9].reshape(3, 3)
        frames[k, :9] = rotation.ravel()
        frames[k, 9:] = position
    axes = frames[:n, 2:9:3]
    found = closed_form_of(axes, frames[:n, 9:], frames[n], rows[:n, kernel.LOW : kernel.HIGH + 1])
    if found is not None:
        rows[:n, kernel.MEETING_POINT] = np.einsum("kj,kj->k", found.form[:n, 3:6] - frames[:n, 9:], axes)
        rows[n, kernel.AXES_KIND] = found.kind
        rows[n, kernel.AXES_FIRST] = found.special[0]
        rows[n, kernel.AXES_OTHERS : kernel.AXES_OTHERS + 3] = found.others
        rows[n, kernel.PAIR_KIND] = found.pair_kind
        rows[n, kernel.PAIR_FIRST] = found.pair_first
    return found


def _joint_transforms(displacements: Array, is_slide: BoolArray) -> Array:
    """(k, 4, 4) the transforms of joints displaced about z, or along z if they slide."""
    T = np.tile(np.eye(4), (len(displacements), 1, 1))
    cos = np.where(is_slide, 1.0, np.cos(displacements))
    sin = np.where(is_slide, 0.0, np.sin(displacements))
    T[:, 0, 0] = cos
    T[:, 0, 1] = -sin
    T[:, 1, 0] = sin
    T[:, 1, 1] = cos
    T[:, 2, 3] = np.where(is_slide, displacements, 0.0)
    return T
