"""Objects show themselves in a few lines, and signatures show every argument."""

import inspect
from functools import partial

import numpy as np
import pytest
from arms import arm_of, some_of

import armctl
from armctl.control import CONTROLLERS
from armctl.core.faces import face, value_text


@pytest.fixture(scope="module")
def arm() -> armctl.Arm:
    return arm_of("robot_arm_3dof")


@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_controller_shows_its_class_and_its_gains_in_one_line(arm, name):
    text = repr(CONTROLLERS[name](arm))
    assert "\n" not in text
    assert "object at" not in text
    assert "=" in text
    assert text.startswith(type(CONTROLLERS[name](arm)).__name__ + "(")


def test_gains_are_shown_as_they_are(arm):
    assert repr(armctl.PD(arm, stiffness=[100.0, 200.0, 300.0], damping=5)).startswith(
        "PD(stiffness=[100, 200, 300], damping=5"
    )
    assert "stiffness=100" in repr(armctl.Impedance(arm, stiffness=100.0))
    assert "stiffness=later" in repr(armctl.Impedance(arm, stiffness=later))
    notched = armctl.TorqueFilter(arm, armctl.PD(arm, stiffness=1.0, damping=2.0), [armctl.Notch(50.0, 1.0)])
    assert repr(notched).startswith("TorqueFilter(controller=PD(stiffness=1, damping=2")
    assert repr(armctl.HandGuiding(arm)) == "HandGuiding(friction_share=0.7)"


def later(t: float) -> float:
    return 50.0 + t


def test_a_plant_shows_what_differs():
    assert repr(armctl.Plant()) == "Plant()"
    assert (
        repr(armctl.Plant(delay=2, elasticity=[0, 300, 0], name="worn"))
        == "Plant(elasticity=[0, 300, 0], delay=2, name='worn')"
    )


def test_simulations_scenes_and_streams_show_themselves_in_one_line(arm):
    scene = armctl.World().add("table", armctl.Box([1, 1, 0.1]), [2, 0, 0])
    assert repr(scene) == "World(table)"
    for i in range(10):
        scene.add(f"ball{i}", armctl.Ball(0.1), [3, 0, i])
    assert repr(scene).endswith("ball4 and 5 more)")
    sim = armctl.Simulation(arm, "pd", armctl.Plant(delay=1))
    assert repr(sim) == "Simulation('robot_arm_3dof', 'pd', plant: delay 1, t = 0 s)"
    with sim.streaming() as run:
        assert repr(run) == f"StreamRun({arm.tip!r}, t = 0 s)"
    assert repr(run).endswith("not running)")


def test_a_gripper_shows_its_width(load_gripper):
    sim = armctl.Simulation(load_gripper)
    assert repr(sim.gripper).startswith("Gripper(")
    assert f"at most {1e3 * sim.gripper.width_max:.3g} mm" in repr(sim.gripper)


@pytest.fixture
def load_gripper(tmp_path) -> armctl.Arm:
    from synthetic import arm_with_gripper

    return armctl.load(arm_with_gripper(tmp_path))


def test_loops_margins_and_comparisons_take_ten_lines_and_a_table_in_a_notebook(arm):
    loop = armctl.linearize(arm, "pd", arm.home, armctl.Plant(delay=2))
    margins = armctl.margins(arm, "pd", 2)
    motion = armctl.move_j(arm, arm.home, arm.home + 0.1)
    plants = [armctl.Plant(payload=0.01 * k) for k in range(12)]
    comparison = armctl.compare(arm, ["pd"], motion, plants, configurations=1, dwell=0.1)
    own = armctl.LinearLoop(A=np.eye(1) * 0.9, B=np.eye(1), C=np.eye(1) * 0.1, D=np.zeros((1, 1)), dt=0.01)
    for thing in (loop, margins, comparison, own):
        assert 2 <= len(repr(thing).splitlines()) <= 10
        assert "<table" in thing._repr_html_()
    assert "delay margin" in repr(loop)
    assert str(loop.margins()) in repr(loop)
    assert repr(comparison).endswith("and 4 more")
    unstable = armctl.linearize(arm, armctl.PD(arm, stiffness=1e5, damping=1.0), arm.home, armctl.Plant(delay=5))
    assert "unstable" in repr(unstable)
    assert "unstable" in repr(armctl.margins(arm, armctl.PD(arm, stiffness=1e5, damping=1.0), 1, [armctl.Plant(delay=5)]))
    for curves in (loop.bode(), loop.nyquist(), loop.step_response()):
        assert "\n" not in repr(curves)
        assert len(repr(curves)) < 200


