"""The names of the environments in Gymnasium's registry."""

from __future__ import annotations

import gymnasium

from armctl.envs.tasks import TASKS


def register() -> None:
    """Registers `armctl/Reach-v0`, `armctl/ReachGoal-v0`, and so on."""
    for task in TASKS:
        for goal_conditioned in (False, True):
            gymnasium.register(
                f"armctl/{task}{'Goal' if goal_conditioned else ''}-v0",
                entry_point="armctl.envs.arm_env:ArmEnv",
                vector_entry_point="armctl.envs.vector_env:ArmVectorEnv",
                kwargs={"task": task, "goal_conditioned": goal_conditioned},
                disable_env_checker=True,  # its checks cost more than a step; a test makes them
                order_enforce=False,
            )
