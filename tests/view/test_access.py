"""Who reaches the page: Host, Origin, token, session cookie, number of clients, size of messages, and no way to publish it."""

import contextlib
import os
import re
import resource
import socket
import stat
import sys
import time
import types
from http.cookies import SimpleCookie
from pathlib import Path

import pytest
from arms import BUNDLED, arm_of

from armctl import InputError
from armctl.cli.main import main

pytest.importorskip("mjviser", reason="pip install -e '.[view]'")

import viser
import websockets.exceptions
from viewer_client import CAMERA, TIMEOUT_S, Client, connected, control_id, follows, get, open_page, until

from armctl.view import access_control, page_server
from armctl.view.access_control import MAX_CLIENTS, AccessControl
from armctl.view.message_filter import MAX_MESSAGE_BYTES
from armctl.view.page_server import listen
from armctl.view.viewer import Viewer
from armctl.view.web_scene import WebScene

TOKEN = "open sesame"


@pytest.fixture(scope="module")
def page():
    with open_page() as page:
        yield page


@pytest.fixture(scope="module")
def locked():
    """A page for other machines, which needs a token."""
    with open_page(host="127.0.0.1", token=TOKEN, allowed_hosts=["robot.example"]) as page:
        yield page


def cookie_of(page) -> str:
    """The cookie that the token buys."""
    response = get(page, "/?token=open%20sesame")
    assert (response.status, response.headers["Location"]) == (303, "/")
    return response.headers["Set-Cookie"].split(";")[0]


FOREIGN_ORIGINS = [
    "http://evil.example",
    "null",
    "http://127.0.0.1:1",
    "http://127.0.0.1",
    "http://localhost.evil.example",
    "file://",
    "https://evil.example:443",
]
FOREIGN_HOSTS = [
    "evil.example",
    "evil.example:8080",
    "127.0.0.1.evil.example",
    "192.0.2.1",
    "[::2]:80",
    "",
    "a b",
    "[::1",
    "127.0.0.1%00.evil.example",
    "127.0.0.1%25.evil.example:80",
    "[::ffff:127.0.0.1%00.evil.example]",
]


@pytest.mark.parametrize("origin", [*FOREIGN_ORIGINS, None])
def test_a_websocket_from_another_page_is_rejected(page, locked, origin):
    for target, cookie in ((page, None), (locked, cookie_of(locked))):
        with pytest.raises(websockets.exceptions.InvalidStatus, match="403"):
            Client(target, origin=origin, cookie=cookie)


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example"])
def test_dns_rebinding_is_rejected(page, locked, host: str):
    """The foreign page was loaded from its own name, which now resolves to this machine: Host and Origin agree."""
    for target, cookie in ((page, None), (locked, cookie_of(locked))):
        with pytest.raises(websockets.exceptions.InvalidStatus, match="403"):
            Client(target, host=f"{host}:{target.port}", cookie=cookie)
        assert get(target, Host=f"{host}:{target.port}", Cookie=cookie or "a=b").status == 403


@pytest.mark.parametrize("host", FOREIGN_HOSTS)
def test_a_request_for_another_host_is_rejected(page, host: str):
    assert get(page, Host=host).status == 403


@pytest.mark.parametrize("origin", FOREIGN_ORIGINS)
def test_a_request_of_a_script_of_another_page_is_rejected(page, origin: str):
    assert get(page, Origin=origin).status == 403


def test_a_request_with_two_hosts_or_none_is_rejected(page):
    for lines in (b"", b"Host: 127.0.0.1\r\nHost: evil.example\r\n"):
        with socket.create_connection(("127.0.0.1", page.port)) as connection:
            connection.sendall(b"GET / HTTP/1.1\r\n" + lines + b"\r\n")
            assert connection.recv(4096).startswith(b"HTTP/1.1 403 ")


def test_the_page_itself_is_served_under_the_names_of_this_machine(page, locked):
    port = page.port
    for host in (f"127.0.0.1:{port}", f"localhost:{port}", "localhost:9000"):  # 9000: the other end of a tunnel
        assert get(page, Host=host).status == 200
        client = Client(page, host=host)
        client.close()
    cookie = cookie_of(locked)
    for host in ("robot.example", f"{socket.gethostname()}:80"):
        assert get(locked, Host=host, Cookie=cookie).status == 200


def test_the_page_cannot_be_shown_inside_another_page(page):
    for path in ("/", "/missing"):
        headers = get(page, path).headers
        assert headers["X-Frame-Options"] == "DENY"
        assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]


