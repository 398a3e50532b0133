"""Live views: an arm that follows a target in real time, in the browser or in MuJoCo's own viewer."""

from armctl.view.native import view_natively
from armctl.view.page import view
from armctl.view.robot_page import view_robot

__all__ = ["view", "view_natively", "view_robot"]
