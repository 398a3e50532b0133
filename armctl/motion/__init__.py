"""Motion: from joint positions, tip lines and waypoints to jerk-limited trajectories within every joint's limits."""

from armctl.motion.move_cartesian import Arc, Line, PathOptions, move_c, move_l, move_path
from armctl.motion.move_j import move_j
from armctl.motion.move_sequence import move_sequence
from armctl.motion.move_through import move_through
from armctl.motion.online import OnlineMotion
from armctl.motion.sections import Via
from armctl.motion.torque_limits import TorqueCheck, check_torque
from armctl.motion.trajectory.joint_trajectory import JointTrajectory

__all__ = [
    "Arc",
    "JointTrajectory",
    "Line",
    "OnlineMotion",
    "PathOptions",
    "TorqueCheck",
    "Via",
    "check_torque",
    "move_c",
    "move_j",
    "move_l",
    "move_path",
    "move_sequence",
    "move_through",
]
