"""The kernels of PD, PD with dynamic feedforward, PD with gravity compensation, and PID with gravity compensation."""

from __future__ import annotations

from armctl.control.kernel import A_TICK, Q_REF, V_REF, V_TICK
from armctl.core.jit import njit_borrowing
from armctl.robot.dynamics_kernel import add_friction, gravity, inverse_dynamics


@njit_borrowing
def pd(params, q, v, reference, memory, tau):
    """Parameters: stiffness (n,), damping (n,). No memory."""
    n = tau.shape[0]
    for i in range(n):
        tau[i] = params[i] * (reference[Q_REF, i] - q[i]) + params[n + i] * (reference[V_REF, i] - v[i])


@njit_borrowing
def pd_feedforward(params, q, v, reference, memory, tau):
    """Parameters: stiffness (n,), damping (n,), model. Memory: scratch of the model."""
    n = tau.shape[0]
    model = params[2 * n :]
    v_ref = reference[V_TICK]
    inverse_dynamics(model, reference[Q_REF], v_ref, reference[A_TICK], memory, tau)
    add_friction(model, v_ref, reference[A_TICK], memory, tau)
    for i in range(n):
        tau[i] += params[i] * (reference[Q_REF, i] - q[i]) + params[n + i] * (v_ref[i] - v[i])


@njit_borrowing
def pd_gravity(params, q, v, reference, memory, tau):
    """Parameters: stiffness (n,), damping (n,), model. Memory: gravity (n,), scratch of the model."""
    n = tau.shape[0]
    torque = memory[:n]
    gravity(params[2 * n :], q, memory[n:], torque)
    pd(params, q, v, reference, memory, tau)
    for i in range(n):
        tau[i] += torque[i]


@njit_borrowing
def pid_gravity(params, q, v, reference, memory, tau):
    """Parameters: stiffness, damping, integral gain x dt, torque limits, each (n,), model. Memory: integral (n,), as above."""
    n = tau.shape[0]
    integral = memory[:n]
    torque = memory[n : 2 * n]
    gravity(params[4 * n :], q, memory[2 * n :], torque)
    pd(params, q, v, reference, memory, tau)
    for i in range(n):
        tau[i] += torque[i] + integral[i]
        change = params[2 * n + i] * (reference[Q_REF, i] - q[i])
        winds_up = abs(tau[i]) >= params[3 * n + i] and change * tau[i] > 0.0
        if not winds_up:
            integral[i] += change
