"""Torques at many states of a motion in one compiled call."""

from __future__ import annotations

import numpy as np

from armctl.core.jit import njit
from armctl.robot.dynamics_kernel import gravity, inverse_dynamics, work_size


@njit
def torques(model, q, v, a):
    """Inverse dynamics without dry friction at states q, v, a, each (T, n): (T, n) N m."""
    tau = np.empty_like(q)
    work = np.zeros(work_size(model, q.shape[1]))
    for k in range(len(q)):
        inverse_dynamics(model, q[k], v[k], a[k], work, tau[k])
    return tau


@njit
def holding_torques(model, q):
    """The torques that hold the arm still at positions q (T, n): (T, n) N m."""
    tau = np.empty_like(q)
    work = np.zeros(work_size(model, q.shape[1]))
    for k in range(len(q)):
        gravity(model, q[k], work, tau[k])
    return tau