def test_every_public_call_shows_its_arguments():
    hidden = []
    for name in dir(armctl):
        value = getattr(armctl, name)
        calls = {name: value}
        if inspect.isclass(value):
            calls |= {f"{name}.{key}": each for key, each in vars(value).items() if inspect.isfunction(each) and key[0] != "_"}
        for call, each in calls.items():
            is_ours = getattr(each, "__module__", "").startswith("armctl.") and callable(each)
            if not is_ours or (inspect.isclass(each) and (issubclass(each, (dict, Exception)) or is_protocol(each))):
                continue
            hidden += [call for p in inspect.signature(each).parameters.values() if p.kind is p.VAR_KEYWORD]
    assert not hidden


def is_protocol(cls: type) -> bool:
    return getattr(cls, "_is_protocol", False)


def test_the_defaults_in_a_signature_are_those_of_the_call(arm):
    shown = inspect.signature(armctl.move_l).parameters
    defaults = {name: each.default for name, each in shown.items() if each.kind is each.KEYWORD_ONLY}
    assert list(defaults) == ["speed", "tip_speed", "tip_angular_speed", "duration"]
    goal = arm.fk(arm.home + 0.1).position
    given = armctl.move_l(arm, arm.home, goal, **defaults)
    assert given.duration == armctl.move_l(arm, arm.home, goal).duration
    assert "payload" in inspect.signature(armctl.Plant).parameters
    assert "stiffness" in armctl.PD.__signature__.parameters
    own = type("Mine", (armctl.PD,), {"__init__": lambda self, arm, speed=1.0: None})
    assert list(inspect.signature(own).parameters) == ["arm", "speed"]


def test_a_wrong_call_names_the_public_class(arm):
    with pytest.raises(TypeError, match=r"^Simulation\.move_to\(\) got an unexpected keyword argument 'sped'"):
        armctl.Simulation(arm).move_to([0.3, 0.2, 0.3], sped=1.0)
    assert armctl.Robot.move_to.__qualname__ == "Robot.move_to"
    assert armctl.Simulation.move_to.__doc__ == armctl.Robot.move_to.__doc__


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (True, "True"),
        ("word", "'word'"),
        (1 / 3, "0.3333"),
        (np.full(3, 2.0), "2"),
        (np.array([1.0, 2.5]), "[1, 2.5]"),
        (np.arange(12.0), "array of 12"),
        (np.arange(4.0).reshape(2, 2), "array of 2 x 2"),
        (object(), "object"),
    ],
)
def test_a_value_is_shown_in_a_few_characters(value, text):
    assert value_text(value) == text
    assert face(3, x=value) == f"int(x={text})"


def test_figures_have_fonts_that_journals_accept_and_text_that_can_be_edited(arm, tmp_path):
    bode = armctl.linearize(arm, "pd", arm.home).bode()
    assert "<text" in bode.plot(tmp_path / "bode.svg").read_text()
    pdf = bode.plot(tmp_path / "bode.pdf").read_bytes()
    assert b"/Type3" not in pdf
    assert b"/CIDFontType2" in pdf or b"/Subtype /Type0" in pdf


def test_a_figure_for_a_paper_has_no_title_inside(arm, tmp_path):
    from armctl.report.plot import four_panels

    loop = armctl.linearize(arm, "pd", arm.home)
    sim = armctl.Simulation(arm, "pd")
    sim.move_to(arm.fk(arm.home + 0.1).position)
    for plot in (loop.plot, armctl.Report.from_log(sim.log).plot, lambda *args, **how: four_panels(sim.log, *args, **how)):
        assert "robot_arm_3dof, pd" in plot(tmp_path / "titled.svg").read_text()
        text = plot(tmp_path / "plain.svg", size=(6.0, 4.0), title=False).read_text()
        assert "robot_arm_3dof" not in text
        assert 'width="432pt"' in text  # 6 inches
    small = armctl.overlay([sim.log], tmp_path / "overlay.svg", size=(3.0, 3.0)).read_text()
    assert 'width="216pt"' in small


