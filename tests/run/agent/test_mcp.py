"""`armctl mcp` as a language model uses it: nothing moves that is not proved, and whatever is wrong is one sentence."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from arms import BUNDLED, arm_of

import armctl
from armctl.model.mjmodel.queries import acts, is_below, robot_roots

pytest.importorskip("mcp", reason="pip install -e '.[mcp]'")

from mcp_client import McpClient, mcp_client

SCENE = """
<mujoco><worldbody>
  <body name="wall" pos="0.42 0 0.2"><geom type="box" size="0.01 0.3 0.2"/></body>
  <body name="can" pos="0.2 -0.3 0.01"><freejoint/><geom type="cylinder" size="0.03 0.05" mass="0.2"/></body>
  <camera name="eye" pos="0 -1.5 1.2" xyaxes="1 0 0 0 0.6 0.8"/>
</worldbody></mujoco>
"""


EACH = 4  # ticks, of which one is looked at for contacts


class Served:
    """A client, the record of its server, and the arm that is served."""

    def __init__(self, client: McpClient, arm: armctl.Arm, record: Path):
        self.client = client
        self.arm = arm
        self.record = record

    def logs(self) -> list[armctl.Log]:
        """The logs of all motions until now."""
        return [armctl.Log.load(path) for path in sorted(self.record.glob("*.npz"))]


@pytest.fixture(scope="module")
def served(tmp_path_factory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("mcp")
    scene = folder / "scene.xml"
    scene.write_text(SCENE)
    with mcp_client(folder, BUNDLED, "--scene", str(scene), "--out", str(folder / "record")) as client:
        yield Served(client, armctl.load(BUNDLED, scene=scene), folder / "record")


def touched(arm: armctl.Arm, log: armctl.Log) -> set[tuple[str, str]]:
    """What the robot touches in MuJoCo at the positions of a log: itself or anything else."""
    model = arm.model
    data = mujoco.MjData(model)
    roots = robot_roots(model, arm.joint_map.joints)
    found = set()
    for qpos in log.qpos[::EACH]:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        for contact in filter(acts, data.contact):
            bodies = [int(model.geom_bodyid[geom]) for geom in contact.geom]
            if any(is_below(model, body, root) for body in bodies for root in roots):
                found.add(tuple(model.body(body).name for body in bodies))
    return found


def test_the_tools_are_those_of_the_page(served: Served):
    tools = served.client.tools()
    assert list(tools) == ["state", "look", "picture", "move_to", "move_l", "move_j", "grasp", "open", "undo", "stop"]
    assert all(schema["additionalProperties"] is False for schema in tools.values())
    assert tools["move_to"]["required"] == ["position"]


def test_it_sees_the_scene_its_points_and_pictures(served: Served):
    seen = served.client.call("look").structured_content
    assert seen is not None
    assert {body["name"]: body["kind"] for body in seen["bodies"]} == {"wall": "fixed", "can": "loose"}
    assert seen["bodies"][0]["box_high"] in ([0.01, 0.3, 0.2], [0.03, 0.03, 0.05])
    assert seen["cameras"] == ["scene/eye"]
    cloud = served.client.call("look", {"camera": "scene/eye"}).structured_content
    assert cloud is not None
    assert 1 <= len(cloud["points"]) <= 200 <= cloud["count"]
    for arguments in ({}, {"camera": "scene/eye", "width": 64, "height": 80}):
        picture = served.client.call("picture", arguments)
        assert [part.type for part in picture.content] == ["text", "image"]
        assert picture.content[1].mime_type == "image/png"


def task(rng: np.random.Generator, arm: armctl.Arm) -> tuple[str, dict[str, Any]]:
    """One of the things that a language model may want, reachable or not."""
    kind = rng.choice(["move_to", "move_to", "move_l", "move_j", "undo", "look", "state"])
    if kind == "move_j":
        q = rng.uniform(arm.limits.q_min, arm.limits.q_max)
        return kind, {"q": q.tolist() if rng.random() < 0.5 else {arm.joint_names[0]: float(q[0])}}
    if kind in ("move_to", "move_l"):
        return kind, {
            "position": rng.uniform([-0.4, -0.5, 0.0], [0.6, 0.5, 0.7]).tolist(),
            "speed": float(rng.choice([0.5, 1.0])),
        }
    return str(kind), {}


def run_tasks(served: Served, count: int, seed: int) -> None:
    client = served.client
    arm = served.arm
    rng = np.random.default_rng(seed)
    before = client.state()
    known = len(served.logs())
    outcomes = []
    for _ in range(count):
        name, arguments = task(rng, arm)
        answer = client.call(name, arguments)
        text = answer.content[0].text
        assert "internal error" not in text
        outcomes.append((name, not answer.is_error))
        values = answer.structured_content
        if answer.is_error and name != "undo":
            assert values is not None
            assert not values["moved"], text
            nearest = np.array(values["nearest_safe"]["q"])
            assert (np.abs(arm.limits.clamp(nearest) - nearest) < 1e-4).all()
            assert "the nearest safe pose has the tip at" in text
    moves = [ok for name, ok in outcomes if name.startswith("move")]
    assert any(moves)
    assert not all(moves)
    logs = served.logs()[known:]
    assert [touched(arm, log) for log in logs] == [set()] * len(logs)
    after = client.state()
    # The simulation has run as long as the motions that were recorded, and so nothing else has moved it.
    assert after["time"] - before["time"] == pytest.approx(sum(map(len, logs)) * arm.dt, abs=1e-6)


def test_tasks_move_only_where_nothing_is_touched(served: Served):
    run_tasks(served, 12, seed=1)


@pytest.mark.full
def test_fifty_tasks_move_only_where_nothing_is_touched(served: Served):
    run_tasks(served, 50, seed=2)


def test_undo_goes_back_motion_by_motion(served: Served):
    client = served.client
    places = [client.state()["joints"]]
    for x in (-0.3, 0.3):
        answer = client.call("move_j", {"q": {"shoulder_yaw": x}})
        assert not answer.is_error, answer.content[0].text
        places.append(client.state()["joints"])
    assert [client.call("undo").is_error for _ in range(2)] == [False, False]
    back = client.state()["joints"]
    assert list(back.values()) == pytest.approx(list(places[0].values()), abs=1e-3)


DEEP: list[Any] = []
for _ in range(60):
    DEEP = [DEEP]
BAD: list[Any] = [
    "0.3",
    "",
    True,
    {},
    {"x": 1},
    [],
    [None] * 3,
    [0.1, 0.2],
    [0.1] * 4,
    [0.1, "a", 0.2],
    [[0.1, 0.2, 0.3]],
    [1e300, 0.0, 0.0],
    [10**400, 0, 0],
    [-1e9] * 3,
    [0.1] * 20_000,
    DEEP,
    "x" * 5_000,
    -1,
    0,
    10**400,
    1e308,
    "../../etc/passwd",
    "wall\n\x00\u2028",
    {"__class__": "x", "shoulder_yaw": [1]},
]
ARGUMENTS = ("position", "quat", "rpy", "speed", "tip", "q", "camera", "width", "height", "force", "bad name", "__init__", "")
NAMES = ("state", "look", "picture", "move_to", "move_l", "move_j", "grasp", "open", "undo", "move", "", "call", "__init__")


def hostile(rng: np.random.Generator) -> tuple[str, dict[str, Any]]:
    """A call that no tool takes: a wrong name, a wrong argument, or a wrong value."""
    name = str(rng.choice(NAMES))
    arguments = {str(rng.choice(ARGUMENTS)): BAD[rng.integers(len(BAD))] for _ in range(rng.integers(1, 4))}
    if name in ("move_to", "move_l") and rng.random() < 0.5:
        arguments = {"position": [0.2, 0.2, 0.3], **arguments, str(rng.choice(["speed", "quat", "tip"])): BAD[rng.integers(3)]}
    return name, arguments


def run_hostile(served: Served, count: int, seed: int) -> None:
    client = served.client
    rng = np.random.default_rng(seed)
    before = client.state()
    for _ in range(count):
        name, arguments = hostile(rng)
        answer = client.call(name, arguments)
        text = answer.content[0].text
        assert answer.is_error, (name, str(arguments)[:200], text)
        assert len(text) <= 500
        assert "\n" not in text
        for sign in ("Traceback", "internal error", "numpy", "<class", 'File "'):
            assert sign not in text
    assert client.state() == before
    assert "Traceback" not in client.errors


def test_hostile_calls_are_answered_in_one_sentence_and_move_nothing(served: Served):
    run_hostile(served, 48, seed=3)


@pytest.mark.full
def test_five_hundred_hostile_calls_move_nothing(served: Served):
    run_hostile(served, 500, seed=4)


def test_what_was_called_is_in_the_record(served: Served):
    served.client.call("move_to", {"position": [9.0, 0.0, 0.0]})
    rows = [json.loads(line) for line in (served.record / "calls.jsonl").read_text().splitlines()]
    assert rows[-1]["tool"] == "move_to"
    assert not rows[-1]["ok"]
    assert "out of reach" in rows[-1]["answer"]
    assert [row["call"] for row in rows] == list(range(1, len(rows) + 1))


TABLE = """
<mujoco><worldbody>
  <body name="table" pos="0.5 0 0.1"><geom type="box" size="0.2 0.3 0.1"/></body>
  <body name="cube" pos="0.5 0 0.225"><freejoint/><geom type="box" size="0.025 0.025 0.025" mass="0.1"/></body>
