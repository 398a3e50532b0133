"""The kernel of admittance control."""

from __future__ import annotations

import math

from armctl.control.kernel import A_TICK, Q_REF, V_TICK
from armctl.control.task_kernel import (
    add_joint_motion,
    factorize_mobility,
    find_responses,
    inertia,
    jacobian,
    measure_tip,
    reference_jacobian,
    task_factors,
    task_size,
    tip_error,
)
from armctl.core.jit import njit, njit_borrowing
from armctl.robot.dynamics_kernel import add_friction, add_linear_damping, inverse_dynamics, mass_matrix

# The parameters begin with these, then follows the model.
PERIOD = 0  # s
BANDWIDTH = 1  # rad/s
ROWS = 2  # of a twist that the arm controls: 3 or 6
MASS = 3  # (6,)
DAMPING = 9  # (6,)
STIFFNESS = 15  # (6,)
HEADER = 21

# Vectors (6,) at the start of the memory; then three vectors (n,), memory of the task, and scratch of the model.
WRENCH = 0
OFFSET = 6
RATE = 12  # of the offset
FILTERED = 18  # wrench
TASK = 24
MEMORY_HEADER = 30

# rad/s. The measured wrench is compensated, so the position loop need not be stiff. Faster, it resonates with a stiff wall.
_WRENCH_FILTER = 20.0


def memory_size(n: int) -> int:
    """Numbers of memory for n joints besides scratch of the model."""
    return MEMORY_HEADER + 3 * n + task_size(n)


@njit_borrowing
def admittance(params, q, v, reference, memory, tau):
    """The law of `Admittance`."""
    n = tau.shape[0]
    model = params[HEADER:]
    rows = int(params[ROWS])
    at = MEMORY_HEADER
    acceleration = memory[at : at + n]
    v_friction = memory[at + n : at + 2 * n]
    error_rate = memory[at + 2 * n : at + 3 * n]
    at += 3 * n
    tip = memory[at : at + task_size(n)]
    work = memory[at + task_size(n) :]
    v_ref = reference[V_TICK]
    a_ref = reference[A_TICK]
    _yield(params, memory)
    measure_tip(model, q, reference[Q_REF], tip, work)
    mass_matrix(model, work, inertia(tip, n))
    find_responses(tip, n)
    factors = task_factors(tip, n, rows)
    factorize_mobility(tip, n, factors)

    bandwidth = params[BANDWIDTH]
    posture_bandwidth = 0.5 * bandwidth
    for i in range(n):
        acceleration[i] = posture_bandwidth * posture_bandwidth * (reference[Q_REF, i] - q[i])
        acceleration[i] += 2.0 * posture_bandwidth * (v_ref[i] - v[i])
        v_friction[i] = v_ref[i]
    J = jacobian(tip, n)
    J_ref = reference_jacobian(tip, n)
    error = tip_error(tip, n)
    task = memory[TASK : TASK + rows]
    for k in range(rows):
        # The acceleration of the offset is not fed forward: with a delay, a mass below the real one would bounce.
        rate = memory[RATE + k]
        of_posture = 0.0
        for i in range(n):
            rate += J_ref[k, i] * v_ref[i] - J[k, i] * v[i]
            of_posture += J[k, i] * acceleration[i]
        task[k] = bandwidth * bandwidth * (error[k] + memory[OFFSET + k]) + 2.0 * bandwidth * rate - of_posture
    add_joint_motion(tip, n, factors, task, acceleration)
    for k in range(rows):
        task[k] = memory[RATE + k]
    add_joint_motion(tip, n, factors, task, v_friction)
    for i in range(n):
        acceleration[i] += a_ref[i]
        error_rate[i] = v_friction[i] - v[i]
    inverse_dynamics(model, q, v, acceleration, work, tau)
    add_linear_damping(model, error_rate, tau)
    add_friction(model, v_friction, a_ref, work, tau)
    for i in range(n):
        for k in range(rows):
            tau[i] -= J[k, i] * memory[FILTERED + k]


@njit
def _yield(params, memory):
    """Moves the offset by one control period, by an implicit Euler step, which is stable for any gains; filters the wrench."""
    dt = params[PERIOD]
    for k in range(6):
        mass = params[MASS + k]
        damping = params[DAMPING + k]
        stiffness = params[STIFFNESS + k]
        rate = memory[RATE + k]
        force = memory[WRENCH + k] - damping * rate - stiffness * (memory[OFFSET + k] + dt * rate)
        rate += dt * force / (mass + dt * damping + dt * dt * stiffness)
        memory[RATE + k] = rate
        memory[OFFSET + k] += dt * rate
        memory[FILTERED + k] -= math.expm1(-_WRENCH_FILTER * dt) * (memory[WRENCH + k] - memory[FILTERED + k])
