"""Live: an arm that follows a target in real time, in the browser or in MuJoCo's own viewer."""

from armctl.live.native import view_natively
from armctl.live.page import view

__all__ = ["view", "view_natively"]
