"""Carry a glass over a wall: the hand keeps it upright, and the glass must not touch anything."""

import numpy as np

import armctl

scene = armctl.World().add("glass", armctl.Cylinder(0.025, 0.12), [0.5, 0.3, 0.06], mass=0.2)
scene.add("wall", armctl.Box([0.4, 0.04, 0.3]), [0.5, 0.0, 0.15])
arm = armctl.load("panda", scene=scene)
sim = armctl.Simulation(arm)
down = np.diag([1.0, -1.0, -1.0])  # the tip's z axis points down

print("open:  ", sim.gripper.open())
print("above: ", sim.move_to(armctl.Pose.from_rotation([0.5, 0.3, 0.22], down)))
print("down:  ", sim.move_to(armctl.Pose.from_rotation([0.5, 0.3, 0.1], down)))
print("grasp: ", sim.gripper.close())
print("lift:  ", sim.move_to(armctl.Pose.from_rotation([0.5, 0.3, 0.15], down), keep="z"))

print("across:", sim.move_to([0.5, -0.3, 0.15], keep="z", keep_within=0.1))
axes = np.array([arm.fk(q).rotation[:, 2] for q in sim.log.q])
print(f"the hand tilted by {np.degrees(np.arccos(-axes[:, 2].min())):.2f} degrees at most")
print(f"the glass stands {np.degrees(np.arccos(sim.data.body('glass').xmat[8])):.2f} degrees off the vertical")
print("touched:", [str(contact) for contact in sim.log.contacts if "wall" in str(contact)] or "no wall")
