"""Chain check: model parity, inverse kinematics and tracking of every serial chain of a robot."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from armctl.core.pose import Pose
from armctl.core.validation import Array, BoolArray
from armctl.model.arm.arm import Arm
from armctl.model.arm.parity import PARITY_TOLERANCE, check_parity
from armctl.model.collision.checkers import collision_checker
from armctl.model.loading.load import chains, load
from armctl.plan.ik.solve_batch import solve_ik_batch
from armctl.plan.motion.move_j import move_j
from armctl.run.sim.simulate import simulate

EXACT_TRACKING = 1e-6  # rad, m: computed torque in its own model
EXPLAINED_TRACKING = 5e-3  # rad, m: with a reason, such as a soft equality
IK_SUCCESS = 0.999  # of reachable poses
GOAL_DISTANCE = 0.2  # rad, m: how far the joints move from home in the tracking runs
_POSITION_TOLERANCE_M = 2e-5  # of an inverse-kinematics answer, twice what the solver promises
_RIGID_IMPEDANCE = 0.999  # an equality with at least this impedance counts as rigid
_PARITY_SAMPLES = 20


@dataclass(frozen=True, eq=False)
class ChainCheck:
    """What was measured of one chain.

    Attributes:
        parity: Largest relative difference from MuJoCo's tip pose, mass matrix and bias.
        ik_success: The share of reachable poses that inverse kinematics solves within its tolerance.
        pd_error: RMS joint error under PD, rad (m).
        computed_torque_error: Largest joint error under computed torque, rad (m).
        tracking_note: Why the tracking is not exact; empty if nothing prevents it.
    """

    arm: Arm
    base: str
    parity: float
    ik_success: float
    pd_error: float
    computed_torque_error: float
    tracking_note: str

    @property
    def tracking_bound(self) -> float:
        """The largest error under computed torque that counts as correct, rad (m)."""
        return EXPLAINED_TRACKING if self.tracking_note else EXACT_TRACKING

    @property
    def reason(self) -> str:
        """What is wrong with the chain; empty if it is ok."""
        if not self.parity <= PARITY_TOLERANCE:
            return f"the model differs from MuJoCo's by {self.parity:.2g}"
        if not self.ik_success >= IK_SUCCESS:
            return f"inverse kinematics solves {100 * self.ik_success:.2f} % of reachable poses"
        if not self.computed_torque_error <= self.tracking_bound:
            note = f" ({self.tracking_note})" if self.tracking_note else ""
            return f"computed torque has an error of {self.computed_torque_error:.2g}, above {self.tracking_bound:g}{note}"
        return ""

    @property
    def ok(self) -> bool:
        """Whether parity, inverse kinematics and tracking are within their bounds."""
        return not self.reason

    def __bool__(self) -> bool:
        return self.ok


def arms_of(robot: str) -> Iterator[tuple[str, Arm]]:
    """Every chain of a robot that can be loaded, with its base."""
    for chain in chains(robot):
        if chain.ok:
            yield chain.base, load(robot, tip=chain.tip, base=None if chain.base == "world" else chain.base)


def check_chain(arm: Arm, base: str, poses: int) -> ChainCheck:
    """Measures one chain; inverse kinematics gets `poses` random reachable poses."""
    parity = check_parity(arm, samples=_PARITY_SAMPLES)
    targets = [arm.fk(q) for q in arm.limits.random(arm.home, poses, np.random.default_rng(0))]
    solved = solve_ik_batch(arm, targets)
    goal, note = _goal_near_home(arm)
    motion = move_j(arm, arm.home, goal)
    pd = simulate(arm, "pd", motion, dwell=0.0)
    computed_torque = simulate(arm, "computed-torque", motion, dwell=0.0)
    error = float(np.abs(computed_torque.q - computed_torque.q_ref).max())
    if not note and error > EXACT_TRACKING and not arm.joint_map.is_plain and not _is_rigid(arm):
        note = "an equality of the model ties joints to each other, and is a soft constraint"
    if not note and error > EXACT_TRACKING and arm.joint_map.closure is not None:
        note = "closed loops are constraints of the simulation, whose forces the controller does not know"
    if not note and (np.abs(computed_torque.tau_cmd) > computed_torque.tau_max).any():
        note = "a motor saturates"
    return ChainCheck(
        arm=arm,
        base=base,
        parity=parity,
        ik_success=float(np.mean(_are_answers(arm, solved.q, solved.ok, targets))),
        pd_error=float(np.sqrt(np.mean((pd.q - pd.q_ref) ** 2))),
        computed_torque_error=error,
        tracking_note=note,
    )


def _are_answers(arm: Arm, q: Array, ok: BoolArray, targets: Sequence[Pose]) -> list[bool]:
    """For each target, whether the solver claims an answer and the answer is right."""
    return [
        bool(claimed and np.linalg.norm(arm.fk(answer).position - target.position) < _POSITION_TOLERANCE_M)
        for answer, claimed, target in zip(q, ok, targets, strict=True)
    ]


def _is_rigid(arm: Arm) -> bool:
    """Whether the equalities of a model are rigid: MuJoCo's impedance is nearly 1 from the start."""
    return bool((arm.model.eq_solimp[:, 0] >= _RIGID_IMPEDANCE).all())


def _goal_near_home(arm: Arm) -> tuple[Array, str]:
    """A configuration near home that the arm reaches without contact; if there is none, any one and the reason."""
    checker = collision_checker(arm)
    touching = ""
    for sign in (1.0, -1.0):
        for fraction in (1.0, 0.1):
            goal = arm.limits.clamp(arm.home + sign * fraction * GOAL_DISTANCE)
            if np.array_equal(goal, arm.home):
                continue
            touching = checker.along(arm.home + np.linspace(0, 1, 12)[:, None] * (goal - arm.home))
            if not touching:
                return goal, ""
    return arm.limits.clamp(arm.home + GOAL_DISTANCE), f"{touching} at home"
