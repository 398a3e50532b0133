"""Loading from an MjSpec or an MjModel: the same arm as from the file, and the caller's object stays as it is."""

import re
import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest
from arms import MENAGERIE_ARMS, some_of
from synthetic import limb, mjcf, motors

import armctl
from armctl.model.loading.catalog import BUNDLED, locate

SERVO = '<position name="{0}" joint="{0}" kp="50" kv="3" gear="{1}" forcerange="-40 40"/>'
SERVOS = f"<actuator>{SERVO.format('a', 2)}{SERVO.format('b', -0.5)}{SERVO.format('c', 1)}</actuator>"
KEYS = '<keyframe><key name="rest" qpos="0 0 0"/><key name="home" qpos="0.3 -0.4 0.5" ctrl="0.3 -0.4 0.5"/></keyframe>'
TIED = '<equality><joint joint1="c" joint2="b" polycoef="0.1 -0.5 0 0 0"/></equality>'
REFLECTED = SERVOS.replace('kp="50"', 'kp="50" armature="0.02" damping="0.3"')
DAMPER = SERVOS.replace("</actuator>", '<damper name="d" joint="b" kv="1" ctrlrange="0 1"/></actuator>')
OFF = '<option><flag actuation="disable"/></option>'

MODELS = {
    "motors": mjcf(limb("a b c"), motors("a b c")),
    "geared servos with keyframes": mjcf(limb("a b c"), SERVOS + KEYS),
    "armature and damping in the actuators": mjcf(limb("a b c"), REFLECTED),
    "a damper beside a servo": mjcf(limb("a b c"), DAMPER),
    "actuators that are disabled": mjcf(limb("a b c"), SERVOS + OFF),
    "joints that follow each other": mjcf(limb("a b c"), SERVOS.replace(SERVO.format("c", 1), "") + TIED),
    "a target of its own": mjcf(limb("a b c") + '<body name="target" mocap="true" pos="0.2 0.1 0.3"/>', SERVOS + KEYS),
    "lifted by gravcomp": mjcf(limb("a b c").replace('pos="0.1 0 0.1"', 'pos="0.1 0 0.1" gravcomp="1"', 2), SERVOS),
}


def loaded(robot, **how) -> armctl.Arm:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", armctl.ArmctlWarning)
        return armctl.load(robot, **how)


@pytest.mark.parametrize("kind", ["spec", "model", "several tips"])
def test_a_warning_points_at_the_line_that_loads(kind: str):
    spec = mujoco.MjSpec.from_string(mjcf(limb("a"), '<actuator><motor name="a" joint="a"/></actuator>'))
    with pytest.warns(armctl.ArmctlWarning, match="no torque limit") as caught:  # noqa: PT031
        if kind == "several tips":
            armctl.load(spec, tips=[armctl.chains(spec)[0].tip])
        else:
            armctl.load(spec.compile() if kind == "model" else spec)
    assert {each.filename for each in caught} == {__file__}


def bytes_of(model: mujoco.MjModel) -> bytes:
    buffer = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def assert_same_arm(arm: armctl.Arm, other: armctl.Arm) -> None:
    assert arm.joint_names == other.joint_names
    assert arm.tip == other.tip
    assert arm.sources == other.sources
    for name in ("q_min", "q_max", "v_max", "a_max", "j_max", "tau_max"):
        assert getattr(arm.limits, name) == pytest.approx(getattr(other.limits, name), rel=1e-12), name
    for name in ("gear", "motor_adr", "ctrl_adr", "dof_adr"):
        assert np.array_equal(getattr(arm.actuation, name), getattr(other.actuation, name)), name
    assert np.array_equal(arm.home_qpos, other.home_qpos)
    assert arm.fk(arm.home).position == pytest.approx(other.fk(other.home).position, abs=1e-12)


def run(arm: armctl.Arm) -> armctl.Log:
    """A run open to all that an actuator can do wrong: moving joints, limits, friction, gravity."""
    return armctl.simulate(arm, "pd", armctl.move_j(arm, arm.home, arm.limits.clamp(arm.home + 0.4)))


