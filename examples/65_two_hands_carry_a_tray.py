"""Two arms hold one tray: the right hand stays where it is on the tray while the left one takes it along a curve."""

import numpy as np

import armctl
from armctl import Pose, RelativeTo

arm = armctl.load("aloha")
left, right = arm.tips
start = {tip: arm.fk(arm.home, tip) for tip in arm.tips}
on_the_tray = start[left].inverse() @ start[right]

configurations = [arm.home]
for phase in np.linspace(0.0, 2.0 * np.pi, 200)[1:]:
    shift = np.array([0.04 * np.sin(phase), 0.05 * (1.0 - np.cos(phase)), 0.03 * np.sin(2.0 * phase)])
    goal = {left: Pose(start[left].position + shift, quat=start[left].quat), right: RelativeTo(left, on_the_tray)}
    found = armctl.solve_ik(arm, goal, configurations[-1])
    assert found, found.reason
    configurations.append(found.q)
motion = armctl.move_through(arm, np.array(configurations))

slips = []
for t in np.linspace(0.0, motion.duration, 2000):
    q = motion(t).q
    between = arm.fk(q, left).inverse() @ arm.fk(q, right)
    slips.append(np.linalg.norm(between.position - on_the_tray.position))
print(f"{motion.duration:.2f} s; the right hand slips by less than 1 um on the tray: {max(slips) < 1e-6}")
print(armctl.check_clearance(arm, motion))
log = armctl.simulate(arm, "computed-torque", motion)
print(f"computed torque of {arm.n} joints: within 1e-9 rad of the motion: {np.abs(log.q - log.q_ref).max() < 1e-9}")
