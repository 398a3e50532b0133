"""Robot files as other projects write them: undeclared prefixes, xacro, no actuators, ranges that stand for "no limit"."""

import re
import sys
import types
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from synthetic import FIRST, JOINT, LIMIT, SECOND, THIRD, TOOL, limb, mjcf, motors, urdf

import armctl
from armctl.model.arm.parity import PARITY_TOLERANCE, check_parity

ROBOT = urdf(FIRST, SECOND, THIRD, TOOL)


@pytest.fixture
def load(tmp_path: Path):
    def loaded(text: str, name: str = "r.urdf", tip: str | None = None) -> armctl.Arm:
        path = tmp_path / name
        path.write_text(text)
        return armctl.load(path, tip=tip)

    return loaded


def test_an_undeclared_prefix_changes_nothing(load):
    with_prefix = ROBOT.replace("<limit ", '<limit drake:acceleration="7" ').replace("<base/>", "<drake:base/>")
    arm = load(with_prefix)
    np.testing.assert_array_equal(arm.limits.v_max, load(ROBOT, "plain.urdf").limits.v_max)
    assert arm.n == 2


def test_a_urdf_named_xml_is_a_urdf(load):
    arm = load(ROBOT, "r.xml")
    assert arm.sources["v_max"] == "URDF"
    assert arm.limits.tau_max == pytest.approx([40, 40])


def test_a_part_of_an_mjcf_says_what_to_load(load):
    with pytest.raises(armctl.ModelError, match=r"r\.xml: a part of an MJCF; load the file that includes it"):
        load("<mujocoinclude><body/></mujocoinclude>", "r.xml")


BOMB = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10}">' for i in range(1, 12))


def test_a_file_with_entities_is_refused_before_they_expand(load):
    bomb = f'<?xml version="1.0"?><!DOCTYPE robot [<!ENTITY e0 "boom">{BOMB}]>' + ROBOT.replace('"r"', '"&e11;"', 1)
    with pytest.raises(armctl.ModelError, match="declares the XML entity 'e0'; write the text itself"):
        load(bomb)


def test_an_external_entity_is_refused_and_never_read(load, tmp_path: Path):
    secret = tmp_path / "secret"
    secret.write_text("two")
    text = f'<!DOCTYPE robot [<!ENTITY x SYSTEM "file://{secret}">]>' + ROBOT
    with pytest.raises(armctl.ModelError, match="declares the XML entity 'x'"):
        load(text)


def test_a_planar_joint_is_refused_with_the_reason(load):
    planar = JOINT.format("j1", "planar", "base", "one", LIMIT)
    with pytest.raises(armctl.ModelError, match=r"joint 'j1' is planar and has three degrees of freedom.*two prismatic joints"):
        load(urdf(planar, SECOND, THIRD, TOOL))


def test_chained_mimic_joints_follow_the_first(load):
    second = JOINT.format("j2", "revolute", "one", "two", LIMIT + '<mimic joint="j1" multiplier="-0.5" offset="0.1"/>')
    third = JOINT.format("j3", "revolute", "two", "three", LIMIT + '<mimic joint="j2" multiplier="2" offset="0.2"/>')
    arm = load(urdf(FIRST, second, third, TOOL))
    assert arm.joint_names == ("j1",)
    np.testing.assert_allclose(arm.joint_map.ratio[:, 0], [1.0, -0.5, -1.0])
    np.testing.assert_allclose(arm.joint_map.offset, [0.0, 0.1, 0.4])
    assert check_parity(arm) <= PARITY_TOLERANCE


@pytest.mark.parametrize("travel", [1e3, 1e4, 999999, 1e8])
def test_a_slide_with_a_huge_range_has_no_limit_and_finds_every_pose(load, travel: float):
    slide = JOINT.format(
        "j1", "prismatic", "base", "one", f'<limit lower="-{travel}" upper="{travel}" effort="40" velocity="1"/>'
    )
    arm = load(urdf(slide, SECOND, THIRD, TOOL))
    assert np.isinf([arm.limits.q_min[0], arm.limits.q_max[0]]).all()
    assert arm.home[0] == 0.0
    for q in arm.limits.random(arm.home, 50, np.random.default_rng(0)):
        assert armctl.solve_ik(arm, arm.fk(q)).ok


