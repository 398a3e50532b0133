"""Offscreen pictures and films of runs."""

from armctl.render.renderer import Renderer
from armctl.render.video import film_path, record, still

__all__ = ["Renderer", "film_path", "record", "still"]
