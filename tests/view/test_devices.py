"""Keyboard, gamepad and SpaceMouse: the tip moves while a hand holds them, for one visitor at a time, and no longer."""

import time

import numpy as np
import pytest

pytest.importorskip("mjviser", reason="pip install -e '.[view]'")

import websockets.exceptions
from viewer_client import Client, connected, get, open_page, until

from armctl.view.devices import FULL_SPEED, LEASE_S, PATH, HandDevices

UP = "[0, 0, 1, 0, 0, 0]"
DOWN = "[0, 0, -1, 0, 0, 0]"
STOP = "[0, 0, 0, 0, 0, 0]"


@pytest.fixture(scope="module")
def page():
    with open_page() as page:
        yield page


def height(page) -> float:
    return float(page.session.arm.fk(page.session.status.q).position[2])


def hold(page, client: Client, message: str, condition) -> None:
    """Renews a velocity until a condition holds."""

    def renewed() -> bool:
        client.send(message)
        return condition()

    until(renewed, f"{message} has no effect")


@pytest.mark.parametrize(
    "message",
    [
        "",
        "x",
        "[]",
        "[0, 0, 1, 0, 0]",
        "[0, 0, 1, 0, 0, 0, 0]",
        "[NaN, 0, 0, 0, 0, 0]",
        "[1e999, 0, 0, 0, 0, 0]",
        "[null, 0, 0, 0, 0, 0]",
        '["1", 0, 0, 0, 0, 0]',
        "{}",
        "[" * 200,
        "[0, 0, 1, 0, 0, 0]" + " " * 300,
        b"\xff\xfe",
        b"\x00" * 100,
    ],
)
def test_wrong_messages_are_dropped(message):
    devices = HandDevices()
    devices.take(object(), message)
    assert devices.velocity is None


def test_a_velocity_is_limited_ends_without_renewal_and_belongs_to_one_visitor(monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    devices = HandDevices()
    first, second = object(), object()
    devices.take(first, "[0.5, -1e300, 0, 0, 0, 0]")
    assert devices.velocity.linear == pytest.approx([0.5 * FULL_SPEED, -FULL_SPEED, 0.0])
    devices.take(second, UP)
    devices.take(second, STOP)
    assert devices.velocity.linear[2] == 0.0
    clock[0] += LEASE_S + 0.01
    assert devices.velocity is None
    devices.take(second, UP)
    devices.take(first, DOWN)
    assert devices.velocity.linear[2] == pytest.approx(FULL_SPEED)
    devices.take(second, STOP)
    assert devices.velocity is None


def test_the_tip_moves_while_a_visitor_renews_and_stops_when_the_visitor_is_gone(page):
    with connected(page):
        until(lambda: page.session.status.elapsed > 0.0, "the arm does not start")
        client = Client(page, PATH)
        begin = height(page)
        hold(page, client, DOWN, lambda: height(page) < begin - 0.02)
        low = height(page)
        hold(page, client, UP, lambda: height(page) > low + 0.01)
        client.close()
        until(lambda: page.scene.devices.velocity is None, "the velocity stays")
        until(lambda: page.session.status.position_error < 1e-5, "the arm does not come to rest")
        q = page.session.status.q
        elapsed = page.session.status.elapsed
        until(lambda: page.session.status.elapsed > elapsed + 0.5, "the session stands")
        assert np.abs(page.session.status.q - q).max() < 2e-3


def test_shadows_fall_where_every_browser_draws_with_a_graphics_card():
    with open_page() as page, connected(page):
        lamp = page.scene._lamps[0]
        assert not lamp.cast_shadow
        for said, shadows in (("true", True), ("false", False), ("true", False)):
            client = Client(page, PATH)
            client.send(said)
            client.send(UP)
            until(lambda: page.scene.devices.velocity is not None, "the messages are not taken")
            until(lambda: lamp.cast_shadow is shadows, f"shadows after {said}: {lamp.cast_shadow}")  # noqa: B023
            client.close()
            until(lambda: page.scene.devices.velocity is None, "the velocity stays")


def test_devices_need_the_origin_of_the_page_and_its_token(page):
    for origin in ("http://evil.example", None):
        with pytest.raises(websockets.exceptions.InvalidStatus):
            Client(page, PATH, origin=origin)
    with open_page(host="127.0.0.1", token="open sesame") as locked:
        with pytest.raises(websockets.exceptions.InvalidStatus):
            Client(locked, PATH)
        cookie = get(locked, "/?token=open%20sesame").headers["Set-Cookie"].split(";")[0]
        Client(locked, PATH, cookie=cookie).close()
