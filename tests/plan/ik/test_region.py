"""Regions: their samples are in them, the nearest member is the nearest, and IK finds the nearest configuration of all."""

import copy
import pickle

import numpy as np
import pytest
from collidable import arm_among

import armctl
from armctl import Ball, Box, Cylinder, InputError, Pose, Region

FRAME = Pose([0.4, 0.1, 0.4], rpy=[0.3, 0.2, 1.0])
TIP = Pose([0.05, 0.0, 0.1], rpy=[1.0, 0.4, 2.0])
FREE = [-np.inf, np.inf]
KINDS = {
    "one pose": Region(FRAME, tip=TIP),
    "a box of positions": Region(FRAME, [[-0.1, 0.1], [0.0, 0.05], [-0.05, 0.1], [0, 0], [0, 0], [0, 0]], tip=TIP),
    "turned about one axis": Region(FRAME, [[0, 0]] * 5 + [FREE], tip=TIP),
    "bounds of all angles": Region(FRAME, [[0, 0]] * 3 + [[-0.3, 0.1], [-0.2, 0.2], [2.0, 3.0]], tip=TIP),
    "any orientation": Region(FRAME, [[0, 0]] * 3 + [FREE] * 3, tip=TIP),
    "a free axis": Region(FRAME, tip=TIP, free="x"),
    "a cone": Region(FRAME, [[-0.1, 0.0], [0, 0], [0, 0], [0, 0], [0, 0], [0, 0]], tip=TIP, free="z", cone=0.3),
    "around a cylinder": Region.around(Cylinder(0.03, 0.12), FRAME, distance=0.05, margin=0.02),
    "around a ball": Region.around(Ball(0.03), FRAME, distance=0.05),
    "on a box": Region.on(Box([0.2, 0.3, 0.02]), FRAME, height=0.1, margin=0.02),
    "on a cylinder": Region.on(Cylinder(0.1, 0.2), FRAME),
    "on a seam": Region.of([[0.4, 0.0, 0.3], [0.4, 0.1, 0.3], [0.4, 0.2, 0.35]], [0.0, 0.2, 1.0], cone=0.2),
}
every_kind = pytest.mark.parametrize("kind", KINDS)


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> armctl.Arm:
    return arm_among(tmp_path_factory.mktemp("region"))


def poses(count: int, seed: int = 0) -> list[Pose]:
    rng = np.random.default_rng(seed)
    return [Pose(rng.uniform(-1.0, 1.0, 3), rng.normal(size=4)) for _ in range(count)]


@every_kind
def test_samples_are_members_and_their_own_nearest_member(kind):
    region = KINDS[kind]
    samples = region.sample(60, seed=1)
    assert len(samples) == 60
    for sample in samples:
        assert region.contains(sample)
        assert max(region.nearest(sample).pose.distance(sample)) < 1e-9


@every_kind
def test_the_nearest_member_of_any_pose_is_a_member(kind):
    region = KINDS[kind]
    for pose in poses(50):
        nearest = region.nearest(pose)
        assert region[nearest.index].contains(nearest.pose)


@pytest.mark.parametrize("kind", ["any orientation", "a free axis", "a cone"])
def test_no_member_of_a_cone_is_turned_less_than_the_nearest(kind):
    region = KINDS[kind]
    samples = region.sample(400, seed=2)
    for pose in poses(20):
        turned = region.nearest(pose).pose.distance(pose)[1]
        assert turned <= min(sample.distance(pose)[1] for sample in samples) + 1e-9


@pytest.mark.parametrize("axis", "xyz")
def test_a_cone_holds_the_tilt_of_the_axis_and_nothing_else(axis):
    region = Region(FRAME, tip=TIP, free=axis, cone=0.3)
    column = "xyz".index(axis)
    middle = (FRAME @ TIP).rotation[:, column]
    tilts = [np.arccos(np.clip(pose.rotation[:, column] @ middle, -1.0, 1.0)) for pose in region.sample(300)]
    assert max(tilts) <= 0.3 + 1e-9
    assert max(tilts) > 0.28
    assert min(tilts) < 0.1


@pytest.mark.parametrize("closing", "xy")
def test_a_grasp_around_a_cylinder_points_to_its_axis_and_closes_across_it(closing):
    place = Pose([0.5, 0.2, 0.3], rpy=[0.4, -0.3, 0.2])
    region = Region.around(Cylinder(0.03, 0.12), place, distance=0.02, margin=0.01, closing=closing)
    along = place.rotation[:, 2]
    flips = set()
    for pose in region.sample(200):
        to_axis = place.position - pose.position
        height = to_axis @ along
        assert abs(height) <= 0.05 + 1e-9
        np.testing.assert_allclose(to_axis - height * along, 0.02 * pose.rotation[:, 2], atol=1e-9)
        assert abs(pose.rotation[:, "xyz".index(closing)] @ along) < 1e-9
        flips.add(round(float(pose.rotation[:, "yx".index(closing)] @ along)))
    assert flips == {-1, 1}


