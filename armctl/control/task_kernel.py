"""What the kernels of task-space controllers share: the tip's pose error, and its inertia. As `task_space`."""

from __future__ import annotations

import math

from armctl.control.task_space import SINGULARITY_DAMPING
from armctl.core.jit import njit
from armctl.robot.dynamics_kernel import (
    factorize,
    locate,
    place,
    quaternion,
    solve,
    tip_jacobian,
    tip_position,
    tip_rotation,
)

_ROTATIONS = 3 * 9 + 4  # two rotations, the one between them, and its quaternion


@njit
def task_size(n):
    """Numbers of memory that these functions share for n joints."""
    return 2 * n * n + 18 * n + 36 + 6 + _ROTATIONS


@njit
def jacobian(memory, n):
    """J (6, n) at the measured configuration."""
    return memory[: 6 * n].reshape((6, n))


@njit
def reference_jacobian(memory, n):
    """J (6, n) at the reference."""
    return memory[6 * n : 12 * n].reshape((6, n))


@njit
def mobility_rows(memory, n):
    """M^-1 J^T, (n, 6)."""
    return memory[12 * n : 18 * n].reshape((n, 6))


@njit
def inertia(memory, n):
    """The mass matrix (n, n), which `project` replaces by its factors."""
    return memory[18 * n : 18 * n + n * n].reshape((n, n))


@njit
def task_mobility(memory, n):
    """The factors of the damped J M^-1 J^T, (6, 6)."""
    at = 18 * n + n * n
    return memory[at : at + 36].reshape((6, 6))


@njit
def task_factors(memory, n, rows):
    """The factors of the damped mobility of the tip's first rows, (rows, rows); those of all are `task_mobility`."""
    at = 18 * n + n * n
    return memory[at : at + rows * rows].reshape((rows, rows))


@njit
def tip_error(memory, n):
    """The pose error (6,) of the tip, m and rad: translation and rotation vector to its reference, world axes."""
    at = 18 * n + n * n + 36
    return memory[at : at + 6]


@njit
def square(memory, n):
    """A matrix (n, n) for the caller."""
    at = 18 * n + n * n + 36 + 6
    return memory[at : at + n * n].reshape((n, n))


@njit
def measure_tip(model, q, q_ref, memory, work):
    """Computes the error of the tip at q with respect to its pose at q_ref, and both Jacobians; places the joints at q."""
    n = q.shape[0]
    rotations = memory[task_size(n) - _ROTATIONS : task_size(n)]
    reference = rotations[:9]
    measured = rotations[9:18]
    error = tip_error(memory, n)
    place(model, q_ref, work)
    locate(model, work)
    x, y, z = tip_position(model, work)
    tip_rotation(model, work, reference)
    tip_jacobian(model, work, reference_jacobian(memory, n))
    place(model, q, work)
    locate(model, work)
    px, py, pz = tip_position(model, work)
    tip_rotation(model, work, measured)
    tip_jacobian(model, work, jacobian(memory, n))
    error[0] = x - px
    error[1] = y - py
    error[2] = z - pz
    _rotation_vector(reference, measured, rotations[18:27], rotations[27:], error[3:])


@njit
def _rotation_vector(reference, measured, between, quat, error):
    """The rotation vector, rad, of reference x measured^T, with an angle of at most pi; all rotations are (9,)."""
    for i in range(3):
        for k in range(3):
            total = 0.0
            for j in range(3):
                total += reference[3 * i + j] * measured[3 * k + j]
            between[3 * i + k] = total
    quaternion(between, quat)
    sine = math.sqrt(quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3])
    scale = 2.0 * math.atan2(sine, quat[0]) / sine if sine > 0.0 else 2.0
    for k in range(3):
        error[k] = scale * quat[1 + k]


@njit
def project(memory, n):
    """From J and the mass matrix: M^-1 J^T, and the factors of M and of the tip's damped mobility J M^-1 J^T."""
    find_responses(memory, n)
    factorize_mobility(memory, n, task_mobility(memory, n))


@njit
def find_responses(memory, n):
    """From J and the mass matrix: M^-1 J^T, and the factors of M."""
    J = jacobian(memory, n)
    W = mobility_rows(memory, n)
    factor = inertia(memory, n)
    factorize(factor)
    for k in range(6):
        column = square(memory, n)[0]
        for i in range(n):
            column[i] = J[k, i]
        solve(factor, column)
        for i in range(n):
            W[i, k] = column[i]


@njit
def find_mobility(memory, n, mobility):
    """The lower triangle of the tip's mobility J M^-1 J^T, of its first rows, as many as the result has; returns the trace."""
    J = jacobian(memory, n)
    W = mobility_rows(memory, n)
    trace = 0.0
    for i in range(mobility.shape[0]):
        for k in range(i + 1):
            total = 0.0
            for j in range(n):
                total += J[i, j] * W[j, k]
            mobility[i, k] = total
        trace += mobility[i, i]
    return trace


@njit
def factorize_mobility(memory, n, factors):
    """The factors of the damped mobility of the tip's first rows, as many as the result has."""
    trace = find_mobility(memory, n, factors)
    for i in range(factors.shape[0]):
        factors[i, i] += SINGULARITY_DAMPING * SINGULARITY_DAMPING * trace
    factorize(factors)


@njit
def add_joint_motion(memory, n, factors, task, motion):
    """Adds the joint motion (n,) of a motion (rows,) of the tip, by the dynamically consistent inverse; changes the latter."""
    solve(factors, task)
    W = mobility_rows(memory, n)
    for i in range(n):
        for k in range(task.shape[0]):
            motion[i] += W[i, k] * task[k]
