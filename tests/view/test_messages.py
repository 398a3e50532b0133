"""What a client may send: checked values reach the session, everything else is dropped, and nothing ends the viewer."""

import io
import re
from itertools import product

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("mjviser", reason="pip install -e '.[view]'")

import msgspec
import viser
from viewer_client import CAMERA, connected, control_id, follows, open_page, until

from armctl import Pose
from armctl.view import picture_panel
from armctl.view.message_filter import MAX_COORDINATE_M, MessageFilter, limited_value
from armctl.view.realtime.status import Activity

NUMBERS = [
    0.0,
    5e-324,
    -1.0,
    1e300,
    1e308,
    -1e308,
    float("nan"),
    float("inf"),
    -float("inf"),
    2**63,
    True,
    None,
    "1",
    [],
    [1.0],
    {},
]
VECTORS = [
    [1, 2],
    [1, 2, 3, 4],
    [],
    [float("nan"), 0, 0],
    [1e308, 0, 0],
    [None, 0, 0],
    ["a", 0, 0],
    [[0], [0], [0]],
    "abc",
    3,
    {},
]
LABELS = [
    "simulation speed",
    "payload, kg",
    "shoulder_yaw",
    "elbow",
    "position, m",
    "roll, pitch, yaw, rad",
    "controller",
    "time",
]
ATTRIBUTES = [
    {"removed": True},
    {"update_cb": "boom"},
    {"__dict__": {}},
    {"__class__": "x"},
    {"min": 5.0},
    {"uuid": "x"},
    {"props": None},
    {"value": 1.0, "removed": True},
    {"is_button": True},
    {"sync_cb": None},
    {"gui_api": None},
    {"disabled": True},
    {},
]


@pytest.fixture(scope="module")
def page():
    with open_page() as page:
        yield page


@pytest.fixture(scope="module")
def client(page):
    with connected(page) as client:
        until(lambda: page.session.status.elapsed > 0.0, "the session does not start")
        yield client


def settled(page, client) -> None:
    """Waits until everything that was sent before has been handled: messages of a client are handled in order."""
    x = 0.2 + 0.01 * float(np.random.default_rng().uniform())
    client.set(page, "position, m", [x, 0.0, 0.4])
    until(lambda: page.session.status.target.position[0] == x, "a message is not handled")


def test_no_value_of_a_control_ends_the_session(page, client):
    for label in LABELS:
        for value in [*NUMBERS, *VECTORS]:
            client.set(page, label, value)
        settled(page, client)
        status = page.session.status
        assert status.activity not in (Activity.FAILED, Activity.DIVERGED), label
        assert 0.05 <= status.speed <= 2.0, label
        assert 0.0 <= status.payload <= 5.0, label
    follows(page, client)


@pytest.mark.full
def test_a_client_changes_no_property_of_a_control(page, client):
    controls = page.scene.server.gui._gui_input_handle_from_uuid
    before = {uuid: (control.label, control.visible, control.disabled) for uuid, control in controls.items()}
    for attributes, label in product(ATTRIBUTES, LABELS):
        uuid = control_id(page, label)
        state = controls[uuid]._impl
        callbacks = state.update_cb
        client.send({"type": "GuiUpdateMessage", "uuid": uuid, "updates": attributes})
        settled(page, client)
        assert controls[uuid]._impl is state, attributes
        assert not state.removed, attributes
        assert state.update_cb is callbacks, attributes
    assert {uuid: (control.label, control.visible, control.disabled) for uuid, control in controls.items()} == before
    follows(page, client)


