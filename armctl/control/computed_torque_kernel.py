"""The kernel of computed torque, with the disturbance observer."""

from __future__ import annotations

from armctl.control.kernel import A_REF, A_TICK, Q_REF, V_REF, V_TICK, clipped
from armctl.core.jit import njit
from armctl.core.validation import Array
from armctl.robot.dynamics_kernel import add_friction, add_linear_damping, inverse_dynamics

# The parameters begin with these, then follow stiffness, damping, added inertia and torque limits, each (n,), and the model.
IS_TEXTBOOK = 0
OBSERVER_WEIGHT = 1  # of the observer's low-pass in one control period; 0 without an observer
PERIOD = 2  # s
HEADER = 3

# Vectors (n,) at the start of the memory, behind one number that is 0 at the first tick only; then scratch of the model.
ESTIMATE = 0
LAST_TORQUE = 1
LAST_Q = 2
LAST_V = 3
CORRECTION = 4
ACCELERATION = 5
FRICTION = 6
VECTORS = 7


def memory_size(n: int, work_size: int) -> int:
    """Numbers of memory for n joints and a model with so many numbers of scratch."""
    return 1 + VECTORS * n + work_size


def estimate(memory: Array, n: int) -> Array:
    """The (n,) disturbance, N m, that the observer estimates, in the memory of the kernel."""
    return memory[1 + ESTIMATE * n : 1 + (ESTIMATE + 1) * n]


@njit
def _vector(memory, n, k):
    return memory[1 + k * n : 1 + (k + 1) * n]


@njit
def computed_torque(params, q, v, reference, memory, tau):
    """The law of `ComputedTorque`."""
    n = tau.shape[0]
    model = params[HEADER + 4 * n :]
    work = memory[1 + VECTORS * n :]
    correction = _vector(memory, n, CORRECTION)
    acceleration = _vector(memory, n, ACCELERATION)
    friction = _vector(memory, n, FRICTION)
    is_textbook = params[IS_TEXTBOOK] != 0.0
    v_ref = reference[V_REF] if is_textbook else reference[V_TICK]
    a_ref = reference[A_REF] if is_textbook else reference[A_TICK]
    for i in range(n):
        correction[i] = params[HEADER + i] * (reference[Q_REF, i] - q[i]) + params[HEADER + n + i] * (v_ref[i] - v[i])
        acceleration[i] = a_ref[i] + correction[i]
        friction[i] = 0.0
    inverse_dynamics(model, q, v, acceleration, work, tau)
    add_friction(model, v_ref, a_ref, work, friction)
    for i in range(n):
        tau[i] += params[HEADER + 2 * n + i] * correction[i]
        correction[i] = v_ref[i] - v[i]
    # Damping is compensated at the velocity of the reference: the arm's own damping then helps the feedback. Compensated at the
    # measured velocity, large damping would be a large positive feedback.
    add_linear_damping(model, correction, tau)
    if params[OBSERVER_WEIGHT] != 0.0:
        _subtract_disturbance(params, q, v, friction, memory, tau)
    for i in range(n):
        tau[i] += friction[i]


@njit
def _subtract_disturbance(params, q, v, friction, memory, tau):
    """Updates the observer's estimate and subtracts it from the torque, to which the caller then adds friction."""
    n = tau.shape[0]
    disturbance = _vector(memory, n, ESTIMATE)
    last_torque = _vector(memory, n, LAST_TORQUE)
    last_q = _vector(memory, n, LAST_Q)
    last_v = _vector(memory, n, LAST_V)
    if memory[0] != 0.0:
        acceleration = _vector(memory, n, ACCELERATION)
        unmodelled = _vector(memory, n, CORRECTION)
        for i in range(n):
            acceleration[i] = (v[i] - last_v[i]) / params[PERIOD]
        work = memory[1 + VECTORS * n :]
        inverse_dynamics(params[HEADER + 4 * n :], last_q, last_v, acceleration, work, unmodelled)
        for i in range(n):
            disturbance[i] += params[OBSERVER_WEIGHT] * (unmodelled[i] - last_torque[i] - disturbance[i])
    memory[0] = 1.0
    for i in range(n):
        tau[i] -= disturbance[i]
        # The motors clip the sum of both; what they cut off is not a disturbance.
        last_torque[i] = clipped(tau[i] + friction[i], params[HEADER + 3 * n + i]) - friction[i]
        last_q[i] = q[i]
        last_v[i] = v[i]