@every_kind
def test_ik_ends_in_the_region_and_says_where(arm, kind):
    region = KINDS[kind]
    result = armctl.solve_ik(arm, region)
    assert result.ok, result.reason
    tip = arm.fk(result.q)
    assert region.contains(tip, position_tolerance=1e-5, orientation_tolerance=1e-4)
    assert result.member is not None
    assert max(result.member.pose.distance(tip)) <= 1e-4
    assert region[result.member.index].contains(result.member.pose)
    assert ((arm.limits.q_min <= result.q) & (result.q <= arm.limits.q_max)).all()


@pytest.mark.parametrize("kind", ["a box of positions", "turned about one axis", "a cone", "around a cylinder", "on a box"])
def test_no_sampled_member_has_a_nearer_configuration(arm, kind):
    region = KINDS[kind]
    found = armctl.solve_ik(arm, region)
    distance = np.linalg.norm(found.q - arm.home)
    for pose in region.sample(60, seed=3):
        other = armctl.solve_ik(arm, pose, arm.home, nearest=True)
        if other.ok:
            assert distance <= np.linalg.norm(other.q - arm.home) + 0.01


def test_an_orientation_anywhere_and_a_mask_of_directions_are_regions(arm):
    turned = Pose([9.0, 9.0, 9.0], rpy=[2.5, 0.3, 1.0])
    found = armctl.solve_ik(arm, Region(turned, [FREE] * 3 + [[0, 0]] * 3))
    assert found.ok, found.reason
    assert arm.fk(found.q).distance(turned)[1] < 1e-4
    lower = Pose(arm.fk(arm.home).position - [0, 0, 0.1], arm.fk(arm.home).quat)
    found = armctl.solve_ik(arm, Region(lower, [FREE, FREE, [0, 0], [0, 0], [0, 0], FREE]))
    assert found.ok, found.reason
    assert arm.fk(found.q).position[2] == pytest.approx(lower.position[2], abs=1e-5)
    assert arm.fk(found.q).rotation[:, 2] == pytest.approx(lower.rotation[:, 2], abs=1e-4)


def test_a_start_in_the_region_is_kept(arm):
    q = arm.limits.random(arm.home, 1, np.random.default_rng(4))[0]
    region = Region(arm.fk(q), [[-0.05, 0.05]] * 3 + [[-0.2, 0.2]] * 3)
    np.testing.assert_allclose(armctl.solve_ik(arm, region, q).q, q, atol=1e-9)


def test_the_same_call_gives_the_same_bits(arm):
    region = KINDS["around a cylinder"]
    assert armctl.solve_ik(arm, region).q.tobytes() == armctl.solve_ik(arm, region).q.tobytes()


def test_a_union_is_reached_at_the_nearest_part_and_names_it(arm):
    q = arm.limits.random(arm.home, 1, np.random.default_rng(5))[0]
    near = Region(arm.fk(q), name="near")
    far = Region(Pose([-0.4, -0.2, 0.3]), free="z").named("far")
    both = far | near
    assert len(both) == 2
    result = armctl.solve_ik(arm, both, q)
    assert result.member is not None
    assert (result.member.index, result.member.name) == (1, "near")
    assert "near" in str(result.member)
    assert [len(part) for part in Region.union([both, far])] == [1, 1, 1]


def test_out_of_reach_is_a_result_with_a_distance(arm):
    result = armctl.solve_ik(arm, Region([5.0, 0.0, 0.0], free="z"))
    assert not result.ok
    assert "out of reach by" in result.reason
    assert 3.0 < result.position_error < 5.0


def test_a_region_whose_members_all_touch_something_is_refused_with_the_contact(tmp_path):
    blocked = arm_among(tmp_path, '<geom name="block" type="box" size="0.2 0.2 0.2" pos="0.4 0 0.4"/>')
    region = Region([0.4, 0.0, 0.4], [[-0.05, 0.05]] * 3 + [FREE] * 3)
    assert armctl.solve_ik(blocked, region).ok
    refused = armctl.solve_ik(blocked, region, avoid=True)
    assert not refused.ok
    assert "block" in refused.reason


