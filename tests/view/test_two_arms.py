"""A page with two arms: one is commanded, the brakes hold the other, and a list chooses which."""

from pathlib import Path

import numpy as np
import pytest
from synthetic import PAIR, mjcf, motors

pytest.importorskip("mjviser", reason="pip install -e '.[view]'")

from viewer_client import connected, open_page, until

import armctl
from armctl import ModelError
from armctl.cli import common
from armctl.cli.main import command_parser
from armctl.cli.view import loaded_arms
from armctl.view.realtime.status import Activity


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("pair") / "pair.xml"
    path.write_text(mjcf(PAIR, motors("a b c d e f")))
    return path


def loaded(*words: str):
    return loaded_arms(command_parser().parse_args(["view", *words]))


def test_view_loads_all_arms_of_a_robot_unless_a_tip_is_given(path: Path):
    assert [arm.tip for arm in loaded(str(path))] == ["C", "F"]
    assert [arm.tip for arm in loaded(str(path), "--tip", "F")] == ["F"]
    with pytest.raises(ModelError, match="no such file"):
        loaded(str(path.parent / "nothing.xml"))


def test_a_robot_is_loaded_once_for_all_its_tips(path: Path, monkeypatch: pytest.MonkeyPatch):
    calls = []
    monkeypatch.setattr("armctl.cli.common.load_arm", lambda args, load=common.load_arm: calls.append(args.tip) or load(args))
    arms = loaded(str(path))
    assert calls == [None]
    for part in arms:
        one = armctl.load(path, tip=part.tip)
        q = one.home + 0.3
        assert part.joint_names == one.joint_names
        assert np.array_equal(part.fk(q).matrix, one.fk(q).matrix)
        assert np.array_equal(part.mass_matrix(q), one.mass_matrix(q))
        assert np.array_equal(part.limits.tau_max, one.limits.tau_max)
        assert np.allclose(part.model.body("target").pos, one.model.body("target").pos)
        motion = armctl.out_and_back(one)
        runs = [armctl.simulate(arm, "computed-torque", motion, dwell=0.0) for arm in (part, one)]
        assert np.allclose(runs[0].q, runs[1].q, atol=1e-9)


def test_either_arm_follows_its_target_while_the_other_stands(path: Path):
    with open_page(loaded(str(path))) as page, connected(page) as client:
        first, second = (controls.session for controls in page._controls.arms.values())
        for session, other, label in ((first, second, "C"), (second, first, "F"), (first, second, "C")):
            client.set(page, "arm", label)
            until(lambda session=session, other=other: page.session is session and other.is_standing_by, "not chosen")
            before = other.status.qpos
            target = session.arm.fk(session.status.q + 0.2)
            session.aim(target)
            until(
                lambda session=session, target=target: (
                    session.status.target is target and session.status.activity is Activity.AT_TARGET
                ),
                "the arm does not follow",
            )
            assert np.abs(session.status.qpos[other.arm.qpos_adr] - before[other.arm.qpos_adr]).max() < 1e-3
            assert np.abs(session.status.q - before[session.arm.qpos_adr]).max() > 0.1


def test_a_dragged_handle_chooses_its_arm(path: Path):
    """Each tip has a handle, which is there all the time; that of an arm that stands is at its tip."""
    with open_page(loaded(str(path))) as page, connected(page) as client:
        first, second = (controls.session for controls in page._controls.arms.values())
        until(lambda: page.session is first and first.status.activity is Activity.AT_TARGET, "the first arm does not come")
        for k, session in enumerate((second, first, second)):
            other = first if session is second else second
            goal = session.arm.fk(session.arm.home + 0.1 * (k + 1)).position
            message = {"name": f"/scene0/arm{int(session is second)}/goal", "owner": ""}
            client.send({"type": "TransformControlsDragStartMessage", **message})
            for share in (0.5, 1.0):
                position = (share * goal + (1.0 - share) * session.arm.fk(session.status.q).position).tolist()
                turned = {"wxyz": [1.0, 0.0, 0.0, 0.0], "position": position}
                client.send({"type": "TransformControlsUpdateMessage", **message, **turned})
            client.send({"type": "TransformControlsDragEndMessage", **message})
            until(lambda session=session, other=other: page.session is session and other.is_standing_by, "not chosen")
            until(
                lambda session=session, goal=goal: (
                    np.abs(session.status.target.position - goal).max() < 1e-6
                    and session.status.activity is Activity.AT_TARGET
                    and not page.is_target_held
                ),
                "the arm does not follow",
            )
            handle = page._controls.arms[other.arm.tip].target._gizmo
            tip = other.arm.fk(session.status.qpos[other.arm.qpos_adr]).position
            until(lambda handle=handle, tip=tip: np.abs(np.array(handle.position) - tip).max() < 1e-3, "no handle at the tip")
