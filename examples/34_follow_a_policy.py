"""A policy emits chunks of ten targets, ten times a second and 100 ms late; the arm follows them without a jerk."""

import numpy as np

import armctl

LATENCY_S = 0.1  # from the observation to the chunk
ROWS = 10
FRAME_S = 1 / 30

arm = armctl.load("robot_arm_3dof")
sim = armctl.Simulation(arm)
stream = armctl.Stream(arm, arm.home)
rng = np.random.default_rng(0)
hidden = rng.standard_normal((8, 3))


def policy(times: np.ndarray) -> np.ndarray:
    """A small random network of the time, instead of one that was trained."""
    layer = np.sin(np.outer(times, 0.3 + 0.3 * np.arange(8)) + hidden[:, 0])
    return arm.home + np.array([0.4, 0.2, 0.2]) * np.tanh(0.4 * layer @ hidden)


wanted = []
reached = []
for tick in range(int(6.0 / sim.dt)):
    if tick % round(0.1 / sim.dt) == 0:
        times = stream.t - LATENCY_S + FRAME_S * np.arange(ROWS)
        stream.push_chunk(times, policy(times) + 2e-3 * rng.standard_normal((ROWS, 3)))
    state = sim.step(sim.controller.torque(sim.measured_state, stream.step(sim.dt)))
    wanted.append(policy(np.array([stream.t]))[0])
    reached.append(state.q)

error = np.array(wanted) - np.array(reached)
print(f"distance from the policy: {1e3 * np.sqrt((error[500:] ** 2).mean()):.1f} mrad RMS")
print(f"targets that were past when they arrived: {stream.report.dropped}; pushes refused: {stream.report.refused}")
