"""Live views: an arm that follows a target in real time, in the browser or in MuJoCo's own viewer."""

from armctl.viewer.native import view_natively
from armctl.viewer.page import view
from armctl.viewer.robot_page import view_robot

__all__ = ["view", "view_natively", "view_robot"]
