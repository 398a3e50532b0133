"""What becomes of the actuators, springs and sensors of a file: each attribute is represented, or named in one sentence."""

import dataclasses
import re
import subprocess
import sys

import mujoco
import numpy as np
import pytest
from synthetic import FAST, limb, mjcf, motors, rotor_spring_link

import armctl
from armctl.model.mjmodel.sensor_timing import sensor_timing

JOINT = 'armature="0.05" damping="0.5"'
DC = '<dcmotor name="m_b" joint="b" nominal="24 1.5 300" gear="50" {}/>'
BALL = '<body name="o" pos="2 0 0"><joint name="ball" type="ball"/><geom size="0.1" mass="1"/></body>'


def warned(caught) -> str:
    return "\n".join(str(each.message) for each in caught)


# What becomes of each attribute of actuators, joints and sensors in MJCF. The tables are compared with MuJoCo's own schema.
JOINT_ATTRIBUTES = {
    "kept": "name class group user type pos axis ref margin solimplimit solreflimit",
    "a limit of the arm": "limited range actuatorfrclimited actuatorfrcrange",
    "in the model of controllers": (
        "armature damping frictionloss solimpfriction solreffriction stiffness springref springdamper actuatorgravcomp"
    ),
    "simulated, and named by a warning": "springyield",
}
SENSOR_ATTRIBUTES = {
    "kept": "name class user cutoff noise joint actuator",
    "simulated, and named by a warning": "delay interval",
    "of MuJoCo's own buffer; measurements are held here until the next one": "nsample interp",
}
ATTRIBUTES = {
    "kept": "name class group user joint jointinparent tendon gear armature damping nsample interp delay",
    "a limit of the arm": "forcelimited forcerange nominal resistance motorconst saturation ctrllimited ctrlrange",
    "simulated, and named by a warning": "inductance cogging thermal lugre",
    "of a servo, which a torque motor replaces": (
        "kp kv ki kd dampratio timeconst imax slewmax posrange velrange ffrange inheritrange input controller actlimited "
        "actrange actdim actearly dyntype gaintype biastype dynprm gainprm biasprm area diameter bias plugin instance"
    ),
    "of a transmission that drives no joint of an arm": (
        "site refsite cranksite slidersite cranklength body gain lengthrange force scale lmin lmax vmax fpmax fvmax range "
        "tausmooth"
    ),
}
SECTIONS = {
    "actuator": (ATTRIBUTES, r"\n   actuator \(\*\)", r"\n   sensor \(\*\)", {"gear", "lugre", "kp", "nsample", "slewmax"}),
    "joint": (
        JOINT_ATTRIBUTES,
        r"\n      joint \(\*\) +(?=actuatorfrc)",
        r"\n +freejoint",
        {"armature", "springyield"},
    ),
    "sensor": (SENSOR_ATTRIBUTES, r"\n      jointpos \(\*\)", r"\n +tendonpos", {"delay", "interval", "noise"}),
    "actuator sensor": (
        SENSOR_ATTRIBUTES,
        r"\n      actuatorpos \(\*\)",
        r"\n +actuatorfrc",
        {"delay", "actuator"},
    ),
}


@pytest.mark.parametrize("section", SECTIONS)
def test_every_attribute_in_mujocos_schema_is_in_the_table(section):
    table, start, end, certain = SECTIONS[section]
    printed = subprocess.run(
        [sys.executable, "-c", "import mujoco; print(mujoco.mj_printSchema(False, True))"],
        capture_output=True,
        text=True,
        check=True,
    )
    text = re.split(end, re.split(start, printed.stdout)[1])[0]
    words = re.findall(r"[a-z_][a-z0-9_]*", re.sub(r"\n {6}\w+ \([*?!]\)", "\n", text))
    names = {word for word in words if word not in ("config", "key", "value")}
    assert certain <= names
    known = {name for group in table.values() for name in group.split()}
    assert names <= known, f"new in MuJoCo: {names - known}"


