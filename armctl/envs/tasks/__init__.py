"""Tasks: they define the goals of episodes, the rewards and success."""

import gymnasium

from armctl.envs.tasks.pick_place import PickPlace
from armctl.envs.tasks.push import PushTask
from armctl.envs.tasks.reach import Reach
from armctl.envs.tasks.reach_past import ReachPast
from armctl.envs.tasks.task import Task
from armctl.envs.tasks.track import Track

TASKS: dict[str, type[Task]] = {task.name: task for task in (Reach, ReachPast, Track, PushTask, PickPlace)}


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
