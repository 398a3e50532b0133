"""Comparisons: every pair once, failures first, the same from one process as from two, and pages that stand alone."""

import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest

import armctl
from armctl.cli.plants import PLANTS, plant_by_name
from armctl.lab.comparison import out_and_back, remarks
from armctl.lab.comparison_html import write_comparison
from armctl.report.report import best_cells, report_table, table
from armctl.run.sim.plant import PLANT_ATTRIBUTES
from armctl.run.sim.plant_attribute import Kind


class Explodes:
    """A spring with the wrong sign."""

    name = "explodes"

    def torque(self, state, setpoint):
        return 1e4 * (state.q - setpoint.q) + 1e3 * state.v + 1.0


class Breaks:
    """Raises after a while."""

    name = "breaks"

    def torque(self, state, setpoint):
        if state.t > 0.1:
            raise ValueError("out of ideas")
        return np.zeros_like(state.q)


@pytest.fixture(scope="module")
def bundled_motion():
    arm = armctl.load("robot_arm_3dof")
    return arm, out_and_back(arm, 0.3)


def test_every_pair_has_a_report_plant_by_plant(bundled_motion):
    arm, motion = bundled_motion
    plants = [armctl.Plant(), armctl.Plant(payload=1.0)]
    reports = armctl.compare(arm, ["pd", "computed-torque"], motion, plants)
    assert [(r.controller, r.plant) for r in reports] == [
        ("pd", "nominal"),
        ("computed-torque", "nominal"),
        ("pd", "payload 1 kg"),
        ("computed-torque", "payload 1 kg"),
    ]
    assert reports[1].joint_rms_rad < 1e-9 < reports[0].joint_rms_rad


@pytest.mark.nightly
def test_plants_and_controllers_of_one_name_stay_apart(bundled_motion, tmp_path):
    arm, motion = bundled_motion
    plants = [armctl.Plant(coulomb_friction=0.01), armctl.Plant(coulomb_friction=0.05), armctl.Plant(coulomb_friction=0.05)]
    controllers = [armctl.PD(arm), armctl.PD(arm, bandwidth=5.0)]
    reports = armctl.compare(arm, controllers, motion, plants)
    assert len({(r.controller, r.plant) for r in reports}) == 6
    assert [r.controller for r in reports[:2]] == ["pd", "pd (2)"]
    assert len(set(table(reports).splitlines())) == 8
    page = write_comparison(reports, tmp_path, "Out and back")[2].read_text()
    assert page.count("<h2>") == page.count("<svg") == 3
    assert "pd (2)" in page


def test_two_threads_find_what_one_finds(bundled_motion):
    arm, motion = bundled_motion
    plants = [armctl.Plant(encoder_noise=1e-4)]
    one, two = (armctl.compare(arm, ["pd", "computed-torque-observer"], motion, plants, threads=threads) for threads in (1, 2))
    assert all(np.array_equal(a.log.q, b.log.q) for a, b in zip(one, two, strict=True))


def test_what_fails_is_named_first(bundled_motion):
    arm, motion = bundled_motion
    reports = armctl.compare(arm, ["pd", Breaks(), Explodes()], motion)
    assert not reports[1].ok
    assert not reports[2].ok
    said = remarks(reports)
    assert said[0].startswith("breaks on encoder: the controller breaks failed at 0.10")
    assert "explodes on encoder" in " ".join(said)
    assert np.isfinite([r.joint_rms_rad for r in reports]).all()


def test_a_divergence_ends_in_a_verdict_with_its_log(bundled_motion):
    arm, motion = bundled_motion
    report = armctl.compare(arm, [Explodes()], motion, [armctl.Plant(timestep=0.004)])[0]
    assert not report.ok
    assert report.verdict
    assert len(report.log) > 10
    assert np.isfinite(report.log.q).all()
    assert np.isfinite(report.log.tau).all()


def words_for(name: str) -> str:
    """A name with a value that differs from the nominal one, and what it needs to matter, from the table of attributes."""
    attribute = PLANT_ATTRIBUTES.get(name)
    if attribute is None or attribute.kind is Kind.FLAG:
        return name
    if attribute.kind in (Kind.POINT, Kind.INERTIA):
        return f"{name}=0.01:0.02:0.02+{words_for(attribute.only_with[0])}"
    others = [word for word in attribute.words if word != attribute.default]
    default = attribute.default or 0
    value = others[0] if others else min(attribute.high, max(attribute.low, default + 1))
    needed = f"+{words_for(attribute.only_with[0])}" if attribute.only_with else ""
    return f"{name}={value:g}{needed}" if not others else f"{name}={value}{needed}"


@pytest.mark.parametrize("name", PLANTS)
def test_every_plant_has_its_name(bundled, name):
    assert (str(plant_by_name(words_for(name), bundled)) == "nominal") == (name == "nominal")


def test_the_attributes_of_a_plant_are_words_of_the_command_line(bundled):
    plant = plant_by_name("mass_scale=1.1+wrench_source=torques+wrench_delay=2+continuous", bundled)
    assert plant.key == armctl.Plant(mass_scale=1.1, wrench_source="torques", wrench_delay=2, continuous=True).key


