"""A robot behind a link: the same program as on a simulation, with the same results and the same refusals."""

import math
import resource
import signal
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from arms import arm_of
from hypothesis import given, settings
from hypothesis import strategies as st

import armctl
from armctl.run.execution.commands import Commands
from armctl.run.links.link import HandReading, Reading

ROUNDING = 1e-3


def at(robot: Commands, *offset: float) -> np.ndarray:
    """(3,) m, a point beside the tip."""
    return robot.tip.position + np.array(offset)


MOVES: dict[str, Callable[[Commands], armctl.MoveResult]] = {
    "move_j": lambda robot: robot.move_j([0.5, 0.3, -1.0]),
    "move_to": lambda robot: robot.move_to([0.3, 0.2, 0.3]),
    "move_l": lambda robot: robot.move_l(at(robot, 0.0, -0.05, 0.0)),
    "move_c": lambda robot: robot.move_c(at(robot, 0.0, 0.03, 0.03), at(robot, 0.0, 0.06, 0.0)),
    "move_path": lambda robot: robot.move_path([at(robot, 0.0, y, 0.0) for y in (0.04, 0.0)], blend=0.01),
}
REFUSED: dict[str, Callable[[Commands], armctl.MoveResult]] = {
    "out of reach": lambda robot: robot.move_to([2.0, 0.0, 0.3]),
    "a line that leaves the workspace": lambda robot: robot.move_l([1.5, 0.0, 0.3]),
    "a contact": lambda robot: robot.move_to([0.2, 0.0, -0.3]),
}


def robot_of(**options) -> armctl.Robot:
    arm = arm_of("robot_arm_3dof")
    plant = {name: options.pop(name) for name in ("lag", "lost", "faults", "q_start", "plant") if name in options}
    return armctl.Robot(arm, armctl.links.PlantLink(arm, **plant), **{"speed": 0.5, "tip_speed": 1.0, **options})


def sent_to(robot: armctl.Robot) -> list[np.ndarray]:
    """All rows that are sent from now on."""
    rows: list[np.ndarray] = []
    link = robot.link
    send = link.send

    def kept(q: np.ndarray, last: bool) -> None:
        rows.append(np.array(q))
        send(q, last)

    link.send = kept
    return rows


def assert_within_limits_and_at_rest(robot: armctl.Robot, rows: list[np.ndarray]) -> None:
    q = np.array(rows)
    a = np.abs(np.diff(q, 2, axis=0)) / robot.dt**2
    j = np.abs(np.diff(q, 3, axis=0)) / robot.dt**3
    assert (a <= (1 + ROUNDING) * robot.arm.limits.a_max).all()
    assert (j <= (1 + ROUNDING) * robot.arm.limits.j_max).all()
    assert np.ptp(q[-3:], axis=0).max() == 0.0


def test_the_same_program_has_the_same_results_on_a_simulation_and_on_a_robot():
    robot = robot_of()
    simulation = armctl.Simulation(robot.arm)
    for name, move in MOVES.items():
        real = move(robot)
        simulated = move(simulation)
        assert real, (name, real.reason)
        assert simulated, name
        assert real.position_error < 1e-4, name
        both = min(len(real.log), len(simulated.log))
        assert real.log.q_ref[:both] == pytest.approx(simulated.log.q_ref[:both], abs=5e-5), name
        assert real.log.motion_duration == pytest.approx(simulated.log.motion_duration, abs=1e-4), name
        assert real.log.contacts == (), name
    assert np.abs(robot.tip.position - simulation.tip.position).max() < 1e-4


@pytest.mark.parametrize("name", REFUSED)
def test_a_refusal_has_the_same_words_and_nothing_is_sent(name: str):
    robot = robot_of()
    rows = sent_to(robot)
    real = REFUSED[name](robot)
    simulated = REFUSED[name](armctl.Simulation(robot.arm))
    assert not real
    assert real.reason == simulated.reason
    assert rows == []
    assert robot.link.sent == 0


def test_it_starts_where_the_robot_stands_and_not_at_home():
    start = [0.2, 0.2, -1.2]
    robot = robot_of(q_start=start)
    assert robot.state.q == pytest.approx(start)
    assert robot.move_j([0.3, 0.2, -1.2]).log.q_ref[0] == pytest.approx(start)


def test_the_defaults_are_slow_and_contacts_need_two_words():
    arm = arm_of("robot_arm_3dof")
    robot = armctl.Robot(arm, armctl.links.PlantLink(arm))
    assert robot.arm.limits.v_max == pytest.approx(0.2 * arm.limits.v_max)
    log = robot.move_j([1.0, 0.3, -1.0]).log
    speeds = np.linalg.norm(np.diff(log.tip_ref, axis=0), axis=1) / log.dt
    assert 0.2 < speeds.max() <= 0.25
    with pytest.raises(armctl.InputError, match="allow_contact=True"):
        robot.move_j([0.0, 0.0, -1.0], avoid=False)
    assert armctl.Robot(arm, armctl.links.PlantLink(arm), allow_contact=True).move_j([0.0, 0.1, -1.4], avoid=False)


