"""The session behind the page, stepped by hand: what it follows, what it says, what it does when told otherwise meanwhile."""

import socket
import time

import numpy as np
import pytest
from arms import BUNDLED, arm_of

from armctl import InputError, Pose, UnknownNameError
from armctl.cli.main import main
from armctl.sim.clock import RealTimeClock
from armctl.sim.history import SECONDS
from armctl.sim.online_reference import OnlineReference
from armctl.sim.realtime import INTERVAL, RealTimeSession
from armctl.viewer.auth_proxy import AuthProxy

SOME = ["robot_arm_3dof", "panda", "ur5e", "xarm7", "so_arm100", "endless", "gantry"]


def go(session: RealTimeSession, seconds: float) -> None:
    for _ in range(round(seconds / INTERVAL)):
        session.advance()


def tip_error(session: RealTimeSession) -> float:
    return float(np.linalg.norm(session.arm.fk(session.q).position - session.target.position))


@pytest.mark.parametrize("name", SOME)
def test_the_arm_goes_to_the_target_and_follows_it(name: str):
    session = RealTimeSession(arm_of(name))
    go(session, 4.0)
    assert session.status.startswith("at the target")
    away = session.arm.fk(session.arm.limits.clamp(session.q + 0.15))
    session.aim(away)
    go(session, 4.0)
    assert tip_error(session) < 1e-3, session.status
    assert session.target is away


@pytest.mark.parametrize("name", SOME)
def test_what_is_out_of_reach_is_said_and_the_arm_comes_to_rest(name: str):
    session = RealTimeSession(arm_of(name))
    far = session.target.position + np.array([50.0, 0.0, 0.0])
    session.aim(Pose(far, quat=session.target.quat))
    go(session, 20.0 if name == "gantry" else 8.0)
    assert session.status.startswith("out of reach by")
    millimetres = float(session.status.split()[4])
    assert millimetres == pytest.approx(1e3 * tip_error(session), rel=0.01, abs=2.0)
    before = session.q
    go(session, 0.5)
    assert np.abs(session.q - before).max() < 1e-3


def test_a_target_that_keeps_moving_is_followed():
    session = RealTimeSession(arm_of("panda"))
    go(session, 2.0)
    center, errors = session.target, []
    for k in range(400):
        angle = 2 * np.pi * k / 200
        session.aim(Pose(center.position + 0.05 * np.array([0.0, np.sin(angle), np.cos(angle) - 1.0]), quat=center.quat))
        session.advance()
        errors.append(tip_error(session))
    assert session.history.read().to_reference[-400:].max() < 1e-6  # computed torque on an exact model, all the way
    assert max(errors[100:]) < 0.03  # at 0.16 m/s, a lag of less than 0.2 s


def test_a_wild_target_never_breaks_the_limits_of_the_joints():
    arm, rng = arm_of("panda"), np.random.default_rng(0)
    guide, dt = OnlineReference(arm, arm.dt, arm.home, acceleration_scale=0.3), arm.dt
    rows = [guide.toward(rng.uniform(arm.limits.q_min, arm.limits.q_max), 5) for _ in range(400)]
    q = np.concatenate([row.q for row in rows])
    assert arm.limits.contains(q, 1e-9)
    v = np.diff(q, axis=0) / dt
    a = np.diff(v, axis=0) / dt
    j = np.diff(a, axis=0) / dt
    for rate, bound in ((v, arm.limits.v_max), (a, arm.limits.a_max), (j, arm.limits.j_max)):
        assert (np.abs(rate) / bound).max() < 1 + 1e-4
    # The differences that the discrete controller uses are those of the reference itself, across all changes of the goal.
    v_tick, a_tick = (np.concatenate([getattr(row, name) for row in rows]) for name in ("v_tick", "a_tick"))
    np.testing.assert_allclose(v_tick[1:], v, atol=1e-9)
    np.testing.assert_allclose(a_tick[1:-1], a, atol=1e-6)


