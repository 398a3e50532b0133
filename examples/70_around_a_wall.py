"""Around a wall: the straight move collides, and the planned move has a proved clearance."""

import numpy as np

import armctl

scene = armctl.World().add("wall", armctl.Box([0.02, 0.02, 0.5]), [0.3, 0.0, 0.25])
arm = armctl.load("robot_arm_3dof", scene=scene)
start = np.array([-0.8, 0.9, -1.2])
goal = np.array([0.8, 0.9, -1.2])

print("straight:", armctl.check_clearance(arm, armctl.move_j(arm, start, goal)))
motion = armctl.move_free(arm, start, goal, clearance=0.01)
print("planned: ", armctl.check_clearance(arm, motion))
print(f"it takes {motion.duration:.2f} s")

log = armctl.simulate(arm, "computed-torque", motion)
print("touched: ", list(log.contacts) or "nothing")
