"""PD, PD with gravity and computed torque follow the same motion: a table, and the paths of the tip in one plot."""

import tempfile
from pathlib import Path

import armctl
from armctl.lab.comparison import out_and_back
from armctl.report.plot import overlay
from armctl.report.report import table

arm = armctl.load("robot_arm_3dof")
names = ["pd", "pd-gravity", "computed-torque-textbook", "computed-torque"]
reports = armctl.compare(arm, names, out_and_back(arm))

picture = Path(tempfile.gettempdir()) / "pd_against_computed_torque.png"
overlay([report.log for report in reports], picture, labels=names)
print(table(reports))
