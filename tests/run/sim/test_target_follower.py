"""A real-time session among obstacles: live as long as nothing is in the way, then on a planned path; nothing is touched."""

import time
from dataclasses import replace

import numpy as np
import pytest
from arms import BUNDLED

import armctl
from armctl import Pose
from armctl.run.execution.obstacles import Obstacles
from armctl.view.realtime.session import UPDATE_INTERVAL_S, RealTimeSession
from armctl.view.realtime.status import Activity
from armctl.view.status_text import describe

BESIDE = [0.42, 0.2, 0.25]
OPPOSITE = [0.42, -0.2, 0.25]
INSIDE = [0.42, 0.0, 0.25]


class Watched:
    """A session with a wall between two targets, and the smallest distance of the arm from anything."""

    def __init__(self) -> None:
        scene = armctl.World()
        scene.add("wall", armctl.Box([0.12, 0.04, 0.34]), [0.42, 0.0, 0.17])
        self.arm = armctl.load(BUNDLED, scene=scene)
        self.session = RealTimeSession(self.arm)
        self.checker = Obstacles(self.arm, self.session._stepper.data).checker()
        self.nearest = np.inf

    def aim(self, point: list[float], *, held: bool = False) -> None:
        self.session.aim(Pose(point), held=held)

    def go(self, seconds: float) -> None:
        for _ in range(round(seconds / UPDATE_INTERVAL_S)):
            self.session.advance()
            self.nearest = min(self.nearest, self.checker.nearest(self.session.status.q)[1])
            while self.session._follower.is_planning and self.session._follower._planning.move is None:
                time.sleep(1e-3)


@pytest.fixture(scope="module")
def room() -> Watched:
    return Watched()


@pytest.fixture
def watched(room: Watched) -> Watched:
    """The arm at rest beside the wall."""
    room.session.set_speed_override(1.0)
    room.aim(BESIDE)
    room.go(6.0)
    assert room.session.status.activity is Activity.AT_TARGET
    room.nearest = np.inf
    return room


def test_a_target_that_is_dragged_through_a_wall_is_followed_around_it_after_it_is_released(watched: Watched):
    for y in np.linspace(BESIDE[1], OPPOSITE[1], 60):
        watched.aim([BESIDE[0], y, BESIDE[2]], held=True)
        watched.go(UPDATE_INTERVAL_S)
    watched.go(1.0)
    status = watched.session.status
    assert status.activity is Activity.BLOCKED
    assert "wall" in describe(status)
    assert status.path is None
    assert watched.arm.fk(status.q).position[1] > 0.02
    watched.session.aim(status.target)
    watched.go(0.3)
    path = watched.session.status.path
    assert path is not None
    assert path.tips.shape == (1, 100, 3)
    assert watched.session._follower.reference.is_on_planned_path
    watched.go(6.0)
    status = watched.session.status
    assert status.activity is Activity.AT_TARGET
    np.testing.assert_allclose(watched.arm.fk(status.q).position, OPPOSITE, atol=1e-3)
    np.testing.assert_allclose(path.tips[0, -1], OPPOSITE, atol=1e-3)
    assert watched.nearest > 0.0


def test_the_arm_does_not_stop_at_each_place_of_a_target_that_is_dragged_in_rare_steps():
    session = RealTimeSession(armctl.load(BUNDLED))
    y = np.repeat(0.2 - 0.01 * np.arange(12), 25)  # a step every 0.25 s
    speeds = []
    for k, each in enumerate(y):
        if k % 25 == 0:
            session.aim(Pose([0.42, each, 0.25]), held=True)
        before = session.status.q
        session.advance()
        speeds.append(np.abs(session.status.q - before).max() / UPDATE_INTERVAL_S)
    assert min(speeds[150:]) > 0.5 * np.mean(speeds[150:]) > 0.02
    for _ in range(100):
        session.advance()
    assert session.status.position_error < 1e-3


