"""Elastic joints: margins before the run, a law that knows the springs, and a motion that leaves no vibration."""

import numpy as np

import armctl

arm = armctl.load("robot_arm_3dof")
springs = {"elasticity": 500.0, "rotor_inertia": 0.2}  # N m/rad between each motor and its link, kg m^2
plant = armctl.Plant(**springs, timestep=0.001)
motion = armctl.move_j(arm, arm.home, arm.home + np.array([0.0, 0.3, 0.3]), speed=0.5)

rigid = [armctl.PDGravity(arm), armctl.ComputedTorque(arm)]
for law in [*rigid, armctl.ElasticFeedforward(arm, **springs), armctl.ElasticFeedback(arm, **springs)]:
    loop = armctl.linearize(arm, law, motion(motion.duration).q, plant)
    log = armctl.simulate(arm, law, motion, plant, dwell=1.0)
    report = armctl.Report.from_log(log)
    print(
        f"{log.controller:20}  delay margin {1e3 * loop.margins().delay_margin:4.1f} ms"
        f"  RMS {1e3 * report.joint_rms_rad:6.3f} mrad  vibration {1e6 * report.residual_vibration_m:6.1f} um"
    )

law = armctl.PDGravity(arm)
modes = armctl.linearize(arm, law, motion(motion.duration).q, plant).vibrations()
for frequency, damping_ratio in modes[modes[:, 0] < 60.0][:2]:
    motion = armctl.shape_motion(motion, frequency, damping_ratio, "zvd")
report = armctl.Report.from_log(armctl.simulate(arm, law, motion, plant, dwell=1.0))
slowest = 2 * np.pi / modes[:, 0].min()
print(f"shaped, pd-gravity: vibration {1e6 * report.residual_vibration_m:.1f} um; its slowest period is {slowest:.2f} s")
