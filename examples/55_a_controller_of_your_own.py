"""A controller of your own, a PID, with a payload that it does not know; and how robust it is."""

import numpy as np

import armctl


class PID:
    name = "my-pid"

    def __init__(self, arm, stiffness=400.0, damping=40.0, integral=400.0):  # N m/rad, N m s/rad, N m/(rad s)
        self.stiffness, self.damping, self.integral = stiffness, damping, integral
        self.gravity = arm.gravity
        self.last_time = float("-inf")

    def torque(self, state, setpoint):
        if abs(state.t - self.last_time - state.dt) > 0.1 * state.dt:  # a new run
            self.sum = np.zeros(len(state.q))
        self.last_time = state.t
        error = setpoint.q - state.q
        self.sum += error * state.dt
        feedback = self.stiffness * error + self.damping * (setpoint.v - state.v) + self.integral * self.sum
        return self.gravity(state.q) + feedback


arm = armctl.load("robot_arm_3dof")
motion = armctl.move_j(arm, arm.home, arm.home + 0.4)
for controller in (armctl.PDGravity(arm, stiffness=400.0, damping=40.0), PID(arm)):
    log = armctl.simulate(arm, controller, motion, armctl.Plant(payload=1.0), dwell=3.0)
    print(f"{controller.name}: {1e3 * armctl.Report.from_log(log).final_tip_error_m:.3f} mm from the goal")
print(armctl.margins(arm, PID(arm)))
