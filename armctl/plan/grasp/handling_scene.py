"""HandlingScene: what an arm could touch while it picks or places a body, with the body standing or carried."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from armctl.core.pose import Pose
from armctl.core.validation import Array, IntArray
from armctl.model.arm.arm import Arm
from armctl.model.collision.checker import CollisionChecker
from armctl.model.collision.checkers import collision_checker
from armctl.model.collision.world_snapshot import WorldBody, WorldSnapshot
from armctl.model.gripper.gripper_model import GripperModel
from armctl.model.mjmodel.queries import body_name
from armctl.plan.grasp.holds import BodyPart

GUARD_M = 1e-3  # between what moves and what stands, on straight lines beside a body
SUPPORT_GAP_M = 1.5e-3  # what is nearer than this to a body touches it, such as the table below it
_MAY_TOUCH = -1.0  # m, the clearance of pairs that may touch: no overlap is so deep


@dataclass(frozen=True, eq=False)
class HandledBody:
    """A body that is picked or placed.

    Attributes:
        name: Its name.
        parts: Its shapes.
        pose: T_world_body now.
        number: Its number in the arm's model; 0 for a body of a world.
        members: The names of the model's bodies that belong to it.
        mass: kg; None if it is not known.
        center: (3,) m, its center of mass in its frame.
        inertia: (3, 3) kg m^2 about the center of mass, in the axes of its frame.
    """

    name: str
    parts: tuple[BodyPart, ...]
    pose: Pose
    number: int
    members: frozenset[str]
    mass: float | None
    center: Array
    inertia: Array


@dataclass(frozen=True, eq=False)
class HandlingScene:
    """An arm with a gripper, a body, and everything around.

    Attributes:
        arm: The one that handles the body, with one tip.
        gripper: What is behind this tip.
        body: What is picked or placed.
        qpos: (nq,) where everything is now.
        snapshot: The world around the arm; None if there is none.
    """

    arm: Arm
    gripper: GripperModel
    body: HandledBody
    qpos: Array
    snapshot: WorldSnapshot | None

    def standing(self, opening: float, T_world_body: Pose | None = None) -> CollisionChecker:
        """With the fingers at a width, m, and the body where it is now or at a pose."""
        pose = self.body.pose if T_world_body is None else T_world_body
        return self._checker(self._placed(opening, pose), held=False, snapshot=self._with_body(pose, ""))

    def obstruction(self, q: Array, width: float) -> str:
        """What keeps the gripper from closing on the body, where it is now, of an arm at q (n,): a part that is not a pad.

        Empty if nothing does. The inner links of a gripper come forward between its fingers while it closes.
        """
        checker = self.standing(width)
        pads = {body_name(self.arm.model, body) for body in self.gripper.jaws.pad_bodies(self.arm.model)}
        for pair in self.near_body(checker, q, 0.0).tolist():
            names = checker.names(pair)
            if pads.isdisjoint(names):
                return "{1} touches {0}".format(*names)
        return ""

    def carried(self, q: Array, width: float, T_tip_body: Pose) -> CollisionChecker:
        """With the body between the fingers, at a width, m, of an arm at q (n,)."""
        qpos = self._placed(width, self.arm.fk(q) @ T_tip_body)
        qpos[self.arm.joint_map.qpos_adr] = self.arm.joint_map.positions(q)
        return self._checker(qpos, held=True, snapshot=self._with_body(T_tip_body, self.arm.tip))

    def near_body(self, checker: CollisionChecker, q: Array, gap: float) -> IntArray:
        """The pairs of the body with what is not farther from it than a gap, m, at q (n,)."""
        near = checker.near(q, np.zeros(len(q)), 1.0, np.full(len(checker.geometry.pairs), gap))
        return np.array([pair for pair in near.pairs.tolist() if self._is_of_body(checker, pair)], np.int64)

    def guarded(self, checker: CollisionChecker, may_touch: IntArray, *, carried: bool) -> CollisionChecker:
        """A checker that keeps what moves from what stands by `GUARD_M`, only the fingers may come nearer to a standing body.

        Pairs in `may_touch` may touch.
        """
        frames = np.array([shape.frame for shape in checker.geometry.shapes])[checker.geometry.pairs]
        clearances = np.where((frames == 0).any(axis=1), GUARD_M, 0.0)
        if not carried:
            clearances[self.pairs_of_body(checker)] = 0.0
        clearances[may_touch] = _MAY_TOUCH
        return checker.with_clearances(clearances)

    @staticmethod
    def leaving(checker: CollisionChecker, may_touch: IntArray) -> CollisionChecker:
        """A checker in which some pairs may touch."""
        clearances = np.zeros(len(checker.geometry.pairs))
        clearances[may_touch] = _MAY_TOUCH
        return checker.with_clearances(clearances)

    def pairs_of_body(self, checker: CollisionChecker) -> IntArray:
        """The pairs of which the body is one."""
        pairs = range(len(checker.geometry.pairs))
        return np.array([pair for pair in pairs if self._is_of_body(checker, pair)], np.int64)

    def loaded_arm(self, T_tip_body: Pose) -> Arm:
        """The arm with the body as a payload at its tip; the arm itself if the mass is not known."""
        if self.body.mass is None:
            return self.arm
        R = T_tip_body.rotation
        center = T_tip_body.transform(self.body.center)
        return self.arm.with_payload(mass=self.body.mass, center=center, inertia=R @ self.body.inertia @ R.T)

    def too_heavy(self, q: Array, T_tip_body: Pose) -> str:
        """Which joint cannot hold the body at the tip at q (n,), with its torque; empty if all can."""
        arm = self.arm
        weight = -(self.body.mass or 0.0) * arm.model.opt.gravity
        arm_of_force = arm.fk(q).rotation @ T_tip_body.transform(self.body.center)
        wrench = np.concatenate([weight, np.cross(arm_of_force, weight)])  # that the motors have to hold at the tip
        needed = arm.gravity(q) + arm.jacobian(q).T @ wrench
        shares = np.abs(needed) / arm.limits.tau_max
        i = int(shares.argmax())
        if shares[i] <= 1.0:
            return ""
        unit = arm.torque_units[i]
        return (
            f"{arm.joint_names[i]} would need {abs(needed[i]):.3g} {unit} to hold the body, and its limit is "
            f"{arm.limits.tau_max[i]:.3g} {unit}"
        )

    def _is_of_body(self, checker: CollisionChecker, pair: int) -> bool:
        return not self.body.members.isdisjoint(checker.names(pair))

    def _placed(self, width: float, T_world_body: Pose) -> Array:
        """(nq,) with the fingers at a width, m, and the body of the model at a pose."""
        qpos = np.array(self.qpos)
        qpos[self.gripper.qpos_adr] = self.gripper.positions_at(width)
        if self.body.number:
            model = self.arm.model
            first = int(model.jnt_qposadr[model.body_jntadr[self.body.number]])
            qpos[first : first + 7] = [*T_world_body.position, *T_world_body.quat]
        return qpos

    def _with_body(self, pose: Pose, tip: str) -> WorldSnapshot | None:
        """The world with the body of a world at a pose, of a tip if it is given."""
        if self.body.number or self.snapshot is None:
            return self.snapshot
        known = self.snapshot.bodies[self.body.name]
        moved = WorldBody(name=known.name, shape=known.shape, pose=pose, mass=known.mass, tip=tip or None)
        bodies = MappingProxyType({**self.snapshot.bodies, known.name: moved})
        return WorldSnapshot(version=self.snapshot.version, bodies=bodies, allowed=self.snapshot.allowed)

    def _checker(self, qpos: Array, snapshot: WorldSnapshot | None, *, held: bool) -> CollisionChecker:
        carried = {self.body.number: self.arm.tip_body} if held and self.body.number else {}
        return collision_checker(self.arm, qpos, (), carried, snapshot)
