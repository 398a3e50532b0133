"""Loading robots: names, files that cannot be read, URDFs, torque limits from wherever they are, keyframes, held bases."""

import re
import time
from pathlib import Path

import mujoco
import mujoco_menagerie as menagerie
import numpy as np
import pytest
from arms import at_hand
from synthetic import FIRST, JOINT, LIMIT, MESH, SECOND, THIRD, TOOL, limb, mjcf, motors, urdf

import armctl
from armctl.model.arm.parity import PARITY_TOLERANCE, check_parity
from armctl.model.loading.catalog import robots
from armctl.model.loading.datasheets import ALIASES, BY_ROBOT
from armctl.model.mjmodel.target_marker import TARGET

HINGE = '<joint name="a" axis="0 1 0" range="-1 1" {}/>'
SERVO = '<position name="s" joint="a" kp="50" {}/>'


def single(actuator: str, joint: str = "", rest: str = "") -> str:
    body = f'<body name="A">{HINGE.format(joint)}<geom size="0.05" pos="0.2 0 0" mass="2" contype="0" conaffinity="0"/></body>'
    return mjcf(body, f"<actuator>{actuator}</actuator>{rest}")


@pytest.fixture
def one(tmp_path: Path):
    def loaded(actuator: str, joint: str = "", rest: str = "") -> armctl.Arm:
        path = tmp_path / "one.xml"
        path.write_text(single(actuator, joint, rest))
        return armctl.load(path)

    return loaded


# --- names and files ---------------------------------------------------------------------------------------------------------


WRONG_NAMES = {
    "iwa14": (armctl.UnknownNameError, "unknown robot 'iwa14'; did you mean 'iiwa14'?"),
    "panda/panda_nohnd": (armctl.UnknownNameError, "unknown entry point of franka_emika_panda 'panda_nohnd'; did you mean"),
    "nowhere.xml": (armctl.ModelError, "nowhere.xml: no such file"),
    "": (armctl.InputError, "robot: '' is neither a name nor a path"),
}


@pytest.mark.parametrize("name", WRONG_NAMES)
def test_a_wrong_name_says_what_next(name: str):
    error, sentence = WRONG_NAMES[name]
    with pytest.raises(error) as caught:
        armctl.load(name)
    assert sentence in str(caught.value)


WRONG_TOOLS = {
    "nothing": "unknown tool 'nothing'; known: leap_hand, robotiq_2f85,",
    "robotiq": "unknown tool 'robotiq'; did you mean 'robotiq_2f85'?",
}


@pytest.mark.parametrize("tool", WRONG_TOOLS)
def test_a_wrong_tool_is_not_called_a_robot(bundled: armctl.Arm, tool: str):
    with pytest.raises(armctl.UnknownNameError) as caught:
        armctl.load(bundled.name, tool=tool)
    assert str(caught.value).startswith(WRONG_TOOLS[tool])


@pytest.mark.parametrize("name", [None, 3])
def test_no_name_at_all_is_a_wrong_call(name: object):
    with pytest.raises(armctl.InputError, match="is neither a name nor a path; try"):
        armctl.load(name)  # pyright: ignore[reportArgumentType]


def test_a_tip_offset_is_a_pose(bundled: armctl.Arm):
    with pytest.raises(armctl.InputError, match=r"tip_offset: expected Pose, got \[0, 0, 1\]; armctl.Pose"):
        armctl.load(bundled.name, tip_offset=[0, 0, 1])  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("how", "sentence"),
    [
        ({"tip": 3}, "tip: expected str, got 3; give the name of a site, body or geom"),
        ({"base": 3}, "base: expected str, got 3; give the name of a body"),
        ({"scene": "table"}, "scene: 'table' is neither a World nor the path of an .xml file; armctl.World()"),
        ({"scene": 3}, "scene: 3 is neither a World nor"),
        ({"tool": 3}, "tool: 3 is neither a name nor a path; try tool='robotiq_2f85'"),
    ],
)
def test_what_is_of_the_wrong_kind_is_said(bundled: armctl.Arm, how: dict, sentence: str):
    with pytest.raises(armctl.InputError) as caught:
        armctl.load(bundled.name, **how)
    assert str(caught.value).startswith(sentence)


