"""The torques of a Franka, on a client of a few lines that counts what Franka's controller would refuse."""

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from arms import arm_of

import armctl
from armctl.control.interface import State
from armctl.core.trajectory import Setpoint
from armctl.run.links.envelope import envelope_of
from armctl.run.links.franka import FR3_TORQUE
from armctl.run.links.host import LinkHost
from armctl.run.links.robot_law import link_law

DT = 1e-3
RATE_MAX = 1000.0  # N m/s, libfranka's kMaxTorqueRate
LOST = {300: 1, 500: 3}  # commands that do not arrive, from a tick on


class Controller:
    """A controller that gets torques without gravity and friction; the arm stays where it is."""

    def __init__(self) -> None:
        self.q = arm_of("fr3").home
        self.tick = 0
        self.lost = dict(LOST)
        self.commanded = np.zeros(7)
        self.late = 0  # ticks, until it reports a command
        self.sent: list[np.ndarray] = []  # all torques, lost ones, too
        self._reported = [np.zeros(7)] * 3
        self.greatest_rate = 0.0
        self.greatest = np.zeros(7)
        self.moving = False

    def set_collision_behavior(self, *thresholds: object) -> None:
        pass

    def read_once(self) -> SimpleNamespace:
        duration = SimpleNamespace(to_sec=lambda: DT * self.tick)
        return SimpleNamespace(
            time=duration,
            q=self.q.tolist(),
            dq=[0.0] * 7,
            q_d=(self.q + self.tick).tolist(),  # of no use after torques
            tau_J=(self.commanded + arm_of("fr3").gravity(self.q)).tolist(),
            tau_J_d=self._reported[-1 - self.late].tolist(),
            current_errors="",
            O_T_EE=np.eye(4).T.ravel().tolist(),
        )

    def start_torque_control(self) -> "Controller":
        self.moving = True
        return self

    def readOnce(self) -> tuple[SimpleNamespace, SimpleNamespace]:
        self.tick += 1
        return self.read_once(), SimpleNamespace(to_sec=lambda: DT)

    def writeOnce(self, command: Any) -> None:
        assert self.moving
        self.moving = not command.motion_finished
        self.sent.append(np.array(command.row))
        for tick, count in self.lost.items():
            if tick <= self.tick < tick + count:
                self._reported.append(self.commanded)
                return
        tau = np.array(command.row)
        self.greatest_rate = max(self.greatest_rate, float(np.abs(tau - self.commanded).max()) / DT)
        self.greatest = np.maximum(self.greatest, np.abs(tau))
        self.commanded = tau
        self._reported.append(tau)


class Command:
    def __init__(self, row: list[float]):
        self.row = row
        self.motion_finished = False


@pytest.fixture
def controller(monkeypatch: pytest.MonkeyPatch) -> Controller:
    """The controller to which every client of this process connects."""
    robot = Controller()
    client: Any = ModuleType("pylibfranka")
    client.FrankaException = RuntimeError
    client.RealtimeConfig = SimpleNamespace(kIgnore=0)
    client.Robot = lambda host, kind: robot
    client.Torques = Command
    monkeypatch.setitem(sys.modules, "pylibfranka", client)
    return robot


def opened(**options: Any) -> armctl.links.Franka:
    link = armctl.links.Franka("fake", real_time=False, **options)
    link.open()
    return link


class Wild:
    """A law whose torques jump; it notes what the motors got."""

    def __init__(self) -> None:
        self.got: list[np.ndarray] = []
        self._rng = np.random.default_rng(0)

    def torque(self, state: State, setpoint: Setpoint) -> np.ndarray:
        return np.full(7, 20.0) * self._rng.choice([-1.0, 1.0], 7)

    def applied(self, tau: np.ndarray) -> None:
        self.got.append(np.array(tau))


@pytest.mark.parametrize("late", [0, 1, 2])
def test_torques_keep_their_rate_where_commands_are_lost_or_late(controller: Controller, late: int):
    """The law is told what was sent; a robot that reports commands late is sent no more than it bears."""
    arm = arm_of("fr3")
    controller.late = late
    law = Wild()
    host = LinkHost(opened(), link_law(arm, opened(), law, envelope_of(arm.limits, "test"), None))
    host.open()
    assert host.play(armctl.move_j(arm, arm.home, arm.home).pieces, None, arm.limits).reason == ""
    for _ in range(700):
        host.advance()
    # Against a report that is old, a part of the rate must do.
    assert (0.3 if late else 0.9) * RATE_MAX < controller.greatest_rate <= RATE_MAX
    told = np.array(law.got) - arm.gravity(arm.home)
    sent = np.array(controller.sent)
    assert np.abs(told[-len(sent) :] - sent[-len(told) :]).max() < 1e-9


def test_a_stream_of_torques_that_has_ended_takes_none(controller: Controller):
    link = opened()
    link.start_torques()
    link.wait()
    link.send_torques(np.zeros(7), last=True)
    assert not controller.moving
    with pytest.raises(armctl.LinkError, match="no stream is open"):
        link.send_torques(np.zeros(7), last=False)
    assert np.abs(link.read().q_ref - controller.q).max() == 0.0  # it stands where it is, and not where it was sent before


class Steep:
    """A law whose torques rise as fast as a step, to more than any motor gives."""

    def torque(self, state: State, setpoint: Setpoint) -> np.ndarray:
        return np.full(7, 1e4)


@pytest.mark.parametrize("law", ["pd-gravity", Steep()], ids=["at rest", "steep"])
def test_a_law_on_a_franka_keeps_its_bounds_and_sends_no_gravity(controller: Controller, law: Any):
    arm = arm_of("fr3")
    link = armctl.links.Franka("fake", real_time=False)
    host = LinkHost(link, link_law(arm, link, law, envelope_of(arm.limits, "test"), None))
    host.open()
    played = host.play(armctl.move_j(arm, arm.home, arm.home).pieces, None, arm.limits)
    assert played.reason == ""
    ticks = 0
    while host.streaming and ticks < 400:
        host.advance()
        ticks += 1
    assert controller.greatest_rate <= RATE_MAX
    assert (controller.greatest <= FR3_TORQUE.torque_limits).all()
    if law == "pd-gravity":
        assert controller.greatest.max() < 1e-6
    else:
        assert controller.greatest[6] > 0.9 * FR3_TORQUE.torque_limits[6]


def test_an_interface_of_another_arm_is_refused():
    with pytest.raises(armctl.InputError, match=r"torque\.tau_max"):
        armctl.links.Franka("127.0.0.1", torque=armctl.links.TorqueInterface([1.0]))
    with pytest.raises(armctl.InputError, match="torque: expected TorqueInterface, got 'all'"):
        armctl.links.Franka("127.0.0.1", torque="all")  # type: ignore[arg-type]
