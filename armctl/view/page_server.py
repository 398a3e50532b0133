"""viser's server behind access control and a message filter.

viser serves HTTP and WebSocket with one call of `websockets.asyncio.server.serve`. viser offers no hook for requests or
messages, but `serve` does. So this module adds our hooks and limits to that call, which it knows by its address, while viser
starts. The page has one port. A proxy would need a second one: viser listens at TCP ports only, and checks neither Origin nor
token, so that any page in a browser of this machine could reach it there.
"""

import asyncio
import contextlib
import gzip
import html
import io
import logging
import socket
import threading
from importlib.resources import files
from typing import Any

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from armctl.core.errors import InputError, NotInstalledError
from armctl.view.access_control import AccessControl, add_security_headers
from armctl.view.devices import PATH, HandDevices
from armctl.view.message_filter import MAX_MESSAGE_BYTES, MessageFilter

LOCAL = "127.0.0.1"
_MAX_PORTS_TRIED = 100
_CLOSE_TIMEOUT_S = 0.5  # for a client that does not answer when the page closes
_OPEN_TIMEOUT_S = 10.0
_MAX_REQUESTS = 256  # connections without a WebSocket: they load the page, or have not sent a request yet
_TOO_MANY_CLIENTS = 1013  # WebSocket close code "try again later"
_GZIP_LEVEL = 6
# Text and buttons with the contrast of WCAG 2 AA, 4.5 to 1, and the ends of a slider below its handle. On a phone the panel
# is as wide as the page and leaves room above.
_STYLE = """
:root {
  --mantine-color-dimmed: #495057 !important;
  --mantine-primary-color-filled: #1864ab !important;
  --mantine-primary-color-filled-hover: #134f87 !important;
  --mantine-color-custom-outline: #1864ab !important;
}
.mantine-ScrollArea-content { box-sizing: border-box; max-width: 100%; padding-right: 0.6rem; }
/* What the arm does stays at the top of the panel, beside every input; a clipped box, unlike a hidden one, lets it. */
.mantine-ScrollArea-content div[style*="overflow: hidden"] {
  overflow: clip !important; min-width: 0; min-height: 0;
}
.mantine-ScrollArea-content div:first-child:has(> p.mantine-Text-root) {
  position: sticky; top: 0; z-index: 5; background: var(--mantine-color-body);
}
#webgl-software-rendering { animation: fade 0.5s 6s forwards; }
@keyframes fade { to { opacity: 0; visibility: hidden; } }
.mantine-Slider-markLabel { color: #495057 !important; margin-top: 0.25rem; }
div, label, p, input { letter-spacing: normal !important; }
@media (max-width: 600px) {
  .mantine-Paper-root:has(> div .mantine-ScrollArea-root) { width: 100% !important; max-height: 45% !important; }
  .mantine-ScrollArea-content > div { width: 100% !important; }
}
"""
_start_lock = threading.Lock()

_log = logging.getLogger("armctl.view")
_silent_log = logging.getLogger("armctl.view.websockets")  # a client must not be able to fill the terminal
_silent_log.addHandler(logging.NullHandler())
_silent_log.propagate = False


