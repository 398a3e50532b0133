"""The kernel of hybrid force/motion control, with the contact transition of each force axis."""

from __future__ import annotations

import math

from armctl.control.kernel import A_TICK, Q_REF, V_TICK, clipped
from armctl.control.task_kernel import (
    add_joint_motion,
    factorize_mobility,
    find_mobility,
    find_responses,
    inertia,
    jacobian,
    measure_tip,
    mobility_rows,
    reference_jacobian,
    task_factors,
    task_size,
    tip_error,
)
from armctl.core.jit import njit, njit_borrowing
from armctl.robot.dynamics_kernel import (
    FRICTION_LOSS,
    _drive,
    add_friction,
    add_linear_damping,
    factorize,
    inverse_dynamics,
    mass_matrix,
    solve,
    tip_rotation,
)

# The parameters begin with these, then follows the model.
PERIOD = 0  # s
BANDWIDTH = 1  # rad/s
DAMPING_RATIO = 2
ROWS = 3  # of a twist that the arm controls: 3 or 6
IN_TIP_FRAME = 4
APPROACH_SPEED = 5  # m/s; 0 for one that follows from target and effective mass
CONTACT_FORCE = 6  # N; 0 for one that follows from the target
IS_FORCE = 7  # (6,) whether an axis is a force axis
TARGET = 13  # (6,) N and N m
HEADER = 19

# State of a force axis.
TOUCHES = 0
MEASURED = 1  # N, filtered
COMMANDED = 2  # N
INTEGRAL = 3
LOST_TIME = 4  # s
YIELDING = 5  # m/s
STEADY_SPEED = 6  # m/s
AXIS_SIZE = 7

# The memory begins with these; then follow five vectors (n,), memory of the task, and scratch of the model.
WRENCH = 0  # (6,)
HAS_BEGUN = 6
AXES = 7  # (6, AXIS_SIZE)
FILTERED = 49  # (6,) wrench
DIRECTIONS = 55  # (6, 6) the unit twist of each axis in the world
MOBILITY = 91  # (6, 6)
CONTACT = 127  # 15 numbers of scratch
TASK = 142  # (6,)
CORRECTION = 148  # (6,)
SCRATCH = 154  # (6,)
COMMANDS = 160  # (4, 6): of each axis, see below
MEMORY_HEADER = 184

# Commands of the axes.
FORCE = 0  # N
ACCELERATION = 1  # m/s^2 that damps or approaches
SPEED = 2  # m/s of the approach, or that lasts in contact: damping and friction of the joints are compensated at it
YIELDING_SPEED = 3  # m/s in contact at which dry friction is compensated

_FORCE_FILTER = 300.0  # rad/s; about 3 ms against the noise of force sensors
_VELOCITY_FILTER = 100.0  # rad/s; velocities that are differenced from positions are ten times less noisy after it
_WRENCH_FILTER = 40.0  # rad/s. The wrench on motion axes is compensated; faster, it would resonate with a face on a wall.
# Of the measured forces on motion axes. Where a tip sticks, friction is a strong damper. Compensated completely but late, it
# would act like a mass, and the tip would swing slowly along the surface.
_COMPENSATED_SHARE = 0.8
_APPROACH_RATE = 40.0  # 1/s, the bandwidth of the speed in an approach; stable with a delay of 4 ms
_DAMPING_RATE = 30.0  # 1/s, the damping of the tip in contact divided by its mass
_INTEGRAL_RATE = 20.0  # 1/s. Below the damping rate, the integral of a lightly damped wall is stable.
# 1/s. Into a soft wall the tip moves steadily, and its damping and that of the joints would hold back a part of the force: 2 N
# of 20 N for a light arm that sinks 10 mm. So a speed that lasts, and that reduces the error, is damped less and less.
_STEADY_SPEED_RATE = 8.0
# Of the target, a bound for what the damping is relieved of, too. On a soft wall the force rises slowly; it prevents windup.
_MAX_INTEGRATED_ERROR = 0.08
_RISE_TIME_S = 0.02  # time constant of the commanded force after the first contact
# Friction is compensated at this share of the speed that a frictionless mass would have. With all of it, the force loop that is
# closed over the friction is unstable on walls ten times stiffer than MuJoCo's default with a delay of 4 ms.
_YIELDING_RATIO = 0.1
# While there is less force than the contact threshold, the command is this multiple of the measured force. Above 1 it makes the
# force grow on any wall that the slow tip touches; without contact it is zero.
_DETECTION_GAIN = 2.0
_CONTACT_RATIO = 0.1  # of the target, the default contact threshold
_LOST_RATIO = 0.2  # of the contact threshold; below it for _LOST_TIME_S the contact is lost
_LOST_TIME_S = 0.01
# 1/s. A mass m that meets a wall of damping rate b at speed v exerts the force m b v at once. For MuJoCo's contacts b is
# 2 / solref[0], 100 /s by default and 330 /s for one ten times stiffer.
_WALL_DAMPING_RATE = 330.0
_IMPACT_RATIO = 0.7  # of the target, the force of such an impact
_MIN_IMPACT_RATIO = 0.1  # where dry friction is larger
_MAX_APPROACH_SPEED = 0.05  # m/s
_MAX_LEVER_M = 0.2  # a hand may touch a wall this far from the tip, where its effective mass is larger
_MIN_MOBILITY_RATIO = 0.1  # of the mobility of the tip, a lower bound for that of another point


