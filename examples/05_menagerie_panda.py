"""The Panda from MuJoCo Menagerie: its joints with their ranges and limits, and a first motion."""

import armctl

arm = armctl.load("panda")
limits = arm.limits
print(f"{arm.name}: {arm.n} joints, tip {arm.tip!r} at home {arm.fk(arm.home).position.round(3)} m")
print("joint     range, rad        speed, rad/s  torque, N m")
for i, name in enumerate(arm.joint_names):
    low, high = limits.q_min[i], limits.q_max[i]
    print(f"{name:8} [{low:6.3f}, {high:6.3f}]  {limits.v_max[i]:10.3f}  {limits.tau_max[i]:11.0f}")

sim = armctl.Simulation(arm)
print(sim.move_to([0.5, 0.2, 0.4]))
print(armctl.Report.from_log(sim.log))
