"""An unknown payload: one controller learns it during the first motion and is exact in the third."""

import numpy as np

import armctl

arm = armctl.load("robot_arm_3dof")
plant = armctl.Plant(payload=1.5, payload_center=[0.0, 0.0, 0.05], timestep=0.001)
goal = arm.home + np.array([0.8, -0.4, 0.6])

for name in ("computed-torque", "computed-torque-observer", "computed-torque-learning"):
    sim = armctl.Simulation(arm, name, plant)
    errors = []
    for _ in range(3):
        logs = [sim.run(armctl.move_j(arm, arm.home, goal)), sim.run(armctl.move_j(arm, goal, arm.home))]
        errors.append(np.sqrt(np.mean(np.concatenate([log.q - log.q_ref for log in logs]) ** 2)))
    print(f"{name:26s} RMS of three motions: " + ", ".join(f"{error:.1e}" for error in errors) + " rad")

print(f"learnt: {sim.controller.payload[0]:.3f} kg")
