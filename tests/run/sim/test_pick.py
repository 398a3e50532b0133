"""Pick and place: a 4 cm cube from anywhere on a table, put down within 2 mm; a stick from one hand to the other."""

import numpy as np
import pytest
from arms import MISSING, at_hand, some_of

import armctl

DOWN = [np.pi, 0, 0]
HEIGHT = 0.22  # m, the cube's centre on the table
CELLS = {  # robot: how it is loaded, the table, the lowest and the highest place
    "panda": ({}, ([0.5, 0.9, 0.2], [0.5, 0, 0.1]), ([0.4, -0.3], [0.6, 0.3])),
    "ur5e": ({"tool": "robotiq_2f85"}, ([1.0, 0.6, 0.2], [0, 0.65, 0.1]), ([-0.3, 0.4], [0.3, 0.6])),
}


@pytest.fixture(scope="module", params=some_of(CELLS))
def cell(request: pytest.FixtureRequest) -> tuple[armctl.Arm, np.ndarray]:
    """An arm at a table with a cube, and the corners of where it may lie."""
    how, table, corners = CELLS[request.param]
    if not all(map(at_hand, [request.param, *how.values()])):
        pytest.skip(f"{request.param}: {MISSING}")
    scene = (
        armctl.World()
        .add("table", armctl.Box(table[0]), table[1])
        .add("cube", armctl.Box([0.04] * 3), np.append(corners[0], HEIGHT), mass=0.1)
    )
    return armctl.load(request.param, scene=scene, **how), np.array(corners)


@pytest.mark.parametrize("place", some_of(range(6), [0, 1]))
def test_a_cube_is_put_down_within_2_mm(cell: tuple[armctl.Arm, np.ndarray], place: int):
    arm, corners = cell
    start, goal = (np.append(xy, HEIGHT) for xy in np.random.default_rng(place).uniform(*corners, (2, 2)))
    sim, above = armctl.Simulation(arm), np.array([0, 0, 0.1])
    sim.data.joint("cube").qpos[:3] = start
    sim.gripper.open()
    for point in (start + above, start):
        assert sim.move_to(armctl.Pose(point, rpy=DOWN))
    grip = sim.gripper.close()
    assert grip.held == "cube", grip
    for point in (start + above, goal + above, goal):
        sim.move_to(armctl.Target.read(armctl.Pose(point, rpy=DOWN), tolerance=3e-3))
    assert sim.gripper.open()
    assert sim.move_to(armctl.Pose(goal + above, rpy=DOWN))
    assert np.linalg.norm(sim.data.body("cube").xpos - goal) < 2e-3


LEFT, RIGHT = "left/gripper", "right/gripper"
END = np.array([0.12, 0, 0.137])  # where the right hand takes the stick


@pytest.fixture(scope="module")
def pair() -> armctl.Arm:
    """ALOHA's two arms and a stick on the table."""
    if not at_hand("aloha"):
        pytest.skip(f"aloha: {MISSING}")
    stick = armctl.World().add("stick", armctl.Box([0.02, 0.22, 0.02]), at=[-0.12, 0, 0.01], mass=0.05)
    return armctl.load("aloha", scene=stick)


def _down(*position: float) -> armctl.Pose:
    """A tip that points down, its fingers to either side of the stick."""
    return armctl.Pose.from_rotation(np.array(position), np.column_stack([[0, 0, -1], [1, 0, 0], [0, -1, 0]]))


@pytest.mark.full
@pytest.mark.parametrize("place", range(2))
def test_one_arm_hands_a_stick_to_the_other(pair: armctl.Arm, place: int):
    x, y = np.random.default_rng(place).uniform([-0.16, -0.02], [-0.08, 0.02])
    sim = armctl.Simulation(pair)
    sim.data.joint("stick").qpos[:2] = x, y
    left, right, stick = sim.gripper_at(LEFT), sim.gripper_at(RIGHT), sim.data.body("stick")
    assert left.open()
    assert right.open()
    for z in (0.15, 0.025):
        assert sim.move_to({LEFT: _down(x, y - 0.08, z), RIGHT: armctl.STAY})
    assert left.grasp(10).held == "stick"
    assert sim.move_to({LEFT: _down(x, y - 0.08, 0.15), RIGHT: armctl.STAY})
    assert sim.move_to({LEFT: _down(0, -0.08, 0.15), RIGHT: _down(0, 0.08, 0.28)})
    assert sim.move_to({RIGHT: _down(0, 0.08, 0.137), LEFT: armctl.STAY})
    assert right.grasp(10).held == "stick"
    assert left.open()
    assert sim.move_to({LEFT: _down(-0.1, -0.08, 0.35), RIGHT: armctl.STAY})
    assert sim.move_to({RIGHT: _down(END[0], 0.08, 0.15), LEFT: armctl.STAY})
    assert right.width == pytest.approx(0.02, abs=1e-3)
    assert np.linalg.norm(stick.xpos - END) < 2e-3
