"""A tool slides over a cylinder with a constant force: the force axis turns with the tip, the surface is 1 mm off the plan."""

from pathlib import Path

import mujoco
import numpy as np

import armctl

FORCE = 10.0  # N
RADIUS = 0.3  # m, of the workpiece
center = np.array([0.35, 0.0, -0.1])
tool = mujoco.MjSpec.from_string("""<mujoco model="polisher"><option cone="elliptic"/><worldbody><body name="pad">
  <geom type="sphere" size="0.01" pos="0 0 0.05" mass="0.05" friction="0.2" priority="1"/><site name="tip" pos="0 0 0.05"/>
</body></worldbody></mujoco>""")
scene = armctl.World().add("workpiece", armctl.Cylinder(RADIUS, 0.5), at=armctl.Pose(center, rpy=[0.0, np.pi / 2, 0.0]))
arm = armctl.load(Path(__file__).parent / "models" / "desk_arm.urdf", tool=tool, scene=scene)


def tip_at(angle: float, gap: float) -> armctl.Pose:
    """The tip above the surface, its z axis into it."""
    outward = np.array([0.0, np.sin(angle), np.cos(angle)])
    at = armctl.Pose(center + (RADIUS + 0.01 + gap) * outward, rpy=[np.pi - angle, 0.0, 0.0])
    return at @ armctl.Pose([0.0, 0.0, 0.0], rpy=[0.0, 0.0, 1.5])


start = armctl.solve_ik(arm, tip_at(-0.15, 0.002)).q
planned = [tip_at(angle, 0.001) for angle in np.linspace(-0.1, 0.15, 6)]  # the surface is 1 mm lower
path = armctl.move_path(arm, start, planned, blend=0.005, tip_speed=0.05)
controller = armctl.HybridForce(arm, {"z": FORCE}, frame="tip")
sim = armctl.Simulation(arm, controller, armctl.Plant(timestep=0.001, force_noise=0.2, encoder_noise=1e-5))
sim.reset(start)
sim.run(armctl.move_j(arm, start, start), dwell=0.6)  # until it touches
log = sim.run(path)
normal = (log.tip - center) * [0.0, 1.0, 1.0]
force = (log.wrench[:, :3] * normal).sum(axis=1) / np.linalg.norm(normal, axis=1)  # the true contact force, without noise
print(f"{1e3 * np.linalg.norm(np.diff(log.tip, axis=0), axis=1).sum():.0f} mm along the surface in {log.t[-1]:.1f} s")
print(f"mean force {force.mean():.2f} N, standard deviation {force.std():.2f} N, from {force.min():.1f} to {force.max():.1f} N")
