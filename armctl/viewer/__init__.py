"""Live views: an arm that follows a target in real time, in the browser or in MuJoCo's own viewer."""

from armctl.viewer.native import view_natively
from armctl.viewer.page import view

__all__ = ["view", "view_natively"]
