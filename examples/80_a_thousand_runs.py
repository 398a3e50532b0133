"""A thousand runs: three controllers over payload, friction, delay and noise; the dominant factor, and where each one fails.

`python 80_a_thousand_runs.py` makes 1152 runs; with a folder as its argument it makes 72 and writes into that folder. Stop it
with Ctrl-C and start it again: it continues.
"""

import sys
from pathlib import Path

import armctl

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
study = armctl.Study(
    "a-thousand-runs",
    robot="robot_arm_3dof",
    controllers=["pd-gravity", "computed-torque", "computed-torque-observer"],
    factors={
        "payload": armctl.Range(0.0, 1.0),  # kg, missing in the controllers' models
        "friction": armctl.Range(0.0, 0.02),  # as a fraction of the torque limits
        "delay": [0, 2, 4],  # ticks of 2 ms
        "noise": 1.0,  # 1e-5 rad and 1e-3 rad/s
    },
    samples=8 if len(sys.argv) > 1 else 128,
)
result = study.run(folder=folder)
print(f"{len(result)} runs\n")
print(result.summary(["tip_rms_m"]))
for run in result.worst(3, controller="computed-torque"):
    print(f"worst: {run.row['payload']:.2f} kg, friction {run.row['friction']:.3f}: {1e3 * run.row['tip_rms_m']:.0f} mm RMS")

result.plot_quantiles(folder / "study_quantiles.png", over="payload")
result.plot_tornado(folder / "study_tornado.png")
result.plot_success(folder / "study_success.png", "payload", "friction", metric="tip_rms_m", limit=0.01)
