"""A client of the page without a browser: it speaks viser's protocol."""

from __future__ import annotations

import contextlib
import http.client
import threading
import time
from collections.abc import Callable, Iterator

import msgspec
import numpy as np
import viser
import websockets.sync.client
from arms import BUNDLED, arm_of

from armctl.model.arm.arm import Arm
from armctl.view.page import Page, Scenes
from armctl.view.realtime.status import Activity
from armctl.view.web_scene import WebScene

TIMEOUT_S = 120.0  # on a busy machine
CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [1.0, 1.0, 1.0],
    "fov": 0.8,
    "near": 0.01,
    "far": 1000.0,
    "image_height": 400,
    "image_width": 600,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
}


@contextlib.contextmanager
def open_page(arm: Arm | None = None, scenes: Scenes | None = None, **options) -> Iterator[Page]:
    """A page with an arm, by default the bundled one, which is served until the end."""
    page = Page(arm or arm_of(BUNDLED), WebScene(0, **options), scenes=scenes)
    thread = threading.Thread(target=page.serve, daemon=True)
    thread.start()
    try:
        yield page
    finally:
        page.close()
        thread.join(timeout=TIMEOUT_S)
        assert not thread.is_alive()


class Client:
    """A WebSocket client of a page. It reads and forgets what the page sends."""

    def __init__(
        self, page: Page, path: str = "", *, origin: str | None = "own", host: str | None = None, cookie: str | None = None
    ):
        address = f"127.0.0.1:{page.port}"
        headers = {"Cookie": cookie} if cookie else {}
        self.connection = websockets.sync.client.connect(
            f"ws://{host or address}{path}",
            sock=http.client.socket.create_connection(("127.0.0.1", page.port)),
            origin=f"http://{host or address}" if origin == "own" else origin,
            subprotocols=None if path else [f"viser-v{viser.__version__}"],
            additional_headers=headers,
            max_size=None,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        with contextlib.suppress(websockets.exceptions.ConnectionClosed):
            while True:
                self.connection.recv()

    def send(self, message: dict | bytes | str) -> None:
        """Sends a message."""
        self.connection.send(message if isinstance(message, bytes | str) else msgspec.msgpack.encode(message))

    def set(self, page: Page, label: str, value: object, **more: object) -> None:
        """Changes a control of the panel."""
        self.send({"type": "GuiUpdateMessage", "uuid": control_id(page, label), "updates": {"value": value, **more}})

    def close(self) -> None:
        self.connection.close()


@contextlib.contextmanager
def connected(page: Page, **how) -> Iterator[Client]:
    """A client that the page counts as connected."""
    client = Client(page, **how)
    try:
        client.send(CAMERA)
        yield client
    finally:
        client.close()


def control_id(page: Page, label: str) -> str:
    """The id of a control of the panel."""
    controls = page.scene.server.gui._gui_input_handle_from_uuid
    return next(uuid for uuid, control in controls.items() if getattr(control, "label", None) == label)


def get(page: Page, path: str = "/", **headers: str) -> http.client.HTTPResponse:
    """The response to a request with these headers."""
    connection = http.client.HTTPConnection("127.0.0.1", page.port, timeout=TIMEOUT_S)
    connection.putrequest("GET", path, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    response = connection.getresponse()
    response.read()
    connection.close()
    return response


def until(condition: Callable[[], bool], what: str) -> None:
    """Waits for a condition."""
    deadline = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.02)


def follows(page: Page, client: Client) -> None:
    """Asserts that the arm still reaches two targets that a client sends."""
    session = page.session
    client.set(page, "time", "play")
    client.set(page, "simulation speed", 1.5)
    client.set(page, "simulation speed", 1.0)
    client.set(page, "payload, kg", 0.0)
    client.set(page, "controller", "computed-torque")
    client.set(page, "orientation counts", False)
    until(lambda: session.status.payload == 0.0 and not session.status.paused, "the page does not take commands")
    for target in ([0.25, -0.2, 0.4], [0.2, 0.2, 0.35]):
        client.set(page, "position, m", target)
        until(
            lambda target=target: (
                np.abs(session.status.target.position - target).max() < 1e-9 and session.status.activity is Activity.AT_TARGET
            ),
            f"the arm does not follow: {session.status}",
        )
        status = session.status
        assert np.linalg.norm(session.arm.fk(status.q).position - target) < 2e-3
