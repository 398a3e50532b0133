"""The kernel of Cartesian impedance control."""

from __future__ import annotations

import math

from armctl.control.kernel import A_TICK, Q_REF, V_TICK, clipped
from armctl.control.task_kernel import (
    inertia,
    jacobian,
    measure_tip,
    mobility_rows,
    project,
    square,
    task_mobility,
    task_size,
    tip_error,
)
from armctl.core.jit import njit, njit_borrowing
from armctl.robot.dynamics_kernel import add_friction, add_linear_damping, inverse_dynamics, mass_matrix, solve, take_roots

# The parameters begin with these, then follow the posture stiffness (n,) and the model.
DAMPING_RATIO = 0
TIP_STIFFNESS = 1  # (6,) N/m and N m/rad
MAX_ERROR = 7  # (6,) m and rad
HEADER = 13

_MAX_SWEEPS = 30  # of the eigenvalue iteration, which converges in about 6


def memory_size(n: int) -> int:
    """Numbers of memory for n joints besides scratch of the model: of the task, four matrices, and three vectors (n,)."""
    return task_size(n) + 4 * n * n + 3 * n


@njit_borrowing
def impedance(params, q, v, reference, memory, tau):
    """The law of `Impedance`."""
    n = tau.shape[0]
    model = params[HEADER + n :]
    at = task_size(n)
    task = memory[:at]
    stiffness = memory[at : at + n * n].reshape((n, n))
    at += n * n
    posture = memory[at : at + n * n].reshape((n, n))
    at += n * n
    scaled = memory[at : at + n * n].reshape((n, n))
    at += n * n
    modes = memory[at : at + n * n].reshape((n, n))
    at += n * n
    error_rate = memory[at : at + n]
    at += n
    scaled_rate = memory[at : at + n]
    at += n
    feedback = memory[at : at + n]
    work = memory[at + n :]
    v_ref = reference[V_TICK]
    a_ref = reference[A_TICK]
    measure_tip(model, q, reference[Q_REF], task, work)
    mass_matrix(model, work, inertia(task, n))
    project(task, n)
    _posture_stiffness(params[HEADER : HEADER + n], task, posture)
    J = jacobian(task, n)
    error = tip_error(task, n)
    for i in range(n):
        error_rate[i] = v_ref[i] - v[i]
        feedback[i] = 0.0
        for k in range(n):
            stiffness[i, k] = posture[i, k]
            feedback[i] += posture[i, k] * (reference[Q_REF, k] - q[k])
            for j in range(6):
                stiffness[i, k] += params[TIP_STIFFNESS + j] * J[j, i] * J[j, k]
        for j in range(6):
            feedback[i] += J[j, i] * params[TIP_STIFFNESS + j] * clipped(error[j], params[MAX_ERROR + j])
    take_roots(inertia(task, n))
    _add_critical_damping(params[DAMPING_RATIO], inertia(task, n), stiffness, scaled, modes, error_rate, scaled_rate, feedback)
    inverse_dynamics(model, q, v, a_ref, work, tau)
    add_linear_damping(model, error_rate, tau)
    add_friction(model, v_ref, a_ref, work, tau)
    for i in range(n):
        tau[i] += feedback[i]


@njit
def _posture_stiffness(springs, task, stiffness):
    """The posture springs (n,) in the null space of the tip, N^T diag(springs) N with N = 1 - M^-1 J^T (J M^-1 J^T)^-1 J."""
    n = stiffness.shape[0]
    J = jacobian(task, n)
    inverse = mobility_rows(task, n)
    N = square(task, n)
    for i in range(n):
        solve(task_mobility(task, n), inverse[i])
        for k in range(n):
            total = 1.0 if i == k else 0.0
            for j in range(6):
                total -= inverse[i, j] * J[j, k]
            N[i, k] = total
    for i in range(n):
        for k in range(i + 1):
            total = 0.0
            for j in range(n):
                total += springs[j] * N[j, i] * N[j, k]
            stiffness[i, k] = total
            stiffness[k, i] = total


@njit
def _add_critical_damping(ratio, L, K, scaled, modes, rate, scaled_rate, torque):
    """Adds 2 ratio L (L^-1 K L^-T)^1/2 L^T rate, with the Cholesky factor L of M: it damps every mode of M and K equally."""
    n = rate.shape[0]
    for k in range(n):  # the columns of L^-1 K
        for i in range(n):
            rest = K[i, k]
            for j in range(i):
                rest -= L[i, j] * scaled[j, k]
            scaled[i, k] = rest / L[i, i]
    for i in range(n):  # the rows of L^-1 K L^-T
        for k in range(n):
            rest = scaled[i, k]
            for j in range(k):
                rest -= L[k, j] * scaled[i, j]
            scaled[i, k] = rest / L[k, k]
    _diagonalize(scaled, modes)
    for i in range(n):
        scaled_rate[i] = 0.0
        for k in range(i, n):
            scaled_rate[i] += L[k, i] * rate[k]
    for m in range(n):
        amplitude = 0.0
        for i in range(n):
            amplitude += modes[i, m] * scaled_rate[i]
        amplitude *= 2.0 * ratio * math.sqrt(max(scaled[m, m], 0.0))
        for i in range(n):
            total = 0.0
            for k in range(i + 1):
                total += L[i, k] * modes[k, m]
            torque[i] += amplitude * total


@njit
def _diagonalize(A, V):
    """Replaces a symmetric matrix by a diagonal one, and V by its eigenvectors (columns): cyclic Jacobi rotations.

    After Golub and Van Loan, Matrix Computations (2013), 8.5. Small eigenvalues keep their relative accuracy.
    """
    n = A.shape[0]
    for i in range(n):
        for k in range(n):
            V[i, k] = 1.0 if i == k else 0.0
    for _ in range(_MAX_SWEEPS):
        is_diagonal = True
        for p in range(n - 1):
            for r in range(p + 1, n):
                if abs(A[p, r]) <= 1e-17 * math.sqrt(abs(A[p, p] * A[r, r])):
                    continue
                is_diagonal = False
                _rotate(A, V, p, r)
        if is_diagonal:
            return


@njit
def _rotate(A, V, p, r):
    """One Jacobi rotation, which makes A[p, r] zero."""
    n = A.shape[0]
    half = 0.5 * (A[r, r] - A[p, p])
    tangent = A[p, r] / (abs(half) + math.sqrt(half * half + A[p, r] * A[p, r]))
    if half < 0.0:
        tangent = -tangent
    cosine = 1.0 / math.sqrt(1.0 + tangent * tangent)
    sine = tangent * cosine
    for k in range(n):
        first = A[k, p]
        second = A[k, r]
        A[k, p] = cosine * first - sine * second
        A[k, r] = sine * first + cosine * second
        first = V[k, p]
        second = V[k, r]
        V[k, p] = cosine * first - sine * second
        V[k, r] = sine * first + cosine * second
    for k in range(n):
        first = A[p, k]
        second = A[r, k]
        A[p, k] = cosine * first - sine * second
        A[r, k] = sine * first + cosine * second
    A[p, r] = 0.0
    A[r, p] = 0.0