@pytest.mark.parametrize("inputs", ["pos vel", "pos", "pos vel ff"])
def test_a_pid_becomes_a_torque_motor_whatever_its_inputs(load, inputs):
    pid = f'<pid name="m_a" joint="a" kp="50" kv="5" ki="3" slewmax="2" input="{inputs}" forcerange="-20 20"/>'
    controls = " ".join("0.1" for _ in inputs.split())
    key = f'<keyframe><key name="home" qpos="0.1 0.2" ctrl="{controls} 0.3" act="0 0"/></keyframe>'
    arm = load(limb("a b", joint=JOINT), FAST + motors("a b", a=pid) + key)
    assert arm.model.nu == arm.n
    assert arm.model.na == 0
    assert arm.home.tolist() == [0.1, 0.2]
    assert arm.limits.tau_max.tolist() == [20.0, 20.0]
    assert any("torque motors replace the servos of a" in note for note in arm.notes)
    log = armctl.simulate(arm, "computed-torque", armctl.move_j(arm, arm.home, arm.home + 0.3))
    assert np.abs(log.q - log.q_ref).max() < 1e-12


def test_an_orientation_servo_in_the_scene_does_not_shift_the_arms_motors(load):
    rest = FAST + motors("a b").replace("<actuator>", '<actuator><orientation joint="ball" kp="5"/>')
    arm = load(limb("a b", joint=JOINT) + BALL, rest)
    assert arm.ctrl_adr.tolist() == [3, 4]
    log = armctl.simulate(arm, "computed-torque", armctl.move_j(arm, arm.home, arm.home + 0.3))
    assert np.abs(log.q - log.q_ref).max() < 1e-12


def test_stall_torque_and_no_load_speed_of_a_dc_motor_are_limits(load):
    arm = load(limb("a b", joint=JOINT), FAST + motors("a b", b=DC.format("")))
    assert arm.limits.tau_max[1] == pytest.approx(75.0)
    assert arm.limits.v_max[1] == pytest.approx(6.0)
    assert arm.limits.no_load_speed[0] == np.inf
    assert "stall torque" in arm.sources["tau_max"]
    assert "no-load speed" in arm.sources["v_max"]
    stalled = mujoco.MjModel.from_xml_string(mjcf(limb("a b", joint=JOINT), FAST + motors("a b", b=DC.format(""))))
    data = mujoco.MjData(stalled)
    data.ctrl[1] = 24.0
    mujoco.mj_forward(stalled, data)
    assert data.qfrc_actuator[1] == pytest.approx(75.0)


@pytest.mark.parametrize("limit", ['saturation="1 0 0"', 'ctrlrange="-12 12"'])
def test_saturation_and_voltage_lower_the_torque_limit(load, limit):
    arm = load(limb("a b", joint=JOINT), FAST + motors("a b", b=DC.format(limit)))
    assert arm.limits.tau_max[1] == pytest.approx(50.0 if "saturation" in limit else 37.5)
    assert arm.limits.no_load_speed[1] == pytest.approx(6.0 if "saturation" in limit else 3.0)


def test_nominal_data_are_found_in_classes_and_included_files(tmp_path):
    included = '<mujoco><default><default class="m"><dcmotor nominal="24 1.5 300"/></default></default></mujoco>'
    (tmp_path / "motor.xml").write_text(included)
    actuators = '<actuator><dcmotor class="m" joint="a" gear="50"/><dcmotor class="m" joint="b" gear="10"/></actuator>'
    text = mjcf(limb("a b", joint=JOINT), actuators).replace("<worldbody>", '<include file="motor.xml"/><worldbody>')
    (tmp_path / "arm.xml").write_text(text)
    arm = armctl.load(tmp_path / "arm.xml")
    assert arm.limits.tau_max == pytest.approx([75.0, 15.0])
    assert arm.limits.v_max == pytest.approx([6.0, 30.0])


def test_a_motion_slows_down_where_the_torque_of_a_dc_motor_falls_with_speed(load):
    weak = DC.replace("1.5", "0.2").format("")
    arm = load(limb("a b", joint=JOINT), FAST + motors("a b", a=weak.replace('"b"', '"a"').replace("m_b", "m_a"), b=weak))
    fast = armctl.move_j(arm, [-1.8, -1.8], [1.8, 1.8])
    assert fast.slowed is not None
    assert armctl.check_torque(arm, fast).ok
    log = armctl.simulate(arm, "computed-torque", fast)
    assert np.abs(log.q - log.q_ref).max() < 1e-9
    # MuJoCo's own motor does not give more: where the speed is left out, the voltage is not enough.
    ideal = arm.with_limits(dataclasses.replace(arm.limits, stall_torque=None, no_load_speed=None))
    impossible = armctl.move_j(ideal, [-1.8, -1.8], [1.8, 1.8])
    assert impossible.duration < fast.duration
    assert not armctl.check_torque(arm, impossible).ok
    log = armctl.simulate(arm, "computed-torque", impossible)
    assert np.abs(log.q - log.q_ref).max() > 1e-3


