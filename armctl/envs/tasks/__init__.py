"""Tasks: they define the goals of episodes, the rewards and success."""

from armctl.envs.tasks.interface import Episode, Task
from armctl.envs.tasks.pick_place import PickPlace
from armctl.envs.tasks.push import Push
from armctl.envs.tasks.reach import Reach
from armctl.envs.tasks.reach_past import ReachPast
from armctl.envs.tasks.track import Track

TASKS: dict[str, type[Task]] = {task.name: task for task in (Reach, ReachPast, Track, Push, PickPlace)}

__all__ = ["TASKS", "Episode", "PickPlace", "Push", "Reach", "ReachPast", "Task", "Track"]
