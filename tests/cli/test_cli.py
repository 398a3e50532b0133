"""The command line as a stranger uses it: what it prints, what it exits with, and how it says no."""

import argparse
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from arms import BUNDLED, MISSING, at_hand
from commands import armctl_command
from synthetic import FIRST, SECOND, THIRD, TOOL, limb, mjcf, motors, urdf

import armctl
from armctl.cli.main import command_parser, main, with_options
from armctl.control import CONTROLLERS
from armctl.core.tables import PIPE_COLUMNS, Table, folded
from armctl.model.loading.datasheets import ROWS
from armctl.run.links import plant_link


def run(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, str, str]:
    status = main(argv)
    out, err = capsys.readouterr()
    return status, out, err


def test_the_bundled_arm_reaches_the_green_target(capsys):
    status, out, err = run(capsys, "reach", BUNDLED)
    assert status == 0, err
    assert out.startswith("reached: the tip ended")
    assert "computed-torque" in out


def test_armctl_alone_prints_the_help(capsys):
    status, out, err = run(capsys)
    assert status == 0
    assert out.startswith("usage: armctl")
    assert "reach" in out
    assert not err


def test_a_mistyped_command_gets_a_suggestion(capsys):
    status, out, err = run(capsys, "simulat", BUNDLED)
    assert status == 2
    assert not out
    assert err == "armctl: unknown command 'simulat'; did you mean 'simulate'?\n"
    _, _, err = run(capsys, "xyz")
    assert "margins, tune, reachability" in err
    _, _, err = run(capsys, "reach", BUNDLED, "--contoller", "pd")
    assert err == "armctl: unknown option '--contoller'; did you mean '--controller'?\n"


@pytest.mark.parametrize(("typed", "completed"), [("armctl simu", {"simulate"}), ("armctl reach robot_arm_3", {BUNDLED})])
def test_the_shell_completes_commands_and_robots(tmp_path, typed: str, completed: set[str]):
    answer = tmp_path / "answer"
    asked = {
        "_ARGCOMPLETE": "1",
        "_ARGCOMPLETE_STDOUT_FILENAME": str(answer),
        "COMP_LINE": typed,
        "COMP_POINT": str(len(typed)),
    }
    subprocess.run(armctl_command(), env=os.environ | asked, timeout=120, check=True)
    assert {word.strip() for word in answer.read_text().split("\x0b")} == completed


def test_tables_and_long_lines_fit_a_terminal_and_lose_no_word():
    words = ["controller,", "delay", "margin", "and", "many", "more", "words"]
    table = Table([f"{word} of a column" for word in words], [[f"{k} {word}" for word in words] for k in range(3)])
    text = table.text(40)
    assert max(map(len, text.splitlines())) <= 40
    for row in table.rows:
        for cell in row:
            assert cell in text
    line = "  label       " + " ".join(words) + " " + " ".join(words)
    assert folded(line, 40).split() == line.split()
    assert all(len(each) <= 40 and each.startswith("  ") for each in folded(line, 40).splitlines())


def listed_controllers(capsys, command: str) -> list[str]:
    with pytest.raises(SystemExit):
        main([command, "--help"])
    _, _, listed = capsys.readouterr().out.partition("controllers:\n")
    return [line.split()[0] for line in listed.partition("\n\n")[0].splitlines()]


def test_the_help_lists_all_controllers(capsys):
    for command in ("reach", "compare", "iso9283", "margins", "view"):
        assert listed_controllers(capsys, command) == list(CONTROLLERS)


def test_the_help_of_tune_lists_those_that_it_takes(capsys):
    """A bound that no gains can satisfy is refused after the name: a design for each controller would take minutes."""
    arm = armctl.load(BUNDLED)
    listed = listed_controllers(capsys, "tune")
    assert "pd-gravity" in listed
    for name in CONTROLLERS:
        expected, match = (armctl.InputError, "peak_sensitivity") if name in listed else (armctl.UnknownNameError, name)
        with pytest.raises(expected, match=match):
            armctl.tune(arm, name, peak_sensitivity=0.5)


