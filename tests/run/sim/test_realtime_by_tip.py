"""A real-time session of an arm with several tips: each has a target, and all are followed at once. MuJoCo judges."""

import time

import mujoco
import numpy as np
import pytest
from arms import MISSING, at_hand
from synthetic import ON_A_TORSO, TWO_ARMS

import armctl
from armctl import Pose
from armctl.core.errors import UnknownNameError
from armctl.view.realtime.session import UPDATE_INTERVAL_S, RealTimeSession
from armctl.view.realtime.status import Activity
from armctl.view.status_text import describe

pytestmark = pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")
FLOOR = '<geom name="floor" type="plane" size="2 2 0.1" pos="0 0 {height}"/>'


def session_of(text: str) -> RealTimeSession:
    return RealTimeSession(armctl.load(mujoco.MjSpec.from_string(text)))


@pytest.fixture
def two() -> RealTimeSession:
    return session_of(TWO_ARMS)


@pytest.fixture
def torso() -> RealTimeSession:
    return session_of(ON_A_TORSO)


def go(session: RealTimeSession, seconds: float) -> None:
    for _ in range(round(seconds / UPDATE_INTERVAL_S)):
        session.advance()
        assert not session._stepper.data.ncon
        while session._follower.is_planning and session._follower._planning.move is None:
            time.sleep(1e-3)


def tips(session: RealTimeSession) -> dict[str, np.ndarray]:
    return {tip: session._stepper.data.site(tip).xpos.copy() for tip in session.arm.tips}


def arms_before(session: RealTimeSession) -> dict[str, np.ndarray]:
    """Where the tips are, after both arms were bent: straight ones have no way to most places near."""
    session.set_speed_override(1.0)
    bent = [0.3, 0.5, 0.6, 0.1, -0.3, 0.5, 0.6, -0.1]
    session.move_joints(np.array(bent if session.arm.n == len(bent) else [0.0, *bent]))
    go(session, 3.0)
    assert session.status.activity is Activity.AT_TARGET
    return tips(session)


def test_both_tips_are_followed_at_once(two: RealTimeSession):
    before = arms_before(two)
    goals = {"l": before["l"] + [0.0, 0.1, 0.1], "r": before["r"] + [-0.05, 0.0, 0.1]}
    for tip, goal in goals.items():
        two.aim(Pose(goal), tip=tip)
    go(two, 0.5)
    under_way = tips(two)
    assert all(np.linalg.norm(under_way[tip] - before[tip]) > 0.02 for tip in goals)
    go(two, 3.0)
    assert two.status.activity is Activity.AT_TARGET
    assert two.status.aimed == ("l", "r")
    for tip, goal in goals.items():
        assert np.linalg.norm(tips(two)[tip] - goal) < 1e-3
        assert np.array_equal(two.status.targets[tip].position, goal)


def test_a_target_stays_followed_while_another_one_moves(torso: RealTimeSession):
    """The torso moves both arms: what one needs of it, the other makes up for."""
    before = arms_before(torso)
    torso.aim(Pose(before["l"]), tip="l")
    far = before["r"] + np.array([-0.1, -0.1, 0.0])
    for share in np.linspace(0.0, 1.0, 100):
        torso.aim(Pose(before["r"] + share * (far - before["r"])), tip="r", held=True)
        go(torso, UPDATE_INTERVAL_S)
    torso.aim(Pose(far), tip="r")
    go(torso, 4.0)
    assert torso.status.activity is Activity.AT_TARGET
    assert np.linalg.norm(tips(torso)["r"] - far) < 1e-3
    assert np.linalg.norm(tips(torso)["l"] - before["l"]) < 1e-3
    assert abs(torso.status.q[0]) > 0.01


def test_a_free_tip_goes_along_and_its_own_joints_rest(torso: RealTimeSession):
    before = arms_before(torso)
    q = torso.status.q
    assert not torso.status.aimed
    torso.aim(Pose(before["r"] + np.array([-0.1, -0.3, 0.0])), tip="r")
    go(torso, 4.0)
    assert torso.status.activity is Activity.AT_TARGET
    assert torso.status.aimed == ("r",)
    own = [torso.arm.joint_names.index(name) for name in ("l1", "l2", "l3", "l4")]
    assert np.abs(torso.status.q - q)[own].max() < 1e-3
    moved = tips(torso)["l"]
    assert np.linalg.norm(moved - before["l"]) > 0.01
    assert np.linalg.norm(torso.status.targets["l"].position - moved) < 1e-3


