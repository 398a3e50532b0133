"""Experts that plan a motion to the goal, and follow it."""

import copy
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import chain, product

import numpy as np

from armctl.core.errors import PlanError
from armctl.core.target import Target
from armctl.core.validation import Array
from armctl.envs.experts.expert import Command, Expert, action_towards, max_turns, next_time, within_step
from armctl.model.arm.arm import Arm
from armctl.model.collision.checker import CollisionChecker
from armctl.model.collision.checkers import collision_checker
from armctl.plan.ik.solve import solve_ik
from armctl.plan.motion.move_j import move_j
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.planner.move_free import move_free

_MAX_LAGS = (0.4, 0.1, 0.03)  # rad (m), of the reference of a joint behind its target
_GROWTHS = (1.45, 1.2)  # of the obstacle in the plan, from which the followed motion may deviate
_SEEDS = 4
_REHEARSED_GROWTH = 1.15  # of the obstacle in the rehearsal
_STEPS_TO_SPARE = 4  # at the end of an episode


class ReachExpert(Expert):
    """Inverse kinematics of the goal, and a jerk-limited motion of the joints."""

    _motion: JointTrajectory

    def begin(self) -> None:
        start = self.arm.limits.clamp(self.batch.rows.q[self.row])
        goal = solve_ik(self.arm, self.batch.task.targets(self.batch.goal[self.row].copy()), start)
        self._motion = move_j(self.arm, start, goal.q)

    def next(self) -> Command:
        return Command(self._motion((self.batch.steps[self.row] + 1) * self.batch.step_time).q)


class ReachPastExpert(Expert):
    """A motion around the obstacle, by the planner.

    The arm leaves a plan where the references of its joints lag behind it, and where it has more joints than a cartesian action
    has numbers. So plans are rehearsed: the references of the joints are computed in advance. If they touch something, the same
    plan is tried more slowly, and then another one.
    """

    def begin(self) -> None:
        """Plans the motion among the obstacles of this episode; without a plan it moves straight, and the episode fails."""
        self._time = 0.0
        checker = collision_checker(self._arm_among(_REHEARSED_GROWTH))
        candidates = ((motion, max_turns(self.batch, lag)) for motion in self._plans() for lag in _MAX_LAGS)
        first = next(candidates)
        solved = (candidate for candidate in chain([first], candidates) if self._solves(*candidate, checker))
        self._motion, self._max_turns = next(solved, first)

    def next(self) -> Command:
        target = self.batch.rows.target[self.row]
        self._time = next_time(self.batch, self._motion, self._max_turns, self._time, target)
        return Command(self._motion(self._time).q)

    def _plans(self) -> Iterator[JointTrajectory]:
        """Motions to the goal; if there is no plan, the straight one."""
        start = self.arm.limits.clamp(self.batch.rows.q[self.row])
        goal = Target.read(np.array(self.batch.goal[self.row]))
        arms = [self._arm_among(growth) for growth in _GROWTHS]
        has_plan = False
        for seed, arm in product(range(_SEEDS), arms):
            with suppress(PlanError):
                yield move_free(arm, start, goal, seed=seed)
                has_plan = True
        if not has_plan:
            yield move_j(self.arm, start, solve_ik(self.arm, goal, start).q)

    def _arm_among(self, growth: float) -> Arm:
        """The arm with the obstacle of this episode, larger by a factor."""
        model = copy.copy(self.arm.model)
        obstacle = model.body(self.batch.task.obstacle)
        obstacle.pos[:] = self.batch.obstacle[self.row]
        model.geom_size[obstacle.geomadr[0]] *= growth
        model.geom_rbound[obstacle.geomadr[0]] *= growth
        model.geom_aabb[obstacle.geomadr[0]] *= growth
        return replace(self.arm, model=model)

    def _solves(self, motion: JointTrajectory, most: Array, checker: CollisionChecker) -> bool:
        """Whether the references of the joints touch nothing and come to the goal in time."""
        batch = self.batch
        target = batch.rows.target[self.row].copy()
        reference = target.copy()
        velocity = np.zeros(self.arm.n)
        time = 0.0
        for _ in range(batch.horizon - _STEPS_TO_SPARE):
            time = next_time(batch, motion, most, time, target)
            before = reference.copy()
            action = within_step(batch, action_towards(batch, target, motion(time).q))
            batch.rows.rehearse(action, target, reference, velocity)
            if checker.line_hit(before, reference) is not None:
                return False
            error = float(np.linalg.norm(self.arm.fk(reference).position - batch.goal[self.row]))
            if time > motion.duration and error < 0.5 * batch.task.tolerance:
                return True
        return False


class TrackExpert(Expert):
    """Inverse kinematics of where the goal will be."""

    def begin(self) -> None:
        self._q = self.arm.limits.clamp(self.batch.rows.q[self.row])

    def next(self) -> Command:
        """The configuration for the goal at the end of the step, near the last one."""
        task = self.batch.task
        which = slice(self.row, self.row + 1)
        goal = task.goals_at(self.batch.goal_number[which], self.batch.steps[which] + 1)[0]
        result = solve_ik(self.arm, task.targets(goal), self._q)
        if result.ok:
            self._q = np.array(result.q)
        return Command(self._q)