def test_messages_name_options_and_not_arguments_of_python():
    args = argparse.Namespace(robot="panda", tip=None, base=None, run=main)
    assert with_options("choose one with tip=: a, b", args) == "choose one with --tip: a, b"
    assert with_options("base=free moves it, tip=hand and tip_offset= too", args) == (
        "--base free moves it, --tip hand and tip_offset= too"
    )
    assert with_options("load it with tip='left/hand' now", args) == "load it with --tip 'left/hand' now"
    assert with_options("tip: no such body", args) == "--tip: no such body"
    assert with_options("robot: no such file", args) == "robot: no such file"


def test_json_has_the_same_keys_after_success_failure_and_wrong_calls(capsys):
    calls = {
        0: [["reach", BUNDLED], ["chains", BUNDLED], ["info", BUNDLED], ["doctor", BUNDLED]],
        1: [
            ["reach", BUNDLED, "--target", "2", "0", "0.35"],
            ["tune", BUNDLED, "pd", "--configurations", "1", "--delay-margin", "1"],
        ],
        2: [["reach", "pandaa"], ["study", "nothing.toml"], ["simulate", BUNDLED], ["info", BUNDLED, "--tp", "x"], ["mrgins"]],
    }
    for expected, lines in calls.items():
        for words in lines:
            status, out, err = run(capsys, *words, "--json")
            figures = json.loads(out)
            assert status == expected
            assert list(figures) == ["ok", "reason", "result"]
            assert figures["ok"] == (status == 0)
            assert bool(figures["reason"]) != figures["ok"]
            assert err == (f"armctl: {figures['reason']}\n" if status == 2 else "")


def test_a_menagerie_arm_reaches_a_target(capsys):
    if not at_hand("panda"):
        pytest.skip(f"panda: {MISSING}")
    status, out, _ = run(capsys, "reach", "panda", "--target", "0.5", "0.2", "0.4", "--json")
    figures = json.loads(out)
    assert status == 0
    assert figures["ok"]
    assert figures["result"]["final_tip_error_m"] < 1e-4


def test_a_robot_with_several_tips_reaches_a_target_for_each(capsys, tmp_path):
    left = limb("a b c p q r", '<site name="left" pos="0.1 0 0"/>')
    right = limb("d e f g h i", '<site name="right" pos="0 0.1 0"/>')
    file = tmp_path / "torso.xml"
    file.write_text(mjcf(limb("torso", left + right), motors("torso a b c p q r d e f g h i")))
    robot = armctl.load(file, tips=["left", "right"])
    q = robot.home + np.repeat([0.0, 0.4, 0.0], [1, 6, 6])
    target = [f"{x:.4f}" for x in robot.fk(q, "left").position]
    command = ["reach", str(file), "--tip", "left,right"]
    status, out, err = run(capsys, *command, "--target", "left", *target, "--target", "right", "stay", "--json")
    errors = json.loads(out)["result"]["tip_errors"]
    assert status == 0, err
    assert max(errors["left"][0], errors["right"][0]) < 1e-4
    status, out, _ = run(capsys, *command, "--target", "left", "0", "0", "99")
    assert status == 1
    assert "left is" in out
    for words, text in (
        ([], "has 2 tips; give a target for any of them: --target left x y z"),
        (["--target", *target], "expected the tip that it is for, left and right, before its numbers, got '"),
        (["--target", "left", *target, "--target", "left", "stay"], "'left' has two targets; give one"),
    ):
        status, _, err = run(capsys, *command, *words)
        assert status == 2
        assert text in err


def test_a_pose_is_six_numbers(capsys):
    status, out, _ = run(capsys, "reach", BUNDLED, "--target", "0.3", "0.2", "0.3", "0", "0", "0")
    assert status == 1
    assert "not reached" in out


def test_angles_in_degrees_are_refused_and_turned_into_radians(capsys):
    status, _, err = run(capsys, "reach", BUNDLED, "--target", "0.3", "0.2", "0.3", "0", "-180", "90")
    assert status == 2
    assert err == "armctl: --target: -180 rad is more than a turn; -180 degrees are -3.1416 rad\n"


def test_out_of_reach_exits_1_and_says_by_how_many_millimetres(capsys):
    status, out, _ = run(capsys, "reach", BUNDLED, "--target", "2", "0", "0.35")
    assert status == 1
    assert "out of reach by 1.45 m" in out
    status, out, _ = run(capsys, "reach", BUNDLED, "--target", "2", "0", "0.35", "--json")
    assert status == 1
    assert json.loads(out)["ok"] is False


