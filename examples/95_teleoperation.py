"""Teleoperation: the velocities of a hand at a joystick become demonstrations, and a replay of each one has a verdict."""

import tempfile
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

import armctl.envs

env = armctl.envs.ArmEnv("robot_arm_3dof", "Reach", "cartesian_delta", render_mode="rgb_array", width=96, height=96)
to_goal = env.batch.observer.columns["to_goal"]
hand = np.random.default_rng(0)
seen: list[np.ndarray] = []


def joystick(observation: np.ndarray) -> np.ndarray:
    """A hand that sees the way to the goal 0.1 s late and trembles; read the axes of your device here."""
    seen.append(observation[to_goal])
    return np.clip(8.0 * seen[max(-3, -len(seen))] + 0.05 * hand.standard_normal(3), -1.0, 1.0)


with tempfile.TemporaryDirectory() as folder:
    dataset = Path(folder) / "teleoperation"
    print(armctl.envs.save_demonstrations(env, dataset, episodes=3, seed=1, policy=joystick))
    rows = pq.read_table(dataset / "data/chunk-000/file-000.parquet").to_pandas()

for episode, frames in rows.groupby("episode_index"):
    _, information = env.reset(seed=1 + int(episode))
    for action in frames["action"]:
        information = env.step(action)[4]
    verdict = "reached" if information["is_success"] else "missed"
    print(f"episode {episode}: {len(frames)} frames, replayed: {verdict}, {1e3 * information['distance']:.1f} mm from the goal")
env.close()
