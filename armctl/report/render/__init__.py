"""Offscreen pictures and films of runs."""

from armctl.report.render.renderer import Renderer
from armctl.report.render.video import film_path, record, still

__all__ = ["Renderer", "film_path", "record", "still"]