def test_reach_goes_around_what_stands_in_the_cell_and_refuses_what_it_cannot_reach(capsys, tmp_path):
    cell = tmp_path / "cell.xml"
    post = '<body name="post" pos="0.3 0.12 0.15"><geom type="box" size="0.02 0.02 0.15"/></body>'
    cell.write_text(f"<mujoco><worldbody>{post}</worldbody></mujoco>")
    straight = armctl.Simulation(armctl.load(BUNDLED, scene=cell)).move_to([0.3, 0.3, 0.2], avoid=False)
    assert "touched post" in straight.reason
    status, out, err = run(capsys, "reach", BUNDLED, "--scene", str(cell), "--target", "0.3", "0.3", "0.2")
    assert status == 0, err
    assert "touched" not in out
    status, out, _ = run(capsys, "reach", BUNDLED, "--scene", str(cell), "--target", "0.3", "0.12", "0.2")
    assert status == 1
    assert "the goal cannot be reached without contact: link3 is 50.0 mm inside post" in out
    into = ("reach", BUNDLED, "--scene", str(cell), "--target", "0.3", "0.12", "0.29")
    _, out, _ = run(capsys, *into, "--allow", "link3,post", "--allow", "link2,post")
    assert "without contact" not in out
    assert "link3 touched post" in out
    status, _, err = run(capsys, *into, "--allow", "post")
    assert status == 2
    assert err == "armctl: --allow: expected two names with a comma between them, such as cube,table, got 'post'\n"


def test_a_controller_that_sags_exits_1(capsys, monkeypatch):
    monkeypatch.setitem(CONTROLLERS, "pd", replace(CONTROLLERS["pd"], arguments={"bandwidth": 10.0}))
    status, out, _ = run(capsys, "reach", BUNDLED, "--controller", "pd")
    assert status == 1
    assert out.startswith("not reached")


def test_save_writes_the_log_the_figures_and_the_plot(capsys, tmp_path):
    status, _, err = run(capsys, "reach", BUNDLED, "--out", str(tmp_path / "run"))
    assert status == 0
    assert sorted(p.name for p in (tmp_path / "run").iterdir()) == ["log.csv", "log.npz", "plot.pdf", "plot.png", "report.json"]
    assert err.count("wrote") == 5
    assert json.loads((tmp_path / "run" / "report.json").read_text())["ok"]


def test_simulate_holds_the_controls_and_plots(capsys, tmp_path):
    status, out, _ = run(
        capsys, "simulate", BUNDLED, "--ctrl", "0.5", "-0.3", "-0.2", "--duration", "2", "--out", str(tmp_path)
    )
    assert status == 0
    assert "shoulder_yaw" in out
    assert "after 2.000 s the tip is at" in out
    assert sorted(p.name for p in tmp_path.iterdir()) == ["log.csv", "log.npz", "plot.pdf", "plot.png"]
    run(capsys, "simulate", BUNDLED, "--ctrl", "0", "0", "0", "--duration", "0.1", "--out", str(tmp_path / "mine.svg"))
    assert (tmp_path / "mine.svg").is_file()


def test_the_version_is_the_packages(capsys):
    with pytest.raises(SystemExit, match="0"):
        run(capsys, "--version")
    assert capsys.readouterr().out == f"armctl {armctl.__version__}\n"


def test_info_names_joints_limits_and_sources(capsys):
    status, out, _ = run(capsys, "info", BUNDLED)
    assert status == 0
    assert "shoulder_pitch" in out
    assert "tau_max from: ctrlrange" in out
    assert "kg at the tip of an arm of 2.4 kg: they are too strong" in out
    assert "tip: the origin of body 'ee_body'" in out
    _, out, _ = run(capsys, "info", BUNDLED, "--json")
    assert json.loads(out)["result"]["limits"]["tau_max"] == [250.0, 250.0, 150.0]


