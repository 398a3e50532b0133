"""Joints tied together: a telescope of four slides that one motor moves counts as one joint of the arm."""

from pathlib import Path

import numpy as np

import armctl

path = Path(__file__).parent / "models" / "telescope.xml"
for chain in armctl.chains(path):
    print(f"{chain.base} to {chain.tip}: {', '.join(chain.joint_names)}; {', '.join(chain.followers)} go along")

arm = armctl.load(path)
print(f"slide0 makes {arm.gear[2]:g} N for each of its motor's, and goes to {arm.limits.q_max[2]} m")
target = armctl.Pose([0.5, 0.6, 0.5], rpy=[0, 0, 1.0])
print(armctl.solve_ik(arm, target))

sim = armctl.Simulation(arm)
print(sim.move_to(target))
slides = [float(sim.data.joint(f"slide{k}").qpos[0]) for k in range(4)]
print("the four slides are out by", ", ".join(f"{1e3 * slide:.1f}" for slide in slides), "mm, within", end=" ")
print(f"{1e6 * np.ptp(slides):.1g} um of each other")
print(armctl.Report.from_log(sim.log))