@pytest.mark.parametrize("what", MODELS)
def test_a_specification_gives_the_same_arm_as_its_file(tmp_path: Path, what: str):
    path = tmp_path / "given.xml"
    path.write_text(MODELS[what])
    spec = mujoco.MjSpec.from_string(MODELS[what])
    before = spec.to_xml()
    arm = loaded(spec)
    assert spec.to_xml() == before
    from_file = loaded(path)
    assert_same_arm(arm, from_file)
    assert bytes_of(arm.model) == bytes_of(from_file.model)


@pytest.mark.parametrize("what", MODELS)
def test_a_compiled_model_gives_an_arm_that_moves_as_that_from_its_file(tmp_path: Path, what: str):
    path = tmp_path / "given.xml"
    path.write_text(MODELS[what])
    model = mujoco.MjModel.from_xml_string(MODELS[what])
    before = bytes_of(model)
    arm = loaded(model)
    assert bytes_of(model) == before
    from_file = loaded(path)
    assert_same_arm(arm, from_file)
    log = run(arm)
    reference = run(from_file)
    assert np.abs(log.q - reference.q).max() < 1e-9
    assert np.abs(log.tau - reference.tau).max() < 1e-6
    assert bytes_of(model) == before


@pytest.mark.parametrize("name", some_of([BUNDLED, *MENAGERIE_ARMS]))
def test_installed_arms_move_alike_from_their_file_and_from_their_compiled_model(name: str):
    path = locate(name).path
    assert path is not None
    spec = mujoco.MjSpec.from_file(str(path))
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)  # contacts that only a specification can exclude
    from_file = loaded(spec)
    arm = loaded(spec.compile())
    assert_same_arm(arm, from_file)
    q = arm.limits.clamp(arm.home + 0.2)
    logs = [armctl.simulate(each, "pd", armctl.move_j(each, each.home, q)) for each in (arm, from_file)]
    assert np.abs(logs[0].q - logs[1].q).max() < 1e-6


def test_an_arm_of_a_compiled_model_without_a_target_moves_to_a_pose():
    arm = loaded(mujoco.MjModel.from_xml_string(MODELS["motors"]))
    assert any("target marker" in note for note in arm.notes)
    sim = armctl.Simulation(arm)
    assert sim.move_to(arm.fk(arm.home + 0.2)).ok
    with pytest.raises(armctl.ModelError, match="the model has no body named 'target'"):
        _ = sim.target


def test_keyframe_controls_of_a_compiled_model_are_cleared_in_the_copy_only():
    model = mujoco.MjModel.from_xml_string(MODELS["geared servos with keyframes"])
    arm = loaded(model)
    assert not arm.model.key_ctrl.any()
    assert model.key_ctrl[1] == pytest.approx([0.3, -0.4, 0.5])
    assert not arm.home_ctrl.any()
    assert arm.home == pytest.approx([0.3, -0.4, 0.5])


def test_actuators_with_memory_need_the_specification():
    text = mjcf(limb("a"), '<actuator><intvelocity name="s" joint="a" kp="50" actrange="-1 1"/></actuator>')
    with pytest.raises(armctl.ModelError, match=r"the actuator 's' has an activation state.*; give the MjSpec or the file"):
        armctl.load(mujoco.MjModel.from_xml_string(text))


@pytest.mark.parametrize("how", [{"base": "free"}, {"tool": "robotiq_2f85"}, {"scene": armctl.World()}])
def test_what_a_compiled_model_cannot_get_is_refused(how: dict):
    model = mujoco.MjModel.from_xml_string(MODELS["motors"])
    with pytest.raises(
        armctl.InputError, match=f"{next(iter(how))}: a compiled MjModel cannot be changed in this way; pass the MjSpec"
    ):
        armctl.load(model, **how)


