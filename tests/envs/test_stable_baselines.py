"""stable-baselines3 accepts the environments. Without that package, which needs PyTorch, these tests are skipped."""

import pytest

pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed; pip install stable-baselines3")

import gymnasium
from stable_baselines3.common.env_checker import check_env
from synthetic import arm_with_gripper

pytestmark = pytest.mark.full


@pytest.mark.filterwarnings("error", "ignore::armctl.core.errors.MissingShapeWarning")
@pytest.mark.parametrize(
    ("name", "action"),
    [
        ("Reach", "torque"),
        ("ReachGoal", "cartesian_delta"),
        ("ReachPast", "joint_delta"),
        ("TrackGoal", "joint_target"),
        ("PushGoal", "cartesian_pose"),
        ("PickPlace", "torque"),
    ],
)
def test_stable_baselines_accepts_the_environment(name, action, tmp_path):
    robot = arm_with_gripper(tmp_path) if name in ("PushGoal", "PickPlace") else "robot_arm_3dof"
    check_env(gymnasium.make(f"armctl.envs:armctl/{name}-v0", robot=robot, action=action, horizon=5).unwrapped)
