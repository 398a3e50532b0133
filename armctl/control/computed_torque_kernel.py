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
INTEGRAL_GAIN = 3  # 1/s^2, of the sum of the errors; 0 without integral action
HEADER = 4

# Vectors (n,) at the start of the memory, behind one number that is 0 at the first tick only; then scratch of the model.
ESTIMATE = 0
LAST_TORQUE = 1
LAST_Q = 2
LAST_V = 3
CORRECTION = 4
ACCELERATION = 5
KNOWN = 6  # torques besides the observer's model, such as dry friction
NEEDED = 7  # the torque that the model needs for the motion since the last tick
INTEGRAL = 8
ADDED = 9  # torques of the feedback that inverse dynamics does not contain
VECTORS = 10


def memory_size(n: int, work_size: int) -> int:
    """Numbers of memory for n joints and a model with so many numbers of scratch."""
    return 1 + VECTORS * n + work_size


def estimate(memory: Array, n: int) -> Array:
    """The (n,) disturbance, N m, that the observer estimates, in the memory of the kernel."""
    return memory[1 + ESTIMATE * n : 1 + (ESTIMATE + 1) * n]


@njit
def vector(memory, n, k):
    """Vector k (n,) of the memory."""
    return memory[1 + k * n : 1 + (k + 1) * n]


@njit
def computed_torque(params, q, v, reference, memory, tau):
    """The law of `ComputedTorque`."""
    control(params, q, v, reference, memory, tau)
    if params[OBSERVER_WEIGHT] != 0.0:
        observe(params, q, v, memory)
        cancel(params, q, v, memory, tau)
    add_known(memory, tau)
    if params[INTEGRAL_GAIN] != 0.0:
        integrate(params, q, reference, memory, tau)


@njit
def integrate(params, q, reference, memory, tau):
    """Adds the error to its integral, except where the motor is at its limit and the error has the sign of the torque."""
    n = tau.shape[0]
    integral = vector(memory, n, INTEGRAL)
    for i in range(n):
        change = params[INTEGRAL_GAIN] * (reference[Q_REF, i] - q[i])
        winds_up = abs(tau[i]) >= params[HEADER + 3 * n + i] and change * tau[i] > 0.0
        if not winds_up:
            integral[i] += change


@njit
def control(params, q, v, reference, memory, tau):
    """The torque of model and feedback without dry friction, which is stored in the memory."""
    n = tau.shape[0]
    model = params[HEADER + 4 * n :]
    work = memory[1 + VECTORS * n :]
    correction = vector(memory, n, CORRECTION)
    acceleration = vector(memory, n, ACCELERATION)
    integral = vector(memory, n, INTEGRAL)
    known = vector(memory, n, KNOWN)
    is_textbook = params[IS_TEXTBOOK] != 0.0
    v_ref = reference[V_REF] if is_textbook else reference[V_TICK]
    a_ref = reference[A_REF] if is_textbook else reference[A_TICK]
    for i in range(n):
        correction[i] = params[HEADER + i] * (reference[Q_REF, i] - q[i]) + params[HEADER + n + i] * (v_ref[i] - v[i])
        acceleration[i] = a_ref[i] + correction[i] + integral[i]
        known[i] = 0.0
    inverse_dynamics(model, q, v, acceleration, work, tau)
    add_friction(model, v_ref, a_ref, work, known)
    added = vector(memory, n, ADDED)
    error_rate = vector(memory, n, NEEDED)
    for i in range(n):
        error_rate[i] = v_ref[i] - v[i]
        added[i] = params[HEADER + 2 * n + i] * correction[i]
    # Damping is compensated at the velocity of the reference: the arm's own damping then helps the feedback. Compensated at the
    # measured velocity, large damping would be a large positive feedback.
    add_linear_damping(model, error_rate, added)
    for i in range(n):
        tau[i] += added[i]


@njit
def observe(params, q, v, memory):
    """Updates the observer's estimate from the motion since the last tick, and stores the torque that the model needs."""
    n = q.shape[0]
    if memory[0] == 0.0:
        return
    disturbance = vector(memory, n, ESTIMATE)
    last_torque = vector(memory, n, LAST_TORQUE)
    last_v = vector(memory, n, LAST_V)
    acceleration = vector(memory, n, ACCELERATION)
    needed = vector(memory, n, NEEDED)
    for i in range(n):
        acceleration[i] = (v[i] - last_v[i]) / params[PERIOD]
    work = memory[1 + VECTORS * n :]
    inverse_dynamics(params[HEADER + 4 * n :], vector(memory, n, LAST_Q), last_v, acceleration, work, needed)
    for i in range(n):
        disturbance[i] += params[OBSERVER_WEIGHT] * (needed[i] - last_torque[i] - disturbance[i])


@njit
def cancel(params, q, v, memory, tau):
    """Subtracts the estimated disturbance from the torque, to which the caller then adds what is known."""
    n = tau.shape[0]
    disturbance = vector(memory, n, ESTIMATE)
    last_torque = vector(memory, n, LAST_TORQUE)
    last_q = vector(memory, n, LAST_Q)
    last_v = vector(memory, n, LAST_V)
    known = vector(memory, n, KNOWN)
    memory[0] = 1.0
    for i in range(n):
        tau[i] -= disturbance[i]
        # The motors clip the sum of both; what they cut off is not a disturbance.
        last_torque[i] = clipped(tau[i] + known[i], params[HEADER + 3 * n + i]) - known[i]
        last_q[i] = q[i]
        last_v[i] = v[i]


@njit
def add_known(memory, tau):
    """Adds the torque that is known besides the observer's model, such as dry friction."""
    n = tau.shape[0]
    known = vector(memory, n, KNOWN)
    for i in range(n):
        tau[i] += known[i]
