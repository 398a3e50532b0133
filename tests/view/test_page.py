"""The page in a real browser: the target is dragged with the mouse, numbers are typed, switches are turned."""

import contextlib
import json
import re
import shutil
import signal
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from arms import BUNDLED
from commands import armctl_command

CHROMIUM = shutil.which("chromium")
pytestmark = [
    pytest.mark.full,
    pytest.mark.skipif(CHROMIUM is None, reason="no browser: apt-get install -y chromium"),
]
pytest.importorskip("mjviser", reason="pip install -e '.[view]'")
sync_api = pytest.importorskip("playwright.sync_api", reason="pip install playwright")


import viser  # noqa: E402
from viewer_client import TIMEOUT_S, open_page, until  # noqa: E402

from armctl.control import CONTROLLERS  # noqa: E402
from armctl.view.page import Page  # noqa: E402
from armctl.view.realtime.session import Activity  # noqa: E402

SOFTWARE_GL = [
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
]
# A browser that draws with software does nothing else where nothing holds it back.
FEW_PICTURES = """
const draw = window.requestAnimationFrame.bind(window);
window.requestAnimationFrame = (callback) => setTimeout(() => draw(callback), 400);
window.cancelAnimationFrame = clearTimeout;
"""
PROTOCOL = f"viser-v{viser.__version__}"


@pytest.fixture(scope="module")
def browser() -> Iterator:
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE_GL)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    """The bundled arm on a page: its scene is light, so that software draws it fast."""
    with open_page() as page:
        yield page


@pytest.fixture(scope="module")
def tab(browser, page: Page):
    return opened(browser, page.url)


def new_tab(browser, width: int, height: int):
    tab = browser.new_context(viewport={"width": width, "height": height}).new_page()
    tab.set_default_timeout(1e3 * TIMEOUT_S)
    tab.add_init_script(FEW_PICTURES)
    return tab


def opened(browser, url: str):
    tab = new_tab(browser, 640, 420)
    tab.goto(url)
    tab.get_by_text("times real time").wait_for(timeout=1e3 * TIMEOUT_S)
    # viser's notice of software rendering lies over the scene and would take the clicks that are meant for the target
    tab.add_style_tag(content=".mantine-Notifications-root { display: none }")
    return tab


def tip_error(page: Page) -> float:
    status = page.session.status
    return float(np.linalg.norm(page.session.arm.fk(status.q).position - status.target.position))


def arrives(page: Page) -> None:
    until(lambda: tip_error(page) < 1e-3 and page.session.status.activity is Activity.AT_TARGET, "the arm does not arrive")


