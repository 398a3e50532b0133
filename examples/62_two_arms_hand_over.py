"""Two arms in one simulation: ALOHA's left arm hands a stick over to its right arm."""

import numpy as np

import armctl

LEFT, RIGHT = "left/gripper", "right/gripper"


def down(*position: float) -> armctl.Pose:
    """A tip that points down, its fingers to either side of the stick."""
    return armctl.Pose.from_rotation(np.array(position), np.column_stack([[0, 0, -1], [1, 0, 0], [0, -1, 0]]))


scene = armctl.World().add("stick", armctl.Box([0.02, 0.22, 0.02]), at=[-0.12, 0, 0.01], mass=0.05)
sim = armctl.Simulation(armctl.load("aloha", scene=scene))
left, right = sim.gripper_at(LEFT), sim.gripper_at(RIGHT)
print("open:", left.open(), right.open())
print(sim.move_to({LEFT: down(-0.12, -0.08, 0.15), RIGHT: armctl.STAY}))
print(sim.move_to({LEFT: down(-0.12, -0.08, 0.025), RIGHT: armctl.STAY}))
print("left:", left.grasp(10))
print(sim.move_to({LEFT: down(-0.12, -0.08, 0.15), RIGHT: armctl.STAY}))
print(sim.move_to({LEFT: down(0, -0.08, 0.15), RIGHT: down(0, 0.08, 0.28)}))
print(sim.move_to({RIGHT: down(0, 0.08, 0.137), LEFT: armctl.STAY}))
print("right:", right.grasp(10))
print("left:", left.open())
print(sim.move_to({LEFT: down(-0.1, -0.08, 0.35), RIGHT: armctl.STAY}))
result = sim.move_to({RIGHT: down(0.12, 0.08, 0.15), LEFT: armctl.STAY})
print(result)
print(f"the stick is {sim.data.body('stick').xpos.round(3)} m, in the right hand")
