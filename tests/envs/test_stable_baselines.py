"""stable-baselines3 accepts the environments. Without that package, which needs PyTorch, these tests are skipped."""

import gymnasium
import pytest

pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed; pip install stable-baselines3")

from stable_baselines3.common.env_checker import check_env


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", ["Reach", "ReachGoal"])
@pytest.mark.parametrize("action", ["torque", "cartesian_delta"])
def test_stable_baselines_accepts_the_environment(name, action):
    check_env(gymnasium.make(f"armctl.envs:armctl/{name}-v0", robot="robot_arm_3dof", action=action).unwrapped)
