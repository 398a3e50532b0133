"""Finding chains: in small models, each with one trap that a robot somewhere has."""

from collections.abc import Callable

import mujoco
import numpy as np
import pytest
from synthetic import limb, mjcf, motors

import armctl
from armctl.model.loading.chain import all_chains, chain_to, find_chain
from armctl.model.mjmodel.queries import joint_name
from armctl.model.mjmodel.transmissions import Transmissions

Model = Callable[..., mujoco.MjModel]


def names(model: mujoco.MjModel, joints: tuple[int, ...]) -> str:
    return " ".join(joint_name(model, joint) for joint in joints)


def found(bodies: str, rest: str = "") -> str:
    model = mujoco.MjModel.from_xml_string(mjcf(bodies, rest))
    return names(model, find_chain(Transmissions(model)))


FINGERS = limb("left", joint='armature="0.01"') + limb("right", joint='armature="0.01"')


def test_the_longest_run_of_actuated_joints_is_the_arm():
    assert found(limb("a b", limb("c d e") + limb("f")), motors("a b c d e f")) == "a b c d e"


def test_two_fingers_with_an_actuator_each_are_not_part_of_the_arm():
    assert found(limb("a b c", FINGERS), motors("a b c left right")) == "a b c"


def test_one_finger_that_leads_another_is_not_part_of_the_arm():
    equality = '<equality><joint joint1="left" joint2="right" polycoef="0 -1 0 0 0"/></equality>'
    assert found(limb("a b c", FINGERS), motors("a b c left") + equality) == "a b c"


def test_a_gripper_on_a_tendon_is_not_part_of_the_arm():
    tendon = '<tendon><fixed name="split"><joint joint="left" coef="0.5"/><joint joint="right" coef="0.5"/></fixed></tendon>'
    actuators = motors("a b c grip", grip='<position tendon="split" kp="9"/>')
    assert found(limb("a b c", FINGERS), tendon + actuators) == "a b c"


@pytest.mark.parametrize("jaw", ["jaw", "gripper", "jointGripper", "moving_finger", "claw"])
def test_a_serial_jaw_is_not_part_of_the_arm(jaw: str):
    assert found(limb(f"a b c {jaw}"), motors(f"a b c {jaw}")) == "a b c"


def test_a_jaw_is_known_by_its_actuator_or_body_too():
    by_actuator = motors("a b c d", d='<position name="gripper" joint="d" kp="9"/>')
    assert found(limb("a b c d"), by_actuator) == "a b c"
    by_body = limb("a b c").replace("</body></body></body>", f"{limb('d').replace('D', 'link_fngr')}</body></body></body>")
    assert found(by_body, motors("a b c d")) == "a b c"


def test_a_body_named_gripper_is_a_jaw_where_its_carrier_has_the_tip_and_else_a_wrist():
    gripper = limb("d").replace("D", "gripper")
    carrier = limb("a b c", "<site name='tcp'/>" + gripper)
    assert found(carrier, motors("a b c d")) == "a b c"
    assert found(limb("a b c", gripper), motors("a b c d")) == "a b c d"


def test_a_wrist_that_carries_the_fingers_stays_in_the_arm_whatever_its_name():
    assert found(limb("a b joint_gripper", FINGERS), motors("a b joint_gripper left right")) == "a b joint_gripper"


def test_a_finger_alone_is_a_chain_although_all_its_joints_are_named_so():
    assert found(limb("finger0 finger1 finger2"), motors("finger0 finger1 finger2")) == "finger0 finger1 finger2"


def test_several_joints_on_one_body_make_one_chain(load):
    base = (
        '<body name="base"><joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>'
        f'<joint name="turn" axis="0 0 1"/><geom size="0.1" mass="5"/>{limb("a b")}</body>'
    )
    arm = load(base, motors("x y turn a b"))
    assert arm.joint_names == ("x", "y", "turn", "a", "b")
    q = np.array([0.1, -0.2, 0.3, 0.4, -0.5])
    data = mujoco.MjData(arm.model)
    data.qpos[:] = arm.qpos(q)
    mujoco.mj_kinematics(arm.model, data)
    assert np.allclose(arm.fk(q).position, data.xpos[arm.tip_body], atol=1e-12)


