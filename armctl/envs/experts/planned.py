"""Experts that plan a motion to the goal, and follow it."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np

from armctl.core.errors import PlanError
from armctl.core.target import Target
from armctl.envs.experts.interface import Command, Expert
from armctl.ik.solve import solve_ik
from armctl.motion.move_j import move_j
from armctl.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.planning.move_free import move_free

_GROWTH = 1.45  # of the obstacle in the plan, from which the followed motion may deviate


class ReachExpert(Expert):
    """Inverse kinematics of the goal, and a jerk-limited motion of the joints."""

    _motion: JointTrajectory

    def begin(self) -> None:
        """Plans the motion."""
        start = self.arm.limits.clamp(self.batch.rows.q[self.row])
        goal = solve_ik(self.arm, self.batch.goal[self.row].copy(), start)
        self._motion = move_j(self.arm, start, goal.q)

    def next(self) -> Command:
        """Where the motion is at the end of the step."""
        return Command(self._motion((self.batch.steps[self.row] + 1) * self.batch.step_time).q)


class ReachPastExpert(ReachExpert):
    """A motion around the obstacle, by the planner."""

    def begin(self) -> None:
        """Plans the motion among the obstacles of this episode; without a plan it moves straight, and the episode fails."""
        model = copy.copy(self.arm.model)
        obstacle = model.body(self.batch.task.obstacle)
        obstacle.pos[:] = self.batch.obstacle[self.row]
        model.geom_size[obstacle.geomadr[0]] *= _GROWTH
        model.geom_rbound[obstacle.geomadr[0]] *= _GROWTH
        model.geom_aabb[obstacle.geomadr[0]] *= _GROWTH
        arm = replace(self.arm, model=model)
        start = arm.limits.clamp(self.batch.rows.q[self.row])
        goal = Target.read(np.array(self.batch.goal[self.row]))
        try:
            self._motion = move_free(arm, start, goal)
        except PlanError:
            super().begin()


class TrackExpert(Expert):
    """Inverse kinematics of where the goal will be."""

    def begin(self) -> None:
        """Notes where the joints are."""
        self._q = self.arm.limits.clamp(self.batch.rows.q[self.row])

    def next(self) -> Command:
        """The configuration for the goal at the end of the step, near the last one."""
        task = self.batch.task
        which = slice(self.row, self.row + 1)
        goal = task.goals_at(self.batch.goal_number[which], self.batch.steps[which] + 1)[0]
        result = solve_ik(self.arm, goal, self._q)
        if result.ok:
            self._q = np.array(result.q)
        return Command(self._q)
