"""A PD controller moves through four waypoints: the arm settles, but sags under its own weight."""

import numpy as np

import armctl

arm = armctl.load("robot_arm_3dof")
waypoints = [[0.0, -0.5, -1.0], [1.0, -0.3, -0.5], [-1.0, -0.3, -0.5], [0.0, 0.0, 0.0]]

sim = armctl.Simulation(arm, armctl.PD(arm))
print(f"stiffness, N m/rad: {sim.controller.stiffness.round(1)}, damping, N m s/rad: {sim.controller.damping.round(1)}")
start = arm.home
for goal in waypoints:
    log = sim.run(armctl.move_j(arm, start, goal), dwell=1.0)
    print(f"at {goal}: off by {np.round(goal - log.q[-1], 4)} rad, moving at {np.abs(log.v[-1]).max():.1e} rad/s")
    start = goal
print(armctl.Report.from_log(log))