def test_two_equal_arms_ask_for_a_tip():
    with pytest.raises(armctl.ModelError, match="2 chains of 2 joints start at the base; choose one with tip=: 'B', 'D'"):
        found(limb("a b") + limb("c d"), motors("a b c d"))


REFUSED = {
    "no joints": ('<geom size="1"/>', "", "no arm: the model has no joints"),
    "no actuators": (limb("a b"), "", "no hinge or slide joint has an actuator; add one"),
    "free base": (
        f'<body name="trunk"><freejoint name="root"/><geom size="0.1" mass="1"/>{limb("a b")}</body>',
        motors("a b"),
        r"the base 'trunk' is free \(joint 'root'\); give the file",
    ),
    "first joint passive": (
        limb("a b"),
        motors("b"),
        "joint 'a' has no actuator of its own, and it is the first one from the base",
    ),
    "ball joint": (
        f'<body><joint name="ball" type="ball"/><geom size="0.1" mass="1"/>{limb("a")}</body>',
        motors("a"),
        "joint 'ball' is a ball joint, not a hinge or slide, and it is the first one from the base",
    ),
    "coupled": (
        limb("a b c"),
        motors("a b c") + '<equality><joint name="belt" joint1="b" joint2="c"/></equality>',
        "joint 'b' and 'c' are tied to each other by equalities, yet several actuators move them: 'm_b' and 'm_c'",
    ),
    "on a tendon": (
        limb("a b c"),
        '<tendon><fixed name="cable" stiffness="3"><joint joint="b" coef="1"/><joint joint="c" coef="1"/></fixed></tendon>'
        + motors("a b c"),
        "joint 'b' is coupled to others by the tendon 'cable'",
    ),
    "on a cable over sites": (
        limb("a b", '<site name="s" pos="0 0.1 0"/>') + '<site name="wall"/>',
        '<tendon><spatial name="rope" stiffness="3"><site site="wall"/><site site="s"/></spatial></tendon>' + motors("a b"),
        "joint 'a' is coupled to others by the tendon 'rope'",
    ),
    "loop": (
        limb("a b"),
        motors("a b") + '<equality><connect name="bar" body1="B" body2="world" anchor="0 0 0"/></equality>',
        "the equality 'bar' closes a loop over joint 'a'",
    ),
}


@pytest.mark.parametrize("trap", REFUSED)
def test_what_is_no_arm_says_why(trap: str):
    bodies, rest, sentence = REFUSED[trap]
    with pytest.raises(armctl.ModelError, match=sentence):
        found(bodies, rest)


def test_what_couples_nothing_is_no_hindrance():
    inactive = '<equality><joint joint1="b" joint2="c" active="false"/></equality>'
    measured = '<tendon><fixed name="sum"><joint joint="a" coef="1"/><joint joint="b" coef="1"/></fixed></tendon>'
    assert found(limb("a b c"), motors("a b c") + inactive + measured) == "a b c"


def test_a_damper_drives_nothing():
    with pytest.raises(armctl.ModelError, match="joint 'a' has no actuator of its own, and it is the first one"):
        found(limb("a b"), motors("a b", a='<damper joint="a" kv="1" ctrlrange="0 1"/>'))


WAY = {
    "ball": ('<body><joint name="ball" type="ball"/><geom size="0.1" mass="1"/>' + limb("a") + "</body>", "joint 'ball'.*ball"),
    "passive": (limb("p a"), "in the chain to 'A': joint 'p' has no actuator of its own; base= a body after this joint"),
}


@pytest.mark.parametrize("trap", WAY)
def test_the_way_to_a_tip_says_what_blocks_it(load, trap: str):
    bodies, sentence = WAY[trap]
    with pytest.raises(armctl.ModelError, match=sentence):
        load(bodies, motors("a"), tip="A")


def test_no_joint_moves_the_tip(load):
    with pytest.raises(armctl.ModelError, match="no joint moves 'plate', so it cannot be the tip of an arm"):
        load(limb("a b") + '<body name="plate"/>', motors("a b"), tip="plate")


