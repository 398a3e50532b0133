"""The kernel of adaptive control."""

from __future__ import annotations

from armctl.control.kernel import A_TICK, Q_REF, V_TICK
from armctl.control.payload_kernel import PARAMETERS, payload_regressor, regressor_scratch
from armctl.core.jit import njit, njit_borrowing
from armctl.robot.dynamics_kernel import (
    add_friction,
    add_linear_damping,
    coriolis_product,
    factorize,
    inverse_dynamics,
    mass_matrix,
    model_size,
    solve,
)

# The parameters begin with these, then follow the adaptation gain (4, 4), the torque limits (n,), the model at the start of the
# control period, in continuous time, and the model of the period.
PERIOD = 0  # s
BANDWIDTH = 1  # rad/s
MAX_STIFFNESS = 2  # 1/s, of the adaptation x period
HEADER = 3

PAYLOAD = 4  # mass and first moment, the first of the parameters of a body


def memory_size(n: int) -> int:
    """Numbers of memory for n joints besides scratch of the model.

    The payload (4,), the regressor (n, 4), two regressors (n, 10), M (n, n), five vectors (n,), and scratch of the regressor.
    """
    return PAYLOAD + (PAYLOAD + 2 * PARAMETERS) * n + n * n + 5 * n + regressor_scratch(n)


@njit_borrowing
def adaptive(params, q, v, reference, memory, tau):
    """The law of `Adaptive`."""
    n = tau.shape[0]
    at = HEADER + PAYLOAD * PAYLOAD
    gain = params[HEADER:at].reshape((PAYLOAD, PAYLOAD))
    limit = params[at : at + n]
    start_model = params[at + n :]
    model = start_model[model_size(start_model, n) :]
    payload = memory[:PAYLOAD]
    at = PAYLOAD
    Y = memory[at : at + PAYLOAD * n].reshape((n, PAYLOAD))
    at += PAYLOAD * n
    bodies = memory[at : at + 2 * PARAMETERS * n].reshape((2, n, PARAMETERS))
    at += 2 * PARAMETERS * n
    M = memory[at : at + n * n].reshape((n, n))
    at += n * n
    vectors = memory[at : at + 5 * n].reshape((5, n))
    at += 5 * n
    scratch = memory[at : at + regressor_scratch(n)]
    work = memory[at + regressor_scratch(n) :]
    acceleration = vectors[0]
    surface = vectors[1]  # s
    coriolis = vectors[2]
    v_ref = reference[V_TICK]
    a_ref = reference[A_TICK]
    bandwidth = params[BANDWIDTH]
    for i in range(n):
        correction = bandwidth * (reference[Q_REF, i] - q[i])
        error_rate = v_ref[i] - v[i]
        surface[i] = error_rate + correction
        acceleration[i] = a_ref[i] + bandwidth * (error_rate + surface[i])
    _regressor(start_model, q, v, surface, acceleration, vectors[3:], work, scratch, bodies, Y)
    slowdown = _slowdown(params, start_model, gain, Y, vectors[3], work, M)
    coriolis_product(start_model, v, surface, work, vectors[3], coriolis)
    inverse_dynamics(model, q, v, acceleration, work, tau)
    add_linear_damping(model, surface, tau)  # at the velocity v + s
    add_friction(model, v_ref, a_ref, work, tau)
    is_clipped = False
    for i in range(n):
        tau[i] += coriolis[i]
        for k in range(PAYLOAD):
            tau[i] += Y[i, k] * payload[k]
        is_clipped = is_clipped or not abs(tau[i]) < limit[i]
    if is_clipped:  # the effect of the payload is not measurable while a motor is at its limit
        return
    for k in range(PAYLOAD):
        change = 0.0
        for j in range(PAYLOAD):
            for i in range(n):
                change += gain[k, j] * Y[i, j] * surface[i]
        payload[k] += params[PERIOD] * slowdown * change


@njit
def _regressor(model, q, v, s, a, vectors, work, scratch, bodies, Y):
    """Y (n, 4) of M a + C(q, v) (v + s) + g of the payload, C by Christoffel's symbols; places the joints at q.

    C(q, v) w is symmetric in v and w, so it follows from Coriolis torques C(q, u) u at the sum u = 2 v + s and difference s.
    """
    n = Y.shape[0]
    zero = vectors[0]
    total = vectors[1]
    for i in range(n):
        zero[i] = 0.0
        total[i] = 2.0 * v[i] + s[i]
    payload_regressor(model, q, total, zero, work, scratch, bodies[0])
    payload_regressor(model, q, s, zero, work, scratch, bodies[1])
    for i in range(n):
        for k in range(PAYLOAD):
            Y[i, k] = 0.25 * (bodies[0, i, k] - bodies[1, i, k])
    payload_regressor(model, q, zero, a, work, scratch, bodies[0])
    for i in range(n):
        for k in range(PAYLOAD):
            Y[i, k] += bodies[0, i, k]


@njit
def _slowdown(params, model, gain, Y, column, work, M):
    """A factor of at most 1 that keeps the adaptation stable in fast motions, where the regressor Y is large.

    Estimate and s form an oscillator of stiffness Y gain Y^T and damping bandwidth. Sampled at dt it is stable while
    stiffness x dt < bandwidth. The stiffness is at most the trace of M^-1 Y gain Y^T; the joints are placed.
    """
    n = Y.shape[0]
    mass_matrix(model, work, M)
    factorize(M)
    stiffness = 0.0
    for j in range(PAYLOAD):
        for i in range(n):
            column[i] = Y[i, j]
        solve(M, column)
        for k in range(PAYLOAD):
            for i in range(n):
                stiffness += gain[j, k] * Y[i, k] * column[i]
    bound = params[MAX_STIFFNESS]
    rate = stiffness * params[PERIOD]
    return bound / rate if rate > bound else 1.0
