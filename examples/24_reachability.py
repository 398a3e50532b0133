"""The points that an arm reaches, and with how many orientations: a map, saved, drawn, and as colored points."""

import tempfile
from pathlib import Path

import armctl

arm = armctl.load("robot_arm_3dof")

reach = armctl.reachability(
    arm, spacing=0.05
)  # three joints: points only; arms of six joints get 32 orientations at each point
print(reach)
best = reach.manipulability.argmax()
print(f"most dexterous at {reach.points[best].round(3)} m: {reach.manipulability[best]:.3g}")

with tempfile.TemporaryDirectory() as folder:
    reach.save(Path(folder) / "reach.npz")
    reach.plot(Path(folder) / "reach.png", "manipulability")
    again = armctl.Reachability.load(Path(folder) / "reach.npz")

points, colours = again.cloud("manipulability")  # for viser's scene.add_point_cloud("reach", points, colours, point_size=0.02)
print(f"a cloud of {len(points)} points, the brightest is {colours.max(axis=0)}")
