"""TargetFollower: the reference of an arm that follows a target without touching anything."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, auto

import numpy as np

from armctl.core.pose import Pose, computed_pose, rotation_from_vector
from armctl.core.target import Target
from armctl.core.trajectory import TickReference, Trajectory
from armctl.core.validation import Array, frozen
from armctl.model.arm.arm import Arm
from armctl.plan.ik.differential import DifferentialIk
from armctl.plan.ik.solve import solve_ik
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.planner.free_space import FreeSpace
from armctl.run.execution.move import plan_free
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

    tip: Array  # (T, 3) m, the path of the tip
    q_end: Array  # (n,) rad, where it ends
    duration: float  # s, at full speed

    @classmethod
    def from_trajectory(cls, arm: Arm, trajectory: Trajectory) -> PlannedPath:
        """The path of a motion of an arm."""
        q = trajectory.sample(np.linspace(0.0, trajectory.duration, PATH_POINTS)).q
        positions, _ = arm.fk_many(q)
        return cls(frozen(positions), frozen(q[-1]), trajectory.duration)


class Phase(Enum):
    """How far a follower is with its task."""

    BEGUN = auto()  # nothing was tried yet
    FOLLOWING = auto()  # the joint goal moves towards the target
    PLANNING = auto()  # a path is being planned, or waits for the arm to come to rest
    FINISHED = auto()  # the joint goal stays where it is


@dataclass(slots=True, eq=False)
class FollowerTask:
    """What a follower is to do since its last command, and how far it is."""

    q: Array | None  # (n,) rad, a goal of the joints; None: the target
    held: bool  # while a target is held, the arm follows live and plans nothing
    phase: Phase = Phase.BEGUN
    refusal: str = ""  # what is in the way; empty if nothing is
    reach_error: float | None = None  # m, of a target out of reach
    path: PlannedPath | None = None


class TargetFollower:
    """Moves the reference of an arm to a target that may change at any time.

    While nothing is in the way it follows live: differential inverse kinematics moves the joint goal, and an online motion
    moves the reference. Each new joint goal is taken only if the whole motion to it is proved free of contact. Where it is not,
    the reference comes to rest at the last free joint goal. Once the target is released, a path around what is in the way is
    planned in another thread, and followed.

    `joint_goal` (n,) rad is where the reference comes to rest, `target` is T_world_tip, and `joint_control` says whether the
    joints were moved last; `Status` explains the rest.
    """

    def __init__(self, arm: Arm, dt: float, obstacles: Obstacles):
        """A follower that rests at home."""
        self.arm = arm
        self.avoidance = ContactAvoidance(obstacles)
        self.reference = FollowerReference(arm, dt, arm.home, self.avoidance.refusal)
        self.oriented = arm.n >= 6
        self.target = arm.fk(arm.home)
        self.joint_goal = arm.home
        self.joint_control = False
        self.task = FollowerTask(arm.home, held=False)
        self._dt = dt
        self._ik: DifferentialIk | None = None
        self._planning = BackgroundPlanning()
        self._glide = TargetGlide(self.target)
        self._swing = SwingDetector(arm.home)
        self._is_jogging = False

    def close(self) -> None:
        self._planning.close()

    def prepare(self) -> None:
        """Loads what the first update needs."""
        self._velocity(Target.read(self.target), self._dt)
        self.avoidance.obstacles.recent_checker()

    def stand(self, q: Array, goal: Array) -> None:
        """Rests at q, (n,) rad, and then moves the joints to a goal, (n,) rad, with the target where the tip then is."""
        self.reference.stand(q)
        self.joint_goal = q
        self.move_joints(goal)
        self.joint_control = False

    def aim(self, target: Pose, held: bool = False) -> None:
        """Takes a new target, T_world_tip. While it is held, the arm follows live and plans nothing.

        The way from one held target to the next one takes the time between the two, so that the arm does not stop at each.
        """
        self._glide.begin(self.target if held and self.task.held else None)
        self.target = target
        self.joint_control = False
        self._begin(None, held)

    def move_joints(self, q: Array) -> None:
        """Moves the joints to q, (n,) rad, inside the limits."""
        self.target = self.arm.fk(q)
        self.joint_control = True
        self._begin(q, held=False)

    def jog(self, velocity: tuple[Array, Array] | None, interval: float) -> None:
        """Moves the target at a velocity, m/s and rad/s in world axes. None ends that: the arm comes to rest where it is."""
        if velocity is None:
            if self._is_jogging:
                self._is_jogging = False
                self.aim(self.arm.fk(self.joint_goal))
            return
        tip = self.arm.fk(self.joint_goal)
        if not self._is_jogging:
            self.aim(tip, held=True)
            self._is_jogging = True
        linear, angular = velocity
        ahead = self.target.position + interval * linear - tip.position
        ahead *= min(1.0, _LEAD_M / max(float(np.linalg.norm(ahead)), 1e-9))
        turned = computed_pose(tip.position + ahead, rotation_from_vector(interval * angular) @ self.target.rotation)
        is_near = Target.read(turned).distance(tip)[1] < _LEAD_RAD
        self.target = turned if is_near or not self.oriented else Pose(turned.position, quat=self.target.quat)
        if self.task.phase is Phase.FINISHED:
            self.task.phase = Phase.FOLLOWING

    def set_avoiding(self, avoiding: bool) -> None:
        """Chooses whether contacts are avoided."""
        self.avoidance.is_on = avoiding
        self._begin(self.task.q, self.task.held)

    def advance(self, ticks: int, held: Mapping[str, int]) -> TickReference:
        """The next ticks of the reference, with the bodies that a gripper holds, as for `Obstacles.checker`."""
        if self.reference.is_on_planned_path:
            rows = self.reference.next(ticks)
            self.joint_goal = self.arm.limits.clamp(self.reference.q)
            return rows
        self._glide.pass_time(ticks * self._dt)
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

    def _begin(self, q: Array | None, held: bool) -> None:
        """Starts again towards the target, or towards joint angles (n,)."""
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
        aimed = self._glide.pose(self.target)
        target = Target.read(aimed if self.oriented else aimed.position)
        if is_new and not task.held and self._is_blocked(target):
            self._plan(target)
            return
        rate = self._velocity(target, interval)
        is_free = self._approach(self.arm.limits.clamp(self.joint_goal + interval * rate))
        if (
            not is_free
            or aimed is not self.target
            or (np.abs(rate).max() > _IK_AT_REST_SPEED and not self._swing.swings(self.joint_goal, rate, interval))
        ):
            return
        solution = solve_ik(self.arm, target, self.joint_goal)
        position_error, _ = target.distance(self.arm.fk(self.joint_goal))
        is_better = solution.ok or solution.position_error < position_error - _MIN_IMPROVEMENT_M
        if not is_better or self._approach(solution.q):
            task.phase = Phase.FINISHED
        if not solution.ok:
            task.reach_error = solution.position_error

    def _velocity(self, target: Target, interval: float) -> Array:
        """(n,) rad/s, by differential inverse kinematics. It is made at its first use, because its imports take long."""
        if self._ik is None:
            self._ik = DifferentialIk(self.arm)
        return self._ik.step(self.joint_goal, target, interval)

    def _is_blocked(self, target: Target) -> bool:
        """Whether something is on the straight line of the joints to a reachable target."""
        if self.avoidance.checker is None:
            return False
        solution = solve_ik(self.arm, target, self.joint_goal)
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

    def _plan(self, goal: Target | Array | None) -> None:
        """Plans a path from the joint goal, where the reference comes to rest, in another thread."""
        checker = self.avoidance.checker
        assert checker is not None
        arm = self.reference.arm
        start = self.joint_goal
        target = Target.read(self.target if self.oriented else self.target.position)
        self.task.phase = Phase.PLANNING
        self.task.refusal = ""
        self._planning.begin(
            lambda: plan_free(arm, target, start, target if goal is None else goal, 1.0, FreeSpace(checker)), target
        )

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
            self.reference.follow(trajectory)
