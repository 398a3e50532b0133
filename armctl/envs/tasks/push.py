"""Push: push an object on a table to a goal on the table."""

import numpy as np

from armctl.core.errors import ModelError
from armctl.envs.tasks.tabletop import (
    TABLETOP_GOALS,
    TABLETOP_START_SPREAD,
    TIP_HEIGHT,
    LooseCylinder,
    find_table,
    load_at_table,
)
from armctl.envs.tasks.task import ArmSource, Episode, Task
from armctl.envs.tasks.tool import find_grip, find_tool
from armctl.model.mjmodel.queries import placed
from armctl.plan.ik.problem import ik_chain

_RADIUS = 0.04  # of the object, in reaches
_SHARE_OF_TOOL = 0.65  # of the radius of the tool, at least: an object does not fit between the fingers of a hand
_MAX_HEIGHT = 0.04  # m
_HEIGHT_SHARE = 1.5  # of the radius, at most: pushed at its top, a higher object falls
_MASS = 0.2  # kg
_FRICTION = 0.5  # as of wood on wood; from 1 on, a tool that presses down a little jams the object
_CLEARANCE = 0.03  # m, between the tool and the object below it
_MIN_WAY = 0.06  # m, between object and goal, or the radius of the area if that is less
BEHIND = 0.02  # m, between the tool and the object before it pushes


class PushTask(Task):
    """Push an object on a table to a goal on the table.

    The table is where the tool can point down, by the reach of the arm. The object is an upright cylinder. A gripper
    is closed and braked.
    """

    name = "Push"
    instruction = "Push the object to the target."
    min_duration = 8.0
    object = "object"

    def __init__(self, source: ArmSource, ticks: int):
        """The task; InputError if the robot was loaded already, or its tool cannot point down over a table."""
        alone = source.load()
        try:
            self.grip = find_grip(alone)
            tool = find_tool(alone, [self.grip.closed])
        except ModelError:  # no gripper
            tool = find_tool(alone, [placed(alone.model, alone.home_qpos)])
        self.radius = max(_RADIUS * ik_chain(alone).reach, _SHARE_OF_TOOL * tool.radius)  # m, of the object
        margin = self.radius + tool.radius + BEHIND
        self.height = min(_MAX_HEIGHT, _HEIGHT_SHARE * self.radius)  # m, of the object
        lift = TIP_HEIGHT + self.height + _CLEARANCE
        places = find_table(alone, tool, low=TIP_HEIGHT, lift=lift, margin=margin, height=self.height, task=self.name)
        self.arm, self.table = load_at_table(
            source, places, LooseCylinder(self.radius, self.height, _MASS, _FRICTION), self.name
        )
        self.start_q = self.table.q
        rng = np.random.default_rng(0)
        self.goals = np.array([[self.table.place(rng, 0.5 * self.height)] for _ in range(TABLETOP_GOALS)])

    def draw(self, rng: np.random.Generator) -> Episode:
        """A start above the table, a goal, and a place of the object away from it."""
        goal = int(rng.integers(len(self.goals)))
        place = self.table.place(rng, 0.5 * self.height)
        while np.linalg.norm(place - self.goals[goal, 0]) < min(_MIN_WAY, self.table.radius):
            place = self.table.place(rng, 0.5 * self.height)
        return Episode(self.start(rng, TABLETOP_START_SPREAD), goal, object=place)
