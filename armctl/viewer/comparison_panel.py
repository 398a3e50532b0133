"""ComparisonPanel: the same motion under every controller with the payload of the moment, at the push of a button."""

from __future__ import annotations

from typing import TYPE_CHECKING

from armctl.analysis.comparison import compare, out_and_back
from armctl.analysis.plot import overlay_image
from armctl.analysis.report import Report
from armctl.control import CONTROLLERS
from armctl.sim.plant import Plant
from armctl.sim.realtime import RealTimeSession

if TYPE_CHECKING:
    import viser


class ComparisonPanel:
    """A button, and below it what came out."""

    def __init__(self, server: viser.ViserServer, session: RealTimeSession):
        """Adds the button to the page.

        Args:
            server: The page's server.
            session: Whose arm and payload are taken; it stands still meanwhile.
        """
        self._gui, self._session = server.gui, session
        with server.gui.add_folder("Comparison", expand_by_default=False) as self._folder:
            self._button = server.gui.add_button("compare the controllers")
            self._words = server.gui.add_markdown(
                "All joints out and back at full speed, under every controller, with this payload."
            )
        self._picture: viser.GuiImageHandle | None = None
        self._button.on_click(lambda event: self._run())

    def _run(self) -> None:
        session, paused = self._session, self._session.paused
        self._button.disabled = True
        session.pause(True)
        try:
            self._words.content = "comparing ..."
            plant = Plant(payload=session.payload)
            reports = compare(session.arm, list(CONTROLLERS), out_and_back(session.arm), [plant])
            self._words.content = _table(reports)
            if self._picture is not None:
                self._picture.remove()
            with self._folder:
                self._picture = self._gui.add_image(overlay_image([report.log for report in reports]))
        finally:
            session.pause(paused)
            self._button.disabled = False


def _table(reports: list[Report]) -> str:
    """The figures that fit beside the scene, as Markdown."""
    rows = [
        f"| {r.controller} | {1e3 * r.tip_rms_m:.3g} | {1e3 * r.final_tip_error_m:.3g} | {100 * r.peak_torque_ratio:.0f} |"
        for r in reports
    ]
    return "\n".join(["| | tip RMS, mm | at the end, mm | peak torque, % |", "| - | - | - | - |", *rows])
