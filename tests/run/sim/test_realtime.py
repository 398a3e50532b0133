"""The real-time session, stepped by hand: it follows its target, executes commands, and reports what it does."""

import html
import threading
import time
from dataclasses import FrozenInstanceError, replace

import mujoco
import numpy as np
import pytest
from arms import BUNDLED, arm_of, some_of
from synthetic import limb, mjcf, motors

from armctl import InputError, Pose, UnknownNameError, load, solve_ik
from armctl.view.realtime.clock import MAX_SPEED, MIN_SPEED, RealTimeClock
from armctl.view.realtime.follower_reference import FollowerReference
from armctl.view.realtime.history import DURATION_S
from armctl.view.realtime.session import UPDATE_INTERVAL_S, RealTimeSession
from armctl.view.realtime.status import Activity
from armctl.view.status_text import describe, readings

SOME = ["robot_arm_3dof", "panda", "ur5e", "xarm7", "so_arm100", "endless", "gantry"]


def go(session: RealTimeSession, seconds: float) -> None:
    """Advances a session; the time in which its thread plans a path does not count, because it differs from run to run."""
    updates = round(seconds / UPDATE_INTERVAL_S)
    while updates > 0:
        session.advance()
        if session.status.activity is Activity.PLANNING:
            time.sleep(1e-3)
        else:
            updates -= 1


def tip_error(session: RealTimeSession) -> float:
    return float(np.linalg.norm(session.arm.fk(session.status.q).position - session.status.target.position))


@pytest.mark.parametrize("name", some_of(["panda", "ur5e", "xarm7"]))
def test_the_first_target_can_be_moved_without_turning_the_tool(name: str):
    session = RealTimeSession(arm_of(name))
    first = session.status.target
    for shift in 0.07 * np.vstack([np.eye(3), -np.eye(3)]):
        assert solve_ik(session.arm, Pose(first.position + shift, quat=first.quat)).ok, shift


@pytest.mark.parametrize("name", some_of(SOME, ["robot_arm_3dof", "gantry"]))
def test_the_arm_goes_to_the_target_and_follows_it(name: str):
    session = RealTimeSession(arm_of(name))
    go(session, 4.0)
    assert session.status.activity is Activity.AT_TARGET
    away = session.arm.fk(session.arm.limits.clamp(session.status.q + 0.15))
    session.aim(away)
    go(session, 4.0)
    assert tip_error(session) < 1e-3, session.status
    assert session.status.target is away


@pytest.mark.parametrize("name", some_of(SOME, ["robot_arm_3dof", "gantry"]))
def test_what_is_out_of_reach_is_said_and_the_arm_comes_to_rest(name: str):
    session = RealTimeSession(arm_of(name))
    far = session.status.target.position + np.array([50.0, 0.0, 0.0])
    session.aim(Pose(far, quat=session.status.target.quat))
    go(session, 20.0 if name == "gantry" else 8.0)
    assert session.status.activity is Activity.OUT_OF_REACH
    assert session.status.reach_errors == {session.arm.tip: pytest.approx(tip_error(session), rel=0.01, abs=2e-3)}
    before = session.status.q
    go(session, 0.5)
    assert np.abs(session.status.q - before).max() < 1e-3


def test_a_target_that_keeps_moving_is_followed():
    session = RealTimeSession(arm_of("redundant"))
    go(session, 2.0)
    center, errors = session.status.target, []
    for k in range(400):
        angle = 2 * np.pi * k / 200
        session.aim(Pose(center.position + 0.05 * np.array([0.0, np.sin(angle), np.cos(angle) - 1.0]), quat=center.quat))
        session.advance()
        errors.append(tip_error(session))
    assert session.history.read().to_reference[-400:].max() < 1e-6  # computed torque on an exact model, all the way
    assert max(errors[100:]) < 0.03  # at 0.16 m/s, a lag of less than 0.2 s


