"""Agent: takes the calls of a language model one after the other, and keeps a record of them."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Lock

from armctl.core.errors import ArmctlError, InputError, UnknownNameError
from armctl.core.json_values import json_value
from armctl.core.validation import shown
from armctl.run.agent.answer import ToolAnswer
from armctl.run.agent.tools import TOOLS, AgentTool, ArmTools
from armctl.run.execution.commands import Commands
from armctl.run.links.robot import Robot

STOP = "stop"
STOP_TEXT = "Stops the arm on its path, and drops the calls that wait. It needs no permission."
_STOPPED = "the agent's stop ended it"
_MAX_RECORDED_CHARACTERS = 2000  # of a call, and of its answer


class Agent:
    """An arm behind the tools of a language model.

    Calls run one after the other in one thread; `stop` and `ticket` may be called by any thread at any time.
    """

    def __init__(self, robot: Commands, permission: Callable[[], str] | None = None, out: str | os.PathLike[str] | None = None):
        """An agent for an arm.

        Args:
            robot: A Simulation or a Robot.
            permission: Says why the agent must not move anything now; empty if it may. None for a simulation.
            out: A folder for the record: `calls.jsonl`, and the log of each motion.

        Raises:
            InputError: A robot without a permission, or a folder that cannot be made.
        """
        if not isinstance(robot, Commands):
            raise InputError(f'robot: expected a Simulation or a Robot, got {shown(robot)}; armctl.Simulation("panda") is one')
        if isinstance(robot, Robot) and permission is None:
            raise InputError("permission: an agent moves a robot only while a person lets it")
        self._tools = ArmTools(robot)
        self._permission = permission
        self._lock = Lock()
        self._stops = 0  # how often it was stopped
        self._ticket = 0  # of the call that runs: how often it had been stopped when the call came
        self._record = None if out is None else _Record(out)
        if isinstance(robot, Robot):
            robot.interlock = self._refusal

    @property
    def arm_name(self) -> str:
        """The name of the arm."""
        return self._tools.robot.arm.name

    def ticket(self) -> int:
        """What a call gets when it arrives: a stop after that time ends it, also if it has not begun."""
        return self._stops

    def stop(self) -> ToolAnswer:
        """Stops the arm on its path, and all calls that have arrived."""
        with self._lock:
            self._stops += 1
        return ToolAnswer(True, "the arm stops on its path; calls that waited are dropped")

    def call(self, name: object, arguments: object, ticket: int) -> ToolAnswer:
        """Runs a tool; whatever is wrong becomes a sentence.

        Args:
            name: The tool.
            arguments: By name.
            ticket: That of the call's arrival.
        """
        self._ticket = ticket
        logs = self._tools.robot.log
        try:
            answer = self._run(_known(name), arguments)
        except ArmctlError as error:
            answer = ToolAnswer(False, str(error), {"reason": str(error)})
        except Exception as error:  # a model cannot repair it, but it must know that nothing is known
            reason = " ".join(f"internal error, {type(error).__name__}: {error}".split())[:400]
            answer = ToolAnswer(False, reason, {"reason": reason})
        if self._record is not None:
            log = self._tools.robot.log
            self._record.keep(name, arguments, answer, None if log is logs else log)
        return answer

    def _run(self, name: str, arguments: object) -> ToolAnswer:
        if name == STOP:
            return self.stop()
        tool = TOOLS[name]
        given = tool.checked(name, arguments)
        if tool.moves and (reason := self._refusal()):
            return ToolAnswer(False, reason, {"reason": reason})
        return tool.run(self._tools, given)

    def _refusal(self) -> str:
        """Why nothing may move now; empty if it may."""
        if self._stops != self._ticket:
            return _STOPPED
        return "" if self._permission is None else self._permission()


def tool_rows() -> Sequence[tuple[str, AgentTool]]:
    """All tools with their names."""
    return [*TOOLS.items(), (STOP, AgentTool(text=STOP_TEXT, run=lambda tools, given: ToolAnswer(True, "")))]


def _known(name: object) -> str:
    names = [*TOOLS, STOP]
    if not isinstance(name, str) or name not in names:
        raise UnknownNameError.from_known("tool", name, names)  # type: ignore[arg-type]
    return name


class _Record:
    """What was called and answered, and the logs of the motions, in a folder."""

    def __init__(self, folder: str | os.PathLike[str]):
        self._folder = Path(folder)
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._file = open(self._folder / "calls.jsonl", "a", encoding="utf-8")  # noqa: SIM115  # as long as the agent
        except OSError as error:
            raise InputError(f"out: {str(folder)!r:.160}: {error.strerror or error}") from None
        self._count = 0

    def keep(self, name: object, arguments: object, answer: ToolAnswer, log: object) -> None:
        self._count += 1
        row = {"call": self._count, "tool": name, "arguments": arguments, "ok": answer.ok, "answer": answer.text}
        if log is not None:
            file = f"{self._count:05}.npz"
            log.save(self._folder / file)  # type: ignore[attr-defined]
            row["log"] = file
        for key in ("tool", "arguments", "answer"):
            text = json.dumps(json_value(row[key]), default=str)
            if len(text) > _MAX_RECORDED_CHARACTERS:
                row[key] = text[:_MAX_RECORDED_CHARACTERS]
        self._file.write(json.dumps(json_value(row), default=str) + "\n")
        self._file.flush()