def test_a_target_inside_a_wall_is_refused_and_the_arm_stays(watched: Watched):
    before = watched.session.status.q
    watched.aim(INSIDE)
    watched.go(1.0)
    status = watched.session.status
    assert status.activity is Activity.BLOCKED
    assert "cannot be reached without contact" in status.refusal
    assert "wall" in status.refusal
    np.testing.assert_allclose(status.q, before, atol=1e-3)
    watched.session.set_avoiding(False)
    watched.go(0.5)
    assert watched.session.status.activity is not Activity.BLOCKED
    assert not watched.session.status.avoiding
    watched.aim(BESIDE)
    watched.go(2.0)
    watched.session.set_avoiding(True)


def test_joints_that_are_commanded_through_a_wall_go_around_it_too(watched: Watched):
    q = armctl.solve_ik(watched.arm, OPPOSITE, watched.session.status.q).q
    watched.session.move_joints(q)
    watched.go(7.0)
    np.testing.assert_allclose(watched.session.status.q, q, atol=1e-5)
    assert watched.session.status.path is not None
    assert watched.nearest > 0.0


def test_a_new_target_stops_the_arm_on_its_planned_path(watched: Watched):
    watched.aim(OPPOSITE)
    watched.go(0.6)
    path = watched.session.status.path
    assert path is not None
    watched.aim(BESIDE)
    watched.go(6.0)
    np.testing.assert_allclose(watched.arm.fk(watched.session.status.q).position, BESIDE, atol=1e-3)
    assert watched.nearest > 0.0


def test_the_speed_override_slows_the_motion_within_all_limits(watched: Watched):
    reference = watched.session._follower.reference
    watched.aim(OPPOSITE)
    rows = []
    for k in range(700):
        if k in (60, 200):
            watched.session.set_speed_override({60: 0.2, 200: 1.0}[k])
        watched.go(UPDATE_INTERVAL_S)
        rows.append(reference.q)
    t = UPDATE_INTERVAL_S * np.arange(len(rows))
    v = np.gradient(rows, t, axis=0)
    a = np.gradient(v, t, axis=0)
    limits = watched.arm.limits
    assert watched.session.status.activity is Activity.AT_TARGET
    assert watched.session.status.speed_override == 1.0
    assert (np.abs(v) / limits.v_max).max() < 1.0
    assert (np.abs(a) / limits.a_max).max() < 1.0
    share = np.abs(v / limits.v_max).max(axis=1)
    assert share[170:200].max() < 0.3 * share.max()  # slow in between
    with pytest.raises(armctl.InputError, match="share"):
        watched.session.set_speed_override(0.0)


def test_a_goal_for_which_the_motors_are_too_weak_is_refused_with_the_reason():
    arm = armctl.load(BUNDLED)
    weak = arm.with_limits(replace(arm.limits, tau_max=np.array([50.0, 3.4, 30.0])))
    watched = RealTimeSession(weak)
    watched.move_joints(np.array([0.5, 0.0, 0.0]))
    for _ in range(100):
        watched.advance()
        while watched._follower.is_planning and watched._follower._planning.move is None:
            time.sleep(1e-3)
    assert watched.status.activity is Activity.BLOCKED
    assert "the limit is 3.4 N m; take a lighter payload" in watched.status.refusal
    assert weak.limits.contains(watched.status.q)


def test_an_orientation_out_of_reach_is_said_even_where_differential_kinematics_swings_about_it():
    session = RealTimeSession(armctl.load(BUNDLED))
    session.set_oriented(True)
    session.aim(Pose([0.2, 0.2, 0.35], rpy=[2.5, 0.3, 0.0]))
    for _ in range(round(4.0 / UPDATE_INTERVAL_S)):
        session.advance()
    status = session.status
    assert status.activity is Activity.OUT_OF_REACH
    assert describe(status) == "this orientation is out of reach here"
    assert status.position_error < 1e-3
