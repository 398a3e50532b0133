"""The world of a simulation or a robot, which knows where the tips are and what the model has."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
from numpy.typing import ArrayLike

from armctl.core.errors import InputError, UnknownNameError
from armctl.core.pose import Pose
from armctl.core.shapes import Shape
from armctl.model.arm.arm import Arm
from armctl.model.collision.world import World, checked_name
from armctl.model.collision.world_snapshot import WorldBody, is_of_model
from armctl.model.mjmodel.queries import is_below, object_id, robot_roots

_UNMOVED = Pose([0.0, 0.0, 0.0])


class ArmWorld(World):
    """A World around an arm: `attach` and `detach` know where the body is, and loose bodies of the model can be attached."""

    def __init__(self, arm: Arm, tip_pose: Callable[[str], Pose]):
        """An empty world around an arm; `tip_pose(tip)` is T_world_tip now."""
        super().__init__()
        self._arm = arm
        self._tip_pose = tip_pose

    def add(self, name: str, shape: Shape, at: Pose | ArrayLike | None = None, mass: float | None = None) -> World:
        """As `World.add`; InputError for the name of a body of the arm's model, too."""
        if is_of_model(self._arm, checked_name(name)):
            raise InputError(
                f"name: the arm's model has a body {name:.60} already, which is where the model has it; choose another name"
            )
        return super().add(name, shape, at, mass)

    def _body_to_attach(self, name: str) -> WorldBody:
        if name in self._bodies or not is_of_model(self._arm, checked_name(name)):
            return self._body(name)
        body = object_id(self._arm.model, mujoco.mjtObj.mjOBJ_BODY, name)
        roots = robot_roots(self._arm.model, self._arm.joint_map.joints)
        if any(is_below(self._arm.model, body, root) for root in roots):
            raise InputError(f"name: {name:.60} is a part of the robot; only what is around it can be attached")
        return WorldBody(name=name, shape=None, pose=_UNMOVED)

    def _tip_named(self, tip: str) -> str:
        name = tip or self._arm.tip
        if name not in self._arm.tips:
            raise UnknownNameError.from_known("tip", name, list(self._arm.tips))
        return name

    def _pose_at_tip(self, body: WorldBody, at: Pose | ArrayLike | None, tip: str) -> Pose:
        name = self._tip_named(tip)
        if body.shape is None:
            if at is not None:
                raise InputError(f"at: {body.name:.60} is a body of the model, which is carried from where it is; leave it out")
            return _UNMOVED
        if at is not None:
            return super()._pose_at_tip(body, at, tip)
        T_world_body = body.pose if body.tip is None else self._tip_pose(body.tip) @ body.pose
        return self._tip_pose(name).inverse() @ T_world_body

    def _pose_in_world(self, body: WorldBody, at: Pose | ArrayLike | None) -> Pose:
        if at is not None or body.tip is None:
            return super()._pose_in_world(body, at)
        return self._tip_pose(body.tip) @ body.pose
