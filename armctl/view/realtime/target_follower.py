"""TargetFollower: the reference of an arm that follows a target without touching anything."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from armctl.core.latest_worker import LatestWorker
from armctl.core.pose import Pose, computed_pose, rotation_from_vector, rotation_vector
from armctl.core.target import Target
from armctl.core.trajectory import TickReference, Trajectory
from armctl.core.validation import Array, frozen
from armctl.model.arm.arm import Arm
from armctl.model.collision.checker import CollisionChecker
from armctl.plan.ik.differential import DifferentialIk
from armctl.plan.ik.solve import solve_ik
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.piecewise import Pieces
from armctl.plan.planner.move_free import FreeSpace
from armctl.run.execution.move import PlannedMove, plan_free
from armctl.run.execution.obstacles import Obstacles
from armctl.view.realtime.follower_reference import FollowerReference

_IK_AT_REST_SPEED = 1e-2  # rad/s: differential IK has converged
# Differential IK may swing about the nearest pose to an orientation out of reach. It gets nowhere if, in so many seconds, the
# joints get less far than a share of their way.
_SWING_S = 0.5
_SWING_SHARE = 0.1
_MIN_IMPROVEMENT_M = 0.01  # an unreachable target changes the posture only if the new one is nearer by this much
_CLEARANCE_M = 1e-3  # of a reference that follows live: half of what a planned path keeps
PATH_POINTS = 100
# By how much a target that moves at a velocity may be ahead of the arm, which an obstacle or a limit may stop.
_LEAD_M = 0.03
_LEAD_RAD = 0.2
_MAX_GLIDE_S = 0.4  # a browser that draws slowly sends the places of a dragged target this rarely

_log = logging.getLogger("armctl.run.sim")


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


class TargetFollower:
    """Moves the reference of an arm to a target that may change at any time.

    While nothing is in the way it follows live: differential inverse kinematics moves the joint goal, and an online motion
    moves the reference. Each new joint goal is taken only if the whole motion to it is proved free of contact. Where it is not,
    the reference comes to rest at the last free joint goal. Once the target is released, a path around what is in the way is
    planned in another thread, and followed.

    `joint_goal` (n,) rad is where the reference comes to rest; `Status` explains the other attributes.
    """

    def __init__(self, arm: Arm, dt: float, obstacles: Obstacles):
        self.arm = arm
        self.obstacles = obstacles
        self.reference = FollowerReference(arm, dt, arm.home, self._refusal)
        self.oriented = arm.n >= 6
        self.avoiding = True
        self._dt = dt
        self._ik: DifferentialIk | None = None
        self._worker: LatestWorker | None = None
        self._checker: CollisionChecker | None = None
        self._clearance = _CLEARANCE_M
        self._is_jogging = False
        self._since_aim = 0.0
        self._glide_s = 0.0
        self.stand(arm.home, arm.home)

    def close(self) -> None:
        if self._worker is not None:
            self._worker.close()

    def prepare(self) -> None:
        """Loads what the first update needs."""
        self._velocity(Target.read(self.target), self._dt)
        self.obstacles.recent_checker("")

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
        if held and self._held and self._since_aim <= _MAX_GLIDE_S:
            self._glide_start = self._glided()
            self._glide_s = self._since_aim
        else:
            self._glide_s = 0.0
        self._since_aim = 0.0
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
        self._finished = False

    def set_avoiding(self, avoiding: bool) -> None:
        """Chooses whether contacts are avoided."""
        self.avoiding = avoiding
        self._begin(self._wanted, self._held)

    def advance(self, ticks: int, held_body: str = "") -> TickReference:
        """The next ticks of the reference, with a body that the gripper holds; empty for none."""
        if self.reference.is_on_planned_path:
            rows = self.reference.next(ticks)
            self.joint_goal = self.arm.limits.clamp(self.reference.q)
            return rows
        self._since_aim += ticks * self._dt
        self._take_answer()
        if not (self.is_planning or self._finished):
            self._watch(held_body)
            self._update_joint_goal(ticks * self._dt)
        return self.reference.next(ticks)

    def _begin(self, wanted: Array | None, held: bool) -> None:
        """Starts again towards the target, or towards joint angles (n,)."""
        self._wanted = wanted
        self._held = held
        self._finished = False
        self._is_new = True
        self._begin_swing()
        self.reach_error: float | None = None
        self.refusal = ""
        self.path: PlannedPath | None = None
        self._request: object = None
        self._answer: tuple[object, PlannedMove] | None = None  # to which request, and what was planned
        self.reference.stop()

    @property
    def is_planning(self) -> bool:
        """Whether a path is being planned, or waits for the arm to come to rest."""
        return self._request is not None

    def _watch(self, held_body: str) -> None:
        """Looks where everything is now, and how much clearance can be kept."""
        if not self.avoiding:
            self._checker = None
            return
        self._checker = self.obstacles.recent_checker(held_body)
        if self._is_new:
            pair, distance = self._checker.nearest(self.reference.q)
            if pair >= 0 and distance <= self._clearance:
                self._clearance = max(0.5 * distance, 0.0)
            else:
                self._clearance = min(_CLEARANCE_M, max(self._clearance, 0.5 * distance))

    def _update_joint_goal(self, interval: float) -> None:
        is_new = self._is_new
        self._is_new = False
        if self._wanted is not None:
            self._finished = self._approach(self._wanted)
            return
        aimed = self._glided()
        target = Target.read(aimed if self.oriented else aimed.position)
        if is_new and not self._held and self._is_blocked(target):
            self._plan(target)
            return
        rate = self._velocity(target, interval)
        is_free = self._approach(self.arm.limits.clamp(self.joint_goal + interval * rate))
        if (
            not is_free
            or aimed is not self.target
            or (np.abs(rate).max() > _IK_AT_REST_SPEED and not self._swings(rate, interval))
        ):
            return
        self._finished = True
        solution = solve_ik(self.arm, target, self.joint_goal)
        position_error, _ = target.distance(self.arm.fk(self.joint_goal))
        if solution.ok or solution.position_error < position_error - _MIN_IMPROVEMENT_M:
            self._finished = self._approach(solution.q)
        if not solution.ok:
            self.reach_error = solution.position_error

    def _glided(self) -> Pose:
        """The target, or a pose on the way there from the held one before it."""
        if self._since_aim >= self._glide_s:
            return self.target
        share = self._since_aim / self._glide_s
        start = self._glide_start
        turn = rotation_vector(self.target.rotation @ start.rotation.T)
        position = start.position + share * (self.target.position - start.position)
        return computed_pose(position, rotation_from_vector(share * turn) @ start.rotation)

    def _begin_swing(self) -> None:
        self._swing_start = self.joint_goal
        self._swing_way = np.zeros(self.arm.n)
        self._swing_time = 0.0

    def _swings(self, rate: Array, interval: float) -> bool:
        """Whether the joint goal moves to and fro, as seen after each half second."""
        self._swing_way += interval * np.abs(rate)
        self._swing_time += interval
        if self._swing_time < _SWING_S:
            return False
        swings = np.abs(self.joint_goal - self._swing_start).max() < _SWING_SHARE * self._swing_way.max()
        self._begin_swing()
        return bool(swings)

    def _velocity(self, target: Target, interval: float) -> Array:
        """(n,) rad/s, by differential inverse kinematics. It is made at its first use, because its imports take long."""
        if self._ik is None:
            self._ik = DifferentialIk(self.arm)
        return self._ik.step(self.joint_goal, target, interval)

    def _is_blocked(self, target: Target) -> bool:
        """Whether something is on the straight line of the joints to a reachable target."""
        if self._checker is None:
            return False
        solution = solve_ik(self.arm, target, self.joint_goal)
        return solution.ok and self._checker.line_hit(self.joint_goal, solution.q, self._clearance) is not None

    def _approach(self, q: Array) -> bool:
        """Moves towards q if the motion there is free. If it is not, plans another one, unless the target is held."""
        if self.reference.go_to(q):
            self.joint_goal = q
            self.refusal = ""
            return True
        obstacle = self.reference.obstacle
        if self._held:
            self.refusal = f"{obstacle}; release the target to plan around" if obstacle else ""
        elif self._checker is not None and (obstacle or self.reference.is_at_rest):
            self._plan(self._wanted)
        return False  # without an obstacle, no motion inside the limits leads there from this state; from rest there may be one

    def _refusal(self, pieces: Pieces) -> str:
        """What a motion would touch; empty if it is free."""
        if self._checker is None:
            return ""
        hit = self._checker.motion_hit(pieces.knots, pieces.coefficients, self._clearance)
        return "" if hit is None else "{} and {} would touch".format(*self._checker.names(hit.pair))

    def _plan(self, goal: Target | Array | None) -> None:
        """Plans a path from the joint goal, where the reference comes to rest, in another thread."""
        assert self._checker is not None
        arm = self.reference.arm
        checker = self._checker
        start = self.joint_goal
        target = Target.read(self.target if self.oriented else self.target.position)
        request = object()
        self._request = request
        self.refusal = ""

        def plan() -> None:
            try:
                move = plan_free(arm, target, start, target if goal is None else goal, 1.0, FreeSpace(checker))
            except Exception as error:
                _log.exception("planning failed")
                move = PlannedMove(target, refusal=f"planning failed: {error}")
            self._answer = (request, move)

        if self._worker is None:
            self._worker = LatestWorker("armctl planning")
        self._worker.submit(plan)

    def _take_answer(self) -> None:
        """Shows what was planned, and follows it as soon as the reference has come to rest."""
        answer = self._answer
        if answer is None or answer[0] is not self._request:
            return
        move = answer[1]
        trajectory = move.trajectory
        if trajectory is None:
            self.refusal = move.refusal
            self._request = None
            self._finished = True
            return
        if self.path is None:
            self.path = PlannedPath.from_trajectory(self.arm, trajectory)
        if self.reference.is_at_rest:
            self._request = None
            self._finished = True
            assert isinstance(trajectory, JointTrajectory)
            self.reference.follow(trajectory)
