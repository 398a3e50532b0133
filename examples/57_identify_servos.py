"""An arm that reports positions only: commands and encoders show its servos' gains, friction, rotor inertia and delay."""

import copy

import mujoco
import numpy as np

import armctl

arm = armctl.load("robot_arm_3dof")
real = copy.copy(arm.model)  # the real arm: position servos, a delay of 24 ms, and other rotors than in the file
real.actuator_gear[:3, 0] = 1.0
real.actuator_ctrllimited[:3] = 0
real.actuator_forcelimited[:3] = 0
real.actuator_gainprm[:3, 0] = 300.0
real.actuator_biastype[:3] = mujoco.mjtBias.mjBIAS_AFFINE
real.actuator_biasprm[:3, :3] = [0.0, -300.0, -20.0]
real.dof_armature[:3] *= 1.5


def recording(seed):
    """Commands 50 times a second along a motion, and what encoders of 12 bits read."""
    command = armctl.excitation(arm, duration=6.0, for_="arm", seed=seed).sample(np.arange(0.0, 6.0, 0.02)).q
    data = mujoco.MjData(real)
    data.qpos[:3] = command[0]
    positions = []
    for tick in range(len(command)):
        positions.append(data.qpos[:3].copy())
        for step in range(10):  # of 2 ms
            data.ctrl[:3] = command[max(0, (10 * tick + step - 12) // 10)]
            mujoco.mj_step(real, data)
    encoder = 2 * np.pi / 4096
    return armctl.Log.from_positions(
        0.02, np.round(np.array(positions) / encoder) * encoder, command, joint_names=arm.joint_names
    )


print(armctl.identify_servo(arm, recording(1), judge=recording(2)))