def test_lag_and_lost_ticks_do_not_change_where_a_move_ends():
    robot = robot_of(lag=20, lost={50: 3, 90: 10})
    result = robot.move_j([0.5, 0.3, -1.0])
    assert result, result.reason
    assert robot.lost_ticks == 13
    assert np.diff(result.log.t) == pytest.approx(robot.dt)
    begin = 130  # after the ticks that were lost
    moving = slice(begin, begin + 120)
    assert np.abs(np.diff(result.log.q[moving], axis=0)).max() > 1e-3
    assert result.log.q[moving] == pytest.approx(result.log.q_ref[begin - 21 : begin + 99], abs=1e-4)


def test_a_reflex_in_a_motion_is_sticky_until_recover():
    robot = robot_of(faults={100: "cartesian_reflex"})
    first = robot.move_j([0.5, 0.3, -1.0])
    assert not first
    assert first.reason == "cartesian_reflex"
    assert first.log is not None
    assert len(first.log) == 100
    assert first.log.failure == "cartesian_reflex"
    rows = sent_to(robot)
    again = robot.move_j([0.5, 0.3, -1.0])
    assert again.reason == "cartesian_reflex; call robot.recover() when the robot may move again"
    with pytest.raises(armctl.LinkError, match="recover"):
        robot.run(armctl.move_j(robot.arm, robot.arm.home, [0.1, 0.1, -1.0]))
    assert rows == []
    robot.recover()
    assert robot.fault == ""
    assert robot.move_j([0.5, 0.3, -1.0])


class MovedMeanwhile(armctl.links.PlantLink):
    """Its position reference moves by itself while a motion is planned: at the second reading after `moves` is set."""

    moves = 0

    def read(self) -> Reading:
        seen = super().read()
        self.moves -= 1
        if self.moves == 0:
            self._robot.hold(seen.q + 0.015)
            seen = super().read()
        return seen


def test_a_robot_that_moved_between_plan_and_start_is_sent_nothing():
    arm = arm_of("robot_arm_3dof")
    link = MovedMeanwhile(arm)
    robot = armctl.Robot(arm, link, speed=0.5, tip_speed=1.0)
    trajectory = armctl.move_j(robot.arm, robot.arm.home, [0.3, 0.2, -1.2])
    link.moves = 1
    log = robot.run(trajectory)
    assert len(log) == 0
    assert log.failure.startswith("not sent: joint 1 of the robot was commanded to")
    assert "plan again" in log.failure
    assert link.sent == 0
    assert robot.move_j([0.3, 0.2, -1.2])


def test_a_move_that_came_to_rest_is_not_undone_by_the_next_reading():
    robot = robot_of()
    is_still = robot._drive.is_still
    answers: list[bool] = []

    def once() -> bool:
        """Whether the joints rest, as measured; once they did, each later reading is off by a tremor."""
        answers.append(not any(answers) and is_still())
        return answers[-1]

    robot._drive.is_still = once
    result = robot.move_j([0.5, 0.3, -1.0])
    assert result, result.reason
    assert any(answers)


def test_a_motion_beyond_the_limits_is_not_sent():
    robot = robot_of(allow_contact=True)
    fast = robot.arm.with_limits(replace(robot.arm.limits, a_max=4 * robot.arm.limits.a_max, j_max=9 * robot.arm.limits.j_max))
    log = robot.run(armctl.move_j(fast, robot.arm.home, [0.5, 0.3, -1.0]))
    assert len(log) == 0
    assert log.failure.startswith("not sent: joint 1 ")
    assert "limits of the model robot_arm_3dof" in log.failure
    slow = armctl.Robot(robot.arm, armctl.links.PlantLink(robot.arm), speed=1.0, tip_speed=0.05)
    assert "the tip moves at" in slow.run(armctl.move_j(slow.arm, slow.arm.home, [0.5, 0.3, -1.0])).failure
    assert robot.link.sent == 0


def test_a_trajectory_that_touches_something_is_refused_unless_contacts_are_allowed():
    robot = robot_of()
    down = armctl.move_j(robot.arm, robot.arm.home, robot.arm.limits.q_max)
    with pytest.raises(armctl.InputError, match=r"would touch \w+ at \d\.\d+ s; give allow_contact"):
        robot.run(down)
    assert robot.link.sent == 0


