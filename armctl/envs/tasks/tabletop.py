"""Table: a place in front of an arm over which its tool points down, or is tilted by a constant angle."""

from collections.abc import Iterator
from itertools import islice, product
from typing import NamedTuple

import mujoco
import numpy as np

from armctl.core.errors import InputError
from armctl.core.pose import Pose, computed_pose, rotation_from_vector
from armctl.core.shapes import Box, Cylinder
from armctl.core.validation import Array
from armctl.envs.actions import target_limits
from armctl.envs.tasks.task import ArmSource
from armctl.envs.tasks.tool import Tool
from armctl.model.arm.arm import Arm
from armctl.model.collision.checkers import collision_checker
from armctl.model.collision.world import World
from armctl.model.loading.scene import SceneParts
from armctl.model.mjmodel.queries import placed
from armctl.plan.ik.problem import ik_chain
from armctl.plan.ik.solve import solve_ik

# Candidates: radius of the area in which objects and goals are, height and distance from the first joint, in reaches; rad from
# the direction of the tip at home.
TABLETOP_GOALS = 1024
TABLETOP_START_SPREAD = 0.03  # rad (m)
TIP_HEIGHT = 0.01  # m, of the end of the tool above the table
_RADII = (0.1, 0.08, 0.06, 0.045)
_HEIGHTS = (-0.25, -0.15, -0.05, -0.35, 0.05, 0.15)
_DISTANCES = (0.5, 0.45, 0.55, 0.4, 0.6, 0.35)
_DIRECTIONS = (0.0, np.pi / 2, -np.pi / 2, np.pi)
# rad, of the tool away from the base. An arm whose tool is long for its reach cannot let it point straight down over an area.
_TILTS = (0.0, 0.35, 0.6)
_MIN_TOP = 0.03  # m: the table is above the ground
_THICKNESS = 0.02  # m
_MAX_TURN = 2.0  # rad, of a joint over the whole area
_MIN_MARGIN = 0.05  # rad, to the limits of the joints
_EDGE = np.array([[np.cos(angle), np.sin(angle)] for angle in np.arange(8) * np.pi / 4])  # of a unit disc
_MAX_SCENES = 8  # that are built to look for contacts


class Tabletop(NamedTuple):
    """A table in front of an arm."""

    center: Array  # (3,) m, of the area, on top of the table
    radius: float  # m, of the area
    low: float  # m, height of the end of the tool above the table when it works there
    lift: float  # m, height of the end of the tool above the table when it moves
    tool: Tool  # the tool, which points down
    tilt: float  # rad, by which it points away from the base
    base: Array  # (2,) m, the place of the first joint
    q: Array  # (n,) rad, with the end of the tool above the center at its greatest height

    def place(self, rng: np.random.Generator, height: float) -> Array:
        """(3,) m, a random point of the area, at a height above the table."""
        angle = rng.uniform(0.0, 2.0 * np.pi)
        distance = self.radius * np.sqrt(rng.random())
        return self.center + np.array([distance * np.cos(angle), distance * np.sin(angle), height])

    def pose(self, end: Array) -> Pose:
        """A pose of the tip with the end of the tool at a position (3,) m."""
        away = end[:2] - self.base
        x, y = away / max(float(np.linalg.norm(away)), 1e-9)
        rotation = rotation_from_vector(self.tilt * np.array([y, -x, 0.0])) @ self.tool.rotation_down
        return computed_pose(end - rotation @ self.tool.end, rotation)

    def reach_over(self, height: float) -> float:
        """m, how far the tilted tool is ahead of its end at a height above it."""
        return height * float(np.tan(self.tilt))


class LooseCylinder(NamedTuple):
    """An upright cylinder."""

    radius: float  # m
    height: float  # m
    mass: float  # kg
    friction: float  # coefficient of friction, with everything


