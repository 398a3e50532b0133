"""Watch every move of a simulation in the browser, in real time."""

import armctl

sim = armctl.Simulation("robot_arm_3dof", viewer=True)
for target in ([0.2, -0.2, 0.4], [0.2, 0.2, 0.4], sim.target):
    print(sim.move_to(target))

print(f"real-time factor {sim.log.real_time_factor:.2f}")
# sim.viewer.wait() keeps the page until Ctrl-C.
print(armctl.Report.from_log(sim.log))