def test_info_prints_where_the_tip_is_on_its_body(capsys, tmp_path: Path):
    file = tmp_path / "arm.xml"
    file.write_text("""<mujoco><worldbody><body><joint name="a" axis="0 1 0" range="-90 90"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0.3 0 0"/><body name="forearm" pos="0.3 0 0">
      <joint name="b" axis="0 1 0" range="-90 90"/><geom type="capsule" size="0.02" fromto="0 0 0 0.2 0 0"/>
      <site name="tool" pos="0.24 0 -0.07"/></body></body></worldbody>
      <actuator><motor joint="a" ctrlrange="-20 20"/><motor joint="b" ctrlrange="-20 20"/></actuator></mujoco>""")
    _, out, _ = run(capsys, "info", str(file))
    assert "tip: 250.0 mm from the origin of body 'forearm', at [0.2400, 0.0000, -0.0700] m in its frame" in out
    _, out, _ = run(capsys, "info", str(file), "--json")
    found = json.loads(out)["result"]
    assert found["tip_body"] == "forearm"
    assert found["tip_offset"] == pytest.approx([0.24, 0.0, -0.07])


def test_an_arm_whose_joints_bear_no_weight_holds_any_payload(capsys, tmp_path: Path):
    file = tmp_path / "planar.urdf"
    file.write_text(urdf(FIRST, SECOND, THIRD, TOOL).replace("0 1 0", "0 0 1"))
    _, out, _ = run(capsys, "info", str(file))
    assert "static payload at the tip: not limited" in out
    _, out, _ = run(capsys, "info", str(file), "--json")
    assert json.loads(out, parse_constant=pytest.fail)["result"]["static_payload_kg"] is None


def test_every_command_has_examples_that_its_parser_takes():
    parser = command_parser()
    for command in parser.known:
        examples = parser.parse_args(_least(command)).examples
        assert examples
        for example in examples:
            assert parser.parse_args([command, *example.split()]).run


def _least(command: str) -> list[str]:
    """The fewest words that a command takes."""
    words = {
        "robots": [],
        "allow": [],
        "identify": ["panda", "run.csv"],
        "simulate": ["panda", "--ctrl", "0"],
        "robot": ["check", "host"],
        "ros2": ["serve", "panda"],
    }
    return [command, *words.get(command, ["panda", "pd"] if command == "tune" else ["panda"])]


def test_tables_use_the_width_of_the_terminal(monkeypatch: pytest.MonkeyPatch):
    table = Table(["name", *(f"column {i}" for i in range(20))], [["row", *map(str, range(20))]])
    assert max(map(len, table.text().splitlines())) <= PIPE_COLUMNS
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "140")
    assert PIPE_COLUMNS < max(map(len, table.text().splitlines())) <= 140


def test_robots_lists_every_name(capsys):
    status, out, _ = run(capsys, "robots")
    assert status == 0
    names = [line.split()[0] for line in out.splitlines()]
    assert {BUNDLED, "panda", "ur5e", "iiwa14", "xarm7", "gen3", "so_arm100"} <= set(names)
    assert names == [BUNDLED, *sorted(set(names) - {BUNDLED})]
    _, listed, _ = run(capsys, "robots", "--json")
    assert [row["name"] for row in json.loads(listed)["result"]] == [line.split()[0] for line in out.splitlines()]


def test_robots_tells_which_are_on_this_machine(capsys, tmp_path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "franka_emika_panda").mkdir()
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    _, out, _ = run(capsys, "robots")
    here = {line.split()[0] for line in out.splitlines() if line.endswith("[on this machine]")}
    assert here == {BUNDLED, "panda"}


def test_ratings_have_a_payload_a_reach_and_a_source_for_each_data_sheet(capsys):
    status, out, _ = run(capsys, "robots", "--ratings")
    assert status == 0
    assert max(map(len, out.splitlines())) <= PIPE_COLUMNS
    ratings, sources = out.split("\n\n")
    rows = [line.split() for line in ratings.splitlines()[3:]]
    assert ["franka_emika_panda", "3", "0.855"] in [cells[:3] for cells in rows]
    assert {cells[0] for cells in rows if len(cells) > 2} == set(ROWS)
    assert [line.split()[0] for line in sources.splitlines()[2:] if not line.startswith(" ")] == [cells[0] for cells in rows]


