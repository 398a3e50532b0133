"""An arm's tip goes to the green target: the three-line way."""

import armctl

sim = armctl.Simulation("robot_arm_3dof")
print(sim.move_to(sim.target))
print(armctl.Report.from_log(sim.log))
