"""Sections of a path with limits of their own: kept in the section, left again after it, with pauses at given positions."""

from dataclasses import replace

import numpy as np
import pytest
from arms import arm_of

import armctl
from armctl import Line, Via

WAYPOINTS = ([0.4, 0.3, -0.3], [0.9, 0.0, 0.2], [0.2, -0.2, 0.1])


@pytest.fixture(scope="module")
def arm():
    arm = arm_of("robot_arm_3dof")
    return arm.with_limits(replace(arm.limits, tau_max=np.full(3, np.inf)))


def times_of(arm, motion, points):
    """When the motion passes each of the points, s."""
    times = np.linspace(0.0, motion.duration, 20_001)
    q = motion.sample(times).q
    return [float(times[np.abs(q - point).max(axis=1).argmin()]) for point in points]


def test_a_slow_section_is_slow_and_the_others_are_not(arm):
    points = [arm.home, *(arm.home + np.array(way) for way in WAYPOINTS)]
    plain = armctl.move_through(arm, points)
    slow = armctl.move_through(arm, [points[0], points[1], Via(points[2], speed=0.3), points[3]])
    assert slow.check_limits().ok
    begins, ends = (np.diff(times_of(arm, motion, points)) for motion in (plain, slow))
    assert ends[1] == pytest.approx(begins[1] / 0.3, rel=0.01)
    assert ends[0] < 1.6 * begins[0]
    assert ends[2] < 1.6 * begins[2]
    assert slow.slowed is None
    for point in points:
        assert np.abs(slow.sample(np.linspace(0.0, slow.duration, 20_001)).q - point).max(axis=1).min() < 1e-3


def test_a_gentle_section_keeps_its_share_of_the_acceleration_limits(arm):
    points = [arm.home, *(arm.home + np.array(way) for way in WAYPOINTS)]
    gentle = armctl.move_through(arm, [points[0], points[1], Via(points[2], acceleration=0.4), points[3]])
    begin, end = times_of(arm, gentle, points[1:3])
    inside = gentle.sample(np.linspace(begin + 1e-3, end - 1e-3, 2000)).a
    assert 0.9 * 0.4 < (np.abs(inside) / arm.limits.a_max).max() < 0.4 * (1 + 1e-6)
    assert np.abs(gentle.sample(np.linspace(0.0, gentle.duration, 4000)).a / arm.limits.a_max).max() > 0.6
    assert gentle.check_limits().ok


def test_a_payload_slows_its_section_only():
    arm = arm_of("robot_arm_3dof")
    points = [arm.home, *(arm.home + np.array(way) for way in WAYPOINTS)]
    need = armctl.check_torque(arm.with_payload(1.0), armctl.move_through(arm, points))
    weak = arm.with_limits(replace(arm.limits, tau_max=0.93 * np.array(need.ratios) * arm.limits.tau_max))
    plain = armctl.move_through(weak, points)
    loaded = armctl.move_through(weak, [points[0], points[1], Via(points[2], payload=1.0), points[3]])
    assert loaded.slowed is not None
    assert loaded.slowed.factor == pytest.approx(loaded.duration / armctl.move_through(arm, points).duration, rel=2e-3)
    assert loaded.duration > plain.duration
    begin, end = times_of(weak, loaded, points[1:3])
    q, v, a = loaded.sample(np.linspace(begin, end, 500))[:3]
    carrying = weak.with_payload(1.0)
    torques = np.array([carrying.inverse_dynamics(*row) for row in zip(q, v, a, strict=True)])
    assert (np.abs(torques) <= weak.limits.tau_max).all()
    assert loaded.check_limits().ok


def test_the_arm_stands_still_where_it_dwells(arm):
    points = [arm.home + np.array(way) for way in WAYPOINTS]
    motion = armctl.move_through(arm, [arm.home, points[0], Via(points[1], dwell=0.25), points[2]])
    still = np.abs(motion.sample(np.linspace(0.0, motion.duration, 4001)).v).max(axis=1) == 0.0
    assert still[1:-1].sum() * motion.duration / 4000 == pytest.approx(0.25, abs=2e-3)
    first = armctl.move_through(arm, [arm.home, *points[:2]])
    assert np.allclose(motion(first.duration + 0.1).q, points[1], atol=1e-9)
    assert motion.duration == pytest.approx(first.duration + 0.25 + armctl.move_through(arm, points[1:]).duration, rel=1e-9)


def test_lines_have_sections_and_pauses_too(arm):
    start = arm.fk(arm.home).position
    ways = ([0.0, 0.08, 0.0], [0.0, 0.08, -0.08], [0.0, 0.0, -0.08])
    plain = armctl.move_path(arm, arm.home, [start + way for way in ways], blend=0.02)
    slow = armctl.move_path(arm, arm.home, [start + ways[0], Line(start + ways[1], speed=0.25), start + ways[2]], blend=0.02)
    dwelling = armctl.move_path(arm, arm.home, [start + ways[0], Line(start + ways[1], dwell=0.5), start + ways[2]], blend=0.02)
    assert slow.check_limits().ok
    assert plain.duration < slow.duration < plain.duration / 0.25
    assert dwelling.duration > plain.duration + 0.5
    corner = np.array([arm.fk(q).position for q in dwelling.sample(np.linspace(0.0, dwelling.duration, 2000)).q])
    assert np.linalg.norm(corner - (start + ways[1]), axis=1).min() < 1e-6


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"speed": 0.0}, "speed: "),
        ({"speed": 1.5}, "speed: "),
        ({"acceleration": -1.0}, "acceleration: "),
        ({"payload": -0.1}, "payload: "),
        ({"dwell": -1.0}, "dwell: "),
    ],
)
def test_limits_of_a_section_are_checked(arm, limits, message):
    with pytest.raises(armctl.InputError, match=message):
        armctl.move_through(arm, [arm.home, Via(arm.home + 0.1, **limits)])
    with pytest.raises(armctl.InputError, match=message):
        armctl.move_path(arm, arm.home, [Line(arm.fk(arm.home + 0.1).position, **limits)])


