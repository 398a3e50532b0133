"""Model predictive control: with weak motors, the arm accelerates before the torque is missing."""

from dataclasses import replace

import numpy as np

import armctl

strong = armctl.load("robot_arm_3dof")
motion = armctl.move_j(strong, strong.home, strong.home + np.array([0.8, 0.4, -0.5]))
needed = np.array([np.abs(strong.inverse_dynamics(*motion(t)[:3])) for t in np.linspace(0.0, motion.duration, 200)]).max(axis=0)
arm = strong.with_limits(replace(strong.limits, tau_max=0.85 * needed))


class Clipped(armctl.ComputedTorque):
    """Computed torque, clipped as motors do it."""

    def torque(self, state, setpoint):
        return np.clip(super().torque(state, setpoint), -arm.limits.tau_max, arm.limits.tau_max)


mpc = armctl.MPC(arm)
for name, law in (("clipped", Clipped(arm)), ("qp", armctl.ComputedTorqueQP(arm)), ("mpc", mpc)):
    log = armctl.simulate(arm, law, motion, dwell=0.5)
    error = np.linalg.norm(log.tip - log.tip_ref, axis=1)
    print(f"{name:8} tip error: RMS {1e3 * np.sqrt(np.mean(error**2)):.2f} mm, largest {1e3 * error.max():.2f} mm")
print(mpc.counts)
print(armctl.margins(strong, "mpc", configurations=5))
