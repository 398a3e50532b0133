"""A robot that feels a contact stops on its path within its limits; what feels nothing, or cannot float, is refused."""

from pathlib import Path

import numpy as np
import pytest
from arms import arm_of

import armctl
from armctl.run.links.link import Reading

PUSH = armctl.Push(0.4, 0.2, force=[0.0, 30.0, 0.0])


def robot_of(reaction: str | None, *, real_time: bool = False, record: Path | None = None, **options) -> armctl.Robot:
    arm = arm_of("robot_arm_3dof")
    link = armctl.links.PlantLink(arm, armctl.Plant(encoder_noise=1e-6, seed=2, **options), real_time=real_time, record=record)
    robot = armctl.Robot(arm, link, speed=0.5, tip_speed=1.0)
    if reaction:
        robot.reaction = armctl.ContactReaction(robot.arm, reaction=reaction)
    return robot


def distance_to_path(rows: np.ndarray, trajectory: armctl.JointTrajectory) -> float:
    """rad, the greatest distance of rows from the places of a motion."""
    path = trajectory.sample(np.linspace(0.0, trajectory.duration, 20_000)).q
    return max(float(np.abs(path - row).max(axis=1).min()) for row in rows)


@pytest.mark.parametrize("real_time", [False, True])
def test_a_push_stops_the_arm_on_its_path_within_its_limits(real_time, tmp_path):
    sent = tmp_path / "rows.bin"
    with robot_of("stop", real_time=real_time, record=sent, pushes=armctl.Push(0.4, 100.0, force=[0.0, 30.0, 0.0])) as robot:
        motion = armctl.move_j(robot.arm, robot.arm.home, robot.arm.home + np.array([1.2, 0.3, -0.3]))
        log = robot.run(motion)
        assert log.failure.startswith("contact at ")
        assert "from outside at shoulder" in robot.reaction.contact
        assert robot.reaction.time > 0.4
        assert real_time or robot.reaction.time < 0.43
        q = log.q_ref
        assert np.abs(q[-1] - motion.sample(np.array([motion.duration])).q[0]).max() > 0.1
        if not real_time:  # where ticks are lost, the log has straight lines
            assert (np.abs(np.diff(q, 2, axis=0)) <= 1.001 * robot.arm.limits.a_max * robot.dt**2).all()
            assert (np.abs(np.diff(q, 3, axis=0)) <= 1.001 * robot.arm.limits.j_max * robot.dt**3).all()
        assert distance_to_path(np.fromfile(sent).reshape(-1, 4)[::5, 1:], motion) < 1e-3
        assert np.ptp(q[-2:], axis=0).max() == 0.0


def test_a_retreat_goes_back_and_the_next_move_starts_there():
    robot = robot_of("retreat", pushes=PUSH)
    goal = robot.arm.home + np.array([1.2, 0.3, -0.3])
    moved = robot.move_j(goal)
    assert not moved
    assert moved.reason == robot.reaction.reason
    assert moved.reason.startswith("contact at 0.4")
    way = np.abs(moved.log.q_ref - robot.arm.home).max(axis=1)
    assert way.max() > 0.02
    assert way[-1] < 0.5 * way.max()
    assert (np.abs(np.diff(moved.log.q_ref, 2, axis=0)) <= 1.001 * robot.arm.limits.a_max * robot.dt**2).all()
    again = robot.move_j(goal)
    assert again, again.reason
    assert again.log.q_ref[0] == pytest.approx(moved.log.q_ref[-1], abs=1e-6)
    assert not robot.reaction.contact


def test_a_retreat_that_may_not_be_sent_is_none():
    robot = robot_of("retreat", pushes=PUSH)
    robot._controlled._provable = lambda trajectory: None
    moved = robot.move_j(robot.arm.home + np.array([1.2, 0.3, -0.3]))
    assert moved.reason.startswith("contact at 0.4")
    assert np.abs(np.diff(moved.log.q_ref, axis=0)[-20:]).max() == pytest.approx(0.0, abs=1e-4)
    assert (np.diff(moved.log.q_ref[:, 0]) >= 0.0).all()


def test_without_a_contact_the_same_rows_are_sent():
    logs = []
    for reaction in (None, "stop"):
        robot = robot_of(reaction)
        assert robot.move_j([0.5, 0.3, -1.0])
        assert robot.move_j(robot.arm.home)
        logs.append(robot.log)
    assert np.array_equal(logs[0].q_ref, logs[1].q_ref)


@pytest.mark.parametrize("row", [120, 200, 280])
def test_ticks_that_are_lost_are_no_contact(row):
    arm = arm_of("robot_arm_3dof")
    link = armctl.links.PlantLink(arm, armctl.Plant(encoder_noise=1e-6, seed=2), lost={row: 100})
    with armctl.Robot(arm, link, speed=0.5, tip_speed=1.0) as robot:
        robot.reaction = armctl.ContactReaction(robot.arm)
        moved = robot.move_j(arm.home + np.array([1.2, 0.3, -0.3]))
        assert not robot.reaction.contact
        assert moved, moved.reason


def test_a_reaction_of_another_arm_is_refused_before_a_motion():
    robot = robot_of(None)
    another = armctl.ContactReaction(arm_of("planar"))
    for commanded in (robot, armctl.Simulation(robot.arm)):
        with pytest.raises(armctl.InputError, match=r"reaction: it is of an arm with .*; this one has shoulder_yaw, "):
            commanded.reaction = another


def test_a_closed_robot_does_not_move():
    robot = robot_of(None)
    robot.close()
    with pytest.raises(armctl.LinkError, match="the link is not open"):
        robot.move_j([0.5, 0.3, -1.0])


def test_a_robot_that_cannot_float_or_feels_nothing_says_so():
    robot = robot_of(None)
    with pytest.raises(armctl.InputError, match="takes positions only and cannot float"):
        robot.reaction = armctl.ContactReaction(robot.arm, reaction="float")
    with pytest.raises(armctl.InputError, match="reaction: expected ContactReaction, got 'stop'"):
        robot.reaction = "stop"
    read = robot.link.read
    robot.link.read = lambda: Reading(*read()[:3], np.full(3, np.nan), *read()[4:])
    with pytest.raises(armctl.InputError, match="measures no speeds and torques"):
        robot.reaction = armctl.ContactReaction(robot.arm)
    assert robot.reaction is None
