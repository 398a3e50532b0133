"""Gymnasium environments: any arm, armctl's controllers as action spaces, many arms at once in the compiled loop.

Gymnasium knows them when this package is imported, also by the name: `gymnasium.make("armctl.envs:armctl/Reach-v0")`.
Its names are not names of `armctl`, which works without gymnasium.
"""

from importlib.util import find_spec

from armctl.core.errors import NotInstalledError

if find_spec("gymnasium") is None:
    raise NotInstalledError.of_extra("environments need gymnasium", "envs")

from armctl.envs.arm_env import ArmEnv
from armctl.envs.demonstrations import DemonstrationsResult, save_demonstrations
from armctl.envs.experts import ExpertPolicy
from armctl.envs.tasks import register
from armctl.envs.vector_env import ArmVectorEnv

__all__ = ["ArmEnv", "ArmVectorEnv", "DemonstrationsResult", "ExpertPolicy", "save_demonstrations"]

register()
