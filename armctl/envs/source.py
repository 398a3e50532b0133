"""ArmSource: the robot of an environment, which a task loads among its objects."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import mujoco

from armctl.core.errors import InputError
from armctl.core.validation import instance
from armctl.loading.load import load
from armctl.loading.scene import Scene
from armctl.robot.arm import Arm

Robot = str | os.PathLike[str] | mujoco.MjSpec | Arm


class ArmSource:
    """A robot that can be loaded, or an arm that was loaded."""

    def __init__(self, robot: Robot, load_options: Mapping[str, Any] | None):
        """A robot.

        Args:
            robot: An arm, or what `armctl.load` takes.
            load_options: Keyword arguments of `armctl.load`, except its scene.

        Raises:
            InputError: Another type, a scene among the options, or options for an arm that was loaded.
        """
        instance("robot", robot, (str, os.PathLike, mujoco.MjSpec, Arm), "'panda' or armctl.load('panda') is one")
        instance("load_options", load_options or {}, Mapping, "{'tool': 'robotiq_2f85'} is one")
        self._robot = robot
        self._options = dict(load_options or {})
        if "scene" in self._options:
            raise InputError("load_options: the scene belongs to the task; give other arguments of armctl.load, such as 'tool'")
        if self._options and isinstance(robot, Arm):
            raise InputError(f"load_options: {robot.name:.80} is loaded already; give its name or file instead")

    def load(self) -> Arm:
        """The arm alone."""
        return self._robot if isinstance(self._robot, Arm) else load(self._robot, **self._options)

    def load_among(self, scene: Scene, task: str) -> Arm:
        """The arm among the objects of a task.

        Raises:
            InputError: The arm was loaded already.
        """
        if isinstance(self._robot, Arm):
            raise InputError(
                f"robot: {task} puts objects around the robot, and {self._robot.name:.80} is loaded already; give its name or "
                "file, and load_options={'tool': ...} for arguments of armctl.load"
            )
        return load(self._robot, scene=scene, **self._options)
