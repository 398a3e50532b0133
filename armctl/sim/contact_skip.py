"""ContactSkip: steps of a simulation without collision detection, where it is proved that nothing can touch.

MuJoCo spends more than half of a step of an arm on collision detection, though nothing touches. `armctl.collision` proves how
far all joints may move before any pair of geoms can meet. While they stay within this box, MuJoCo's contacts are disabled: it
would find none, so the results are the same bits.

Import this only in a function that needs it, because numba takes long to load.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from armctl.sim import tick_kernel as kernel
from armctl.sim.box_proofs import BoxProofs
from armctl.sim.mujoco_library import disable_flags_offset

if TYPE_CHECKING:
    from armctl.sim.box_proof import BoxProof


class ContactSkip:
    """Skips collision detection in one simulation."""

    def __init__(self, proofs: BoxProofs, model: mujoco.MjModel, data: mujoco.MjData):
        """Skips nothing yet.

        Args:
            proofs: What proves that nothing touches.
            model: The model; its option that disables contacts changes during a run.
            data: The state.
        """
        self._proofs = proofs
        self._model = model
        self._data = data
        self._proof: BoxProof | None = None
        self._table = np.zeros(kernel.SKIP_SIZE, np.int64)
        self._kept: tuple[object, ...] = ()  # what the table points to

    @property
    def skipped(self) -> int:
        """Steps without collision detection so far."""
        return int(self._table[kernel.SKIP_SKIPPED])

    def start(self, steps: int) -> int:
        """The address of the table for `tick_kernel`, 0 for none. Each step with it sets the flags of the model.

        Args:
            steps: As many as will be made.
        """
        proof = self._proofs.of(self._model, steps)
        if proof is None:
            return 0
        if proof is not self._proof:
            self._set_proof(proof)
        self._table[kernel.SKIP_NORMAL] = self._model.opt.disableflags
        return int(self._table.ctypes.data)

    @contextmanager
    def table(self, steps: int) -> Iterator[int]:
        """The address of the table for `tick_kernel`, 0 for none, during a run. Afterwards the model is as before.

        Args:
            steps: Of the run.
        """
        flags = int(self._model.opt.disableflags)
        try:
            yield self.start(steps)
        finally:
            self._model.opt.disableflags = flags

    def _set_proof(self, proof: BoxProof) -> None:
        joints = len(proof.positions)
        indices = np.array([proof.scene.qpos_adr, proof.scene.dof_adr])
        box = np.array([np.full(joints, np.inf), np.full(joints, -np.inf)])
        table = self._table
        table[:] = 0
        table[kernel.SKIP_FLAGS] = self._model._address + disable_flags_offset()
        table[kernel.SKIP_QPOS] = self._data.qpos.ctypes.data
        table[kernel.SKIP_QVEL] = self._data.qvel.ctypes.data
        table[kernel.SKIP_INDICES] = indices.ctypes.data
        table[kernel.SKIP_BOX] = box.ctypes.data
        table[kernel.SKIP_POSITIONS] = proof.positions.ctypes.data
        table[kernel.SKIP_DELTA] = proof.delta.ctypes.data
        table[kernel.SKIP_PROOF] = proof.function
        table[kernel.SKIP_PROOF_TABLE] = proof.argument
        table[kernel.SKIP_JOINTS] = joints
        table[kernel.SKIP_NQ] = self._model.nq
        table[kernel.SKIP_NV] = self._model.nv
        self._proof = proof
        self._kept = (indices, box)