def memory_size(n: int) -> int:
    """Numbers of memory for n joints besides scratch of the model."""
    return MEMORY_HEADER + 5 * n + task_size(n)


@njit_borrowing
def hybrid_force(params, q, v, reference, memory, tau):
    """The law of `HybridForce`."""
    n = tau.shape[0]
    model = params[HEADER:]
    rows = int(params[ROWS])
    at = MEMORY_HEADER
    velocity = memory[at : at + n]
    acceleration = memory[at + n : at + 2 * n]
    v_friction = memory[at + 2 * n : at + 3 * n]
    rate = memory[at + 3 * n : at + 4 * n]
    change = memory[at + 4 * n : at + 5 * n]
    at += 5 * n
    tip = memory[at : at + task_size(n)]
    work = memory[at + task_size(n) :]
    v_ref = reference[V_TICK]
    a_ref = reference[A_TICK]
    _filter_velocity(params[PERIOD], v, memory, velocity)
    measure_tip(model, q, reference[Q_REF], tip, work)
    _find_directions(params, model, work, memory)
    mass_matrix(model, work, inertia(tip, n))
    find_responses(tip, n)
    factors = task_factors(tip, n, rows)
    factorize_mobility(tip, n, factors)
    _command_axes(params, model, tip, factors, velocity, rate, memory)

    posture_bandwidth = 0.5 * params[BANDWIDTH]
    for i in range(n):
        acceleration[i] = posture_bandwidth * posture_bandwidth * (reference[Q_REF, i] - q[i])
        acceleration[i] += 2.0 * posture_bandwidth * (v_ref[i] - velocity[i])
        change[i] = 0.0
    _find_task(params, tip, velocity, v_ref, a_ref, acceleration, memory)
    add_joint_motion(tip, n, factors, memory[TASK : TASK + rows], acceleration)
    # Friction is compensated at the speed at which the tip is to correct its errors: at that of the reference, which may stand
    # still, the friction of the joints would hold the tip where it is.
    add_joint_motion(tip, n, factors, memory[CORRECTION : CORRECTION + rows], change)
    for i in range(n):
        acceleration[i] += a_ref[i]
        v_friction[i] = v_ref[i] + change[i]
        rate[i] = v_friction[i] - velocity[i]
    inverse_dynamics(model, q, v, acceleration, work, tau)
    add_linear_damping(model, rate, tau)
    yielding = memory[SCRATCH : SCRATCH + 6]
    _along_axes(params, memory, YIELDING_SPEED, yielding)
    add_joint_motion(tip, n, factors, yielding[:rows], v_friction)
    add_friction(model, v_friction, a_ref, work, tau)
    wrench = memory[SCRATCH : SCRATCH + 6]
    _along_axes(params, memory, FORCE, wrench)
    _subtract_compensated_wrench(params, memory, wrench)
    J = jacobian(tip, n)
    for i in range(n):
        for k in range(6):
            tau[i] += J[k, i] * wrench[k]