def test_only_a_notebook_kernel_lets_pages_of_this_machine_show_its_page(monkeypatch: pytest.MonkeyPatch):
    kernel_shell = types.SimpleNamespace(kernel=object())
    monkeypatch.setitem(sys.modules, "IPython", types.SimpleNamespace(get_ipython=lambda: kernel_shell))
    viewer = Viewer(arm_of(BUNDLED), 0)
    try:
        headers = get(viewer.scene).headers
        assert headers["Content-Security-Policy"] == "frame-ancestors http://localhost:* http://127.0.0.1:*"
        assert headers["X-Frame-Options"] is None  # it would forbid every frame
        assert f'<iframe src="{viewer.url}"' in viewer._repr_html_()
    finally:
        viewer.close()


@pytest.mark.parametrize("message", ["ShareUrlRequest", "ShareUrlDisconnect"])
def test_no_message_opens_a_tunnel(page, monkeypatch: pytest.MonkeyPatch, message: str):
    opened = []
    monkeypatch.setattr("viser._viser.ViserTunnel", lambda *args: opened.append(args))
    monkeypatch.setattr(page.scene.server, "request_share_url", lambda *args: opened.append(args))
    monkeypatch.setattr(page.scene.server, "disconnect_share_url", lambda *args: opened.append(args))
    with connected(page) as client:
        client.send({"type": message})
        follows(page, client)
    assert opened == []


def test_no_tunnel_opens_even_behind_the_filter(page, monkeypatch: pytest.MonkeyPatch):
    """viser answers a request for a tunnel by calling these two."""
    opened = []
    monkeypatch.setattr("viser._viser.ViserTunnel", lambda *args: opened.append(args))
    server = page.scene.server
    assert server.request_share_url() is None
    server.disconnect_share_url()
    assert opened == []


def test_a_version_of_viser_that_serves_in_another_way_is_refused(monkeypatch: pytest.MonkeyPatch):
    real = viser.ViserServer.__init__

    def unprotected(self, *address, **options):
        real(self, "127.0.0.1", 0, **options)

    monkeypatch.setattr(viser.ViserServer, "__init__", unprotected)
    with pytest.raises(Exception, match="cannot protect"):
        WebScene(0)


# The token


@pytest.mark.parametrize("token", ["", "open", "open sesame ", "Open Sesame", "\udcff", "%00"])
def test_a_wrong_token_gets_nothing(locked, token: str):
    from urllib.parse import quote

    assert get(locked, f"/?token={quote(token, errors='surrogateescape')}").status == 403


@pytest.mark.parametrize(
    "cookie", ["", "armctl=open sesame", "armctl-{port}=open%20sesame", "armctl-{port}=", "=;;=", "x" * 4000]
)
def test_without_a_session_nothing_gets_through(locked, cookie: str):
    cookie = cookie.format(port=locked.port)
    for path in ("/", "/index.html", "/assets/index.js", "/?tok=open%20sesame"):
        assert get(locked, path, Cookie=cookie).status == 403
    with pytest.raises(websockets.exceptions.InvalidStatus, match="403"):
        Client(locked, cookie=cookie)


def test_the_cookie_is_random_and_holds_no_token(locked):
    response = get(locked, "/?token=open%20sesame")
    header = response.headers["Set-Cookie"]
    assert "HttpOnly" in header
    assert "SameSite=Strict" in header
    assert re.search("open|sesame", header) is None
    morsel = SimpleCookie(header)[f"armctl-{locked.port}"]
    assert len(morsel.value) >= 40
    assert morsel.value not in cookie_of(locked)


def test_the_session_reaches_the_page_and_its_websocket(locked):
    cookie = cookie_of(locked)
    assert get(locked, Cookie=cookie).status == 200
    with connected(locked, cookie=cookie) as client:
        follows(locked, client)


def test_the_session_of_one_page_opens_no_other(locked):
    with open_page(host="127.0.0.1", token=TOKEN) as other:
        value = cookie_of(locked).split("=", 1)[1]
        assert get(other, Cookie=f"armctl-{other.port}={value}").status == 403


def test_there_is_no_second_port_behind_the_page(locked):
    """Every socket that this process listens at asks for the token, or is another page's."""
    inodes = {os.readlink(f"/proc/self/fd/{fd}") for fd in os.listdir("/proc/self/fd") if _is_socket(fd)}
    ports = set()
    for line in Path("/proc/net/tcp").read_text().splitlines()[1:]:
        fields = line.split()
        if fields[3] == "0A" and f"socket:[{fields[9]}]" in inodes:
            ports.add(int(fields[1].split(":")[1], 16))
    assert locked.port in ports
    for port in ports - {locked.port}:
        with pytest.raises(websockets.exceptions.InvalidStatus, match="403"):
            Client(type("Other", (), {"port": port}), origin="http://evil.example")


