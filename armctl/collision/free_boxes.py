"""The scene of each arm for proofs that nothing touches in a box of joint positions, made when its runs have become long."""

from __future__ import annotations

from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import mujoco

from armctl.robot.arm import Arm

if TYPE_CHECKING:
    from armctl.collision.free_box import FreeBoxScene

# To prepare a scene takes as long as collision detection in so many steps.
_MIN_STEPS = 10_000


class FreeBoxes:
    """The scene of the models of one arm; it contains no reference to the arm."""

    def __init__(self) -> None:
        self._steps = 0
        self._last: tuple[tuple[bytes, ...], FreeBoxScene | None] | None = None

    def scene(self, model: mujoco.MjModel, steps: int) -> FreeBoxScene | None:
        """The scene for a run.

        Args:
            model: A model of the arm.
            steps: Of the run.

        Returns:
            The scene; None if proofs are impossible, or do not pay yet.
        """
        self._steps += steps
        is_runge_kutta = model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4)  # it looks for contacts within a step
        if self._steps < _MIN_STEPS or is_runge_kutta:
            return None
        from armctl.collision.free_box import free_box_scene, geometry_key  # loads numba

        key = geometry_key(model)
        last = self._last
        if last is None or last[0] != key:
            last = (key, free_box_scene(model))
            self._last = last
        return last[1]


_free_boxes: WeakKeyDictionary[Arm, FreeBoxes] = WeakKeyDictionary()


def free_boxes(arm: Arm) -> FreeBoxes:
    """The scene of an arm's models, made once for each arm."""
    return _free_boxes.setdefault(arm, FreeBoxes())
