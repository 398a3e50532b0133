"""Camera observations: a policy gets its joints and a picture, but not its goal; demonstrations film the same camera."""

import tempfile
from pathlib import Path

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict

import armctl.envs


class WithPicture(gymnasium.ObservationWrapper):
    def __init__(self, env):
        super().__init__(env)
        self.columns = env.unwrapped.batch.observer.columns["q"]
        joints = Box(-np.inf, np.inf, (env.unwrapped.batch.arm.n,), np.float32)
        self.observation_space = Dict(picture=Box(0, 255, (96, 96, 3), np.uint8), joints=joints)

    def observation(self, observation):
        return {"picture": self.unwrapped.see()["above"].colour, "joints": observation[self.columns]}


above = armctl.Camera(armctl.Pose([0.2, 0.0, 1.5], rpy=[np.pi, 0.0, 0.0]), fovy=1.0, name="above")  # looks down
options = {"robot": "robot_arm_3dof", "action": "joint_target", "cameras": [above], "width": 96, "height": 96}
env = WithPicture(gymnasium.make("armctl.envs:armctl/Reach-v0", **options))
observation, _ = env.reset(seed=0)
print({name: (value.dtype.name, value.shape) for name, value in observation.items()})

# The goal is drawn in green, as a mark that depth does not contain: its pixels give a line of sight.
seen = env.unwrapped.see()["above"]
red, green, blue = seen.colour[seen.is_seen].astype(float).T
sight = seen.points[green > 2.0 * np.maximum(red, blue)].mean(axis=0) - above.at.position
off = np.cross(sight / np.linalg.norm(sight), env.unwrapped.batch.goal[0] - above.at.position)
print(f"the line of sight passes the goal within 10 mm: {np.linalg.norm(off) < 0.01}")

with tempfile.TemporaryDirectory() as folder:
    print(armctl.envs.save_demonstrations(env.unwrapped, Path(folder) / "reach", episodes=3, seed=1))
    print(*(path.name for path in (Path(folder) / "reach" / "videos").iterdir()))
env.close()