@given(tick=st.integers(1, 600), kind=st.sampled_from([KeyboardInterrupt, RuntimeError]))
@settings(max_examples=8, deadline=None)
def test_an_exception_at_any_time_brakes_within_the_limits(tick: int, kind: type[BaseException]):
    robot = robot_of()
    rows = sent_to(robot)
    link = robot.link
    wait = link.wait

    def failing():
        if link.sent == tick:
            link.wait = wait
            raise kind
        return wait()

    link.wait = failing
    try:
        for q in ([0.8, 0.3, -1.0], [0.0, 0.1, -1.4]):
            robot.move_j(q)
    except kind:
        assert robot.log is not None
        assert robot.log.failure.startswith("interrupted at")
    link.wait = wait
    assert_within_limits_and_at_rest(robot, rows)
    assert robot.move_j([0.4, 0.2, -1.2])
    assert_within_limits_and_at_rest(robot, rows)


@given(seed=st.integers(0, 100), until=st.floats(0.1, 1.5))
@settings(max_examples=5, deadline=None)
def test_follow_ends_at_rest_when_targets_stop_coming(seed: int, until: float):
    robot = robot_of()
    rows = sent_to(robot)
    center = robot.tip.position
    phase = 0.1 * seed

    def target(t: float) -> np.ndarray:
        if t > until:
            raise RuntimeError("no more targets")
        return center + 0.05 * np.array([0.0, math.sin(3 * t + phase), math.cos(3 * t)])

    with pytest.raises(armctl.InputError, match="no more targets"):
        robot.follow(target, duration=3.0)
    assert_within_limits_and_at_rest(robot, rows)
    assert robot.log.failure.startswith("interrupted at")
    assert robot.move_j([0.1, 0.1, -1.4])


def test_follow_follows_and_comes_to_rest_at_the_last_goal():
    robot = robot_of()
    rows = sent_to(robot)
    center = robot.tip.position
    log = robot.follow(lambda t: center + 0.04 * np.array([0.0, math.sin(2 * t), math.cos(2 * t) - 1.0]), duration=2.0)
    assert log.failure == ""
    assert np.linalg.norm(log.tip[-1] - log.target[:3]) < 0.01
    robot.close()
    assert_within_limits_and_at_rest(robot, rows)


@pytest.mark.parametrize("lost", [{60: 120}, {37: 95, 210: 140}])
def test_follow_goes_on_after_motions_that_came_too_late(lost: dict[int, int]):
    """Where many ticks are lost at once, the next motion is late: the arm rests, follows again, and the late ticks are told."""
    robot = robot_of(lost=lost)
    rows = sent_to(robot)
    center = robot.tip.position
    log = robot.follow(lambda t: center + 0.04 * np.array([0.0, math.sin(2 * t), math.cos(2 * t) - 1.0]), duration=2.5)
    assert robot.late_ticks > 0
    assert log.failure == ""
    assert log.t[-1] - log.t[0] > 2.4
    assert np.linalg.norm(log.tip[-1] - log.target[:3]) < 0.01
    robot.close()
    assert np.array_equal(rows[-1], rows[-2])
    assert robot.fault == ""


def test_follow_sends_no_motion_that_touches():
    robot = robot_of()
    log = robot.follow(lambda t: [0.2, 0.0, -0.3], duration=1.0)
    assert log.contacts == ()
    assert np.linalg.norm(log.tip[-1] - log.target[:3]) > 0.01


def test_another_model_is_refused_with_the_difference():
    arm = arm_of("robot_arm_3dof")
    longer = replace(arm, T_body_tip=armctl.Pose(arm.T_body_tip.position + np.array([0.0, 0.0, 0.1034]), arm.T_body_tip.quat))
    with pytest.raises(armctl.LinkError, match=r"is 103\.4 mm from the tip that the robot computes"):
        armctl.Robot(arm, armctl.links.PlantLink(longer))
    with pytest.raises(armctl.LinkError, match="the robot has 7 joints"):
        armctl.Robot(arm, armctl.links.PlantLink(arm_of("panda")))
    narrow = arm.with_limits(replace(arm.limits, q_max=np.array([3.14, -0.2, 0.0])))
    with pytest.raises(armctl.LinkError, match=r"outside the range of the model, \[-1\.57"):
        armctl.Robot(narrow, armctl.links.PlantLink(arm))


def test_the_payload_must_be_the_one_that_the_robot_is_set_to():
    arm = arm_of("robot_arm_3dof")
    with pytest.raises(armctl.LinkError, match=r"set to a payload of 1\.5 kg, the program says 0 kg"):
        armctl.Robot(arm, armctl.links.PlantLink(arm, payload=1.5))
    assert armctl.Robot(arm, armctl.links.PlantLink(arm, payload=1.5), payload=1.5)


