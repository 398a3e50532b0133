"""Screen: pictures of an environment, or the viewer's page."""

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from armctl.core import hooks
from armctl.core.validation import Array, choice
from armctl.envs.batch import Batch
from armctl.model.mjmodel.target_marker import set_target
from armctl.report.render.camera import fitted_camera
from armctl.report.render.depth_camera import Camera, CameraImage, Eyes, camera_names, placed
from armctl.report.render.renderer import Image, Renderer, check_size
from armctl.report.render.stick_figure import needed_stick_figure

RENDER_MODES = ("rgb_array", "human")


class SceneState(NamedTuple):
    qpos: Array  # (nq,) positions
    mocap_pos: Array  # (nmocap, 3) m, of the marker of the goal and of the obstacle


class Screen:
    """Shows the first row of a batch, and the goal as the target marker."""

    def __init__(self, batch: Batch, mode: str, width: int, height: int, cameras: Sequence[str | Camera] = ()):
        """A screen; pictures or the page are opened when they are first needed."""
        self.cameras = camera_names(cameras)
        self._batch = batch
        self._arm = batch.arm
        self._data = mujoco.MjData(self._arm.model)
        self._width, self._height = check_size((width, height))
        self._renderer: Renderer | None = None
        self._stick_figure = needed_stick_figure(self._arm)
        self._camera: mujoco.MjvCamera | None = None
        self._eyes = Eyes(self._arm.model)
        if self.cameras:
            mujoco.mj_forward(self._arm.model, self._data)
        for camera in self.cameras.values():
            placed(self._arm.model, self._data, camera)  # UnknownNameError now rather than at the first picture
        self._viewer = None
        if choice("render_mode", mode, RENDER_MODES) == "human" and hooks.open_viewer is not None:
            self._viewer = hooks.open_viewer(self._arm)

    @property
    def size(self) -> tuple[int, int]:
        return self._width, self._height

    def state(self) -> SceneState:
        self._place(self._batch.rows.q[0])
        return SceneState(self._data.qpos.copy(), self._data.mocap_pos.copy())

    def picture(self, state: SceneState | None = None) -> Image:
        """A state, or that of now, as a picture (height, width, 3)."""
        state = self.state() if state is None else state
        if self._renderer is None:
            self._renderer = Renderer(self._arm.model, (self._width, self._height))
        if self._camera is None:
            self._place(self._arm.home)
            self._camera = fitted_camera(self._arm, [self._data], self._batch.task.points, self._width / self._height)
        self._data.qpos[:] = state.qpos
        self._data.mocap_pos[:] = state.mocap_pos
        mujoco.mj_forward(self._arm.model, self._data)
        sticks = None if self._stick_figure is None else self._stick_figure.segments(self._data)
        return self._renderer.image(self._data, self._camera, sticks=sticks)

    def see(self, name: str, state: SceneState | None = None) -> CameraImage:
        """What one of the cameras sees in a state, or in that of now."""
        state = self.state() if state is None else state
        self._data.qpos[:] = state.qpos
        self._data.mocap_pos[:] = state.mocap_pos
        mujoco.mj_forward(self._arm.model, self._data)
        return self._eyes.look(self._data, self.cameras[name], self.size)

    def show(self) -> None:
        """Shows the state on the page, and waits until the wall clock reaches it."""
        assert self._viewer is not None
        self._place(self._batch.rows.q[0])
        if self._batch.steps[0] == 0:
            self._viewer.after_reset(self._data)
            return
        self._viewer.before_run()
        self._viewer.after_ticks(self._data, self._batch.step_time)

    def close(self) -> None:
        self._eyes.close()
        if self._renderer is not None:
            self._renderer.close()
        if self._viewer is not None:
            self._viewer.close()

    def _place(self, q: np.ndarray) -> None:
        """Puts the arm at q (n,), everything else where it is, and the marker at the goal (of the first tip)."""
        data = self._batch.rows.simulated.data(0)
        self._data.qpos[:] = data.qpos
        self._data.mocap_pos[:] = data.mocap_pos
        self._data.qpos[self._arm.joint_map.qpos_adr] = self._arm.joint_map.positions(q)
        set_target(self._arm.model, self._data, self._batch.goal[0, :3])
        mujoco.mj_forward(self._arm.model, self._data)
