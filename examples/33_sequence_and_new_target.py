"""Motions of several kinds with rounded corners, and a line to a new target that starts while the arm moves."""

import numpy as np

import armctl

arm = armctl.load("robot_arm_3dof")
above = arm.home + np.array([0.6, 0.3, -0.3])
approach = armctl.move_j(arm, arm.home, above)
line = armctl.move_l(arm, above, arm.fk(above).position + np.array([0.0, -0.1, 0.05]))
end = line(line.duration).q
back = armctl.move_through(arm, [end, end + np.array([0.3, -0.2, 0.1]), arm.home])

for blend in (0.0, 0.01, 0.05):
    whole = armctl.move_sequence(arm, [approach, line, back], blend=blend)
    print(f"corners of {1e3 * blend:2.0f} mm: {whole.duration:.3f} s, inside all limits: {whole.check_limits().ok}")

t = 0.5 * approach.duration  # a new target appears during the motion
now = approach(t)
target = arm.fk(above).position + np.array([0.0, -0.05, -0.05])
turned = approach.until(t).then(armctl.move_l(arm, now, target))
print(f"at {t:.3f} s the tip turns to another target, which it reaches at {turned.duration:.3f} s")
print(f"it ends {1e3 * np.linalg.norm(arm.fk(turned(turned.duration).q).position - target):.3f} mm from it")
