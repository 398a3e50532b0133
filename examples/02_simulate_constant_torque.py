"""An arm under constant torques, without any controller."""

import armctl

sim = armctl.Simulation("robot_arm_3dof")
log = sim.apply_ctrl([0.5, -0.3, -0.2], duration=1.0)  # motor controls; a joint's torque is gear x control
print(f"joint torques, N m: {log.tau[0]}")
print("time, s   joint angles, rad          tip, m")
for k in range(0, len(log), 100):
    print(f"{log.t[k]:7.3f}  {log.q[k].round(3)!s:26} {log.tip[k].round(3)}")
print(f"at the end the joints move at {log.v[-1].round(3)} rad/s")
