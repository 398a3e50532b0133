"""A 20 mm peg goes into a 20.1 mm hole from 1 mm beside it: it presses, searches along a spiral, and yields when it drops."""

import itertools
from pathlib import Path

import mujoco
import numpy as np

import armctl

PEG = """<mujoco model="peg"><worldbody><body name="peg"><site name="tip" pos="0 0 0.06"/><geom type="cylinder" size="0.01 0.03"
  pos="0 0 0.03" mass="0.1" friction="0.2" solref="0.005 1" solimp="0.999 0.999" priority="1"/></body></worldbody></mujoco>"""
hole = np.array([0.35, 0.0, 0.1])
scene = armctl.Scene().add_box("bottom", [0.06, 0.06, 0.02], hole - [0.0, 0.0, 0.03])
for side, angle in enumerate(2 * np.pi * np.arange(12) / 12):  # flat faces at 10.05 mm from the axis of the hole
    center = hole + np.array([0.02005 * np.cos(angle), 0.02005 * np.sin(angle), -0.01])
    scene.add_box(f"side {side}", [0.02, 0.016, 0.02], armctl.Pose(center, rpy=[0.0, 0.0, angle]))
arm = armctl.load(Path(__file__).parent / "models" / "desk_arm.urdf", tool=mujoco.MjSpec.from_string(PEG), scene=scene)
arm.model.opt.ccd_tolerance = 1e-9  # m; at the default of 1e-6, a cylinder that just touches gets depths of 0.1 mm


def tip_at(x: float, y: float, z: float) -> armctl.Pose:  # from 1 mm beside the hole, tilted by half a degree
    return armctl.Pose(hole + np.array([x, y + 1e-3, z]), rpy=[np.deg2rad(0.5), np.pi, 0.0])


x = 45e-6 * np.arange(28) * (-1.0) ** np.arange(28)  # half circles of a spiral; its pitch of 90 um is less than the gap of 100
spiral = [armctl.Arc(tip_at((a + b) / 2, (a - b) / 2, -0.025), tip_at(b, 0.0, -0.025)) for a, b in itertools.pairwise(x)]
start = armctl.solve_ik(arm, tip_at(0.0, 0.0, 2e-4)).q
search = armctl.move_path(arm, armctl.solve_ik(arm, tip_at(0.0, 0.0, -0.025), start).q, spiral, tip_speed=0.015)

press = armctl.Impedance(arm, stiffness=[8000, 8000, 2000, 8, 8, 30], error_max=[1, 1, 0.006, 1, 1, 1])  # at most 12 N down
sim = armctl.Simulation(arm, press, armctl.Plant(timestep=0.001, encoder_noise=1e-5))
sim.reset(start)
while sim.state.t < search.duration and sim.tip.position[2] > hole[2] - 5e-4:
    sim.step(press.torque(sim.measured_state, search(sim.state.t)))
print(f"the peg drops after {sim.state.t:.2f} s")
sim.controller = armctl.Impedance(arm, stiffness=[100, 100, 10000, 5, 5, 30], error_max=[1, 1, 0.0015, 1, 1, 1])
log = sim.run(armctl.move_j(arm, search(sim.state.t).q, search(sim.state.t).q), dwell=0.5)
deep = np.argmax(log.tip[:, 2] < hole[2] - 0.0199) * log.dt
print(f"it is {1e3 * (hole[2] - log.tip[-1, 2]):.2f} mm deep after another {deep:.2f} s")