def test_a_target_that_is_released_does_not_release_another_hand(two: RealTimeSession):
    before = arms_before(two)
    two.aim(Pose(before["l"]), tip="l", held=True)
    two.aim(Pose(before["r"]), tip="r", held=True)
    two.aim(Pose(before["r"]), tip="r")
    two.advance()
    assert two._follower.task.held
    two.aim(Pose(before["l"]), tip="l")
    two.advance()
    assert not two._follower.task.held


def test_the_tip_whose_target_is_out_of_reach_is_named(two: RealTimeSession):
    before = arms_before(two)
    two.aim(Pose(before["l"] + [0.0, 0.05, 0.05]), tip="l")
    two.aim(Pose(before["r"] + [3.0, 0.0, 0.0]), tip="r", held=True)
    go(two, 8.0)
    assert two.status.activity is Activity.OUT_OF_REACH
    assert list(two.status.reach_errors) == ["r"]
    assert two.status.reach_errors["r"] == pytest.approx(two.status.position_error, abs=0.02)
    assert describe(two.status).startswith("r is out of reach by ")
    assert np.linalg.norm(tips(two)["l"] - before["l"] - [0.0, 0.05, 0.05]) < 1e-3


def test_arms_that_would_meet_plan_around_each_other(two: RealTimeSession):
    before = arms_before(two)
    crossed = {"l": before["l"] + [0.0, -0.2, 0.1], "r": before["r"] + [0.0, 0.05, 0.1]}
    for tip, goal in crossed.items():
        two.aim(Pose(goal), tip=tip)
    go(two, 8.0)
    assert two.status.activity is Activity.AT_TARGET
    for tip, goal in crossed.items():
        assert np.linalg.norm(tips(two)[tip] - goal) < 1e-3


def test_a_hand_moves_the_tip_that_is_chosen(two: RealTimeSession):
    before = arms_before(two)
    velocity = (np.array([0.0, 0.0, 0.1]), np.zeros(3))
    two.hand = lambda: velocity
    two.hand_tip = "r"
    go(two, 1.0)
    two.hand_tip = "l"
    go(two, 0.5)
    two.hand = lambda: None
    go(two, 4.0)
    risen = {tip: tips(two)[tip][2] - before[tip][2] for tip in before}
    assert 0.05 < risen["r"] < 0.11
    assert 0.02 < risen["l"] < 0.06
    assert two.status.activity is Activity.AT_TARGET


def test_an_unknown_tip_is_an_error_at_once(two: RealTimeSession):
    for call in (two.aim, two.set_oriented, two.grip):
        with pytest.raises(UnknownNameError, match="foot"):
            call(Pose([0.0, 0.0, 0.0]) if call == two.aim else 0.0, tip="foot")


def assert_rises(session: RealTimeSession, tip: str) -> None:
    """The tip comes up to a target above it."""
    start = session._stepper.data.site(tip).xpos.copy()
    session.aim(Pose(start + np.array([-0.1, 0.0, 0.15])), tip=tip)
    for _ in range(500):
        session.advance()
    assert session.status.activity is not Activity.BLOCKED
    assert session._stepper.data.site(tip).xpos[2] > start[2] + 0.1


def test_what_touches_at_home_may_touch():
    """Feet on the ground, such as here the upper arms on a floor: an arm that stands is not blocked by it."""
    height = 0.5 - 0.02 + 1e-3  # at home the links lie on it
    assert_rises(session_of(TWO_ARMS.replace("<worldbody>", "<worldbody>" + FLOOR.format(height=height))), "r")


def test_a_loose_body_that_lies_on_an_arm_does_not_block_it():
    brick = '<body pos="0.15 0.25 0.56"><freejoint/><geom name="brick" type="box" size="0.02 0.02 0.03" mass="0.01"/></body>'
    session = session_of(TWO_ARMS.replace("</worldbody>", brick + "</worldbody>"))
    for _ in range(100):
        session.advance()
    assert session._stepper.data.ncon
    assert_rises(session, "l")


@pytest.mark.skipif(not at_hand("aloha"), reason=MISSING)
def test_each_gripper_is_moved_by_its_tip():
    session = RealTimeSession(armctl.load("aloha"))
    left, right = session.arm.tips
    widths = dict(session.status.gripper_widths)
    session.grip(0.02, tip=right)
    for _ in range(20):
        session.advance()
    assert session.status.gripper_widths[right] == pytest.approx(0.02, abs=2e-3)
    assert session.status.gripper_widths[left] == pytest.approx(widths[left], abs=2e-3)
    session.grip(0.03)
    for _ in range(20):
        session.advance()
    assert session.status.gripper_widths[left] == pytest.approx(0.03, abs=2e-3)
