"""Pick and place as calls: grasps of many shapes by several grippers, and one sentence for what cannot be done."""

import numpy as np
import pytest
from arms import MISSING, at_hand, some_of
from gantry import GANTRY

import armctl

TOP = 0.1  # m, of the table


def scene() -> armctl.World:
    """A table with bodies on it that a hand of 80 mm can hold or not."""
    return (
        armctl.World()
        .add("table", armctl.Box([0.8, 0.8, 0.1]), [0, 0, 0.05])
        .add("brick", armctl.Box([0.1, 0.04, 0.05]), armctl.Pose([0.1, 0.1, TOP + 0.025], rpy=[0, 0, 0.4]), mass=0.1)
        .add("crate", armctl.Box([0.12, 0.13, 0.14]), [-0.25, 0.25, TOP + 0.07], mass=0.2)
        .add("far", armctl.Box([0.04] * 3), [1.5, 0, 0.02], mass=0.1)
        .add("heavy", armctl.Box([0.04] * 3), [-0.1, 0.0, TOP + 0.02], mass=30.0)
        .add("pyramid", armctl.Mesh(0.05 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])), [0.3, 0.3, TOP], mass=0.1)
        .add("post", armctl.Box([0.04, 0.04, 0.1]), [0.3, -0.3, TOP + 0.05])
        .add("cornered", armctl.Box([0.04] * 3), [-0.25, -0.25, TOP + 0.02], mass=0.1)
        .add("west", armctl.Box([0.01, 0.2, 0.12]), [-0.276, -0.25, TOP + 0.06])
        .add("south", armctl.Box([0.2, 0.01, 0.12]), [-0.2, -0.276, TOP + 0.06])
    )


@pytest.fixture(scope="module")
def gantry(tmp_path_factory: pytest.TempPathFactory) -> armctl.Arm:
    path = tmp_path_factory.mktemp("gantry") / "gantry.xml"
    path.write_text(GANTRY)
    return armctl.load(path, scene=scene())


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> armctl.Arm:
    """The same arm that knows nothing of the scene."""
    path = tmp_path_factory.mktemp("bare") / "gantry.xml"
    path.write_text(GANTRY)
    return armctl.load(path)


def test_a_brick_is_picked_and_placed_and_nothing_else_is_touched(gantry: armctl.Arm):
    sim = armctl.Simulation(gantry)
    picked = sim.pick("brick")
    assert picked, picked.reason
    assert picked.held
    assert picked.touched == ()
    assert picked.grasp is not None
    assert picked.grasp.width == pytest.approx(0.04)
    assert "from above" in str(picked)
    assert sim.gripper.held == "brick"
    assert sim.data.body("brick").xpos[2] > TOP + 0.06
    placed = sim.place("brick", [0.0, -0.1, TOP + 0.025])
    assert placed, placed.reason
    assert placed.touched == ()
    assert sim.gripper.held == ""
    assert np.linalg.norm(sim.data.body("brick").xpos - [0.0, -0.1, TOP + 0.025]) < 2e-3
    upright = sim.data.body("brick").xmat.reshape(3, 3)[2, 2]
    assert upright > 0.999


def test_a_body_is_put_into_a_region_and_a_pose(gantry: armctl.Arm):
    sim = armctl.Simulation(gantry)
    assert sim.pick("brick")
    board = armctl.Box([0.2, 0.1, 0.02])
    region = armctl.Region.on(board, [0.2, 0.0, TOP - 0.01], height=0.025, upright=True)
    placed = sim.place("brick", region)
    assert placed, placed.reason
    assert placed.pose is not None
    assert region.contains(placed.pose)
    assert sim.pick("brick")
    goal = armctl.Pose([-0.1, 0.1, TOP + 0.025], rpy=[0, 0, 1.0])
    placed = sim.place("brick", goal)
    assert placed, placed.reason
    body = sim.data.body("brick")
    position, angle = armctl.Pose(body.xpos, body.xquat).distance(goal)
    assert position < 3e-3
    assert angle < 0.03


