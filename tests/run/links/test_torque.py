"""A controller on a robot: torques within the maker's bounds, laws that the link bears, an arm that comes to rest."""

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from arms import arm_of

import armctl
from armctl.control.interface import State
from armctl.core.trajectory import Setpoint
from armctl.run.links.delay_probe import delay_ticks
from armctl.run.links.plant_link import PlantLink
from armctl.run.links.torque_interface import TorqueInterface

DT = 1e-3
REAL = armctl.Plant(continuous=True, timestep=DT)
FRICTION = armctl.Plant(
    continuous=True, timestep=DT, mass_scale=1.1, coulomb_friction=0.1, viscous_friction=0.1, encoder_noise=2e-6
)
GOAL = [0.5, 0.3, -1.0]
RATE = 200.0  # N m/s
LAWS = ["pd-gravity", "pd-feedforward", "computed-torque", "computed-torque-observer", "impedance"]


def robot_of(controller: Any = "computed-torque", plant: armctl.Plant = REAL, **options) -> armctl.Robot:
    arm = arm_of("robot_arm_3dof")
    link = PlantLink(arm, plant, **{name: options.pop(name) for name in ("torque", "lag", "lost") if name in options})
    return armctl.Robot(arm, link, controller=controller, **{"speed": 0.5, "tip_speed": 1.0, **options})


def given(delay: float = 0.0, **options) -> TorqueInterface:
    """The interface of an arm whose delay is given, with which a Robot opens without a measurement."""
    return TorqueInterface(arm_of("robot_arm_3dof").limits.tau_max, delay=delay, **options)


def plant_link(robot: armctl.Robot) -> PlantLink:
    assert isinstance(robot.link, PlantLink)
    return robot.link


def sent_to(robot: armctl.Robot) -> list[np.ndarray]:
    """All torques that are sent from now on."""
    rows: list[np.ndarray] = []
    link = plant_link(robot)
    send = link.send_torques

    def kept(tau: np.ndarray, last: bool) -> None:
        rows.append(np.array(tau))
        send(tau, last)

    link.send_torques = kept
    return rows


def still_speed(robot: armctl.Robot) -> float:
    """rad/s, of the fastest joint over the next 20 ms."""
    before = robot.state.q
    plant_link(robot)._pass(20)
    return float(np.abs(robot.state.q - before).max() / (20 * DT))


class Failing:
    """PD with gravity until a time after its first call, and then something else."""

    def __init__(self, what: Callable[[np.ndarray], object], after: float = 0.3):
        self._inner = armctl.PDGravity(arm_of("robot_arm_3dof"))
        self._what = what
        self._after = after
        self.calls = 0  # since the law was set free

    def torque(self, state: State, setpoint: Setpoint) -> object:
        tau = self._inner.torque(state, setpoint)
        self.calls += bool(np.abs(setpoint.v).max() > 0.0)
        return self._what(tau) if self.calls * DT > self._after else tau


def failed(tau: np.ndarray) -> np.ndarray:
    raise RuntimeError("no idea")


@pytest.mark.parametrize("controller", LAWS)
def test_a_law_moves_the_robot_to_its_target_and_the_log_has_both_torques(controller: str):
    robot = robot_of(controller, torque=given())
    motion = armctl.move_j(robot.arm, robot.arm.home, GOAL, speed=0.5)
    log = robot.run(motion)
    assert log.failure == ""
    assert (log.controller, log.torques, log.source) == (controller, "both", "robot")
    assert np.abs(log.tau - log.tau_cmd)[:-1].max() < 1e-3 * np.abs(log.tau).max()  # the last torque is not measured any more
    simulated = armctl.Simulation(robot.arm, controller=controller, plant=REAL).run(motion)
    errors = [np.sqrt(((each.q - each.q_ref) ** 2).mean()) for each in (log, simulated)]
    assert errors[0] == pytest.approx(errors[1], rel=0.3, abs=2e-5)
    result = robot.move_to([0.3, 0.2, 0.3])
    assert result, result.reason


