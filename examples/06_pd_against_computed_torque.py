"""The same motion under PD and under computed torque, in one table: the benefit of a model of the arm."""

import armctl
from armctl.report.report import table

arm = armctl.load("robot_arm_3dof")
motion = armctl.move_through(arm, [[0.0, -0.5, -1.0], [1.0, -0.3, -0.5], [-1.0, -0.3, -0.5], [0.0, 0.0, 0.0]])
reports = armctl.compare(arm, [armctl.PD(arm), armctl.ComputedTorque(arm)], motion)
print(table(reports))
print(reports[-1])
