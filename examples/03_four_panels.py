"""One run in four panels: joint angles, joint velocities, torques with their limits, and the tip over time."""

import sys
import tempfile
from pathlib import Path

import armctl

folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
sim = armctl.Simulation("robot_arm_3dof")
sim.move_to([0.3, 0.2, 0.3])
report = armctl.Report.from_log(sim.log)
print(f"drawn: {report.plot(folder / 'four_panels.png')}")
print(report)
