"""Contacts: what the arm touches at a position, by MuJoCo's own collision detection."""

from __future__ import annotations

import mujoco
import numpy as np

from armctl.arm import Arm
from armctl.arrays import Array
from armctl.elements import body_name, name_of
from armctl.rigid_body import joint_above


class Contacts:
    """Collision detection of an arm with itself and with its scene; all else is at home.

    Attributes:
        arm: The arm.
    """

    def __init__(self, arm: Arm):
        """Collision detection for an arm.

        Args:
            arm: The arm.
        """
        self.arm = arm
        self._data = mujoco.MjData(arm.model)
        joints = tuple(int(j) for j in arm.model.dof_jntid[arm.dof_adr])
        self._above = np.array(joint_above(arm.model, joints))[arm.model.geom_bodyid]

    def at(self, q: Array, margin: float = 0.0) -> tuple[str, str] | None:
        """The deepest contact of two parts that the arm moves against each other.

        Args:
            q: (n,) rad.
            margin: m that parts must be apart; contacts are seen as far as the model's own contact margins reach.

        Returns:
            The names of the two bodies (of a geom where it is part of the scene), or None where nothing touches.
        """
        model, data = self.arm.model, self._data
        data.qpos[:] = self.arm.qpos(q)
        mujoco.mj_fwdPosition(model, data)
        if not data.ncon:
            return None
        distance, geoms = data.contact.dist, data.contact.geom
        moved = self._above[geoms[:, 0]] != self._above[geoms[:, 1]]
        near = np.flatnonzero(moved & (distance < margin))
        if not len(near):
            return None
        first, second = geoms[near[distance[near].argmin()]].tolist()
        return self._name(first), self._name(second)

    def _name(self, geom: int) -> str:
        """The body of a geom; for a part of the scene, the geom itself."""
        body = int(self.arm.model.geom_bodyid[geom])
        if body == 0:
            return name_of(self.arm.model, mujoco.mjtObj.mjOBJ_GEOM, geom)
        return body_name(self.arm.model, body)

    def along(self, path: Array) -> tuple[str, str] | None:
        """The first contact along a path.

        Args:
            path: (T, n) rad.

        Returns:
            The names of the two bodies (of a geom where it is part of the scene), or None where nothing touches.
        """
        return next((pair for pair in map(self.at, path) if pair is not None), None)