def listen(port: int, host: str | None) -> socket.socket:
    """A socket that listens at an address, or at the next free port of this machine if no host is given."""
    last = port if host is not None or port == 0 else min(port + _MAX_PORTS_TRIED, 65535)
    while True:
        try:
            address_of = LOCAL if host is None else host or None
            addresses = socket.getaddrinfo(address_of, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
            family, _, _, _, address = addresses[0]
            return socket.create_server(address[:2], family=family)
        except OSError as error:
            if port >= last:
                name = "port" if host is None else "host"
                raise InputError(f"{name}: cannot listen at {host or LOCAL}:{port} ({error.strerror or error})") from None
            port += 1


class _Connections:
    """The connections of a page. One more request than allowed ends the oldest, so that idle ones lock nobody out."""

    def __init__(self) -> None:
        self.all: set[ServerConnection] = set()
        self.requests: dict[ServerConnection, None] = {}  # in the order of their arrival

    def add(self, connection: ServerConnection) -> None:
        self.all.add(connection)
        self.requests[connection] = None
        if len(self.requests) > _MAX_REQUESTS:
            oldest = next(iter(self.requests))
            del self.requests[oldest]
            oldest.transport.abort()

    def remove(self, connection: ServerConnection) -> None:
        self.all.discard(connection)
        self.requests.pop(connection, None)

    def abort(self) -> None:
        for connection in list(self.all):
            connection.transport.abort()


class _UnsharedServer(viser.ViserServer):
    """viser's server without the tunnel that would publish the page. The filter drops requests for it, too."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Opens no tunnel."""

    def disconnect_share_url(self) -> None:
        """There is no tunnel."""


class PageServer:
    def __init__(self, server: viser.ViserServer, connections: _Connections, devices: HandDevices):
        """Use `start_server`."""
        self.viser = server  # viser's server
        self.devices = devices  # what the visitors' keyboards, gamepads and SpaceMice ask for
        self._connections = connections

    def stop(self) -> None:
        """Ends all connections at once and stops the server: a client that does not answer must not delay the end."""
        with contextlib.suppress(RuntimeError):  # the event loop is closed already
            self.viser.get_event_loop().call_soon_threadsafe(self._connections.abort)
        with contextlib.redirect_stdout(io.StringIO()):  # viser announces its end
            self.viser.stop()


def start_server(listener: socket.socket, access: AccessControl, title: str) -> PageServer:
    """Starts viser's server on a socket, behind access control and a message filter. The browser's tab shows the title."""
    messages = MessageFilter()
    connections = _Connections()
    devices = HandDevices()
    address = (LOCAL, int(listener.getsockname()[1]))
    unprotected_serve = websockets.asyncio.server.serve
    calls: list[str] = []

    def serve(handler, host, port, *, process_request=None, **options: Any):
        if (host, port) != address:  # not viser's call
            return unprotected_serve(handler, host, port, process_request=process_request, **options)
        calls.append("serve")
        options.update(_options(messages, connections))
        checked = _checked(process_request, access, title)
        counted = _counted(handler, access, connections, devices)
        return unprotected_serve(counted, sock=listener, process_request=checked, **options)

    with _start_lock, contextlib.redirect_stdout(io.StringIO()):  # viser prints a table
        setattr(websockets.asyncio.server, "serve", serve)  # noqa: B010 (for the type checker, a class is not a variable)
        try:
            server = _UnsharedServer(*address, verbose=False)
        finally:
            setattr(websockets.asyncio.server, "serve", unprotected_serve)  # noqa: B010
    if calls != ["serve"]:
        listener.close()
        PageServer(server, connections, devices).stop()
        raise NotInstalledError(f"armctl cannot protect the page of viser {viser.__version__}; install viser 1.1")
    loop = server.get_event_loop()
    loop.call_soon_threadsafe(loop.set_exception_handler, _ErrorLog())
    # viser has no public way from the id in a message to the control.
    messages.inputs = server.gui._gui_input_handle_from_uuid
    return PageServer(server, connections, devices)


def _options(messages: MessageFilter, connections: _Connections) -> dict[str, Any]:
    class FilteredConnection(ServerConnection):
        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            super().connection_made(transport)
            connections.add(self)

        def connection_lost(self, exc: Exception | None) -> None:
            connections.remove(self)
            super().connection_lost(exc)

        async def recv(self, decode: bool | None = None) -> Any:
            if _is_for_devices(self):
                return await super().recv(decode)
            while True:
                message = messages.checked(await super().recv(decode))
                if message is not None:
                    return message

    return {
        "create_connection": FilteredConnection,
        "max_size": MAX_MESSAGE_BYTES,
        "open_timeout": _OPEN_TIMEOUT_S,
        "close_timeout": _CLOSE_TIMEOUT_S,
        "server_header": None,
        "logger": _silent_log,
    }


def _is_for_devices(connection: ServerConnection) -> bool:
    return connection.request is not None and connection.request.path == PATH


def _counted(handler, access: AccessControl, connections: _Connections, devices: HandDevices):
    async def handle(connection: ServerConnection) -> None:
        connections.requests.pop(connection, None)
        if not access.add_client(connection):
            await connection.close(_TOO_MANY_CLIENTS)
            return
        try:
            await (devices.serve if _is_for_devices(connection) else handler)(connection)
        finally:
            access.remove_client(connection)

    return handle


def _checked(process_request, access: AccessControl, title: str):
    pages: dict[str, bytes] = {}

    async def answer(connection: ServerConnection, request: Request) -> Response | None:
        response = await access.answer(connection, request)
        if response is None:
            response = process_request(connection, request)
            if response is not None and response.headers.get("Content-Type", "").startswith("text/html"):
                encoding = response.headers["Content-Encoding"]
                if encoding not in pages:
                    pages[encoding] = _styled(response.body, title, compressed=encoding == "gzip")
                response.body = pages[encoding]
                del response.headers["Content-Length"]
                response.headers["Content-Length"] = str(len(response.body))
        return response if response is None else add_security_headers(response, access.in_notebook)

    return answer


def _styled(page: bytes, title: str, *, compressed: bool) -> bytes:
    plain = gzip.decompress(page) if compressed else page
    script = files("armctl.view").joinpath("devices.js").read_text(encoding="utf-8")
    head = f"<title>{html.escape(title)}</title><style>{_STYLE}</style><script>{script}</script>"
    styled = plain.replace(b"<title>Viser</title>", head.encode(), 1)
    return gzip.compress(styled, _GZIP_LEVEL) if compressed else styled


class _ErrorLog:
    """Writes each kind of error on viser's event loop to the log once."""

    def __init__(self) -> None:
        self._seen: set[str] = set()

    def __call__(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        kind = f"{context.get('message')}: {type(context.get('exception')).__name__}"
        if kind not in self._seen:
            self._seen.add(kind)
            _log.warning("the page's server had an error: %s (%s)", kind, context.get("exception"))