def test_a_wild_target_never_breaks_the_limits_of_the_joints():
    arm, rng = arm_of("redundant"), np.random.default_rng(0)
    guide, dt = FollowerReference(arm, arm.dt, arm.home, lambda pieces: ""), arm.dt
    taken = 0
    rows = []
    for k in range(400):
        if k % 40 == 0:
            guide.set_speed(rng.uniform(0.2, 1.0))
        taken += guide.go_to(rng.uniform(arm.limits.q_min, arm.limits.q_max))
        rows.append(guide.next(5))
    assert taken > 150
    q = np.concatenate([row.q for row in rows])
    assert arm.limits.contains(q, 1e-9)
    v = np.diff(q, axis=0) / dt
    a = np.diff(v, axis=0) / dt
    j = np.diff(a, axis=0) / dt
    for rate, bound in ((v, arm.limits.v_max), (a, arm.limits.a_max), (j, arm.limits.j_max)):
        assert (np.abs(rate) / bound).max() < 1 + 1e-4
    # The differences that the discrete controller uses are those of the reference itself, across all changes of the goal.
    v_tick, a_tick = (np.concatenate([getattr(row, name) for row in rows]) for name in ("v_tick", "a_tick"))
    np.testing.assert_allclose(v_tick[1:], v, atol=1e-9)
    np.testing.assert_allclose(a_tick[1:-1], a, atol=1e-6)


def test_switching_the_controller_and_the_payload_shows_in_the_error():
    session = RealTimeSession(arm_of("panda"))
    go(session, 2.0)
    exact = session.history.read().to_reference[-1]
    session.set_payload(2.0)
    go(session, 2.0)
    burdened = session.history.read().to_reference[-1]
    session.set_controller("pd")
    go(session, 4.0)
    sagging = session.history.read().to_reference[-1]
    assert exact < 1e-6 < 5e-3 < burdened < sagging
    assert session.status.activity is Activity.SAGGING
    assert (session.status.controller, session.status.payload) == ("pd", 2.0)
    session.set_payload(0.0)
    session.set_controller("computed-torque")
    go(session, 3.0)
    assert session.history.read().to_reference[-1] < 1e-6


def test_the_joints_can_be_steered_and_the_target_follows():
    session = RealTimeSession(arm_of("redundant"))
    goal = session.arm.home + 0.2
    session.move_joints(goal)
    go(session, 2.0)
    np.testing.assert_allclose(session.status.q, goal, atol=1e-6)
    assert session.status.joint_control
    assert session.status.target.distance(session.arm.fk(goal))[0] < 1e-9


def test_the_gripper_moves_while_the_arm_holds_its_place():
    session = RealTimeSession(arm_of("panda"))
    go(session, 2.0)
    tip = session.arm.tip
    assert list(session.status.gripper_widths) == [tip]
    assert not RealTimeSession(arm_of(BUNDLED)).status.gripper_widths
    for width in (0.02, 0.06):
        session.grip(width)
        go(session, 0.1)
        assert session.status.gripper_widths[tip] == pytest.approx(width, abs=2e-3)
        assert tip_error(session) < 1e-3
    session.set_payload(0.5)
    go(session, 0.1)
    assert session.status.gripper_widths[tip] == pytest.approx(0.06, abs=2e-3)
    session.reset()
    go(session, 4.0)
    assert session.status.activity is Activity.SAGGING  # under 0.5 kg that the controller does not know
    assert session.status.payload == 0.5


def test_pause_holds_time_and_reset_starts_afresh():
    session = RealTimeSession(arm_of(BUNDLED))
    go(session, 0.1)
    session.pause(True)
    before = session.status.q
    go(session, 0.5)
    assert session.status.activity is Activity.PAUSED
    np.testing.assert_array_equal(session.status.q, before)
    session.pause(False)
    first = RealTimeSession(arm_of(BUNDLED)).status.target
    session.aim(Pose([0.2, -0.2, 0.4]))
    go(session, 1.0)
    session.reset()
    session.advance()
    assert session.status.target == first
    np.testing.assert_allclose(session.status.q, session.arm.home, atol=0.01)


def test_a_keyframe_puts_everything_there_and_contact_forces_bear_the_weight():
    spec = mujoco.MjSpec.from_string(mjcf(limb("a b c"), motors("a b c")))
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[3, 3, 0.1], pos=[0, 0, -2])
    box = spec.worldbody.add_body(name="box", pos=[2, 2, -1.9])
    box.add_freejoint()
    box.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.1, 0.1, 0.1], mass=2.0)
    bent = np.array(spec.compile().qpos0)
    bent[:3] = 0.2
    spec.add_key(name="bent", qpos=bent)
    session = RealTimeSession(load(spec.compile()))
    assert "bent" in session.keyframes
    session.reset("bent")
    go(session, 0.5)
    np.testing.assert_allclose(session.status.q, 0.2, atol=1e-3)
    point = session.status.contacts[:, 0]
    force = session.status.contacts[:, 1]
    np.testing.assert_allclose(force.sum(axis=0), [0.0, 0.0, 2.0 * 9.81], atol=0.1)
    np.testing.assert_allclose(point[:, 2], -2.0, atol=1e-2)
    with pytest.raises(UnknownNameError, match="keyframe"):
        session.reset("bend")


