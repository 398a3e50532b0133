"""Seeing: offscreen pictures and films of runs."""

from armctl.view.film import film_path, record, still
from armctl.view.renderer import Renderer

__all__ = ["Renderer", "film_path", "record", "still"]
