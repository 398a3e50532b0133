"""Targets whose velocity the source knows, as that of a conveyor."""

import numpy as np
import pytest
from arms import arm_of

import armctl

DT = 2e-3
RATE = 20.0


@pytest.fixture(scope="module")
def arm() -> armctl.Arm:
    return arm_of("robot_arm_3dof")


def errors_behind_a_belt(arm: armctl.Arm, *, tells_velocity: bool, noise: float = 0.0) -> np.ndarray:
    """(T,) rad, the largest distance of a joint from a belt that moves from the first target on."""
    velocity = np.array([0.3, -0.2, 0.25])
    stream = armctl.Stream(arm, arm.home)
    rng = np.random.default_rng(0)
    errors = []
    due = 0.0
    while stream.t < 1.5:
        if stream.t >= due - 1e-9:
            due += 1 / RATE
            target = arm.home + velocity * stream.t + noise * rng.standard_normal(3)
            stream.push(stream.t, target, *([velocity] if tells_velocity else []))
        point = stream.step(DT)
        assert arm.limits.contains(point.q)
        assert (np.abs(point.v) <= arm.limits.v_max * (1 + 1e-6)).all()
        assert (np.abs(point.a) <= arm.limits.a_max * (1 + 1e-6)).all()
        errors.append(np.abs(point.q - arm.home - velocity * stream.t).max())
    return np.array(errors)


def test_a_target_with_its_velocity_is_followed_from_the_first_one_on(arm):
    told = errors_behind_a_belt(arm, tells_velocity=True)
    guessed = errors_behind_a_belt(arm, tells_velocity=False)
    half_a_second = int(0.5 / DT)
    assert told[half_a_second:].max() < 1e-7
    assert told.max() < 0.7 * guessed.max()


def test_the_velocity_of_a_noisy_target_is_believed(arm):
    """Noise of 5 mrad moves the arm by as much, and not by what it makes of a difference of two targets."""
    told = errors_behind_a_belt(arm, tells_velocity=True, noise=5e-3)
    assert told[int(0.5 / DT) :].max() < 0.02


def test_a_chunk_with_velocities_is_passed_with_them_also_at_its_end(arm):
    times = 0.3 + 0.1 * np.arange(8)
    velocity = np.array([0.3, -0.2, 0.25])
    rows = arm.home + np.outer(times - 0.15, velocity)
    stream = armctl.Stream(arm, arm.home)
    stream.push_chunk(times, rows, np.tile(velocity, (8, 1)), np.zeros((8, 3)))
    stream.step(float(times[-1]))
    assert stream.setpoint.q == pytest.approx(rows[-1], abs=1e-9)
    assert stream.setpoint.v == pytest.approx(velocity, abs=1e-7)
    stream.step(stream.time_left)
    assert stream.setpoint.q == pytest.approx(rows[-1], abs=1e-7)
    assert np.abs(stream.setpoint.v).max() < 1e-7


def test_a_single_target_ahead_is_passed_with_its_velocity(arm):
    velocity = np.array([0.1, 0.1, -0.1])
    stream = armctl.Stream(arm, arm.home)
    stream.push(1.0, arm.home + 0.1, velocity)
    stream.step(1.0)
    assert stream.setpoint.q == pytest.approx(arm.home + 0.1, abs=1e-9)
    assert stream.setpoint.v == pytest.approx(velocity, abs=1e-7)


def test_wrong_velocities_are_refused_and_change_nothing(arm):
    stream = armctl.Stream(arm, arm.home)
    with pytest.raises(armctl.InputError, match="v: expected 3 numbers"):
        stream.push(0.0, arm.home, [0.1, 0.2])
    with pytest.raises(armctl.InputError, match="a: accelerations need the velocities"):
        stream.push(0.0, arm.home, a=np.zeros(3))
    with pytest.raises(armctl.InputError, match="v: 1 rows for 2 targets"):
        stream.push_chunk([0.1, 0.2], [arm.home, arm.home], np.zeros((1, 3)))
    assert stream.report.targets == 0
    assert stream.time_left == 0.0