BROKEN = {
    "not XML": "<mujoco",
    "crossed tags": "<mujoco><worldbody></mujoco>",
    "not a model": "<svg/>",
    "unknown element": mjcf("<boddy/>"),
    "missing mesh": mjcf('<geom type="mesh" mesh="m"/>', '<asset><mesh name="m" file="nowhere.stl"/></asset>'),
    "missing include": '<mujoco><include file="nowhere.xml"/></mujoco>',
    "unknown joint": mjcf(limb("a"), '<actuator><motor joint="b"/></actuator>'),
}


@pytest.mark.parametrize("what", BROKEN)
def test_a_broken_file_is_one_clear_sentence(tmp_path: Path, what: str):
    path = tmp_path / "broken.xml"
    path.write_text(BROKEN[what])
    with pytest.raises(armctl.ModelError) as caught:
        armctl.load(path)
    assert str(caught.value).startswith((f"{path}: MuJoCo cannot ", f"{path}: no well-formed XML"))
    assert "\n" not in str(caught.value)


def test_a_robot_that_cannot_be_downloaded_says_so_at_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.delenv("MENAGERIE_ROOT", raising=False)
    monkeypatch.setenv("MENAGERIE_BASE_URL", "http://127.0.0.1:9")
    monkeypatch.setenv("MENAGERIE_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(time, "sleep", lambda seconds: pytest.fail("it waits"))
    with pytest.raises(armctl.ModelError) as caught:
        armctl.load("google_robot")
    sentence = str(caught.value)
    assert sentence.startswith("google_robot: its model is not installed (http://127.0.0.1:9: ")
    assert "`mujoco-menagerie prefetch google_robot`, or set MENAGERIE_ROOT to a checkout" in sentence
    assert sentence.endswith("; 'robot_arm_3dof' comes with armctl")
    assert "\n" not in sentence


def test_all_of_menagerie_is_listed_with_what_can_be_done_with_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("MENAGERIE_ROOT", raising=False)  # nothing has to be at hand
    listed = robots()
    for robot in menagerie.robots():
        names = [robot.name, *(alias for alias, name in ALIASES.items() if name == robot.name)]
        assert any(name in listed for name in names), robot.name
    assert not [text for text in listed.values() if text.endswith("see armctl chains")]
    assert set(BY_ROBOT) <= set(menagerie.names())


# --- torque limits and motors ------------------------------------------------------------------------------------------------


TORQUES = {
    "forcerange": ('<position joint="a" kp="50" forcerange="-30 30"/>', "", 30.0, "forcerange"),
    "forcerange x gear": ('<position joint="a" kp="50" gear="4" forcerange="-5 5"/>', "", 20.0, "forcerange"),
    "negative gear": ('<motor joint="a" gear="-50" ctrlrange="-1 2"/>', "", 50.0, "ctrlrange"),
    "actfrcrange": ('<position joint="a" kp="50"/>', 'actuatorfrcrange="-7 7"', 7.0, "actfrcrange"),
    "the least": ('<position joint="a" kp="50" forcerange="-30 30"/>', 'actuatorfrcrange="-7 7"', 7.0, "actfrcrange"),
    "motor": ('<motor joint="a" ctrlrange="-9 9"/>', "", 9.0, "ctrlrange"),
    "general motor": ('<general joint="a" gainprm="3" ctrlrange="-2 2"/>', "", 6.0, "ctrlrange"),
    "uneven": ('<motor joint="a" ctrlrange="-4 9"/>', "", 4.0, "ctrlrange"),
    "velocity": ('<velocity joint="a" kv="5" forcerange="-8 8" ctrlrange="-1 1"/>', "", 8.0, "forcerange"),
    "affine": (
        '<general joint="a" gainprm="50" biastype="affine" biasprm="0 -50 -5" forcerange="-6 6"/>',
        "",
        6.0,
        "forcerange",
    ),
    "intvelocity": ('<intvelocity joint="a" kp="50" actrange="-1 1" forcerange="-5 5"/>', "", 5.0, "forcerange"),
    "in the parent's frame": ('<motor jointinparent="a" ctrlrange="-3 3"/>', "", 3.0, "ctrlrange"),
    "cylinder": ('<cylinder joint="a" area="2" timeconst="1" forcerange="-4 4"/>', "", 4.0, "forcerange"),
    "with a damper first": (
        '<damper joint="a" kv="9" ctrlrange="0 1"/><motor joint="a" ctrlrange="-3 3"/>',
        "",
        3.0,
        "ctrlrange",
    ),
}


@pytest.mark.parametrize("what", TORQUES)
def test_a_torque_limit_is_found_where_the_model_has_it(one, what: str):
    actuator, joint, tau_max, source = TORQUES[what]
    arm = one(actuator, joint)
    assert arm.limits.tau_max == pytest.approx([tau_max])
    assert source in arm.sources["tau_max"]


@pytest.mark.parametrize("what", TORQUES)
def test_an_actuator_becomes_a_motor_of_just_that_torque(one, what: str):
    actuator, joint, tau_max, _ = TORQUES[what]
    arm = one(actuator, joint)
    data = mujoco.MjData(arm.model)
    for torque in (-0.5 * tau_max, 0.9 * tau_max, 2 * tau_max):
        data.ctrl[arm.ctrl_adr] = torque / arm.gear
        mujoco.mj_forward(arm.model, data)
        assert data.qfrc_actuator[arm.dof_adr] == pytest.approx([min(torque, tau_max)])


UNUSABLE = {
    "muscle": ('<muscle joint="a" lengthrange="-1 1"/>', "joint 'a' is driven by a muscle, which pulls in one direction only"),
    "gear 0": ('<motor joint="a" gear="0"/>', "joint 'a': its actuator has a gear of 0 and cannot move it"),
    "one direction": (
        '<position joint="a" kp="5" forcerange="0 5"/>',
        r"joint 'a': its forcerange \[0, 5\] permits only one direction",
    ),
    "adhesion": ('<adhesion body="A" ctrlrange="0 1"/>', "no hinge or slide joint has an actuator"),
}


@pytest.mark.parametrize("what", UNUSABLE)
def test_an_actuator_that_makes_no_motor_says_why(one, what: str):
    actuator, sentence = UNUSABLE[what]
    with pytest.raises(armctl.ModelError, match=sentence):
        one(actuator)


def test_a_torque_limit_that_nobody_gives_is_assumed_aloud(one):
    with pytest.warns(armctl.ArmctlWarning, match="no torque limit given for a: assumed"):
        arm = one('<position joint="a" kp="50"/>')
    assert arm.sources["tau_max"] == "assumed"
    assert any("assumed" in note for note in arm.notes)
    assert arm.limits.tau_max[0] > 2 * 9.81 * 0.2  # it can at least hold itself


def test_a_slide_joint_is_spoken_of_in_newtons_and_metres(tmp_path: Path):
    path = tmp_path / "one.xml"
    joint = '<joint name="a" type="slide" axis="0 0 1" range="0 1"/>'
    actuator = '<actuator><position joint="a" kp="50"/></actuator>'
    path.write_text(mjcf(f'<body name="A">{joint}<geom size="0.05" mass="2"/></body>', actuator))
    with pytest.warns(armctl.ArmctlWarning, match=r"assumed [\d.]+ N \(twice gravity at rest plus 10 m/s\^2 plus friction\)"):
        arm = armctl.load(path)
    with pytest.raises(armctl.LimitError, match=r"q: a: 2 m is outside \[0\.000, 1\.000\] m"):
        armctl.Simulation(arm).move_j([2.0])
    with pytest.raises(armctl.LimitError, match=r"q_start: a: position [\d.]+ m at [\d.]+ s, limit 1 m"):
        armctl.move_j(arm, armctl.Setpoint(np.array([0.1]), np.array([9.0]), np.zeros(1)), [0.2])
    motion = armctl.move_j(arm, [0.1], [0.2])
    assert motion.then(armctl.move_j(arm, [0.2], [0.3])).check_limits().worst.unit.startswith("m/s")
    assert " N of " in str(armctl.check_torque(arm, motion))
    log = armctl.simulate(arm, armctl.ComputedTorque(arm), motion)
    assert log.units == armctl.Log.load(log.save(tmp_path / "log.npz")).units == ("m",)
    assert type(motion).load(motion.save(tmp_path / "motion.npz")).units == ("m",)
    report = armctl.Report.from_log(log)
    assert re.search(r"RMS \S+ m, max \S+ m\n", str(report))
    assert re.search(r"chatter \S+ N$", str(report))
    assert "joint RMS, m |" in armctl.table([report]).replace("  ", "")
    report.plot(tmp_path / "log.svg")
    assert {"joint position, m; dashed: reference", "motor torque, N"} <= set(
        re.findall(r">([^<>]+)</text>", (tmp_path / "log.svg").read_text())
    )


def test_keyframes_survive_whatever_the_actuators_were(one):
    key = '<keyframe><key name="home" qpos="0.4" act="0.4" ctrl="7"/></keyframe>'
    arm = one('<intvelocity joint="a" kp="50" actrange="-1 1" forcerange="-5 5"/>', rest=key)
    assert arm.home == pytest.approx([0.4])
    assert not arm.model.key_ctrl.any()
    assert arm.model.na == 0


def test_an_actuators_own_armature_and_damping_move_to_its_joint(one):
    plain = one('<motor joint="a" ctrlrange="-9 9"/>', 'armature="0.1" damping="0.2"')
    geared = one('<motor joint="a" gear="3" ctrlrange="-3 3" armature="0.02"/>', 'armature="0.1" damping="0.2"')
    assert geared.model.dof_armature[0] == pytest.approx(0.1 + 9 * 0.02)
    assert plain.model.dof_damping[0] == geared.model.dof_damping[0]


# --- home and target ---------------------------------------------------------------------------------------------------------


def test_home_is_the_keyframe_of_that_name_within_the_limits(one):
    keys = '<keyframe><key name="other" qpos="-0.5"/><key name="home" qpos="3"/></keyframe>'
    assert one('<motor joint="a" ctrlrange="-9 9"/>', rest=keys).home == pytest.approx([1.0])


def test_home_without_a_keyframe_is_the_middle(one):
    assert one('<motor joint="a" ctrlrange="-9 9"/>').home == pytest.approx([0.0])


def test_a_target_of_the_model_stays_and_one_is_added_where_there_is_none(load):
    own = load(limb("a b") + f'<body name="{TARGET}" pos="1 2 3"/>', motors("a b"))
    assert own.model.body(TARGET).pos == pytest.approx([1, 2, 3])
    added = load(limb("a b"), motors("a b"))
    assert added.model.body(TARGET).mocapid >= 0
    assert np.linalg.norm(added.model.body(TARGET).pos - added.fk(added.home).position) > 1e-3


# --- held bases --------------------------------------------------------------------------------------------------------------


WALKER = (
    '<geom name="floor" type="plane" size="5 5 0.1"/><body name="trunk" pos="0 0 1" euler="0.3 0 0"><freejoint name="root"/>'
    '<geom size="0.1" mass="5"/>' + limb("a b") + "</body>"
    '<body name="cube" pos="1 0 0.5"><freejoint/><geom type="box" size="0.02 0.02 0.02" mass="0.1"/></body>'
)
STANDING = '<keyframe><key name="home" qpos="0.1 0.2 0.6 0.8 0 0.6 0 0.3 -0.4 1 0 0.5 1 0 0 0"/></keyframe>'


def test_a_held_base_is_where_its_keyframe_puts_it_and_all_else_keeps_its_place(load):
    arm = load(WALKER, motors("a b") + STANDING)
    data = mujoco.MjData(arm.model)
    data.qpos[:] = arm.home_qpos
    mujoco.mj_forward(arm.model, data)
    assert data.body("trunk").xpos == pytest.approx([0.1, 0.2, 0.6])
    assert data.body("trunk").xquat == pytest.approx([0.8, 0, 0.6, 0])
    assert arm.home == pytest.approx([0.3, -0.4])
    assert data.body("cube").xpos == pytest.approx([1, 0, 0.5])
    assert arm.model.nv == 2 + 6  # the cube stays free


def test_a_held_base_without_a_keyframe_is_where_it_is_drawn(load):
    trunk = f'<body name="trunk" pos="0.1 0 0"><freejoint/><geom size="0.1" mass="5"/>{limb("a b")}</body>'
    arm = load(f'<frame pos="0 0 1" euler="0 0 1.5707963267948966">{trunk}</frame>', motors("a b"))
    data = mujoco.MjData(arm.model)
    mujoco.mj_forward(arm.model, data)
    assert data.body("trunk").xpos == pytest.approx([0, 0.1, 1])
    assert data.body("trunk").xquat == pytest.approx([0.5**0.5, 0, 0, 0.5**0.5])


def test_a_held_base_stays_while_its_limb_moves(load):
    arm = load(WALKER, motors("a b") + STANDING)
    simulation = armctl.Simulation(arm)
    before = simulation.data.body("trunk").xpos.copy()
    log = simulation.run(armctl.move_j(arm, arm.home, arm.home + 0.3))
    assert np.abs(log.q - log.q_ref).max() < 1e-9
    assert np.array_equal(simulation.data.body("trunk").xpos, before)


# --- URDF --------------------------------------------------------------------------------------------------------------------


def test_a_urdf_brings_its_limits_and_its_tool_frame(tmp_path: Path):
    path = tmp_path / "r.urdf"
    path.write_text(urdf(FIRST, SECOND, THIRD, TOOL))
    arm = armctl.load(path)
    assert arm.joint_names == ("j1", "j2")
    assert arm.tip == "tool0"
    assert arm.limits.q_min == pytest.approx([-1, -1])
    assert arm.limits.v_max == pytest.approx([2.5, 2.5])
    assert arm.limits.tau_max == pytest.approx([40, 40])
    assert arm.sources["v_max"] == "URDF"
    assert arm.fk([0, 0]).position == pytest.approx([0, 0, 1.2])


def test_a_joint_that_mimics_another_goes_along_with_it(tmp_path: Path):
    path = tmp_path / "r.urdf"
    mimic = JOINT.format("j2", "revolute", "one", "two", LIMIT + '<mimic joint="j1" multiplier="2" offset="0.1"/>')
    path.write_text(urdf(FIRST, mimic, THIRD, TOOL))
    arm = armctl.load(path)
    assert arm.joint_names == ("j1",)
    assert arm.qpos(np.array([0.3])) == pytest.approx([0.3, 0.7])
    plain = tmp_path / "plain.urdf"
    plain.write_text(urdf(FIRST, SECOND, THIRD, TOOL))
    assert np.allclose(arm.fk([0.3]).matrix, armctl.load(plain).fk([0.3, 0.7]).matrix)


def test_an_endless_joint_has_no_limits_and_an_unknown_effort_is_assumed(tmp_path: Path):
    path = tmp_path / "r.urdf"
    path.write_text(urdf(FIRST, JOINT.format("j2", "continuous", "one", "two", ""), THIRD, TOOL))
    with pytest.warns(armctl.ArmctlWarning, match="no torque limit given for j2: assumed"):
        arm = armctl.load(path)
    assert np.isinf(arm.limits.q_max[1])
    assert arm.sources["v_max"] == "URDF; default for j2"


@pytest.mark.parametrize("name", ["package://robot/meshes/one.dae", "meshes/one.stl", "file:///nowhere/one.stl"])
def test_a_mesh_that_cannot_be_had_is_left_out_aloud(tmp_path: Path, name: str):
    path = tmp_path / "robot" / "urdf" / "r.urdf"
    path.parent.mkdir(parents=True)
    (tmp_path / "robot" / "meshes").mkdir()
    (tmp_path / "robot" / "meshes" / "one.dae").write_text("a format that MuJoCo cannot read")
    path.write_text(urdf(FIRST, SECOND, THIRD, TOOL, shapes=MESH.format(name)))
    with pytest.warns(armctl.ArmctlWarning, match=f"collision mesh '{Path(name).name}' left out"):
        arm = armctl.load(path)
    assert any("left out" in note for note in arm.notes)


def test_a_mesh_is_found_in_its_ros_package(tmp_path: Path):
    path = tmp_path / "robot" / "urdf" / "r.urdf"
    path.parent.mkdir(parents=True)
    (tmp_path / "robot" / "meshes").mkdir()
    corners = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "robot" / "meshes" / "one.obj").write_text(corners)
    path.write_text(urdf(FIRST, SECOND, THIRD, TOOL, shapes=MESH.format("package://robot/meshes/one.obj")))
    arm = armctl.load(path)
    assert arm.model.nmesh == 1
    assert arm.unchecked_links == ("two", "three")  # the links without a mesh
    assert len(arm.notes) == 1


