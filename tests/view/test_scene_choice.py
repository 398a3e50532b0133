"""A page with several scenes: a list loads the arm in another one, and what cannot be loaded changes nothing."""

import functools
import threading
from pathlib import Path

import numpy as np
import pytest
from arms import BUNDLED

pytest.importorskip("mjviser", reason="pip install -e '.[view]'")

from viewer_client import connected, control_id, follows, open_page, until

from armctl import InputError
from armctl.cli.main import command_parser
from armctl.cli.view import loaded_arm, run, scenes_by_name

BOX = '<mujoco><worldbody><geom name="box" type="box" size=".05 .05 .05" pos="0 0.6 0.1"/></worldbody></mujoco>'
BALL = '<mujoco><worldbody><body name="ball" pos="0 -0.6 0.05"><freejoint/><geom size="0.05"/></body></worldbody></mujoco>'


@pytest.fixture
def paths(tmp_path: Path) -> list[str]:
    for name, text in (("box.xml", BOX), ("ball.xml", BALL)):
        (tmp_path / name).write_text(text)
    return [str(tmp_path / name) for name in ("box.xml", "ball.xml", "missing.xml")]


def test_scenes_are_offered_by_the_names_of_their_files_unless_two_are_the_same():
    assert scenes_by_name([]) == {"none": None}
    assert scenes_by_name(["a/cell.xml", "b/shelf.xml"]) == {"cell.xml": "a/cell.xml", "shelf.xml": "b/shelf.xml", "none": None}
    assert list(scenes_by_name(["a/cell.xml", "b/cell.xml"])) == ["a/cell.xml", "b/cell.xml", "none"]


def test_the_native_window_shows_one_scene():
    with pytest.raises(InputError, match="shows one, got 2"):
        run(command_parser().parse_args(["view", BUNDLED, "--native", "--scene", "a.xml", "--scene", "b.xml"]))


def test_a_chosen_scene_replaces_everything_and_a_failure_leaves_the_present_one(paths: list[str]):
    args = command_parser().parse_args(["view", BUNDLED, *(word for path in paths for word in ("--scene", path))])
    scenes = {name: functools.partial(loaded_arm, args, path) for name, path in scenes_by_name(args.scene).items()}
    allowed = threading.Event()
    load_alone = scenes["none"]
    scenes["none"] = lambda: allowed.wait() and load_alone()
    with open_page(scenes["box.xml"](), scenes) as page, connected(page) as client:
        server = page.scene.server
        first = page.session
        until(lambda: first.status.elapsed > 0.0, "the arm does not move")

        def choose(name: str) -> None:
            client.set(page, "scene", name)

        def present() -> str:
            return server.gui._gui_input_handle_from_uuid[control_id(page, "scene")].value

        def payload_sliders() -> int:
            controls = list(server.gui._gui_input_handle_from_uuid.values())
            return sum(getattr(control, "label", "") == "payload, kg" for control in controls)

        choose("ball.xml")
        until(lambda: page.session is not first and page.session.status.elapsed > 0.0, "the scene is not loaded")
        second = page.session
        assert second.arm.model.body("ball").id > 0
        assert page.scene._drawing.model.nq == second.arm.model.nq == len(second.status.qpos)
        until(lambda: not first._thread.is_alive(), "the first session does not end")
        until(lambda: "/scene0/tip0/goal" not in server.scene._handle_from_node_name, "the first target remains")
        assert "/scene1/tip0/goal" in server.scene._handle_from_node_name
        until(lambda: payload_sliders() == 1, "the first panel remains")

        choose("missing.xml")
        until(lambda: "missing.xml was not loaded: " in page.scene.text.content, "the failure is not shown")
        until(lambda: present() == "ball.xml", "the list does not show the present scene")
        choose("/etc/passwd")
        client.set(page, "position, m", [0.2, 0.1, 0.35])
        until(lambda: second.status.target.position[0] == 0.2, "the present arm takes no target")
        assert page.session is second

        choose("none")
        until(lambda: "loading the scene none" in page.scene.text.content, "the page does not say that it loads")
        assert page.session is second
        allowed.set()
        until(lambda: page.session is not second, "the scene is not removed")
        assert page.session.arm.model.nq == page.session.arm.n
        np.testing.assert_array_equal(page.session.arm.home, first.arm.home)
        until(lambda: "not loaded" not in page.scene.text.content, "the old failure is still shown")
        until(lambda: payload_sliders() == 1, "the second panel remains")
        follows(page, client)
