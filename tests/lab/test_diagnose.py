"""What `diagnose` says about files with one fault each."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from synthetic import FIRST, INERTIA, JOINT, LIMIT, LINK, MESH, SECOND, THIRD, TOOL, limb, mjcf, motors, urdf

import armctl
from armctl.cli.main import main
from armctl.lab.static_payload import doubt_about_torque_limits, static_payload, static_payloads
from armctl.model.loading.datasheets import ROWS, Row

ROBOT = urdf(FIRST, SECOND, THIRD, TOOL)
BALL = '<collision><geometry><sphere radius="0.4"/></geometry></collision>'
SOUND = ROBOT.replace("</inertial>", '</inertial><collision><geometry><sphere radius="0.05"/></geometry></collision>')
OVERLAP = urdf(FIRST, SECOND, JOINT.format("j3", "revolute", "two", "three", LIMIT), TOOL, shapes=BALL).replace(
    LINK.format("three", INERTIA, ""), LINK.format("three", INERTIA, BALL)
)
NO_LIMIT = ROBOT.replace('effort="40" ', 'effort="0" ')


@pytest.fixture
def diagnose(tmp_path: Path):
    def diagnosed(text: str, name: str = "r.urdf", **keywords: object) -> armctl.Diagnosis:
        (tmp_path / name).write_text(text)
        return armctl.diagnose(tmp_path / name, **keywords)

    return diagnosed


def test_a_sound_file_has_neither_errors_nor_warnings(diagnose):
    found = diagnose(SOUND)
    assert found
    assert found.reason == ""
    assert {finding.severity for finding in found.findings} == {"note"}


FAULTS = {
    "missing mesh": (urdf(FIRST, SECOND, THIRD, TOOL, shapes=MESH.format("one.stl")), "left out: not found", "copy the meshes"),
    "no torque limit": (NO_LIMIT, "no torque limit given for j1, j2", 'write <limit effort="..."/>'),
    "no inertia": (ROBOT.replace(INERTIA, ""), "has no mass or no inertia", ""),
    "links that touch": (OVERLAP, r"contacts of 1 pair of links", "list the pairs in an SRDF"),
    "too strong": (
        ROBOT.replace('effort="40"', 'effort="40000"'),
        "kg at the tip of an arm of 3 kg: they are too strong",
        "take effort or forcerange from the data sheet",
    ),
    "units": (
        ROBOT.replace('<mass value="1"/>', '<mass value="1e-5"/>', 1),
        "differ by more than 1000 times",
        "check their units",
    ),
}


@pytest.mark.parametrize(("text", "what", "advice"), FAULTS.values(), ids=FAULTS)
def test_a_fault_is_a_warning_with_advice(diagnose, text: str, what: str, advice: str):
    found = diagnose(text)
    matching = [finding for finding in found.findings if what in finding.text]
    assert [finding.severity for finding in matching] == ["warning"]
    assert advice in matching[0].advice


def test_a_motor_that_cannot_hold_the_arm_at_home_is_an_error(diagnose):
    found = diagnose(SOUND.replace('effort="40"', 'effort="0.5"'))
    assert not found
    assert "holding j1 still at home takes" in found.reason


def test_the_payload_is_what_the_torque_limits_hold(diagnose):
    # One joint, an arm of 1 m without mass but at its axis: 20 N m hold 20 / (9.81 x 1 m) kg at worst.
    body = (
        '<body><joint name="a" axis="0 1 0" range="-0.05 0.05"/><geom size="0.01" mass="1" contype="0"/>'
        '<site name="tip" pos="1 0 0"/></body>'
    )
    assert diagnose(mjcf(body, motors("a")), "r.xml").payload == pytest.approx(20 / 9.81, rel=2e-3)


def test_bodies_that_overlap_at_home_are_named(diagnose):
    # Where C is at home, and in other configurations not: a contact in all of them is left out.
    ball = '<geom size="0.03" mass="0.5" {}/>'
    text = mjcf(limb("a b c", ball.format("")) + ball.format('pos="0.3 0 0.3"'), motors("a b c"))
    assert any("world and C overlap at home" in finding.text for finding in diagnose(text, "r.xml").findings)


def test_a_tip_that_was_given_is_not_guessed(diagnose):
    assert any("the tip is 'tool0'" in finding.text for finding in diagnose(ROBOT).findings)
    assert not any("the tip is" in finding.text for finding in diagnose(ROBOT, tip="two").findings)


def test_a_file_that_does_not_load_is_an_error_with_the_reason(diagnose):
    found = diagnose("<robot")
    assert not found.ok
    assert "no well-formed XML" in found.reason
    assert [finding.severity for finding in found.findings] == ["error"]


def test_the_command_prints_the_findings_and_fails_on_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "r.urdf"
    path.write_text(SOUND)
    assert main(["doctor", str(path), "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)["result"]
    assert figures["payload"] > 0
    assert all(finding["severity"] == "note" for finding in figures["findings"])
    path.write_text("<robot")
    assert main(["doctor", str(path)]) == 1
    assert capsys.readouterr().out.startswith("r.urdf: 1 error, 0 warnings, 0 notes\nerror: ")


@pytest.mark.parametrize(("rated", "doubt"), [(0.1, "they are too strong"), (2.5, ""), (500.0, "they are too weak")])
def test_torque_limits_far_from_the_rated_payload_are_doubted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rated: float, doubt: str
):
    row = Row(source="data sheet", payload=rated, reach=1.0)
    monkeypatch.setitem(ROWS, "r", row)
    (tmp_path / "r.urdf").write_text(ROBOT)
    arm = replace(armctl.load(tmp_path / "r.urdf"), notes=(row.rating,))
    found = doubt_about_torque_limits(arm, static_payload(static_payloads(arm)))
    assert found.endswith(doubt)
    assert bool(found) == bool(doubt)
    assert (f"rated for {rated:g} kg" in found) == bool(doubt)
    assert not doubt_about_torque_limits(replace(arm, notes=()), 0.0)
