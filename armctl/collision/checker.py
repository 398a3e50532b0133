"""What an arm touches at a position, by MuJoCo's own collision detection."""

from __future__ import annotations

import threading
from dataclasses import replace
from weakref import WeakKeyDictionary

import mujoco
import numpy as np

from armctl.core.validation import Array, IntArray
from armctl.mjmodel.queries import body_name, last_joint_above, name_of
from armctl.robot.arm import Arm

SAMPLES = 64


class _Memory(threading.local):
    """MuJoCo's memory, one for each thread that asks."""

    def __init__(self, model: mujoco.MjModel):
        self.data = mujoco.MjData(model)


class CollisionChecker:
    """CollisionChecker of an arm with itself and with the scene, everything outside its chain at home.

    Left out are contacts that no motion of the arm changes, pairs that touch in every one of many random positions, and
    neighbouring links that touch at home: their geoms overlap by design.
    """

    def __init__(self, arm: Arm):
        """Learns which pairs always touch.

        Args:
            arm: The arm.
        """
        self._arm = replace(arm)  # a copy: what is remembered by an arm must not keep it alive
        self._memory = _Memory(arm.model)
        self.owner = geom_owners(arm)
        self.ignored = np.empty(0, np.int64)
        at_home = self._pairs(arm.home)
        always = at_home
        for q in arm.limits.random(arm.home, SAMPLES, np.random.default_rng(0)):
            always = np.intersect1d(always, self._pairs(q))
        first, second = (self.owner[geoms] for geoms in divmod(at_home, arm.model.ngeom))
        self.ignored = np.union1d(always, at_home[np.abs(first - second) == 1])

    def at(self, q: Array) -> str:
        """What touches what at a position.

        Args:
            q: (n,) rad.

        Returns:
            Such as "link7 touches floor", or nothing where nothing touches.
        """
        touching = self._pairs(q)
        if not len(touching):
            return ""
        return " touches ".join(self._name(geom) for geom in divmod(int(touching[0]), self._arm.model.ngeom))

    def along(self, path: Array) -> str:
        """The first contact along a path.

        Args:
            path: (T, n) rad.

        Returns:
            As for `at`.
        """
        return next(filter(None, map(self.at, path)), "")

    def _name(self, geom: int) -> str:
        """The body a geom is on; in the world, the geom itself."""
        body = int(self._arm.model.geom_bodyid[geom])
        return body_name(self._arm.model, body) if body else name_of(self._arm.model, mujoco.mjtObj.mjOBJ_GEOM, geom)

    def _pairs(self, q: Array) -> IntArray:
        """The geoms of each contact that counts, the lesser first, as one number."""
        model, data = self._arm.model, self._memory.data
        data.qpos[:] = self._arm.qpos(q)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        geoms = np.sort(data.contact.geom.astype(np.int64), axis=1)
        geoms = geoms[(geoms[:, 0] >= 0) & (self.owner[geoms[:, 0]] != self.owner[geoms[:, 1]])]
        return np.setdiff1d(geoms[:, 0] * model.ngeom + geoms[:, 1], self.ignored)


def geom_owners(arm: Arm) -> IntArray:
    """Which joint of the chain moves each geom.

    Args:
        arm: The arm.

    Returns:
        (ngeom,) the last joint above it, counted from the base; -1 where none is.
    """
    return np.array(last_joint_above(arm.model, arm.joint_map.joints), np.int64)[arm.model.geom_bodyid]


_contacts: WeakKeyDictionary[Arm, CollisionChecker] = WeakKeyDictionary()


def collision_checker(arm: Arm) -> CollisionChecker:
    """The contacts of an arm, learned once.

    Args:
        arm: The arm.

    Returns:
        Its contacts.
    """
    contacts = _contacts.get(arm)
    if contacts is None:
        contacts = _contacts[arm] = CollisionChecker(arm)
    return contacts
