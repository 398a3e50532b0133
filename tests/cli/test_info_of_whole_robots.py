"""What `armctl info` and a notebook show of a robot with several tips."""

import json
import re
from pathlib import Path

import mujoco
import pytest
from synthetic import limb, mjcf, motors

import armctl
from armctl.cli.describe import TABLE_COLUMNS, span
from armctl.cli.main import main

pytestmark = pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")

LIMBS = {
    "torso": [],
    "left_arm": [f"left_arm_joint_{k}_of_the_robot" for k in range(7)],
    "right_arm": [f"right_arm_joint_{k}" for k in range(7)],
    "left_leg": [f"left_leg_{k}" for k in range(6)],
    "right_leg": [f"right_leg_{k}" for k in range(6)],
    "tail": ["a_joint_whose_name_is_longer_than_the_table_has_room_for", "tail_2"],
}
UPPER = "".join(limb(" ".join(LIMBS[name])) for name in ("left_arm", "right_arm", "tail"))
LOWER = "".join(limb(" ".join(LIMBS[name])) for name in ("left_leg", "right_leg"))
TRUNK = '<body name="trunk" pos="0 0 1"><geom size="0.1" mass="5" contype="0" conaffinity="0"/>'
ROBOT = f"{TRUNK}{limb('waist neck', UPPER)}{LOWER}</body>"
NAMES = ["waist", "neck", *LIMBS["left_arm"], *LIMBS["right_arm"], *LIMBS["tail"], *LIMBS["left_leg"], *LIMBS["right_leg"]]


@pytest.fixture
def robot(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(mjcf(ROBOT, motors(" ".join(NAMES))))
    return path


def info(capsys, *options):
    assert main(["info", *map(str, options)]) == 0
    return capsys.readouterr().out


def test_thirty_joints_and_five_tips_are_named_in_a_hundred_columns(capsys, robot):
    arm = armctl.load(robot)
    assert arm.n == 30
    assert len(arm.tips) == 5
    lines = info(capsys, robot).splitlines()
    table = lines[: next(k for k, line in enumerate(lines) if line.startswith("units:"))]
    assert max(map(len, table)) <= TABLE_COLUMNS
    assert "30 joints" in table[0]
    assert "5 tips" in table[0]
    text = "\n".join(table)
    for name in NAMES:
        assert re.search(rf"(?m)^\d+ +{name}\b", text)
    for tip in arm.tips:
        x, y, z = arm.fk(arm.home, tip).position
        assert re.search(rf"(?m)^{tip} +\[{x:.4f}, {y:.4f}, {z:.4f}\] +\S", text)
    rows = [line.split() for line in table if re.match(r"\d+ +(?:right_leg|tail)", line)]
    assert {row[1]: row[3:5] for row in rows}["tail_2"] == ["-2", "2"]


def test_the_joints_to_a_tip_are_those_that_move_it(robot):
    arm = armctl.load(robot)
    for tip in arm.tips:
        moving = arm.jacobian(arm.home + 0.3, tip).any(axis=0).nonzero()[0]
        assert arm.joints_to(tip) == tuple(moving.tolist())
    with pytest.raises(armctl.UnknownNameError, match="wing"):
        arm.joints_to("wing")


def test_a_follower_outside_the_chain_does_not_move_its_leaders_tip():
    bodies = limb("a b c") + limb("d e f")
    tied = '<equality><joint joint1="d" joint2="a" polycoef="0 0.5 0 0 0"/></equality>'
    arm = armctl.load(mujoco.MjSpec.from_string(mjcf(bodies, motors("a b c e f") + tied)))
    assert arm.joint_names == ("a", "b", "c", "e", "f")
    assert [arm.joints_to(tip) for tip in arm.tips] == [(0, 1, 2), (0, 3, 4)]


def test_indices_are_written_as_spans():
    assert span([0, 1, 2, 5, 7, 8]) == "0-2, 5, 7-8"
    assert span([]) == ""


def test_the_data_have_tips_and_base_and_a_free_base_has_no_motors(capsys, robot):
    arm = armctl.load(robot)
    facts = json.loads(info(capsys, robot, "--json"))["result"]
    assert facts["base"] == "fixed"
    assert list(facts["tips"]) == list(arm.tips)
    first = facts["tips"][arm.tip]
    assert first["at_home"] == pytest.approx(arm.fk(arm.home).position)
    assert first["joints"] == [arm.joint_names[i] for i in arm.joints_to(arm.tip)]
    text = info(capsys, robot, "--base", "free")
    assert "base: free, moved by q[0-5]" in text
    assert "no motor holds the free base" in text
    assert "payload at" not in text
    assert "static_payload_kg" not in json.loads(info(capsys, robot, "--base", "free", "--json"))["result"]


def test_a_notebook_shows_the_tips_and_the_base(robot):
    page = armctl.load(robot, base="planar")._repr_html_()
    assert page.count("<table") == 2
    assert "planar base" in page
    for name in ("moved by q", "TAIL_2", "waist"):
        assert name in page
    one = armctl.load(robot, tip="TAIL_2")._repr_html_()
    assert one.count("<table") == 1


def test_an_arm_with_closed_loops_is_described_without_margins(capsys):
    path = Path(__file__).parents[2] / "examples/models/parallel_link_arm.xml"
    text = info(capsys, path)
    assert "closed loops: elbow, level" in text
    assert text.endswith("payloads and margins are not computed for an arm with closed loops\n")
    assert "margin_exceptions" not in json.loads(info(capsys, path, "--json"))
