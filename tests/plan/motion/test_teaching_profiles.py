"""Trapezoids and quintics of textbooks: their closed forms, and what `check_limits` says about their jerk."""

from dataclasses import replace

import numpy as np
import pytest
from arms import arm_of

import armctl

N = 3
V = np.array([1.0, 2.0, 1.5])
A = np.array([4.0, 5.0, 3.0])


@pytest.fixture(scope="module")
def arm() -> armctl.Arm:
    arm = arm_of("robot_arm_3dof")
    return arm.with_limits(replace(arm.limits, v_max=V, a_max=A, j_max=np.full(N, 20.0), tau_max=np.full(N, np.inf)))


def test_a_trapezoid_takes_the_time_of_its_closed_form(arm):
    """A way s at v and a along the line: s / v + v / a with a cruise, 2 sqrt(s / a) without."""
    for size in (1.0, 0.02):
        way = size * np.array([0.5, -0.4, 0.3])
        v = (V / np.abs(way)).min()
        a = (A / np.abs(way)).min()
        expected = 1 / v + v / a if v**2 < a else 2 / np.sqrt(a)
        motion = armctl.move_j(arm, arm.home, arm.home + way, profile="trapezoid")
        assert motion.duration == pytest.approx(expected, rel=1e-12)
        assert np.allclose(motion(motion.duration).q, arm.home + way, atol=1e-14)
        samples = motion.sample(np.linspace(0.0, motion.duration, 5000))
        assert (np.abs(samples.v).max(axis=0) / V).max() == pytest.approx(1.0 if v**2 < a else np.sqrt(a) / v, rel=1e-3)
        assert (np.abs(samples.a).max(axis=0) / A).max() == pytest.approx(1.0, rel=1e-12)
        # velocity is continuous, and the integral of the acceleration
        assert np.abs(np.diff(samples.v, axis=0)).max() <= A.max() * motion.duration / 4998


def test_a_quintic_is_the_polynomial_of_the_textbook(arm):
    way = np.array([0.5, -0.4, 0.3])
    motion = armctl.move_j(arm, arm.home, arm.home + way, profile="quintic")
    T = motion.duration
    x = np.linspace(0.0, 1.0, 101)
    assert np.allclose(motion.sample(T * x).q, arm.home + (10 * x**3 - 15 * x**4 + 6 * x**5)[:, None] * way, atol=1e-13)
    peaks = {peak.quantity: peak.ratio for peak in motion.check_limits().peaks if peak.quantity in ("velocity", "acceleration")}
    assert max(peaks.values()) <= 1 + 1e-9
    worst = max(peak.ratio for peak in motion.check_limits().peaks if peak.quantity in ("velocity", "acceleration"))
    assert worst == pytest.approx(1.0, rel=1e-9)
    assert motion(0.0).a == pytest.approx(np.zeros(N), abs=1e-12)


def test_check_limits_prints_the_violation_of_the_jerk(arm):
    goal = arm.home + np.array([0.5, -0.4, 0.3])
    trapezoid = armctl.move_j(arm, arm.home, goal, profile="trapezoid").check_limits()
    assert not trapezoid.ok
    assert {peak.quantity for peak in trapezoid.violations} == {"jerk"}
    assert all(np.isinf(peak.value) for peak in trapezoid.violations)
    assert "jerk -inf rad/s^3 at" in str(trapezoid) or "jerk inf rad/s^3 at" in str(trapezoid)
    assert "limit" in str(trapezoid)
    quintic = armctl.move_j(arm, arm.home, goal, profile="quintic")
    peak = quintic.check_limits().violations[0]
    assert peak.quantity == "jerk"
    assert abs(peak.value) == pytest.approx(60 * np.abs(goal - arm.home).max() / quintic.duration**3)
    assert armctl.move_j(arm, arm.home, goal).check_limits().ok


def test_every_motion_of_armctl_has_a_continuous_acceleration(arm):
    """What check_limits says of a jump is about the trapezoid: no planner makes one."""
    motions = [
        armctl.move_j(arm, arm.home, arm.home + 0.4, straight=False),
        armctl.move_through(arm, [arm.home, arm.home + 0.3, arm.home - 0.2]),
        armctl.move_l(arm, arm.home, arm.fk(arm.home).position + np.array([0.0, 0.05, 0.02])),
    ]
    motions.append(motions[0].stopped_at(0.5 * motions[0].duration))
    motions.append(armctl.move_sequence(arm, [motions[1], armctl.move_j(arm, arm.home - 0.2, arm.home)], blend=0.05))
    for motion in motions:
        assert motion.check_limits().ok


def test_a_duration_and_a_weak_motor_slow_a_profile_down_as_a_whole():
    arm = arm_of("robot_arm_3dof")
    goal = arm.home + np.array([0.5, -0.4, 0.3])
    for profile in ("trapezoid", "quintic"):
        motion = armctl.move_j(arm, arm.home, goal, profile=profile)
        assert armctl.move_j(arm, arm.home, goal, profile=profile, duration=3.0).duration == pytest.approx(3.0)
        half = 0.5 * np.array(armctl.check_torque(arm, motion).ratios) + 0.5 * np.abs(arm.gravity(goal)) / arm.limits.tau_max
        weak = arm.with_limits(replace(arm.limits, tau_max=np.maximum(half, 1e-3) * arm.limits.tau_max))
        slower = armctl.move_j(weak, arm.home, goal, profile=profile)
        assert armctl.check_torque(weak, slower).ok
        assert slower.slowed is not None
        assert slower.slowed.factor == pytest.approx(slower.duration / motion.duration)


def test_a_profile_is_for_straight_moves_from_rest_to_rest(arm):
    moving = armctl.Setpoint(arm.home, 0.1 * V, np.zeros(N))
    with pytest.raises(armctl.InputError, match="profile: 'quintic' is for straight moves from rest to rest"):
        armctl.move_j(arm, moving, arm.home + 0.1, profile="quintic")
    with pytest.raises(armctl.InputError, match="profile: 'trapezoid' is for straight moves"):
        armctl.move_j(arm, arm.home, arm.home + 0.1, profile="trapezoid", straight=False)
    with pytest.raises(armctl.InputError, match="profile: expected one of jerk-limited, trapezoid, quintic, got 'cubic'"):
        armctl.move_j(arm, arm.home, arm.home + 0.1, profile="cubic")
    assert armctl.move_j(arm, arm.home, arm.home, profile="quintic").duration == 0.0
