"""lerobot reads what `save_demonstrations` writes. Without that package, which needs PyTorch, this test is skipped."""

import numpy as np
import pytest

pytest.importorskip("lerobot", reason="lerobot is not installed; pip install lerobot")

import pyarrow.parquet as pq
from lerobot.datasets.lerobot_dataset import LeRobotDataset

import armctl.envs

EPISODES = 2


@pytest.mark.full
def test_lerobot_reads_every_frame(tmp_path):
    folder = tmp_path / "reach"
    env = armctl.envs.ArmEnv("robot_arm_3dof", action="cartesian_delta")
    assert armctl.envs.save_demonstrations(env, folder, EPISODES)
    rows = pq.read_table(folder / "data/chunk-000/file-000.parquet")
    read = LeRobotDataset("local/reach", root=folder)
    assert (read.num_episodes, len(read), read.fps) == (EPISODES, len(rows), 20)
    for k in range(len(rows)):
        frame = read[k]
        assert frame["task"] == env.batch.task.instruction
        for name in ("observation.state", "action", "next.reward", "next.done", "episode_index", "timestamp"):
            assert np.allclose(frame[name].numpy(), rows[name][k].as_py())
    last = LeRobotDataset("local/reach", root=folder, episodes=[1], delta_timestamps={"action": [0.0, 0.05]})
    assert last[0]["action"].shape == (2, 3)
    assert set(read.meta.stats["action"]) >= {"mean", "std", "q01", "q99"}
