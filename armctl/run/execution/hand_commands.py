"""HandCommands: the commands of an arm with a gripper: pick a body, and place it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.defaults import DEFAULT_GRIP_FORCE
from armctl.core.errors import InputError
from armctl.core.handling import PickResult, PlaceResult
from armctl.core.pose import Pose, computed_pose, rotation_from_vector, rotation_vector
from armctl.core.region import Region
from armctl.core.result import GripResult, MoveResult
from armctl.core.target import Target
from armctl.core.validation import number, vector
from armctl.model.arm.arm import check_one_tip
from armctl.model.collision.world_snapshot import WorldSnapshot, read_world
from armctl.model.gripper.grip_frames import GripFrames, grip_frames
from armctl.model.gripper.gripper_model import GripperModel, checked_force
from armctl.plan.grasp.attempts import ProvedMotion, Ways
from armctl.plan.grasp.candidates import MIN_FINGER_GAP_M, least_width
from armctl.plan.grasp.handled_bodies import find_body
from armctl.plan.grasp.handling_scene import HandledBody, HandlingScene
from armctl.plan.grasp.plan_pick import HeldAt, PickPlan, PlacePlan, plan_pick, plan_place
from armctl.run.execution.commands import Commands
from armctl.run.execution.move import ControlledArm, PlannedMove
from armctl.run.execution.obstacles import Carried

APPROACH_M = 0.08
LIFT_M = 0.08
PLACE_TOLERANCE_M = 5e-3
_MIN_WAY_M = 5e-3
_MAX_WAY_M = 1.0
_FORCE_OF_WEIGHT = 2.0  # two pads with a coefficient of friction of 0.5 hold twice what they need
_TURNS = 12  # about the vertical, of a body that is put at a position
_REGION_SAMPLES = 64  # poses of a region that are tried
# A controller that does not know the load lets the tip sag; what counts is where the body is put.
_CARRY_TOLERANCE_M = 5e-3
_CARRY_TOLERANCE_RAD = 0.05
_UP = np.array([0.0, 0.0, 1.0])


class GripperCommands(Protocol):
    """A gripper, simulated or real."""

    @property
    def width(self) -> float: ...

    @property
    def width_max(self) -> float: ...

    def move(self, width: float) -> GripResult: ...

    def grasp(self, force: float) -> GripResult: ...


class GripperAtHand(NamedTuple):
    """A gripper with its model."""

    commands: GripperCommands
    model: GripperModel


class HandCommands(Commands):
    """An arm that may have a gripper."""

    def __init__(self, controlled: ControlledArm):
        """Commands for an arm on its drive."""
        super().__init__(controlled)
        self._frames: GripFrames | None = None

    def pick(
        self,
        body: str,
        *,
        speed: float = 1.0,
        approach: float = APPROACH_M,
        lift: float = LIFT_M,
        force: float | None = None,
    ) -> PickResult:
        """Picks a body: finds a grasp, moves around everything to it, closes the gripper and lifts the body.

        Grasps are made of the body's shape: its box, ball, cylinder or convex hull, and of the fingers. Of those that the arm
        can make, one near the middle of the body and from above is preferred. All motions are planned and proved before the arm
        moves: nothing touches, but the fingers the body, and the body what it stands on. From then on the body is a part of the
        proofs of all moves, and its mass a payload of their plans.

        Args:
            body: The name of a loose body of the model; of a robot, of a body of `world`.
            speed: Fraction of the full speed, in (0, 1].
            approach: m, the line on which the open gripper comes to the body; shorter where there is no room for it.
            lift: m, the line on which the body is lifted; likewise.
            force: N between the pads; left out, 10 N or twice the weight, at most what the gripper has.

        Returns:
            The result with the grasp. No error is raised if there is no grasp that the arm can make: `ok` is False, and
            `reason` says what is in the way.

        Raises:
            UnknownNameError: There is no such body.
            InputError: The body is fixed, a part of the robot or wider than the gripper, or the gripper holds something.
            ModelError: The arm has no gripper, or a link without a collision shape.
            SimulationError: The controller failed; `error.log` contains the ticks until then.
        """
        check_one_tip(self.arm)
        hand = self._gripper_at_hand()
        found = self._find(body)
        held = self._held_body()
        if held:
            raise InputError(
                f"body: the gripper already holds {held:.60}; place it, or open the gripper, before {body:.60} is picked"
            )
        self._forget_lost()
        frames = self._grip_frames(hand.model)
        narrowest = least_width(found.parts)
        if not np.isfinite(narrowest):
            raise InputError(f"body: {body:.60} has no two opposite sides that pads can press on; pick one that has")
        if narrowest > frames.width_max - 2.0 * MIN_FINGER_GAP_M:
            raise InputError(
                f"body: {body:.60} is {1e3 * narrowest:.3g} mm wide where it is narrowest, "
                f"and the gripper opens {1e3 * frames.width_max:.3g} mm; pick a smaller body, or mount a wider gripper"
            )
        ways = self._ways(approach, lift, speed)
        squeeze = self._force(force, found, hand.model)
        scene = self._handling_scene(hand.model, found)
        plan = plan_pick(scene, frames, self._start, ways, _UP)
        if isinstance(plan, str):
            return PickResult(ok=False, body=body, reason=plan)
        return self._pick_along(plan, hand.commands, scene, squeeze)

    def place(
        self,
        body: str,
        where: Pose | ArrayLike | Region,
        *,
        speed: float = 1.0,
        approach: float = APPROACH_M,
        lift: float = LIFT_M,
        tolerance: float = PLACE_TOLERANCE_M,
    ) -> PlaceResult:
        """Puts down the body that the gripper holds, opens the gripper and moves away.

        All motions are planned and proved before the arm moves. At its place the body may touch what it comes to stand on.

        Args:
            body: Its name.
            where: T_world_body; (3,) m, where it gets the orientation that it had before it was picked, turned about the
                vertical as it suits; or a Region of such poses, such as `Region.on(box, at, height=..., upright=True)`.
            speed: Fraction of the full speed, in (0, 1].
            approach: m, the line on which the open gripper leaves; shorter where there is no room for it.
            lift: m, the line on which the body is lowered; likewise.
            tolerance: m, how far from there it may come to rest in a simulation.

        Returns:
            The result with the pose that was chosen. If it can be put nowhere there, `ok` is False, and `reason` gives the
            reason.

        Raises:
            UnknownNameError: There is no such body.
            InputError: The gripper does not hold the body, or an argument of a wrong shape or out of its bounds.
            ModelError: The arm has no gripper, or a link without a collision shape.
            SimulationError: The controller failed; `error.log` contains the ticks until then.
        """
        check_one_tip(self.arm)
        hand = self._gripper_at_hand()
        found = self._find(body)
        held = self._held_body()
        if held != body:
            has = f"it holds {held:.60}" if held else "it holds nothing"
            raise InputError(f"body: {body:.60} is not in the gripper, {has}; pick({body!r:.60}) comes first")
        ways = self._ways(approach, lift, speed)
        largest_error = number("tolerance", tolerance, 0.0)
        poses = self._poses(where, found)
        scene = self._handling_scene(hand.model, found)
        at = HeldAt(hand.commands.width, self.tip.inverse() @ found.pose)
        plan = plan_place(scene, self._grip_frames(hand.model), poses, self._start, at, ways, _UP)
        if isinstance(plan, str):
            return PlaceResult(ok=False, body=body, reason=plan)
        return self._place_along(plan, hand.commands, found, largest_error)

    @abstractmethod
    def _gripper_at_hand(self) -> GripperAtHand:
        """The gripper; ModelError if there is none."""

    @abstractmethod
    def _held_body(self) -> str:
        """The body that the gripper holds now; empty if there is none."""

    def _check_pickable(self, body: HandledBody) -> None:
        """InputError for a body that cannot be picked here."""

    def _pick_along(self, plan: PickPlan, gripper: GripperCommands, scene: HandlingScene, force: float) -> PickResult:
        """Carries out a plan as far as it goes."""
        name = scene.body.name
        planned = PickResult(ok=False, body=name, reason="", grasp=plan.grasp)
        opened = gripper.move(min(plan.opening, gripper.width_max))
        if not opened:
            return replace(planned, reason=f"the gripper did not open: {opened.reason}", grip=opened)
        moves: list[MoveResult] = []
        for motion in (plan.to_body, plan.approach):
            moves.append(self._follow(motion))
            if not moves[-1]:
                reason = f"the arm did not get there: {moves[-1].reason}"
                return replace(planned, reason=reason, moves=tuple(moves))
        grip = gripper.grasp(force)
        planned = replace(planned, grip=grip, moves=tuple(moves))
        if not grip.grasped or grip.held not in ("", name):
            return replace(planned, reason=grip.reason or f"the gripper holds {grip.held:.60}")
        self._grasped(scene)
        moves.append(self._follow(plan.lift, carries=True))
        reason = "" if moves[-1] else f"the arm did not lift it: {moves[-1].reason}"
        is_held = self._held_body() == name
        if not is_held:
            reason = "it was lost while it was lifted"
        return replace(planned, ok=not reason, reason=reason, held=is_held, moves=tuple(moves))

    def _place_along(self, plan: PlacePlan, gripper: GripperCommands, body: HandledBody, tolerance: float) -> PlaceResult:
        """Carries out a plan as far as it goes."""
        planned = PlaceResult(ok=False, body=body.name, reason="", pose=plan.pose)
        moves: list[MoveResult] = []
        for motion in (plan.to_place, plan.lower):
            moves.append(self._follow(motion, carries=True))
            reason = "" if moves[-1] else f"the arm did not get there: {moves[-1].reason}"
            if self._held_body() != body.name:
                reason = "it was lost on the way"
            if reason:
                return replace(planned, reason=reason, moves=tuple(moves))
        grip = gripper.move(min(plan.opening, gripper.width_max))
        planned = replace(planned, grip=grip, moves=tuple(moves))
        if not grip:
            return replace(planned, reason=f"the gripper did not open: {grip.reason}")
        self._put_down(body, plan.pose)
        moves.append(self._follow(plan.retreat))
        seen = self._measured_pose(body.name)
        error = (np.nan, np.nan) if seen is None else seen.distance(plan.pose)
        reason = "" if moves[-1] else f"the arm did not get away: {moves[-1].reason}"
        if error[0] > tolerance:
            reason = f"it is {1e3 * error[0]:.3g} mm from where it was to be, at most {1e3 * tolerance:.3g} mm are allowed"
        return replace(
            planned,
            ok=not reason,
            reason=reason,
            position_error=error[0],
            orientation_error=error[1],
            moves=tuple(moves),
        )

    def _follow(self, planned: ProvedMotion, *, carries: bool = False) -> MoveResult:
        """Makes a move that was planned."""
        goal = Target.read(self.arm.fk(planned.end))
        if carries:
            goal = Target.read(goal, _CARRY_TOLERANCE_M, _CARRY_TOLERANCE_RAD)
        return self._move(goal, lambda: PlannedMove(goal, planned.motion, clearance=planned.clearance))

    def _find(self, name: str) -> HandledBody:
        body = find_body(self.arm, self._controlled.drive.data, self._snapshot, name, self.tip)
        self._check_pickable(body)
        return body

    @property
    def _snapshot(self) -> WorldSnapshot | None:
        world = self._obstacles.world
        return None if world is None else read_world(world)

    def _handling_scene(self, gripper: GripperModel, body: HandledBody) -> HandlingScene:
        qpos = self._obstacles.qpos()
        return HandlingScene(arm=self.arm, gripper=gripper, body=body, qpos=qpos, snapshot=self._snapshot)

    def _grip_frames(self, gripper: GripperModel) -> GripFrames:
        if self._frames is None:
            self._frames = grip_frames(self.arm, gripper)
        return self._frames

    def _ways(self, approach: float, lift: float, speed: float) -> Ways:
        self.arm.limits.at_speed(speed)
        return Ways(
            approach=number("approach", approach, _MIN_WAY_M, _MAX_WAY_M),
            lift=number("lift", lift, _MIN_WAY_M, _MAX_WAY_M),
            speed=speed,
        )

    def _force(self, force: float | None, body: HandledBody, gripper: GripperModel) -> float:
        """N between the pads."""
        if force is not None:
            return checked_force(force, gripper.force_max)
        weight = (body.mass or 0.0) * float(np.linalg.norm(self.model.opt.gravity))
        return min(max(DEFAULT_GRIP_FORCE, _FORCE_OF_WEIGHT * weight), gripper.force_max)

    def _grasped(self, scene: HandlingScene) -> None:
        """Notes that the gripper holds a body; one of the world is attached to the tip."""
        body = scene.body
        T_tip_body = self.tip.inverse() @ self._find(body.name).pose
        is_of_model = body.number > 0
        loaded = scene.loaded_arm(T_tip_body) if is_of_model else self.arm
        self._carried = Carried(name=body.name, is_of_model=is_of_model, upright=body.pose.rotation, loaded=loaded)
        if is_of_model:
            self._carry(body, T_tip_body)
        else:
            self.world.attach(body.name)

    def _forget_lost(self) -> None:
        """Notes that a body which was picked, and is not in the gripper any more, stands where it was seen last."""
        carried = self._carried
        self._carried = None
        snapshot = self._snapshot
        if carried is not None and (carried.is_of_model or (snapshot is not None and carried.name in snapshot.bodies)):
            lost = find_body(self.arm, self._controlled.drive.data, snapshot, carried.name, self.tip)
            self._put_down(lost, lost.pose)

    def _measured_pose(self, name: str) -> Pose | None:
        """T_world_body of a body, where it is measured; None where it is only known from what was commanded."""
        return None

    def _put_down(self, body: HandledBody, pose: Pose) -> None:
        """Notes that a body stands at a pose."""
        self._carried = None
        snapshot = self._snapshot
        if body.number:
            self._set_down(body, pose)
        elif snapshot is not None and snapshot.bodies[body.name].tip is not None:
            self.world.detach(body.name, pose)

    def _carry(self, body: HandledBody, T_tip_body: Pose) -> None:
        """Lets a body of the model move with the tip, where nothing else does that."""

    def _set_down(self, body: HandledBody, pose: Pose) -> None:
        """Lets a body of the model stand at a pose, where nothing else does that."""

    def _poses(self, where: Pose | ArrayLike | Region, body: HandledBody) -> Sequence[Pose]:
        """The poses of a body at which it may be put down, the preferred ones first."""
        if isinstance(where, Pose):
            return [where]
        if isinstance(where, Region):
            return [where.nearest(body.pose).pose, *where.sample(_REGION_SAMPLES)]
        position = vector("where", where, 3)
        is_known = self._carried is not None and self._carried.name == body.name
        upright = self._carried.upright if self._carried is not None and is_known else body.pose.rotation
        turn_now = rotation_vector(body.pose.rotation @ upright.T) @ _UP
        turns = turn_now + 2.0 * np.pi / _TURNS * np.array(sorted(range(_TURNS), key=lambda k: min(k, _TURNS - k)))
        return [computed_pose(position, rotation_from_vector(turn * _UP) @ upright) for turn in turns]
