"""Motions whose tip stays in a region, judged by MuJoCo's kinematics ten thousand times a second."""

import numpy as np
import pytest
from arms import arm_of
from collidable import arm_among, placed
from tip_coordinates import TipJudge

import armctl

pytestmark = pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")

POST = '<geom name="post" type="box" size="0.06 0.02 0.15" pos="0.45 0 0.15"/>'
START = np.array([-0.8, 1.2, 0.9, 0.0, np.pi - 2.1, 0.0])  # the tip points down
GOAL = np.array([0.8, 1.2, 0.9, 0.0, np.pi - 2.1, 0.0])
FREE = [-np.inf, np.inf]


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> armctl.Arm:
    return arm_among(tmp_path_factory.mktemp("post"), POST)


def symmetric(*halves: float) -> list[list[float]]:
    return [[-half, half] for half in halves]


def plane_at(tip: armctl.Pose, thickness: float = 2e-3, tilt: float = 0.01) -> armctl.Region:
    """The plane through a tip across its z axis: it slides and turns on it."""
    return armctl.Region(tip, symmetric(np.inf, np.inf, thickness, tilt, tilt, np.inf))


def arc_through(tip: armctl.Pose, hinge: armctl.Pose, thickness: float = 2e-3, tilt: float = 0.01) -> armctl.Region:
    """The arc of a handle about the z axis of a hinge, with the angle as the free coordinate."""
    halves = (thickness, thickness, thickness, tilt, tilt, 1.5)
    return armctl.Region(hinge, symmetric(*halves), tip=hinge.inverse() @ tip)


def on_arc(region: armctl.Region, angle: float) -> armctl.Pose:
    (part,) = region.parts
    return part.frame @ armctl.Pose([0.0, 0.0, 0.0], rpy=[0.0, 0.0, angle]) @ part.tip


def assert_stays(arm: armctl.Arm, motion: armctl.JointTrajectory, region: armctl.Region) -> np.ndarray:
    """(N, 6) the coordinates of the tip, after they have been found inside the bounds."""
    (part,) = region.parts
    q = motion.sample(np.append(np.arange(0.0, motion.duration, 1e-4), motion.duration)).q
    found = TipJudge(arm).coordinates(part.frame, part.tip, q)
    found[:, 3:] = np.unwrap(found[:, 3:], axis=0)
    assert (found >= part.bounds[:, 0])[:, [0, 1, 2, 3, 4]].all()
    assert (found <= part.bounds[:, 1])[:, [0, 1, 2, 3, 4]].all()
    if np.ptp(part.bounds[5]) < 2 * np.pi:
        assert part.bounds[5, 0] <= found[:, 5].min()
        assert found[:, 5].max() <= part.bounds[5, 1]
    return found


def assert_moves(arm: armctl.Arm, motion: armctl.JointTrajectory) -> None:
    assert motion.check_limits().ok
    assert armctl.check_torque(arm, motion).ok
    at_end = motion(motion.duration)
    np.testing.assert_allclose(at_end.v, 0.0, atol=1e-9)


@pytest.mark.parametrize(("thickness", "tilt"), [(2e-3, 0.01), pytest.param(0.02, 0.1, marks=pytest.mark.full)])
def test_a_tip_slides_on_a_plane_past_a_post(arm, thickness, tilt):
    region = plane_at(arm.fk(START), thickness, tilt)
    motion = armctl.move_free(arm, START, GOAL, keep=region)
    assert_moves(arm, motion)
    assert_stays(arm, motion, region)
    assert armctl.check_clearance(arm, motion, keep=region)
    np.testing.assert_allclose(motion(motion.duration).q, GOAL, atol=1e-9)
    for q in motion.sample(np.arange(0.0, motion.duration, 2e-3)).q:
        assert not any(contact.dist < 0.0 for contact in placed(arm, q).contact)
    inside = motion.sample(np.linspace(0.05, 0.95, 300) * motion.duration)
    assert np.abs(inside.v).max(axis=1).min() > 0.02  # it does not stop on the way
    unkept = armctl.check_clearance(arm, armctl.move_free(arm, START, GOAL), keep=region)
    assert "the tip is outside the region: its" in unkept.reason


