"""Slide over a table past a bowl, and turn a lever along its arc: the tip stays in a region on the whole way."""

import numpy as np

import armctl


def symmetric(*halves):
    return np.outer(halves, [-1, 1])


scene = (
    armctl.World()
    .add("table", armctl.Box([0.6, 1.0, 0.04]), [0.5, 0, -0.02])
    .add("bowl", armctl.Box([0.1, 0.1, 0.2]), [0.5, 0, 0.1])
)
arm = armctl.load("panda", scene=scene)
sim = armctl.Simulation(arm)
corner = armctl.Pose([0.5, -0.25, 0.05], rpy=[np.pi, 0, 0])
print("corner:", sim.move_to(corner))

# x y z, roll pitch yaw: it slides on the plane and turns about its normal, 2 mm and 10 mrad to each side
plane = armctl.Region(corner, symmetric(np.inf, np.inf, 2e-3, 0.01, 0.01, np.inf))
print("slide: ", sim.move_to([0.5, 0.25, 0.05], keep=plane))
heights = np.array([arm.fk(q).position[2] for q in sim.log.q_ref])
print(f"the tip was planned between {1e3 * heights.min():.2f} and {1e3 * heights.max():.2f} mm above the table")

# A lever of 0.2 m: the frame is at its hinge, the tip has an offset, and the yaw is free
hinge = armctl.Pose(sim.tip.position + np.array([0, 0.2, 0]))
handle = hinge.inverse() @ sim.tip
arc = armctl.Region(hinge, symmetric(1e-3, 1e-3, 1e-3, 0.01, 0.01, 1.5), tip=handle)
end = hinge @ armctl.Pose([0, 0, 0], rpy=[0, 0, 1.0]) @ handle
print("lever: ", sim.move_to(end, keep=arc))
radii = np.array([np.hypot(*(arm.fk(q).position - hinge.position)[:2]) for q in sim.log.q_ref])
print(f"its handle was planned between {1e3 * radii.min():.2f} and {1e3 * radii.max():.2f} mm from the hinge")
print("off it:", sim.move_to(end @ armctl.Pose([0, 0, -0.1]), keep=arc).reason)
