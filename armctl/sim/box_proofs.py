"""BoxProofs: the proofs of one simulation that nothing touches, prepared when they pay."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco

from armctl.collision.free_boxes import FreeBoxes

if TYPE_CHECKING:
    from armctl.sim.box_proof import BoxProof


class BoxProofs:
    """Proofs for the models of one simulation, whatever its plant is."""

    def __init__(self, boxes: FreeBoxes):
        """Prepares nothing yet.

        Args:
            boxes: The scene of the arm.
        """
        self._boxes = boxes
        self._last: BoxProof | None = None

    def of(self, model: mujoco.MjModel, steps: int) -> BoxProof | None:
        """The proofs for a run.

        Args:
            model: The model.
            steps: How many steps, or checks for contacts, it makes.

        Returns:
            The proofs; None if they are impossible, or do not pay yet.
        """
        scene = self._boxes.scene(model, steps)
        if scene is None:
            return None
        if self._last is None or self._last.scene is not scene:
            from armctl.sim.box_proof import BoxProof  # loads the collision kernels

            self._last = BoxProof(scene)
        return self._last
