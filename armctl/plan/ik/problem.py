"""An IK problem in numbers: the chain of an arm, the targets, and the residual that judges an answer."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, TypedDict
from weakref import finalize

import numpy as np
from numpy.typing import ArrayLike

from armctl import _core
from armctl._core import Constraint
from armctl.core.errors import InputError, ModelError
from armctl.core.limits import Limits
from armctl.core.pose import Pose
from armctl.core.target import Target, TargetLike
from armctl.core.validation import Array, BoolArray, IntArray, as_array, choice, frozen, integer, matrix, number, vector
from armctl.model.arm.arm import Arm, check_one_tip
from armctl.model.arm.core_model import tips
from armctl.plan.ik.closed_form_recognition import ClosedForm, Hinges, closed_form_of

_FREE_AXES = {"x": Constraint.FREE_X, "y": Constraint.FREE_Y, "z": Constraint.FREE_Z}
MIN_TOLERANCE = 1e-12  # m or rad: below it rounding decides
_LIMIT_ROUNDING = 1e-9  # rad or m: a start that much outside the limits is moved to the limit
_NO_BRANCHES = (None,) * (_core.NO_BRANCH + 1)


class _ChainArrays(TypedDict):
    """What the compiled core takes of a chain, for each of the k joints and each of the n unknowns."""

    rotations: Array  # (k + 1, 3, 3), of the tip as well, in the frame before
    translations: Array  # (k + 1, 3) reaches
    slides: IntArray
    unknowns: IntArray
    ratios: Array
    low: Array
    high: Array
    period: Array
    reach: float


@dataclass(frozen=True, eq=False)
class IkChain:
    """The chain of an arm with n unknowns, as the solver sees it: lengths are in units of the reach."""

    arrays: _ChainArrays
    core: _core.Chain  # the chain in the compiled core
    reach: float  # m, the length of the arm stretched out, which is the unit of length
    base: Array  # (3,) m, the origin of the first joint
    low: Array  # (n,) the bounds of the unknowns
    high: Array  # (n,)
    period: Array  # (n,) 2 pi for hinges, of which whole turns lead back to the same pose, and 0 for others
    unit: Array  # (n,) one unit of each joint of the arm: 1 rad, or the reach for a slide joint
    has_slides: bool  # whether there is a slide joint
    limits: Limits  # the arm's limits
    home: Array  # (n,) the arm's home, in the solver's units
    closed_form: ClosedForm | None  # the closed form of its inverse kinematics, or None
    closed_form_core: _core.ClosedForm | None  # the closed form in the compiled core
    branch_names: tuple[str | None, ...]  # (28,) what the branches are called that the core numbers

    def branches(self, q: Array) -> list[str | None]:
        return [self.branch_names[number] for number in self.branch_numbers(q).tolist()]

    def branch_numbers(self, q: Array) -> IntArray:
        """The core's numbers of the branches of configurations (N, n) in rad."""
        numbers = np.full(len(q), _core.NO_BRANCH)
        if self.closed_form is not None:
            self.core.branches(np.ascontiguousarray(q), numbers)
        return numbers

    def held(self, joints: IntArray, positions: Array) -> IkChain:
        """The chain with some unknowns held at positions in the solver's units: a sweep."""
        low = self.low.copy()
        high = self.high.copy()
        period = self.period.copy()
        low[joints] = positions
        high[joints] = positions
        period[joints] = 0.0
        arrays: _ChainArrays = {**self.arrays, "low": low, "high": high, "period": period}
        return replace(self, core=_core.Chain(**arrays), low=low, high=high, period=period)

    def to_units(self, q: Array) -> Array:
        """Configurations (N, n) in the solver's units."""
        return q / self.unit if self.has_slides else q

    def from_units(self, q: Array) -> Array:
        """Configurations (N, n) from the solver's units, inside the joint limits."""
        return self.limits.clamp(q * self.unit) if self.has_slides else q


