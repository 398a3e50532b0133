"""The player: rows on the path, within the limits of the plan, and to rest, whatever is said to it and when."""

import numpy as np
import pytest
from arms import arm_of
from hypothesis import given, settings
from hypothesis import strategies as st

import armctl
from armctl.plan.motion.trajectory.piecewise import sample, standing
from armctl.run.links.host import Played, Player

DT = 0.002
LEAD = 5
ROUNDING = 1e-3  # relative: differences of rows


def planned(seed: int) -> tuple[armctl.Arm, armctl.JointTrajectory]:
    arm = arm_of("robot_arm_3dof")
    q = arm.limits.random(arm.home, 4, np.random.default_rng(seed))
    return arm, armctl.move_j(arm, q[0], q[1]) if seed % 2 else armctl.move_through(arm, q)


def greatest(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The greatest acceleration and jerk of rows that begin and end at rest."""
    q = np.vstack([rows[:1].repeat(3, axis=0), rows, rows[-1:].repeat(3, axis=0)])
    return np.abs(np.diff(q, 2, axis=0)).max(axis=0) / DT**2, np.abs(np.diff(q, 3, axis=0)).max(axis=0) / DT**3


def assert_within(limits: armctl.Limits, rows: np.ndarray) -> None:
    a, j = greatest(rows)
    assert (a <= (1 + ROUNDING) * limits.a_max).all(), a / limits.a_max
    assert (j <= (1 + ROUNDING) * limits.j_max).all(), j / limits.j_max


@pytest.mark.full
@given(seed=st.integers(0, 40), share=st.floats(0.0, 1.0))
@settings(max_examples=15, deadline=None)
def test_a_stop_at_any_time_stays_on_the_path_and_within_the_limits(seed: int, share: float):
    arm, trajectory = planned(seed)
    player = Player(trajectory(0.0).q, DT, arm.limits, LEAD)
    assert player.play(trajectory.pieces, 0) == Played(0)
    ticks = int(trajectory.duration / DT) + 1
    rows = [player.next() for _ in range(round(share * ticks))]
    player.stop()
    while player.tick <= player.end + 2:
        rows.append(player.next())
    path = sample(trajectory.pieces, np.linspace(0.0, trajectory.duration, 20 * ticks)).q
    gaps = [np.abs(path - row).max(axis=1).min() for row in rows[:: max(1, len(rows) // 40)]]
    assert max(gaps) < 2e-3
    assert len(rows) <= ticks + LEAD + 4
    assert_within(arm.limits, np.array(rows))


@given(seed=st.integers(0, 40), when=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=6), late=st.integers(0, 40))
@settings(max_examples=15, deadline=None)
def test_new_goals_in_time_or_late_leave_the_arm_at_rest_within_the_limits(seed: int, when: list[float], late: int):
    arm = arm_of("robot_arm_3dof")
    rng = np.random.default_rng(seed)
    motion = armctl.OnlineMotion(arm, arm.home)
    player = Player(arm.home, DT, arm.limits, LEAD)
    rows = []
    first = 0
    for share in when:
        motion.go_to(arm.limits.random(arm.home, 1, rng)[0])
        taken = player.play(motion.pieces, first)
        if taken[1]:
            assert "too late" in taken[1]
            break
        ticks = 1 + int(share * motion.time_left / DT)
        motion.step(ticks * DT)
        first += ticks
        rows += [player.next() for _ in range(first - 1 - player.tick + (late if share > 0.8 else 0))]
    while player.tick <= player.end + 2:
        rows.append(player.next())
    assert_within(arm.limits, np.array(rows))
    assert np.ptp(np.array(rows[-3:]), axis=0).max() == 0.0


def test_lost_ticks_skip_rows_so_that_the_motion_keeps_its_time():
    arm, trajectory = planned(1)
    player = Player(trajectory(0.0).q, DT, arm.limits, LEAD)
    player.play(trajectory.pieces, 0)
    player.next(1)
    assert player.next(20) == pytest.approx(trajectory(20 * DT).q, abs=1e-12)


def test_a_motion_that_does_not_join_or_does_not_end_at_rest_is_refused():
    arm, trajectory = planned(1)
    player = Player(trajectory(0.0).q, DT, arm.limits, LEAD)
    assert "rad from where the last one is" in player.play(standing(trajectory(0.0).q + 0.01), 0)[1]
    half = trajectory.knots / 2
    fast = type(trajectory.pieces)(half[:2], trajectory.coefficients[:1])
    assert player.play(fast, 0)[1] == "the motion does not end at rest"


def test_nothing_is_played_after_a_stop():
    arm, trajectory = planned(1)
    player = Player(trajectory(0.0).q, DT, arm.limits, LEAD)
    player.stop()
    assert player.play(trajectory.pieces, LEAD)[1] == "the arm was stopped"