@pytest.mark.full
def test_the_same_seed_gives_the_same_bits(arm):
    region = plane_at(arm.fk(START), 0.02, 0.1)
    first, again, other = (armctl.move_free(arm, START, GOAL, keep=region, seed=seed) for seed in (3, 3, 4))
    assert first.coefficients.tobytes() == again.coefficients.tobytes()
    assert first.coefficients.shape != other.coefficients.shape or (first.coefficients != other.coefficients).any()


def test_an_upright_region_gives_the_bits_of_the_short_form(arm):
    upright = armctl.Region.upright(arm.fk(START), "z", cone=0.2)
    short = armctl.move_free(arm, START, GOAL, keep="z", keep_within=0.2)
    long = armctl.move_free(arm, START, GOAL, keep=upright)
    assert short.coefficients.tobytes() == long.coefficients.tobytes()


def test_a_glass_stays_upright_in_a_layer(arm):
    tip = arm.fk(START)
    layer = armctl.Region(
        armctl.Pose(tip.position),
        [FREE, FREE, [-0.05, 0.05], [0, 0], [0, 0], [0, 0]],
        tip=armctl.Pose.from_rotation([0.0, 0.0, 0.0], tip.rotation),
        free="z",
        cone=0.05,
    )
    motion = armctl.move_free(arm, START, GOAL, keep=layer)
    judge = TipJudge(arm)
    poses = np.array([judge.pose(q) for q in motion.sample(np.arange(0.0, motion.duration, 1e-4)).q])
    assert np.abs(poses[:, 2, 3] - tip.position[2]).max() <= 0.05
    assert np.arccos(np.clip(poses[:, :3, 2] @ tip.rotation[:, 2], -1.0, 1.0)).max() <= 0.05


def test_a_point_is_reached_on_the_plane_with_the_turn_that_suits(arm):
    tip = arm.fk(START)
    region = plane_at(tip)
    target = tip.position + 0.1 * tip.rotation[:, 0]
    motion = armctl.move_free(arm, START, target, keep=region)
    np.testing.assert_allclose(arm.fk(motion(motion.duration).q).position, target, atol=2e-6)
    assert_stays(arm, motion, region)


@pytest.mark.parametrize(
    ("name", "radius", "angle", "thickness"),
    [
        ("panda", -0.25, 0.9, 5e-4),
        pytest.param("panda", 0.4, -0.5, 2e-3, marks=pytest.mark.full),
        pytest.param("ur5e", 0.2, 0.8, 2e-3, marks=pytest.mark.full),
        pytest.param("ur5e", 0.4, -0.5, 5e-4, marks=pytest.mark.full),
    ],
)
def test_a_handle_goes_along_its_arc(name, radius, angle, thickness):
    arm = arm_of(name)
    tip = arm.fk(arm.home)
    region = arc_through(tip, armctl.Pose(tip.position + np.array([0.0, radius, 0.0])), thickness)
    motion = armctl.move_free(arm, arm.home, on_arc(region, angle), keep=region)
    assert_moves(arm, motion)
    found = assert_stays(arm, motion, region)
    assert found[-1, 5] == pytest.approx(angle, abs=1e-5)  # of inverse kinematics


def test_it_starts_while_the_arm_moves_on_the_plane(arm):
    region = plane_at(arm.fk(START), 0.02, 0.1)
    first = armctl.move_free(arm, START, GOAL, keep=region)
    state = first(0.3 * first.duration)
    motion = armctl.move_free(arm, state, START, keep=region, speed=0.5)
    assert_stays(arm, motion, region)
    for given, started in zip(state[:3], motion(0.0)[:3], strict=True):
        np.testing.assert_allclose(started, given, atol=1e-9)


def test_a_simulated_move_stays_in_the_region_or_says_why_not(arm):
    sim = armctl.Simulation(arm)
    sim.reset(START)
    region = plane_at(sim.tip)
    assert sim.move_to(sim.tip.position + 0.1 * sim.tip.rotation[:, 0], keep=region)
    refused = sim.move_to(sim.tip.position + np.array([0.0, 0.0, 0.05]), keep=region)
    assert not refused
    assert "goal: the tip is outside the region: its z is" in refused.reason
    with pytest.raises(armctl.InputError, match="avoid=True"):
        sim.move_to(sim.tip, keep=region, avoid=False)


