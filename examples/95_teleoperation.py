"""Teleoperation: the velocities of a hand at a joystick become demonstrations, and a replay of each one has a verdict."""

import tempfile
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

import armctl.envs

env = armctl.envs.ArmEnv("robot_arm_3dof", "Reach", "cartesian_delta", render_mode="rgb_array", width=96, height=96)
columns = env.batch.observer.columns
hand = np.random.default_rng(0)
seen = []


def joystick(observation: np.ndarray) -> np.ndarray:
    """A hand that sees the way to the goal 0.1 s late and trembles; read the axes of your device here."""
    seen.append(observation[columns["to_goal"]])
    return np.clip(8.0 * seen[max(-3, -len(seen))] + 0.05 * hand.standard_normal(3), -1.0, 1.0)


with tempfile.TemporaryDirectory() as folder:
    dataset = Path(folder) / "teleoperation"
    print(armctl.envs.save_demonstrations(env, dataset, episodes=3, seed=1, policy=joystick))
    rows = pq.read_table(dataset / "data/chunk-000/file-000.parquet").to_pandas()
sim = armctl.Simulation("robot_arm_3dof")
for episode, frames in rows.groupby("episode_index"):
    states = np.stack(list(frames["observation.state"]))
    sim.reset(states[0, columns["q"]])
    with sim.streaming() as run:
        run.stream.push_chunk(env.batch.step_time * np.arange(1, len(states)), states[1:, columns["q"]])
        run.advance(run.stream.time_left + 0.5)
    distance = np.linalg.norm(sim.tip.position - states[-1, columns["goal"]])
    verdict = "reached" if distance < env.batch.task.tolerance else "missed"
    used = (np.abs(sim.log.v) / sim.arm.limits.v_max).max(), armctl.Report.from_log(sim.log).peak_torque_ratio
    touched = ", ".join(contact.other for contact in sim.log.contacts) or "nothing"
    print(f"episode {episode}: {verdict}, {1e3 * distance:.1f} mm from the goal, touched {touched};", end=" ")
    print(f"at most {100 * used[0]:.0f} % of the speed limits and {100 * used[1]:.0f} % of the torque limits")
env.close()
