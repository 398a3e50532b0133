"""The kernel of computed torque that learns a payload: computed torque with an observer, and the estimator beside it."""

from __future__ import annotations

from armctl.control import computed_torque_observer_kernel as law
from armctl.control.computed_torque_observer_kernel import add_known, cancel, control, observe
from armctl.control.kernel import A_TICK, Q_REF, V_TICK
from armctl.control.payload_kernel import (
    PARAMETERS,
    constants_size,
    estimator_size,
    learn_payload,
    payload_regressor,
    regressor_scratch,
)
from armctl.core.jit import njit

# The parameters are the constants of the estimator, then those of the law with an observer. The memory is that of the
# estimator, the regressor (n, 10) of the last tick, the torque (n,) that was fed forward, the estimate (10,) before, scratch of
# the regressor, a number that is not 0 if the reference moved, and the memory of the law with an observer.


def memory_size(n: int) -> int:
    """Numbers of memory for n joints besides scratch of the model."""
    return estimator_size(n) + (n + 1) * (PARAMETERS + 1) + regressor_scratch(n) + law.memory_size(n)


@njit
def computed_torque_learning(params, q, v, reference, memory, tau):
    """The law of `ComputedTorqueLearning`."""
    n = tau.shape[0]
    p = PARAMETERS
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
    payload_regressor(base[law.HEADER + law.ROWS * n :], reference[Q_REF], v_ref, reference[A_TICK], work, scratch, Y)
    moves[0] = 0.0
    for i in range(n):
        fed_forward[i] = 0.0
        for k in range(p):
            fed_forward[i] += Y[i, k] * estimator[k]
        known[i] += fed_forward[i]
        if v_ref[i] != 0.0:
            moves[0] = 1.0
    cancel(base, inner, tau)
    add_known(inner, tau)


@njit
def _learn(constants, Y, fed_forward, is_moving, before, estimator, inner):
    """Updates the estimate of the payload. The observer's estimate changes by the opposite torque: the sum does not jump."""
    n = Y.shape[0]
    disturbance = law.vector(inner, n, law.ESTIMATE)
    last_torque = law.vector(inner, n, law.LAST_TORQUE)
    needed = law.vector(inner, n, law.NEEDED)
    unmodelled = law.vector(inner, n, law.LOST)  # scratch until the torque is known
    for i in range(n):
        unmodelled[i] = last_torque[i] + fed_forward[i] - needed[i]
    learn_payload(constants, Y, unmodelled, is_moving, estimator)
    for i in range(n):
        for k in range(PARAMETERS):
            disturbance[i] += Y[i, k] * (estimator[k] - before[k])
