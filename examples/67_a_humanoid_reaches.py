"""A humanoid reaches with both hands while its feet stay where they are. Kinematics only: nothing balances here."""

import numpy as np

import armctl
from armctl import STAY

robot = armctl.load("unitree_h1", base="free")
feet = ("left_ankle_link", "right_ankle_link")
hands = ("left_elbow_link", "right_elbow_link")
standing = {foot: robot.fk(robot.home, foot) for foot in feet}
reach = {hand: robot.fk(robot.home, hand).position + np.array([0.25, 0.0, -0.35]) for hand in hands}

ik = armctl.DifferentialIk(robot)
q = robot.home
slips = []
for _ in range(1500):
    q = q + 0.004 * ik.step(q, reach | dict.fromkeys(feet, STAY), 0.004)
    slips.append(max(np.linalg.norm(robot.fk(q, foot).position - standing[foot].position) for foot in feet))
for hand, point in reach.items():
    print(f"{hand} is at its target: {np.linalg.norm(robot.fk(q, hand).position - point) < 1e-5}")
print(f"the feet moved by less than 0.1 um: {max(slips) < 1e-7}; the pelvis went {1e3 * (robot.home - q)[2]:.0f} mm down")