def test_what_else_a_dc_motor_has_is_simulated_and_named(load):
    with pytest.warns(armctl.ArmctlWarning) as caught:
        arm = load(
            limb("a b", joint=JOINT), FAST + motors("a b", b=DC.format('inductance="0 0.004" lugre="100 0.5 0.02 0.03 0.1"'))
        )
    assert "(b: inductance (4 ms) and LuGre friction (0.02 N m))" in warned(caught)
    log = armctl.simulate(arm, "computed-torque", armctl.move_j(arm, arm.home, arm.home + 0.3))
    assert 1e-5 < np.abs(log.q - log.q_ref).max() < 0.3


def test_a_compiled_model_keeps_its_dc_motor(load):
    rest = FAST + motors("a b", b=DC.format('inductance="0 0.004" saturation="1 0 0"'))
    with pytest.warns(armctl.ArmctlWarning, match="inductance"):
        arm = armctl.load(mujoco.MjModel.from_xml_string(mjcf(limb("a b", joint=JOINT), rest)))
    log = armctl.simulate(arm, "computed-torque", armctl.move_j(arm, arm.home, arm.home + 0.3))
    assert 1e-5 < np.abs(log.q - log.q_ref).max() < 0.1


def test_a_delay_of_an_actuator_is_named_and_simulated(load):
    late = '<motor name="m_b" joint="b" ctrlrange="-20 20" delay="0.004" nsample="4"/>'
    with pytest.warns(armctl.ArmctlWarning, match=r"delay commands \(b 4 ms\)"):
        arm = load(limb("a b", joint=JOINT), FAST + motors("a b", b=late))
    target = np.array([0.4, 0.4])
    log = armctl.simulate(arm, "pd-gravity", armctl.move_j(arm, arm.home, target), dwell=2.0)
    assert log.q[-1] == pytest.approx(target, abs=1e-3)
    step = np.flatnonzero(np.abs(log.tau_cmd[:, 1]) > 0.0)[0]
    assert log.tau[step + 4, 1] == pytest.approx(log.tau_cmd[step, 1])


def test_steps_too_short_for_the_buffer_of_a_delay_are_refused():
    rest = FAST + motors("a b", b='<motor name="m_b" joint="b" ctrlrange="-20 20" delay="0.004" nsample="4"/>')
    with pytest.warns(armctl.ArmctlWarning):
        arm = armctl.load(mujoco.MjModel.from_xml_string(mjcf(limb("a b", joint=JOINT), rest)))
    with pytest.raises(armctl.InputError, match=r"the delay of the actuator 'm_b' spans 20 steps, and its nsample is 4"):
        armctl.Plant(continuous=True).model(arm)


def test_a_spring_that_yields_is_named(load):
    with pytest.warns(armctl.ArmctlWarning, match=r"springs yield in simulation .* \(a beyond 0\.1 rad; b beyond 0\.1 rad\)"):
        load(limb("a b", joint='stiffness="5" springyield="0.1"'), motors("a b"))


def test_a_late_sensor_of_a_joint_is_named(load):
    sensors = '<sensor><jointpos name="encoder" joint="a" delay="0.002" nsample="2"/><jointpos joint="b"/></sensor>'
    with pytest.warns(armctl.ArmctlWarning, match=r"the sensors of joints are late \(a 2 ms\)"):
        load(limb("a b", joint=JOINT), FAST + motors("a b") + sensors)


@pytest.mark.parametrize("sensor", [
    'delay="0.0042"',
    'interval="0.0035 -0.0012"',
    'interval="0.006" delay="0.0015"',
    'interval="0.0004"',
])  # fmt: skip
def test_measurements_are_as_old_as_those_of_mujocos_own_sensor(sensor):
    text = mjcf(limb("a"), FAST + f'<sensor><jointpos joint="a" nsample="30" {sensor}/></sensor>')
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    ticks = np.arange(100)
    ages = sensor_timing(model, {0: 0}, {}, 1).ages(ticks, 0.001)[:, 0]
    positions = np.empty(100)
    for tick in ticks:
        positions[tick] = data.qpos[0]
        mujoco.mj_step1(model, data)
        if tick > 20:
            assert data.sensordata[0] == pytest.approx(positions[tick - ages[tick]], abs=1e-15)
        mujoco.mj_step2(model, data)