@pytest.mark.parametrize(
    "pose",
    [
        {"position": [float("nan"), 0, 0]},
        {"position": [1, 2]},
        {"position": None},
        {"wxyz": [0, 0, 0, 0]},
        {"wxyz": [float("inf"), 0, 0, 0]},
        {"wxyz": [1, 0, 0]},
        {"wxyz": [1e-300, 0, 0, 0]},
        {"name": "/other"},
        {"name": "x" * 100},
        {"owner": "me"},
    ],
    ids=str,
)
def test_a_wrong_pose_of_the_target_is_dropped(page, client, pose: dict):
    settled(page, client)
    target = page.session.status.target
    message = {"name": "/scene0/tip0/goal", "wxyz": [1, 0, 0, 0], "position": [0.9, 0.9, 0.9], "owner": ""}
    client.send({"type": "TransformControlsUpdateMessage"} | message | pose)
    client.send(CAMERA)
    client.set(page, "simulation speed", 0.75)
    until(lambda: page.session.status.speed == 0.75, "the message after it is not handled")
    assert page.session.status.target is target
    client.set(page, "simulation speed", 1.0)


def test_a_far_target_is_limited_and_the_arm_says_that_it_is_out_of_reach(page, client):
    message = {"name": "/scene0/tip0/goal", "wxyz": [1, 0, 0, 0], "position": [1e300, 0, 0], "owner": ""}
    client.send({"type": "TransformControlsUpdateMessage"} | message)
    until(lambda: page.session.status.target.position[0] == MAX_COORDINATE_M, "it is not limited")
    until(lambda: page.session.status.activity is Activity.OUT_OF_REACH, "it is not called out of reach")
    until(lambda: 'click "undo" under "Target"' in page.scene.text.content, "no remedy is named")
    follows(page, client)
    until(lambda: "undo" not in page.scene.text.content, "the remedy stays")


def test_an_orientation_out_of_reach_comes_with_a_remedy(page, client):
    client.set(page, "orientation counts", True)
    client.set(page, "position, m", [0.3, 0.0, 0.4])
    client.set(page, "roll, pitch, yaw, rad", [0.0, 0.0, 1.5])
    until(lambda: "this orientation is out of reach here" in page.scene.text.content, "the orientation is not refused")
    assert 'switch off "orientation counts" under "Target".*' in page.scene.text.content
    follows(page, client)
    until(lambda: "orientation" not in page.scene.text.content, "the remedy stays")


def test_jog_buttons_move_the_target_along_tool_or_world_axes_and_undo_takes_it_back(page, client):
    start = page.session.status.target
    client.set(page, "step, mm", 30.0)
    client.set(page, "axes", "tool")
    client.set(page, "move", "+z")
    along_tool = start.position + start.rotation @ [0.0, 0.0, 0.03]
    until(lambda: np.allclose(page.session.status.target.position, along_tool), "no step along the tool's axis")
    client.set(page, "axes", "world")
    client.set(page, "move", "-x")
    until(
        lambda: np.allclose(page.session.status.target.position, along_tool - [0.03, 0.0, 0.0]),
        "no step along the world's axis",
    )
    before = page.session.status.target
    client.set(page, "step, rad", 0.2)
    client.set(page, "turn", "+z")
    turned = Pose(np.zeros(3), rpy=[0.0, 0.0, 0.2]).rotation @ before.rotation
    until(lambda: np.allclose(page.session.status.target.rotation, turned), "no turn about the world's axis")
    client.set(page, "move", "up")  # no such button
    for _ in range(3):
        previous = page.session.status.target
        client.set(page, "last move", "undo")
        until(lambda previous=previous: page.session.status.target is not previous, "nothing is undone")
    assert np.allclose(page.session.status.target.matrix, start.matrix)
    client.set(page, "axes", "tool")


@pytest.mark.full
def test_jog_buttons_move_single_joints_one_step_after_another(page, client):
    follows(page, client)
    before = page.session.status.q
    client.set(page, "joint", "elbow")
    client.set(page, "joint step", 0.05)
    for _ in range(3):
        client.set(page, "jog", "-")
    client.set(page, "jog", "+")
    wanted = before - np.array([0.0, 0.0, 0.1])
    until(lambda: np.allclose(page.session.status.q, wanted, atol=1e-3), "the joint is elsewhere")
    client.set(page, "joint", "no joint")
    follows(page, client)


