"""ReachabilityPanel: a switch that shows the points that an arm reaches, coloured by the share of orientations there."""

from __future__ import annotations

from typing import TYPE_CHECKING

from armctl.core.latest_worker import LatestWorker
from armctl.ik.reachability import Reachability, reachability
from armctl.robot.arm import Arm

if TYPE_CHECKING:
    import viser

_POINT_SIZE_SPACINGS = 0.08
_EXPLANATION = "Computed once, with one thread. Contacts are not considered."
_LEGEND = "From dark blue (few of the orientations) to yellow (most of them)."


class ReachabilityPanel:
    """The map is computed in a thread of its own when it is first shown; the arm moves meanwhile."""

    def __init__(self, server: viser.ViserServer, arm: Arm, root: str):
        """Adds the switch to a server's page; the points go below the scene node `root`."""
        self._scene = server.scene
        self._arm = arm
        self._root = root
        self._worker = LatestWorker("armctl reachability")
        self._points: viser.PointCloudHandle | None = None
        with server.gui.add_folder("Reachability", expand_by_default=False):
            self._switch = server.gui.add_checkbox("reachable points", False)
            self._text = server.gui.add_markdown(_EXPLANATION)
        self._switch.on_update(self._switched)

    def close(self) -> None:
        self._worker.close()

    async def _switched(self, event: object) -> None:
        self._worker.submit(self._show)

    def _show(self) -> None:
        """Shows or hides the points, after computing them at the first time."""
        if self._points is None and self._switch.value:
            self._text.content = "computing ..."
            try:
                found = reachability(self._arm, threads=1)
            except Exception as error:
                self._text.content = f"not computed: {error}"[:300]
                raise
            if self._worker.is_closed:
                return
            self._points = self._add_points(found)
            self._text.content = f"{found}. {_LEGEND}" if len(found.orientations) else f"{found}."
        if self._points is not None:
            self._points.visible = self._switch.value

    def _add_points(self, found: Reachability) -> viser.PointCloudHandle:
        points, colours = found.cloud()
        size = _POINT_SIZE_SPACINGS * found.spacing
        return self._scene.add_point_cloud(f"{self._root}/reachable", points, colours, point_size=size, point_shape="circle")
