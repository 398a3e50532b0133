"""Pick and place: a 4 cm cube from anywhere on a table, put down within 2 mm."""

import numpy as np
import pytest
from arms import at_hand

import armctl

DOWN = [np.pi, 0, 0]
HEIGHT = 0.22  # m, the cube's centre on the table
CELLS = {  # robot: how it is loaded, the table, the lowest and the highest place
    "panda": ({}, ([0.5, 0.9, 0.2], [0.5, 0, 0.1]), ([0.4, -0.3], [0.6, 0.3])),
    "ur5e": ({"tool": "robotiq_2f85"}, ([1.0, 0.6, 0.2], [0, 0.65, 0.1]), ([-0.3, 0.4], [0.3, 0.6])),
}


@pytest.fixture(scope="module", params=CELLS)
def cell(request: pytest.FixtureRequest) -> tuple[armctl.Arm, np.ndarray]:
    """An arm at a table with a cube, and the corners of where it may lie."""
    how, table, corners = CELLS[request.param]
    if not all(map(at_hand, [request.param, *how.values()])):
        pytest.skip(f"{request.param}: its model is not at hand")
    scene = armctl.Scene().add_box("table", *table).add_box("cube", [0.04] * 3, np.append(corners[0], HEIGHT), mass=0.1)
    return armctl.load(request.param, scene=scene, **how), np.array(corners)


@pytest.mark.parametrize("place", range(20))
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
        sim.move_to(armctl.Pose(point, rpy=DOWN), tolerance=3e-3)
    assert sim.gripper.open()
    assert sim.move_to(armctl.Pose(goal + above, rpy=DOWN))
    assert np.linalg.norm(sim.data.body("cube").xpos - goal) < 2e-3
