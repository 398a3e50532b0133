"""Arms that only the limits of a motion hold back, and how long ruckig's own motion takes within these."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import ruckig
from numpy.typing import ArrayLike
from synthetic import Shape, serial_arm

import armctl


def light_arm(folder: Path, joints: int) -> armctl.Arm:
    """An arm whose motors and joint ranges limit nothing."""
    arm = serial_arm(folder, Shape(0.3, 2.0, 100.0, joints=joints))
    many = np.full(joints, 1e6)
    return arm.with_limits(replace(arm.limits, q_min=-many, q_max=many, tau_max=1e3 * many))


def with_bounds(arm: armctl.Arm, v: ArrayLike, a: ArrayLike, j: ArrayLike) -> armctl.Arm:
    """The same arm with bounds of speed, acceleration and jerk, one for all joints or one for each."""
    v_max, a_max, j_max = (np.array(np.broadcast_to(bound, arm.n), np.float64) for bound in (v, a, j))
    return arm.with_limits(replace(arm.limits, v_max=v_max, a_max=a_max, j_max=j_max))


def by_ruckig_alone(limits: armctl.Limits, start: armctl.Setpoint, goal: armctl.Setpoint) -> float:
    """s, the duration of ruckig's own motion."""
    n = len(start.q)
    problem = ruckig.InputParameter(n)
    problem.current_position, problem.current_velocity, problem.current_acceleration = (x.tolist() for x in start[:3])
    problem.target_position, problem.target_velocity, problem.target_acceleration = (x.tolist() for x in goal[:3])
    problem.max_velocity = limits.v_max.tolist()
    problem.max_acceleration = limits.a_max.tolist()
    problem.max_jerk = limits.j_max.tolist()
    motion = ruckig.Trajectory(n)
    ruckig.Ruckig(n).calculate(problem, motion)
    return motion.duration