def test_switching_the_controller_and_the_payload_shows_in_the_error():
    session = RealTimeSession(arm_of("panda"))
    go(session, 2.0)
    exact = session.history.read().to_reference[-1]
    session.carry(2.0)
    go(session, 2.0)
    burdened = session.history.read().to_reference[-1]
    session.control_by("pd")
    go(session, 4.0)
    sagging = session.history.read().to_reference[-1]
    assert exact < 1e-6 < 5e-3 < burdened < sagging
    assert "pd does not hold it there under 2 kg" in session.status
    session.carry(0.0)
    session.control_by("computed-torque")
    go(session, 3.0)
    assert session.history.read().to_reference[-1] < 1e-6


def test_the_joints_can_be_steered_and_the_target_follows():
    session = RealTimeSession(arm_of("panda"))
    goal = session.arm.home + 0.2
    session.steer(goal)
    go(session, 2.0)
    np.testing.assert_allclose(session.q, goal, atol=1e-6)
    assert session.steered
    assert session.target.distance(session.arm.fk(goal))[0] < 1e-9


def test_the_gripper_moves_while_the_arm_holds_its_place():
    session = RealTimeSession(arm_of("panda"))
    go(session, 2.0)
    assert session.gripper is not None
    assert RealTimeSession(arm_of(BUNDLED)).gripper is None
    for width in (0.02, 0.06):
        session.grip(width)
        go(session, 0.1)
        assert session.gripper.width == pytest.approx(width, abs=2e-3)
        assert tip_error(session) < 1e-3
    session.carry(0.5)
    go(session, 0.1)
    assert session.gripper.width == pytest.approx(0.06, abs=2e-3)
    session.reset()
    go(session, 2.0)
    assert session.status.startswith("at the target") or "0.5 kg" in session.status


def test_pause_holds_time_and_reset_starts_afresh():
    session = RealTimeSession(arm_of(BUNDLED))
    go(session, 0.1)
    session.pause(True)
    before = session.q
    go(session, 0.5)
    assert session.status == "paused"
    np.testing.assert_array_equal(session.q, before)
    session.pause(False)
    first = RealTimeSession(arm_of(BUNDLED)).target
    session.aim(Pose([0.2, -0.2, 0.4]))
    go(session, 1.0)
    session.reset()
    session.advance()
    assert session.target == first
    np.testing.assert_allclose(session.q, session.arm.home, atol=0.01)


def test_an_arm_that_runs_away_says_so_and_reset_brings_it_back():
    session = RealTimeSession(arm_of(BUNDLED))
    session._law = type("Wild", (), {"torque": lambda self, state, setpoint: np.full(3, np.nan)})()
    go(session, 0.1)
    assert "no finite torque" in session.status
    assert session.status.endswith("reset")
    session.control_by("computed-torque")
    session.reset()
    go(session, 3.0)
    assert session.status.startswith("at the target")


def test_orientation_counts_only_where_it_is_said_to():
    session = RealTimeSession(arm_of("panda"))
    assert session.oriented
    assert not RealTimeSession(arm_of(BUNDLED)).oriented
    upside_down = Pose(session.target.position, rpy=[0.0, 0.0, 0.0])
    session.aim(upside_down)
    session.orient(False)
    go(session, 4.0)
    assert session.status.startswith("at the target")


def test_the_history_is_the_last_ten_seconds():
    session = RealTimeSession(arm_of(BUNDLED))
    go(session, SECONDS + 1.0)
    past = session.history.read()
    assert np.isfinite(past.to_target).all()
    np.testing.assert_allclose(np.diff(past.t), INTERVAL)
    assert past.torque_share.shape == (len(past.t), 3)


@pytest.mark.parametrize(
    ("call", "error"), [(lambda s: s.control_by("pdd"), UnknownNameError), (lambda s: s.carry(-1.0), InputError)]
)
def test_a_wrong_order_is_refused_at_once(call, error):
    session = RealTimeSession(arm_of(BUNDLED))
    with pytest.raises(error):
        call(session)


def test_pace_keeps_abreast_of_the_clock_and_catches_up():
    pace, started = RealTimeClock(), time.perf_counter()
    time.sleep(0.03)
    for _ in range(20):
        pace.wait(0.01)
    assert time.perf_counter() - started >= 0.2
    assert 0.0 < pace.real_time_factor <= 1.05