def test_a_move_into_a_region_says_which_member_it_chose(arm):
    sim = armctl.Simulation(arm)
    region = Region(arm.fk(arm.home + 0.3), free="z", cone=0.2, name="there") | Region([9.0, 0.0, 0.0])
    result = sim.move_to(region)
    assert result.ok, result.reason
    assert result.member is not None
    assert (result.member.index, result.member.name) == (0, "there")
    assert "'there'" in str(result)
    assert region.contains(sim.tip, position_tolerance=1e-3, orientation_tolerance=1e-2)
    straight = sim.move_to(Region(arm.fk(arm.home), [[-0.01, 0.01]] * 3 + [[0, 0]] * 3), avoid=False)
    assert straight.ok, straight.reason
    assert not sim.move_to(Region([9.0, 0.0, 0.0]))


def test_a_motion_around_obstacles_ends_in_the_region(tmp_path):
    walled = arm_among(tmp_path, '<geom name="wall" type="box" size="0.3 0.02 0.45" pos="0.45 0 0.45"/>')
    start = np.array([-0.8, 1.0, 0.4, 0.0, 0.3, 0.0])
    behind = walled.fk(-start * [1, -1, -1, 1, -1, 1])
    region = Region(behind, [[-0.05, 0.05]] * 3 + [FREE, [-0.3, 0.3], FREE])
    motion = armctl.move_free(walled, start, region)
    assert armctl.check_clearance(walled, motion)
    assert region.contains(walled.fk(motion(motion.duration).q), position_tolerance=1e-5, orientation_tolerance=1e-4)
    among = armctl.move_free(walled, start, [Pose([9.0, 0.0, 0.0]), region])
    assert region.contains(walled.fk(among(among.duration).q), position_tolerance=1e-5, orientation_tolerance=1e-4)


def test_differential_ik_approaches_the_nearest_member(arm):
    follower = armctl.DifferentialIk(arm)
    q = arm.home.copy()
    region = Region(arm.fk(arm.home + 0.4), free="z", cone=0.3)
    for _ in range(300):
        q = q + 0.02 * follower.step(q, region, 0.02)
    assert region.contains(arm.fk(q), position_tolerance=1e-3, orientation_tolerance=1e-2)


def test_a_region_is_a_value():
    region = KINDS["a cone"]
    for twin in (pickle.loads(pickle.dumps(region)), copy.deepcopy(region)):
        assert twin.sample(3) == region.sample(3)
    with pytest.raises(AttributeError, match="frozen"):
        region.parts = ()
    assert "parts=1" in repr(region)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Region.union([]), "regions: .* empty"),
        (lambda: Region.union([FRAME]), "regions: expected Region"),
        (lambda: Region.union(FRAME), "regions: expected a list"),
        (lambda: Region(FRAME, [[0.3, 0.1]] + [[0, 0]] * 5), r"those of x are reversed, \[0.3, 0.1\]"),
        (lambda: Region(FRAME, [[0, 0]] * 3), r"expected \(6, 2\)"),
        (lambda: Region(FRAME, [[0, np.nan]] + [[0, 0]] * 5), "those of x"),
        (lambda: Region(FRAME, [[0, 0]] * 4 + [[0, 2.0], [0, 0]]), "quarter turn"),
        (lambda: Region(FRAME, [[0, 0]] * 5 + [FREE], free="z"), "free: "),
        (lambda: Region(FRAME, free="up"), "free: expected one of"),
        (lambda: Region(FRAME, cone=0.2), "cone: .* free="),
        (lambda: Region(FRAME, free="z", cone=4.0), "cone: "),
        (lambda: Region.around(Box([0.1, 0.1, 0.1]), FRAME), "shape: .*Region.on"),
        (lambda: Region.around(Cylinder(0.1, 0.1), FRAME, margin=0.2), "margin: "),
        (lambda: Region.on(Ball(0.1), FRAME), "shape: "),
        (lambda: Region.on(Box([0.1, 0.1, 0.1]), FRAME, margin=0.2), "margin: "),
        (lambda: Region.of([[0.0, 0.0, 0.0]], [[0.0, 0.0, 0.0]]), "normals: that of point 0 has no length"),
        (lambda: Region.of([[0.0, 0.0, 0.0]] * 3, [[0.0, 0.0, 1.0]] * 2), "normals: 2 given for 3 points"),
        (lambda: Region(FRAME, [[-np.inf, np.inf]] + [[0, 0]] * 5).sample(1), "infinite bounds"),
    ],
)
def test_wrong_regions_are_one_sentence(call, message):
    with pytest.raises(InputError, match=message):
        call()


def test_a_free_axis_beside_a_region_has_a_hint(arm):
    with pytest.raises(InputError, match="free_axis: a region has its own"):
        armctl.solve_ik(arm, KINDS["a cone"], free_axis="z")