class _SceneWithCylinder(SceneParts):
    """A scene with a table, and a cylinder called "object"."""

    def __init__(self, table: Tabletop, cylinder: LooseCylinder):
        edge = 2.0 * (table.radius + 3.0 * cylinder.radius)
        top = Box([edge, edge, _THICKNESS])
        away = table.center + np.array([0.0, 0.0, 10.0 * edge])  # where it touches nothing; each episode places it
        world = World().add("task_table", top, table.center - np.array([0.0, 0.0, 0.5 * _THICKNESS]))
        super().__init__(world.add("object", Cylinder(cylinder.radius, cylinder.height), away, mass=cylinder.mass))
        self._friction = cylinder.friction

    def build(self, spec: mujoco.MjSpec) -> None:
        """Adds everything, and sets the friction of the cylinder."""
        super().build(spec)
        spec.geom("object").friction[0] = self._friction


_Place = tuple[Tabletop, list[Array]]  # a candidate: the table, and the configurations over its corners


def find_table(arm: Arm, tool: Tool, *, low: float, lift: float, margin: float, height: float, task: str) -> Iterator[_Place]:
    """Places for a table, the preferred ones first; InputError, with the name of the task, if there is none.

    At each of them the tool can point down over all corners of the area and a margin around it, with its end `low` and
    `lift` above the table, and the arm moves there without large turns of its joints. A tilted tool needs room beside an
    object of a height. Lengths are in m.
    """
    reach = ik_chain(arm).reach
    base = placed(arm.model, arm.qpos(arm.home)).xanchor[arm.joint_map.joints[0]]
    ahead = arm.fk(arm.home).position - base
    heading = float(np.arctan2(ahead[1], ahead[0]))
    has_ground = base[2] > 0.0
    middles: dict[tuple[float, ...], Array | None] = {}
    found = False
    for tilt, turn, radius, drop, distance in product(_TILTS, _DIRECTIONS, _RADII, _HEIGHTS, _DISTANCES):
        direction = np.array([np.cos(heading + turn), np.sin(heading + turn), 0.0])
        center = base + reach * (distance * direction + np.array([0.0, 0.0, drop]))
        center[2] = max(center[2], _MIN_TOP) if has_ground else center[2]
        table = Tabletop(center, radius * reach, low, lift, tool, tilt, base[:2], arm.home)
        where = (tilt, *center)
        if where not in middles:
            middles[where] = _solve(arm, table, np.array([0.0, 0.0, lift]), arm.home)
        corners = _corners(arm, table, middles[where], margin + table.reach_over(height))
        if corners is not None:
            found = True
            yield table._replace(q=corners[0]), corners
    if not found:
        width = 2.0 * (_RADII[-1] * reach + margin)
        raise InputError(
            f"robot: {task} needs a tool that points down over a table, with its end {low:.2f} to {lift:.2f} m above it; "
            f"{arm.name:.80} can do so nowhere {width:.2f} m wide; Reach, ReachPast and Track need no table"
        )


def load_at_table(source: ArmSource, places: Iterator[_Place], cylinder: LooseCylinder, name: str) -> tuple[Arm, Tabletop]:
    """The arm at the first place where it touches neither the table nor itself, with a cylinder on the table.

    InputError if there is none, or the robot was loaded already.
    """
    for table, corners in islice(places, _MAX_SCENES):
        arm = source.load_among(_SceneWithCylinder(table, cylinder), name)
        checker = collision_checker(arm)
        if not any(checker.at(q) for q in corners):
            return arm, table
    raise InputError(f"robot: {name} finds no place for a table that the arm does not touch; mount the arm higher or alone")


def _corners(arm: Arm, table: Tabletop, middle: Array | None, margin: float) -> list[Array] | None:
    """Configurations over the area, that above its center first, if there is one; None if the arm is not good there."""
    limits = target_limits(arm)
    if middle is None:
        return None
    found = [middle]
    for (x, y), height in product((table.radius + margin) * _EDGE, (table.lift, table.low)):
        q = _solve(arm, table, np.array([x, y, height]), middle)
        if q is None or np.abs(q - middle).max() > _MAX_TURN:
            return None
        if (q < limits.q_min + _MIN_MARGIN).any() or (q > limits.q_max - _MIN_MARGIN).any():
            return None
        found.append(q)
    return found


def _solve(arm: Arm, table: Tabletop, offset: Array, q: Array) -> Array | None:
    """The configuration near q with the end of the tool at an offset from the center of the area; None if there is none."""
    result = solve_ik(arm, table.pose(table.center + offset), q, free_axis=table.tool.axis)
    return result.q if result.ok else None
