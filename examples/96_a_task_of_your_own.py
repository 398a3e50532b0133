"""A task of your own for learning: goals on a line in front of the arm, and a reward that also counts the joint speeds."""

import gymnasium
import numpy as np

import armctl.envs


class GentleReach(gymnasium.Wrapper):
    def __init__(self, env):
        super().__init__(env)
        self.velocities = env.unwrapped.batch.observer.columns["v"]
        self.rng = np.random.default_rng()

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        goal = [0.3, self.rng.uniform(-0.2, 0.2), 0.3]  # m
        return self.env.reset(seed=seed, options={**(options or {}), "goal": goal})

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        speeds = observation[self.velocities]  # rad/s
        return observation, reward - 0.1 * float(speeds @ speeds), terminated, truncated, info


env = GentleReach(gymnasium.make("armctl.envs:armctl/Reach-v0", robot="robot_arm_3dof", action="joint_delta"))
expert = armctl.envs.ExpertPolicy(env.unwrapped)
for seed in range(3):
    observation, info = env.reset(seed=seed)
    total, is_over = 0.0, False
    while not is_over:
        observation, reward, terminated, truncated, info = env.step(expert())
        total += reward
        is_over = terminated or truncated
    print(f"goal {seed}: return {total:.1f}, {1e3 * info['distance']:.1f} mm from the goal")
