"""What the server makes of lines that are no protocol, of a client that leaves, and of a program that prints."""

import io
import json
import os
import threading
from collections.abc import Iterator
from typing import Any

import pytest
from arms import BUNDLED, arm_of

import armctl

pytest.importorskip("mcp", reason="pip install -e '.[mcp]'")

from armctl.run.agent.server import Wire, serve_on


class Session:
    """A server in a thread, and both ends of its pipes."""

    def __init__(self, robot: armctl.Simulation | armctl.Robot):
        read_in, write_in = os.pipe()
        read_out, write_out = os.pipe()
        self.robot = robot
        self._to_server = os.fdopen(write_in, "wb", buffering=0)
        self._answers = os.fdopen(read_out, encoding="utf-8")
        self._last = 0
        stdin = io.TextIOWrapper(os.fdopen(read_in, "rb"), "utf-8", "replace")
        stdout = io.TextIOWrapper(os.fdopen(write_out, "wb"), "utf-8")
        self.thread = threading.Thread(target=self._serve, args=(stdin, stdout))
        self.thread.start()
        hello = {"protocolVersion": "2025-06-18", "capabilities": {}, "clientInfo": {"name": "test", "version": "1"}}
        assert self.ask("initialize", hello)["result"]["serverInfo"]["name"] == "armctl"
        self.send(json.dumps({"jsonrpc": "2.0", "method": "notifications/initialized"}))

    def _serve(self, stdin: io.TextIOWrapper, stdout: io.TextIOWrapper) -> None:
        with stdin, stdout:
            serve_on(Wire(stdin, stdout), self.robot)

    def send(self, line: str | bytes) -> None:
        """Sends a line."""
        self._to_server.write((line.encode() if isinstance(line, str) else line) + b"\n")

    def ask(self, method: str, parameters: Any) -> dict[str, Any]:
        """Sends a request, and waits for its answer."""
        self._last += 1
        self.send(json.dumps({"jsonrpc": "2.0", "id": self._last, "method": method, "params": parameters}))
        return self.answer(self._last)

    def answer(self, number: int) -> dict[str, Any]:
        """Reads lines until the answer to a request; each line is a message of the protocol."""
        for line in self._answers:
            message = json.loads(line)
            assert message["jsonrpc"] == "2.0"
            if message.get("id") == number:
                return message
        raise AssertionError("the server has ended")

    def call(self, tool: str, **arguments: Any) -> dict[str, Any]:
        """Calls a tool."""
        return self.ask("tools/call", {"name": tool, "arguments": arguments})["result"]

    def leave(self) -> None:
        """Closes the pipe of the client."""
        self._to_server.close()
        self.thread.join(30.0)
        assert not self.thread.is_alive()
        self._answers.close()


@pytest.fixture
def session() -> Iterator[Session]:
    session = Session(armctl.Simulation(arm_of(BUNDLED)))
    yield session
    session.leave()


def call_of(tool: str, arguments: str, number: int) -> str:
    """A line that calls a tool, with arguments that need not be JSON."""
    parameters = f'{{"name": "{tool}", "arguments": {arguments}}}'
    return f'{{"jsonrpc": "2.0", "id": {number}, "method": "tools/call", "params": {parameters}}}'


NOISE = [
    "",
    "{",
    "null",
    "[]",
    "[" * 100_000,
    '{"jsonrpc": "2.0", "id": 900}',
    '{"jsonrpc": "1.0", "id": 901, "method": "tools/call"}',
    '{"jsonrpc": "2.0", "id": 902, "method": "tools/call", "params": 3}',
    '{"jsonrpc": "2.0", "id": 903, "method": "tools/call", "params": {"name": 3, "arguments": {}}}',
    call_of("move_j", "[1, 2]", 904),
    '{"jsonrpc": "2.0", "id": 905, "method": "robot/move", "params": {}}',
    call_of("move_j", '{"q": [NaN, 0, -1]}', 906),
    call_of("move_j", '{"q": [Infinity, 0, -1]}', 907),
    call_of("move_to", '{"position": [1e999, 0, 0]}', 908),
    '{"jsonrpc": "2.0", "method": "notifications/cancelled", "params": {"requestId": {"a": 1}}}',
    b"\xff\xfe\x00 not text",
]


def test_lines_that_are_no_calls_move_nothing_and_the_server_goes_on(session: Session, capfd):
    before = session.call("state")["structuredContent"]
    for line in NOISE:
        session.send(line)
        assert session.call("state")["structuredContent"] == before
    assert session.robot.log is None
    assert not session.call("move_j", q={"shoulder_yaw": 0.2}).get("isError")
    assert "Traceback" not in "".join(capfd.readouterr())


@pytest.mark.parametrize("word", ["NaN", "Infinity", "-Infinity"])
def test_a_number_that_is_not_finite_is_refused_in_one_sentence(session: Session, word: str):
    session.send(call_of("move_j", f'{{"q": [{word}, 0, -1]}}', 77))
    answer = session.answer(77)["result"]
    assert answer["isError"]
    assert "finite" in answer["content"][0]["text"]
    assert session.robot.log is None


def test_a_stop_drops_calls_that_wait(session: Session):
    for number in (50, 51, 52):
        session.send(call_of("move_j", f'{{"q": {{"shoulder_yaw": 0.{number}}}, "speed": 0.01}}', number))
    session.send(call_of("stop", "{}", 53))
    answers = {}
    while len(answers) < 4:
        message = json.loads(session._answers.readline())
        answers[message["id"]] = message["result"]
    assert not answers[53].get("isError")
    assert answers[52]["isError"]
    assert "stop" in answers[52]["content"][0]["text"]
    assert not session.call("move_j", q={"shoulder_yaw": 0.0}).get("isError")