@njit
def _filter_velocity(dt, v, memory, velocity):
    """Low-pass of the measured velocity, which begins with the first one of a run."""
    if memory[HAS_BEGUN] == 0.0:
        memory[HAS_BEGUN] = 1.0
        for i in range(v.shape[0]):
            velocity[i] = v[i]
    for i in range(v.shape[0]):
        velocity[i] += _weight(_VELOCITY_FILTER, dt) * (v[i] - velocity[i])


@njit
def _find_directions(params, model, work, memory):
    """The unit twists of the axes in the world, at the located joints."""
    directions = memory[DIRECTIONS : DIRECTIONS + 36].reshape((6, 6))
    rotation = memory[CONTACT : CONTACT + 9]
    tip_rotation(model, work, rotation)
    in_tip_frame = params[IN_TIP_FRAME] != 0.0
    for k in range(6):
        for j in range(6):
            directions[k, j] = 0.0
    for k in range(3):
        for j in range(3):
            value = rotation[3 * j + k] if in_tip_frame else (1.0 if j == k else 0.0)
            directions[k, j] = value
            directions[3 + k, 3 + j] = value


@njit
def _dot(directions, k, twist):
    """The part of a twist or a wrench (6,) along axis k."""
    total = 0.0
    for j in range(6):
        total += directions[k, j] * twist[j]
    return total


@njit
def _along_axes(params, memory, command, result):
    """The twist or wrench (6,) that has a command of the force axes along these, and nothing along the others."""
    directions = memory[DIRECTIONS : DIRECTIONS + 36].reshape((6, 6))
    for j in range(6):
        result[j] = 0.0
    for k in range(6):
        if params[IS_FORCE + k] != 0.0:
            for j in range(6):
                result[j] += directions[k, j] * memory[COMMANDS + 6 * command + k]


@njit
def _command_axes(params, model, tip, factors, velocity, rate, memory):
    """The commands of the force axes. `rate` is scratch (n,)."""
    n = velocity.shape[0]
    rows = factors.shape[0]
    directions = memory[DIRECTIONS : DIRECTIONS + 36].reshape((6, 6))
    mobility = memory[MOBILITY : MOBILITY + 36].reshape((6, 6))
    twist = memory[TASK : TASK + 6]
    unit = memory[SCRATCH : SCRATCH + rows]
    J = jacobian(tip, n)
    W = mobility_rows(tip, n)
    trace = find_mobility(tip, n, mobility)
    for k in range(6):
        twist[k] = 0.0
        for i in range(n):
            twist[k] += J[k, i] * velocity[i]
        for j in range(k):
            mobility[j, k] = mobility[k, j]
    for k in range(6):
        if params[IS_FORCE + k] == 0.0:
            continue
        # The motion of the joints at unit speed along the axis, and its inertia.
        for j in range(rows):
            unit[j] = directions[k, j]
        solve(factors, unit)
        mass = 0.0
        dry_friction = 0.0
        for i in range(n):
            rate[i] = 0.0
            for j in range(rows):
                rate[i] += W[i, j] * unit[j]
            for j in range(rows):
                mass += unit[j] * J[j, i] * rate[i]
            dry_friction += abs(rate[i]) * model[_drive(model, i) + FRICTION_LOSS]
        target = abs(params[TARGET + k])
        threshold = params[CONTACT_FORCE] if params[CONTACT_FORCE] > 0.0 else _CONTACT_RATIO * target
        approach_speed = params[APPROACH_SPEED]
        if approach_speed == 0.0:
            # When the tip stops, the wall bears the force that moved the joints against their dry friction.
            impact = max(_IMPACT_RATIO * target - dry_friction, _MIN_IMPACT_RATIO * target)
            contact_mobility = _contact_mobility(mobility, trace, directions[k], memory[CONTACT : CONTACT + 15])
            approach_speed = min(_MAX_APPROACH_SPEED, impact * contact_mobility / _WALL_DAMPING_RATE)
        measured = -_dot(directions, k, memory[WRENCH : WRENCH + 6])  # the tip exerts the opposite of the wrench on it
        _command_axis(params, k, measured, _dot(directions, k, twist), mass, approach_speed, threshold, memory)


