"""A robot on a page: it moves while a visitor holds on, for one visitor at a time, and brakes when the visitor is gone."""

import threading

import numpy as np
import pytest
from arms import arm_of

pytest.importorskip("mjviser", reason="pip install -e '.[view]'")

from viewer_client import CAMERA, TIMEOUT_S, Client, control_id, until

import armctl
from armctl.cli.main import main
from armctl.view.devices import PATH
from armctl.view.plan_preview import Ghost
from armctl.view.robot_page import RobotPage
from armctl.view.web_scene import WebScene

DOWN = "[0, 0, -1, 0, 0, 0]"


class Served:
    """A page of a simulated robot, with what the helpers of the other pages need."""

    def __init__(self, **options):
        arm = arm_of("robot_arm_3dof")
        self.robot = armctl.Robot(arm, armctl.links.PlantLink(arm, **options), speed=0.5)
        self.scene = WebScene(0)
        self.port = self.scene.port
        self.page = RobotPage(self.robot, self.scene)
        self.thread = threading.Thread(target=self.page.serve, daemon=True)

    def __enter__(self) -> "Served":
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.page.close()
        self.thread.join(TIMEOUT_S)
        assert not self.thread.is_alive()
        self.scene.close()
        self.robot.close()

    @property
    def height(self) -> float:
        return float(self.robot.arm.fk(self.robot.state.q).position[2])


def still(served: Served) -> bool:
    rows = served.robot.link.sent
    threading.Event().wait(0.3)
    return served.robot.link.sent == rows


def test_a_robot_moves_while_a_key_is_held_and_brakes_when_the_visitor_is_gone():
    with Served() as served:
        client = Client(served, PATH)
        begin = served.height

        def moved() -> bool:
            client.send(DOWN)
            return served.height < begin - 0.02

        until(moved, "the robot does not move")
        client.close()
        until(lambda: still(served), "the robot does not come to rest")
        assert served.robot.fault == ""
        log = served.robot.log
        v = np.diff(log.q_ref, axis=0) / log.dt
        assert (np.abs(np.diff(v, axis=0)) / log.dt <= 1.001 * served.robot.arm.limits.a_max).all()
        assert np.abs(v[-1]).max() < 1e-4


def drag(client: Client, position: np.ndarray, kind: str = "TransformControlsUpdateMessage") -> None:
    pose = {"wxyz": [1.0, 0.0, 0.0, 0.0], "position": position.tolist()} if kind.endswith("UpdateMessage") else {}
    client.send({"type": kind, "name": "/hand", "owner": "", **pose})


def test_a_dragged_handle_moves_the_robot_for_the_visitor_who_holds_it():
    with Served() as served:
        first, second = Client(served), Client(served)
        for client in (first, second):
            client.send(CAMERA)
        until(lambda: len(served.scene.server.get_clients()) == 2, "the visitors are not counted")
        begin = served.robot.tip.position
        low = begin - np.array([0.0, 0.0, 0.1])
        drag(first, low, "TransformControlsDragStartMessage")

        def moved() -> bool:
            drag(first, low)
            drag(second, begin + np.array([0.0, 0.0, 0.1]))
            return served.height < begin[2] - 0.02

        until(moved, "the robot does not move")
        first.close()
        until(lambda: still(served), "the robot does not come to rest")
        second.close()


def test_a_fault_stays_until_a_visitor_recovers():
    with Served(faults={5: "cartesian_reflex"}) as served:
        client = Client(served, PATH)

        def failed() -> bool:
            client.send(DOWN)
            return served.robot.fault == "cartesian_reflex"

        until(failed, "no fault")
        until(lambda: "cartesian_reflex" in served.scene.text.content, "the page does not say it")
        assert still(served)
        visitor = Client(served)
        visitor.send(CAMERA)
        until(lambda: len(served.scene.server.get_clients()) == 1, "the visitor is not counted")
        visitor.send({"type": "GuiUpdateMessage", "uuid": control_id(served, "recover"), "updates": {"value": True}})
        until(lambda: served.robot.fault == "", "it does not recover")
        visitor.close()
        client.close()


@pytest.mark.full
def test_a_page_shows_the_moves_of_a_program_beside_what_the_robot_was_told(monkeypatch):
    told = []
    monkeypatch.setattr(Ghost, "show", lambda _, q: told.append(q))
    arm = arm_of("robot_arm_3dof")
    with armctl.Robot(arm, armctl.links.PlantLink(arm, real_time=True), speed=0.5) as robot:
        page = robot.view()
        assert told.pop(0) is arm.home
        assert told.pop(0) is None
        drawn = []
        page.scene.show = lambda qpos: drawn.append(qpos)
        result = robot.move_to([0.3, 0.2, 0.3])
        assert result, result.reason
        seen = np.array(drawn)[:, arm.qpos_adr]
        assert len(seen) > 20
        assert np.abs(np.diff(seen, axis=0)).max() < 0.5 * np.abs(seen[-1] - seen[0]).max()
        assert seen[-1] == pytest.approx(result.log.q[-1], abs=5e-3)
        assert len(told) > 5
        assert all(np.abs(result.log.q_ref - q).max(axis=1).min() < 1e-6 for q in told)
        assert "simulated robot_arm_3dof" in page.scene.text.content
        page.close()
        assert robot.move_to([0.3, -0.2, 0.3])


def test_the_command_line_serves_a_page_until_ctrl_c(monkeypatch, capsys):
    def interrupted(page: RobotPage) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(RobotPage, "serve", interrupted)
    assert main(["robot", "view", "here", "--link", "plant"]) == 0
    assert "simulated robot_arm_3dof is at http://127.0.0.1:" in capsys.readouterr().out
