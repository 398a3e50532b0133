"""serve_mcp: an arm behind a server of the Model Context Protocol, for language models that call tools."""

from __future__ import annotations

import asyncio
import base64
import io
import os
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

import armctl
from armctl.core.errors import import_extra
from armctl.core.json_values import json_value
from armctl.run.agent.agent import Agent, tool_rows
from armctl.run.agent.answer import ToolAnswer
from armctl.run.agent.person import PersonSwitch
from armctl.run.execution.commands import Commands
from armctl.run.links.robot import Robot

if TYPE_CHECKING:
    from mcp.types import CallToolResult

_INSTRUCTIONS = (
    "You command a robot arm. Units are m, rad, s and N; positions are in the world, z up; quaternions are w x y z. Every "
    "motion is proved free of contact before it begins, and otherwise refused with the reason and the nearest safe pose: read "
    "it, and ask for something else. Begin with state and look. A motion is over when its call returns."
)


class Wire(NamedTuple):
    """The two streams of the protocol."""

    stdin: io.TextIOWrapper
    stdout: io.TextIOWrapper


@contextmanager
def claimed_wire() -> Iterator[Wire]:
    """Keeps standard input and output for the protocol: what else prints, also in child processes, goes to standard error."""
    kept_in = os.dup(0)
    kept_out = os.dup(1)
    sys.stdout.flush()
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    os.dup2(2, 1)
    stdin = os.fdopen(kept_in, "rb", closefd=False)
    stdout = os.fdopen(kept_out, "wb", closefd=False)
    try:
        yield Wire(io.TextIOWrapper(stdin, "utf-8", "replace"), io.TextIOWrapper(stdout, "utf-8"))
    finally:
        sys.stdout.flush()
        os.dup2(kept_in, 0)
        os.dup2(kept_out, 1)


def serve_mcp(robot: Commands, *, out: str | os.PathLike[str] | None = None) -> None:
    """Serves an arm to a language model over standard input and output, until the client closes them.

    Tools: state, look, picture, move_to, move_l, move_j, grasp, open, undo and stop. Every motion takes the way of
    `robot.move_to` and its like: it is proved, or refused in one sentence with the nearest safe pose. A `Robot` moves only
    while a person lets it: `armctl allow` in a terminal. What the program prints goes to standard error meanwhile.

    Args:
        robot: A Simulation or a Robot; it stays open.
        out: A folder for a record: `calls.jsonl`, and the log of each motion as `00001.npz`.

    Raises:
        InputError: The folder cannot be made, or it is neither a Simulation nor a Robot.
        NotInstalledError: The SDK of the protocol is missing.

    Example:
        >>> sim = armctl.Simulation("panda")
        >>> sim.world.add("wall", armctl.Box([0.02, 1, 1]), at=[0.6, 0, 0.5])
        >>> armctl.serve_mcp(sim)
    """
    with claimed_wire() as wire:
        serve_on(wire, robot, out)


def serve_on(wire: Wire, robot: Commands, out: str | os.PathLike[str] | None = None) -> None:
    """As `serve_mcp`, on streams that are claimed already."""
    require_sdk()
    if not isinstance(robot, Robot):
        asyncio.run(_serve(wire, Agent(robot, out=out)))
        return
    switch = PersonSwitch(f"{robot.link.name}, model {robot.arm.name}")
    try:
        asyncio.run(_serve(wire, Agent(robot, switch.refusal, out), switch))
    finally:
        robot.interlock = None
        switch.close()


def require_sdk() -> None:
    """Raises NotInstalledError if the SDK is missing."""
    import_extra("mcp.server.lowlevel", "a server for language models needs the SDK of the Model Context Protocol", "mcp")


async def _serve(wire: Wire, agent: Agent, switch: PersonSwitch | None = None) -> None:
    import anyio
    import mcp.types as types
    from mcp.server.lowlevel import Server
    from mcp.server.stdio import stdio_server

    worker = ThreadPoolExecutor(1, "agent")  # one thread for all calls: motions come one after the other, and OpenGL wants it

    async def list_tools(_context: Any, _params: Any) -> types.ListToolsResult:
        return types.ListToolsResult(
            tools=[types.Tool(name=name, description=tool.text, input_schema=tool.schema) for name, tool in tool_rows()]
        )

    async def call_tool(_context: Any, params: types.CallToolRequestParams) -> CallToolResult:
        ticket = agent.ticket()
        if params.name == "stop":
            return _result(agent.stop())
        try:
            answer = await asyncio.get_running_loop().run_in_executor(worker, agent.call, params.name, params.arguments, ticket)
        except asyncio.CancelledError:  # the client does not wait for it any more
            agent.stop()
            raise
        if switch is not None:
            switch.tell(f"{params.name}: {answer.text}")
        return _result(answer)

    server = Server(
        "armctl", version=armctl.__version__, instructions=_INSTRUCTIONS, on_list_tools=list_tools, on_call_tool=call_tool
    )
    try:
        async with stdio_server(anyio.wrap_file(wire.stdin), anyio.wrap_file(wire.stdout)) as (read, write):
            await server.run(read, write, server.create_initialization_options())
    finally:
        agent.stop()
        worker.shutdown(cancel_futures=True)


def _result(answer: ToolAnswer) -> CallToolResult:
    import mcp.types as types

    content: list[Any] = [types.TextContent(text=answer.text)]
    if answer.picture:
        content.append(types.ImageContent(data=base64.b64encode(answer.picture).decode(), mime_type="image/png"))
    values = json_value(dict(answer.values)) or None
    return types.CallToolResult(content=content, structured_content=values, is_error=not answer.ok)
