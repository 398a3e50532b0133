"""ReachPast: move the tip to a point with an obstacle on the straight path."""

import copy

import mujoco
import numpy as np

from armctl.core.errors import InputError
from armctl.core.shapes import Ball
from armctl.core.validation import Array
from armctl.envs.tasks.task import ArmSource, Episode, Task, free_configurations
from armctl.model.arm.arm import Arm
from armctl.model.collision.world import World
from armctl.model.loading.scene import SceneParts
from armctl.model.mjmodel.queries import acts
from armctl.plan.ik.problem import ik_chain

_SPREAD = 0.8  # rad (m), of all joints around home
_CONFIGURATIONS = 2048
_EPISODES = 512
_RADIUS = 0.06  # of the ball, as a fraction of the reach
_MIN_WAY = 4.0  # radii between start and goal
_CLEARANCE = 0.5  # radii, of start and goal to the ball
_AWAY = 10.0  # reaches below the base: where the ball touches nothing


class _SceneWithBall(SceneParts):
    """A scene whose ball can be moved without a change of the model."""

    def build(self, spec: mujoco.MjSpec) -> None:
        super().build(spec)
        next(body for body in spec.bodies if body.name == ReachPast.obstacle).mocap = True


class ReachPast(Task):
    """Move the tip to a point without touching a ball on the straight path.

    The ball is where the tip is in the middle of the straight way between the start and the goal in joint space. At the start
    and at the goal the arm is clear of it by half of its radius.
    """

    name = "ReachPast"
    instruction = "Move the tip to the target without touching the obstacle."
    min_duration = 4.0
    obstacle = "obstacle"

    def __init__(self, source: ArmSource, ticks: int):
        """The task; InputError if the robot was loaded already, or hardly any start and goal have the ball between them."""
        reach = ik_chain(source.load()).reach
        radius = _RADIUS * reach
        scene = _SceneWithBall(World().add(self.obstacle, Ball(radius), [0.0, 0.0, -_AWAY * reach]))
        self.arm = source.load_among(scene, self.name)
        q = free_configurations(self.arm, _CONFIGURATIONS, _SPREAD)
        tips = self.arm.fk_many(q)[0]
        middles = self.arm.fk_many(0.5 * (q[: len(q) // 2] + q[len(q) // 2 :]))[0]
        touches = _BallProbe(self.arm, self.obstacle, (1.0 + _CLEARANCE) * radius)
        starts: list[Array] = []
        self._obstacles: list[Array] = []
        goals: list[Array] = []
        for start, ball in enumerate(middles):
            goal = start + len(middles)
            far = np.linalg.norm(tips[goal] - tips[start]) > _MIN_WAY * radius
            if far and not touches(q[start], ball) and not touches(q[goal], ball):
                starts.append(q[start])
                goals.append(tips[goal])
                self._obstacles.append(ball)
        if not starts:
            raise InputError(f"robot: {self.arm.name:.80} finds no start and goal near home with an obstacle between them")
        self._starts = starts[:_EPISODES]
        self.start_q = self._starts[0]
        self.goals = np.array(goals[:_EPISODES])[:, None]

    def draw(self, rng: np.random.Generator) -> Episode:
        """One of the goals, with its start and its obstacle."""
        goal = int(rng.integers(len(self.goals)))
        return Episode(self._starts[goal], goal, obstacle=self._obstacles[goal])


class _BallProbe:
    """Tells whether an arm touches a ball."""

    def __init__(self, arm: Arm, body: str, radius: float):
        self._arm = arm
        self._model = copy.copy(arm.model)
        self._data = mujoco.MjData(self._model)
        self._geom = int(self._model.body(body).geomadr[0])
        self._mocap = int(self._model.body(body).mocapid[0])
        self._model.geom_size[self._geom, 0] = radius
        self._model.geom_rbound[self._geom] = radius
        self._model.geom_aabb[self._geom, 3:] = radius

    def __call__(self, q: Array, center: Array) -> bool:
        """Whether the arm at q (n,) rad touches the ball at a center (3,) m."""
        self._data.qpos[:] = self._arm.qpos(q)
        self._data.mocap_pos[self._mocap] = center
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_collision(self._model, self._data)
        return any(self._geom in contact.geom for contact in self._data.contact if acts(contact))