def _is_socket(fd: str) -> bool:
    try:
        return stat.S_ISSOCK(os.stat(int(fd)).st_mode)
    except OSError:
        return False


def test_the_code_for_the_browser_is_valid_once(locked):
    path = locked.scene._access.one_time_query()
    assert "sesame" not in path
    assert get(locked, path).status == 303
    assert get(locked, path).status == 403


def test_old_sessions_end_when_there_are_too_many(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(access_control, "_MAX_SESSIONS", 2)
    with open_page(host="127.0.0.1", token=TOKEN) as page:
        cookies = [cookie_of(page) for _ in range(3)]
        assert [get(page, Cookie=cookie).status for cookie in cookies] == [403, 200, 200]


def test_wrong_tokens_are_slow_and_do_not_delay_the_right_one(locked):
    started = time.perf_counter()
    assert get(locked, "/?token=wrong").status == 403
    assert time.perf_counter() - started >= access_control._WRONG_TOKEN_DELAY_S


def test_a_short_token_and_a_taken_port_are_refused():
    with pytest.raises(InputError, match="token: expected at least 8 characters, got 5"):
        AccessControl(8080, token="short")
    with listen(0, None) as taken, pytest.raises(InputError, match="host: cannot listen at"):
        listen(taken.getsockname()[1], "127.0.0.1")
    with pytest.raises(InputError, match="host: cannot listen at"):
        listen(0, "192.0.2.1")


def test_without_a_host_the_next_free_port_is_used():
    with listen(0, None) as taken:
        port = taken.getsockname()[1]
        with listen(port, None) as other:
            assert other.getsockname()[1] > port


@pytest.mark.parametrize(
    ("argv", "environment", "sentence"),
    [
        (["--host", "127.0.0.1"], {}, "give a token of at least 8 characters"),
        (["--host", "127.0.0.1", "--token", "short"], {}, "token: expected at least 8 characters"),
        (["--host", "127.0.0.1"], {"ARMCTL_TOKEN": "brief"}, "token: expected at least 8 characters, got 5"),
        (["--host", "127.0.0.1", "--token-file", "missing"], {}, "cannot read 'missing'"),
        (["--token", "long enough", "--token-file", "missing"], {}, "not both"),
        (["--port", "70000"], {}, "port: expected a number in [0, 65535], got 70000"),
        (["--controller", "pdd"], {}, "unknown controller 'pdd'"),
    ],
)
def test_the_command_line_refuses_in_one_sentence(argv, environment, sentence, monkeypatch, capsys):
    monkeypatch.delenv("ARMCTL_TOKEN", raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert main(["view", BUNDLED, *argv]) == 2
    error = capsys.readouterr().err
    assert sentence in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("where", ["file", "environment"])
def test_the_token_comes_from_a_file_or_the_environment(where: str, monkeypatch, tmp_path: Path):
    given = {}
    monkeypatch.delenv("ARMCTL_TOKEN", raising=False)
    monkeypatch.setattr("armctl.view.view", lambda load, controller, **options: given.update(options))
    argv = ["view", BUNDLED, "--host", "127.0.0.1"]
    if where == "file":
        path = tmp_path / "token"
        path.write_text("from a file\n")
        argv += ["--token-file", str(path)]
    else:
        monkeypatch.setenv("ARMCTL_TOKEN", "from a file")
    assert main(argv) == 0
    assert given["token"] == "from a file"


# Limits


def test_one_client_too_many_is_refused_and_the_others_stay(page):
    clients = [Client(page) for _ in range(MAX_CLIENTS)]
    try:
        for _ in range(3):
            with pytest.raises(websockets.exceptions.InvalidStatus, match="503"):
                Client(page)
    finally:
        for client in clients:
            client.close()
    with connected(page) as client:
        follows(page, client)


@pytest.mark.full
def test_many_connections_cost_little_memory(page):
    before = _memory_mb()
    for _ in range(20):
        clients = [Client(page) for _ in range(MAX_CLIENTS)]
        for client in clients:
            client.close()
    assert _memory_mb() - before < 200
    with connected(page) as client:
        follows(page, client)


def test_a_large_message_closes_the_connection_of_its_sender_alone(page):
    with connected(page) as other:
        client = Client(page)
        client.send(b"\0" * (MAX_MESSAGE_BYTES + 1))
        until(lambda: client.connection.close_code == 1009, "the connection stays open")
        follows(page, other)


def test_uploads_are_dropped(page):
    uuid = control_id(page, "payload, kg")
    before = _memory_mb()
    start = {
        "source_component_uuid": uuid,
        "transfer_uuid": "t",
        "filename": "f",
        "mime_type": "m",
        "part_count": 9,
        "size_bytes": 9,
    }
    with connected(page) as client:
        client.send({"type": "FileTransferStartUpload", **start})
        for part in range(2000):
            message = {"source_component_uuid": uuid, "transfer_uuid": "t", "part": part, "content": b"\0" * 60_000}
            client.send({"type": "FileTransferPart", **message})
        follows(page, client)
        assert page.scene.server.gui._current_file_upload_states == {}
    assert _memory_mb() - before < 60


@pytest.mark.full
def test_a_flood_of_payloads_costs_one_thread(page):
    import threading

    with connected(page) as client:
        follows(page, client)
        threads = threading.active_count()
        memory = _memory_mb()
        for k in range(3000):
            client.set(page, "payload, kg", 0.001 * k)
        until(lambda: page.session.status.payload == pytest.approx(2.999), "the last payload is not taken")
        assert threading.active_count() <= threads
        assert _memory_mb() - memory < 60
        follows(page, client)


def test_a_silent_connection_is_closed_and_costs_nobody_the_page(page):
    silent = [socket.create_connection(("127.0.0.1", page.port)) for _ in range(100)]
    try:
        for connection in silent:
            connection.sendall(b"GET / HT")
        assert get(page).status == 200
    finally:
        for connection in silent:
            connection.close()


def test_garbage_gets_no_answer_and_no_word_in_the_log(page, capfd: pytest.CaptureFixture[str]):
    for garbage in (b"\x16\x03\x01 nonsense \r\n\r\n", b"POST / HTTP/1.1\r\n\r\n", b"GET\r\n\r\n", b"\0" * 10_000, b""):
        with socket.create_connection(("127.0.0.1", page.port), timeout=20) as connection:
            connection.sendall(garbage)
            connection.shutdown(socket.SHUT_WR)
            while connection.recv(4096):
                pass
    with connected(page) as client:
        for malformed in (
            b"",
            b"\xc1",
            b"\x81\xa4type",
            b"\x81\xa4type\xa1x",
            CAMERA | {"fov": "wide"},
            CAMERA | {"position": [1]},
        ):
            client.send(malformed)
        client.connection.send("text")
        follows(page, client)
    assert capfd.readouterr() == ("", "")


def _memory_mb() -> float:
    """Memory that this process holds now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def test_the_page_closes_at_once_whatever_its_clients_do(monkeypatch: pytest.MonkeyPatch):
    """Neither a client that does not answer nor one that never sends its request delays the end."""
    monkeypatch.setattr(page_server, "_OPEN_TIMEOUT_S", 1e6)
    monkeypatch.setattr(page_server, "_CLOSE_TIMEOUT_S", 1e6)
    with open_page() as page:
        address = f"127.0.0.1:{page.port}"
        silent = socket.create_connection(("127.0.0.1", page.port))
        silent.sendall(
            f"GET / HTTP/1.1\r\nHost: {address}\r\nOrigin: http://{address}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
            f"Sec-WebSocket-Protocol: viser-v{viser.__version__}\r\n\r\n".encode()
        )
        assert silent.recv(12) == b"HTTP/1.1 101"
        mute = socket.create_connection(("127.0.0.1", page.port))
        mute.sendall(b"GET / HT")
        assert get(page).status == 200
        server_thread = page.scene.server._websock_server._server_thread
        page.close()
        assert server_thread is not None
        server_thread.join(timeout=TIMEOUT_S)
        assert not server_thread.is_alive()
        for connection in (silent, mute):
            connection.close()


def test_the_oldest_request_is_cut_if_there_are_too_many(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(page_server, "_MAX_REQUESTS", 5)
    with open_page() as page:
        silent = [socket.create_connection(("127.0.0.1", page.port), timeout=TIMEOUT_S) for _ in range(6)]
        started = time.perf_counter()
        with contextlib.suppress(ConnectionResetError):
            assert silent[0].recv(1) == b""
        assert time.perf_counter() - started < page_server._OPEN_TIMEOUT_S / 2
        silent[-1].sendall(f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{page.port}\r\n\r\n".encode())
        assert silent[-1].recv(12) == b"HTTP/1.1 200"
        for connection in silent:
            connection.close()


@pytest.mark.full
def test_hundreds_of_idle_connections_lock_nobody_out(page):
    with connected(page) as client:
        idle = [socket.create_connection(("127.0.0.1", page.port), timeout=TIMEOUT_S) for _ in range(280)]
        try:
            started = time.perf_counter()
            assert get(page).status == 200
            with connected(page) as other:
                follows(page, other)
            follows(page, client)
            assert time.perf_counter() - started < TIMEOUT_S
        finally:
            for connection in idle:
                connection.close()