def test_many_late_joints_are_counted_and_no_phrase_is_cut(load):
    names = " ".join(f"j{i}" for i in range(18))
    late = {name: f'<motor joint="{name}" ctrlrange="-9 9" delay="0.004" nsample="4"/>' for name in names.split()}
    with pytest.warns(armctl.ArmctlWarning, match=r"j15 4 ms; and 2 more\); simulations"):
        load(limb(names), FAST + motors(names, **late))


def test_an_elastic_joint_continues_the_arm(load):
    with pytest.warns(armctl.ArmctlWarning, match=r"\(sa behind a, 400 N m/rad; sb behind b, 400 N m/rad\)"):
        arm = load(rotor_spring_link("a b", 400.0), FAST + motors("a b"))
    assert arm.joint_names == ("a", "b")
    assert arm.tip == "Lb"
    log = armctl.simulate(arm, "pd-gravity", armctl.move_j(arm, [0.1, 0.2], [0.5, 0.7]), dwell=1.0)
    springs = log.qpos[:, [1, 3]]
    assert np.abs(springs).max() > 1e-3
    # At rest, each spring carries what gravity asks of the link behind it.
    data = mujoco.MjData(arm.model)
    data.qpos[:] = log.qpos[0]
    mujoco.mj_forward(arm.model, data)
    assert 400.0 * springs[0] == pytest.approx(-data.qfrc_bias[[1, 3]], abs=1e-6)
    chains = armctl.chains(mujoco.MjModel.from_xml_string(mjcf(rotor_spring_link("a b", 400.0), motors("a b"))))
    assert [chain.joint_names for chain in chains if chain] == [("a", "b")]


def test_a_spring_without_a_motor_on_its_axis_still_ends_the_arm(load):
    turned = rotor_spring_link("a b", 400.0).replace('name="sa" axis="0 1 0"', 'name="sa" axis="1 0 0"')
    with pytest.warns(armctl.ArmctlWarning, match="the arm ends before joint 'sa'"):
        arm = load(turned, motors("a b"))
    assert arm.joint_names == ("a",)


@pytest.mark.parametrize(("version", "jacobian", "solver", "is_wrong"), [
    ("4.0.0", "sparse", "Newton", True),
    ("4.0.0", "auto", "Newton", False),
    ("4.0.0", "sparse", "CG", False),
    ("4.0.1", "sparse", "Newton", False),
])  # fmt: skip
def test_jacobians_are_dense_where_the_solver_of_mujoco_4_0_0_is_wrong(load, monkeypatch, version, jacobian, solver, is_wrong):
    monkeypatch.setattr(mujoco, "__version__", version)
    options = f'<option jacobian="{jacobian}" solver="{solver}"/>'
    arm = load(limb("a b", joint=JOINT), motors("a b") + options)
    compiled = armctl.load(mujoco.MjModel.from_xml_string(mjcf(limb("a b", joint=JOINT), motors("a b") + options)))
    for each in (arm, compiled):
        assert any("wrong accelerations with sparse Jacobians" in note for note in each.notes) == is_wrong
        assert (each.model.opt.jacobian == mujoco.mjtJacobian.mjJAC_DENSE) == is_wrong


def test_doctor_names_what_load_names(tmp_path):
    late = '<pid name="m_b" joint="b" kp="9" forcerange="-20 20" delay="0.004" nsample="4"/>'
    path = tmp_path / "arm.xml"
    path.write_text(mjcf(limb("a b", joint='springyield="0.1" stiffness="5"'), FAST + motors("a b", b=late)))
    found = armctl.diagnose(path)
    text = str(found)
    for phrase in ("delay commands (b 4 ms)", "springs yield", "torque motors replace the servos of b"):
        assert phrase in text
    assert all(
        finding.advice for finding in found.findings if finding.severity == "warning" and "delay commands" in finding.text
    )