@pytest.mark.parametrize(("gap", "is_free"), [(5e-4, False), (3e-3, True)])
def test_a_body_is_put_on_what_it_touches_but_not_against_it(gantry: armctl.Arm, gap: float, is_free: bool):
    sim = armctl.Simulation(gantry)
    assert sim.pick("brick")
    post_side = 0.3 - 0.02
    placed = sim.place("brick", armctl.Pose([post_side - 0.05 - gap, -0.3, TOP + 0.025]))
    assert placed.ok == is_free, placed.reason
    if not is_free:
        assert "brick touches post" in placed.reason
        assert sim.gripper.held == "brick"


def test_a_carried_body_is_a_payload_of_plans_and_a_part_of_proofs(gantry: armctl.Arm):
    sim = armctl.Simulation(gantry)
    assert sim.pick("brick")
    low = armctl.Pose([0.3, -0.15, TOP + 0.12], rpy=[np.pi, 0, 0])
    beside = sim.move_to(armctl.Pose([0.3, -0.29, TOP + 0.12], rpy=[np.pi, 0, 0]))
    assert not beside  # the brick would be in the post; the open hand above it would not
    assert "brick" in beside.reason
    assert sim.move_to(low), "the brick has room there"


@pytest.mark.parametrize(
    ("body", "error", "words"),
    [
        ("cub", armctl.UnknownNameError, "cub"),
        ("post", armctl.InputError, "post is fixed"),
        ("hand", armctl.InputError, "part of the robot"),
        ("pyramid", armctl.InputError, "pyramid has no two opposite sides that pads can press on"),
        ("crate", armctl.InputError, "crate is 120 mm wide where it is narrowest, and the gripper opens 80 mm"),
    ],
)
def test_a_body_that_cannot_be_picked_is_refused_in_one_sentence(
    gantry: armctl.Arm, body: str, error: type[Exception], words: str
):
    with pytest.raises(error, match=words):
        armctl.Simulation(gantry).pick(body)


@pytest.mark.parametrize(
    ("body", "words"),
    [("far", "out of reach"), ("cornered", "touches"), ("heavy", "N to hold the body, and its limit is 200 N")],
)
def test_what_no_grasp_reaches_is_a_result_with_the_reason(gantry: armctl.Arm, body: str, words: str):
    sim = armctl.Simulation(gantry)
    result = sim.pick(body)
    assert not result
    assert words in result.reason
    assert not result.held
    assert result.moves == ()
    assert sim.log is None  # nothing has moved


def test_a_full_hand_picks_nothing_and_an_empty_one_places_nothing(gantry: armctl.Arm):
    sim = armctl.Simulation(gantry)
    with pytest.raises(armctl.InputError, match="brick is not in the gripper, it holds nothing"):
        sim.place("brick", [0, 0, TOP + 0.025])
    assert sim.pick("brick")
    with pytest.raises(armctl.InputError, match="the gripper already holds brick"):
        sim.pick("far")
    with pytest.raises(armctl.InputError, match="force: 1000 N is more than the maximum of this gripper"):
        armctl.Simulation(gantry).pick("brick", force=1000)
    inside = sim.place("brick", [0, 0, TOP])
    assert not inside
    assert "table" in inside.reason
    assert sim.gripper.held == "brick"


def test_an_arm_without_a_gripper_and_a_body_that_is_only_seen_are_refused(gantry: armctl.Arm):
    with pytest.raises(armctl.ModelError, match="no gripper"):
        armctl.Simulation("robot_arm_3dof").pick("cube")
    sim = armctl.Simulation(gantry)
    sim.world.add("seen", armctl.Box([0.04] * 3), [0, 0.3, TOP + 0.02])
    with pytest.raises(armctl.InputError, match="seen is only seen"):
        sim.pick("seen")


