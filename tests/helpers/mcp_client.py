"""A client of `armctl mcp`: the SDK's own over standard input and output, behind calls that wait."""

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

from anyio.from_thread import BlockingPortal, start_blocking_portal
from mcp.client.session import ClientSession
from mcp.client.stdio import StdioServerParameters, stdio_client
from mcp.types import CallToolResult

_EXIT_TIMEOUT_S = 60.0  # in which the server may end by itself: the SDK's 2 s are short on a busy computer


class McpClient:
    """A session with a server."""

    def __init__(self, portal: BlockingPortal, session: ClientSession, errors: Path):
        self._portal = portal
        self._session = session
        self._errors = errors

    def call(self, tool: str, arguments: dict[str, Any] | None = None) -> CallToolResult:
        """Calls a tool, and waits for its answer."""
        return self._portal.call(self._session.call_tool, tool, arguments)

    def tools(self) -> dict[str, dict[str, Any]]:
        """The schemas of the tools."""
        return {tool.name: tool.input_schema for tool in self._portal.call(self._session.list_tools).tools}

    def state(self) -> dict[str, Any]:
        """What the tool `state` says."""
        values = self.call("state").structured_content
        assert values is not None
        return values

    @property
    def errors(self) -> str:
        """What the server has printed to standard error."""
        return self._errors.read_text()


@contextlib.contextmanager
def mcp_client(folder: Path, *arguments: str) -> Iterator[McpClient]:
    """A client of a server in a process of its own.

    Args:
        folder: Where its standard error is kept.
        arguments: What follows `armctl mcp`.
    """
    errors = folder / "stderr.txt"
    server = StdioServerParameters(command=sys.executable, args=["-m", "armctl", "mcp", *arguments], env=dict(os.environ))

    @contextlib.asynccontextmanager
    async def session(log):
        async with stdio_client(server, errlog=log) as streams, ClientSession(*streams) as session:
            await session.initialize()
            yield session

    with (
        patch("mcp.client.stdio.PROCESS_TERMINATION_TIMEOUT", _EXIT_TIMEOUT_S),
        errors.open("w") as log,
        start_blocking_portal() as portal,
        portal.wrap_async_context_manager(session(log)) as opened,
    ):
        yield McpClient(portal, opened, errors)