def test_avoidance_and_arm_speed_reach_the_session(page, client):
    client.set(page, "avoid contacts", False)
    client.set(page, "arm speed, %", -50.0)
    until(lambda: not page.session.status.avoiding, "contacts are still avoided")
    until(lambda: page.session.status.speed_override == pytest.approx(0.05), "the speed is not the least")
    client.set(page, "avoid contacts", True)
    client.set(page, "arm speed, %", 100.0)
    until(lambda: page.session.status.avoiding and page.session.status.speed_override == 1.0, "they are not as before")


def test_a_screenshot_and_a_film_are_offered_for_download(page, client, monkeypatch: pytest.MonkeyPatch):
    files = {}

    def keep(receiver, name: str, content: bytes, **how: bool) -> None:
        files[name] = content

    monkeypatch.setattr(picture_panel, "_SCREENSHOT_PX", (64, 48))
    monkeypatch.setattr(picture_panel, "_FILM_PX", (64, 48))
    monkeypatch.setattr(
        viser.ClientHandle, "send_file_download", lambda self, name, content, **how: files.update({name: content})
    )
    client.set(page, "screenshot", True)
    until(lambda: "robot_arm_3dof.png" in files, "there is no screenshot")
    image = np.asarray(Image.open(io.BytesIO(files["robot_arm_3dof.png"])))
    assert image.shape == (48, 64, 3)
    assert image.std() > 5.0
    pictures = page.panel.pictures
    client.set(page, "record a film", True)
    until(lambda: pictures._film is not None and len(pictures._film) > 5, "nothing is recorded")
    client.set(page, "stop and download", True)
    until(lambda: "robot_arm_3dof.mp4" in files, "there is no film")
    assert files["robot_arm_3dof.mp4"][4:8] == b"ftyp"
    assert pictures._film is None


def test_the_points_that_the_arm_reaches_are_shown_and_hidden(page, client):
    (panel,) = page.panel._reachability
    client.set(page, "reachable points", True)
    until(lambda: panel._points is not None and panel._points.visible, "the points are not shown")
    until(lambda: re.fullmatch(r"\d+ of \d+ points reached, .* m\^3\.", panel._text.content), "no number of points")
    shown = np.linalg.norm(panel._points.points - page.session.arm.fk(page.session.arm.home).position, axis=1)
    assert shown.min() < 0.2  # the tip is among them
    client.set(page, "reachable points", False)
    until(lambda: not panel._points.visible, "the points are not hidden")


def test_a_target_whose_holder_leaves_is_released(page, client):
    with connected(page) as holder:
        drag = {"type": "TransformControlsDragStartMessage", "name": "/scene0/tip0/goal", "owner": ""}
        until(lambda: len(page.scene.server.get_clients()) == 2, "the second client is not connected")
        holder.send(drag)
        until(lambda: page.is_target_held, "the target is not held")
    until(lambda: not page.is_target_held, "the target is still held")
    until(lambda: not page.session._follower.task.held, "the session still waits for its release")
    follows(page, client)


def test_two_clients_that_drag_at_once_leave_a_target_that_one_of_them_set(page, client):
    """Every pose of the session's target is one of those that a client sent, and the arm follows afterwards."""
    session = page.session
    settled(page, client)
    home = session.arm.fk(session.arm.home).position
    start = session.status.target.position
    sent = home + np.array([[0.0, 0.02 * (k % 5), 0.05] if k % 2 else [0.0, -0.02 * (k % 5), -0.05] for k in range(40)])
    seen = []
    with connected(page) as other:
        until(lambda: len(page.scene.server.get_clients()) == 2, "the second client is not connected")
        for each in (client, other):
            each.send({"type": "TransformControlsDragStartMessage", "name": "/scene0/tip0/goal", "owner": ""})
        for k, position in enumerate(sent):
            message = {"type": "TransformControlsUpdateMessage", "name": "/scene0/tip0/goal", "owner": ""}
            message |= {"wxyz": [1.0, 0.0, 0.0, 0.0], "position": position.tolist()}
            (client, other)[k % 2].send(message)
            seen.append(session.status.target.position)
        for each in (client, other):
            each.send({"type": "TransformControlsDragEndMessage", "name": "/scene0/tip0/goal", "owner": ""})
        until(lambda: not page.is_target_held, "the target is still held")
    allowed = np.array([start, *sent])
    assert all(np.abs(allowed - position).max(axis=1).min() < 1e-6 for position in seen)
    follows(page, client)


