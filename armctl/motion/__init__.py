"""Motion: from joint positions, tip lines and waypoints to jerk-limited trajectories within every joint's limits."""

from armctl.motion.joint_trajectory import JointTrajectory
from armctl.motion.lines import Arc, Line, move_c, move_l, move_path
from armctl.motion.online import OnlineMotion
from armctl.motion.straight import move_j
from armctl.motion.through import move_through
from armctl.motion.torque import TorqueCheck, check_torque

__all__ = [
    "Arc",
    "JointTrajectory",
    "Line",
    "OnlineMotion",
    "TorqueCheck",
    "check_torque",
    "move_c",
    "move_j",
    "move_l",
    "move_path",
    "move_through",
]