def test_a_slide_limited_on_one_side_keeps_that_limit(load):
    limit = '<limit lower="0.2" upper="999999" effort="40" velocity="1"/>'
    arm = load(urdf(JOINT.format("j1", "prismatic", "base", "one", limit), SECOND, THIRD, TOOL))
    assert (arm.limits.q_min[0], arm.limits.q_max[0]) == (0.2, np.inf)
    assert arm.home[0] == pytest.approx(0.2)


def test_an_assumed_torque_overcomes_friction_and_damping(load):
    def torque(joint: str) -> np.ndarray:
        bodies = limb("a b", '<site name="tip"/>', joint=joint)
        servos = motors("a b", **{name: f'<position joint="{name}" kp="50"/>' for name in "ab"})
        with pytest.warns(armctl.ArmctlWarning, match="plus friction"):
            return load(mjcf(bodies, servos), "r.xml").limits.tau_max

    added = torque('frictionloss="30" damping="2"') - torque("")
    np.testing.assert_allclose(added, 30 + 2 * 2.0)  # at the default speed of 2 rad/s


def test_an_arm_with_dry_friction_and_assumed_torques_moves(load):
    bodies = limb("a b", '<site name="tip"/>', joint='frictionloss="30"')
    servos = motors("a b", **{name: f'<position joint="{name}" kp="50"/>' for name in "ab"})
    with pytest.warns(armctl.ArmctlWarning, match="no torque limit given for a, b: assumed"):
        arm = load(mjcf(bodies, servos), "r.xml")
    assert armctl.Simulation(arm).move_j(arm.home + 0.3).ok


@pytest.mark.filterwarnings("ignore:r. (no torque limit|no actuator|no mass|no inertia|the arm ends)")
def test_an_inertial_without_inertia_keeps_its_mass_with_a_warning(load):
    text = re.sub("<inertia .*?/>", "", ROBOT, count=1)
    with pytest.warns(armctl.ArmctlWarning, match="the inertial of one has no mass or no inertia"):
        arm = load(text)
    assert arm.model.body("one").mass == pytest.approx(1.0)


@pytest.mark.filterwarnings("ignore:r. (no torque limit|no actuator|no mass|no inertia|the arm ends)")
def test_joints_without_actuators_get_motors_with_a_warning(load):
    with pytest.warns(armctl.ArmctlWarning, match="no actuator in the file moves a, b, c: armctl added motors"):
        arm = load(mjcf(limb("a b c")), "r.xml")
    assert arm.n == 3
    assert armctl.Simulation(arm, "computed-torque").move_j(arm.home + 0.2).ok


@pytest.mark.filterwarnings("ignore:r. (no torque limit|no actuator|no mass|no inertia|the arm ends)")
def test_only_a_file_without_any_actuator_gets_motors(load):
    assert load(mjcf(limb("a b c"), motors("a b")), "r.xml").joint_names == ("a", "b")


MOCAP = '<body name="hand target" mocap="true" pos="0 0 1"/>'
WELD = '<equality><weld body1="hand target" body2="C"/></equality>'


@pytest.mark.filterwarnings("ignore:r. (no torque limit|no actuator|no mass|no inertia|the arm ends)")
def test_an_arm_welded_to_a_mocap_body_is_moved_by_motors_instead(load):
    finger = '<body name="F"><joint name="f" type="slide" range="0 0.04"/><geom size="0.01"/></body>'
    text = mjcf(limb("a b c", finger) + MOCAP, WELD + motors("f"))
    with pytest.warns(armctl.ArmctlWarning, match="the weld of C to a mocap body was removed"):
        arm = load(text, "r.xml")
    assert arm.joint_names[:3] == ("a", "b", "c")
    assert arm.model.neq == 0
    assert check_parity(arm) <= PARITY_TOLERANCE


def test_a_weld_between_bodies_that_are_not_mocap_still_closes_a_loop(load):
    other = '<body name="post" pos="1 0 0"><geom size="0.1"/></body>'
    with pytest.raises(armctl.ModelError, match="closes a loop"):
        load(mjcf(limb("a b c") + other, '<equality><weld body1="post" body2="C"/></equality>' + motors("a b c")), "r.xml")


@pytest.mark.parametrize(("ending", "converter"), [("sdf", "sdformat2mjcf"), ("usd", "usd_to_urdf"), ("usda", "usd_to_urdf")])
def test_a_format_that_mujoco_does_not_read_names_a_converter(load, ending: str, converter: str):
    with pytest.raises(armctl.ModelError, match=f"MuJoCo reads no {ending[:3].upper()}; convert it first.*{converter}"):
        load("<sdf/>", f"r.{ending}")


