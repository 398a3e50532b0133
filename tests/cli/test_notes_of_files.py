"""What the commands say about a file: each note once, in plain words, with units."""

import mujoco
import pytest
from synthetic import FAST, limb, mjcf, motors

import armctl
from armctl.cli.main import main

SERVOS = motors("a", a='<position name="m_a" joint="a" kp="50" forcerange="-9 9"/>')


def test_info_prints_each_note_once_and_counts_one_joint(tmp_path, capsys):
    path = tmp_path / "arm.xml"
    path.write_text(mjcf(limb("a"), FAST + motors("a", a='<motor joint="a"/>')))
    assert main(["info", str(path)]) == 0
    printed = capsys.readouterr()
    assert (printed.out + printed.err).count("no torque limit given for a") == 1
    assert "arm: 1 joint, " in printed.out


def test_simulate_notes_replaced_servos_and_contacts_that_are_left_out(tmp_path, capsys):
    bodies = (
        '<body name="base"><geom type="cylinder" size="0.05 0.05"/><body name="link1" pos="0 0 0.05">'
        '<joint name="a" axis="0 0 1" range="-2 2"/><geom type="capsule" fromto="0 0 0 0 0 0.3" size="0.04"/></body></body>'
    )
    path = tmp_path / "arm.xml"
    path.write_text(mjcf(bodies, FAST + SERVOS))
    assert main(["simulate", str(path), "--ctrl", "0.5", "--duration", "0.01"]) == 0
    printed = capsys.readouterr().out
    assert "note: contact of base with link1 left out" in printed
    assert "in MuJoCo alone their friction brakes the joint" in printed
    assert "note: torque motors replace the servos of a: their gains are not used, and controls are torques" in printed


def test_an_element_that_is_not_closed_is_named_in_plain_words(tmp_path):
    path = tmp_path / "arm.xml"
    text = mjcf(limb("a b"), motors("a b"))
    path.write_text(text.replace("</body>", "", 1))
    said = r"line 1, column [0-9]+: an element before it is not closed: each <body> needs"
    with pytest.raises(armctl.ModelError, match=said):
        armctl.load(path)


def test_a_urdf_names_its_effort_and_every_missing_mesh_whole(tmp_path):
    inertial = '<inertial><mass value="1"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>'
    links = "".join(
        f'<link name="l{i}">{inertial}<collision><geometry><mesh filename="package://robot_description/mesh_of_link_{i}.stl"/>'
        "</geometry></collision></link>"
        for i in range(9)
    )
    joints = "".join(
        f'<joint name="j{i}" type="revolute"><parent link="l{i}"/><child link="l{i + 1}"/><origin xyz="0 0 0.2"/>'
        '<axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="500" velocity="2"/></joint>'
        for i in range(8)
    )
    path = tmp_path / "arm.urdf"
    path.write_text(f'<robot name="arm">{links}{joints}</robot>')
    with pytest.warns(armctl.ArmctlWarning) as caught:
        arm = armctl.load(path)
    said = next(str(each.message) for each in caught if "left out: not found" in str(each.message))
    assert "'mesh_of_link_5.stl' and 3 more left out: not found" in said
    assert arm.sources["tau_max"] == "URDF effort"
    advice = [finding.advice for finding in armctl.diagnose(path).findings if finding.text.startswith("a_max, j_max")]
    assert advice == ["arm.with_limits(...) sets them"]


def test_doctor_gives_torques_their_unit():
    weak = mujoco.MjSpec.from_string(mjcf(limb("a b"), FAST + motors("a b")))
    for geom in weak.geoms:
        geom.mass = 400.0
    texts = [finding.text for finding in armctl.diagnose(weak).findings if finding.severity == "error"]
    held = next(text for text in texts if text.startswith("holding a still at home takes "))
    assert " N m; its limit is 20 N m (ctrlrange)" in held
