"""The tip of an arm is millimetres off: 20 measured positions show which joints and lengths differ from the file."""

import copy
from pathlib import Path
from tempfile import mkdtemp

import mujoco
import numpy as np

import armctl

arm = armctl.load("robot_arm_3dof")
real = copy.copy(arm.model)  # the real arm: the elbow reads 0.01 rad wrong, and sits 2 mm too far out
real.body("link3").pos += [0.002, 0.0, 0.0]
real.body("link3").quat[:] = [np.cos(0.005), 0.0, np.sin(0.005), 0.0]

poses = armctl.calibration_poses(arm, 20, parameters=["offsets", "lengths"])
data = mujoco.MjData(real)
rng = np.random.default_rng(0)
measured = []
for q in poses.q:  # a laser tracker with 0.1 mm of noise
    data.qpos[:] = arm.qpos(q)
    mujoco.mj_kinematics(real, data)
    measured.append(data.site("end_effector").xpos + 1e-4 * rng.standard_normal(3))

found = armctl.calibrate_geometry(arm, poses.q, measured, parameters=["offsets", "lengths"])
print(found)
found.to_mjcf(Path(mkdtemp()) / "calibrated.xml")
