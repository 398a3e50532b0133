"""Your own MPC with `sim.step`: a quadratic program plans accelerations, and inverse dynamics turns the first into a torque."""

import daqp
import numpy as np

import armctl

COUNT, INTERVAL = 15, 0.02  # intervals of the horizon, and their length, s
steps = np.tril(np.ones((COUNT, COUNT)))
to_velocity = INTERVAL * steps  # from accelerations to velocities at the ends of the intervals
to_position = INTERVAL * (to_velocity @ steps - 0.5 * to_velocity)
cost = to_position.T @ to_position + 0.01 * to_velocity.T @ to_velocity + 1e-7 * np.eye(COUNT)


def planned(error: float, v: float, v_max: float, a_max: float) -> float:
    """The first acceleration, rad/s^2, that brings a joint to its target within its limits."""
    free = error + v * INTERVAL * (1.0 + np.arange(COUNT))
    f = to_position.T @ free + 0.01 * to_velocity.T @ np.full(COUNT, v)
    upper = np.concatenate([np.full(COUNT, a_max), np.full(COUNT, v_max - v)])
    lower = np.concatenate([np.full(COUNT, -a_max), np.full(COUNT, -v_max - v)])
    return daqp.solve(cost, f, to_velocity, upper, lower, np.zeros(2 * COUNT, dtype=np.int32))[0][0]


arm = armctl.load("robot_arm_3dof")
sim = armctl.Simulation(arm)
state = sim.measured_state
limits = arm.limits
while state.t < 2.0:
    target = arm.home + (0.8 if state.t < 0.3 else -0.6)  # it changes while the arm moves
    a = [planned(*joint) for joint in zip(state.q - target, state.v, limits.v_max, limits.a_max, strict=True)]
    state = sim.step(arm.inverse_dynamics(state.q, state.v, a))

print("error at the end:", np.abs(state.q - target).max().round(5), "rad")
print("largest velocity:", (np.abs(sim.log.v) / limits.v_max).max().round(3), "of the limit")
