"""Track: follow a point that moves on a smooth path."""

import math

import numpy as np

from armctl.core.errors import InputError
from armctl.core.validation import Array
from armctl.envs.actions import target_limits
from armctl.envs.tasks.task import ArmSource, Task, free_configurations, tip_positions
from armctl.model.collision.checkers import collision_checker

_PATHS = 128
_CENTERS = 256
_CENTER_SPREAD = 0.4  # rad (m), of all joints around home
_MAX_AMPLITUDE = 0.25  # rad (m), of each sine
_SPEED_SHARE = 0.15  # of each joint's greatest speed, for each sine
_FREQUENCIES = (0.1, 0.2)  # Hz, of the sines, as factors of a number between 0.8 and 1.2
_CHECKED_POINTS = 12  # of a path
_DURATION = 6.0  # s, of a path; its last point stays


class Track(Task):
    """Follow a point that moves on a smooth path, which is new in each episode; several tips each its own.

    The path is that of the tip while each joint moves by the sum of two sines, so the arm can follow it. At all of twelve
    checked points of a path the arm touches nothing.
    """

    name = "Track"
    instruction = "Follow the moving target with the tip."
    min_duration = 4.0
    held_fraction = 0.5
    moves_goal = True

    def __init__(self, source: ArmSource, ticks: int):
        """The task, for steps of so many ticks; InputError if the arm touches something on nearly all paths."""
        self.arm = source.load()
        limits = target_limits(self.arm)
        self.start_q = np.clip(self.arm.home, limits.q_min, limits.q_max)
        checker = collision_checker(self.arm)
        rng = np.random.default_rng(1)
        step_time = ticks * self.arm.dt
        times = step_time * np.arange(math.ceil(_DURATION / step_time) + 1, dtype=float)
        paths: list[Array] = []
        for center in free_configurations(self.arm, _CENTERS, _CENTER_SPREAD):
            q = np.clip(center + self._waves(rng, times), limits.q_min, limits.q_max)
            checked = q[np.linspace(0, len(q) - 1, _CHECKED_POINTS).astype(int)]
            if not any(checker.at(each) for each in checked):
                paths.append(tip_positions(self.arm, q))
            if len(paths) == _PATHS:
                break
        if not paths:
            raise InputError(f"robot: {self.arm.name:.80} touches something on every path near home; give it another home")
        self.goals = np.array(paths)

    def _waves(self, rng: np.random.Generator, times: Array) -> Array:
        """(T, n) rad, the sum of two sines for each joint."""
        speed = self.arm.limits.v_max
        total = np.zeros((len(times), self.arm.n))
        for frequency in _FREQUENCIES:
            rate = 2.0 * np.pi * frequency * rng.uniform(0.8, 1.2, self.arm.n)
            amplitude = rng.uniform(0.3, 1.0, self.arm.n) * np.minimum(_MAX_AMPLITUDE, _SPEED_SHARE * speed / rate)
            total += amplitude * np.sin(times[:, None] * rate + rng.uniform(0.0, 2.0 * np.pi, self.arm.n))
        return total