def test_reachability_is_printed_saved_and_drawn(capsys, tmp_path):
    files = ["--out", str(tmp_path / "reach.npz"), "--out", str(tmp_path / "reach.png")]
    status, out, err = run(capsys, "reachability", BUNDLED, "--spacing", "0.3", *files)
    assert status == 0
    found = armctl.Reachability.load(tmp_path / "reach.npz")
    assert out.strip() == str(found)
    assert (tmp_path / "reach.png").stat().st_size > 1000
    assert "wrote" in err
    status, out, _ = run(capsys, "reachability", BUNDLED, "--spacing", "0.3", "--json")
    assert json.loads(out)["result"] == found.to_dict()


@pytest.mark.full
def test_margins_are_a_table_and_a_page(capsys, tmp_path):
    chosen = ("--controllers", "pd,pd-gravity", "--configurations", "3", "--timestep", "0.002")
    status, out, err = run(capsys, "margins", BUNDLED, *chosen, "--out", str(tmp_path))
    assert status == 0, err
    assert [line.split()[0] for line in out.splitlines()[-2:]] == ["pd", "pd-gravity"]
    page = (tmp_path / "margins.html").read_text()
    assert page.count("<svg") == 2
    status, out, _ = run(capsys, "margins", BUNDLED, *chosen, "--json")
    for figures in json.loads(out)["result"]:
        again = armctl.margins(armctl.load(BUNDLED), figures["controller"], 3, [armctl.Plant(timestep=0.002)])
        assert figures["delay"]["value"] == again.delay.value


@pytest.mark.nightly
def test_compare_shows_every_controller(capsys):
    status, out, _ = run(capsys, "compare", BUNDLED, "--controllers", "all")
    assert status == 0
    assert max(map(len, out.splitlines())) <= PIPE_COLUMNS
    for controller in CONTROLLERS:
        assert f"\n{controller} " in out


BROKEN = "<mujoco><worldbody><body></worldbody></mujoco>"
WRONG_CALLS = {
    "no speed": (["reach", BUNDLED, "--speed", "0"], "speed: expected a fraction in (0, 1], got 0"),
    "too fast": (["compare", BUNDLED, "--speed", "1.5"], "speed: expected a fraction in (0, 1], got 1.5"),
    "a word as speed": (["iso9283", BUNDLED, "--speed", "fast"], "--speed: 'fast' is not a number"),
    "no film": (["reach", BUNDLED, "--out", "x.avi"], "--out: 'x.avi' ends in '.avi', expected .npz, .csv, "),
    "no picture": (["simulate", BUNDLED, "--ctrl", "0", "0", "0", "--out", "x.bmp"], "--out: 'x.bmp' ends in '.bmp'"),
    "negative mass": (
        ["compare", BUNDLED, "--plants", "mass=-1"],
        "plant mass=-1: mass_scale: expected",
    ),
    "unknown robot": (["reach", "pandaa"], "unknown robot 'pandaa'; did you mean 'panda'?"),
    "short target": (
        ["reach", BUNDLED, "--target", "0.3", "0.2"],
        "target: expected x y z or x y z roll pitch yaw, got 2 numbers",
    ),
    "NaN target": (["reach", BUNDLED, "--target", "nan", "0", "0"], "target: element [0] is nan"),
    "word as target": (
        ["reach", BUNDLED, "--target", "here", "0", "0"],
        "target: here 0 0 is not a list of numbers; write them with spaces",
    ),
    "unknown controller": (["reach", BUNDLED, "--controller", "pdd"], "unknown controller 'pdd'; did you mean 'pd'?"),
    "no such file": (["reach", "nothing.xml"], "nothing.xml: no such file"),
    "negative time": (
        ["simulate", BUNDLED, "--ctrl", "1", "1", "1", "--duration", "-1"],
        "duration: expected a number at least 0, got -1",
    ),
    "control out of range": (["simulate", BUNDLED, "--ctrl", "1", "1", "9"], "ctrl: elbow: 9 is outside [-5, 5]"),
    "no controllers": (["compare", BUNDLED, "--controllers", ""], "expected a list of at least one of each"),
    "no plants": (["compare", BUNDLED, "--plants", ","], "expected a list of at least one of each"),
    "no folder": (["compare", BUNDLED, "--out", "/dev/null/x"], "/dev/null/x: Not a directory"),
    "a plant that is a robot": (
        ["compare", BUNDLED, "--robot", "host", "--plants", "friction"],
        "plants: a robot is what it is",
    ),
    "several plants at once": (
        ["compare", BUNDLED, "--robot", "x", "--link", "plant", "--plants", "nominal,friction"],
        "plants: a simulated robot is one plant, got 2",
    ),
    "gains for no robot": (["compare", BUNDLED, "--robot", "host", "--delay-margin", "0.01"], "--delay-margin: on a robot"),
    "nothing to identify": (["compare", BUNDLED, "--identify"], "identify: it is for a robot; give --robot HOST"),
    "a load of no robot": (
        ["compare", BUNDLED, "--payload", "2"],
        "payload: it is for a robot; give --robot HOST; --plants simulates a load",
    ),
    "a link of no robot": (["compare", BUNDLED, "--link", "plant"], "link: it is for a robot; give --robot HOST"),
    "unknown tip": (["reach", BUNDLED, "--tip", "end_efector"], "did you mean 'end_effector'?"),
}


