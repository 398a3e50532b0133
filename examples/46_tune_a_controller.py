"""Tune a controller: the highest gains that tolerate a delay of 8 ms everywhere, and the bound that limits each joint."""

import armctl

arm = armctl.load("robot_arm_3dof")
tuned = armctl.tune(arm, "pd-gravity", delay_margin=8e-3, configurations=5)
print(tuned)

motion = armctl.move_j(arm, arm.home, arm.home + 0.4)
for name, controller in (("default", armctl.PDGravity(arm)), ("tuned", tuned.controller)):
    report = armctl.Report.from_log(armctl.simulate(arm, controller, motion, armctl.Plant(payload=0.5)))
    print(f"{name}: joint error with 0.5 kg unknown, RMS {report.joint_rms_rad:.1e} rad")