def test_an_arm_that_runs_away_says_so_and_reset_brings_it_back():
    session = RealTimeSession(arm_of(BUNDLED))
    session._controller = type("Wild", (), {"torque": lambda self, state, setpoint: np.full(3, np.nan)})()
    go(session, 0.1)
    assert session.status.activity is Activity.DIVERGED
    assert "no finite torque" in session.status.failure
    session.set_controller("computed-torque")
    session.reset()
    go(session, 3.0)
    assert session.status.activity is Activity.AT_TARGET


def test_orientation_counts_only_where_it_is_said_to():
    session = RealTimeSession(arm_of("redundant"))
    assert session.status.oriented
    assert not RealTimeSession(arm_of(BUNDLED)).status.oriented
    upside_down = Pose(session.status.target.position, rpy=[0.0, 0.0, 0.0])
    session.aim(upside_down)
    session.set_oriented(False)
    go(session, 4.0)
    assert session.status.activity is Activity.AT_TARGET


def test_the_history_is_the_last_ten_seconds():
    session = RealTimeSession(arm_of(BUNDLED))
    go(session, DURATION_S + 1.0)
    past = session.history.read()
    assert np.isfinite(past.to_target).all()
    np.testing.assert_allclose(np.diff(past.t), UPDATE_INTERVAL_S)
    assert past.torque_share.shape == (len(past.t), 3)


WRONG_CALLS = {
    "set_controller": ["pdd"],
    "set_payload": [-1.0, float("nan"), "heavy"],
    "set_speed": [0.0, 5e-324, -1.0, 1e300, float("nan"), float("inf")],
    "grip": [float("nan"), "wide"],
    "move_joints": [[0.0, 0.0], [float("nan"), 0.0, 0.0], "home"],
    "aim": [[0.2, 0.0, 0.4], None],
}


@pytest.mark.parametrize(("method", "value"), [(method, value) for method, values in WRONG_CALLS.items() for value in values])
def test_a_wrong_command_is_refused_at_once_and_changes_nothing(method: str, value):
    session = RealTimeSession(arm_of(BUNDLED))
    with pytest.raises(UnknownNameError if method == "set_controller" else InputError):
        getattr(session, method)(value)
    go(session, 2.0)
    assert session.status.activity is Activity.AT_TARGET


@pytest.mark.parametrize("broken", ["_controller", "_follower.reference", "_follower._ik", "_grippers"])
def test_a_defect_anywhere_is_reported_and_reset_repairs_the_session(broken: str, monkeypatch, caplog):
    session = RealTimeSession(arm_of("panda"))

    class Broken:
        def __getattr__(self, name: str):
            raise ZeroDivisionError("a defect")

    go(session, 0.1)
    with monkeypatch.context() as patch:
        owner, _, name = broken.rpartition(".")
        patch.setattr(getattr(session, owner) if owner else session, name, Broken())
        session.aim(Pose([0.4, 0.2, 0.4]))
        session.grip(0.02)
        go(session, 0.1)
        assert session.status.activity in (Activity.FAILED, Activity.DIVERGED)
        assert "a defect" in session.status.failure
        assert not session.advance()
    session.reset()
    go(session, 3.0)
    assert session.status.activity is Activity.AT_TARGET
    assert session.status.failure == ""


def test_a_failing_thread_is_never_shown_as_at_the_target(monkeypatch, caplog):
    session = RealTimeSession(arm_of(BUNDLED))
    go(session, 3.0)
    assert session.status.activity is Activity.AT_TARGET

    def broken(*args) -> None:
        raise SystemExit("the thread ends")

    monkeypatch.setattr(session._clock, "wait", broken)
    session.start()
    assert session._thread is not None
    session._thread.join(timeout=60.0)
    assert not session._thread.is_alive()
    assert session.status.activity is Activity.FAILED


def test_a_status_is_a_snapshot_that_nobody_can_change():
    session = RealTimeSession(arm_of(BUNDLED))
    before = session.status
    q = before.q.copy()
    go(session, 0.5)
    np.testing.assert_array_equal(before.q, q)
    assert session.status is not before
    with pytest.raises(FrozenInstanceError):
        before.payload = 1.0  # type: ignore[misc]
    with pytest.raises(ValueError, match="read-only"):
        before.q[0] = 1.0


