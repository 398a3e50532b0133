"""Experts: scripted policies that solve the tasks with armctl's inverse kinematics, motions and planner."""

import gymnasium
import numpy as np
from numpy.typing import NDArray

from armctl.core.errors import InputError
from armctl.core.validation import shown
from armctl.envs.arm_env import ArmEnv
from armctl.envs.experts.expert import Expert
from armctl.envs.experts.pick_place_expert import PickPlaceExpert
from armctl.envs.experts.planned import ReachExpert, ReachPastExpert, TrackExpert
from armctl.envs.experts.push_expert import PushExpert
from armctl.envs.vector_env import ArmVectorEnv

EXPERTS: dict[str, type[Expert]] = {
    "Reach": ReachExpert,
    "ReachPast": ReachPastExpert,
    "Track": TrackExpert,
    "Push": PushExpert,
    "PickPlace": PickPlaceExpert,
}


class ExpertPolicy:
    """A scripted policy that solves the task of an environment by its actions.

    It plans with armctl's inverse kinematics, motions and planner, and it sees the state of the simulation. Call it before each
    step; it notices when an episode starts.

    Attributes:
        experts: The policy of each row of the environment.
    """

    def __init__(self, env: gymnasium.Env | gymnasium.vector.VectorEnv):
        """The policy of an environment.

        Args:
            env: An environment of armctl, also in wrappers of Gymnasium.

        Raises:
            InputError: It is another environment, or its actions are not "joint_target", "joint_delta" or "cartesian_delta".
        """
        own = getattr(env, "unwrapped", env)
        if not isinstance(own, (ArmEnv, ArmVectorEnv)):
            raise InputError(f"env: {shown(env)} is no environment of armctl; armctl.envs.ArmEnv('panda') is one")
        batch = own.batch
        self.experts = [EXPERTS[batch.task.name](batch, row) for row in range(batch.rows.count)]
        self._is_single = isinstance(own, ArmEnv)

    def __call__(self) -> NDArray[np.float32]:
        """The next action (k,) of an environment, or those (num_envs, k) of a vector environment.

        Returns:
            The action, in [-1, 1].
        """
        actions = np.array([expert.act() for expert in self.experts]).astype(np.float32)
        return actions[0] if self._is_single else actions
