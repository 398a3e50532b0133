"""A gate between a policy and the motors: what is free passes, what is not is refused with the nearest safe pose."""

import numpy as np

import armctl

scene = armctl.World().add("wall", armctl.Box([0.04, 0.4, 0.4]), [0.45, 0.0, 0.2])
arm = armctl.load("robot_arm_3dof", scene=scene)
gate = armctl.Gate(arm)
sim = armctl.Simulation(arm)
times = 0.05 * np.arange(1, 21)

ways = {
    "a policy": [0.5, -0.3, 0.2],
    "a policy that fails": [0.2, 1.0, -0.3],
    "a policy in a hurry": [6.0, -0.5, 0.3],
}
for name, way in ways.items():
    chunk = sim.state.q + np.outer(np.sin(0.5 * np.pi * times) ** 2, way)
    answer = gate.admit(sim.state.q, q=arm.limits.clamp(chunk), times=times)
    print(f"{name}: {answer}")

# A target inside the wall: the arm goes to the nearest safe pose instead, around what is in the way.
answer = gate.admit(sim.state.q, tip=[0.45, 0.1, 0.2])
print(f"a target in the wall: {answer}")
if answer.nearest_pose is not None:
    print(f"instead: {sim.move_to(answer.nearest_pose.position)}")