# The gate: what has no token gets nothing.


@pytest.fixture
def gate():
    """A gate before a page that says only 'inside'."""
    inner = socket.create_server(("127.0.0.1", 0))
    gate = AuthProxy("127.0.0.1", "open sesame", inner.getsockname()[1], 0)
    yield gate, inner
    gate.close()
    inner.close()


def request(gate: AuthProxy, text: bytes) -> bytes:
    port = int(gate.url.split(":")[2].split("/")[0])
    with socket.create_connection(("127.0.0.1", port), timeout=5) as connection:
        connection.sendall(text)
        connection.shutdown(socket.SHUT_WR)
        answer = b""
        while chunk := connection.recv(4096):
            answer += chunk
    return answer


@pytest.mark.parametrize(
    "text",
    [
        b"GET / HTTP/1.1\r\nHost: x\r\n\r\n",
        b"GET /?token=open HTTP/1.1\r\nHost: x\r\n\r\n",
        b"GET /?token= HTTP/1.1\r\nHost: x\r\n\r\n",
        b"GET / HTTP/1.1\r\nCookie: armctl=wrong\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\r\n",
        b"GET / HTTP/1.1\r\nCookie: =;;\xff=\r\n\r\n",
        b"\x16\x03\x01 nonsense \r\n\r\n",
        b"",
    ],
)
def test_without_the_token_nothing_gets_through(gate, text: bytes):
    gate, inner = gate
    answer = request(gate, text)
    assert answer == b"" or answer.startswith(b"HTTP/1.1 403 ")
    inner.settimeout(0.1)
    with pytest.raises(TimeoutError):
        inner.accept()


def test_the_token_gets_a_cookie_and_the_cookie_gets_through(gate):
    gate, inner = gate
    answer = request(gate, b"GET /?token=open%20sesame HTTP/1.1\r\nHost: x\r\n\r\n")
    assert answer.startswith(b"HTTP/1.1 303 ")
    cookie = answer.split(b"Set-Cookie: ")[1].split(b";")[0]
    assert b"HttpOnly; SameSite=Strict" in answer
    port = int(gate.url.split(":")[2].split("/")[0])
    with socket.create_connection(("127.0.0.1", port), timeout=5) as visitor:
        visitor.sendall(b"GET / HTTP/1.1\r\nCookie: " + cookie + b"\r\n\r\n")
        page, _ = inner.accept()
        assert page.recv(4096).startswith(b"GET / HTTP/1.1")
        page.sendall(b"inside")
        page.close()
        assert visitor.recv(4096) == b"inside"


def test_a_short_token_and_a_taken_port_are_refused(gate):
    with pytest.raises(InputError, match="token: 5 characters given, at least 8 wanted"):
        AuthProxy("127.0.0.1", "short", 1, 0)
    with pytest.raises(InputError, match="nobody can listen at"):
        AuthProxy("127.0.0.1", "long enough", 1, gate[1].getsockname()[1])


@pytest.mark.parametrize(
    ("argv", "sentence"),
    [
        (["--host", "0.0.0.0"], "whoever finds the page could drive the arm; choose a --token"),
        (["--token", "open sesame"], "without --host only this machine can reach the page"),
        (["--host", "0.0.0.0", "--token", "short"], "at least 8 wanted"),
        (["--port", "70000"], "port: 70000 given"),
        (["--controller", "pdd"], "unknown controller 'pdd'"),
    ],
)
def test_the_command_line_refuses_in_one_sentence(argv: list[str], sentence: str, capsys: pytest.CaptureFixture[str]):
    pytest.importorskip("mjviser", reason="pip install -e '.[view]'")
    assert main(["view", BUNDLED, *argv]) == 2
    assert sentence in capsys.readouterr().err


def test_native_without_a_screen_says_so_in_one_line(monkeypatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    assert main(["view", BUNDLED, "--native"]) == 2
    err = capsys.readouterr().err
    assert "no screen" in err
    assert err.count("\n") == 1