# Every public plot, which a function of an arm and of the result of a study makes, and the number of its axes.
PLOTS = {
    "motion": (lambda arm, _: armctl.move_j(arm, arm.home, arm.home + 0.1).plot, 4),
    "reachability": (lambda arm, _: armctl.reachability(arm, spacing=0.3, orientations=0).plot, 3),
    "quantiles": (lambda _, finished: finished.plot_quantiles, 1),
    "tornado": (lambda _, finished: finished.plot_tornado, 2),
    "success": (lambda _, finished: finished.plot_success, 2),
    "response": (lambda arm, _: armctl.frequency_response(arm, "pd", arm.home, 0).plot, 2),
    "report": (lambda arm, _: armctl.Report.from_log(moved(arm)).plot, 4),
    "four panels": (lambda arm, _: partial(armctl.four_panels, moved(arm)), 4),
    "overlay": (lambda arm, _: partial(armctl.overlay, [moved(arm)]), 2),
    "loop": (lambda arm, _: armctl.linearize(arm, "pd", arm.home).plot, 6),
    "bode": (lambda arm, _: armctl.linearize(arm, "pd", arm.home).bode().plot, 2),
    "nyquist": (lambda arm, _: armctl.linearize(arm, "pd", arm.home).nyquist().plot, 1),
    "step": (lambda arm, _: armctl.linearize(arm, "pd", arm.home).step_response().plot, 1),
}


def moved(arm: armctl.Arm) -> armctl.Log:
    sim = armctl.Simulation(arm, "pd")
    sim.move_to(arm.fk(arm.home + 0.1).position)
    assert sim.log is not None
    return sim.log


@pytest.mark.parametrize("name", some_of(PLOTS, {"motion", "reachability", "tornado", "response"}, full=PLOTS))
def test_every_plot_has_a_size_and_fonts_for_papers_and_takes_axes(arm, finished, name, tmp_path):
    from matplotlib.figure import Figure

    make, count = PLOTS[name]
    plot = make(arm, finished)
    plot(tmp_path / "figure.svg", size=(6.0, 4.0))
    text = (tmp_path / "figure.svg").read_text()
    assert 'width="432pt"' in text  # 6 inches
    assert "<text" in text
    plot(tmp_path / "figure.pdf")
    pdf = (tmp_path / "figure.pdf").read_bytes()
    assert b"/Type3" not in pdf
    assert b"/Subtype /Type0" in pdf
    axes = Figure().subplots(count, 1, squeeze=False)[:, 0]
    plot(ax=axes)
    assert all(each.has_data() for each in axes)
    with pytest.raises(armctl.InputError, match=f"ax: expected {count} axes of matplotlib"):
        plot(ax=Figure().subplots(7))
    with pytest.raises(armctl.InputError, match="path, ax: give one of them"):
        plot(tmp_path / "other.svg", ax=axes)
    with pytest.raises(armctl.InputError, match=r"size: expected .*got 600"):
        plot(tmp_path / "other.svg", size=(600, 400))
    assert not (tmp_path / "other.svg").exists()


@pytest.mark.parametrize(
    ("name", "words"), [("response", ", sensitivity"), ("quantiles", "median, and bands"), ("tornado", "from the low")]
)
def test_what_a_caption_says_can_be_left_out_of_a_figure(arm, finished, name, words, tmp_path):
    plot = PLOTS[name][0](arm, finished)
    for title in (True, False):
        plot(tmp_path / "figure.svg", title=title)
        assert (words in (tmp_path / "figure.svg").read_text()) == title


def test_a_motion_is_drawn_with_fonts_that_journals_accept(arm, tmp_path):
    armctl.move_j(arm, arm.home, arm.home + 0.1).plot(tmp_path / "motion.pdf")
    assert b"/Type3" not in (tmp_path / "motion.pdf").read_bytes()


def test_the_width_of_a_figure_is_as_given(arm, tmp_path):
    step = armctl.linearize(arm, "pd", arm.home).step_response()
    text = step.plot(tmp_path / "step.svg", size=(3.0, 2.0)).read_text()
    assert 'width="216pt"' in text  # 3 inches
    assert 'height="144pt"' in text
