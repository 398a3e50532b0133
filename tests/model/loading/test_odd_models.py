"""Models that are unlike the usual ones: one joint, physics switched off by a flag, joints that nothing drives, odd names."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
from synthetic import limb, mjcf, motors

import armctl
from armctl.control import CONTROLLERS
from armctl.model.arm.parity import PARITY_TOLERANCE, check_parity
from armctl.model.loading.tip import tip_on

PASSIVE = 'stiffness="2" damping="0.5" frictionloss="0.3" armature="0.05"'


# --- one joint ---------------------------------------------------------------------------------------------------------------


@pytest.fixture(params=["hinge", "slide"])
def single(request: pytest.FixtureRequest, load) -> armctl.Arm:
    body = f'<body name="A"><joint name="a" type="{request.param}" axis="0 1 0" range="-1 1" damping="0.1"/>'
    return load(body + '<geom size="0.05" pos="0.2 0 0" mass="1"/><site name="tip" pos="0.3 0 0"/></body>', motors("a"))


def test_the_jacobian_of_one_joint_has_a_column(single: armctl.Arm):
    J = single.jacobian([0.3])
    steps = [single.fk([0.3 + h]).position for h in (-1e-6, 1e-6)]
    assert J.shape == (6, 1)
    assert J[:3, 0] == pytest.approx((steps[1] - steps[0]) / 2e-6, abs=1e-8)


@pytest.mark.parametrize("name", CONTROLLERS)
def test_every_controller_drives_one_joint(single: armctl.Arm, name: str):
    log = armctl.simulate(single, name, armctl.move_j(single, [0.0], [0.3]))
    assert not log.failure
    assert np.abs(log.q - log.q_ref).max() < 0.3


def test_one_joint_is_solved_stepped_and_identified(single: armctl.Arm):
    target = single.fk([0.4]).position
    assert armctl.solve_ik(single, target).q == pytest.approx([0.4], abs=1e-4)
    assert armctl.DifferentialIk(single).step([0.0], target, 0.01)[0] > 0
    log = armctl.simulate(single, "computed-torque-observer", armctl.excitation(single), armctl.Plant(payload=0.5))
    assert armctl.identify_payload(single, log).mass == pytest.approx(0.5, rel=0.02)


# --- physics switched off ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("flag", ["damper", "spring", "frictionloss", "constraint", "gravity", "eulerdamp", "limit", "contact"])
def test_what_a_flag_switches_off_is_off_for_the_controller_too(load, flag: str):
    lifted = limb("a b", joint=PASSIVE).replace("<body", '<body gravcomp="0.5"')
    arm = load(lifted, motors("a b") + f'<option><flag {flag}="disable"/></option>')
    assert check_parity(arm) <= PARITY_TOLERANCE
    log = armctl.simulate(arm, "computed-torque", armctl.move_j(arm, arm.home, arm.home + 0.3))
    assert np.abs(log.q - log.q_ref).max() < 1e-9


@pytest.mark.parametrize("option", ['<option><flag actuation="disable"/></option>', '<option actuatorgroupdisable="0"/>'])
def test_motors_that_the_model_disables_are_enabled_with_a_warning(load, option: str):
    with pytest.warns(armctl.ArmctlWarning, match="the model's options disable its actuators; armctl enables them"):
        arm = load(limb("a b"), motors("a b") + option)
    assert armctl.Simulation(arm).move_j(arm.home + 0.3).ok


@pytest.mark.parametrize("option", ['viscosity="0.1"', 'density="1.2" wind="3 0 0"'])
def test_drag_is_noted_as_not_modelled(load, option: str):
    with pytest.warns(armctl.ArmctlWarning, match=r"drag \(density .* viscosity .* wind .*controllers do not model it") as said:
        arm = load(limb("a b"), motors("a b") + f"<option {option}/>")
    assert [each.category for each in said] == [armctl.ArmctlWarning, armctl.MissingShapeWarning]
    assert any("0.1 Pa s" in note or ("density 1.2 kg/m^3" in note and "[3, 0, 0] m/s" in note) for note in arm.notes)


def test_wind_alone_drags_nothing(load):
    windy = load(limb("a b"), motors("a b") + '<option wind="3 0 0"/>')
    assert windy.notes == load(limb("a b"), motors("a b")).notes


def test_only_the_groups_of_the_arms_motors_are_switched_on(load):
    servo = '<position joint="a" kp="9" group="3"/><position joint="left" kp="9" group="3" forcerange="-1 1"/>'
    actuators = motors("a b").replace("</actuator>", f"{servo}</actuator>")
    arm = load(limb("a b", inside=limb("left") + limb("right")), actuators + '<option actuatorgroupdisable="3"/>')
    notes = [note for note in arm.notes if "collision shape" not in note]
    assert notes == ["the file switches 'actuator2' of joint 'a' off: only 'm_a' counts"]
    assert arm.model.opt.disableactuator == 1 << 3


# --- chains that end early, and loose objects --------------------------------------------------------------------------------


def test_a_chain_that_ends_before_a_joint_without_a_motor_says_so(load):
    with pytest.warns(
        armctl.ArmctlWarning, match="the arm ends before joint 'c', which has no actuator of its own and is held"
    ):
        arm = load(limb("a b c"), motors("a b"))
    assert arm.joint_names == ("a", "b")


def test_a_loose_object_is_not_blamed_for_an_arm_without_motors(load):
    cube = '<body name="cube" pos="1 0 0"><freejoint name="cube_joint"/><geom size="0.1"/></body>'
    with pytest.raises(armctl.ModelError, match="joint 'a' has no actuator of its own, and it is the first one"):
        load(cube + limb("a b"), motors("b"))


def test_a_range_that_ends_below_its_start_counts_as_unlimited_aloud(load):
    with pytest.warns(armctl.ArmctlWarning, match="the range of a ends below its start, so it counts as unlimited"):
        arm = load(limb("a b").replace('range="-2 2"', 'range="2 -2"', 1), motors("a b"))
    assert np.isinf(arm.limits.q_max).tolist() == [True, False]


# --- names -------------------------------------------------------------------------------------------------------------------


def test_names_in_any_script_and_with_spaces_are_names(load):
    text = limb("a b").replace('name="a"', 'name="Gelenk ä 1"').replace('name="B"', 'name="手"')
    arm = load(text, motors("a b").replace('joint="a"', 'joint="Gelenk ä 1"'))
    assert arm.joint_names == ("Gelenk ä 1", "b")
    assert arm.tip == "手"


def test_names_that_are_not_in_utf8_are_one_clear_sentence(tmp_path: Path):
    path = tmp_path / "old.xml"
    path.write_bytes(mjcf(limb("ä b"), motors("ä b")).encode("latin-1"))
    with pytest.raises(armctl.ModelError, match="names that are not in UTF-8; save it as UTF-8"):
        armctl.load(path)


def fixed(name: str, inside: str = "") -> str:
    return f'<body name="{name}" pos="0 0 0.1"><geom size="0.01"/>{inside}</body>'


ENDS = {
    "a tool frame beside a camera": (fixed("flange", fixed("tool0") + fixed("camera_link")), "tool0"),
    "the deeper of two": (fixed("gripper_link", fixed("gripper")), "gripper"),
    "an effector before its fingers": (fixed("end_effector") + fixed("finger_tip_1") + fixed("finger_tip_2"), "end_effector"),
    "a palm before its fingers": (fixed("palm", fixed("fingertip_1") + fixed("fingertip_2")), "palm"),
    "the end of a straight piece": (fixed("one", fixed("two")), "two"),
    "no sensor": (fixed("one", fixed("imu_link")), "one"),
    "not a wheel for an ee": (fixed("wheel") + fixed("plate"), "hand"),
}


@pytest.mark.parametrize("case", ENDS)
def test_a_piece_without_sites_ends_at_its_tool_or_before_its_fingers(case: str):
    inside, tip = ENDS[case]
    model = mujoco.MjModel.from_xml_string(mjcf(f'<body name="hand"><joint/><geom size="0.01"/>{inside}</body>'))
    assert tip_on(model, 1).name == tip


def test_what_the_motors_lift_of_themselves_is_not_taken_for_a_payload(load):
    lifted = limb("a b", joint='actuatorgravcomp="true"').replace("<body", '<body gravcomp="1"', 1)
    arm = load(lifted.replace("</body></body>", '<site name="tip" pos="0.1 0 0"/></body></body>'), motors("a b"))
    log = armctl.simulate(arm, "computed-torque-observer", armctl.excitation(arm), armctl.Plant(payload=0.5))
    assert armctl.identify_payload(arm, log).mass == pytest.approx(0.5, rel=0.02)


# --- a body that MuJoCo lifts ------------------------------------------------------------------------------------------------

LIFTED = limb("a b c", '<body name="hand" euler="1 2 3"><geom size="0.01"/><site name="tip" pos="0.1 0 0"/></body>')
LIFTED = LIFTED.replace("<body", '<body gravcomp="1"')


@pytest.fixture(params=["unlifted behind", "fused", "apart"])
def lifted(request: pytest.FixtureRequest, load) -> armctl.Arm:
    """An arm that MuJoCo lifts, hand included; what is behind the hand may weigh, or be fused with it by the compiler."""
    tool = '<site name="tip" pos="0.1 0 0"/><body pos="0.1 0 0" euler="3 1 2"><geom size="0.01"/></body>'
    bodies = LIFTED.replace('<site name="tip" pos="0.1 0 0"/>', tool) if request.param == "unlifted behind" else LIFTED
    return load(bodies, motors("a b c") + f'<compiler fusestatic="{str(request.param == "fused").lower()}"/>', tip="tip")


def test_a_payload_of_a_lifted_body_weighs_what_it_weighs(lifted: armctl.Arm):
    center = np.array([0.05, -0.02, 0.1])
    mass = 1.5
    q = np.array([0.4, 0.9, -0.7])
    model = armctl.Plant(payload=mass, payload_center=center).model(lifted)
    data = mujoco.MjData(model)
    data.qpos[lifted.qpos_adr] = q
    mujoco.mj_forward(model, data)
    force = -mass * model.opt.gravity
    wrench = np.concatenate([force, np.cross(lifted.fk(q).rotation @ center, force)])
    expected = lifted.gravity(q) + lifted.jacobian(q).T @ wrench
    assert np.abs(lifted.jacobian(q).T @ wrench).max() > 1.0
    assert data.qfrc_bias - data.qfrc_passive == pytest.approx(expected, abs=1e-10)
    assert lifted.with_payload(mass, center).gravity(q) == pytest.approx(expected, abs=1e-10)


def test_a_payload_of_a_lifted_body_is_identified(lifted: armctl.Arm):
    log = armctl.simulate(lifted, "computed-torque-observer", armctl.excitation(lifted), armctl.Plant(payload=0.5))
    assert armctl.identify_payload(lifted, log).mass == pytest.approx(0.5, rel=0.02)


def test_each_of_several_lifted_arms_bears_its_own_payload(tmp_path: Path):
    path = tmp_path / "two.xml"
    other = re.sub(r'name="(\w+)"', r'name="\1_2"', LIFTED)
    path.write_text(mjcf(LIFTED + other, motors("a b c a_2 b_2 c_2")))
    arms = [armctl.load(path, tip=tip) for tip in ("tip", "tip_2")]
    q = np.array([0.4, 0.9, -0.7])
    first = arms[0].with_payload(1.0).gravity(q)
    second = arms[1].with_payload(1.0).gravity(q)
    assert np.abs(first).max() > 1.0
    assert first == pytest.approx(second, abs=1e-10)