@pytest.mark.parametrize("text", ["<robot", urdf(JOINT.format("j", "floating", "one", "two", ""), FIRST, THIRD, TOOL)])
def test_a_broken_urdf_is_one_clear_sentence(tmp_path: Path, text: str):
    path = tmp_path / "r.urdf"
    path.write_text(text)
    with pytest.raises(armctl.ModelError) as caught:
        armctl.load(path)
    assert str(caught.value).startswith((f"{path}: MuJoCo cannot ", f"{path}: no well-formed XML"))
    assert "\n" not in str(caught.value)


# --- every arm at hand -------------------------------------------------------------------------------------------------------


def test_the_model_of_an_arm_is_mujocos(arm: armctl.Arm):
    assert check_parity(arm, samples=20, seed=1) <= PARITY_TOLERANCE


WRONG_TYPES = {
    "scene": 3,
    "tool": 4,
    "tip_offset": [0, 0, 1],
    "tip": 3,
    "base": ["base"],
}


@pytest.mark.parametrize("argument", WRONG_TYPES)
def test_an_argument_of_a_wrong_type_is_an_input_error(argument: str):
    with pytest.raises(armctl.InputError, match=f"^{argument}: "):
        armctl.load("robot_arm_3dof", **{argument: WRONG_TYPES[argument]})


@pytest.mark.parametrize("tips", [3, "end_effector", [], {"end_effector": 1}])
def test_tips_that_are_no_list_of_names_are_an_input_error(tips: object):
    with pytest.raises(armctl.InputError, match=r"^tips: "):
        armctl.load("robot_arm_3dof", tips=tips)  # pyright: ignore[reportArgumentType]


@pytest.mark.skipif(not at_hand("kinova_gen3"), reason="kinova_gen3: its model is not installed")
def test_a_rating_is_noted_for_the_arm_of_the_data_sheet_and_for_no_other():
    whole = armctl.load("gen3")
    assert any(note.startswith("rated payload 4 kg, reach 0.902 m (Kinova Gen3 user guide") for note in whole.notes)
    part = armctl.load("gen3", tip="forearm_link")
    assert not any("rated" in note for note in part.notes)
