"""Inverse kinematics of ten thousand points on all cores: the share of a box that the arm can reach."""

import time

import numpy as np

import armctl

arm = armctl.load("robot_arm_3dof")
points = np.random.default_rng(0).uniform([-0.6, -0.6, 0.0], [0.6, 0.6, 0.9], (10_000, 3))

start = time.perf_counter()
batch = armctl.solve_ik_batch(arm, points)
seconds = time.perf_counter() - start

print(f"{batch} in {seconds:.2f} s")
print(f"the farthest is {batch[int(batch.position_error.argmax())].reason}")