XACRO = ROBOT.replace('<robot name="r">', '<robot name="r"><xacro:property name="length" value="1"/>')


@pytest.mark.parametrize("name", ["r.xacro", "r.urdf", "r.urdf.xacro", "r.xml"])
def test_a_xacro_says_how_to_expand_it(load, monkeypatch: pytest.MonkeyPatch, name: str):
    monkeypatch.setitem(sys.modules, "xacrodoc", None)
    with pytest.raises(armctl.ModelError, match="a xacro, which must be expanded to a URDF: `pip install xacrodoc`"):
        load(XACRO, name)


def with_xacrodoc(monkeypatch: pytest.MonkeyPatch, expand: Callable[[str], str]) -> None:
    """Installs a xacrodoc that expands files by a function of their path."""

    class XacroDoc:
        def __init__(self, path: str):
            self.path = path

        @classmethod
        def from_file(cls, path: str, resolve_packages: bool) -> "XacroDoc":
            assert not resolve_packages
            return cls(path)

        def to_urdf_string(self) -> str:
            return expand(self.path)

    module = types.ModuleType("xacrodoc")
    module.XacroDoc = XacroDoc
    monkeypatch.setitem(sys.modules, "xacrodoc", module)


def test_a_xacro_is_expanded_if_xacrodoc_is_installed(load, monkeypatch: pytest.MonkeyPatch):
    with_xacrodoc(monkeypatch, lambda _path: ROBOT)
    arm = load(XACRO, "wx.urdf.xacro")
    assert (arm.name, arm.n) == ("wx", 2)
    assert arm.sources["v_max"] == "URDF"


def test_what_xacrodoc_raises_is_one_sentence(load, monkeypatch: pytest.MonkeyPatch):
    def fail(_path: str) -> str:
        raise RuntimeError("package 'arms'\nnot found")

    with_xacrodoc(monkeypatch, fail)
    with pytest.raises(armctl.ModelError, match="xacrodoc cannot expand it: package 'arms' not found"):
        load(XACRO, "r.xacro")


@pytest.mark.filterwarnings("ignore:r. (no torque limit|no actuator)")
def test_a_nameless_joint_without_an_actuator_gets_a_name_and_a_motor(load):
    nameless = mjcf(limb("a b c").replace('name="b" ', "").replace('name="c" ', 'name="joint0" '))
    assert load(nameless, "r.xml").joint_names == ("a", "joint1", "joint0")


def test_of_repeated_elements_the_first_counts_with_a_warning(load):
    first = FIRST.replace("</joint>", '<axis xyz="1 0 0"/></joint>')
    text = urdf(first, SECOND, THIRD, TOOL).replace("</inertial>", '</inertial><inertial><mass value="9"/></inertial>', 1)
    with pytest.warns(armctl.ArmctlWarning, match=r"repeated elements are left out: <inertial> of \w+, <axis> of j1"):
        arm = load(text)
    plain = load(ROBOT)
    np.testing.assert_allclose(arm.model.body_mass, plain.model.body_mass)
    np.testing.assert_allclose(arm.model.jnt_axis, plain.model.jnt_axis)


def test_the_inertia_of_a_rod_without_thickness_is_accepted(load):
    rod = '<inertia ixx="1e-7" ixy="-9e-13" ixz="0" iyy="1e-15" iyz="1e-12" izz="1e-7"/>'
    with pytest.warns(armctl.ArmctlWarning, match="is impossible .*: armctl uses the nearest"):
        arm = load(re.sub("<inertia .*?/>", rod, ROBOT, count=1))
    assert arm.n == 2


def test_the_tips_of_a_robot_with_several_limbs_can_be_chosen(load):
    leg = '<body pos="{0} 0 0.2"><joint name="{1}"/><geom name="foot {1}" size="0.05"/></body>'
    text = mjcf(leg.format(0.2, "left") + leg.format(-0.2, "right"), motors("left right"))
    assert load(text, "r.xml").tips == ("foot left", "foot right")
    assert load(text, "r.xml", tip="foot left").joint_names == ("left",)


def test_a_generated_texture_keeps_its_size(load):
    texture = '<asset><texture name="sky" type="skybox" builtin="gradient" rgb1="1 0 0" width="32" height="192"/></asset>'
    text = mjcf(limb("a b", '<site name="tip"/>'), motors("a b")).replace("<worldbody>", texture + "<worldbody>", 1)
    assert load(text, "r.xml").model.tex_width.tolist() == [32]
