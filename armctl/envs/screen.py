"""Screen: pictures of an environment, or the viewer's page."""

from __future__ import annotations

import mujoco
import numpy as np

from armctl.core.validation import choice
from armctl.envs.batch import Batch
from armctl.mjmodel.target_marker import set_target
from armctl.render.camera import fitted_camera
from armctl.render.renderer import Image, Renderer

RENDER_MODES = ("rgb_array", "human")
_WIDTH = 640
_HEIGHT = 480


class Screen:
    """Shows the first row of a batch, and the goal as the target marker."""

    def __init__(self, batch: Batch, mode: str):
        """A screen; pictures or the page are opened when they are first needed.

        Args:
            batch: The batch.
            mode: "rgb_array" or "human".

        Raises:
            InputError: There is no such mode.
            NotInstalledError: The page needs a package that is missing.
        """
        self._batch = batch
        self._arm = batch.arm
        self._data = mujoco.MjData(self._arm.model)
        self._renderer: Renderer | None = None
        self._camera: mujoco.MjvCamera | None = None
        self._viewer = None
        if choice("render_mode", mode, RENDER_MODES) == "human":
            from armctl.viewer.viewer import Viewer

            self._viewer = Viewer(self._arm)

    def picture(self) -> Image:
        """The state now, (480, 640, 3)."""
        if self._renderer is None:
            self._renderer = Renderer(self._arm.model, _WIDTH, _HEIGHT)
        if self._camera is None:
            self._place(self._arm.home)
            self._camera = fitted_camera(self._arm, [self._data], self._batch.task.points, _WIDTH / _HEIGHT)
        self._place(self._batch.rows.q[0])
        return self._renderer.image(self._data, self._camera)

    def show(self) -> None:
        """Shows the state on the page, and waits until the wall clock reaches it."""
        assert self._viewer is not None
        self._place(self._batch.rows.q[0])
        seconds = self._batch.rows.ticks * self._arm.dt
        if self._batch.steps[0] == 0:
            self._viewer.after_reset(self._data)
            return
        self._viewer.before_run()
        self._viewer.after_ticks(self._data, seconds)

    def close(self) -> None:
        """Closes the renderer and the page."""
        if self._renderer is not None:
            self._renderer.close()
        if self._viewer is not None:
            self._viewer.close()

    def _place(self, q: np.ndarray) -> None:
        """Puts the arm at q (n,), everything else where it is, and the marker at the goal."""
        simulated = self._batch.rows.simulated
        if simulated is not None:
            self._data.qpos[:] = simulated.data(0).qpos
            self._data.mocap_pos[:] = simulated.data(0).mocap_pos
            self._data.qpos[self._arm.joint_map.qpos_adr] = self._arm.joint_map.positions(q)
        else:
            self._data.qpos[:] = self._arm.qpos(q)
        set_target(self._arm.model, self._data, self._batch.goal[0])
        mujoco.mj_forward(self._arm.model, self._data)
