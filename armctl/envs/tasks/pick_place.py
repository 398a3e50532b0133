"""PickPlace: lift an object to a goal with a gripper."""

from dataclasses import replace
from functools import cached_property

import numpy as np

from armctl.core.errors import InputError, ModelError
from armctl.core.validation import Array
from armctl.envs.tasks.tabletop import (
    TABLETOP_GOALS,
    TABLETOP_START_SPREAD,
    TIP_HEIGHT,
    LooseCylinder,
    find_table,
    load_at_table,
)
from armctl.envs.tasks.task import ArmSource, Episode, Task
from armctl.envs.tasks.tool import find_grip, find_tool, jaw_center
from armctl.model.arm.arm import Arm
from armctl.model.gripper.grip_frames import GripFrames, grip_frames
from armctl.model.gripper.gripper_model import GripperModel, find_gripper_model
from armctl.plan.ik.problem import ik_chain

_WIDTH_SHARE = 0.5  # of the object, of the open gripper
_MAX_WIDTH = 0.05  # m
_WIDTH_OF_REACH = 0.06  # of the object, at most
_MIN_HEIGHT = 0.04  # m
_DENSITY = 600.0  # kg/m^3
_FRICTION = 1.0  # as of rubber, to be held
_LIFT = 0.15  # how high the tip moves, in reaches
_WIDTH_WHEN_AROUND = 2.0  # of the object: how far the jaws are apart when the object is in their middle
_LIFTED = (0.3, 0.8)  # of the height at which the tip moves, of goals above the table


class PickPlace(Task):
    """Lift an object to a goal with a gripper.

    The table is where the tool can point down, by the reach of the arm. The object is an upright cylinder, half as wide as the
    open gripper.
    """

    name = "PickPlace"
    instruction = "Lift the object to the target."
    min_duration = 8.0
    object = "object"
    uses_gripper = True

    def __init__(self, source: ArmSource, ticks: int):
        """The task; InputError if the robot was loaded already, has no gripper, or no place for a table."""
        alone = source.load()
        try:
            self.grip = find_grip(alone)
        except ModelError as error:
            hint = "load_options={'tool': 'robotiq_2f85'} mounts one"
            raise InputError(f"robot: PickPlace needs a gripper: {error!s:.250}; {hint}") from None
        tool = find_tool(alone, [self.grip.closed, self.grip.opened])
        reach = ik_chain(alone).reach
        width = min(_WIDTH_SHARE * self.grip.width_max, _WIDTH_OF_REACH * reach, _MAX_WIDTH)
        # (3,) m, in the tip's frame, beside the line along which the tool points: the middle between the jaws
        self.grasp = jaw_center(alone, self.grip, tool, _WIDTH_WHEN_AROUND * width)
        self.height = max(_MIN_HEIGHT, 1.5 * width)  # m, of the object
        mass = _DENSITY * np.pi * (0.5 * width) ** 2 * self.height
        lift = TIP_HEIGHT + max(_LIFT * reach, 2.0 * self.height)
        margin = float(np.linalg.norm(self.grasp))
        places = find_table(alone, tool, low=TIP_HEIGHT, lift=lift, margin=margin, height=0.0, task=self.name)
        self.arm, self.table = load_at_table(
            source, places, LooseCylinder(0.5 * width, self.height, mass, _FRICTION), self.name
        )
        self.start_q = self.table.q
        rng = np.random.default_rng(0)
        self.goals = np.array([[self._goal(rng)] for _ in range(TABLETOP_GOALS)])

    @cached_property
    def handling_arm(self) -> Arm:
        """The arm for plans: what has no shape touches nothing in the simulation either."""
        return replace(self.arm, unchecked_links=())

    @cached_property
    def gripper(self) -> GripperModel:
        """The gripper in the scene of the task."""
        return find_gripper_model(self.arm)

    @cached_property
    def grip_frames(self) -> GripFrames:
        """Where it holds."""
        return grip_frames(self.arm, self.gripper)

    def draw(self, rng: np.random.Generator) -> Episode:
        """A start above the table, a goal in the air, and a place of the object."""
        goal = int(rng.integers(len(self.goals)))
        return Episode(self.start(rng, TABLETOP_START_SPREAD), goal, object=self.table.place(rng, 0.5 * self.height))

    def _goal(self, rng: np.random.Generator) -> Array:
        """(3,) m, a goal above the table."""
        lifted = rng.uniform(*_LIFTED) * (self.table.lift - self.table.low)
        return self.table.place(rng, 0.5 * self.height + lifted)
