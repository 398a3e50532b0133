"""The arm finds a green ball with three cameras, and goes there around what it sees."""

from pathlib import Path

import numpy as np

import armctl

sim = armctl.Simulation(armctl.load("robot_arm_3dof", scene=Path(__file__).parent / "models" / "seen.xml"))
green = []
seen = []
for name in ("seen/above", "seen/right", "seen/left"):
    image = sim.camera(name)
    red, green_part, blue = image.colour[image.is_seen].astype(float).T
    is_green = green_part > 3.0 * np.maximum(red, blue)
    green.append(image.points[is_green])
    seen.append(image.points[~is_green])
surface = np.concatenate(green)
goal = 0.5 * (surface.min(axis=0) + surface.max(axis=0))
print(f"the green ball is at ({', '.join(f'{x:.2f}' for x in goal)}) m")

# The arm that plans knows no scene: what is around it is what the cameras see, without the arm itself and the floor.
arm = armctl.load("robot_arm_3dof")
points = armctl.robot_filter(arm, sim.state.q, np.concatenate(seen))
points = points[(points[:, 2] > -0.03) & (np.linalg.norm(points - goal, axis=1) > 0.05)]
world = armctl.World().add("seen", armctl.Points.on_grid(points, 0.01))
motion = armctl.move_free(arm, sim.state.q, armctl.Target.read(goal), world=world)
log = sim.run(motion)
error = np.linalg.norm(sim.tip.position - [0.3, 0.25, 0.35])
print(f"around {len(world['seen'].shape)} points to {1e3 * error:.0f} mm from its center; touched {len(log.contacts)} bodies")
