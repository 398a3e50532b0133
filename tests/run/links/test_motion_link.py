"""A link that takes whole motions: what the robot was sent is at every tick what the player says, whatever comes in between."""

import numpy as np
import pytest
from arms import arm_of

import armctl
from armctl.plan.motion.trajectory.piecewise import JointSamples

GOAL = [1.2, 0.3, -1.0]


class MotionPlant(armctl.links.PlantLink):
    """A simulated robot that plays the rows of the motions that it was sent; `send` only tells what it should be at."""

    lead = 0.01

    def __init__(self, arm: armctl.Arm, interrupted: int = -2, **named):
        super().__init__(arm, **named)
        self.interrupted = interrupted  # the tick of a Ctrl-C
        self.late = 0  # messages that come too late
        self.messages: list[tuple[int, int, JointSamples]] = []
        self.tick = -1
        self.gap = 0.0  # rad, greatest between a row that was sent in a motion and that of the player

    def start(self):
        super().start()
        self.tick = -1

    def send_motion(self, first: int, changed: int, rows: JointSamples) -> bool:
        if self.late:
            self.late -= 1
            return False
        assert first <= max(self.tick, 0) < changed or self.tick == -1
        if self.messages and self.tick >= 0:
            q, v = self.played(first, changed)
            assert np.abs(q - rows.q[: changed - first]).max(initial=0.0) < 1e-9
            assert np.abs(v - rows.v[: changed - first]).max(initial=0.0) < 1e-6
        self.messages.append((first, changed, rows))
        return True

    def played(self, first: int, end: int) -> tuple[np.ndarray, np.ndarray]:
        begin, _, rows = self.messages[-1]
        ticks = np.minimum(np.arange(first, end) - begin, len(rows.q) - 1)
        return rows.q[ticks], rows.v[ticks]

    def wait(self):
        if self.tick == self.interrupted:
            self.interrupted = -2
            raise KeyboardInterrupt
        ticks, reading = super().wait()
        self.tick += ticks
        return ticks, reading

    def send(self, q, last):
        row = self.played(self.tick, self.tick + 1)[0][0]
        self.gap = max(self.gap, float(np.abs(row - q).max()))
        super().send(row, last)


@pytest.fixture
def arm() -> armctl.Arm:
    return arm_of("robot_arm_3dof")


def test_one_motion_is_one_message_that_ends_at_rest_and_gives_the_results_of_a_stream(arm: armctl.Arm):
    link = MotionPlant(arm)
    with armctl.Robot(arm, link, speed=0.5, tip_speed=1.0) as robot:
        result = robot.move_j(GOAL)
    with armctl.Robot(arm, armctl.links.PlantLink(arm), speed=0.5, tip_speed=1.0) as robot:
        streamed = robot.move_j(GOAL)
    assert result
    assert streamed
    assert len(link.messages) == 1
    first, changed, rows = link.messages[0]
    assert (first, changed) == (0, 0)
    both = min(len(result.log), len(streamed.log))
    assert np.array_equal(result.log.q_ref[:both], streamed.log.q_ref[:both])
    assert abs(result.duration - streamed.duration) < 2 * link.lead
    assert np.abs(np.diff(rows.q, axis=0) / link.dt - 0.5 * (rows.v[1:] + rows.v[:-1])).max() < 1e-4
    assert np.abs(np.diff(rows.v, axis=0) / link.dt - 0.5 * (rows.a[1:] + rows.a[:-1])).max() < 0.1
    assert not rows.v[[0, -1]].any()
    assert not rows.a[-1].any()
    assert link.gap < 1e-12


def test_a_stop_sends_the_braking_path_which_agrees_with_the_motion_until_it_brakes(arm: armctl.Arm):
    link = MotionPlant(arm, interrupted=150)
    with armctl.Robot(arm, link, speed=0.5, tip_speed=1.0) as robot:
        with pytest.raises(KeyboardInterrupt):
            robot.move_j(GOAL)
        assert robot.log is not None
        assert robot.log.failure.startswith("interrupted")
    assert len(link.messages) == 2
    _, changed, rows = link.messages[1]
    assert changed > 150
    assert not rows.v[-1].any()
    start = arm.home
    along = (rows.q - start) @ (GOAL - start) / np.sum(np.square(GOAL - start))
    assert np.abs(rows.q - start - along[:, None] * (GOAL - start)).max() < 1e-9
    assert along[-1] < 0.9
    assert link.gap < 1e-12


def test_a_moving_target_is_followed_by_motions_that_continue_each_other(arm: armctl.Arm):
    link = MotionPlant(arm)
    with armctl.Robot(arm, link, speed=0.5, tip_speed=1.0) as robot:
        center = robot.tip.position
        log = robot.follow(lambda t: center + 0.03 * np.sin([0.0, 2 * t, t]), duration=1.0)
    assert not log.failure
    assert len(link.messages) > 10
    assert link.gap < 1e-12


def test_a_motion_that_the_robot_would_get_too_late_is_not_played(arm: armctl.Arm):
    link = MotionPlant(arm)
    with armctl.Robot(arm, link, speed=0.5, tip_speed=1.0) as robot:
        center = robot.tip.position

        def moving(t: float) -> np.ndarray:
            link.late = 1 if 0.3 < t < 0.4 else 0
            return center + 0.03 * np.sin([0.0, 2 * t, t])

        robot.follow(moving, duration=1.0)
        assert robot.late_ticks > 0
    assert link.gap < 1e-12


def test_where_the_first_message_comes_too_late_nothing_moves(arm: armctl.Arm):
    link = MotionPlant(arm)
    link.late = 1
    with armctl.Robot(arm, link, speed=0.5, tip_speed=1.0) as robot:
        assert "the motion came too late" in robot.move_j(GOAL).reason
        assert not link.messages
        robot.recover()
        assert robot.move_j(GOAL)


def test_after_a_fault_of_the_link_the_braking_path_is_sent(arm: armctl.Arm):
    link = MotionPlant(arm, faults={100: "no readings"})
    with armctl.Robot(arm, link, speed=0.5, tip_speed=1.0) as robot:
        assert robot.move_j(GOAL).reason == "no readings"
    assert len(link.messages) == 2
    assert not link.messages[1][2].v[-1].any()
    assert np.abs(link.messages[1][2].q[-1] - GOAL).max() > 0.1
