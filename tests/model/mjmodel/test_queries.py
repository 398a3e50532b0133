"""Queries of a compiled model: what is on what, what acts on what, and what is fixed to what."""

import math

import mujoco
import numpy as np
import pytest
from synthetic import limb

from armctl.core.errors import UnknownNameError
from armctl.model.mjmodel import queries
from armctl.model.mjmodel.couplings import dofs_of_equality, dofs_of_tendon, tendon_coefficients

# A base without joints, an arm of three hinges with a welded tool and two fingers, a free box, and a wall.
BODIES = f"""
<geom name="wall" type="box" size="0.1 0.1 0.1" pos="2 0 0"/>
<body name="base"><geom size="0.1"/>{
    limb(
        "a b c",
        '<body name="tool" pos="0 0 0.1"><geom name="flange" size="0.02" mass="0.1"/>'
        + limb("left")
        + limb("right").replace('pos="0.1 0 0.1"', 'pos="0.1 0 0.2"')
        + "</body>",
    )
}</body>
<body name="box" pos="1 0 0"><freejoint name="floating"/><geom size="0.1"/><body name="lid"><geom size="0.1"/></body></body>
"""


def model_of(bodies: str = BODIES, rest: str = "") -> mujoco.MjModel:
    text = f'<mujoco><compiler angle="radian" autolimits="true"/><worldbody>{bodies}</worldbody>{rest}</mujoco>'
    return mujoco.MjModel.from_xml_string(text)


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return model_of()


def bodies(model: mujoco.MjModel, numbers) -> list[str]:
    return [model.body(number).name for number in numbers]


def joints(model: mujoco.MjModel, numbers) -> str:
    return " ".join(model.joint(number).name for number in numbers)


def test_what_has_no_name_is_called_by_its_kind_and_number():
    model = model_of('<body><joint axis="0 1 0"/><geom size="0.1"/></body>')
    assert queries.joint_name(model, 0) == "joint0"
    assert queries.body_name(model, 1) == "body1"
    assert queries.geom_owner_name(model, 0) == "body1"


def test_a_geom_of_the_world_is_called_by_its_own_name_and_others_by_their_body(model):
    assert queries.geom_owner_name(model, model.geom("wall").id) == "wall"
    assert queries.geom_owner_name(model, model.geom("flange").id) == "tool"


def test_a_body_is_found_by_its_name_and_an_unknown_one_is_an_error_with_a_suggestion(model):
    assert model.body(queries.body_named(model, "tool")).name == "tool"
    with pytest.raises(UnknownNameError, match="unknown body 'tol'; did you mean 'tool'"):
        queries.body_named(model, "tol")
    assert queries.object_id(model, mujoco.mjtObj.mjOBJ_BODY, "\ud800") == -1


def test_the_joints_above_a_body_end_below_the_base(model):
    finger = model.body("LEFT").id
    assert joints(model, queries.joints_above(model, finger)) == "a b c left"
    assert joints(model, queries.joints_above(model, finger, model.body("A").id)) == "b c left"
    assert queries.joints_above(model, model.body("base").id) == ()
    assert queries.joints_of(model, model.body("tool").id) == ()


def test_the_last_joint_above_each_body_is_counted_among_the_given_ones(model):
    chain = tuple(model.joint(name).id for name in ("a", "c"))
    owner = queries.last_joint_above(model, chain)
    assert {name: owner[model.body(name).id] for name in ("base", "A", "B", "C", "tool", "LEFT", "box")} == {
        "base": -1,
        "A": 0,
        "B": 0,
        "C": 1,
        "tool": 1,
        "LEFT": 1,
        "box": -1,
    }


def test_descendants_are_below_and_siblings_are_not(model):
    number = {name: model.body(name).id for name in ("A", "tool", "LEFT", "RIGHT", "box", "lid")}
    assert queries.is_below(model, number["LEFT"], number["A"])
    assert queries.is_below(model, number["A"], number["A"])
    assert queries.is_below(model, number["box"], 0)
    assert not queries.is_below(model, number["RIGHT"], number["LEFT"])
    assert not queries.is_below(model, number["A"], number["LEFT"])
    assert bodies(model, queries.welded_behind(model, model.body("C").id)) == ["C", "tool"]


def test_branches_are_the_jointed_bodies_on_a_welded_piece(model):
    assert bodies(model, queries.branches(model, model.body("C").id)) == ["LEFT", "RIGHT"]
    assert bodies(model, queries.branches(model, 0)) == ["A", "box"]
    counts = queries.branch_counts(model)
    for body in range(model.nbody):
        if body == 0 or model.body_jntnum[body]:
            assert counts[body] == len(queries.branches(model, body)), model.body(body).name


