"""Tool paths: every point is passed with the tool inside its cone, within all limits, and a break is named."""

import numpy as np
import pytest
from arms import MISSING, arm_of, at_hand
from collidable import arm_among
from scipy.spatial import KDTree

import armctl
from armctl import InputError, PlanError, Pose, Region

COUNT = 300
ANGLE = np.linspace(0.0, 2 * np.pi, COUNT)
CIRCLE = np.column_stack([0.25 + 0.08 * np.cos(ANGLE), 0.08 * np.sin(ANGLE), 0.2 + 0.02 * np.cos(2 * ANGLE)])
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> armctl.Arm:
    return arm_among(tmp_path_factory.mktemp("tool"), "")


def assert_passed(arm: armctl.Arm, motion: armctl.JointTrajectory, points: np.ndarray, normal: np.ndarray, cone: float) -> None:
    """Every point is passed within 10 um, with the z axis in the cone around the opposite of the normal."""
    positions, rotations = arm.fk_many(motion.sample(np.linspace(0.0, motion.duration, 40_001)).q)
    tilts = np.arccos(np.clip(-(rotations[:, :, 2] @ normal), -1.0, 1.0))
    assert tilts.max() <= cone + 1e-4
    _, nearest = KDTree(positions).query(points)
    nearest = np.clip(nearest, 1, len(positions) - 2)
    distances = []
    for begin, end in ((positions[nearest - 1], positions[nearest]), (positions[nearest], positions[nearest + 1])):
        way = end - begin
        share = np.clip(((points - begin) * way).sum(axis=1) / np.maximum((way**2).sum(axis=1), 1e-30), 0.0, 1.0)
        distances.append(np.linalg.norm(points - begin - share[:, None] * way, axis=1))
    assert np.minimum(*distances).max() < 1e-5


@pytest.mark.parametrize("cone", [0.0, 0.26])
def test_all_points_are_passed_inside_the_cone_and_all_limits(arm, cone):
    motion = armctl.move_path(arm, None, CIRCLE, normals=UP, cone=cone)
    assert_passed(arm, motion, CIRCLE, UP, cone)
    assert motion.check_limits().ok
    assert armctl.check_torque(arm, motion).ok
    np.testing.assert_allclose(motion(motion.duration).v, 0.0, atol=1e-9)


def test_freedom_makes_the_joint_path_shorter_and_not_longer(arm):
    def length(**freedom: float) -> float:
        q = armctl.move_path(arm, None, CIRCLE, normals=UP, **freedom).sample(np.linspace(0.0, 1.0, 2000)).q
        return float(np.linalg.norm(np.diff(q, axis=0), axis=1).sum())

    assert length(cone=0.4) < length()


def test_poses_points_and_a_region_are_the_same_path(arm):
    poses = [Pose(point, rpy=[np.pi, 0.0, 0.0]) for point in CIRCLE]
    by_pose = armctl.move_path(arm, None, poses, free="z")
    by_region = armctl.move_path(arm, None, Region.union(Region(pose, free="z") for pose in poses))
    assert by_pose.coefficients.tobytes() == by_region.coefficients.tobytes()
    assert_passed(arm, by_pose, CIRCLE, UP, 0.0)


def test_it_starts_where_it_is_told(arm):
    q = armctl.solve_ik(arm, Region.of(CIRCLE[0], UP), position_tolerance=1e-10, orientation_tolerance=1e-10).q
    motion = armctl.move_path(arm, q, CIRCLE, normals=UP)
    np.testing.assert_allclose(motion(0.0).q, q, atol=1e-6)
    with pytest.raises(PlanError, match=r"point 0 of 300.*not there at q_start"):
        armctl.move_path(arm, arm.home, CIRCLE, normals=UP)


def test_a_path_of_one_point_stands_there(arm):
    pose = arm.fk(arm.home)
    motion = armctl.move_path(arm, None, [pose], free="z")
    assert motion.duration == 0.0
    assert_passed(arm, motion, pose.position[None], -pose.rotation[:, 2], 0.0)


