"""Demonstrations: a scripted expert moves past obstacles, and its episodes become a data set for imitation learning."""

import json
import tempfile
from pathlib import Path

import pyarrow.parquet as pq

import armctl.envs

env = armctl.envs.ArmEnv("robot_arm_3dof", "ReachPast", "joint_target", render_mode="rgb_array", width=96, height=96)

policy = armctl.envs.ExpertPolicy(env)
env.reset(seed=0)
success = [env.step(policy())[4]["is_success"] for _ in range(env.batch.horizon)]
print(f"the expert is at the goal after {(1 + success.index(True)) * env.batch.step_time:.2f} s")

with tempfile.TemporaryDirectory() as folder:
    dataset = Path(folder) / "reach_past"
    print(armctl.envs.save_demonstrations(env, dataset, episodes=3, seed=1))
    info = json.loads((dataset / "meta/info.json").read_text())
    rows = pq.read_table(dataset / "data/chunk-000/file-000.parquet")
    film = dataset / "videos/observation.images.front/chunk-000/file-000.mp4"
    print(f"LeRobotDataset {info['codebase_version']}, {info['fps']} frames per second, of {info['robot_type']}")
    for name in ("observation.state", "action", "observation.images.front"):
        print(f"{name}: {info['features'][name]['dtype']} {info['features'][name]['shape']}")
    print(f"{rows.num_rows} rows, and a film: {film.exists()}")
env.close()