@pytest.mark.parametrize(("argv", "sentence"), WRONG_CALLS.values(), ids=WRONG_CALLS)
def test_a_wrong_call_exits_2_with_one_sentence(capsys, argv: list[str], sentence: str):
    status, out, err = run(capsys, *argv)
    assert status == 2
    assert out == ""
    assert err.startswith("armctl: ")
    assert sentence in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (BROKEN, "MuJoCo cannot read it"),
        ("not xml at all", "MuJoCo cannot read it"),
        ("<mujoco/>", "no arm: the model has no joints"),
        ("<mujoco><worldbody><body><joint type='ball'/><geom size='.1'/></body></worldbody></mujoco>", "has an actuator"),
        ("<mujoco><worldbody><body><freejoint name='f'/><geom size='.1'/></body></worldbody></mujoco>", "no arm"),
    ],
)
def test_a_model_that_is_no_arm_exits_2_with_one_sentence(capsys, tmp_path, text: str, sentence: str):
    path = tmp_path / "model.xml"
    path.write_text(text)
    status, _, err = run(capsys, "info", str(path))
    assert status == 2
    assert sentence in err
    assert err.count("\n") == 1
    assert "Traceback" not in err


def test_no_network_and_no_models_says_what_to_set_or_run(tmp_path):
    code = "import sys; from armctl.cli.main import main; sys.exit(main(['info', 'panda']))"
    env = {"PATH": "/usr/bin", "MENAGERIE_CACHE_DIR": str(tmp_path), "MENAGERIE_BASE_URL": "file:///nowhere"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env | _paths())
    assert done.returncode == 2
    assert "mujoco-menagerie prefetch franka_emika_panda" in done.stderr
    assert "MENAGERIE_ROOT" in done.stderr
    assert done.stderr.count("\n") == 1


