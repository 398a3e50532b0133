"""Two arms in one simulation: ALOHA's left arm hands a stick over to its right arm."""

import numpy as np

import armctl

LEFT, RIGHT = "left/gripper", "right/gripper"


def down(*position: float) -> armctl.Pose:
    """A tip that points down, its fingers to either side of the stick."""
    return armctl.Pose.from_rotation(np.array(position), np.column_stack([[0, 0, -1], [1, 0, 0], [0, -1, 0]]))


def show(results: dict[str, armctl.MoveResult]) -> None:
    print(", ".join(f"{tip} {result}" for tip, result in results.items()))


scene = armctl.Scene().add_box("stick", [0.02, 0.22, 0.02], at=[-0.12, 0, 0.01], mass=0.05)
team = armctl.Team(armctl.load_arms("aloha", [LEFT, RIGHT], scene=scene))
left, right = team.gripper(LEFT), team.gripper(RIGHT)
print("open:", left.open(), right.open())
show(team.move_to({LEFT: down(-0.12, -0.08, 0.15)}))
show(team.move_to({LEFT: down(-0.12, -0.08, 0.025)}))
print("left:", left.grasp(10))
show(team.move_to({LEFT: down(-0.12, -0.08, 0.15)}))
show(team.move_to({LEFT: down(0, -0.08, 0.15), RIGHT: down(0, 0.08, 0.28)}))
show(team.move_to({RIGHT: down(0, 0.08, 0.137)}))
print("right:", right.grasp(10))
print("left:", left.open())
show(team.move_to({LEFT: down(-0.1, -0.08, 0.35)}))
results = team.move_to({RIGHT: down(0.12, 0.08, 0.15)})
show(results)
print(f"the stick is {team.data.body('stick').xpos.round(3)} m, in the right hand")
print(armctl.Report.from_log(results[RIGHT].log))
