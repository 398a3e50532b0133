"""AccessControl: which requests a page answers. It checks Host, Origin, token and the number of clients."""

from __future__ import annotations

import asyncio
import hmac
import http
import ipaddress
import secrets
import socket
from collections import OrderedDict
from collections.abc import Sequence
from http.cookies import CookieError, SimpleCookie
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, quote, urlsplit

from armctl.core.errors import InputError

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

MIN_TOKEN_LENGTH = 8
MAX_CLIENTS = 16
_MAX_SESSIONS = 256
_SESSION_ID_BYTES = 32
_WRONG_TOKEN_DELAY_S = 0.1  # wrong tokens are answered one after the other, so at most ten guesses a second
_HEADERS = {
    "Cache-Control": "no-cache",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
# Another page must not show this one and catch the clicks.
_NO_FRAMES = {"Content-Security-Policy": "frame-ancestors 'none'", "X-Frame-Options": "DENY"}
# X-Frame-Options does not support a list of pages, so only the policy is sent.
_NOTEBOOK_FRAMES = {"Content-Security-Policy": "frame-ancestors http://localhost:* http://127.0.0.1:*"}


def check_token(token: str) -> str:
    """The token, if it is long enough and can be part of an address."""
    if len(token) < MIN_TOKEN_LENGTH:
        raise InputError(f"token: expected at least {MIN_TOKEN_LENGTH} characters, got {len(token)}")
    return token


class AccessControl:
    """Decides about each HTTP and WebSocket request before viser sees it.

    A request must name this machine in Host: otherwise a foreign page could reach this one through a DNS name of its own (DNS
    rebinding). A request from a script carries Origin, which must be the page itself: otherwise any page in the same browser
    could open a WebSocket. With a token, a visitor shows the token once and gets a random session id as a cookie.
    """

    def __init__(
        self,
        port: int,
        host: str | None = None,
        token: str | None = None,
        allowed_hosts: Sequence[str] = (),
        *,
        in_notebook: bool = False,
    ):
        self.in_notebook = in_notebook
        self._token = None if token is None else check_token(token).encode()
        self._cookie_name = f"armctl-{port}"  # cookies do not distinguish ports, so the name does
        self._sessions: OrderedDict[str, None] = OrderedDict()
        self._one_time_codes: set[str] = set()
        self._clients: set[ServerConnection] = set()
        self._wrong_token_lock = asyncio.Lock()
        self._names = {"localhost", *(name.lower() for name in allowed_hosts)}
        if host is not None:
            machine = socket.gethostname().lower()
            self._names |= {host.lower(), machine, f"{machine}.local", socket.getfqdn().lower()}

    def query(self) -> str:
        """The part of the page's address that carries the token; empty without one."""
        return "" if self._token is None else f"/?token={quote(self._token.decode(), safe='')}"

    def one_time_query(self) -> str:
        """The same with a code that is valid once: other users of this machine can read a browser's command line."""
        if self._token is None:
            return ""
        code = secrets.token_urlsafe(_SESSION_ID_BYTES)
        self._one_time_codes.add(code)
        return f"/?token={code}"

    def add_client(self, connection: ServerConnection) -> bool:
        """False if there are too many."""
        if len(self._clients) >= MAX_CLIENTS:
            return False
        self._clients.add(connection)
        return True

    def remove_client(self, connection: ServerConnection) -> None:
        self._clients.discard(connection)

    async def answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """The response to a request that goes no further; None if viser may answer it."""
        host = _single(request, "Host")
        if host is None or not self._is_own(host, connection):
            return _response(http.HTTPStatus.FORBIDDEN, "This address is not a name of the page. See --allow-host.")
        origin = _single(request, "Origin")
        is_websocket = "upgrade" in request.headers
        if origin is None:
            if is_websocket or request.headers.get_all("Origin"):
                return _response(http.HTTPStatus.FORBIDDEN, "A connection needs the Origin of the page.")
        elif origin.lower() not in (f"http://{host.lower()}", f"https://{host.lower()}"):
            return _response(http.HTTPStatus.FORBIDDEN, "The request comes from another page.")
        if self._token is not None:
            denied = await self._check_session(request)
            if denied is not None:
                return denied
        if is_websocket and len(self._clients) >= MAX_CLIENTS:
            return _response(http.HTTPStatus.SERVICE_UNAVAILABLE, f"The page serves at most {MAX_CLIENTS} clients.")
        return None

    async def _check_session(self, request: Request) -> Response | None:
        given = parse_qs(urlsplit(request.path).query).get("token")
        if given is not None:
            if self._is_valid(given[0]):
                return self._logged_in()
            async with self._wrong_token_lock:
                await asyncio.sleep(_WRONG_TOKEN_DELAY_S)
        elif self._has_session(request):
            return None
        return _response(http.HTTPStatus.FORBIDDEN, "This page needs its token.")

    def _is_valid(self, token: str) -> bool:
        assert self._token is not None
        if token in self._one_time_codes:
            self._one_time_codes.discard(token)
            return True
        return hmac.compare_digest(token.encode(errors="replace"), self._token)

    def _has_session(self, request: Request) -> bool:
        for header in request.headers.get_all("Cookie"):
            cookies = SimpleCookie()
            try:
                cookies.load(header)
            except CookieError:
                continue
            # 256 bits of a random id cannot be guessed by timing a dictionary
            if self._cookie_name in cookies and cookies[self._cookie_name].value in self._sessions:
                return True
        return False

    def _logged_in(self) -> Response:
        """Gives out a session and redirects to the address without the token, so that the history does not keep it."""
        session = secrets.token_urlsafe(_SESSION_ID_BYTES)
        self._sessions[session] = None
        while len(self._sessions) > _MAX_SESSIONS:
            self._sessions.popitem(last=False)
        response = _response(http.HTTPStatus.SEE_OTHER, "")
        response.headers["Location"] = "/"
        response.headers["Set-Cookie"] = f"{self._cookie_name}={session}; HttpOnly; SameSite=Strict; Path=/"
        return response

    def _is_own(self, host: str, connection: ServerConnection) -> bool:
        """Whether a Host names this machine: by a known name, or by the address that the connection came in at."""
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        if name.rstrip(".") in self._names:
            return True
        if "%" in name:  # no browser sends a zone, and "127.0.0.1%00.evil.example" is no address
            return False
        try:
            return _address(name) == _address(connection.local_address[0])
        except ValueError:
            return False


def add_security_headers(response: Response, in_notebook: bool = False) -> Response:
    """The same response with headers; only a notebook kernel, of this machine, may show its page in another one."""
    frames = _NOTEBOOK_FRAMES if in_notebook else _NO_FRAMES
    for name, value in (_HEADERS | frames).items():
        if name not in response.headers:
            response.headers[name] = value
    return response


def _address(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    address = ipaddress.ip_address(text.partition("%")[0])
    return (isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped) or address


def _single(request: Request, name: str) -> str | None:
    """A header that must not be repeated; None if it is missing or repeated."""
    values = request.headers.get_all(name)
    return values[0] if len(values) == 1 else None


def _response(status: http.HTTPStatus, sentence: str) -> Response:
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    body = f"{sentence}\n".encode() if sentence else b""
    headers = Headers()
    headers["Content-Type"] = "text/plain; charset=utf-8"
    headers["Content-Length"] = str(len(body))
    headers["Connection"] = "close"
    return Response(status.value, status.phrase, headers, body)
