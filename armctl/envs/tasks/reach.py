"""Reach: move the tip to a point, or each of several tips to one."""

import numpy as np

from armctl.envs.actions import target_limits
from armctl.envs.tasks.task import ArmSource, Task, free_configurations, tip_positions

_GOAL_SPREAD = 0.5  # rad (m), of all joints around home
_GOALS = 2048


class Reach(Task):
    """Move the tip to a point, which is new in each episode; several tips each to its own.

    Goals are tips of configurations around home at which nothing touches, so the arm can reach each of them.
    """

    name = "Reach"
    instruction = "Move the tip to the target."

    def __init__(self, source: ArmSource, ticks: int):
        self.arm = source.load()
        limits = target_limits(self.arm)
        self.start_q = np.clip(self.arm.home, limits.q_min, limits.q_max)
        # (k, n) rad, configurations whose tips are the goals
        self.goal_q = free_configurations(self.arm, _GOALS, _GOAL_SPREAD)
        self.goals = tip_positions(self.arm, self.goal_q)[:, None]