@pytest.mark.parametrize("seen", [pytest.param(False, marks=pytest.mark.full), True])
def test_a_robot_picks_and_places_what_its_model_or_its_world_has(gantry: armctl.Arm, bare: armctl.Arm, seen: bool):
    link = armctl.links.PlantLink(gantry)
    robot = armctl.Robot(bare if seen else gantry, link, speed=1.0, tip_speed=1.0)
    if seen:
        for name, body in scene().snapshot().bodies.items():
            robot.world.add(name, body.shape, body.pose, mass=body.mass)
    picked = robot.pick("brick")
    assert picked, picked.reason
    assert picked.held
    assert not robot.move_to(armctl.Pose([0.3, -0.29, TOP + 0.12], rpy=[np.pi, 0, 0])), "the brick would be in the post"
    with pytest.raises(armctl.InputError, match="already holds brick"):
        robot.pick("far")
    placed = robot.place("brick", [0.0, -0.1, TOP + 0.025])
    assert placed, placed.reason
    assert np.isnan(placed.position_error)
    where = robot.world["brick"].pose.position if seen else robot.data.body("brick").xpos
    assert where == pytest.approx([0.0, -0.1, TOP + 0.025], abs=1e-6)
    assert robot.pick("brick"), "it is where the robot put it"


# A frustum whose sides lean by 10 degrees
FRUSTUM = [[x, y, z] for z, half in ((-0.03, 0.022), (0.03, 0.012)) for x in (-half, half) for y in (-half, half)]
SHAPES = {  # and the height of the middle above what it stands on
    "box": (armctl.Box([0.05, 0.03, 0.06]), 0.03),
    "plate": (armctl.Box([0.1, 0.06, 0.02]), 0.01),
    "can": (armctl.Cylinder(0.028, 0.11), 0.055),
    "ball": (armctl.Ball(0.024), 0.024),
    "hull": (armctl.Mesh(FRUSTUM), 0.03),
}
ARMS = {"panda": {}, "ur5e": {"tool": "robotiq_2f85"}, "xarm7": {}, "gen3": {"tool": "robotiq_2f85"}}


@pytest.mark.parametrize("shape", some_of(SHAPES, ["hull"]))
@pytest.mark.parametrize("robot", some_of(ARMS, ["panda"]))
def test_shapes_are_picked_by_arms_of_menagerie(robot: str, shape: str):
    if not all(map(at_hand, [robot, *ARMS[robot].values()])):
        pytest.skip(f"{robot}: {MISSING}")
    body, height = SHAPES[shape]
    place = [0.45, 0.1, 0.2 + height]
    around = armctl.World().add("table", armctl.Box([0.4, 0.8, 0.2]), [0.55, 0, 0.1]).add("body", body, place, mass=0.1)
    sim = armctl.Simulation(armctl.load(robot, scene=around, **ARMS[robot]))
    picked = sim.pick("body")
    assert picked, picked.reason
    assert picked.touched == ()
    assert sim.gripper.held == "body"
    placed = sim.place("body", [0.5, -0.1, 0.2 + height], tolerance=0.02)  # a ball rolls
    assert placed, placed.reason
    assert placed.touched == ()


def test_the_center_between_the_pads_is_where_the_hand_holds(gantry: armctl.Arm):
    from armctl.model.gripper.grip_frames import grip_frames
    from armctl.model.gripper.gripper_model import find_gripper_model

    frames = grip_frames(gantry, find_gripper_model(gantry))
    assert frames.width_max == pytest.approx(0.08)
    assert frames.centers == pytest.approx(np.tile([0, 0, -0.015], (len(frames.width), 1)), abs=1e-6)
    assert np.abs(frames.closing) == pytest.approx([0, 1, 0], abs=1e-6)
    assert frames.pointing == pytest.approx([0, 0, 1], abs=1e-6)
    assert frames.depth == pytest.approx(0.025)


def test_a_jaw_that_turns_holds_at_its_end():
    if not at_hand("so_arm100"):
        pytest.skip(f"so_arm100: {MISSING}")
    can = armctl.World().add("can", armctl.Cylinder(0.0125, 0.05), [0.0, -0.24, 0.025], mass=0.03)
    sim = armctl.Simulation(armctl.load("so_arm100", scene=can))
    picked = sim.pick("can")
    assert picked, picked.reason
    assert picked.touched == ()
    assert sim.data.body("can").xpos[2] > 0.06
