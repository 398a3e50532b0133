"""A 20 mm peg goes into a 20.1 mm hole from 1 mm beside it: its lower edge finds the hole, then it stands up and sinks."""

from pathlib import Path

import mujoco
import numpy as np

import armctl

PEG = """<mujoco model="peg"><option cone="elliptic"/><worldbody><body name="peg"><geom type="cylinder" size="0.01 0.03"
  pos="0 0 0.03" mass="0.1" friction="0.2" solref="0.002 1" solimp="0.999 0.999" priority="1"/><site name="tip" pos="0 0 0.06"/>
</body></worldbody></mujoco>"""
hole = np.array([0.35, 0.0, 0.1])
scene = armctl.World().add("bottom", armctl.Box([0.06, 0.06, 0.02]), hole - [0.0, 0.0, 0.03])
for side, angle in enumerate(2 * np.pi * np.arange(12) / 12):  # flat faces at 10.05 mm from the axis of the hole
    center = hole + np.array([0.02005 * np.cos(angle), 0.02005 * np.sin(angle), -0.01])
    scene.add(f"side {side}", armctl.Box([0.02, 0.016, 0.02]), armctl.Pose(center, rpy=[0.0, 0.0, angle]))
arm = armctl.load(Path(__file__).parent / "models" / "desk_arm.urdf", tool=mujoco.MjSpec.from_string(PEG), scene=scene)
arm.model.opt.ccd_tolerance = 1e-9  # m; at the default of 1e-6, a cylinder that just touches gets depths of 0.1 mm

beside = hole + np.array([0.0, 1e-3, 0.0])  # where the hole is expected; the axis is half a degree wrong as well
start = armctl.Pose(beside + np.array([-4e-3, 0.0, 2e-3]), rpy=[0.009, np.pi + 0.08, 0.0])  # the peg leans
q = armctl.solve_ik(arm, start).q
force = 2 / (arm.jacobian(q)[2] @ np.linalg.solve(arm.mass_matrix(q), arm.jacobian(q)[2]))  # N, 2 m/s^2 x effective mass
controller = armctl.HybridForce(arm, {"z": -force}, approach_speed=0.015, contact_force=0.15 * force)
sim = armctl.Simulation(arm, controller, armctl.Plant(timestep=0.001, encoder_noise=1e-5, force_noise=0.2, wrench_delay=4))
sim.reset(q)
top = sim.run(armctl.move_j(arm, q, q), dwell=0.6).tip[-1, 2]  # the lower edge dips into the hole
controller.force = {"x": 0.35 * force, "y": 0.0, "z": -force}
while sim.tip.position[2] > top - 1e-3:  # it slides until the peg drops
    sim.step(controller.torque(sim.measured_state, armctl.Setpoint(q, 0 * q, 0 * q)))
print(f"pressed with {force:.1f} N, the peg drops after {sim.state.t:.2f} s")
controller.force = {"x": 0.0, "y": 0.0}
upright = armctl.solve_ik(arm, armctl.Pose(sim.tip.position, rpy=[0.009, np.pi, 0.0]), sim.state.q).q
sim.run(armctl.move_j(arm, sim.state.q, upright).scaled(0.2), dwell=0.15)
controller.force = {"x": 0.0, "y": 0.0, "z": -0.5 * force, "rx": 0.0, "ry": 0.0}  # it yields to the walls
log = sim.run(armctl.move_j(arm, upright, upright), dwell=2.0)
deep = np.argmax(log.tip[:, 2] < hole[2] - 0.0199) * log.dt
print(f"upright, it sinks for {deep:.2f} s; after {sim.state.t:.2f} s it is {1e3 * (hole[2] - log.tip[-1, 2]):.2f} mm deep")
