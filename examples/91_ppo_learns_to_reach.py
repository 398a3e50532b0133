"""PPO of stable-baselines3 learns Reach without contacts; the policy is then tested and filmed with contacts."""

import sys
import time
from pathlib import Path

import numpy as np
from PIL import Image

from armctl.envs import ArmEnv, ArmVectorEnv

try:
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecEnv
except ImportError:
    raise SystemExit("stable-baselines3 is not installed; pip install stable-baselines3") from None


class Batch(VecEnv):
    """An ArmVectorEnv in the interface of stable-baselines3."""

    def __init__(self, envs):
        self.envs = envs
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self):
        return self.envs.reset(seed=0)[0]

    def step_async(self, actions):
        self.actions = actions

    def step_wait(self):
        observations, rewards, _, ended, information = self.envs.step(self.actions)
        infos = [{} for _ in range(self.num_envs)]
        for k in np.flatnonzero(ended):
            infos[k] = {"terminal_observation": information["final_obs"][k], "TimeLimit.truncated": True}
        return observations, rewards, ended, infos

    def close(self):
        self.envs.close()

    def get_attr(self, name, indices=None):
        return [None] * self.num_envs

    def set_attr(self, name, value, indices=None):
        raise NotImplementedError

    def env_method(self, name, *args, indices=None, **kwargs):
        raise NotImplementedError

    def env_is_wrapped(self, wrapper, indices=None):
        return [False] * self.num_envs


def success(policy, envs, seed):
    """The share of episodes that end within 20 mm of their goals, and the largest distance, m."""
    observations, _ = envs.reset(seed=seed)
    for _ in range(50):
        observations, _, _, _, information = envs.step(policy.predict(observations, deterministic=True)[0])
    return information["is_success"].mean(), information["distance"].max()


torch.set_num_threads(1)
start = time.process_time()
envs = ArmVectorEnv("panda", action="joint_delta", num_envs=256)
policy = PPO(
    "MlpPolicy",
    Batch(envs),
    n_steps=50,
    batch_size=3200,
    n_epochs=8,
    learning_rate=1e-3,
    gamma=0.95,
    gae_lambda=0.9,
    policy_kwargs={"log_std_init": -1.0},
    device="cpu",
    seed=0,
)
policy.learn(int(sys.argv[2]) if len(sys.argv) > 2 else 600_000)
print(f"{policy.num_timesteps} steps in {time.process_time() - start:.0f} s of CPU time")
touching = ArmVectorEnv("panda", action="joint_delta", num_envs=500, contacts=True)
for name, tested in (("without contacts", envs), ("with contacts", touching)):
    share, distance = success(policy, tested, seed=10_000)
    print(
        f"{name}: {share:.1%} of {tested.num_envs} episodes end within 20 mm, the largest distance is {1e3 * distance:.1f} mm"
    )

env = ArmEnv("panda", action="joint_delta", contacts=True, render_mode="rgb_array")
pictures = []
for episode in range(3):
    observation, _ = env.reset(seed=episode)
    for _ in range(25):
        pictures.append(Image.fromarray(env.render()))
        observation = env.step(policy.predict(observation, deterministic=True)[0])[0]
folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
folder.mkdir(exist_ok=True)
pictures[0].save(folder / "policy.gif", save_all=True, append_images=pictures[1:], duration=50, loop=0)
print("filmed 3 episodes in policy.gif")