def on_screen(page: Page, tab, point: np.ndarray) -> np.ndarray:
    """Where a point of the world is in the tab, pixels."""
    box = tab.locator("canvas").first.bounding_box()
    (client, *_) = page.scene.server.get_clients().values()
    eye, look_at, fov = np.array(client.camera.position), np.array(client.camera.look_at), client.camera.fov
    forward = (look_at - eye) / np.linalg.norm(look_at - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up, way = np.cross(right, forward), point - eye
    scale = box["height"] / 2 / np.tan(fov / 2) / (way @ forward)
    return np.array([box["x"] + box["width"] / 2 + scale * (way @ right), box["y"] + box["height"] / 2 - scale * (way @ up)])


def draws(tab) -> None:
    """Waits for two pictures: what the mouse points at is found in one, and what it does is shown in the next."""
    tab.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")


def typed(tab, label: str, value: str, which: int = 0) -> None:
    """Types into a number field of the panel."""
    field = field_of(tab, label, which)
    field.fill(value)
    field.press("Enter")


def typed_x(page: Page, tab, x: float) -> None:
    """Types the x of the target until the page has it: a field that is typed into while it is drawn again forgets the text."""
    deadline = time.monotonic() + TIMEOUT_S
    while abs(page.session.status.target.position[0] - x) > 1e-6:
        assert time.monotonic() < deadline, "x is not taken over"
        typed(tab, "position, m", f"{x:g}", 0)
        time.sleep(2.0)


def field_of(tab, label: str, which: int = 0):
    return tab.get_by_text(label, exact=True).locator("xpath=ancestor::*[.//input][1]").locator("input:visible").nth(which)


def choose(tab, controller: str) -> None:
    """Chooses a controller from the list."""
    boxes = tab.get_by_role("combobox").all()
    next(box for box in boxes if box.input_value() in CONTROLLERS).click()
    tab.get_by_role("option", name=controller, exact=True).click()


FAKE_DEVICES = """
window.pad = { axes: [0, 0, 0, 0], buttons: Array.from({ length: 6 }, () => ({ pressed: false })) };
navigator.getGamepads = () => [null, window.pad];
window.mouse = Object.assign(new EventTarget(), { opened: true });
Object.defineProperty(navigator, "hid", { value: { getDevices: async () => [window.mouse] } });
window.report = (id, counts) => {
  const data = new DataView(new ArrayBuffer(2 * counts.length));
  counts.forEach((count, k) => data.setInt16(2 * k, count, true));
  window.mouse.dispatchEvent(Object.assign(new Event("inputreport"), { reportId: id, data }));
};
"""


def test_keys_a_gamepad_and_a_space_mouse_ask_for_a_velocity_while_they_are_held(browser, page: Page, monkeypatch):
    # a browser that draws with software on a busy machine is too slow to renew in time
    said: list[list[float] | bool | int] = []
    monkeypatch.setattr(page.scene.devices, "take", lambda _, message: said.append(json.loads(message)))
    tab = new_tab(browser, 320, 240)
    tab.add_init_script(FAKE_DEVICES)
    tab.goto(page.url)
    tab.get_by_text("real time").wait_for(timeout=1e3 * TIMEOUT_S)

    def says(velocity: list[float], act: Callable[[], object]) -> None:
        said.clear()
        act()
        until(lambda: tab.wait_for_timeout(20) or velocity in said, f"{velocity} is not asked for, but {said}")

    until(lambda: tab.wait_for_timeout(20) or False in said, "the page does not say that it draws with software")
    nothing = [0, 0, 0, 0, 0, 0]
    says([1, 0, 0, 0, 0, 0], lambda: tab.keyboard.down("i"))
    tab.keyboard.down("Shift")
    says(nothing, lambda: tab.keyboard.up("i"))
    says([0, 0, 0, 0, -1, 0], lambda: tab.keyboard.down("L"))
    says(nothing, lambda: tab.evaluate("dispatchEvent(new Event('blur'))"))
    said.clear()
    tab.evaluate("pad.axes = [0, 0, 0, -1]")
    tab.wait_for_timeout(300)
    assert not [message for message in said if isinstance(message, list)], "a gamepad moves the tip without its shoulder button"
    says([0, 0, 1, 0, 0, 0], lambda: tab.evaluate("pad.buttons[5].pressed = true"))
    says(nothing, lambda: tab.evaluate("pad.buttons[5].pressed = false"))
    says([0, 0.5, 0, 0, 0, 0], lambda: tab.evaluate("window.timer = setInterval(() => report(1, [-175, 0, 0]), 10)"))
    says(nothing, lambda: tab.evaluate("clearInterval(timer)"))
    says([0, 0.5, 0, 0, 0, -1], lambda: tab.evaluate("window.timer = setInterval(() => report(2, [0, 0, 700]), 10)"))
    tab.close()


def test_the_page_shows_the_arm_and_says_what_it_does(page: Page, tab):
    arrives(page)
    tab.get_by_text("at the target").first.wait_for(timeout=1e3 * TIMEOUT_S)
    for text in (
        "tip error, mm",
        "largest torque, %",
        "controller",
        "payload, kg",
        "simulation speed",
        "pause",
        "Target",
        "Comparison",
    ):
        assert tab.get_by_text(text).first.is_visible(), text
    assert tab.get_by_role("button", name="reset", exact=True).is_visible()
    assert page.session.status.real_time_factor > 0.0


def test_the_browser_says_that_the_arm_is_drawn_and_the_stick_figure_goes(page: Page, tab):
    drawing = page.scene._drawing
    until(lambda: tab.wait_for_timeout(20) or not drawing.sticks.visible, "the stick figure stays")
    assert page.scene.devices.meshes_drawn > 0


def test_dragging_the_target_with_the_mouse_brings_the_tip_there(page: Page, tab):
    arrives(page)
    before = page.session.status.target.position.copy()
    axis = np.array([0.0, 0.0, 1.0])
    handle, farther = (on_screen(page, tab, before + reach * axis) for reach in (0.11, 0.21))
    tab.mouse.move(*handle)
    draws(tab)
    tab.mouse.down()
    draws(tab)
    for share in np.linspace(0.2, 1.0, 5):
        tab.mouse.move(*(handle + share * (farther - handle)))
        draws(tab)
    tab.mouse.up()
    until(lambda: np.linalg.norm(page.session.status.target.position - before) > 0.03, "the target has not moved")
    until(lambda: not page.is_target_held, "the target is still held")
    moved = page.session.status.target.position - before
    assert np.linalg.norm(np.cross(moved, axis)) < 0.02 * np.linalg.norm(moved)  # along the arrow that was held
    arrives(page)


def test_a_typed_target_is_reached_and_an_impossible_one_refused_in_millimetres(page: Page, tab):
    typed_x(page, tab, 0.25)
    arrives(page)
    typed_x(page, tab, 3.0)
    tab.get_by_text("out of reach by").first.wait_for(timeout=1e3 * TIMEOUT_S)
    typed_x(page, tab, 0.25)
    arrives(page)


def test_switching_the_controller_and_the_payload_shows_in_the_error_plot(page: Page, tab):
    tab.get_by_role("button", name="reset", exact=True).click()
    arrives(page)

    def error() -> float:
        return page.panel.charts.shown_reference_error_mm

    until(lambda: error() <= 0.011, "computed torque is exact")
    typed(tab, "payload, kg", "2")
    until(lambda: page.session.status.payload == 2.0 and error() > 1.0, "the payload shows")
    typed(tab, "payload, kg", "0")
    until(lambda: page.session.status.payload == 0.0 and error() <= 0.011, "without payload it is exact again")
    choose(tab, "pd")
    until(lambda: page.session.status.controller == "pd" and error() > 0.1, "PD sags")
    typed(tab, "payload, kg", "2")
    tab.get_by_text("steady-state error").first.wait_for(timeout=1e3 * TIMEOUT_S)
    typed(tab, "payload, kg", "0")
    until(lambda: page.session.status.payload == 0.0, "the payload is taken off")
    choose(tab, "computed-torque")
    arrives(page)


def test_pause_and_reset_do_what_they_say(page: Page, tab):
    tab.get_by_role("button", name="pause", exact=True).click()
    until(lambda: page.session.status.paused, "pause is not taken over")
    tab.get_by_text("paused").first.wait_for(timeout=1e3 * TIMEOUT_S)
    tab.get_by_role("button", name="play", exact=True).click()
    page.session.move_joints(page.session.arm.home + 0.3)
    start = type(page.session)(page.session.arm).status.target
    tab.get_by_role("button", name="reset", exact=True).click()
    until(lambda: page.session.status.target == start, "reset is not taken over")
    arrives(page)


def test_a_second_tab_sees_the_same_and_closing_it_harms_nothing(browser, page: Page, tab):
    tab.get_by_role("button", name="reset", exact=True).click()
    arrives(page)
    second, x = opened(browser, page.url), round(float(page.session.status.target.position[0]) - 0.03, 3)
    typed(second, "position, m", str(x), 0)
    until(lambda: page.session.status.target.position[0] == x, "the second tab is not listened to")
    tab.bring_to_front()
    until(lambda: float(field_of(tab, "position, m").input_value()) == x, "the first tab shows another target")
    second.close()
    arrives(page)
    until(lambda: len(page.scene.server.get_clients()) == 1, "the closed tab is gone")


def test_the_comparison_runs_on_the_page(page: Page, tab):
    tab.get_by_text("Comparison").click()
    tab.get_by_role("button", name="compare the controllers").click()
    tab.get_by_text("tip RMS").wait_for(timeout=1e3 * TIMEOUT_S)
    until(lambda: not page.session.status.paused, "time goes on afterwards")
    rows = [[cell.inner_text() for cell in row.get_by_role("cell").all()] for row in tab.get_by_role("row").all()]
    rows = [row for row in rows if row and row[0] in CONTROLLERS]
    assert len(rows) == len(CONTROLLERS)
    assert len({row[1] for row in rows}) > len(rows) / 2, "with an encoder's noise, the controllers differ"
    assert not any(cell == "<1 nm" for row in rows for cell in row)


def test_the_verdict_stays_beside_the_inputs_and_nothing_is_cut(page: Page, tab):
    tab.set_viewport_size({"width": 800, "height": 600})
    field = field_of(tab, "roll, pitch, yaw, rad", 2)
    field.scroll_into_view_if_needed()
    verdict = tab.locator("strong").filter(has_text=re.compile("target|following|reach")).first
    until(lambda: 0 <= verdict.bounding_box()["y"] < 200, "the verdict leaves the window")
    assert field.bounding_box()["y"] > verdict.bounding_box()["y"] + verdict.bounding_box()["height"]
    scrollbar = tab.locator(".mantine-ScrollArea-thumb").first
    tab.mouse.move(700, 400)  # the bar is there while the mouse is
    scrollbar.wait_for(timeout=1e3 * TIMEOUT_S)
    right = field.bounding_box()["x"] + field.bounding_box()["width"]
    assert right <= scrollbar.bounding_box()["x"]
    tab.set_viewport_size({"width": 640, "height": 420})


KNOCK = """([url, protocol]) => new Promise(done => {
    const socket = new WebSocket(url, protocol);
    socket.onopen = () => { socket.close(); done("in"); };
    socket.onerror = () => done("out");
})"""


def test_from_other_machines_a_wrong_token_gets_nothing_and_the_right_one_everything(browser):
    with open_page(host="127.0.0.1", token="open sesame") as page:
        root = page.url.split("/?")[0]
        stranger = browser.new_context().new_page()
        response = stranger.goto(f"{root}/?token=wrong")
        assert response is not None
        assert response.status == 403
        assert stranger.evaluate(KNOCK, [root.replace("http", "ws"), PROTOCOL]) == "out"
        friend = opened(browser, page.url)
        assert "token" not in friend.url
        friend.close()


def test_a_foreign_page_in_the_same_browser_cannot_connect(browser, page: Page, tab):
    foreign = tab.context.new_page()
    for address in ("http://127.0.0.1:1/", "http://localhost:1/", "http://evil.example/"):
        foreign.route(address, lambda route: route.fulfill(body="<p>evil</p>", content_type="text/html"))
        foreign.goto(address)
        for name in ("127.0.0.1", "localhost"):
            assert foreign.evaluate(KNOCK, [f"ws://{name}:{page.port}", PROTOCOL]) == "out"
    foreign.close()
    assert tab.evaluate(KNOCK, [f"ws://127.0.0.1:{page.port}", PROTOCOL]) == "in"


@pytest.mark.parametrize("who", ["nobody", "somebody"])
def test_ctrl_c_ends_the_command_without_a_word(browser, who: str):
    command = armctl_command("view", BUNDLED, "--port", "0")
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as view:
        try:
            assert view.stdout is not None
            url = re.search(r"http://\S+:\d+", view.stdout.readline())
            assert url is not None
            if who == "somebody":
                tab = opened(browser, url[0])
                tab.get_by_text("at the target").first.wait_for(timeout=1e3 * TIMEOUT_S)
            else:
                until(lambda: serves(url[0]), "the page is not served")
            view.send_signal(signal.SIGINT)
            out, err = view.communicate(timeout=TIMEOUT_S)
        finally:
            view.kill()
    if who == "somebody":
        tab.close()
    assert (view.returncode, out, err) == (0, "", "")


def serves(url: str) -> bool:
    with contextlib.suppress(urllib.error.URLError):
        return urllib.request.urlopen(url).status == 200
    return False
