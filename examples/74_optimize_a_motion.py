"""A motion around a wall made faster, and one that excites less vibration: each within all limits, and proved free again."""

import numpy as np

import armctl

scene = armctl.World().add("wall", armctl.Box([0.02, 0.02, 0.5]), [0.3, 0.0, 0.25])
arm = armctl.load("robot_arm_3dof", scene=scene)
motion = armctl.move_free(arm, np.array([-0.8, 0.9, -1.2]), np.array([0.8, 0.9, -1.2]), seed=1)

for name, weights in (("faster", {"time": 1.0}), ("smoother", {"time": 1.0, "vibration": 1.0})):
    better = armctl.optimize(arm, motion, evaluations=150, **weights)
    print(f"{name}: {better}")
    print(f"  {better.clearance}")