def test_plants_take_values_and_join(bundled):
    plant = plant_by_name("payload=0.5+delay=1+noise=2", bundled, 0.001)
    assert (plant.payload, plant.delay, plant.encoder_noise, plant.timestep) == (0.5, 1, 2e-5, 0.001)
    assert np.allclose(plant_by_name("friction=0.1", bundled).coulomb_friction, 0.1 * bundled.limits.tau_max)


def test_a_payload_on_the_command_line_has_a_center_and_an_inertia(bundled):
    moments = [0.001, 0.0025, 0.0017]
    hand = armctl.Plant(payload=0.73, payload_center=[-0.01, 0, 0.03], payload_inertia=np.diag(moments))
    words = ["payload=0.73", "payload_center=-0.01:0:0.03", "payload_inertia=0.001:0.0025:0.0017"]
    for text in ("+".join(words), "+".join(words[::-1])):
        assert plant_by_name(text, bundled).key == hand.key


@pytest.mark.parametrize(
    ("text", "error", "sentence"),
    [
        ("payload=1+payload_inertia=0.1", armctl.InputError, "plant payload_inertia=0.1: payload_inertia: .*3"),
        ("payload_inertia=1:2:9", armctl.InputError, "no body has the principal moments"),
        ("payload_center", armctl.InputError, "'payload_center' needs a value, as in 'payload_center=0:0:0'"),
        ("paylod=1", armctl.UnknownNameError, "did you mean 'payload'"),
        ("payload=much", armctl.InputError, "plant payload=much: 'much' is not a number"),
        ("payload=-1", armctl.InputError, "payload: expected .*got -1"),
        ("force_noise", armctl.InputError, "plant force_noise: 'force_noise' needs a value, as in 'force_noise=1'"),
        ("wrench_source=x", armctl.InputError, "wrench_source: expected one of flange, torques"),
        ("continuous=1", armctl.InputError, "'continuous' takes no value"),
        ("all=2", armctl.InputError, "'all' takes no value"),
        ("nominal=3", armctl.InputError, "'nominal' takes no value"),
        ("delay=1.5", armctl.InputError, "delay: expected a whole number"),
    ],
)
def test_a_wrong_plant_is_one_sentence(bundled, text, error, sentence):
    with pytest.raises(error, match=sentence):
        plant_by_name(text, bundled)


@pytest.mark.full
def test_a_page_stands_alone_and_says_it_all(bundled_motion, tmp_path):
    arm, motion = bundled_motion
    plants = [armctl.Plant(), armctl.Plant(payload=1.0)]
    reports = armctl.compare(arm, ["pd", "computed-torque", Breaks()], motion, plants)
    paths = write_comparison(reports, tmp_path / "out", "Out and back")
    assert [path.name for path in paths] == ["comparison.json", "comparison.md", "comparison.html"]
    figures = json.loads(paths[0].read_text())
    assert len(figures["runs"]) == 6
    assert figures["remarks"] == remarks(reports)
    assert table(reports) in paths[1].read_text()
    page = paths[2].read_text()
    HTMLParser().feed(page)
    assert page.count("<svg") == len(plants)
    assert not re.search(r'(?:src|href)="(?!#)', page), "the page needs something from elsewhere"
    assert page.index("breaks on nominal") < page.index("<table")
    assert page.count("<table") == len(plants)


def test_the_best_values_of_each_plant_are_marked_and_not_those_of_failed_runs(bundled_motion):
    arm, motion = bundled_motion
    reports = armctl.compare(arm, ["pd", "computed-torque", Breaks()], motion, [armctl.Plant(), armctl.Plant(payload=1.0)])
    for group in reports.plants().values():
        made = report_table(group)
        marks = best_cells(group)
        assert {made.rows[row][0] for row, _ in marks} <= {"pd", "computed-torque"}
        column = [title.startswith("tip RMS") for title in made.header].index(True)
        best = min(group[:2], key=lambda report: report.tip_rms_m)
        assert (group.index(best), column) in marks
    page = reports._repr_html_()
    assert page.count("<h4>") == page.count("<table") == 2
    assert "<mark>" in page


def test_margins_are_those_of_each_pair(bundled):
    plant = armctl.Plant(timestep=0.004)
    motion = armctl.move_j(bundled, bundled.home, bundled.home + 0.1)
    with_margins, without = (armctl.compare(bundled, ["pd"], motion, [plant], configurations=count)[0] for count in (2, 0))
    found = armctl.margins(bundled, "pd", 2, [plant])
    assert with_margins.delay_margin_s == found.delay.value
    assert with_margins.peak_sensitivity == found.peak_sensitivity.value
    assert np.isnan(without.peak_sensitivity)
    assert "Ms" in table([with_margins])
    assert "Ms" not in table([without])


def test_a_printed_comparison_is_the_table_of_the_command_line(bundled_motion):
    bundled, motion = bundled_motion
    reports = armctl.compare(bundled, ["pd", "computed-torque"], motion, configurations=0)
    lines = str(reports).splitlines()
    assert lines[0].startswith("controller")
    assert [sum(line.startswith(name) for line in lines) for name in ("pd ", "computed-torque ")] == [2, 2]
    assert max(map(len, lines)) <= 80
