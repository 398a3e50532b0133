"""A friction of your own: a plant with a Stribeck curve, which MuJoCo has not, and how far each controller is off."""

import numpy as np

import armctl

arm = armctl.load("robot_arm_3dof")
COULOMB, BREAKAWAY = 1.0, 1.5  # N m
STRIBECK_SPEED, SMOOTHING_SPEED = 0.05, 0.005  # rad/s


def stribeck(q, v, t):
    """The torque of the friction on each joint, N m."""
    return -np.tanh(v / SMOOTHING_SPEED) * (COULOMB + (BREAKAWAY - COULOMB) * np.exp(-((v / STRIBECK_SPEED) ** 2)))


motion = armctl.move_j(arm, arm.home, arm.home + 0.5)
for controller in ("pd-gravity", "computed-torque", "computed-torque-observer"):
    for plant in (armctl.Plant(timestep=0.001), armctl.Plant(timestep=0.001, joint_torque=stribeck)):
        log = armctl.simulate(arm, controller, motion, plant)
        print(f"{controller:24s} {plant!s:35s} {1e3 * armctl.Report.from_log(log).joint_rms_rad:8.4f} mrad")
