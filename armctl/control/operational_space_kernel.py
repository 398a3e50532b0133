"""The kernel of operational space control."""

from __future__ import annotations

from armctl.control.kernel import A_TICK, Q_REF, V_TICK
from armctl.control.task_kernel import (
    inertia,
    jacobian,
    measure_tip,
    mobility_rows,
    project,
    reference_jacobian,
    task_mobility,
    task_size,
    tip_error,
)
from armctl.core.jit import njit_borrowing
from armctl.robot.dynamics_kernel import add_friction, add_linear_damping, inverse_dynamics, mass_matrix, solve

# The parameters begin with these, then follows the model.
STIFFNESS = 0  # 1/s^2, of the tip
DAMPING = 1  # 1/s
POSTURE_STIFFNESS = 2
POSTURE_DAMPING = 3
HEADER = 4


def memory_size(n: int) -> int:
    """Numbers of memory for n joints besides scratch of the model: of the task, an acceleration, and a rate (n,)."""
    return task_size(n) + 2 * n


@njit_borrowing
def operational_space(params, q, v, reference, memory, tau):
    """The law of `OperationalSpace`."""
    n = tau.shape[0]
    model = params[HEADER:]
    at = task_size(n)
    task = memory[:at]
    acceleration = memory[at : at + n]
    error_rate = memory[at + n : at + 2 * n]
    work = memory[at + 2 * n :]
    v_ref = reference[V_TICK]
    a_ref = reference[A_TICK]
    measure_tip(model, q, reference[Q_REF], task, work)
    mass_matrix(model, work, inertia(task, n))
    project(task, n)
    for i in range(n):
        error_rate[i] = v_ref[i] - v[i]
        acceleration[i] = params[POSTURE_STIFFNESS] * (reference[Q_REF, i] - q[i]) + params[POSTURE_DAMPING] * error_rate[i]
    J = jacobian(task, n)
    J_ref = reference_jacobian(task, n)
    force = tip_error(task, n)  # what the posture leaves to do, then J W of it
    for k in range(6):
        rate = 0.0
        of_posture = 0.0
        for i in range(n):
            rate += J_ref[k, i] * v_ref[i] - J[k, i] * v[i]
            of_posture += J[k, i] * acceleration[i]
        force[k] = params[STIFFNESS] * force[k] + params[DAMPING] * rate - of_posture
    solve(task_mobility(task, n), force)
    W = mobility_rows(task, n)
    for i in range(n):
        acceleration[i] += a_ref[i]
        for k in range(6):
            acceleration[i] += W[i, k] * force[k]
    inverse_dynamics(model, q, v, acceleration, work, tau)
    add_linear_damping(model, error_rate, tau)
    add_friction(model, v_ref, a_ref, work, tau)