def test_where_start_or_goal_is_outside_is_said(arm):
    tip = arm.fk(START)
    away = plane_at(tip @ armctl.Pose([0.0, 0.0, 0.01]))
    with pytest.raises(armctl.PlanError, match=r"start: the tip is outside the region: its z is -0\.01 m, 0\.008 m outside"):
        armctl.move_free(arm, START, GOAL, keep=away)
    edge = plane_at(tip @ armctl.Pose([0.0, 0.0, 2e-3]))
    with pytest.raises(
        armctl.PlanError, match=r"start: the tip is at the edge of the region: its z is -0\.002 m, expected it at"
    ):
        armctl.move_free(arm, START, GOAL, keep=edge)
    tilted = GOAL + np.array([0.0, 0.0, 0.0, 0.0, 0.3, 0.0])
    with pytest.raises(armctl.PlanError, match=r"goal: the tip is outside the region: its .* outside \["):
        armctl.move_free(arm, START, tilted, keep=plane_at(tip, 0.5))


def test_arms_with_several_tips_and_thin_regions_are_refused(arm):
    with pytest.raises(armctl.InputError, match="0 m thick in z"):
        armctl.move_free(arm, START, GOAL, keep=plane_at(arm.fk(START), 0.0))
    with pytest.raises(armctl.InputError, match="a union of 2 parts"):
        armctl.move_free(arm, START, GOAL, keep=plane_at(arm.fk(START)) | plane_at(arm.fk(GOAL)))
    both = arm_of("aloha")
    with pytest.raises(armctl.InputError, match="it has the tips"):
        armctl.move_free(both, both.home, both.home, keep=plane_at(both.fk(both.home)))


@pytest.mark.full
def test_a_plane_with_a_wall_across_it_is_said():
    """The arm reaches over the wall, and its tip cannot go around it."""
    height = arm_of("panda").fk(arm_of("panda").home).position[2]
    world = armctl.World()
    for name, y in (("left", 0.15), ("right", -1.0)):
        world.add(name, armctl.Box([3.0, 0.02, 0.1]), [0.6, y, height])
    arm = armctl.load("panda", scene=world)
    tip = arm.fk(arm.home)
    with pytest.raises(armctl.PlanError, match="no collision-free path found in the region after 20000 samples"):
        armctl.move_free(arm, arm.home, tip.position + np.array([0.0, 0.35, 0.0]), keep=plane_at(tip))


@pytest.mark.full
@pytest.mark.parametrize("name", ["panda", "ur5e", "fr3", "xarm7"])
@pytest.mark.parametrize("kind", ["plane", "arc"])
def test_random_regions_are_kept_by_robots(name, kind):
    """Of goals that the arm can reach in the region, most are reached; none of the motions leaves it."""
    arm = arm_of(name)
    rng = np.random.default_rng(11)
    tip = arm.fk(arm.home)
    reached = 0
    tried = 0
    for seed in range(12):
        turn = armctl.Pose([0.0, 0.0, 0.0], rpy=rng.uniform(-0.7, 0.7, 3))
        if kind == "plane":
            region = armctl.Region(tip @ turn, symmetric(np.inf, np.inf, 1e-3, 5e-3, 5e-3, np.inf), tip=turn.inverse())
            move = armctl.Pose([*rng.uniform(-0.2, 0.2, 2), 0.0], rpy=[0.0, 0.0, rng.uniform(-0.6, 0.6)])
            goal = tip @ turn @ move @ turn.inverse()
        else:
            region = arc_through(tip, tip @ armctl.Pose(rng.uniform(-0.3, 0.3, 3)) @ turn, 1e-3, 5e-3)
            goal = on_arc(region, rng.uniform(0.3, 0.9) * rng.choice([-1.0, 1.0]))
        if not armctl.solve_ik(arm, goal, arm.home, avoid=True).ok:
            continue
        tried += 1
        try:
            motion = armctl.move_free(arm, arm.home, goal, keep=region, seed=seed)
        except armctl.PlanError as error:
            if "no collision-free path" not in str(error):
                raise
            continue
        reached += 1
        assert_moves(arm, motion)
        assert_stays(arm, motion, region)
    assert tried >= 5
    assert reached >= 0.8 * tried
