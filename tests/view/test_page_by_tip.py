"""A page of a robot with several tips: all are followed at once, and a list or a drag chooses whose fields show."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from synthetic import ON_A_TORSO, PAIR, mjcf, motors

pytest.importorskip("mjviser", reason="pip install -e '.[view]'")

from viewer_client import Client, connected, open_page, until

import armctl
from armctl import ModelError, Pose
from armctl.cli.main import command_parser
from armctl.cli.view import loaded_arm
from armctl.view.realtime.status import Activity


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("pair") / "pair.xml"
    path.write_text(mjcf(PAIR, motors("a b c d e f")))
    return path


def loaded(*words: str) -> armctl.Arm:
    return loaded_arm(command_parser().parse_args(["view", *words]))


def drag(client: Client, node: str, points: list[list[float]], *, released: bool = True) -> None:
    """Drags the handles of a node of the scene through points, m."""
    message = {"name": f"/scene0/{node}/goal", "owner": ""}
    client.send({"type": "TransformControlsDragStartMessage", **message})
    for point in points:
        place = {"wxyz": [1.0, 0.0, 0.0, 0.0], "position": point}
        client.send({"type": "TransformControlsUpdateMessage", **message, **place})
    if released:
        client.send({"type": "TransformControlsDragEndMessage", **message})


def test_view_loads_the_whole_robot_unless_a_tip_is_given(path: Path):
    assert loaded(str(path)).tips == ("C", "F")
    assert loaded(str(path), "--tip", "F").tips == ("F",)
    with pytest.raises(ModelError, match="no such file"):
        loaded(str(path.parent / "nothing.xml"))


def test_both_tips_follow_handles_that_are_dragged_at_once(path: Path):
    arm = loaded(str(path))
    goal = arm.fk(arm.home + 0.2, "C").position, arm.fk(arm.home + 0.2, "F").position
    half = [0.5 * (end + arm.fk(arm.home, tip).position) for tip, end in zip(arm.tips, goal, strict=True)]
    with open_page(arm) as page, connected(page) as client:
        until(lambda: page.session.status.elapsed > 0.0, "the session does not begin")
        drag(client, "tip0", [half[0].tolist()], released=False)
        drag(client, "tip1", [half[1].tolist()], released=False)
        until(lambda: page.session.status.aimed == arm.tips, "not both are aimed")
        assert all(target.is_held for target in page._controls.targets.values())
        drag(client, "tip0", [goal[0].tolist()])
        drag(client, "tip1", [goal[1].tolist()])
        until(
            lambda: (
                page.session.status.activity is Activity.AT_TARGET
                and not page.is_target_held
                and all(
                    np.abs(page.session.status.targets[tip].position - end).max() < 1e-6
                    for tip, end in zip(arm.tips, goal, strict=True)
                )
            ),
            "the arms do not follow",
        )
        for tip, end in zip(arm.tips, goal, strict=True):
            assert np.linalg.norm(arm.fk(page.session.status.q, tip).position - end) < 1e-3


def test_a_drag_or_the_list_chooses_whose_fields_show(path: Path):
    arm = loaded(str(path))
    with open_page(arm) as page, connected(page) as client:
        folders = page.panel._tip_folders
        shown = lambda: [tip for tip, folder in folders.items() if folder.visible]  # noqa: E731
        first = page.session.hand_tip
        (other,) = {*arm.tips} - {first}
        assert shown() == [first]
        drag(client, f"tip{arm.tips.index(other)}", [arm.fk(arm.home + 0.1, other).position.tolist()])
        until(lambda: shown() == [other] and page.session.hand_tip == other, "the drag does not choose its tip")
        client.set(page, "tip", first)
        until(lambda: shown() == [first] and page.session.hand_tip == first, "the list does not choose")


def test_the_handles_of_a_free_tip_go_with_it():
    """On a torso that turns for the other arm."""
    arm = armctl.load(mujoco.MjSpec.from_string(ON_A_TORSO))
    with open_page(arm) as page, connected(page):
        session = page.session
        bent = arm.home + 0.4
        until(lambda: session.status.elapsed > 0.0, "the session does not begin")
        session.move_joints(bent)
        until(lambda: np.abs(session.status.q - bent).max() < 1e-3, "the joints do not move")
        handle = page._controls.targets["l"]._gizmo
        before = np.array(handle.position)
        session.aim(Pose(arm.fk(bent, "r").position + np.array([-0.1, -0.3, 0.0])), tip="r")
        until(lambda: session.status.aimed == ("r",) and session.status.activity is Activity.AT_TARGET, "it is not followed")
        tip = arm.fk(session.status.q, "l").position
        until(lambda: np.abs(np.array(handle.position) - tip).max() < 1e-3, "the handles are not at the tip")
        assert np.linalg.norm(tip - before) > 0.01