MAKERS = [{"adds_gravity": True}, {"adds_friction": True}, {"rate_max": RATE}, {"lag": 5e-4}]


@pytest.mark.parametrize("options", MAKERS, ids=lambda options: next(iter(options)))
def test_what_the_maker_does_is_no_part_of_the_law(options: dict):
    plain = robot_of(torque=given()).move_j(GOAL).log
    log = robot_of(torque=given(**options)).move_j(GOAL).log
    assert plain is not None
    assert log is not None
    count = min(len(plain), len(log))
    assert np.abs(plain.q[:count] - log.q[:count]).max() < 2e-3
    assert np.abs(log.tau[:count] - plain.tau[:count]).max() < 0.1 * np.abs(plain.tau).max()


def test_torques_begin_with_those_that_hold_the_arm_and_keep_their_rate():
    robot = robot_of("pd-gravity", torque=given(rate_max=RATE))
    plant_link(robot)._opened().stepper.reset(robot.arm.home + 0.01)  # the law begins with an error
    sent = sent_to(robot)
    result = robot.move_j(GOAL)
    assert result, result.reason
    tau = np.array(sent)
    assert np.abs(tau[0] - robot.arm.gravity(robot.arm.home + 0.01)).max() < 1e-3 * robot.arm.limits.tau_max.max()
    assert np.abs(np.diff(tau, axis=0)).max() <= DT * RATE
    stiffness = armctl.PDGravity(robot.arm).stiffness
    assert np.abs(np.diff(tau[:20], axis=0)).max() < 0.1 * 0.01 * np.max(stiffness)  # no bump


def test_the_delay_is_measured_and_a_law_without_margin_is_refused():
    assert robot_of(lag=2, controller="pd-gravity").delay == pytest.approx(2 * DT)
    with pytest.raises(
        armctl.LinkError, match=r"pd-gravity .* at the link's delay of 6 ms, at least 1 ms .*armctl\.tune\(arm, 'pd-g"
    ):
        robot_of("pd-gravity", lag=6)
    with pytest.raises(armctl.LinkError, match=r"computed-torque-observer has a peak sensitivity of .* at most 2"):
        robot_of("computed-torque-observer", torque=given(2 * DT))
    plant = armctl.Plant(delay=6, timestep=DT, continuous=True)
    tuned = armctl.tune(arm_of("robot_arm_3dof"), "computed-torque", delay_margin=0.01, plants=[plant], configurations=5)
    robot = robot_of(tuned.controller, lag=6)
    result = robot.move_j(GOAL)
    assert result, result.reason


@pytest.mark.parametrize(
    ("plant", "ticks"),
    [
        ({"delay": 3}, 3),
        ({"jitter": 3}, 3),
        ({"delay": 1, "jitter": 1}, 2),
        ({"motor": 1e-3}, 1),
        ({"coulomb_friction": 1.0}, 0),
    ],
    ids=str,
)
def test_the_measured_delay_has_jitter_and_lag_and_the_arm_stays(plant: dict, ticks: int):
    robot = robot_of("computed-torque", replace(REAL, **plant))
    assert robot.delay == pytest.approx(ticks * DT)
    assert np.abs(robot.state.q - robot.arm.home).max() < 5e-3


def test_torques_that_follow_no_commands_have_no_delay():
    rng = np.random.default_rng(0)
    sent = rng.normal(size=(500, 3))
    assert delay_ticks(sent, np.roll(sent, 4, axis=0), 20, np.ones(3)) == 3
    noise = 0.5 * rng.normal(size=(500, 3))
    assert delay_ticks(sent, np.roll(sent, 4, axis=0) + noise, 20, np.ones(3)) == 3
    for measured in (noise, np.roll(sent, 40, axis=0), np.full((500, 3), np.nan)):
        with pytest.raises(armctl.LinkError, match="the delay of the torques cannot be measured"):
            delay_ticks(sent, measured, 20, np.ones(3))


