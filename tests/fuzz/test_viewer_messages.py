"""Random and mutated messages of a client: afterwards the arm still follows its target."""

import copy
import time

import numpy as np
import pytest

pytest.importorskip("mjviser", reason="pip install -e '.[view]'")

import msgspec
import viser
from viewer_client import CAMERA, connected, follows, open_page, until

from armctl.view.realtime.status import Activity

MESSAGES_IN_SUITE = 10_000
GOAL = "/scene0/tip0/goal"
ODD_VALUES = [
    None, True, False, 0, -1, 1, 2**31, 2**63, -(2**63), 0.0, 5e-324, 1e300, -1e308, float("nan"), float("inf"), "", "x",
    GOAL, "__class__", b"\0", [], [0.0], [1, 2, 3], [1, 2, 3, 4], [float("nan")] * 3, {}, {"value": 1}, {"removed": True},
]  # fmt: skip
KEYS = ["type", "uuid", "updates", "value", "removed", "update_cb", "__dict__", "name", "owner", "wxyz", "position", "fov"]


def real_messages(page) -> list[dict]:
    """One message of each kind that a browser sends, and one of each kind that viser knows."""
    messages = [CAMERA]
    for kind in ("TransformControlsDragStartMessage", "TransformControlsDragEndMessage"):
        messages.append({"type": kind, "name": GOAL, "owner": ""})
    pose = {"name": GOAL, "wxyz": [1.0, 0.0, 0.0, 0.0], "position": [0.2, 0.1, 0.4], "owner": ""}
    messages.append({"type": "TransformControlsUpdateMessage", **pose})
    for uuid, control in page.scene.server.gui._gui_input_handle_from_uuid.items():
        if getattr(control, "label", "") != "compare the controllers":  # it would run for seconds, on every press
            messages.append({"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": control.value}})
    kinds = sorted(kind.__name__ for kind in viser._messages.Message.get_subclasses())
    return messages + [{"type": kind} for kind in kinds]


def mutated(rng: np.random.Generator, message: dict) -> dict:
    """The message with one or more random changes, at any depth."""
    message = copy.deepcopy(message)
    for _ in range(rng.integers(1, 4)):
        place = message
        while True:
            inner = [
                value for value in (place.values() if isinstance(place, dict) else place) if isinstance(value, dict | list)
            ]
            if not inner or rng.uniform() < 0.3:
                break
            place = inner[rng.integers(len(inner))]
        odd = copy.deepcopy(ODD_VALUES[rng.integers(len(ODD_VALUES))])
        if isinstance(place, list):
            if place and rng.uniform() < 0.7:
                place[rng.integers(len(place))] = odd
            else:
                place.append(odd)
        elif place and rng.uniform() < 0.7:
            place[sorted(place, key=str)[rng.integers(len(place))]] = odd
        else:
            place[KEYS[rng.integers(len(KEYS))]] = odd
    return message


def random_message(rng: np.random.Generator, messages: list[dict]) -> bytes:
    """A mutated message, one with damaged bytes, or random bytes."""
    real = messages[rng.integers(len(messages))]
    choice = rng.uniform()
    if choice < 0.7:
        return msgspec.msgpack.encode(mutated(rng, real))
    if choice < 0.8:
        return rng.bytes(rng.integers(0, 200))
    data = bytearray(msgspec.msgpack.encode(real))
    for _ in range(rng.integers(1, 4)):
        data[rng.integers(len(data))] = rng.integers(256)
    return bytes(data[: rng.integers(len(data) + 1)] if choice < 0.85 else data)


def test_after_random_messages_the_arm_still_follows_its_target(fuzz_seed: int, fuzz_seconds: float, capfd):
    rng = np.random.default_rng(fuzz_seed)
    with open_page() as page, connected(page) as client:
        until(lambda: page.session.status.elapsed > 0.0, "the session does not start")
        messages = real_messages(page)
        end = time.monotonic() + fuzz_seconds
        sent = 0
        while sent < MESSAGES_IN_SUITE or time.monotonic() < end:
            client.send(random_message(rng, messages))
            sent += 1
        follows(page, client)
        assert page.session.status.activity is Activity.AT_TARGET
    captured = capfd.readouterr()
    print(f"{sent} messages sent")
    assert captured.err == ""
