"""Open a door: the hand holds the handle, goes along its arc, and turns in it as far as it may."""

from pathlib import Path

import numpy as np

import armctl

TURN = np.radians(-60)
HANDLE = armctl.Pose([0.675, -0.05, 0.45], rpy=[0, np.pi / 2, 0])
PLAY = np.outer([0, 0, 0, 0.5, 0, 0], [-1, 1])  # the hand may roll by 0.5 rad about the handle

arm = armctl.load("panda", scene=Path(__file__).parent / "models" / "door.xml")
sim = armctl.Simulation(arm, "computed-torque-observer")
print("open: ", sim.gripper.open())
print("front:", sim.move_to(HANDLE @ armctl.Pose([0, 0, -0.08])))
print("there:", sim.move_l(HANDLE, allow=[("left_finger", "door"), ("right_finger", "door"), ("hand", "door")]))
print("grasp:", sim.gripper.grasp(30.0))

hinge = sim.data.joint("hinge").xanchor
arc = [sim.tip.turned_about(hinge, [0, 0, 1], share * TURN) for share in np.linspace(0, 1, 100)]
held = armctl.Region.union(armctl.Region(pose, PLAY) for pose in arc)
print("turn: ", sim.move_path(held, tip_speed=0.15, avoid=False))
print(f"the door is open by {np.degrees(-sim.data.joint('hinge').qpos[0]):.0f} degrees")