def test_a_base_holds_what_is_above_it(load):
    arm = load(limb("p a b"), motors("a b"), base="P")
    assert arm.joint_names == ("a", "b")
    assert load(limb("a b c"), motors("a b c"), base="A", tip="C").joint_names == ("b", "c")


def test_a_base_must_be_a_body_above_the_tip(load):
    with pytest.raises(armctl.ModelError, match="'B' is not attached to 'C'; choose a base among its ancestors"):
        load(limb("a b c"), motors("a b c"), base="C", tip="B")
    with pytest.raises(armctl.UnknownNameError, match="unknown body 'BB'; known: planar, free, world, A, B, BC"):
        load(limb("a b bc"), motors("a b bc"), base="BB")
    with pytest.raises(armctl.ModelError, match="no joint hangs on 'B'"):
        load(limb("a b"), motors("a b"), base="B")


def test_all_chains_of_a_robot_are_found_with_reasons():
    model = mujoco.MjModel.from_xml_string(
        mjcf(
            f'<body name="trunk"><freejoint/><geom size="0.1" mass="1"/>{limb("a b c", FINGERS)}{limb("p d e")}</body>',
            motors("a b c left d e") + '<equality><joint name="pair" joint1="left" joint2="right"/></equality>',
        )
    )
    chains = [(c.base, c.tip, " ".join(c.joint_names), c.reason) for c in all_chains(Transmissions(model))]
    assert chains == [
        ("trunk", "C", "a b c", ""),
        ("P", "E", "d e", ""),
        ("C", "LEFT", "left", ""),
        ("C", "RIGHT", "right", ""),
        ("trunk", "P", "p", "joint 'p' has no actuator of its own"),
    ]


@pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")
def test_a_chain_loads_by_base_and_tip_or_says_why_not(robot: str):
    chains = armctl.chains(robot)
    for chain in [next((c for c in chains if c.ok), None), next((c for c in reversed(chains) if not c.ok), None)]:
        if chain is not None and chain.ok:
            arm = armctl.load(robot, base=chain.base, tip=chain.tip)
            assert arm.joint_names == chain.joint_names
        elif chain is not None:
            with pytest.raises(armctl.ModelError, match=r"coupled|shares|no actuator|ball|loop"):
                armctl.load(robot, base=chain.base, tip=chain.tip)


def test_chain_to_agrees_with_find_chain():
    model = mujoco.MjModel.from_xml_string(mjcf(limb("a b c"), motors("a b c")))
    assert chain_to(Transmissions(model), model.body("C").id) == find_chain(Transmissions(model)) == (0, 1, 2)


TIPS = {
    '<site name="imu"/><site name="pinch" pos="0 0 0.1"/>': "pinch",
    '<site name="attachment_site"/><site name="grasp_site"/>': "grasp_site",
    '<site name="wrist_cam_site"/>': "C",
    '<site name="FL"/>': "FL",
    '<site/><geom name="foot" size="0.02" mass="0"/>': "foot",
    '<body name="tool0"><site name="flange"/></body>': "flange",
    '<body name="hand"/>': "hand",
    "": "C",
}


@pytest.mark.parametrize("inside", TIPS)
def test_the_tip_is_what_is_named_like_one(load, inside: str):
    assert load(limb("a b c", inside), motors("a b c")).tip == TIPS[inside]


def test_a_tip_of_no_name_suggests_one(load):
    with pytest.raises(armctl.UnknownNameError, match="unknown site, body or geom 'tooltip'; did you mean 'tool_tip'"):
        load(limb("a b", '<site name="tool_tip"/>'), motors("a b"), tip="tooltip")


def test_nameless_joints_and_bodies_get_numbers(load):
    nameless = limb("a b c").replace('name="a" ', "").replace('name="C" ', "")
    arm = load(nameless, motors("b c") + '<keyframe><key qpos="1 0 0"/></keyframe>', base="A")
    assert arm.joint_names == ("b", "c")
    assert arm.tip == "body3"
