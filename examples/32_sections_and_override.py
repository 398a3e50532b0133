"""Sections of a path with different speeds and payloads, a pause, and a speed override during the motion."""

import numpy as np

import armctl
from armctl import Line, Via

arm = armctl.load("robot_arm_3dof")
up = arm.home + np.array([0.4, 0.3, -0.3])
down = arm.home + np.array([0.9, 0.0, 0.2])

plain = armctl.move_through(arm, [arm.home, up, down, arm.home])
careful = armctl.move_through(arm, [arm.home, up, Via(down, speed=0.5, dwell=0.3), Via(arm.home, payload=0.5)])
print(f"as fast as it can: {plain.duration:.2f} s; half speed down, a pause, 0.5 kg back: {careful.duration:.2f} s")

start = arm.fk(arm.home)
corners = [(start.position + np.array(way)) for way in ([0.0, 0.08, 0.0], [0.0, 0.08, -0.08], [0.0, 0.0, -0.08])]
contour = armctl.move_path(arm, arm.home, [corners[0], Line(corners[1], speed=0.3), corners[2]], blend=0.02)
print(f"the contour takes {contour.duration:.2f} s, inside all limits: {contour.check_limits().ok}")

slower = contour.overridden(0.3, 0.5)  # somebody comes near after 0.3 s
faster = slower.overridden(0.9, 2.0)  # and leaves after 0.9 s
print(f"at half speed from 0.3 s on: {slower.duration:.2f} s; until 0.9 s only: {faster.duration:.2f} s")