@njit
def _contact_mobility(mobility, trace, direction, scratch):
    """The smallest mobility, 1/kg, of any point of the hand that may touch, in a direction (6,), a unit twist.

    The mobility of a point at the lever r is that of the twist (n, r x n). It is smallest where the hand does not turn.
    """
    turning = scratch[:9].reshape((3, 3))
    lever = scratch[9:12]
    coupling = scratch[12:15]
    tip = 0.0
    for i in range(6):
        for j in range(6):
            tip += direction[i] * mobility[i, j] * direction[j]
    for i in range(3):
        coupling[i] = 0.0
        for j in range(3):
            coupling[i] += mobility[3 + i, j] * direction[j]
            turning[i, j] = mobility[3 + i, 3 + j]
        turning[i, i] += 1e-9 * trace
        lever[i] = -coupling[i]
    factorize(turning)
    solve(turning, lever)
    length = math.sqrt(lever[0] * lever[0] + lever[1] * lever[1] + lever[2] * lever[2])
    scale = min(1.0, _MAX_LEVER_M / max(length, 1e-12))
    value = tip
    for i in range(3):
        value += 2.0 * scale * lever[i] * coupling[i]
        for j in range(3):
            inertia_part = mobility[3 + i, 3 + j] + (1e-9 * trace if i == j else 0.0)
            value += scale * scale * lever[i] * inertia_part * lever[j]
    return max(value, _MIN_MOBILITY_RATIO * tip)


@njit
def _command_axis(params, k, measured, speed, mass, approach_speed, threshold, memory):
    """The command of one force axis: approach, contact, and back if the contact is lost.

    `measured` is what the tip exerts, N; `mass` is the effective mass, kg, of a tip that moves along the axis only; above the
    threshold, N, there is contact.
    """
    dt = params[PERIOD]
    target = params[TARGET + k]
    axis = memory[AXES + AXIS_SIZE * k : AXES + AXIS_SIZE * (k + 1)]
    axis[MEASURED] += _weight(_FORCE_FILTER, dt) * (measured - axis[MEASURED])
    sign = math.copysign(1.0, target)
    pressing = sign * axis[MEASURED]
    if target == 0.0:
        axis[TOUCHES] = 1.0
    elif axis[TOUCHES] == 0.0:
        if pressing > threshold:
            axis[TOUCHES] = 1.0
            axis[COMMANDED] = axis[MEASURED]
            axis[INTEGRAL] = 0.0
            axis[STEADY_SPEED] = 0.0
            axis[LOST_TIME] = 0.0
    else:
        axis[LOST_TIME] = axis[LOST_TIME] + dt if pressing < _LOST_RATIO * threshold else 0.0
        if axis[LOST_TIME] > _LOST_TIME_S:
            axis[TOUCHES] = 0.0
            axis[INTEGRAL] = 0.0
    if axis[TOUCHES] == 0.0:
        error = sign * approach_speed - speed
        axis[INTEGRAL] += dt * error
        memory[COMMANDS + 6 * FORCE + k] = _DETECTION_GAIN * sign * max(pressing, 0.0)
        # Both poles at half the rate.
        memory[COMMANDS + 6 * ACCELERATION + k] = _APPROACH_RATE * (error + 0.25 * _APPROACH_RATE * axis[INTEGRAL])
        memory[COMMANDS + 6 * SPEED + k] = sign * approach_speed
        memory[COMMANDS + 6 * YIELDING_SPEED + k] = 0.0
        return
    axis[COMMANDED] += _weight(1.0 / _RISE_TIME_S, dt) * (target - axis[COMMANDED])
    error = axis[COMMANDED] - axis[MEASURED]
    damping = _DAMPING_RATE * mass
    bound = _MAX_INTEGRATED_ERROR * abs(target)
    reducing = speed if error * speed > 0.0 else 0.0
    axis[STEADY_SPEED] += _weight(_STEADY_SPEED_RATE, dt) * (reducing - axis[STEADY_SPEED])
    # Up to the speed, so that the damping never pushes, and up to a part of the target, so that a tip that slides or yields
    # stays slow.
    axis[STEADY_SPEED] = clipped(axis[STEADY_SPEED], min(abs(speed), bound / damping))
    damped_speed = speed - axis[STEADY_SPEED]
    # The damping explains a part of the error. If that were integrated, the force would overshoot.
    axis[INTEGRAL] += _INTEGRAL_RATE * dt * clipped(error - damping * damped_speed, bound)
    free_speed = error / damping  # of a mass without friction under this error of the force
    axis[YIELDING] += _weight(_DAMPING_RATE, dt) * (_YIELDING_RATIO * free_speed - axis[YIELDING])
    memory[COMMANDS + 6 * FORCE + k] = axis[COMMANDED] + axis[INTEGRAL]
    memory[COMMANDS + 6 * ACCELERATION + k] = -_DAMPING_RATE * damped_speed
    memory[COMMANDS + 6 * SPEED + k] = axis[STEADY_SPEED]
    memory[COMMANDS + 6 * YIELDING_SPEED + k] = axis[YIELDING]