def test_points_far_apart_are_joined_by_lines(arm):
    corners = np.array([[0.2, -0.1, 0.2], [0.3, 0.1, 0.2]])
    motion = armctl.move_path(arm, None, corners, normals=UP)
    positions = arm.fk_many(motion.sample(np.linspace(0.0, motion.duration, 500)).q)[0]
    way = (corners[1] - corners[0]) / np.linalg.norm(corners[1] - corners[0])
    away = positions - corners[0]
    assert np.linalg.norm(away - np.outer(away @ way, way), axis=1).max() < 1e-4


def test_the_first_point_that_breaks_a_path_is_named(arm):
    outwards = np.column_stack([np.linspace(0.25, 3.0, COUNT), np.zeros(COUNT), np.full(COUNT, 0.2)])
    with pytest.raises(PlanError, match=r"point \d+ of 300, at .* m: ") as refused:
        armctl.move_path(arm, None, outwards, normals=UP)
    number = int(str(refused.value).split()[1])
    assert 5 < number < COUNT
    armctl.move_path(arm, None, outwards[: number - 5], normals=UP)


def test_a_simulated_tool_path_is_followed(arm):
    sim = armctl.Simulation(arm)
    motion = armctl.move_path(arm, None, CIRCLE, normals=UP, cone=0.2)
    assert sim.move_j(motion(0.0).q).ok
    result = sim.move_path(CIRCLE, normals=UP, cone=0.2)
    assert result.ok, result.reason


EIGHT = np.column_stack([0.45 + 0.1 * np.sin(ANGLE), 0.1 * np.sin(2 * ANGLE), np.full(COUNT, 0.4)])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"path": EIGHT, "normals": UP}, "path: it crosses itself at"),
        ({"path": np.empty((0, 3)), "normals": UP}, "points: there is none"),
        ({"path": [], "free": "z"}, "path: it is empty"),
        ({"path": CIRCLE, "free": "z"}, "path: .*normals"),
        ({"path": CIRCLE, "normals": UP, "free": "up"}, "free: "),
        ({"path": CIRCLE, "normals": UP, "blend": 0.1}, "blend: "),
        ({"path": CIRCLE, "normals": UP, "cone": -0.1}, "cone: "),
        ({"path": Region([0.4, 0.0, 0.4], free="z"), "free": "z"}, "free: the parts of a region"),
        ({"path": [Pose([0.4, 0.0, 0.4])]}, "q_start: only a tool path"),
    ],
)
def test_wrong_tool_paths_are_one_sentence(arm, arguments, message):
    with pytest.raises(InputError, match=message):
        armctl.move_path(arm, None, **arguments)


def test_the_tip_stays_on_its_way_between_points_where_the_joints_move_fast():
    """A hand that may roll by 0.5 rad about a handle has to move its other joints on a short piece of the arc."""
    if not at_hand("panda"):
        pytest.skip(f"panda: {MISSING}")
    panda = arm_of("panda")
    q = [0.7143, 0.2735, -0.9686, -1.9979, 2.7665, 2.4684, 1.3148]
    hinge, tip = np.array([0.7765, 0.2270, 0.4091]), panda.fk(q)
    play = np.outer([0, 0, 0, 0.5, 0, 0], [-1, 1])
    arc = [tip.turned_about(hinge, [0, 0, 1], angle) for angle in np.linspace(0.0, -0.5, 100)]
    motion = armctl.move_path(panda, q, Region.union(Region(pose, play) for pose in arc), tip_speed=0.06)
    at = panda.fk_many(motion.sample(np.linspace(0.0, motion.duration, 10_001)).q)[0]
    assert np.ptp(np.linalg.norm((at - hinge)[:, :2], axis=1)) < 2e-5
    assert np.ptp(at[:, 2]) < 2e-5


@pytest.mark.parametrize("turn", [0.5 * np.pi, 2.2])
def test_a_path_with_a_corner_is_passed(arm, turn: float):
    way = np.linspace(0.0, 0.05, 21)[:, None]
    corner = np.array([0.25, 0.0, 0.2])
    points = np.vstack([corner - way[:0:-1] * [1, 0, 0], corner + way * [np.cos(turn), np.sin(turn), 0]])
    motion = armctl.move_path(arm, None, points, normals=UP, cone=0.1)
    assert_passed(arm, motion, points, UP, 0.1)
