"""Panels whose work takes long: one motion under every controller with the payload, and the points that an arm reaches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from armctl.control import CONTROLLERS
from armctl.core.latest_worker import LatestWorker
from armctl.core.tables import Table
from armctl.lab.comparison import WITH_ENCODER, compare, out_and_back
from armctl.model.arm.arm import Arm
from armctl.model.loading.build import arm_to
from armctl.plan.ik.reachability import reachability
from armctl.report.plot import overlay_image
from armctl.report.report import Report, report_columns
from armctl.view.realtime.session import RealTimeSession

if TYPE_CHECKING:
    import viser


_POINT_SIZE_SPACINGS = 0.08
_EXPLANATION = "Computed once, with one thread. Contacts are not considered."
_COLUMNS = ("controller", "tip RMS", "final tip error", "peak torque", "chatter")
_LEGEND = "From dark blue (few of the orientations) to yellow (most of them)."


class ComparisonPanel:
    def __init__(self, server: viser.ViserServer, session: RealTimeSession):
        """Adds the button to a server's page; the session pauses while a comparison runs."""
        self._gui = server.gui
        self._session = session
        self._worker = LatestWorker("armctl comparison")
        with server.gui.add_folder("Comparison", expand_by_default=False) as self._folder:
            self._button = server.gui.add_button("compare the controllers")
            self._text = server.gui.add_markdown(
                "All joints out and back at full speed, under every controller at its default gains, with this payload and "
                f"an encoder noise of {WITH_ENCODER.encoder_noise:g} rad. The smallest error is first."
            )
        self._picture: viser.GuiImageHandle | None = None
        self._button.on_click(self._clicked)

    def close(self) -> None:
        self._worker.close()

    async def _clicked(self, event: object) -> None:
        self._button.disabled = True
        self._worker.submit(self._compare)

    def _compare(self) -> None:
        session = self._session
        status = session.status
        session.pause(True)
        try:
            self._text.content = "comparing ..."
            plant = replace(WITH_ENCODER, payload=status.payload)
            reports = compare(session.arm, list(CONTROLLERS), out_and_back(session.arm), [plant], configurations=0)
            if self._worker.is_closed:
                return
            self._text.content = _table(reports)
            if self._picture is not None:
                self._picture.remove()
            with self._folder:
                self._picture = self._gui.add_image(overlay_image([report.log for report in reports]))
        except Exception as error:
            self._text.content = f"the comparison failed: {error}"[:300]
            raise
        finally:
            session.pause(status.paused)
            if not self._worker.is_closed:
                self._button.disabled = False


def _table(reports: Sequence[Report]) -> str:
    """The columns of a comparison that fit into the panel, the smallest error first."""
    ordered = sorted(reports, key=lambda report: report.tip_rms_m)
    columns = [column for column in report_columns(reports) if column.title.startswith(_COLUMNS)]
    return Table([column.title for column in columns], [[column.cell(r) for column in columns] for r in ordered]).markdown()


class ReachabilityPanel:
    """The map is computed in a thread of its own when it is first shown; the arm moves meanwhile."""

    def __init__(self, server: viser.ViserServer, arm: Arm, root: str, tip: str):
        """Adds the switch of a tip's map, which is drawn below the scene node `root`."""
        self._scene = server.scene
        self._arm = arm
        self._tip = tip
        self._name = f"{root}/reachable {arm.tips.index(tip)}"
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
                arm = arm_to(self._arm, self._tip) if self._arm.further_tips else self._arm
                found = reachability(arm, threads=1)
            except Exception as error:
                self._text.content = f"not computed: {error}"[:300]
                raise
            if self._worker.is_closed:
                return
            points, colours = found.cloud()
            size = _POINT_SIZE_SPACINGS * found.spacing
            self._points = self._scene.add_point_cloud(self._name, points, colours, point_size=size, point_shape="circle")
            self._text.content = f"{found}. {_LEGEND}" if len(found.orientations) else f"{found}."
        if self._points is not None:
            self._points.visible = self._switch.value