@njit
def _find_task(params, tip, velocity, v_ref, a_ref, posture, memory):
    """The acceleration of the tip minus that of the posture, and the velocity that corrects its errors; both (6,)."""
    n = velocity.shape[0]
    bandwidth = params[BANDWIDTH]
    directions = memory[DIRECTIONS : DIRECTIONS + 36].reshape((6, 6))
    task = memory[TASK : TASK + 6]
    correction = memory[CORRECTION : CORRECTION + 6]
    feedforward = memory[SCRATCH : SCRATCH + 6]
    J = jacobian(tip, n)
    J_ref = reference_jacobian(tip, n)
    error = tip_error(tip, n)
    for k in range(6):
        rate = 0.0
        feedforward[k] = 0.0
        for i in range(n):
            rate += J_ref[k, i] * v_ref[i] - J[k, i] * velocity[i]
            feedforward[k] += J[k, i] * a_ref[i]
        task[k] = bandwidth * bandwidth * error[k] + 2.0 * params[DAMPING_RATIO] * bandwidth * rate
        correction[k] = 0.5 * bandwidth * error[k]
    for k in range(6):  # the axes are orthogonal, so one after the other can be replaced
        if params[IS_FORCE + k] != 0.0:
            missing = memory[COMMANDS + 6 * ACCELERATION + k] - _dot(directions, k, task) - _dot(directions, k, feedforward)
            missing_speed = memory[COMMANDS + 6 * SPEED + k] - _dot(directions, k, correction)
            for j in range(6):
                task[j] += missing * directions[k, j]
                correction[j] += missing_speed * directions[k, j]
    for k in range(6):
        for i in range(n):
            task[k] -= J[k, i] * posture[i]


@njit
def _subtract_compensated_wrench(params, memory, wrench):
    """Subtracts the measured wrench on motion axes in contact: friction, and the moment of a contact beside the tip."""
    directions = memory[DIRECTIONS : DIRECTIONS + 36].reshape((6, 6))
    filtered = memory[FILTERED : FILTERED + 6]
    in_contact = True
    for k in range(6):
        is_pressing = params[IS_FORCE + k] != 0.0 and params[TARGET + k] != 0.0
        in_contact = in_contact and not (is_pressing and memory[AXES + AXIS_SIZE * k + TOUCHES] == 0.0)
    for j in range(6):
        filtered[j] += _weight(_WRENCH_FILTER, params[PERIOD]) * (memory[WRENCH + j] - filtered[j])
        if not in_contact:
            filtered[j] = 0.0
    compensated = memory[TASK : TASK + 6]
    for j in range(6):
        compensated[j] = filtered[j]
    for k in range(6):
        if params[IS_FORCE + k] != 0.0:
            along = _dot(directions, k, filtered)
            for j in range(6):
                compensated[j] -= along * directions[k, j]
    for j in range(int(params[ROWS])):
        wrench[j] -= (_COMPENSATED_SHARE if j < 3 else 1.0) * compensated[j]


@njit
def _weight(rate, dt):
    """The weight of a new sample in a low-pass of first order."""
    return -math.expm1(-rate * dt)