def test_neighbours_that_overlap_in_a_compiled_model_are_noted():
    body = limb("a b").replace('contype="0" conaffinity="0"', "")
    text = mjcf(f'<body name="S"><geom size="0.3" mass="1"/>{body}</body>', motors("a b"))
    with pytest.warns(armctl.ArmctlWarning, match="S and A overlap at home, and their contact brakes the joint"):
        armctl.load(mujoco.MjModel.from_xml_string(text))


def test_a_specification_can_get_a_base_a_tool_and_a_scene(tmp_path: Path):
    floating = mjcf(f'<body name="F"><freejoint/><geom size="0.05"/>{limb("a b")}</body>', motors("a b"))
    claw = mjcf('<body name="claw"><geom name="tip" type="sphere" size="0.02" pos="0 0 0.1" mass="0.1"/></body>')
    scene = armctl.World().add("box", armctl.Box([0.1, 0.1, 0.1]), [0.9, 0, 0.05])
    spec = mujoco.MjSpec.from_string(floating)
    arm = loaded(spec, tool=mujoco.MjSpec.from_string(claw), scene=scene)
    assert arm.joint_names == ("a", "b")
    assert arm.model.body("box").id > 0
    assert len(spec.joints) == 3


def test_several_arms_and_chains_come_from_a_compiled_model():
    model = mujoco.MjModel.from_xml_string(mjcf(limb("a b c") + limb("d e"), motors("a b c d e")))
    assert [chain.joint_names for chain in armctl.chains(model)] == [("a", "b", "c"), ("d", "e")]
    arm = armctl.load(model, tips=["C", "E"])
    assert arm.joint_names == ("a", "b", "c", "d", "e")
    assert arm.tips == ("C", "E")


def test_the_name_of_the_model_is_the_name_of_the_arm():
    spec = mujoco.MjSpec.from_string(MODELS["motors"])
    assert armctl.load(spec).name == "trap"
    assert armctl.load(spec.compile()).name == "trap"


def test_a_specification_that_refers_to_nothing_is_refused():
    spec = mujoco.MjSpec.from_string(mjcf(limb("a"), '<actuator><motor joint="b"/></actuator>'))
    with pytest.raises(armctl.ModelError, match="trap: one of its actuators refers to an element"):
        armctl.load(spec)


def test_a_specification_that_does_not_compile_is_one_sentence():
    spec = mujoco.MjSpec.from_string(mjcf(limb("a"), motors("a")))
    spec.bodies[1].add_body(name="flat").add_geom(size=[0.0, 0.0, 0.0])
    with pytest.raises(armctl.ModelError, match=re.escape("trap: MuJoCo cannot compile it: Error: ")) as caught:
        armctl.load(spec)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("given", ["a file", "an MjSpec", "an MjModel"])
def test_a_time_step_is_the_tick_of_everything_that_runs_the_arm(given: str, tmp_path: Path):
    path = tmp_path / "arm.xml"
    path.write_text(MODELS["motors"])
    spec = mujoco.MjSpec.from_file(str(path))
    robot = {"a file": path, "an MjSpec": spec, "an MjModel": spec.compile()}[given]
    arm = loaded(robot, timestep=0.0005)
    assert arm.dt == armctl.Simulation(arm).dt == arm.with_payload(0.1).dt == 0.0005
    assert (robot.opt if given == "an MjModel" else spec.option).timestep == 0.002
    assert loaded(robot).dt == 0.002
    with pytest.raises(armctl.InputError, match=r"timestep: expected a number in \[1e-06, 0.1\], got 0"):
        armctl.load(robot, timestep=0.0)


def test_a_time_step_that_loose_bodies_do_not_bear_is_refused():
    world = armctl.World().add("cube", armctl.Box([0.05, 0.05, 0.05]), [0.4, 0.0, 0.03], mass=0.1)
    with pytest.raises(armctl.InputError, match=r"timestep: 0.002 s; in a scene with loose bodies it is at most 0.001 s"):
        armctl.load(BUNDLED, scene=world, timestep=0.002)
    assert armctl.load(BUNDLED, scene=world, timestep=0.0005).dt == 0.0005
