"""Grasp any can: the goal is every grasp around three cans, and the motion goes to the nearest configuration."""

import numpy as np

import armctl

CAN = armctl.Cylinder(0.03, 0.12)
PLACES = {"left": [0.5, 0.25, 0.26], "middle": [0.6, 0.0, 0.26], "right": [0.5, -0.25, 0.26]}

scene = armctl.World().add("table", armctl.Box([0.6, 1.0, 0.04]), [0.55, 0.0, 0.18])
for name, place in PLACES.items():
    scene.add(name, CAN, place, mass=0.1)
arm = armctl.load("panda", scene=scene)
grasps = armctl.Region.union(
    armctl.Region.around(CAN, at, distance=0.015, margin=0.04, name=name) for name, at in PLACES.items()
)

print("IK:   ", armctl.solve_ik(arm, grasps, avoid=True).member)
motion = armctl.move_free(arm, arm.home, grasps)
print("path: ", armctl.check_clearance(arm, motion), f"in {motion.duration:.2f} s")

sim = armctl.Simulation(arm)
print("open: ", sim.gripper.open())
print("moved:", sim.move_to(grasps))
print("grasp:", sim.gripper.close())
print("lift: ", sim.move_to(armctl.Pose(sim.tip.position + np.array([0, 0, 0.1]), sim.tip.quat)))
