"""Film a move, plot it, and compare it with the same move under another controller."""

import sys
from pathlib import Path

import armctl
from armctl.report.plot import overlay

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
logs = []
for controller in ("pd", "computed-torque"):
    sim = armctl.Simulation("robot_arm_3dof", controller)
    logs.append(sim.move_to(sim.target).log)

try:
    sim.record(folder / "reach.gif", size=(320, 240))
except armctl.NotInstalledError as error:
    print(f"no film: {error}")
overlay(logs, folder / "overlay.png")

print(armctl.Report.from_log(logs[-1]))