def test_a_disabled_button_cannot_be_pressed(page, client, monkeypatch: pytest.MonkeyPatch):
    button = page.panel._comparison._button
    ordered = []
    monkeypatch.setattr(page.panel._comparison._worker, "submit", ordered.append)
    button.disabled = True
    client.set(page, "compare the controllers", True)
    settled(page, client)
    assert ordered == []
    button.disabled = False
    client.set(page, "compare the controllers", True)
    settled(page, client)
    assert len(ordered) == 1
    button.disabled = False


def test_a_failure_while_drawing_or_writing_does_not_end_the_page(page, client, monkeypatch: pytest.MonkeyPatch, caplog):
    calls = []

    def broken(*args, **options) -> None:
        calls.append(args)
        raise RuntimeError("a defect")

    with monkeypatch.context() as patch:
        patch.setattr(page.panel, "update", broken)
        until(lambda: len(calls) > 2, "the page has ended")
    assert "could not show" in caplog.text
    follows(page, client)


def test_a_failed_session_is_shown_and_reset_repairs_it(page, client, monkeypatch: pytest.MonkeyPatch, caplog):
    def broken(*args) -> None:
        raise ZeroDivisionError("a defect")

    with monkeypatch.context() as patch:
        patch.setattr(page.session._follower, "advance", broken)
        until(lambda: page.session.status.activity is Activity.FAILED, "the failure is not noticed")
        until(lambda: "ZeroDivisionError: a defect" in page.scene.text.content, "the page does not show the failure")
        assert "at the target" not in page._controls._label.text
    assert page.session._thread is not None
    assert page.session._thread.is_alive()
    client.set(page, "time", "reset")
    follows(page, client)


def test_a_number_outside_a_sliders_range_becomes_its_bound(page):
    slider = page.scene.server.gui._gui_input_handle_from_uuid[control_id(page, "simulation speed")]
    assert [limited_value(slider, value) for value in (-1, 0.5, 1e300)] == [0.05, 0.5, 2.0]
    assert limited_value(slider, float("nan")) is None
    assert limited_value(slider, True) is None
    assert limited_value(None, 1.0) is None


@pytest.mark.parametrize(
    "wrong",
    [
        {"position": [1e200, 0.0, 0.0]},
        {"look_at": [0.0, float("nan"), 0.0]},
        {"up_direction": [0.0, 0.0, -1e7]},
        {"far": float("inf")},
        {"fov": 0.0},
        {"fov": 3.2},
        {"wxyz": [0.0, 0.0, 0.0, 0.0]},
    ],
    ids=str,
)
def test_a_camera_from_which_nothing_can_be_drawn_is_dropped(wrong: dict):
    messages = MessageFilter()
    assert messages.checked(msgspec.msgpack.encode(CAMERA)) is not None
    assert messages.checked(msgspec.msgpack.encode(CAMERA | wrong)) is None


def test_a_message_is_encoded_again_from_what_was_checked(page):
    messages = MessageFilter()
    messages.inputs = page.scene.server.gui._gui_input_handle_from_uuid
    update = {
        "type": "GuiUpdateMessage",
        "uuid": control_id(page, "simulation speed"),
        "updates": {"value": 9.0, "removed": True},
        "x": 1,
    }
    checked = messages.checked(msgspec.msgpack.encode(update))
    assert checked is not None
    assert msgspec.msgpack.decode(checked) == {
        "type": "GuiUpdateMessage",
        "uuid": control_id(page, "simulation speed"),
        "updates": {"value": 2.0},
    }
