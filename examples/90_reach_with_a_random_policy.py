"""Environments for learning: many arms in one step, with unknown payloads; a random policy and inverse kinematics."""

import gymnasium
import numpy as np

import armctl

arm = armctl.load("robot_arm_3dof")
envs = gymnasium.make_vec(
    "armctl.envs:armctl/Reach-v0",
    num_envs=200,
    robot=arm,
    action="joint_target",
    threads=2,
    randomize={"payload": armctl.Range(0.0, 0.2)},  # kg, missing in the controller's model
)
print(f"{envs.num_envs} environments with actions of shape {envs.single_action_space.shape}")


def asked_by_kinematics(observations):
    """The actions that ask for the joint positions at which each tip is at its goal."""
    goals = observations[:, 3 * arm.n + 3 : 3 * arm.n + 6]
    q = np.array([armctl.solve_ik(arm, goal.astype(float)).q for goal in goals])
    return 2.0 * (q - arm.limits.q_min) / (arm.limits.q_max - arm.limits.q_min) - 1.0


rng = np.random.default_rng(0)
for policy in ("random", "inverse kinematics"):
    observations, _ = envs.reset(seed=0)
    asked = asked_by_kinematics(observations)
    for _ in range(50):
        actions = asked if policy == "inverse kinematics" else rng.uniform(-1.0, 1.0, asked.shape)
        observations, rewards, _, ended, information = envs.step(actions)
    reached = int(information["is_success"].sum())
    distance = 1e3 * np.median(information["distance"])
    print(f"{policy}: {reached} of {envs.num_envs} within 20 mm, median distance {distance:.1f} mm")
envs.close()
