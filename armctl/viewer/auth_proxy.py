"""AuthProxy: lets those through to the page who know the token, and nobody else, when it is served to other machines."""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import socket
import threading
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, quote, urlsplit

from armctl.core.errors import InputError
from armctl.viewer.web_scene import LOCAL

TOKEN_LENGTH = 8  # characters at least
_HEAD_MAX = 16384  # bytes
_PATIENCE = 10.0  # s for a request's head to arrive
_COOKIE = "armctl"
_END = b"Content-Length: 0\r\nConnection: close\r\n\r\n"
_REFUSAL = b"HTTP/1.1 403 This page wants its token\r\n" + _END


class AuthProxy:
    """A reverse proxy on an outer address, in a thread of its own. Whatever comes without the token gets nothing behind it.

    The page's address carries the token once; the answer is a cookie, which the browser shows for all that follows, WebSocket
    included. Without TLS the token is readable on the way: a network that is not trusted wants a tunnel, such as ssh -L.

    Attributes:
        url: The address to hand out, token and all.
    """

    def __init__(self, host: str, token: str, inner: int, port: int):
        """Opens the gate.

        Args:
            host: The address to listen at, such as "0.0.0.0".
            token: What a visitor must know.
            inner: The port of the page on this machine.
            port: Where to listen; any free one if 0.

        Raises:
            InputError: The token is too short, or nobody can listen there.
        """
        if len(token) < TOKEN_LENGTH:
            raise InputError(f"token: {len(token)} characters given, at least {TOKEN_LENGTH} wanted")
        self._token, self._inner = token.encode(), inner
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="armctl gate", daemon=True)
        self._thread.start()
        starting = asyncio.run_coroutine_threadsafe(asyncio.start_server(self._visit, host, port, limit=_HEAD_MAX), self._loop)
        try:
            self._server = starting.result()
        except OSError as error:
            self._end()
            raise InputError(f"host: nobody can listen at {host}:{port} ({error.strerror or error})") from None
        shown = socket.gethostname() if host in ("", "0.0.0.0", "::") else host
        self.url = f"http://{shown}:{self._server.sockets[0].getsockname()[1]}/?token={quote(token)}"

    def close(self) -> None:
        """Shuts the gate on everyone."""
        self._loop.call_soon_threadsafe(self._server.close)
        self._end()

    def _end(self) -> None:
        async def cancel_all() -> None:
            tasks = asyncio.all_tasks() - {asyncio.current_task()}
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

        asyncio.run_coroutine_threadsafe(cancel_all(), self._loop).result(timeout=5.0)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(timeout=5.0)
        self._loop.close()

    async def _visit(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """One connection: its first request decides; then bytes flow both ways."""
        try:
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), _PATIENCE)
            path, cookie = _path_and_cookie(head)
            if self._knows(parse_qs(urlsplit(path).query).get("token", [""])[0]):
                writer.write(self._welcome())
            elif not self._knows(cookie):
                writer.write(_REFUSAL)
            else:
                await self._pass_on(head, reader, writer)
            writer.close()
            await writer.wait_closed()
        except (TimeoutError, OSError, ValueError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # a visitor who left, or never spoke HTTP
        finally:
            writer.transport.abort()

    async def _pass_on(self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        inner_reader, inner_writer = await asyncio.open_connection(LOCAL, self._inner)
        inner_writer.write(head)
        flows = [asyncio.ensure_future(_flow(reader, inner_writer)), asyncio.ensure_future(_flow(inner_reader, writer))]
        try:
            await asyncio.wait(flows, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for flow in flows:
                flow.cancel()
            inner_writer.transport.abort()

    def _knows(self, word: str) -> bool:
        return hmac.compare_digest(word.encode(), self._token)

    def _welcome(self) -> bytes:
        """Hands out the cookie, and sends on to an address without the token, so that it stays in no history."""
        cookie = f"{_COOKIE}={quote(self._token.decode(), safe='')}; HttpOnly; SameSite=Strict; Path=/"
        return f"HTTP/1.1 303 See Other\r\nLocation: /\r\nSet-Cookie: {cookie}\r\n".encode() + _END


def _path_and_cookie(head: bytes) -> tuple[str, str]:
    """What a request asks for, and the token it carries."""
    request, *lines = head.decode("latin-1").split("\r\n")
    words = request.split(" ")
    fields = dict(line.split(":", 1) for line in lines if ":" in line)
    cookies = SimpleCookie()
    with contextlib.suppress(CookieError):
        cookies.load(next((value.strip() for name, value in fields.items() if name.lower() == "cookie"), ""))
    token = cookies[_COOKIE].value if _COOKIE in cookies else ""
    return (words[1] if len(words) > 1 else ""), parse_qs(f"t={token}").get("t", [""])[0]


async def _flow(source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
    with contextlib.suppress(OSError):
        while chunk := await source.read(1 << 16):
            sink.write(chunk)
            await sink.drain()