def test_a_newer_command_of_the_same_kind_replaces_an_older_one():
    session = RealTimeSession(arm_of(BUNDLED))
    for payload in (0.1, 0.2, 0.3):
        session.set_payload(payload)
    assert len(session._commands) == 1
    session.advance()
    assert session.status.payload == 0.3


def test_stopping_does_not_wait_for_the_gripper():
    session = RealTimeSession(arm_of("panda"))
    session.start()
    session.grip(0.0)
    while session.status.gripper_widths[session.arm.tip] > 0.07:
        time.sleep(0.001)
    session.stop()
    assert session._thread is not None
    session._thread.join(timeout=60.0)
    assert not session._thread.is_alive()
    assert session.status.gripper_widths[session.arm.tip] > 0.0


def test_the_clock_keeps_time_and_catches_up():
    clock = RealTimeClock()
    started = time.perf_counter()
    time.sleep(0.03)
    for _ in range(20):
        clock.wait(0.01)
    assert time.perf_counter() - started >= 0.2
    assert 0.0 < clock.real_time_factor <= 1.05


def test_a_clock_in_slow_motion_takes_a_new_speed_while_it_waits():
    clock = RealTimeClock(MIN_SPEED)
    waiting = threading.Thread(target=clock.wait, args=(1.0,), daemon=True)  # 1000 s
    waiting.start()
    time.sleep(0.02)
    clock.speed = MAX_SPEED
    waiting.join(timeout=30.0)
    assert not waiting.is_alive()


@pytest.mark.parametrize("speed", [0.0, MIN_SPEED / 2, 2 * MAX_SPEED, float("nan"), -1.0])
def test_the_clock_refuses_a_speed_out_of_range(speed: float):
    clock = RealTimeClock(0.5)
    with pytest.raises(InputError, match="speed"):
        clock.speed = speed
    assert clock.speed == 0.5


STATUS_SENTENCES = {
    Activity.FOLLOWING: "following, 12 mm to go",
    Activity.PLANNING: "planning a path around what is in the way",
    Activity.BLOCKED: "wall and link would touch",
    Activity.AT_TARGET: "at the target, error 12 mm",
    Activity.OUT_OF_REACH: "out of reach by 34 mm",
    Activity.SAGGING: "steady-state error 12 mm with pd and 2 kg",
    Activity.PAUSED: "paused",
    Activity.DIVERGED: "a defect; press reset",
    Activity.FAILED: "a defect; press reset",
}


@pytest.mark.parametrize("activity", Activity)
def test_each_activity_has_its_sentence(activity: Activity):
    status = replace(
        RealTimeSession(arm_of(BUNDLED)).status,
        activity=activity,
        failure="a defect" if activity in (Activity.DIVERGED, Activity.FAILED) else "",
        position_error=0.012,
        reach_errors={"tip": 0.034} if activity is Activity.OUT_OF_REACH else {},
        refusal="wall and link would touch" if activity is Activity.BLOCKED else "",
        controller="pd",
        payload=2.0,
    )
    assert describe(status) == STATUS_SENTENCES[activity]


def test_an_error_has_one_number_wherever_it_is_shown():
    session = RealTimeSession(arm_of(BUNDLED))
    for error, text in ((3e-6, "<0.01 mm"), (2.5e-5, "0.025 mm"), (0.0123, "12.3 mm")):
        status = replace(session.status, activity=Activity.AT_TARGET, position_error=error)
        samples = session.history.read()
        samples.to_reference[-1] = error
        samples.torque_share[-1] = 0.1
        assert describe(status) == f"at the target, error {text}"
        assert html.escape(text) in readings(samples, session.arm.joint_names, 1.0)


def test_only_a_target_that_somebody_holds_is_to_be_released():
    status = replace(RealTimeSession(arm_of(BUNDLED)).status, activity=Activity.BLOCKED, refusal="wall and link would touch")
    assert describe(status) == "wall and link would touch"
    assert describe(status, is_held=True) == "wall and link would touch; release the target to plan around"


def test_a_tip_within_a_millimetre_of_a_moving_target_has_nothing_to_go():
    status = replace(RealTimeSession(arm_of(BUNDLED)).status, activity=Activity.FOLLOWING, position_error=3e-4)
    assert describe(status) == "following"


def test_an_unreachable_orientation_has_its_sentence():
    status = RealTimeSession(arm_of(BUNDLED)).status
    status = replace(status, activity=Activity.FOLLOWING, reach_errors={"tip": 0.0}, position_error=0.012)
    assert describe(status) == "following, 12 mm to go; this orientation is out of reach here"
