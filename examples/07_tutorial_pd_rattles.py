"""Why a PD law of a tutorial oscillates: the gear multiplies its gains, and its damping is too large for 2 ms."""

import warnings

import numpy as np

import armctl

arm = armctl.load("robot_arm_3dof")
warnings.simplefilter("ignore", armctl.ArmctlWarning)  # of the jumps, which are meant


class TutorialPD:
    """The law as published: ctrl = clip(50 (q_ref - q) - 5 v, -5, 5), straight into motors with a gear of 50 or 30."""

    name = "tutorial-pd"

    def torque(self, state, setpoint):
        ctrl = np.clip(50.0 * (setpoint.q - state.q) - 5.0 * state.v, -5.0, 5.0)
        return arm.gear * ctrl


waypoints = [[0.0, -0.5, -1.0], [1.0, -0.3, -0.5], [-1.0, -0.3, -0.5], [0.0, 0.0, 0.0]]
print("controller        waypoint            torque, N m      chatter, N m  off at the end, rad")
for controller in (TutorialPD(), armctl.PD(arm), armctl.ComputedTorque(arm)):
    sim, start = armctl.Simulation(arm, controller), arm.home
    for goal in waypoints:
        jump = isinstance(controller, TutorialPD)  # the tutorial jumps to each waypoint, and stays for 3 s
        log = sim.run(armctl.move_j(arm, goal if jump else start, goal), dwell=3.0)
        report, start = armctl.Report.from_log(log), goal
        torque = f"{log.tau.min():6.1f} to {log.tau.max():5.1f}"
        off = np.abs(log.q[-1] - goal).max()
        print(f"{report.controller:16}  {goal!s:18}  {torque}  {report.chatter_nm:12.4f}  {off:18.4f}")
print(report)
