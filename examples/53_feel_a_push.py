"""The arm feels a push during a move, without a sensor, and goes back; then a hand guides it."""

import numpy as np

import armctl

arm = armctl.load("robot_arm_3dof")
real = {"timestep": 0.001, "mass_scale": 1.05, "encoder_noise": 1e-5}  # the model knows nothing of this

# Thresholds from a motion in which nothing touches the arm.
sim = armctl.Simulation(arm, "computed-torque", armctl.Plant(**real))
free = sim.run(armctl.excitation(arm))
noisy = free.q + 1e-5 * np.random.default_rng(0).normal(size=free.q.shape)
speed = np.diff(noisy, axis=0, prepend=noisy[:1]) / free.dt
force = armctl.ExternalForce(arm, model_error=0.05).calibrated(noisy, speed, free.tau, free.dt)
print("thresholds of an exact model, N m:", force.noise.round(3))

push = armctl.Push(0.2, 0.1, force=[0.0, 50.0, 0.0])
sim = armctl.Simulation(arm, "computed-torque", armctl.Plant(**real, pushes=push))
sim.reaction = armctl.ContactReaction(arm, force, "retreat")
print(sim.move_j(arm.home + 0.6).reason)

hand = armctl.Push(0.1, 0.4, force=[0.0, 8.0, 0.0])
sim = armctl.Simulation(arm, armctl.HandGuiding(arm), armctl.Plant(**real, pushes=hand))
for _ in range(1500):
    sim.step()
print("guided by", (sim.state.q - arm.home).round(2), "rad, now at", np.abs(sim.state.v).max().round(3), "rad/s")