def test_help_is_there_without_heavy_imports():
    code = (
        "import sys\nfrom armctl.cli.main import main\ntry: main(['--help'])\n"
        "finally: assert not {'numpy', 'mujoco', 'pinocchio'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=_paths())
    assert done.returncode == 0, done.stderr
    for command in ("robots", "info", "reach", "compare", "simulate"):
        assert command in done.stdout


def _paths() -> dict[str, str]:
    return {"PYTHONPATH": ":".join(sys.path)}


@pytest.mark.full
def test_compare_writes_a_report_on_the_plants_asked_for(capsys, tmp_path):
    chosen = ("--controllers", "pd,computed-torque", "--plants", "nominal,payload=1")
    status, out, _ = run(capsys, "compare", BUNDLED, *chosen, "--out", str(tmp_path), "--threads", "1", "--json")
    assert status == 0
    assert [(r["controller"], r["plant"]) for r in json.loads(out)["result"]][-1] == ("computed-torque", "payload 1 kg")
    assert {f"comparison.{ending}" for ending in ("html", "json", "md")} <= {path.name for path in tmp_path.iterdir()}


@pytest.mark.nightly
def test_compare_tunes_controllers_to_one_delay_margin(capsys):
    chosen = ("--controllers", "computed-torque,computed-torque-textbook", "--configurations", "2", "--threads", "1")
    _, out, _ = run(capsys, "compare", BUNDLED, *chosen, "--json")
    default = json.loads(out)["result"][0]
    _, out, _ = run(capsys, "compare", BUNDLED, *chosen, "--delay-margin", "0.005", "--json")
    tuned = json.loads(out)["result"][0]
    assert 5.0 <= 1e3 * tuned["delay_margin_s"] < 0.6e3 * default["delay_margin_s"]
    _, out, _ = run(capsys, "compare", BUNDLED, *chosen, "--delay-margin", "0.005")
    assert out.startswith("computed-torque-textbook has its default gains: it has no gains to tune")


@pytest.mark.nightly
def test_compare_saves_every_run_in_files_of_its_own(capsys, tmp_path):
    plants = "friction=0.01,friction=0.05"
    status, _, err = run(capsys, "compare", BUNDLED, "--plants", plants, "--out", str(tmp_path), "--threads", "1")
    assert status == 0
    assert len(list(tmp_path.iterdir())) == err.count("wrote") == 23


@pytest.mark.full
def test_half_the_speed_takes_twice_as_long(capsys):
    times = []
    for speed in ("1", "0.5"):
        status, out, err = run(capsys, "compare", BUNDLED, "--dwell", "0", "--speed", speed, "--json")
        assert status == 0, err
        times.append(json.loads(out)["result"][0]["duration_s"])
    assert times[1] == pytest.approx(2 * times[0], abs=0.01)


def test_reach_moves_an_arm_that_differs_from_its_model(capsys):
    reached, exact, _ = run(capsys, "reach", BUNDLED, "--controller", "pd-gravity", "--json")
    missed, loaded, _ = run(capsys, "reach", BUNDLED, "--controller", "pd-gravity", "--plant", "payload=2", "--json")
    assert (reached, missed) == (0, 1)
    assert json.loads(loaded)["result"]["tip_rms_m"] > 2 * json.loads(exact)["result"]["tip_rms_m"]
    assert json.loads(loaded)["result"]["plant"] == "payload 2 kg"
    status, _, err = run(capsys, "reach", BUNDLED, "--plant", "paylod=2")
    assert status == 2
    assert "unknown plant 'paylod'; did you mean 'payload'?" in err


def test_reach_takes_a_speed(capsys):
    durations = []
    for speed in ("1", "0.5"):
        status, out, err = run(capsys, "reach", BUNDLED, "--speed", speed, "--json")
        assert status == 0, err
        durations.append(json.loads(out)["result"]["duration_s"])
    assert durations[1] > 1.5 * durations[0]


@pytest.mark.full
def test_compare_on_a_robot_shows_it_beside_its_simulation(capsys, monkeypatch, tmp_path):
    simulated = plant_link.PlantLink
    monkeypatch.setattr(plant_link, "PlantLink", lambda *given, **more: simulated(*given, **(more | {"real_time": False})))
    chosen = ["--robot", "here", "--link", "plant", "--plants", "mass=1.2", "--timestep", "0.004", "--speed", "0.5"]
    quick = ["--tip-speed", "1", "--configurations", "0", "--dwell", "0.1", "--controllers", "mpc,pd-gravity"]
    status, out, _ = run(capsys, "compare", BUNDLED, *chosen, *quick, "--json", "--out", str(tmp_path))
    assert status == 0
    rows = json.loads(out)["result"]
    found = [(row["controller"], row["plant"], row["outcome"]) for row in rows]
    assert found[0] == ("mpc", f"robot: simulated {BUNDLED}", "not run")
    assert [each[:2] for each in found[1:]] == [("pd-gravity", f"robot: simulated {BUNDLED}"), ("pd-gravity", "simulation")]
    assert rows[1]["joint_rms_rad"] > 0.0
    assert len(list(tmp_path.glob("pd-gravity-*log.npz"))) == 2


def test_compare_refuses_what_it_does_not_know(capsys):
    assert run(capsys, "compare", BUNDLED, "--plants", "paylod=1")[0] == 2
    assert run(capsys, "compare", BUNDLED, "--controllers", "pdd")[0] == 2


def test_iso9283_prints_the_figures_with_units(capsys):
    status, out, _ = run(capsys, "iso9283", BUNDLED, "--cycles", "2", "--plant", "payload=0.5+noise", "--identify")
    assert status == 0
    assert "pose accuracy AP" in out
    assert "8.6 path velocity" in out
    assert " um" in out


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_a_full_disk_behind_the_output_is_one_sentence():
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "armctl", "robots"]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, env=os.environ | _paths())
    assert done.returncode == 2
    assert done.stderr == "armctl: output: No space left on device\n"


