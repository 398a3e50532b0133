"""Your own robot: from a plain URDF to a tracked Cartesian target."""

from pathlib import Path

import numpy as np

import armctl

path = Path(__file__).parent / "models" / "desk_arm.urdf"
for chain in armctl.chains(path):
    print(f"{chain.base} to {chain.tip}: {', '.join(chain.joint_names)} {chain.reason}")

arm = armctl.load(path)  # limits, damping and the tool's frame come from the file
for note in arm.notes:
    print("assumed:", note)
print(f"{arm.n} joints, tip {arm.tip!r}, {arm.limits.tau_max} N m by {arm.sources['tau_max']}")

target = armctl.Pose([0.35, 0.2, 0.45], rpy=[0, np.pi / 2, 0.5])
print(armctl.solve_ik(arm, target))
sim = armctl.Simulation(arm)
print(sim.move_to(target))
print(armctl.Report.from_log(sim.log))
