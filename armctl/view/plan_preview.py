"""PlanPreview: a planned path of the tips, and the arm at its end as a ghost. RobotDrawing: a robot and its ghost."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.view.mesh_decimation import decimated
from armctl.view.realtime.target_follower import PATH_POINTS, PlannedPath
from armctl.view.web_scene import WebScene

if TYPE_CHECKING:
    import trimesh
    import viser

_PATH_RGB = (0, 90, 200)
_PATH_THICKNESS_PX = 4.0
_GHOST_RGB = (0, 90, 200)
_GHOST_OPACITY = 0.35
_GHOST_INTERVAL_S = 0.05
_GHOST_CELL = 4e-3  # of the model's extent: a ghost is seen through, so it needs less detail


class Ghost:
    """The arm as a transparent ghost, made when it is shown first."""

    def __init__(self, server: viser.ViserServer, arm: Arm, root: str):
        """An invisible ghost in a server's scene, below the scene node `root`."""
        self._server = server
        self._arm = arm
        self._root = root
        self._data = mujoco.MjData(arm.model)
        self._meshes: dict[int, viser.MeshHandle] = {}

    def show(self, q: Array | None) -> None:
        """Shows it at q, (n,) rad; None hides it."""
        if q is not None:
            self._data.qpos[:] = self._arm.qpos(q)
            mujoco.mj_kinematics(self._arm.model, self._data)
            if not self._meshes:
                self._meshes = {body: self._add_body(body, mesh) for body, mesh in _moving_bodies(self._arm).items()}
        for body, mesh in self._meshes.items():
            mesh.visible = q is not None
            if q is not None:
                mesh.position = self._data.xpos[body]
                mesh.wxyz = self._data.xquat[body]

    def _add_body(self, body: int, mesh: trimesh.Trimesh) -> viser.MeshHandle:
        return self._server.scene.add_mesh_simple(
            f"{self._root}/ghost/{body}", mesh.vertices, mesh.faces, color=_GHOST_RGB, opacity=_GHOST_OPACITY, cast_shadow=False
        )


class RobotDrawing:
    """A robot in a scene: as it measures itself, and as a ghost where it was commanded to be."""

    def __init__(self, scene: WebScene, arm: Arm, name: str):
        self._scene = scene
        self._arm = arm
        self._name = name
        self._ghost_shown_at = -np.inf
        self._ghost = Ghost(scene.server, arm, "/commanded")
        self._ghost.show(arm.home)  # makes it now: a robot that moves would brake meanwhile
        self._ghost.show(None)

    def show(self, q: Array, q_told: Array | None, state: str) -> None:
        """Draws it with joints q (n,) rad; with None as the command, there is no ghost. Waits for nothing."""
        if self._scene.is_closed:
            return
        self._scene.show(self._arm.qpos(q))
        if q_told is None or time.monotonic() - self._ghost_shown_at > _GHOST_INTERVAL_S:
            self._ghost_shown_at = time.monotonic()
            self._ghost.show(q_told)
            text = f"**{self._name}**\n\n{state}"
            if self._scene.text.content != text:
                self._scene.text.content = text


class PlanPreview:
    def __init__(self, server: viser.ViserServer, arm: Arm, root: str):
        self._server = server
        self._path: PlannedPath | None = None
        self._ghost = Ghost(server, arm, root)
        self._has_ghost = False
        segments = np.zeros((len(arm.tips) * (PATH_POINTS - 1), 2, 3), np.float32)
        self._line = server.scene.add_line_segments(
            f"{root}/plan", segments, _PATH_RGB, thickness=_PATH_THICKNESS_PX, thickness_units="screen", visible=False
        )

    def show(self, path: PlannedPath | None, *, with_ghost: bool) -> None:
        has_ghost = path is not None and with_ghost
        if path is self._path and has_ghost == self._has_ghost:
            return
        with self._server.atomic():
            if path is not None and path is not self._path:
                ends = np.stack([path.tips[:, :-1], path.tips[:, 1:]], axis=2)
                self._line.points = ends.reshape(-1, 2, 3).astype(np.float32)
            self._line.visible = path is not None
            self._ghost.show(path.q_end if path is not None and with_ghost else None)
        self._path = path
        self._has_ghost = has_ghost


def _moving_bodies(arm: Arm) -> dict[int, trimesh.Trimesh]:
    """The visible shape of each body that the arm moves."""
    from mjviser.conversions import merge_geoms

    model = decimated(arm.model, _GHOST_CELL)
    visible = model.geom_rgba[:, 3] > 0
    moving = set(arm.moved_bodies)
    for body in range(min(moving) + 1, model.nbody):
        if int(model.body_parentid[body]) in moving:
            moving.add(body)
    geoms = {body: np.flatnonzero(visible & (model.geom_bodyid == body)).tolist() for body in sorted(moving)}
    return {body: merge_geoms(model, members) for body, members in geoms.items() if members}
