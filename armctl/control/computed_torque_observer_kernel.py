"""The kernel of computed torque with a disturbance observer that estimates velocities."""

from __future__ import annotations

from math import sqrt

from armctl.control.kernel import A_TICK, Q_REF, V_TICK, clipped
from armctl.core.jit import njit, njit_borrowing
from armctl.core.validation import Array
from armctl.robot.dynamics_kernel import (
    add_friction,
    add_implicit_damping,
    add_linear_damping,
    factorize,
    inverse_dynamics,
    mass_matrix,
    solve,
)

# The parameters begin with these, then follow the rows below, each (n,), and the model.
PERIOD = 0  # s
POSITION_STEP = 1  # change of position / (acceleration x period^2) in one period from rest: 1 in a step of MuJoCo, or 1/2
POSITION_WEIGHT = 2  # of the error of the predicted position, for the estimated position
VELOCITY_WEIGHT = 3  # of the error of the predicted position / period, for the estimated velocity
OBSERVER_WEIGHT = 4  # of the observer's low-pass in one control period
HEADER = 5

# Rows of parameters (n,).
STIFFNESS = 0
DAMPING = 1
TORQUE_LIMIT = 2
ROWS = 3

# Vectors (n,) at the start of the memory, behind one number that is 0 at the first tick only; then a matrix (n, n) and
# scratch of the model.
ESTIMATE = 0
LAST_TORQUE = 1
POSITION = 2  # estimated
VELOCITY = 3
LOST = 4  # torque that the motors cut off
ACCELERATION = 5  # commanded; after the tick that which the motors then achieve
KNOWN = 6  # torques besides the observer's model, such as dry friction
NEEDED = 7  # the torque that the model needs for the motion since the last tick
LAST_POSITION = 8
LAST_VELOCITY = 9
VECTORS = 10


def memory_size(n: int) -> int:
    """Numbers of memory for n joints besides scratch of the model."""
    return 1 + VECTORS * n + n * n


def estimate(memory: Array, n: int) -> Array:
    """The (n,) disturbance, N m, that the observer estimates, in the memory of the kernel."""
    return memory[1 + ESTIMATE * n : 1 + (ESTIMATE + 1) * n]


@njit
def vector(memory, n, k):
    """Vector k (n,) of the memory."""
    return memory[1 + k * n : 1 + (k + 1) * n]


@njit
def scratch(memory, n):
    """The scratch of the model, at the end of the memory."""
    return memory[1 + VECTORS * n + n * n :]


@njit
def row(params, n, k):
    """Row k (n,) of the parameters; after the last one the model begins."""
    return params[HEADER + k * n : HEADER + (k + 1) * n]


@njit_borrowing
def computed_torque_observer(params, q, v, reference, memory, tau):
    """The law of `ComputedTorqueObserver`."""
    observe(params, q, v, memory)
    control(params, reference, memory, tau)
    cancel(params, memory, tau)
    add_known(memory, tau)


@njit
def control(params, reference, memory, tau):
    """The torque of model and feedback at the estimated motion, without dry friction, which is stored in the memory."""
    n = tau.shape[0]
    model = params[HEADER + ROWS * n :]
    work = scratch(memory, n)
    position = vector(memory, n, POSITION)
    velocity = vector(memory, n, VELOCITY)
    acceleration = vector(memory, n, ACCELERATION)
    known = vector(memory, n, KNOWN)
    stiffness = row(params, n, STIFFNESS)
    damping = row(params, n, DAMPING)
    v_ref = reference[V_TICK]
    a_ref = reference[A_TICK]
    for i in range(n):
        acceleration[i] = a_ref[i] + stiffness[i] * (reference[Q_REF, i] - position[i]) + damping[i] * (v_ref[i] - velocity[i])
        known[i] = 0.0
    inverse_dynamics(model, position, velocity, acceleration, work, tau)
    corrected = vector(memory, n, LOST)  # scratch until the torque is known
    for i in range(n):
        corrected[i] = v_ref[i] + sqrt(stiffness[i]) * (reference[Q_REF, i] - position[i]) - velocity[i]
    # Damping is compensated at the velocity v_ref + bandwidth x error: the arm's own damping then helps the feedback, and the
    # error of a joint that hardly anything but damping resists decays as fast as those of the others. Compensated at the
    # estimated velocity, which is late, large damping would be a large positive feedback.
    add_linear_damping(model, corrected, tau)
    add_friction(model, v_ref, a_ref, work, known)


@njit
def observe(params, q, v, memory):
    """Estimates position, velocity and disturbance from measured positions q, and stores the torque that the motion needs.

    The commanded acceleration predicts position and velocity. The velocity is measured at the first tick only, because it is
    noisy where it is differenced from positions.
    """
    n = q.shape[0]
    position = vector(memory, n, POSITION)
    velocity = vector(memory, n, VELOCITY)
    if memory[0] == 0.0:
        for i in range(n):
            position[i] = q[i]
            velocity[i] = v[i]
        return
    disturbance = vector(memory, n, ESTIMATE)
    last_torque = vector(memory, n, LAST_TORQUE)
    last_position = vector(memory, n, LAST_POSITION)
    last_velocity = vector(memory, n, LAST_VELOCITY)
    acceleration = vector(memory, n, ACCELERATION)
    needed = vector(memory, n, NEEDED)
    dt = params[PERIOD]
    for i in range(n):
        last_position[i] = position[i]
        last_velocity[i] = velocity[i]
        predicted = position[i] + dt * velocity[i] + params[POSITION_STEP] * dt * dt * acceleration[i]
        error = q[i] - predicted
        position[i] = predicted + params[POSITION_WEIGHT] * error
        acceleration[i] += params[VELOCITY_WEIGHT] * error / (dt * dt)
        velocity[i] += dt * acceleration[i]
    work = scratch(memory, n)
    inverse_dynamics(params[HEADER + ROWS * n :], last_position, last_velocity, acceleration, work, needed)
    for i in range(n):
        disturbance[i] += params[OBSERVER_WEIGHT] * (needed[i] - last_torque[i] - disturbance[i])


@njit
def cancel(params, memory, tau):
    """Subtracts the estimated disturbance from the torque, to which the caller then adds what is known."""
    n = tau.shape[0]
    disturbance = vector(memory, n, ESTIMATE)
    last_torque = vector(memory, n, LAST_TORQUE)
    known = vector(memory, n, KNOWN)
    limit = row(params, n, TORQUE_LIMIT)
    lost = vector(memory, n, LOST)
    is_clipped = False
    memory[0] = 1.0
    for i in range(n):
        tau[i] -= disturbance[i]
        last_torque[i] = clipped(tau[i] + known[i], limit[i]) - known[i]
        lost[i] = last_torque[i] - tau[i]
        is_clipped = is_clipped or abs(tau[i] + known[i]) > limit[i]
    if is_clipped:  # what the motors cut off is no disturbance
        M = memory[1 + VECTORS * n : 1 + VECTORS * n + n * n].reshape((n, n))
        mass_matrix(params[HEADER + ROWS * n :], scratch(memory, n), M)
        add_implicit_damping(params[HEADER + ROWS * n :], M)
        factorize(M)
        solve(M, lost)
        acceleration = vector(memory, n, ACCELERATION)
        for i in range(n):
            acceleration[i] += lost[i]


@njit
def add_known(memory, tau):
    """Adds the torque that is known besides the observer's model, such as dry friction."""
    n = tau.shape[0]
    known = vector(memory, n, KNOWN)
    for i in range(n):
        tau[i] += known[i]
