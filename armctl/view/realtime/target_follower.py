"""TargetFollower: the reference of an arm whose tips follow targets without touching anything."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum, auto

import numpy as np

from armctl.core.defaults import MIN_JOINTS_FOR_POSES
from armctl.core.pose import Pose, computed_pose, rotation_from_vector
from armctl.core.target import ANGLE_TOLERANCE, TOLERANCE, Target
from armctl.core.trajectory import TickReference, Trajectory
from armctl.core.validation import Array, frozen
from armctl.model.arm.arm import Arm
from armctl.plan.ik.differential import DifferentialIk
from armctl.plan.ik.ik_result import IkResult
from armctl.plan.ik.resting_joints import resting_joints
from armctl.plan.ik.solve import solve_ik
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.planner.free_space import FreeSpace
from armctl.run.execution.move import PlannedMove, plan_by_tip, plan_free
from armctl.run.execution.obstacles import Obstacles
from armctl.view.realtime.background_planning import BackgroundPlanning
from armctl.view.realtime.contact_avoidance import ContactAvoidance
from armctl.view.realtime.follower_reference import FollowerReference
from armctl.view.realtime.live_target import SwingDetector, TargetGlide

_IK_AT_REST_SPEED = 1e-2  # rad/s: differential IK has converged
_MIN_IMPROVEMENT_M = 0.01  # an unreachable target changes the posture only if the new one is nearer by this much
PATH_POINTS = 100
# By how much a target that moves at a velocity may be ahead of the arm, which an obstacle or a limit may stop.
_LEAD_M = 0.03
_LEAD_RAD = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class PlannedPath:
    """A planned motion, as it is shown."""

    tips: Array  # (tips, T, 3) m, the path of each tip
    q_end: Array  # (n,) rad, where it ends
    duration: float  # s, at full speed

    @classmethod
    def from_trajectory(cls, arm: Arm, trajectory: Trajectory) -> PlannedPath:
        """The path of a motion of an arm."""
        q = trajectory.sample(np.linspace(0.0, trajectory.duration, PATH_POINTS)).q
        positions = np.stack([arm.fk_many(q, tip)[0] for tip in arm.tips])
        return cls(frozen(positions), frozen(q[-1]), trajectory.duration)


class Phase(Enum):
    """How far a follower is with its task."""

    BEGUN = auto()  # nothing was tried yet
    FOLLOWING = auto()  # the joint goal moves towards the targets
    PLANNING = auto()  # a path is being planned, or waits for the arm to come to rest
    FINISHED = auto()  # the joint goal stays where it is


@dataclass(slots=True, eq=False)
class FollowerTask:
    """What a follower is to do since its last command, and how far it is."""

    q: Array | None  # (n,) rad, a goal of the joints; None: the targets
    held: bool  # while a target is held, the arm follows live and plans nothing
    phase: Phase = Phase.BEGUN
    refusal: str = ""  # what is in the way; empty if nothing is
    reach_errors: Mapping[str, float] = field(default_factory=dict)  # m, of the targets out of reach, by tip
    path: PlannedPath | None = None


class TargetFollower:
    """Moves the reference of an arm to targets of its tips that may change at any time.

    While nothing is in the way it follows live: differential inverse kinematics moves the joint goal, and an online motion
    moves the reference. Each new joint goal is taken only if the whole motion to it is proved free of contact. Where it is not,
    the reference comes to rest at the last free joint goal. Once the targets are released, a path around what is in the way is
    planned in another thread, and followed.

    A tip of several is free until its target is moved: the joints that move only free tips rest, and these targets go where the
    tips go.

    `joint_goal` (n,) rad is where the reference comes to rest, `targets` are T_world_tip by tip, `aimed` are the tips that are
    not free, `oriented` those whose orientation counts, and `joint_control` says whether the joints were moved last; `Status`
    explains the rest.
    """

    def __init__(self, arm: Arm, dt: float, obstacles: Obstacles):
        """A follower that rests at home."""
        self.arm = arm
        self.avoidance = ContactAvoidance(obstacles)
        self.reference = FollowerReference(arm, dt, arm.home, self.avoidance.refusal)
        self.oriented = frozenset(tip for tip in arm.tips if len(arm.joints_to(tip)) >= MIN_JOINTS_FOR_POSES)
        self.targets = self._tip_poses(arm.home)
        self.joint_goal = arm.home
        self.joint_control = False
        self.task = FollowerTask(arm.home, held=False)
        self._dt = dt
        self._ik: DifferentialIk | None = None
        self._planning = BackgroundPlanning()
        self._glides = {tip: TargetGlide(target) for tip, target in self.targets.items()}
        self._swing = SwingDetector(arm.home)
        self._jogged_tip: str | None = None
        self.aimed = arm.tips[:1]
        self._held: set[str] = set()
        self._idle = np.zeros(arm.n, bool)  # (n,) the joints that move free tips only

    def close(self) -> None:
        self._planning.close()

    def prepare(self) -> None:
        """Loads what the first update needs."""
        self._velocity(self.targets, self._dt)
        self._forget_velocity()
        self.avoidance.obstacles.recent_checker()

    def stand(self, q: Array, goal: Array) -> None:
        """Rests at q, (n,) rad, and then moves the joints to a goal, (n,) rad, with the targets where the tips then are."""
        self.reference.stand(q)
        self.joint_goal = q
        self.move_joints(goal)
        self.joint_control = False

    def aim(self, target: Pose, tip: str, held: bool = False) -> None:
        """Takes a new target of a tip, T_world_tip. While one is held, the arm follows live and plans nothing.

        The way from one held target to the next one takes the time between the two, so that the arm does not stop at each.
        """
        was_held = self.task.held and tip in self._held
        if held:
            self._held.add(tip)
        else:
            self._held.discard(tip)
        self._glides[tip].begin(self.targets[tip] if held and was_held else None)
        self.targets = {**self.targets, tip: target}
        self.joint_control = False
        if tip not in self.aimed:
            self._set_aimed(tuple(each for each in self.arm.tips if each == tip or each in self.aimed))
        self._begin(None, bool(self._held))

    def move_joints(self, q: Array) -> None:
        """Moves the joints to q, (n,) rad, inside the limits. Of several tips all are free then."""
        self.targets = self._tip_poses(q)
        self.joint_control = True
        self._held.clear()
        self._forget_velocity()
        self._set_aimed(() if self.arm.further_tips else self.aimed)
        self._begin(q, held=False)

    def set_oriented(self, tip: str, oriented: bool) -> None:
        """Chooses whether the orientation of a tip's target counts."""
        self.oriented = self.oriented | {tip} if oriented else self.oriented - {tip}
        self.aim(self.targets[tip], tip)

    def jog(self, tip: str, velocity: tuple[Array, Array] | None, interval: float) -> None:
        """Moves the target of a tip at a velocity, m/s and rad/s in world axes.

        None, or another tip, ends that: the arm comes to rest where it is.
        """
        if self._jogged_tip is not None and (velocity is None or tip != self._jogged_tip):
            self.aim(self.arm.fk(self.joint_goal, self._jogged_tip), self._jogged_tip)
            self._jogged_tip = None
        if velocity is None:
            return
        pose = self.arm.fk(self.joint_goal, tip)
        if self._jogged_tip is None:
            self.aim(pose, tip, held=True)
            self._jogged_tip = tip
        linear, angular = velocity
        before = self.targets[tip]
        ahead = before.position + interval * linear - pose.position
        ahead *= min(1.0, _LEAD_M / max(float(np.linalg.norm(ahead)), 1e-9))
        turned = computed_pose(pose.position + ahead, rotation_from_vector(interval * angular) @ before.rotation)
        is_near = Target.read(turned).distance(pose)[1] < _LEAD_RAD
        target = turned if is_near or tip not in self.oriented else Pose(turned.position, quat=before.quat)
        self.targets = {**self.targets, tip: target}
        if self.task.phase is Phase.FINISHED:
            self.task.phase = Phase.FOLLOWING

    def errors(self, tips: Mapping[str, Pose]) -> dict[str, float]:
        """How far the tips at given poses are from their targets, m: those that are not free, or all if each is free."""
        return {
            tip: float(np.linalg.norm(tips[tip].position - self.targets[tip].position)) for tip in self.aimed or self.arm.tips
        }

    def set_avoiding(self, avoiding: bool) -> None:
        """Chooses whether contacts are avoided."""
        self.avoidance.is_on = avoiding
        self._begin(self.task.q, self.task.held)

    def advance(self, ticks: int, held: Mapping[str, int]) -> TickReference:
        """The next ticks of the reference, with the bodies that a gripper holds, as for `Obstacles.checker`."""
        if self.reference.is_on_planned_path:
            rows = self.reference.next(ticks)
            self.joint_goal = self.arm.limits.clamp(self.reference.q)
            self._carry_free_targets()
            return rows
        for glide in self._glides.values():
            glide.pass_time(ticks * self._dt)
        if self.task.phase is Phase.PLANNING:
            self._take_plan()
        if self.task.phase in (Phase.BEGUN, Phase.FOLLOWING):
            self.avoidance.look(held)
            self._update_joint_goal(ticks * self._dt)
        return self.reference.next(ticks)

    @property
    def is_planning(self) -> bool:
        """Whether a path is being planned, or waits for the arm to come to rest."""
        return self.task.phase is Phase.PLANNING

    def _tip_poses(self, q: Array) -> dict[str, Pose]:
        return {tip: self.arm.fk(q, tip) for tip in self.arm.tips}

    def _set_aimed(self, tips: tuple[str, ...]) -> None:
        self.aimed = tips
        if self.arm.further_tips:
            self._idle = resting_joints(self.arm, {tip: self.targets[tip] for tip in tips}).idle

    def _carry_free_targets(self) -> None:
        """Puts the targets of free tips where the tips are."""
        free = [tip for tip in self.arm.tips if tip not in self.aimed]
        if free and self.task.q is None:
            self.targets = {**self.targets, **{tip: self.arm.fk(self.joint_goal, tip) for tip in free}}

    def _begin(self, q: Array | None, held: bool) -> None:
        """Starts again towards the targets, or towards joint angles (n,)."""
        self.task = FollowerTask(q, held)
        self._swing.restart(self.joint_goal)
        self._planning.cancel()
        self.reference.stop()

    def _update_joint_goal(self, interval: float) -> None:
        task = self.task
        is_new = task.phase is Phase.BEGUN
        task.phase = Phase.FOLLOWING
        if is_new:
            self.avoidance.set_clearance(self.reference.q)
        if task.q is not None:
            if self._approach(task.q):
                task.phase = Phase.FINISHED
            return
        aimed = {tip: self._glides[tip].pose(self.targets[tip]) for tip in self.aimed}
        if is_new and not task.held and self._is_blocked(aimed):
            self._plan(None)
            return
        rate = self._velocity(aimed, interval)
        is_free = self._approach(self.arm.limits.clamp(self.joint_goal + interval * rate))
        if not is_free:
            self._forget_velocity()
        self._carry_free_targets()
        if (
            not is_free
            or any(pose is not self.targets[tip] for tip, pose in aimed.items())
            or (np.abs(rate).max() > _IK_AT_REST_SPEED and not self._swing.swings(self.joint_goal, rate, interval))
        ):
            return
        solution = self._solution(aimed)
        position_error = max(self.errors(self._tip_poses(self.joint_goal)).values())
        is_better = solution.ok or solution.position_error < position_error - _MIN_IMPROVEMENT_M
        if not is_better or self._approach(solution.q):
            task.phase = Phase.FINISHED
        if not solution.ok:
            task.reach_errors = self._out_of_reach(solution)

    def _goal(self, poses: Mapping[str, Pose]) -> Target | dict[str, Target]:
        """Poses of tips as the target of an arm with one tip, or as targets by tip of one with several."""
        targets = {tip: Target.read(pose if tip in self.oriented else pose.position) for tip, pose in poses.items()}
        return targets if self.arm.further_tips else targets[self.arm.tip]

    def _solution(self, poses: Mapping[str, Pose]) -> IkResult:
        """The solution near the joint goal for tips at poses; joints that move free tips only rest."""
        solution = solve_ik(self.arm, self._goal(poses), self.joint_goal)
        return replace(solution, q=np.where(self._idle, self.joint_goal, solution.q)) if self._idle.any() else solution

    def _out_of_reach(self, solution: IkResult) -> dict[str, float]:
        """How far targets are from what a tip reaches, m, of those that it does not reach."""
        errors = solution.tip_errors or {self.arm.tip: (solution.position_error, solution.orientation_error)}
        missed = {tip: far for tip, (far, turned) in errors.items() if far > TOLERANCE or turned > ANGLE_TOLERANCE}
        return missed or {tip: far for tip, (far, _) in errors.items()}

    def _velocity(self, poses: Mapping[str, Pose], interval: float) -> Array:
        """(n,) rad/s, by differential inverse kinematics. It is made at its first use, because its imports take long."""
        if self._ik is None:
            self._ik = DifferentialIk(self.arm)
        rate = self._ik.step(self.joint_goal, self._goal(poses), interval)
        return np.where(self._idle, 0.0, rate)

    def _forget_velocity(self) -> None:
        """Differential inverse kinematics begins again from standstill."""
        if self._ik is not None:
            self._ik.reset()

    def _is_blocked(self, poses: Mapping[str, Pose]) -> bool:
        """Whether something is on the straight line of the joints to reachable targets."""
        if self.avoidance.checker is None:
            return False
        solution = self._solution(poses)
        return solution.ok and self.avoidance.is_line_blocked(self.joint_goal, solution.q)

    def _approach(self, q: Array) -> bool:
        """Moves towards q if the motion there is free. If it is not, plans another one, unless the target is held."""
        task = self.task
        if self.reference.go_to(q):
            self.joint_goal = q
            task.refusal = ""
            return True
        obstacle = self.reference.obstacle
        if task.held:
            task.refusal = obstacle
        elif self.avoidance.checker is not None and (obstacle or self.reference.is_at_rest):
            self._plan(task.q)
        return False  # without an obstacle, no motion inside the limits leads there from this state; from rest there may be one

    def _plan(self, q: Array | None) -> None:
        """Plans a path to joint angles (n,), or to the targets, in another thread; from the joint goal, where the arm rests."""
        checker = self.avoidance.checker
        assert checker is not None
        arm = self.reference.arm
        start = self.joint_goal
        goal = self._goal({tip: self.targets[tip] for tip in self.aimed or self.arm.tips})
        first = Target.read(self.targets[self.arm.tip])
        self.task.phase = Phase.PLANNING
        self.task.refusal = ""

        def plan() -> PlannedMove:
            space = FreeSpace(checker)
            if q is None and isinstance(goal, dict):
                return plan_by_tip(arm, goal, start, 1.0, space)
            target = goal if isinstance(goal, Target) else first
            return plan_free(arm, target, start, target if q is None else q, 1.0, space)

        self._planning.begin(plan, first)

    def _take_plan(self) -> None:
        """Shows what was planned, and follows it as soon as the reference has come to rest."""
        move = self._planning.move
        if move is None:
            return
        task = self.task
        trajectory = move.trajectory
        if trajectory is None:
            task.refusal = move.refusal
            task.phase = Phase.FINISHED
            return
        if task.path is None:
            task.path = PlannedPath.from_trajectory(self.arm, trajectory)
        if self.reference.is_at_rest:
            task.phase = Phase.FINISHED
            assert isinstance(trajectory, JointTrajectory)
            self._forget_velocity()
            self.reference.follow(trajectory)
