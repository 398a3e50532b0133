"""LQR and LQG: gains by a delay margin, by Bryson's rule and along a motion, in the same table as computed torque."""

import armctl

arm = armctl.load("robot_arm_3dof")
motion = armctl.move_j(arm, arm.home, arm.home + 0.4)
plant = armctl.Plant(payload=0.3, encoder_noise=1e-5)

bryson = armctl.LQR(arm, max_error=0.05, max_velocity=1.0)
along = armctl.LQR(arm, motion, max_error=0.05, max_velocity=1.0)
laws = {
    "computed torque": armctl.ComputedTorque(arm),
    "lqr, delay margin 5 ms": armctl.LQR(arm),
    "lqr, delay margin 10 ms": armctl.LQR(arm, delay_margin=0.01),
    "lqr, Bryson's rule": bryson,
    "lqr, along the motion": along,
}
for name, law in laws.items():
    report = armctl.Report.from_log(armctl.simulate(arm, law, motion, plant))
    worst = armctl.margins(arm, law, configurations=5)
    print(f"{name}: RMS {report.joint_rms_rad:.1e} rad, delay margin {1e3 * worst.delay.value:.1f} ms", end=", ")
    print(f"Ms {worst.peak_sensitivity.value:.2f}")

(gains,) = bryson.gains()
print(f"K {gains.K.shape}, first row: {gains.K[0].round(1).tolist()}")
print(f"gains change at {len(along.gains())} points of the motion")
