"""The check of rows against what the maker publishes, before anything is sent."""

from dataclasses import replace

import numpy as np
import pytest
from arms import arm_of
from hypothesis import given, settings
from hypothesis import strategies as st

import armctl
from armctl.run.links.envelope import envelope_of

DT = 0.002


def envelope() -> armctl.Envelope:
    return envelope_of(arm_of("robot_arm_3dof").limits, "a test")


def rows_of(seed: int, speed: float) -> np.ndarray:
    arm = arm_of("robot_arm_3dof")
    q = arm.limits.random(arm.home, 2, np.random.default_rng(seed))
    trajectory = armctl.move_j(arm.with_limits(envelope().planning_limits(arm.limits, speed)), *q)
    return trajectory.sample(DT * np.arange(int(trajectory.duration / DT) + 3)).q


@given(seed=st.integers(0, 1000), speed=st.floats(0.05, 1.0))
@settings(max_examples=40, deadline=None)
def test_what_is_planned_with_its_limits_passes(seed: int, speed: float):
    rows = rows_of(seed, speed)
    assert envelope().refusal(rows, rows[:1].repeat(3, axis=0), DT) == ""


@given(seed=st.integers(0, 1000), tick=st.integers(0, 10_000), joint=st.integers(0, 2), step=st.floats(1e-3, 0.1))
@settings(max_examples=40, deadline=None)
def test_a_step_is_refused_with_its_joint_and_its_time(seed: int, tick: int, joint: int, step: float):
    rows = rows_of(seed, 0.5)
    tick %= len(rows)
    rows[tick:, joint] += step
    reason = envelope().refusal(rows, rows_of(seed, 0.5)[:1].repeat(3, axis=0), DT)
    assert reason.startswith(f"joint {joint + 1} ")
    assert f"at {DT * tick:.3f} s (a test)" in reason


def test_speed_depends_on_the_distance_to_the_end_of_the_range():
    arm = arm_of("robot_arm_3dof")
    limits = replace(envelope().limits, velocity_offset=np.full(3, 0.3), deceleration_limit=np.full(3, 6.0))
    near = replace(envelope(), limits=limits)
    q = np.array([[0.0, 0.0, -1.0], arm.limits.q_max - 0.05, arm.limits.q_max - 0.001])
    low, high = near.speed_limits(q)
    assert high[0] == pytest.approx(near.limits.v_max - 1e-3)
    assert high[1] == pytest.approx(np.full(3, np.sqrt(2 * 6.0 * 0.05) - 0.3 - 1e-3))
    assert (high[2] <= 0.0).all()
    assert low[2] == pytest.approx(-near.limits.v_max + 1e-3)
    standing = q[2:].repeat(4, axis=0)
    assert near.refusal(standing, standing[:3], DT) == ""


def test_a_position_outside_the_range_is_named():
    arm = arm_of("robot_arm_3dof")
    q = np.tile(arm.limits.q_max + 1e-3, (4, 1))
    assert envelope().refusal(q, q[:3], DT).startswith("joint 1 is at 3.141 rad, outside [-3.14, 3.14]")


def test_a_wrong_speed_is_refused():
    with pytest.raises(armctl.InputError, match="speed"):
        envelope().planning_limits(arm_of("robot_arm_3dof").limits, 0.0)
