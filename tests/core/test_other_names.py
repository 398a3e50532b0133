"""Names of other libraries: the error says what armctl calls the same thing."""

import copy
import pickle
import re

import numpy as np
import pytest
from arms import arm_of

import armctl
from armctl.core.units import above_text, length_text


@pytest.mark.parametrize(("name", "use"), [("q", "sim.state.q"), ("open_gripper", "sim.gripper.open()")])
def test_a_missing_attribute_of_a_simulation_names_what_to_use(name: str, use: str):
    with pytest.raises(AttributeError, match=f"^Simulation has no attribute '{name}'; use ") as info:
        getattr(armctl.Simulation(arm_of("robot_arm_3dof")), name)
    assert str(info.value).endswith(use)


def test_every_hint_names_something_that_exists():
    arm = arm_of("robot_arm_3dof")
    sim = armctl.Simulation(arm)
    sim.move_to(arm.fk(arm.home).position)
    for thing, letters in ((sim, "sim"), (arm, "arm"), (sim.log, "log")):
        hints = type(thing).__getattr__.__closure__[0].cell_contents
        for name, hint in hints.items():
            assert not hasattr(type(thing), name), name
            first = hint.split(",")[0].split("(")[0]
            value = {"sim": sim, "arm": arm, "log": sim.log, "armctl": armctl}.get(first.split(".")[0])
            if value is None:  # another package
                continue
            for attribute in first.split(".")[1:2]:
                assert hasattr(type(value) if letters == "sim" and attribute == "gripper" else value, attribute), hint


@pytest.mark.parametrize(("word", "name"), [("kp", "stiffness"), ("kd", "damping"), ("zeta", "damping_ratio")])
def test_a_gain_by_its_textbook_name_is_suggested(word: str, name: str):
    with pytest.raises(TypeError, match=f"^PD takes no argument '{word}'; did you mean '{name}'\\?$"):
        armctl.PD(arm_of("robot_arm_3dof"), **{word: 3.0})


def test_an_unknown_argument_of_a_plant_lists_those_that_exist():
    with pytest.raises(TypeError, match=r"^Plant takes no argument 'wobble'; it takes payload, "):
        armctl.Plant(wobble=1)
    with pytest.raises(TypeError, match="did you mean 'payload'"):
        armctl.Plant(load=2.0)


def test_hints_do_not_disturb_copies_and_pickles():
    arm = arm_of("robot_arm_3dof")
    plant = armctl.Plant(payload=1.0)
    assert pickle.loads(pickle.dumps(plant)).payload == copy.copy(plant).payload == 1.0
    assert copy.deepcopy(arm).n == pickle.loads(pickle.dumps(arm)).n == arm.n
    assert not hasattr(arm, "__array_interface__")


def test_an_unknown_public_name_lists_similar_ones():
    with pytest.raises(AttributeError, match=r"^armctl has no attribute 'solve_ikk'; similar: solve_ik"):
        armctl.solve_ikk  # noqa: B018


@pytest.mark.parametrize(("word", "name"), armctl._OTHER_NAMES.items())
def test_a_public_name_of_other_libraries_is_answered_by_one_that_exists(word: str, name: str):
    with pytest.raises(AttributeError, match=re.escape(f"armctl has no attribute '{word}'; similar: {name}")):
        getattr(armctl, word)
    assert hasattr(armctl, name.split("(")[0])


@pytest.mark.parametrize("word", ["pid", "PID", "osc"])
def test_a_controller_by_its_name_elsewhere_is_suggested(word: str):
    with pytest.raises(armctl.UnknownNameError) as caught:
        armctl.Simulation(arm_of("robot_arm_3dof"), word)
    assert str(caught.value).split("'")[3] in {"computed-torque-observer", "operational-space"}


def test_angles_in_degrees_give_a_warning():
    with pytest.warns(armctl.ArmctlWarning, match="taken in radians"):
        armctl.Pose([0.3, 0.0, 0.4], rpy=[180, 0, 0])


def test_a_matrix_in_the_place_of_a_point_names_the_constructor_of_a_pose():
    with pytest.raises(armctl.InputError, match=r"^target: .* of shape \(4, 4\); Pose\.from_matrix"):
        armctl.solve_ik(arm_of("robot_arm_3dof"), np.eye(4))


def test_a_rotation_matrix_in_the_place_of_a_quaternion_names_the_other_constructor():
    with pytest.raises(armctl.InputError, match=r"Pose\.from_rotation"):
        armctl.Pose([0.3, 0.0, 0.4], armctl.Pose([0, 0, 0]).rotation)


@pytest.mark.parametrize(
    ("metres", "text"),
    [
        (0.0, "<1 nm"),
        (8.45e-20, "<1 nm"),
        (1.2e-8, "12 nm"),
        (3.449e-3, "3.45 mm"),
        (0.9996, "1 m"),
        (2.066, "2.07 m"),
        (4321.0, "4321 m"),
    ],
)
def test_a_length_has_one_form(metres: float, text: str):
    assert length_text(metres) == text


@pytest.mark.parametrize(
    ("metres", "text"), [(1.02e-3, "1.02 mm"), (1.0001e-3, "just over 1 mm"), (1e-3, "1 mm"), (0.9999e-3, "1 mm")]
)
def test_a_length_beside_its_bound_does_not_read_as_the_bound(metres: float, text: str):
    assert above_text(metres, 1e-3) == text
