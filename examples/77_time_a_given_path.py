"""A curve that another program gives: as fast as the arm can follow it, in a given time, and from a recording as it was."""

import tempfile
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

import armctl

arm = armctl.load("robot_arm_3dof")
points = arm.home + np.array([[0.0, 0.0, 0.0], [0.4, 0.2, -0.3], [0.9, -0.1, -0.1], [0.5, -0.3, 0.1], [0.0, 0.0, 0.0]])
curve = CubicSpline([0.0, 1.0, 2.0, 3.0, 4.0], points)  # over any parameter
motion = armctl.time_path(arm, curve)
print(f"along the spline: {motion.duration:.3f} s; {motion.check_limits()}")
print(armctl.check_torque(arm, motion))


def lissajous(s: np.ndarray, order: int) -> np.ndarray:
    """(T, 3) rad, the derivative of an order at parameters (T,)."""
    middle = arm.home - 0.2 if order == 0 else 0.0
    rates = np.array([1.0, 2.0, 3.0])
    return middle + 0.2 * rates**order * np.sin(rates * s[:, None] + order * np.pi / 2)


print(f"along a function: {armctl.time_path(arm, lissajous, (0.0, 2 * np.pi)).duration:.3f} s")
print(f"in a given time: {armctl.time_path(arm, curve, duration=3.0).duration:.3f} s")

recording = motion.scaled(0.4).to_csv(Path(tempfile.gettempdir()) / "recording.csv", dt=0.01)
played = armctl.JointTrajectory.from_csv(recording, arm)
faster = armctl.time_path(arm, played)
print(f"the recording plays in {played.duration:.3f} s, and its path can take {faster.duration:.3f} s")
