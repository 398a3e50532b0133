"""The frequency response of an elastic joint from a recording, its resonance, and a filter for a law that it disturbs."""

import tempfile
from pathlib import Path

import numpy as np

import armctl

arm = armctl.load("robot_arm_3dof")
motion = armctl.excitation(arm, for_="frequency")  # run it on your robot, and record positions and torques
real = armctl.Plant(timestep=0.001, elasticity=[0, 300, 0], rotor_inertia=0.05, elastic_damping=0.03, delay=2)
measured = []


class Recorded(armctl.PDGravity):
    """Keeps the positions of the motors, as encoders show them; the log of a simulation has those of the links."""

    def torque(self, state, setpoint):
        measured.append(state.q.copy())
        return super().torque(state, setpoint)


log = armctl.simulate(arm, Recorded(arm), motion, real, dwell=0.0)
positions = np.array(measured) + 1e-6 * np.random.default_rng(0).normal(size=log.q.shape)

responses = [armctl.FrequencyResponse.from_log(log, motion, joint, positions=positions) for joint in arm.joint_names]
fits = [response.two_mass() for response in responses]
for response, fit in zip(responses, fits, strict=True):
    print(response)
    print(fit)
print(f"drawn: {responses[1].plot(Path(tempfile.gettempdir()) / 'bode.svg')}")

known = armctl.TwoMass.plant(arm, fits, motion(0.0).q, armctl.Plant(timestep=0.001, delay=2))
print(armctl.propose_filter(arm, "computed-torque", motion(0.0).q, known))
