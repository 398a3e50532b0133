"""Around what is seen: points of a ball that appears, a stick that the arm carries, and both in proofs of whole motions."""

import numpy as np

import armctl

arm = armctl.load("panda")
sim = armctl.Simulation(arm)
goal = arm.home + np.array([1.2, 0.3, 0.0, 0.2, 0.0, 0.0, 0.0])
direct = armctl.move_j(arm, arm.home, goal)
halfway = arm.fk(direct(0.5 * direct.duration).q).position

rng = np.random.default_rng(0)
directions = rng.normal(size=(5000, 3))
ball = halfway + 0.05 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
points = armctl.robot_filter(arm, sim.state.q, ball)  # without those on the robot itself

sim.world.add("seen", armctl.Points(points, radius=0.003))
print("straight:", armctl.check_clearance(arm, direct, world=sim.world))
print("around:  ", sim.move_j(goal))

sim.world.remove("seen")
sim.world.add("stick", armctl.Cylinder(0.01, 0.3), at=sim.tip @ armctl.Pose([0.0, 0.0, 0.16]), mass=0.2)
sim.world.attach("stick")  # from where it is; its mass is a payload
sim.world.add("table", armctl.Box([0.6, 0.6, 0.1]), at=[0.3, 0.5, 0.05])
lower = sim.tip.position - [0.0, 0.0, 0.3]
print("carrying:", sim.move_to(lower))
