"""BoxProof: proves that nothing touches in a box of joint positions.

Import this only in a function that needs it, because it loads the collision kernels.
"""

from __future__ import annotations

import numpy as np

from armctl.collision import kernel as collision
from armctl.collision.free_box import FreeBoxScene
from armctl.core.validation import Array, BoolArray
from armctl.sim import skip_kernel


class BoxProof:
    """Proofs for one scene in one thread.

    Attributes:
        scene: The scene.
        positions: (m,) the center of a box.
        delta: (m,) its half width, which a proof reduces.
        function: The address of a C function that proves this box and returns 0 if it cannot.
        argument: Its argument.
    """

    def __init__(self, scene: FreeBoxScene):
        """Allocates the memory of the proofs.

        Args:
            scene: The scene.
        """
        geometry = scene.geometry
        joints = len(scene.qpos_adr)
        self.scene = scene
        self.positions = np.zeros(joints)
        self.delta = np.zeros(joints)
        pairs = geometry.pairs.copy()
        spheres = np.zeros((len(geometry.geoms), collision.MOTION + geometry.depth))
        work = np.zeros((collision.WORK_ROWS, 3))
        work[collision.LAST_HIT, 0] = -1.0
        self._arrays = {
            skip_kernel.POSITIONS: self.positions,
            skip_kernel.DELTA: self.delta,
            skip_kernel.CLEARANCES: scene.clearances,
            skip_kernel.GROUP_CLEARANCES: scene.group_clearances,
            skip_kernel.GEOM_ROWS: geometry.geoms,
            skip_kernel.POINT_ROWS: geometry.points,
            skip_kernel.NEIGHBORS: geometry.neighbors,
            skip_kernel.PAIR_ROWS: pairs,
            skip_kernel.GROUP_ROWS: geometry.groups,
            skip_kernel.TREE: geometry.tree,
            skip_kernel.FRAMES: np.zeros((joints + 1, skip_kernel.FRAME_COLUMNS)),
            skip_kernel.SPHERES: spheres,
            skip_kernel.WORK: work,
        }
        self._table = np.zeros(skip_kernel.TABLE_SIZE, np.int64)
        for entry, array in self._arrays.items():
            self._table[entry] = array.ctypes.data
        self._table[skip_kernel.JOINTS] = joints
        self._table[skip_kernel.GEOMS] = len(geometry.geoms)
        self._table[skip_kernel.POINTS_COUNT] = len(geometry.points)
        self._table[skip_kernel.NEIGHBORS_COUNT] = len(geometry.neighbors)
        self._table[skip_kernel.PAIRS_COUNT] = len(pairs)
        self._table[skip_kernel.GROUPS_COUNT] = len(geometry.groups)
        self._table[skip_kernel.SPHERE_COLUMNS] = spheres.shape[1]
        self.function = skip_kernel.PROVE_BOX
        self.argument = int(self._table.ctypes.data)

    def free_rows(self, qpos: Array) -> BoolArray:
        """At which rows of a motion it is proved that nothing touches.

        Args:
            qpos: (T, nq) the whole model's positions.

        Returns:
            (T,).
        """
        is_free = np.zeros(len(qpos), bool)
        rows = np.ascontiguousarray(qpos[:, self.scene.qpos_adr])
        skip_kernel.mark_free_rows(self.function, self.argument, rows, self.positions, self.delta, is_free)
        return is_free
