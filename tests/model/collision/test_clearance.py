"""The certificate: a bound that holds between samples, and is close to what is attained."""

from dataclasses import dataclass
from itertools import pairwise

import mujoco
import numpy as np
import pytest
from collidable import arm_among, placed

import armctl
from armctl.model.collision.checkers import collision_checker

pytestmark = [pytest.mark.core, pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")]


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> armctl.Arm:
    return arm_among(tmp_path_factory.mktemp("arm"))


def free_configurations(arm: armctl.Arm, count: int) -> list[np.ndarray]:
    checker = collision_checker(arm)
    points = arm.limits.random(arm.home, 50 * count, np.random.default_rng(7))
    return [q for q in points if checker.hit(q, 0.01) < 0][:count]


def motions(arm: armctl.Arm):
    points = free_configurations(arm, 30)
    for a, b in pairwise(points):
        yield armctl.move_j(arm, a, b)
    for i in range(0, 27, 3):
        yield armctl.move_through(arm, points[i : i + 4])


def test_the_bound_holds_and_is_attained_within_a_fifth_of_a_millimetre(arm):
    checker = collision_checker(arm)
    proved = 0
    for motion in motions(arm):
        check = armctl.check_clearance(arm, motion)
        sampled = min(checker.nearest(q)[1] for q in motion.sample(np.linspace(0, motion.duration, 500)).q)
        if check.ok:
            assert check.distance <= sampled <= check.distance + 1e-3  # samples miss the nearest instant by a little
            attained = checker.nearest(motion(check.time).q)[1]
            assert check.distance <= attained <= check.distance + 2.2e-4
            proved += 1
        else:
            assert sampled < 2e-4
            assert check.distance <= 2e-4
    assert proved >= 5


def test_no_pair_is_ever_nearer_by_mujocos_distances_than_the_bound(arm):
    geometry = collision_checker(arm).geometry
    pairs = [geometry.pair_geoms(p) for p in range(len(geometry.pairs))]
    proved = [(motion, check) for motion in motions(arm) if (check := armctl.check_clearance(arm, motion))]
    assert len(proved) >= 5
    for motion, check in proved:
        times = np.append(np.linspace(0, motion.duration, 60), check.time)
        least = [
            min(mujoco.mj_geomDistance(arm.model, data, *pair, 0.3, None) for pair in pairs)
            for data in (placed(arm, q) for q in motion.sample(times).q)
        ]
        assert min(least) > check.distance - 1e-6
        assert least[-1] < check.distance + 2.2e-4


def test_a_motion_that_is_repeated_a_hundred_times_comes_as_near_as_once(arm):
    """More intervals wait than the search may keep."""
    first, *others = free_configurations(arm, 30)
    moves = [armctl.move_j(arm, first, q) for q in others]
    free = next(move for move in moves if armctl.check_clearance(arm, move, 2e-3))
    once = free.then(armctl.move_j(arm, free(free.duration).q, first))
    near = armctl.check_clearance(arm, once)
    often = once
    for _ in range(7):
        often = often.then(often)
    check = armctl.check_clearance(arm, often)
    assert check, check.reason
    assert check.distance == pytest.approx(near.distance, abs=2e-4)
    assert armctl.check_clearance(arm, often, clearance=near.distance - 1e-6)
    touching = next(move for move in moves if not armctl.check_clearance(arm, move))
    refused = armctl.check_clearance(arm, often.then(touching), clearance=near.distance - 1e-6)
    assert refused.time > often.duration


def test_it_sees_what_no_sample_sees(tmp_path):
    """A plate thinner than a sample's step."""
    arm = arm_among(tmp_path, '<geom name="sheet" type="box" size="0.3 0.0001 0.3" pos="0.5 0.3 0.6"/>')
    start = np.array([-0.5, 1.2, 0.2, 0.0, 0.0, 0.0])
    motion = armctl.move_j(arm, start, start + np.array([2.0, 0, 0, 0, 0, 0]))
    check = armctl.check_clearance(arm, motion)
    assert not check
    assert {check.first, check.second} >= {"sheet"}
    assert "sheet" in check.reason
    assert 0.0 < check.time < motion.duration


def test_a_clearance_that_is_not_kept_is_refused_with_what_is_there(arm):
    motion = next(motion for motion in motions(arm) if armctl.check_clearance(arm, motion).ok)
    distance = armctl.check_clearance(arm, motion).distance
    assert armctl.check_clearance(arm, motion, clearance=0.9 * distance)
    refused = armctl.check_clearance(arm, motion, clearance=distance + 5e-4)
    assert not refused
    assert "are required" in refused.reason


def test_a_contact_that_is_allowed_does_not_count(arm):
    touching = next(check for check in (armctl.check_clearance(arm, m) for m in motions(arm)) if not check)
    motion = next(m for m in motions(arm) if not armctl.check_clearance(arm, m))
    first = armctl.check_clearance(arm, motion)
    second = armctl.check_clearance(arm, motion, allow=[(first.first, first.second)])
    assert {second.first, second.second} != {first.first, first.second}
    assert touching.reason


def test_nothing_to_touch_is_said(tmp_path):
    arm = arm_among(tmp_path, "")
    allow = [("link0", f"link{i}") for i in range(6)]
    check = armctl.check_clearance(arm, armctl.move_j(arm, arm.home, arm.home + 0.01), allow=allow)
    assert check
    assert str(check) == "nothing can touch"


def test_a_motion_that_tilts_is_refused_with_a_distance_that_occurs(arm, tmp_path):
    checker = collision_checker(arm)
    motion = next(motion for motion in motions(arm) if armctl.check_clearance(arm, motion).ok)
    check = armctl.check_clearance(arm, motion, keep="z", keep_within=1e-3)
    assert not check
    assert "tilts by more than 0.001 rad" in check.reason
    times = np.linspace(0, motion.duration, 500)
    distances = [checker.nearest(q)[1] for q in motion.sample(times).q]
    assert min(distances) - 1e-4 <= check.distance <= min(distances[0], distances[-1])
    alone = arm_among(tmp_path, "")
    allow = [("link0", f"link{i}") for i in range(6)]
    tilted = armctl.move_j(alone, alone.home, alone.home + 0.01)
    check = armctl.check_clearance(alone, tilted, keep="z", keep_within=1e-3, allow=allow)
    assert not check
    assert check.distance == np.inf


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"trajectory": [0.0]}, "is not a motion of polynomial pieces"),
        ({"clearance": -1.0}, "clearance"),
        ({"clearance": float("nan")}, "clearance"),
        ({"keep": "w"}, "unknown axis to keep 'w'"),
        ({"keep": 3}, "unknown axis to keep '3'"),
        ({"keep": "z", "keep_within": 0.0}, "keep_within: expected a number in "),
        ({"keep": "z", "keep_within": 2.0}, "keep_within: expected a number in "),
    ],
)
def test_wrong_calls_are_one_sentence(arm, arguments, message):
    motion = armctl.move_j(arm, arm.home, arm.home + 0.01)
    with pytest.raises(armctl.ArmctlError, match=message):
        armctl.check_clearance(arm, **({"trajectory": motion} | arguments))


def test_a_motion_of_other_joints_is_rejected(arm, bundled):
    with pytest.raises(armctl.InputError, match="the arm has j0"):
        armctl.check_clearance(arm, armctl.move_j(bundled, bundled.home, bundled.home + 0.01))


@dataclass
class HigherDegree:
    """A motion with zeros as coefficients of the sixth power."""

    motion: armctl.JointTrajectory

    def __post_init__(self):
        self.knots = self.motion.knots
        self.joint_names = self.motion.joint_names
        self.duration = self.motion.duration
        self.coefficients = np.pad(self.motion.coefficients, ((0, 0), (0, 1), (0, 0)))

    def __call__(self, t: float) -> armctl.Setpoint:
        return self.motion(t)


def test_polynomials_of_a_higher_degree_than_the_proofs_take_are_refused(bundled):
    motion = armctl.move_j(bundled, bundled.home, bundled.home + 0.1)
    with pytest.raises(armctl.InputError, match="expected polynomials of degree at most 5, got 6"):
        armctl.check_clearance(bundled, HigherDegree(motion))
