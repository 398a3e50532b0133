"""The proof that a tip stays in a region during a whole motion, judged by MuJoCo's kinematics at many times."""

from pathlib import Path

import numpy as np
import pytest
from arms import arm_of
from collidable import arm_among
from tip_coordinates import TipJudge

import armctl

pytestmark = [pytest.mark.core, pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")]

PARALLEL_LINK_ARM = Path(__file__).parents[3] / "examples" / "models" / "parallel_link_arm.xml"
OUTER = 1e-4  # m and rad
RATE = 10_000  # Hz
ALLOWED = [("link0", f"link{i}") for i in range(6)]
NAMES = ("x", "y", "z", "roll", "pitch", "yaw")
ALL = [[-np.inf, np.inf]] * 6


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> armctl.Arm:
    return arm_among(tmp_path_factory.mktemp("alone"), "")


def any_pose(rng: np.random.Generator, reach: float) -> armctl.Pose:
    return armctl.Pose(rng.uniform(-reach, reach, 3), rpy=rng.uniform(-0.5, 0.5, 3))


def sampled(arm: armctl.Arm, frame: armctl.Pose, tip: armctl.Pose, motion: armctl.JointTrajectory) -> np.ndarray:
    """(N, 6) the coordinates along a motion, whose angles do not jump."""
    q = motion.sample(np.linspace(0.0, motion.duration, int(RATE * motion.duration))).q
    found = TipJudge(arm).coordinates(frame, tip, q)
    found[:, 3:] = np.unwrap(found[:, 3:], axis=0)
    return found


def random_motion(arm: armctl.Arm, rng: np.random.Generator, width: float) -> armctl.JointTrajectory:
    points = arm.limits.clamp(arm.home + rng.uniform(-width, width, (3, arm.n)))
    return armctl.move_through(arm, points)


def kept(arm: armctl.Arm, motion: armctl.JointTrajectory, region: armctl.Region) -> armctl.ClearanceCheck:
    names = {arm.model.body(i).name for i in range(1, arm.model.nbody)}
    allow = [(a, b) for a in names for b in names if a < b]
    return armctl.check_clearance(arm, motion, allow=allow, keep=region)


def assert_bounds_decide(arm: armctl.Arm, seed: int) -> None:
    """A region a little wider than the motion is proved, and one that it leaves on any side is refused where it is outside."""
    rng = np.random.default_rng(seed)
    motion = random_motion(arm, rng, 0.25)
    tip = any_pose(rng, 0.2)
    start = arm.fk(motion(0.0).q)
    frame = start @ tip.inverse() @ any_pose(rng, 0.1)
    found = sampled(arm, frame, tip, motion)
    assert np.abs(found[:, 4]).max() < 1.4  # away from the singularity of the angles
    wide = np.column_stack([found.min(axis=0) - OUTER, found.max(axis=0) + OUTER])
    check = kept(arm, motion, armctl.Region(frame, wide, tip=tip))
    assert check, check.reason
    for row in range(6):
        for side in range(2):
            narrow = wide.copy()
            narrow[row, side] += (2 * side - 1) * -2 * OUTER
            refused = kept(arm, motion, armctl.Region(frame, narrow, tip=tip))
            assert not refused
            assert f"its {NAMES[row]} is" in refused.reason
            there = TipJudge(arm).coordinates(frame, tip, motion(refused.time).q[None])[0, row]
            turns = 2 * np.pi * np.round((there - narrow[row].mean()) / (2 * np.pi)) if row > 2 else 0.0
            assert not narrow[row, 0] + 2e-6 < there - turns < narrow[row, 1] - 2e-6


@pytest.mark.parametrize("seed", range(3))
def test_all_six_bounds_are_proved_and_refused_where_mujoco_sees_it(arm, seed):
    assert_bounds_decide(arm, seed)


@pytest.mark.full
@pytest.mark.parametrize("name", ["panda", "ur5e", "fr3", "xarm7"])
@pytest.mark.parametrize("seed", range(8))
def test_all_six_bounds_are_proved_and_refused_on_robots(name, seed):
    assert_bounds_decide(arm_of(name), 100 + seed)


@pytest.mark.full
@pytest.mark.parametrize("seed", range(4))
def test_all_six_bounds_are_proved_and_refused_with_closed_loops(seed):
    assert_bounds_decide(armctl.load(PARALLEL_LINK_ARM), seed)


def test_a_line_that_leaves_a_region_between_its_ends_for_a_moment_is_refused(arm):
    """Both ends and the middle are inside: only the way between is not."""
    rng = np.random.default_rng(5)
    motion = random_motion(arm, rng, 0.3)
    there_and_back = motion.then(armctl.move_through(arm, [motion(motion.duration).q, motion(0.0).q]))
    frame = armctl.Pose(arm.fk(motion(0.0).q).position)
    found = sampled(arm, frame, armctl.Pose([0.0, 0.0, 0.0]), there_and_back)
    bounds = np.array(ALL, dtype=float)
    for row in range(3):
        bounds[row] = found[:, row].min() - 1.0, found[:, row].max() + 2e-6
        assert kept(arm, there_and_back, armctl.Region(frame, bounds)).ok
        bounds[row, 1] -= 4e-6
        assert not kept(arm, there_and_back, armctl.Region(frame, bounds)).ok
        bounds[row] = ALL[row]


def test_an_axis_with_a_cone_and_lengths_is_one_region(arm):
    rng = np.random.default_rng(3)
    motion = random_motion(arm, rng, 0.3)
    start = arm.fk(motion(0.0).q)
    q = motion.sample(np.linspace(0.0, motion.duration, int(RATE * motion.duration))).q
    judge = TipJudge(arm)
    poses = np.array([judge.pose(each) for each in q])
    tilts = np.arccos(np.clip(poses[:, :3, 2] @ start.rotation[:, 2], -1.0, 1.0))
    heights = poses[:, 2, 3] - start.position[2]
    bounds = np.array([ALL[0], ALL[0], [heights.min() - OUTER, heights.max() + OUTER], [0, 0], [0, 0], [0, 0]], dtype=float)
    frame = armctl.Pose(start.position)
    tip = armctl.Pose.from_rotation([0.0, 0.0, 0.0], start.rotation)
    cone = tilts.max() + 1e-3
    assert kept(arm, motion, armctl.Region(frame, bounds, tip=tip, free="z", cone=cone))
    refused = kept(arm, motion, armctl.Region(frame, bounds, tip=tip, free="z", cone=tilts.max() - 1e-4))
    assert "its tilt is" in refused.reason
    bounds[2, 1] -= 2 * OUTER
    refused = kept(arm, motion, armctl.Region(frame, bounds, tip=tip, free="z", cone=cone))
    assert "its z is" in refused.reason


def test_an_upright_region_is_the_short_form(arm):
    motion = random_motion(arm, np.random.default_rng(8), 0.1)
    for within in (0.02, 0.1, 0.5):
        short = armctl.check_clearance(arm, motion, allow=ALLOWED, keep="z", keep_within=within)
        upright = armctl.Region.upright(arm.fk(motion(0.0).q), "z", cone=within)
        long = armctl.check_clearance(arm, motion, allow=ALLOWED, keep=upright)
        assert (short.ok, short.distance, short.time) == (long.ok, long.distance, long.time)


def test_an_angle_may_have_a_range_of_more_than_half_a_turn(arm):
    """The first joint turns from -1.8 to 2.0 rad, measured from the middle of the region."""
    turned = arm.home + 1.4 * np.eye(arm.n)[0]
    motion = armctl.move_through(arm, [arm.home, turned, arm.home - 2.4 * np.eye(arm.n)[0]])
    frame = armctl.Pose([0.0, 0.0, 0.0], rpy=[0.0, 0.0, -0.6])
    tip = arm.fk(arm.home)
    for low, high, inside in ((-1.9, 2.1, True), (-1.7, 2.1, False), (-1.9, 1.9, False)):
        bounds = np.array([*ALL[:5], [low, high]], dtype=float)
        assert kept(arm, motion, armctl.Region(frame, bounds, tip=tip)).ok == inside


@pytest.mark.parametrize(
    ("region", "message"),
    [
        (armctl.Region([0.0, 0.0, 0.0]), "keep: the region is 0 m thick in x, .* give bounds at least 0.0001 m apart"),
        (
            armctl.Region([0.0, 0.0, 0.0], [*ALL[:5], [0.3, 0.3]]),
            "keep: the region is 0 rad thick in yaw, .* give bounds at least 0.0001 rad apart",
        ),
        (armctl.Region([0.0, 0.0, 0.0], ALL[:3] + [[0, 0]] * 3, free="z"), "keep: the cone of the region is 0 rad; give"),
        (armctl.Region([0.0, 0.0, 0.0], ALL) | armctl.Region([0.0, 0.0, 0.0], ALL), "a union of 2 parts"),
    ],
)
def test_a_region_in_which_no_motion_stays_is_one_sentence(arm, region, message):
    motion = armctl.move_j(arm, arm.home, arm.home + 0.01)
    with pytest.raises(armctl.InputError, match=message):
        armctl.check_clearance(arm, motion, keep=region)


def test_an_angle_beside_a_region_is_refused(arm):
    motion = armctl.move_j(arm, arm.home, arm.home + 0.01)
    with pytest.raises(armctl.InputError, match="keep_within: it belongs to keep='z'"):
        armctl.check_clearance(arm, motion, keep=armctl.Region([0.0, 0.0, 0.0], ALL), keep_within=0.2)
    with pytest.raises(armctl.InputError, match="axis"):
        armctl.Region.upright(arm.fk(arm.home), "up")