FAILURES = {
    "an exception": (failed, "the controller Failing failed: RuntimeError: no idea"),
    "no number": (lambda tau: tau * np.nan, "the controller Failing gave no finite torque"),
    "a wrong length": (lambda tau: tau[:2], "the controller Failing gave no finite torque"),
    "no torque": (lambda tau: None, "the controller Failing gave no finite torque"),
    "zero": (lambda tau: 0.0 * tau, "rad from its reference under Failing, at most 0.1 rad"),
    "full torque": (lambda tau: 1e9 * np.sign(tau), "rad from its reference|moves at|would leave its range"),
}


@pytest.mark.parametrize("case", FAILURES)
def test_after_a_law_that_fails_the_arm_is_damped_to_rest_and_the_fault_stays(case: str):
    what, words = FAILURES[case]
    robot = robot_of(Failing(what), torque=given(rate_max=1e4))
    sent = sent_to(robot)
    result = robot.move_j(GOAL)
    assert re.search(words, result.reason), result.reason
    assert np.abs(np.diff(np.array(sent), axis=0)).max() <= 1e4 * DT
    assert still_speed(robot) < 1e-2
    assert robot.fault == result.reason
    assert robot.move_j(GOAL).reason == f"{result.reason}; call robot.recover() when the robot may move again"


def test_after_recovery_a_law_begins_anew():
    law = Failing(failed)
    robot = robot_of(law, torque=given())
    assert not robot.move_j(GOAL)
    law._after = np.inf
    robot.recover()
    result = robot.move_j(GOAL)
    assert result, result.reason


def test_an_arm_that_is_blocked_or_pushed_away_is_let_go():
    bar = armctl.Push(start=0.3, duration=5.0, force=(0.0, -60.0, 0.0))
    robot = robot_of("pd-gravity", replace(REAL, pushes=(bar,)), torque=given(), error_max=0.015)
    result = robot.move_j(GOAL)
    assert re.search(r"rad from its reference under pd-gravity, at most 0.015 rad", result.reason), result.reason
    robot.recover()
    plant_link(robot)._pass(6000)
    result = robot.move_j(GOAL)  # a motion begins where the robot stands now
    assert result, result.reason


def test_a_stop_brakes_the_reference_on_its_path_and_the_law_follows():
    robot = robot_of("computed-torque-observer", torque=given())
    sent = sent_to(robot)
    send = plant_link(robot).send_torques

    def interrupted(tau: np.ndarray, last: bool) -> None:
        send(tau, last)
        if len(sent) == 300:
            raise KeyboardInterrupt

    plant_link(robot).send_torques = interrupted
    with pytest.raises(KeyboardInterrupt):
        robot.move_j(GOAL)
    assert robot.fault == ""
    log = robot.log
    assert log is not None
    path = np.array(GOAL) - robot.arm.home
    along = (log.q_ref - robot.arm.home) @ path / (path @ path)
    assert np.abs(log.q_ref - robot.arm.home - along[:, None] * path).max() < 1e-9
    assert 0.05 < along[-1] < 0.95
    assert np.abs(log.q - log.q_ref).max() < 2e-3
    assert still_speed(robot) < 1e-3


def test_a_law_that_yields_is_pushed_away_and_another_one_measures_the_force():
    push = armctl.Push(start=0.2, duration=2.0, force=(0.0, 15.0, 0.0))
    plant = replace(REAL, pushes=(push,))
    arm = arm_of("robot_arm_3dof")
    hold = armctl.move_j(arm, arm.home, arm.home)
    soft = armctl.Impedance(arm, stiffness=[300.0, 300.0, 300.0, 0.0, 0.0, 0.0])
    log = robot_of(soft, plant, torque=given()).run(hold, dwell=1.0)
    assert log.failure == ""
    assert log.tip[-1][1] - log.tip[0][1] == pytest.approx(15.0 / 300.0, rel=0.2)
    floating = robot_of(armctl.HandGuiding(arm), plant, torque=given()).run(hold, dwell=0.5)
    assert floating.failure == ""
    assert floating.tip[-1][1] - floating.tip[0][1] > 0.05
    robot = robot_of(armctl.Admittance(arm), plant, torque=given())
    log = robot.run(hold, dwell=1.0)
    assert log.failure == ""
    assert log.tip[-1][1] - log.tip[0][1] > 0.01


