"""An arm pushes a box to a pose: sampling MPC tries variations of its plan in MuJoCo, with the contacts of the scene."""

from pathlib import Path

import mujoco
import numpy as np

import armctl

STICK = """<mujoco model="stick"><option cone="elliptic"/><worldbody><body name="stick">
<geom type="capsule" fromto="0 0 0 0 0 0.09" size="0.01" mass="0.1" friction="0.2" priority="1"/>
<site name="tip" pos="0 0 0.09"/></body></worldbody></mujoco>"""
box = np.array([0.35, 0.0, 0.025])
scene = armctl.World().add("table", armctl.Box([0.6, 0.8, 0.02]), [0.35, 0.0, -0.01])
scene.add("box", armctl.Box([0.08, 0.06, 0.05]), box + np.array([0.0, 0.0, 1e-4]), mass=0.2)
arm = armctl.load(Path(__file__).parent / "models" / "desk_arm.urdf", tool=mujoco.MjSpec.from_string(STICK), scene=scene)

way = np.array([0.03, 0.09, 0.0])
sim = armctl.Simulation(arm, "computed-torque-observer")
beside = armctl.Pose(box - way, rpy=[np.pi, 0.0, 0.0])
sim.reset(armctl.solve_ik(arm, beside, np.zeros(arm.n), free_axis="z").q)

goal = armctl.Pose(box + way, rpy=[0.0, 0.0, 0.2])
result = armctl.push(sim, "box", goal, seed=1)
print(result.ok, f"after {result.duration:.1f} s: {1e3 * result.position_error:.1f} mm and {result.angle_error:.2f} rad")