class IkProblem(NamedTuple):
    """N targets for one arm, all with the same constraint."""

    arm: Arm
    chain: IkChain
    constraint: Constraint  # which parts of the tip's pose are constrained
    targets: Array  # (N, 12) rotation row by row, position
    q0: Array  # (N, n) rad, where to start
    position_tolerance: float  # m
    orientation_tolerance: float  # rad
    seed: int

    def select(self, rows: IntArray) -> IkProblem:
        """The problem of some of the targets, given by their numbers (K,)."""
        return self._replace(targets=self.targets[rows], q0=self.q0[rows])

    def residual(self, q: Array) -> tuple[float, float]:
        """Position error, m, and orientation error, rad, at q (n,) for the first target, by the arm's forward kinematics."""
        position, rotation = self.arm.pinocchio_model.tip(q)
        errors = np.empty((2, 1))
        _core.residuals(self.constraint, self.targets[:1], position[None], rotation[None].copy(), *errors)
        return float(errors[0, 0]), float(errors[1, 0])

    def residuals(self, q: Array) -> tuple[Array, Array]:
        """Position errors (N,), m, and orientation errors (N,), rad, of each row of q (N, n) for its target."""
        positions, rotations = tips(self.arm.core_model, q)
        position_errors = np.empty(len(q))
        orientation_errors = np.empty(len(q))
        _core.residuals(self.constraint, self.targets, positions, rotations, position_errors, orientation_errors)
        return position_errors, orientation_errors

    def is_solved(self, position_errors: Array, orientation_errors: Array) -> BoolArray:
        """(N,) whether errors (N,), m and rad, are inside the tolerances."""
        return (position_errors <= self.position_tolerance) & (orientation_errors <= self.orientation_tolerance)


def read_target(target: TargetLike, free_axis: str | None) -> tuple[Constraint, Array]:
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


def constraint_of(is_pose: bool, free_axis: str | None) -> Constraint:
    """Which parts of the tip's pose are constrained; an InputError if there is no such axis, or an axis beside a point."""
    if free_axis is None:
        return Constraint.POSE if is_pose else Constraint.POSITION
    choice("free_axis", free_axis, _FREE_AXES)
    if not is_pose:
        raise InputError("free_axis: a point leaves every axis free; give a Pose as the target")
    return _FREE_AXES[free_axis]


def read_problem(
    arm: Arm,
    constraint: Constraint,
    targets: Array,
    q0: ArrayLike | None,
    position_tolerance: float,
    orientation_tolerance: float,
    seed: int,
) -> IkProblem:
    """The problem of a call with targets (N, 12), checked; q0 is (n,), (N, n) or None for the arm's home."""
    chain = ik_chain(arm)
    return IkProblem(
        arm,
        chain,
        constraint,
        np.ascontiguousarray(targets),
        read_starts(arm, q0, len(targets)),
        read_tolerance("position_tolerance", position_tolerance),
        read_tolerance("orientation_tolerance", orientation_tolerance),
        read_seed(seed),
    )


def read_tolerance(what: str, value: float) -> float:
    return number(what, value, MIN_TOLERANCE)


def read_seed(seed: int) -> int:
    """A checked seed, as the core takes it."""
    if type(seed) is not int or seed < 0:
        seed = integer("seed", seed, 0)
    return seed % 2**63


def read_start(arm: Arm, chain: IkChain, q0: ArrayLike | None) -> Array:
    """Where to start for one target, (n,), read-only."""
    if q0 is None:
        return arm.home
    if type(q0) is np.ndarray and not chain.has_slides and chain.core.contains(q0):
        return frozen(q0.copy())
    return read_starts(arm, q0, 1)[0]


def read_starts(arm: Arm, q0: ArrayLike | None, count: int) -> Array:
    """Where to start for each of `count` targets, (count, n), read-only."""
    if q0 is None:
        return arm.home[None] if count == 1 else np.broadcast_to(arm.home, (count, arm.n))
    if as_array("q0", q0).ndim < 2:
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
_chains: dict[int, IkChain] = {}