@pytest.mark.skipif(os.name != "posix", reason="limits of POSIX")
def test_a_full_disk_names_the_file(tmp_path):
    code = (
        "import resource, sys\nfrom armctl.cli.main import main\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (4000, resource.RLIM_INFINITY))\n"
        "sys.exit(main(sys.argv[1:]))"
    )
    command = [sys.executable, "-c", code, "reach", BUNDLED, "--out", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | _paths())
    assert done.returncode == 2
    assert done.stderr == f"armctl: {tmp_path / 'log.npz'}: cannot be written: File too large\n"
    assert list(tmp_path.iterdir()) == []


def test_a_reader_that_leaves_early_is_no_error():
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "armctl", "robots"]
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, env=os.environ | _paths())
    os.close(writing)
    assert done.returncode == 0
    assert done.stderr == b""


def test_every_command_that_loads_an_arm_takes_an_srdf(capsys, tmp_path: Path):
    robot = urdf(FIRST, SECOND, THIRD, TOOL)
    (tmp_path / "robot.urdf").write_text(robot)
    group = '<group name="short"><chain base_link="base" tip_link="one"/></group>'
    (tmp_path / "other.srdf").write_text(f'<robot name="r">{group}</robot>')
    options = [str(tmp_path / "robot.urdf"), "--srdf", str(tmp_path / "other.srdf"), "--tip", "short"]
    status, out, err = run(capsys, "info", *options)
    assert status == 0, err
    assert "one" in out
    assert "j2" not in out


def test_an_interrupt_that_python_cannot_raise_is_raised_soon_after():
    code = (
        "import signal, sys, time\nfrom armctl.cli import unraisable_hook\n"
        "sys.unraisablehook = unraisable_hook\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "class Interrupted:\n    def __del__(self): raise KeyboardInterrupt\n"
        "try:\n    Interrupted()\n    time.sleep(1000)\nexcept KeyboardInterrupt:\n    print('interrupted')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=100)
    assert (done.stdout, done.stderr) == ("interrupted\n", "")


def test_an_interrupt_waits_until_modules_are_imported(tmp_path):
    (tmp_path / "slow.py").write_text(
        "import os, signal, time\nos.kill(os.getpid(), signal.SIGINT)\ntime.sleep(0.1)\nprint('imported')\n"
    )
    code = (
        "import signal, time\nfrom armctl.cli import interrupt\nsignal.signal(signal.SIGINT, interrupt)\n"
        "try:\n    import slow\n    time.sleep(1000)\nexcept KeyboardInterrupt:\n    print('interrupted')\n"
    )
    paths = {"PYTHONPATH": f"{tmp_path}:{_paths()['PYTHONPATH']}"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=os.environ | paths, timeout=100)
    assert (done.stdout, done.stderr) == ("imported\ninterrupted\n", "")


def test_an_interrupt_that_python_wraps_in_another_error_ends_the_program():
    code = """
import armctl.cli.main

class Interrupted:
    def __set_name__(self, owner, name):
        raise KeyboardInterrupt

def main():
    class Axis:
        attribute = Interrupted()

armctl.cli.main.main = main
raise SystemExit(armctl.cli.program())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=os.environ | _paths())
    assert (done.returncode, done.stderr) == (130, "")


def test_all_speeds_of_iso9283_are_fractions_of_the_given_one(capsys, monkeypatch):
    speeds = []

    def measured(*_, speed, **__):
        speeds.append(speed)
        return SimpleNamespace(reason="", to_dict=lambda: {"speed": speed})

    monkeypatch.setattr("armctl.lab.iso9283.iso9283_cycles", measured)
    status, _, _ = run(capsys, "iso9283", BUNDLED, "--all-speeds", "--speed", "0.4")
    assert status == 0
    assert speeds == pytest.approx([0.4, 0.2, 0.04])
