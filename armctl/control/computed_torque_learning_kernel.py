"""The kernel of computed torque that learns a payload: computed torque with an observer, and the estimator beside it."""

from __future__ import annotations

from armctl.control import computed_torque_observer_kernel as law
from armctl.control.computed_torque_observer_kernel import add_known, cancel, control, observe
from armctl.control.kernel import A_TICK, Q_REF, V_TICK
from armctl.control.payload_kernel import (
    DELAY,
    FRICTION,
    PARAMETERS,
    constants_size,
    estimator_size,
    learn_payload,
    payload_regressor,
    regressor_scratch,
    unknowns,
)
from armctl.core.jit import njit, njit_borrowing
from armctl.robot.dynamics_kernel import inverse_dynamics

# The parameters are the constants of the estimator, then those of the law with an observer. The memory is that of the
# estimator, the regressor (n, p) of the last tick, the torque (n,) that was fed forward, the estimate (p,) before, the torque
# (n,) that the model needs for the reference and the rate (n,) of that torque, scratch of the regressor, a number that is not 0
# if the reference moved, and the memory of the law with an observer.


FRICTION_SPEED = 1e-3  # rad/s (m/s), above which the friction that is fed forward does not depend on the speed


def memory_size(n: int) -> int:
    """Numbers of memory for n joints besides scratch of the model."""
    return estimator_size(n) + (n + 1) * (unknowns(n) + 1) + 2 * n + regressor_scratch(n) + law.memory_size(n)


@njit_borrowing
def computed_torque_learning(params, q, v, reference, memory, tau):
    """The law of `ComputedTorqueLearning`."""
    n = tau.shape[0]
    p = unknowns(n)
    constants = params[: constants_size(n)]
    base = params[constants_size(n) :]
    at = estimator_size(n)
    estimator = memory[:at]
    Y = memory[at : at + n * p].reshape((n, p))
    at += n * p
    fed_forward = memory[at : at + n]
    at += n
    before = memory[at : at + p]
    at += p
    needed = memory[at : at + n]
    at += n
    last_rate = memory[at : at + n]
    at += n
    scratch = memory[at : at + regressor_scratch(n)]
    at += regressor_scratch(n)
    moves = memory[at : at + 1]
    inner = memory[at + 1 :]
    is_first = inner[0] == 0.0
    observe(base, q, v, inner)
    if not is_first:
        for k in range(p):
            before[k] = estimator[k]
        _learn(constants, Y, fed_forward, moves[0] != 0.0, before, estimator, inner)
    control(base, reference, inner, tau)
    known = law.vector(inner, n, law.KNOWN)
    v_ref = reference[V_TICK]
    work = law.scratch(inner, n)
    model = base[law.HEADER + law.ROWS * n :]
    rate = fed_forward
    for i in range(n):
        rate[i] = -_torque(needed, Y, estimator, i)
    payload_regressor(model, reference[Q_REF], v_ref, reference[A_TICK], work, scratch, Y)
    inverse_dynamics(model, reference[Q_REF], v_ref, reference[A_TICK], work, needed)
    period = base[law.PERIOD]
    for i in range(n):
        rate[i] += _torque(needed, Y, estimator, i)
        rate[i] = 0.0 if is_first or period == 0.0 else rate[i] / period
    moves[0] = 1.0 if _feed_forward(estimator, v_ref, period, last_rate, Y, fed_forward) else 0.0
    for i in range(n):
        known[i] += fed_forward[i]
    cancel(base, inner, tau)
    add_known(inner, tau)


@njit
def _torque(needed, Y, estimator, i):
    """The torque of model and estimated payload at joint i; the payload of today in both ticks that are compared."""
    torque = needed[i]
    for k in range(PARAMETERS):
        torque += Y[i, k] * estimator[k]
    return torque


@njit
def _feed_forward(estimator, v_ref, period, last_rate, Y, torque):
    """Completes the regressor, replaces the rate of the torque of the reference by what is fed forward; whether it moves."""
    moves = False
    for i in range(Y.shape[0]):
        rate = torque[i]
        Y[i, DELAY] = rate
        Y[i, FRICTION + i] = v_ref[i] / (abs(v_ref[i]) + FRICTION_SPEED)
        torque[i] = 0.0
        for k in range(Y.shape[1]):
            torque[i] += Y[i, k] * estimator[k]
        if period != 0.0:  # what is fed forward against the delay is late, too
            Y[i, DELAY] += estimator[DELAY] * (rate - last_rate[i]) / period
        last_rate[i] = rate
        moves = moves or v_ref[i] != 0.0
    return moves


@njit
def _learn(constants, Y, fed_forward, is_moving, before, estimator, inner):
    """Updates the estimate. The observer's estimate changes by the opposite torque: the sum does not jump."""
    n = Y.shape[0]
    disturbance = law.vector(inner, n, law.ESTIMATE)
    last_torque = law.vector(inner, n, law.LAST_TORQUE)
    needed = law.vector(inner, n, law.NEEDED)
    unmodelled = law.vector(inner, n, law.LOST)  # scratch until the torque is known
    for i in range(n):
        unmodelled[i] = last_torque[i] + fed_forward[i] - needed[i]
    learn_payload(constants, Y, unmodelled, is_moving, estimator)
    for i in range(n):
        for k in range(Y.shape[1]):
            disturbance[i] += Y[i, k] * (estimator[k] - before[k])
