"""Pick and place: a UR5e with a Robotiq gripper moves a cube across a table."""

import numpy as np

import armctl

START, GOAL = np.array([0.2, 0.45, 0.22]), np.array([-0.25, 0.55, 0.22])
ABOVE, DOWN = np.array([0, 0, 0.1]), [np.pi, 0, 0]

scene = armctl.World()
scene.add("table", armctl.Box([1.0, 0.6, 0.2]), at=[0, 0.65, 0.1])
scene.add("cube", armctl.Box([0.04, 0.04, 0.04]), at=START, mass=0.1)
arm = armctl.load("ur5e", tool="robotiq_2f85", scene=scene)
print(f"{arm.name} with its tip at {arm.tip!r}")

sim = armctl.Simulation(arm)
print("gripper:", sim.gripper.open())
for point in (START + ABOVE, START):
    print(sim.move_to(armctl.Pose(point, rpy=DOWN)))
print("gripper:", sim.gripper.close())
for point in (START + ABOVE, GOAL + ABOVE):
    print(sim.move_to(armctl.Pose(point, rpy=DOWN)))
print(sim.move_to(armctl.Pose(GOAL, rpy=DOWN), allow=[("cube", "table")]))  # the cube may touch the table
report = armctl.Report.from_log(sim.log)
print("gripper:", sim.gripper.open())
print(sim.move_to(armctl.Pose(GOAL + ABOVE, rpy=DOWN)))

error = np.linalg.norm(sim.data.body("cube").xpos - GOAL)
print(f"the cube is {1e3 * error:.2f} mm from its goal")
print(report)