</worldbody></mujoco>
"""


@pytest.mark.full
def test_a_cube_is_grasped_lifted_and_carried_and_nothing_else_is_touched(tmp_path: Path):
    arm_of("panda")  # skips where it is not installed
    scene = tmp_path / "scene.xml"
    scene.write_text(TABLE)
    down = [0.0, 1.0, 0.0, 0.0]
    record = tmp_path / "record"
    with mcp_client(tmp_path, "panda", "--scene", str(scene), "--out", str(record)) as client:
        for tool, arguments in (
            ("open", {}),
            ("move_to", {"position": [0.5, 0.0, 0.35], "quat": down}),
            ("move_l", {"position": [0.5, 0.0, 0.225], "quat": down}),
            ("grasp", {"force": 15.0}),
            ("move_l", {"position": [0.5, 0.0, 0.4], "quat": down}),
            ("move_to", {"position": [0.4, 0.2, 0.35], "quat": down}),
        ):
            answer = client.call(tool, arguments)
            assert not answer.is_error, (tool, answer.content[0].text)
        assert client.state()["gripper"]["held"] == "cube"
        refused = client.call("move_to", {"position": [0.5, 0.0, 0.21], "quat": down})
        assert refused.is_error
        assert "cube" in refused.content[0].text  # what is held is part of the proof
        seen = client.call("look").structured_content
        assert seen is not None
        [cube] = [body for body in seen["bodies"] if body["name"] == "cube"]
        assert np.linalg.norm(np.array(cube["position"]) - [0.4, 0.2, 0.35]) < 0.01
    arm = armctl.load("panda", scene=scene)
    for path in sorted(record.glob("*.npz")):
        pairs = touched(arm, armctl.Log.load(path))
        assert all("cube" in pair and any("finger" in body for body in pair) for pair in pairs), pairs
