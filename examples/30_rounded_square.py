"""The Panda draws a square with rounded corners without stopping; outside the corners the lines are exact."""

import numpy as np

import armctl

sim = armctl.Simulation("panda")
home = sim.tip
ways = [0, 0.1, 0], [0, 0.1, -0.2], [0, -0.1, -0.2], [0, -0.1, 0]
corners = [armctl.Pose(home.position + way, quat=home.quat) for way in ways]
result = sim.move_path([*corners, home], blend=0.03, tip_speed=0.5)
print(result)

tip = sim.log.tip[:, :3] - home.position
inside = np.minimum(np.abs(np.abs(tip[:, 1]) - 0.1), np.abs(np.abs(tip[:, 2] + 0.1) - 0.1))
corner = np.linalg.norm(np.abs(tip[:, 1:] + [0, 0.1]) - 0.1, axis=1)
print(f"off the sides, outside the corners: {1e6 * inside[corner > 0.03].max():.4f} um")
print(f"rounded at the corners by up to {1e3 * corner.min():.1f} mm")
print(armctl.Report.from_log(sim.log))