def test_a_floating_body_and_what_is_welded_to_it_are_loose(model):
    assert [queries.is_loose(model, model.body(name).id) for name in ("box", "lid", "A", "base")] == [True, True, False, False]
    assert queries.is_free(model, model.joint("floating").id)
    assert not queries.is_free(model, model.joint("a").id)


def test_a_base_is_part_of_its_robot_and_stands_alone_beside_another(model):
    arm = model.body("C").id
    assert not queries.stands_alone(model, model.body("base").id, arm)
    assert queries.stands_alone(model, model.body("base").id, model.body("box").id)
    assert queries.stands_alone(model, 0, arm)
    assert not queries.stands_alone(model, arm, arm)


def test_obstacles_are_shapes_that_collide_and_are_not_the_robot(model):
    chain = tuple(model.joint(name).id for name in "abc")
    assert bodies(model, queries.robot_roots(model, chain)) == ["base"]
    assert queries.has_obstacles(model, chain)
    alone = model_of(limb("a b"))
    assert not queries.has_obstacles(alone, (0, 1))
    assert not queries.colliding_geoms(alone).any()
    without = model_of(rest='<option><flag contact="disable"/></option>')
    assert queries.colliding_geoms(model).sum() == 5
    assert not queries.colliding_geoms(without).any()


@pytest.mark.parametrize(
    ("kind", "given", "found"),
    [
        ("hinge", "-2 3", (-2.0, 3.0)),
        ("slide", "-999999 0.5", (-math.inf, 0.5)),
        ("slide", "-1 999999", (-1.0, math.inf)),
        ("slide", "-1 900", (-1.0, 900.0)),
        ("hinge", "", (-math.inf, math.inf)),
    ],
)
def test_a_range_that_stands_for_no_limit_is_infinite(kind, given, found):
    bounds = f'range="{given}"' if given else ""
    assert queries.joint_range(model_of(f'<body><joint type="{kind}" {bounds}/><geom size="0.1"/></body>'), 0) == found


def test_actuators_that_drive_are_told_from_those_that_resist_rest_or_are_switched_off():
    rest = """<option actuatorgroupdisable="2"/><actuator>
    <motor name="motor" joint="a" gear="0"/><damper name="damper" joint="a" kv="3" ctrlrange="0 1"/>
    <position name="off" joint="a" kp="0"/><motor name="second" joint="a" group="2"/>
    <position name="servo" joint="b" kp="10"/><motor name="cable" tendon="t"/></actuator>
    <tendon><fixed name="t"><joint joint="c" coef="1"/></fixed></tendon>"""
    model = model_of(limb("a b c"), rest)
    number = {model.actuator(i).name: i for i in range(model.nactuator)}
    assert {name for name, i in number.items() if queries.is_damper(model, i)} == {"damper"}
    assert {name for name, i in number.items() if queries.is_powerless(model, i)} == {"motor", "off"}
    assert {name for name, i in number.items() if queries.is_disabled(model, i)} == {"second"}
    assert {name for name, i in number.items() if not queries.is_on_joint(model, i)} == {"cable"}
    assert queries.joint_actuators(model) == {0: number["motor"], 1: number["servo"]}


def test_a_tendon_acts_on_the_joints_that_change_its_length():
    sites = '<site name="one" pos="0.1 0 0"/>'
    arm = limb("a b c", '<site name="two" pos="0 0.1 0"/>').replace('<joint name="a"', f'{sites}<joint name="a"')
    rest = """<tendon><fixed name="f"><joint joint="a" coef="0.5"/><joint joint="c" coef="-2"/></fixed>
    <spatial name="s"><site site="one"/><site site="two"/></spatial></tendon>
    <equality><joint joint1="c" joint2="b"/><tendon tendon1="f"/><connect body1="B" body2="C" anchor="0 0 0"/></equality>"""
    model = model_of(arm, rest)
    assert dofs_of_tendon(model, 0) == [0, 2]
    assert tendon_coefficients(model, 0) == {0: 0.5, 2: -2.0}
    assert dofs_of_tendon(model, 1) == [1, 2]  # the first joint moves both sites
    assert tendon_coefficients(model, 1) == {}
    assert [sorted(dofs_of_equality(model, k)) for k in range(3)] == [[1, 2], [0, 2], [2]]


def test_forces_of_contacts_carry_the_weight_of_what_rests_on_them():
    model = model_of(
        '<geom type="plane" size="1 1 1"/><body pos="0 0 .1"><freejoint/><geom type="box" size=".1 .1 .1"/></body>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 2000)
    mujoco.mj_forward(model, data)
    forces = queries.contact_forces(model, data)
    assert len(forces) == 4
    assert forces[:, 1].sum(axis=0) == pytest.approx([0.0, 0.0, 9.81 * model.body_mass[1]], abs=1e-3)
    assert np.abs(forces[:, 0, :2]) == pytest.approx(0.1, abs=1e-3)
    assert all(queries.acts(contact) for contact in data.contact)
