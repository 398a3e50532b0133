"""The kernel of computed torque, with integral action."""

from __future__ import annotations

from armctl.control.kernel import A_REF, A_TICK, Q_REF, V_REF, V_TICK
from armctl.core.jit import njit, njit_borrowing, njit_inlined
from armctl.robot.dynamics_kernel import add_friction, add_linear_damping, inverse_dynamics
from armctl.robot.forward_dynamics_kernel import inverse_step, is_free

# The parameters begin with these, then follow stiffness, damping, added inertia and torque limits, each (n,), and the model.
IS_TEXTBOOK = 0
INTEGRAL_GAIN = 1  # 1/s^2, of the sum of the errors; 0 without integral action
HEADER = 2

# Vectors (n,) at the start of the memory; then scratch of the model.
INTEGRAL = 0
CORRECTION = 1
ACCELERATION = 2
ERROR_RATE = 3
ADDED = 4  # torques of the feedback that inverse dynamics does not contain
VECTORS = 5


def memory_size(n: int) -> int:
    """Numbers of memory for n joints besides scratch of the model."""
    return VECTORS * n


@njit_inlined
def vector(memory, n, k):
    """Vector k (n,) of the memory."""
    return memory[k * n : (k + 1) * n]


@njit_borrowing
def computed_torque(params, q, v, reference, memory, tau):
    """The law of `ComputedTorque`."""
    n = tau.shape[0]
    command_acceleration(params, q, v, reference, memory, n)
    model = params[HEADER + 4 * n :]
    if is_free(model):  # a plant in free space that has this model uses bias and inertia again
        inverse_step(model, q, v, vector(memory, n, ACCELERATION), memory[VECTORS * n :], tau)
    else:
        inverse_dynamics(model, q, v, vector(memory, n, ACCELERATION), memory[VECTORS * n :], tau)
    add_feedback(params, q, v, reference, memory, tau)


@njit_inlined
def command_acceleration(params, q, v, reference, memory, n):
    """The acceleration of the reference and the feedback, and the correction in it."""
    correction = vector(memory, n, CORRECTION)
    acceleration = vector(memory, n, ACCELERATION)
    integral = vector(memory, n, INTEGRAL)
    is_textbook = params[IS_TEXTBOOK] != 0.0
    v_ref = reference[V_REF] if is_textbook else reference[V_TICK]
    a_ref = reference[A_REF] if is_textbook else reference[A_TICK]
    for i in range(n):
        correction[i] = params[HEADER + i] * (reference[Q_REF, i] - q[i]) + params[HEADER + n + i] * (v_ref[i] - v[i])
        acceleration[i] = a_ref[i] + correction[i] + integral[i]


@njit_inlined
def add_feedback(params, q, v, reference, memory, tau):
    """Adds the feedback that inverse dynamics does not contain, and friction; then integrates the error."""
    n = tau.shape[0]
    model = params[HEADER + 4 * n :]
    is_textbook = params[IS_TEXTBOOK] != 0.0
    v_ref = reference[V_REF] if is_textbook else reference[V_TICK]
    a_ref = reference[A_REF] if is_textbook else reference[A_TICK]
    correction = vector(memory, n, CORRECTION)
    added = vector(memory, n, ADDED)
    error_rate = vector(memory, n, ERROR_RATE)
    for i in range(n):
        error_rate[i] = v_ref[i] - v[i]
        added[i] = params[HEADER + 2 * n + i] * correction[i]
    # Damping is compensated at the velocity of the reference: the arm's own damping then helps the feedback. Compensated at the
    # measured velocity, large damping would be a large positive feedback.
    add_linear_damping(model, error_rate, added)
    for i in range(n):
        tau[i] += added[i]
    add_friction(model, v_ref, a_ref, memory[VECTORS * n :], tau)
    if params[INTEGRAL_GAIN] != 0.0:
        _integrate(params, q, reference, memory, tau)


@njit
def _integrate(params, q, reference, memory, tau):
    """Adds the error to its integral, except where the motor is at its limit and the error has the sign of the torque."""
    n = tau.shape[0]
    integral = vector(memory, n, INTEGRAL)
    for i in range(n):
        change = params[INTEGRAL_GAIN] * (reference[Q_REF, i] - q[i])
        winds_up = abs(tau[i]) >= params[HEADER + 3 * n + i] and change * tau[i] > 0.0
        if not winds_up:
            integral[i] += change
