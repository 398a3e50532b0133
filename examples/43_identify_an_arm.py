"""The inertia of an arm differs from its model: one run identifies it, and computed torque tracks better."""

import copy
from dataclasses import replace

import mujoco
import numpy as np

import armctl
from armctl.lab.comparison import out_and_back

arm = armctl.load("robot_arm_3dof")
model = copy.copy(arm.model)  # the real arm: 20 % more mass and 30 % more damping than its model
model.body_mass *= 1.2
model.body_inertia *= 1.2
model.dof_damping *= 1.3
mujoco.mj_setConst(model, mujoco.MjData(model))
real = replace(arm, model=model)

recording = armctl.simulate(real, "computed-torque-observer", armctl.excitation(arm, for_="arm"), armctl.Plant(timestep=0.001))
rng = np.random.default_rng(0)
recording = replace(recording, q=recording.q + 1e-5 * rng.standard_normal(recording.q.shape))  # rad of encoder noise
found = armctl.identify(arm, recording)
print(found)

motion = out_and_back(arm)
for name, known in (("model", arm), ("identified", found.applied_to(arm))):
    log = armctl.simulate(real, armctl.ComputedTorque(known), motion, armctl.Plant(timestep=0.001))
    print(f"{name:10} {1e6 * armctl.Report.from_log(log).joint_rms_rad:8.1f} urad RMS")