@pytest.mark.parametrize("factor", [0.2, 0.7])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.6])
def test_an_override_changes_the_speed_and_not_the_path(arm, factor, share):
    motion = armctl.move_through(arm, [arm.home, *(arm.home + np.array(way) for way in WAYPOINTS)])
    begin = share * motion.duration
    slower = motion.overridden(begin, factor)
    before = np.linspace(0.0, begin, 50)
    assert np.allclose(slower.sample(before).q, motion.sample(before).q, atol=1e-12)
    assert slower.check_limits().ok
    late = np.linspace(0.0, 0.1 * motion.duration, 50)  # counted from the end: there the change is over
    one = slower.sample(slower.duration - late / factor)
    other = motion.sample(motion.duration - late)
    assert np.allclose(one.q, other.q, atol=1e-9)
    assert np.allclose(one.v, factor * other.v, atol=1e-7)
    assert motion.duration < slower.duration < begin + (motion.duration - begin) / factor


@pytest.mark.parametrize("share", [0.1, 0.4, 0.8])
def test_a_change_of_the_speed_has_a_knot_where_the_motion_has_one(arm, share):
    """The jerk of a motion jumps at its knots: a piece of the change across one would leave the motion between its samples."""
    motion = armctl.move_through(arm, [arm.home, *(arm.home + np.array(way) for way in WAYPOINTS)])
    begin = share * motion.duration
    slower = motion.overridden(begin, 0.7)
    at_knots = slower.sample(slower.knots).q
    later = motion.knots[motion.knots > begin]
    assert len(later) > 5
    for q in motion.sample(later).q:
        assert np.abs(at_knots - q).max(axis=1).min() < 1e-6


@pytest.mark.parametrize("change", [lambda motion, t: motion.overridden(t, 0.4), lambda motion, t: motion.stopped_at(t)])
def test_a_change_of_the_speed_that_begins_just_before_a_knot_has_no_jump(arm, change):
    motion = armctl.move_j(arm, arm.home - 0.4, arm.home + 0.4, speed=0.5)
    changed = change(motion, motion.knots[3] - 5e-6)
    assert changed.duration != motion.duration
    steps = np.diff(changed.knots)
    ends = np.einsum("mp,mpn->mn", steps[:, None] ** np.arange(6), changed.coefficients)
    assert np.abs(ends[:-1] - changed.coefficients[1:, 0]).max() < 1e-12


def test_an_override_can_be_taken_back(arm):
    motion = armctl.move_j(arm, arm.home - 0.4, arm.home + 0.4)
    slower = motion.overridden(0.2 * motion.duration, 0.4)
    again = slower.overridden(0.5 * motion.duration, 1 / 0.4)
    assert again.check_limits().ok
    assert motion.duration < again.duration < slower.duration
    assert np.allclose(again(again.duration).q, arm.home + 0.4, atol=1e-9)


def test_an_override_beyond_the_limits_gets_what_they_allow(arm):
    start = arm.home - 0.4
    fast = armctl.move_j(arm, start, arm.home + 0.4)
    assert np.array_equal(fast.overridden(0.1 * fast.duration, 3.0).coefficients, fast.coefficients)
    half = armctl.move_j(arm, start, arm.home + 0.4, speed=0.5)
    faster = half.overridden(0.2 * half.duration, 3.0)
    assert faster.check_limits().ok
    assert fast.duration < faster.duration < 0.2 * half.duration + 0.75 * fast.duration + 0.1


@pytest.mark.parametrize("share", [0.1, 0.4, 0.6, 0.9])
@pytest.mark.parametrize("way", [0.005, 0.2])
def test_an_override_of_a_short_motion_that_brakes_keeps_limits_and_goal(arm, way, share):
    motion = armctl.move_j(arm, arm.home, arm.home + way)
    begin = share * motion.duration
    slower = motion.overridden(begin, 0.2)
    assert slower.check_limits().ok
    assert motion.duration <= slower.duration < begin + (motion.duration - begin) / 0.2
    end = slower(slower.duration)
    assert np.allclose(end.q, arm.home + way, atol=1e-9)
    assert np.abs(end.v).max() < 1e-9


def test_the_arguments_of_an_override_are_checked(arm):
    motion = armctl.move_j(arm, arm.home - 0.4, arm.home + 0.4)
    with pytest.raises(armctl.InputError, match="factor: "):
        motion.overridden(0.1, 0.0)
    with pytest.raises(armctl.InputError, match="t: "):
        motion.overridden(-0.1, 0.5)
