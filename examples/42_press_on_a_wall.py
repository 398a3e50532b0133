"""The tip presses on a wall with impedance control: the deeper the target is behind the surface, the larger the force."""

import numpy as np

import armctl

K = 2000.0  # N/m
wall_at = 0.44  # m, where its face is
scene = armctl.World().add("wall", armctl.Box([0.1, 1.0, 1.0]), at=[wall_at + 0.05, 0.0, 0.5])
arm = armctl.load("robot_arm_3dof", scene=scene)

controller = armctl.Impedance(arm, stiffness=[K, K, K, 0.0, 0.0, 0.0])
sim = armctl.Simulation(arm, controller, armctl.Plant(timestep=0.001))
q, height = arm.home, arm.fk(arm.home).position[2]

print("target past its face, mm   force on it, N   spring's force, N")
for depth in (0.0, 0.005, 0.01, 0.02):
    press = armctl.move_l(arm, q, [wall_at + depth, 0.0, height], tip_speed=0.2)
    log = sim.run(press, dwell=1.0)
    q = press(press.duration).q
    force = np.linalg.lstsq(arm.jacobian(log.q[-1])[:3].T, -sim.data.qfrc_constraint[arm.dof_adr])[0]
    spring = K * (log.tip_ref - log.tip)[-1]
    print(f"{1e3 * depth:24.0f} {force[0]:16.2f} {spring[0]:18.2f}")
print(armctl.Report.from_log(log))
