"""A robot moves for an agent only while a person lets it, in a terminal; and brakes when that ends."""

import os
import re
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from arms import BUNDLED, arm_of

import armctl
from armctl.run.agent.agent import Agent
from armctl.run.agent.person import PersonSwitch, allow


class Terminal:
    """A person's terminal in which `armctl allow` runs."""

    def __init__(self) -> None:
        self._keys, slave = os.openpty()
        self._stdin = os.fdopen(slave, "r", encoding="utf-8")
        self._stdout = os.fdopen(os.dup(slave), "w", encoding="utf-8")
        self.failure: Exception | None = None
        self.thread = threading.Thread(target=self._run)
        self.thread.start()

    def _run(self) -> None:
        try:
            allow(self._stdin, self._stdout)
        except armctl.ArmctlError as error:
            self.failure = error

    def type(self, text: str) -> None:
        """Types a line."""
        os.write(self._keys, text.encode() + b"\n")

    def read(self) -> str:
        """What is on the screen."""
        return os.read(self._keys, 65536).decode()

    def close(self) -> None:
        """The terminal ends."""
        self.thread.join(10.0)
        assert not self.thread.is_alive()
        self._stdin.close()
        self._stdout.close()
        os.close(self._keys)


def wait_until(is_so: Callable[[], bool]) -> None:
    """Waits some seconds at most."""
    for _ in range(1000):
        if is_so():
            return
        time.sleep(0.01)
    raise AssertionError("it did not happen")


@pytest.fixture
def switch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[PersonSwitch]:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    switch = PersonSwitch("a robot for a test")
    yield switch
    switch.close()


@pytest.fixture
def robot() -> Iterator[armctl.Robot]:
    with armctl.Robot(arm_of(BUNDLED), armctl.links.PlantLink(arm_of(BUNDLED)), speed=0.5) as robot:
        yield robot


def test_a_robot_needs_a_person(robot: armctl.Robot):
    with pytest.raises(armctl.InputError, match="only while a person lets it"):
        Agent(robot)


def test_nothing_moves_until_a_person_says_yes_and_again_after_enter(robot: armctl.Robot, switch: PersonSwitch):
    agent = Agent(robot, switch.refusal)
    before = robot.state.q
    move = {"q": {"shoulder_yaw": 0.3}}
    for tool in ("move_j", "grasp", "open", "undo", "move_to", "move_l"):
        arguments = move if tool == "move_j" else {"position": [0.3, 0.1, 0.3]} if tool.startswith("move") else {}
        answer = agent.call(tool, arguments, agent.ticket())
        assert not answer.ok
        assert "a person has to run `armctl allow`" in answer.text
    assert (robot.state.q == before).all()
    assert agent.call("state", {}, agent.ticket()).ok
    terminal = Terminal()
    terminal.type("yes")
    wait_until(lambda: not switch.refusal())
    assert agent.call("move_j", move, agent.ticket()).ok
    switch.tell("move_j: done")
    wait_until(lambda: "move_j: done" in terminal.read())
    terminal.type("")
    wait_until(lambda: bool(switch.refusal()))
    assert not agent.call("undo", {}, agent.ticket()).ok
    terminal.close()


def test_a_word_other_than_yes_and_a_terminal_that_closes_allow_nothing(switch: PersonSwitch):
    for word in ("no", "y", ""):
        terminal = Terminal()
        terminal.type(word)
        terminal.close()
        assert switch.refusal()


def test_releasing_the_switch_brakes_the_arm_on_its_path(robot: armctl.Robot):
    agent = Agent(robot, lambda: "released" if robot.data.time > 0.2 else "")
    answer = agent.call("move_j", {"q": {"shoulder_yaw": 1.0}}, agent.ticket())
    assert not answer.ok
    assert answer.text == "not reached: released"
    assert answer.values["moved"]
    log = robot.log
    assert log is not None
    assert 0.0 < log.q_ref[-1, 0] < 0.6
    assert np.abs(np.diff(log.q_ref, axis=0)[-1]).max() < 1e-6


def test_a_stop_ends_the_motion_that_runs_and_what_is_asked_after_it_runs(robot: armctl.Robot):
    agent = Agent(robot, lambda: "")

    def stop_once() -> str:
        if robot.data.time > 0.2 and agent.ticket() == 0:
            agent.stop()
        return inner()

    inner = robot.interlock
    assert inner is not None
    robot.interlock = stop_once
    answer = agent.call("move_j", {"q": {"shoulder_yaw": 1.0}}, agent.ticket())
    assert "stop" in answer.text
    assert not answer.ok
    back = agent.call("undo", {}, agent.ticket())
    assert back.ok, back.text
    assert np.abs(robot.state.q - robot.arm.home).max() < 2e-3


def test_the_folder_of_the_switch_must_be_private(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    (tmp_path / f"armctl-mcp-{os.getuid()}").mkdir(mode=0o755)
    with pytest.raises(armctl.LinkError, match="must belong to you alone"):
        PersonSwitch("a robot")


def test_only_a_terminal_can_allow_and_only_where_a_server_waits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with open(os.devnull) as stdin, open(os.devnull, "w") as stdout, pytest.raises(armctl.InputError, match="in a terminal"):
        allow(stdin, stdout)
    terminal = Terminal()
    terminal.close()
    assert re.match("allow: no server of an agent has a robot", str(terminal.failure))
