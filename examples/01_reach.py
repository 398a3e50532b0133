"""Move the tip of an arm to the green target, in three lines."""

import armctl

sim = armctl.Simulation("robot_arm_3dof")
print(sim.move_to(sim.target))
print(armctl.Report.from_log(sim.log))
