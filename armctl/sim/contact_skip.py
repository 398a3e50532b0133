"""ContactSkip: steps of a simulation without collision detection, where it is proved that nothing can touch.

MuJoCo spends more than half of a step of an arm on collision detection, though nothing touches. `armctl.collision` proves how
far all joints may move before any pair of geoms can meet. While they stay within this box, MuJoCo's contacts are disabled: it
would find none, so the results are the same bits.

Import this only in a function that needs it, because numba takes long to load.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from armctl.collision import kernel as collision
from armctl.collision.free_box import FreeBoxScene
from armctl.collision.free_boxes import FreeBoxes
from armctl.sim import tick_kernel as kernel
from armctl.sim.mujoco_library import disable_flags_offset


class ContactSkip:
    """Skips collision detection in one simulation."""

    def __init__(self, boxes: FreeBoxes, model: mujoco.MjModel, data: mujoco.MjData):
        """Skips nothing yet.

        Args:
            boxes: The scene of the arm.
            model: The model; its option that disables contacts changes during a run.
            data: The state.
        """
        self._boxes = boxes
        self._model = model
        self._data = data
        self._scene: FreeBoxScene | None = None
        self._table = np.zeros(kernel.SKIP_SIZE, np.int64)
        self._arrays: tuple[NDArray[Any], ...] = ()  # that the table points to

    @property
    def skipped(self) -> int:
        """Steps without collision detection so far."""
        return int(self._table[kernel.SKIP_SKIPPED])

    @contextmanager
    def table(self, steps: int) -> Iterator[int]:
        """The address of the table for `tick_kernel`, 0 for none, during a run. Afterwards the model is as before.

        Args:
            steps: Of the run.
        """
        scene = self._boxes.scene(self._model, steps)
        if scene is None:
            yield 0
            return
        if scene is not self._scene:
            self._set_scene(scene)
        flags = int(self._model.opt.disableflags)
        self._table[kernel.SKIP_NORMAL] = flags
        try:
            yield self._table.ctypes.data
        finally:
            self._model.opt.disableflags = flags

    def _set_scene(self, scene: FreeBoxScene) -> None:
        from armctl.sim import skip_kernel  # loads the collision kernels

        m = len(scene.qpos_adr)
        geometry = scene.geometry
        indices = np.array([scene.qpos_adr, scene.dof_adr])
        box = np.array([np.full(m, np.inf), np.full(m, -np.inf)])
        positions = np.zeros(m)
        delta = np.zeros(m)
        pairs = geometry.pairs.copy()
        frames = np.zeros((len(geometry.tree) + 1, skip_kernel.FRAME_COLUMNS))
        spheres = np.zeros((len(geometry.geoms), collision.MOTION + geometry.depth))
        work = np.zeros((collision.WORK_ROWS, 3))
        work[collision.LAST_HIT, 0] = -1.0
        proof = np.zeros(skip_kernel.TABLE_SIZE, np.int64)
        arrays = {
            skip_kernel.POSITIONS: positions,
            skip_kernel.DELTA: delta,
            skip_kernel.CLEARANCES: scene.clearances,
            skip_kernel.GROUP_CLEARANCES: scene.group_clearances,
            skip_kernel.GEOM_ROWS: geometry.geoms,
            skip_kernel.POINT_ROWS: geometry.points,
            skip_kernel.NEIGHBORS: geometry.neighbors,
            skip_kernel.PAIR_ROWS: pairs,
            skip_kernel.GROUP_ROWS: geometry.groups,
            skip_kernel.TREE: geometry.tree,
            skip_kernel.FRAMES: frames,
            skip_kernel.SPHERES: spheres,
            skip_kernel.WORK: work,
        }
        for entry, array in arrays.items():
            proof[entry] = array.ctypes.data
        proof[skip_kernel.GEOMS] = len(geometry.geoms)
        proof[skip_kernel.POINTS_COUNT] = len(geometry.points)
        proof[skip_kernel.NEIGHBORS_COUNT] = len(geometry.neighbors)
        proof[skip_kernel.PAIRS_COUNT] = len(pairs)
        proof[skip_kernel.GROUPS_COUNT] = len(geometry.groups)
        proof[skip_kernel.JOINTS] = m
        proof[skip_kernel.SPHERE_COLUMNS] = spheres.shape[1]
        table = self._table
        table[:] = 0
        table[kernel.SKIP_FLAGS] = self._model._address + disable_flags_offset()
        table[kernel.SKIP_QPOS] = self._data.qpos.ctypes.data
        table[kernel.SKIP_QVEL] = self._data.qvel.ctypes.data
        table[kernel.SKIP_INDICES] = indices.ctypes.data
        table[kernel.SKIP_BOX] = box.ctypes.data
        table[kernel.SKIP_POSITIONS] = positions.ctypes.data
        table[kernel.SKIP_DELTA] = delta.ctypes.data
        table[kernel.SKIP_PROOF] = skip_kernel.PROVE_BOX
        table[kernel.SKIP_PROOF_TABLE] = proof.ctypes.data
        table[kernel.SKIP_JOINTS] = m
        table[kernel.SKIP_NQ] = self._model.nq
        table[kernel.SKIP_NV] = self._model.nv
        self._scene = scene
        self._arrays = (indices, box, proof, *arrays.values())