def test_a_log_on_a_full_disk_fails_and_the_robot_goes_on(tmp_path):
    robot = robot_of()
    log = robot.move_j([0.3, 0.2, -1.2]).log
    path = tmp_path / "log.npz"
    log.save(path)
    before = path.read_bytes()
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    bounds = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, bounds[1]))
        with pytest.raises(armctl.ArmctlError, match="cannot be written: File too large"):
            robot.log.save(path)
        assert robot.move_j([0.1, 0.1, -1.4])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, bounds)
        signal.signal(signal.SIGXFSZ, ignored)
    assert path.read_bytes() == before


def test_two_programs_cannot_command_one_robot(tmp_path):
    arm = arm_of("robot_arm_3dof")
    first = armctl.links.PlantLink(arm)
    first.address = f"test {tmp_path}"
    second = armctl.links.PlantLink(arm)
    second.address = first.address
    with armctl.Robot(arm, first), pytest.raises(armctl.LinkError, match="another program commands this robot"):
        armctl.Robot(arm, second)
    armctl.Robot(arm, second).close()


def test_a_log_of_a_robot_is_a_log_like_any_other(tmp_path):
    log = robot_of().move_j([0.5, 0.3, -1.0]).log
    assert log.plant == "robot: simulated robot_arm_3dof"
    assert np.isfinite(log.tau).all()
    assert armctl.Report.from_log(log).ok
    again = armctl.Log.load(log.save(tmp_path / "log.parquet"))
    assert again.q_ref == pytest.approx(log.q_ref, nan_ok=True)


class WithoutTorqueSensors(armctl.links.PlantLink):
    """A robot that does not measure its torques, as servos on a bus."""

    def _reading(self) -> Reading:
        seen = super()._reading()
        return seen._replace(tau=np.full_like(seen.tau, np.nan))


def test_a_log_without_torques_is_saved_and_not_identified(tmp_path):
    arm = arm_of("robot_arm_3dof")
    robot = armctl.Robot(arm, WithoutTorqueSensors(arm), speed=0.1)
    log = robot.move_j([0.6, 0.3, -1.0]).log
    for name in ("log.npz", "log.csv"):
        assert np.isnan(armctl.Log.load(log.save(tmp_path / name)).tau).all()
    with pytest.raises(armctl.InputError, match="measured no torque"):
        armctl.identify(arm, log)


def test_a_dry_run_plans_and_checks_and_sends_nothing(capsys):
    arm = arm_of("robot_arm_3dof")
    link = armctl.links.PlantLink(arm)
    rows = []
    link.send = lambda *row: rows.append(row)
    dry = armctl.DryRun(link)
    with armctl.Robot(arm, dry, speed=0.5) as robot:
        real = robot_of(tip_speed=0.25)
        for move in list(MOVES.values())[:3]:
            thought = move(robot)
            made = move(real)
            assert thought
            assert thought.log.q_ref[-1] == pytest.approx(made.log.q_ref[-1], abs=1e-9)
        assert REFUSED["out of reach"](robot).reason == REFUSED["out of reach"](real).reason
        with pytest.raises(armctl.LinkError, match="dry run"):
            robot.recover()
    assert rows == []
    first = dry.rehearsals[0]
    limits = robot.arm.limits
    assert 0.2 < first.tip_speed <= 0.25
    assert first.acceleration <= (1 + ROUNDING) * limits.a_max.max()
    assert first.jerk <= (1 + ROUNDING) * limits.j_max.max()
    assert 0.0 < first.clearance < 1.0
    assert str(first) in capsys.readouterr().out


class LyingHand(armctl.links.PlantLink):
    """A hand that reports a grasp of nothing, as a simulator of one does."""

    width = 0.08

    def read_hand(self) -> HandReading:
        return HandReading(self.width, 0.08, self.width < 0.08)

    def move_hand(self, width: float) -> bool:
        self.width = width
        return True

    def close_hand(self, force: float) -> bool:
        self.width = self.thing
        return True

    thing = 0.0016


def test_a_hand_that_reports_a_grasp_of_nothing_holds_nothing():
    arm = arm_of("robot_arm_3dof")
    link = LyingHand(arm)
    robot = armctl.Robot(arm, link)
    assert robot.gripper.open()
    result = robot.gripper.grasp(20.0)
    assert not result
    assert not result.grasped
    assert result.reason == "closed on nothing: the fingers are 1.6 mm apart; the hand reports a grasp"
    link.thing = 0.03
    assert robot.gripper.close().grasped
    assert not robot.gripper.move(0.05).reason
    with pytest.raises(armctl.InputError, match="width"):
        robot.gripper.move(0.2)


def test_a_gripper_of_the_model_works_through_the_link():
    arm = arm_of("panda")
    robot = armctl.Robot(arm, armctl.links.PlantLink(arm))
    assert robot.gripper.move(0.04).width == pytest.approx(0.04, abs=1e-3)
    assert robot.gripper.grasp(10.0).reason.startswith("closed on nothing")