def test_lost_ticks_leave_the_memory_of_a_law_alone():
    plain = robot_of("computed-torque-observer", torque=given()).move_j(GOAL)
    robot = robot_of("computed-torque-observer", torque=given(), lost={200: 3, 400: 1})
    result = robot.move_j(GOAL)
    assert result, result.reason
    assert robot.lost_ticks == 4
    assert plain.log is not None
    assert result.log is not None
    assert np.abs(result.log.q - result.log.q_ref).max() < 1e-2


@pytest.mark.parametrize("controller", ["computed-torque", "computed-torque-observer", "lqr"])
def test_after_a_lost_tick_the_torques_do_not_jump(controller: str):
    """A law that estimates speeds took an arm that moved for two ticks for twice as fast."""
    steps = []
    for lost in ({}, {row: 1 + row // 100 % 3 for row in range(50, 2000, 25)}):
        robot = robot_of(controller, FRICTION, torque=given(), lost=lost)
        sent = sent_to(robot)
        result = robot.move_j(GOAL)
        assert result, result.reason
        assert bool(robot.lost_ticks) == bool(lost)
        steps.append(float(np.abs(np.diff(sent, axis=0)).max()))
    assert steps[1] < 3.0 * steps[0]


@pytest.mark.parametrize(
    ("lost", "reason"),
    [(16, "16 ticks were lost at once, too many for a controller of torques"), (40, "no torques came for 20 ticks")],
)
def test_after_too_many_lost_ticks_the_arm_comes_to_rest(lost: int, reason: str):
    robot = robot_of("computed-torque-observer", torque=given(), lost={200: lost})
    assert reason in robot.move_j(GOAL).reason
    assert reason in robot.fault
    plant_link(robot)._pass(300)
    assert still_speed(robot) < 1e-2


class Positions(PlantLink):
    """A robot that takes positions only."""

    def __init__(self, arm: armctl.Arm):
        super().__init__(arm)
        self.torque = None


def test_what_no_link_can_do_is_refused():
    arm = arm_of("robot_arm_3dof")
    with pytest.raises(armctl.LinkError, match="takes no torques; leave it out"):
        armctl.Robot(arm, Positions(arm), controller="pd")
    with pytest.raises(armctl.LinkError, match="dry run of simulated robot_arm_3dof takes no torques"):
        armctl.Robot(arm, armctl.DryRun(PlantLink(arm)), controller="pd")
    with pytest.raises(armctl.InputError, match="needs the reference of coming ticks, which a link does not give"):
        robot_of("mpc")
    with pytest.raises(armctl.InputError, match="error_max: it is a bound for controller="):
        armctl.Robot(arm, PlantLink(arm), error_max=0.1)
    with pytest.raises(armctl.UnknownNameError, match="unknown controller 'fuzzy'"):
        robot_of("fuzzy")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"tau_max": [1.0], "settle": 0.005}, r"settle: expected a list of numbers, got a single number"),
        ({"tau_max": [1.0], "settle": (0.005, 0.0)}, r"settle: both must be above 0, got \[0.005, 0.0\]"),
        ({"tau_max": [1.0, 0.0]}, r"tau_max: every torque must be above 0 N m, got 0"),
        ({"tau_max": [1.0], "rate_max": -1.0}, r"rate_max: every rate must be above 0 N m/s, got -1"),
        ({"tau_max": [1.0], "delay": 1.0}, r"delay: expected .* 0\.05"),
        ({"tau_max": [1.0], "lag": -1.0}, r"lag: expected"),
        ({"tau_max": [1.0], "adds_gravity": 1}, r"adds_gravity: expected True or False"),
    ],
)
def test_an_interface_with_a_wrong_number_is_refused(wrong: dict, message: str):
    with pytest.raises(armctl.InputError, match=message):
        TorqueInterface(**wrong)