def ik_chain(arm: Arm) -> IkChain:
    """The chain of an arm, made once for each arm.

    InputError if it is no arm, or has several tips; ModelError if it has closed loops, which are no chain.
    """
    chain = open_chain(arm)
    if chain is None:
        assert arm.joint_map.closure is not None
        raise ModelError(arm.joint_map.closure.refusal)
    return chain


def open_chain(arm: Arm) -> IkChain | None:
    """As `ik_chain`; None for an arm with closed loops."""
    chain = _chains.get(id(arm))
    if chain is None:
        check_one_tip(arm)
        if arm.joint_map.closure is not None:
            return None
        chain = _make_chain(arm)
        _chains[id(arm)] = chain
        finalize(arm, _chains.pop, id(arm), None)
    return chain


def _make_chain(arm: Arm) -> IkChain:
    body = arm.pinocchio_model
    limits = arm.limits
    joint_map = arm.joint_map
    ratio = joint_map.ratio[: body.chain_length]
    slides = body.is_slide[joint_map.leaders]
    position, rotation = body.tip(np.zeros(arm.n))
    links = np.array([*(T.homogeneous for T in body.scratch.liMi[1 : body.chain_length + 1]), body.T_last_tip])
    joints = np.array([T.homogeneous for T in body.scratch.oMi[1 : body.chain_length + 1]])
    farthest = np.maximum(np.abs(limits.q_min), np.abs(limits.q_max))
    travel = np.where(body.is_slide, np.abs(ratio) @ np.where(np.isfinite(farthest), farthest, 0.0), 0.0)
    reach = float(np.linalg.norm(links[1:, :3, 3], axis=1).sum() + travel.sum()) or 1.0
    unit = np.where(slides, reach, 1.0)
    moves_several_joints = np.count_nonzero(ratio, axis=0) > 1
    rotations = np.ascontiguousarray(links[:, :3, :3])
    translations = links[:, :3, 3] / reach
    ratios = (ratio @ unit) / np.where(body.is_slide, reach, 1.0)
    low = limits.q_min / unit
    high = limits.q_max / unit
    period = np.where(slides | moves_several_joints, 0.0, 2 * np.pi)
    arrays: _ChainArrays = {
        "rotations": rotations,
        "translations": translations,
        "slides": body.is_slide.astype(np.int64),
        "unknowns": np.abs(ratio).argmax(axis=1).astype(np.int64),
        "ratios": ratios,
        "low": low,
        "high": high,
        "period": period,
        "reach": reach,
    }
    core = _core.Chain(**arrays)
    closed_form = None
    closed_form_core = None
    if body.chain_length == arm.n and (period > 0).all() and (ratios == 1.0).all():
        hinges = Hinges(joints[:, :3, 2].copy(), joints[:, :3, 3] / reach, rotation.copy(), position / reach)
        in_reaches = np.repeat([[1 / reach], [1.0]], 3, axis=0)
        closed_form = closed_form_of(hinges, lambda q: in_reaches * body.jacobian(q))
        if closed_form is not None:
            core = _core.Chain(
                **arrays,
                relation=closed_form.kind,
                first=closed_form.special[0],
                others=np.array(closed_form.others, np.int64),
                pair_relation=closed_form.pair_kind,
                pair_first=closed_form.pair_first,
                distances_to_points=np.einsum("kj,kj->k", closed_form.points - hinges.points, hinges.axes),
            )
            closed_form_core = _core.ClosedForm(core, closed_form.held)
    return IkChain(
        arrays=arrays,
        core=core,
        reach=reach,
        base=frozen(links[0, :3, 3].copy()),
        low=frozen(low),
        high=frozen(high),
        period=frozen(period),
        unit=frozen(unit),
        has_slides=bool(slides.any()),
        limits=limits,
        home=frozen(arm.home / unit),
        closed_form=closed_form,
        closed_form_core=closed_form_core,
        branch_names=_NO_BRANCHES if closed_form is None else closed_form.branch_names,
    )
