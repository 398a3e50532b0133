"""The position servos of an arm are found from commanded and measured positions; another motion is the judge."""

import copy
from dataclasses import replace

import mujoco
import numpy as np
import pytest

import armctl
from armctl.lab.identification.identify_servo import better_rival
from armctl.lab.identification.servo_fit import ServoFit
from armctl.lab.identification.servo_simulation import ServoParameters, ServoSimulation
from armctl.model.arm.arm import with_model

DT = 0.02
SECONDS = 8.0
STEP = 0.0005  # of the real arm: a quarter of the model's
COUNT = 2 * np.pi / 4096
DELAY = 0.033
TRUE = {
    "armature": np.array([0.02, 0.03]),
    "stiffness": np.array([17.0, 22.0]),
    "damping": np.array([0.7, 0.5]),
    "coulomb_friction": np.array([0.04, 0.06]),
    "offset": np.array([0.01, -0.006]),
}
ARM = """<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body name="A" pos="0 0 0.3"><joint name="a" axis="{axis}" range="-1.5 1.5" armature="{armature[0]}" frictionloss="{loss[0]}"/>
<geom type="capsule" fromto="0 0 0 0 0 0.12" size="0.02" mass="0.2" contype="0"/>
<body name="B" pos="0 0 0.12"><joint name="b" axis="{axis}" range="-1.5 1.5" armature="{armature[1]}" frictionloss="{loss[1]}"/>
<geom type="capsule" fromto="0 0 0 0 0 0.15" size="0.02" mass="0.2" contype="0"/><site name="tip" pos="0 0 0.15"/></body></body>
</worldbody><actuator>{motors}</actuator></mujoco>"""
SERVO = '<position name="{0}" joint="{0}" kp="{1}" kv="{2}" ctrlrange="-1.5 1.5" forcerange="-40 40"/>'


def text(armature, stiffness, damping, loss, axis="0 1 0", gap=0.0):
    motors = "".join(SERVO.format(*row) for row in zip("ab", stiffness, damping, strict=True))
    found = ARM.format(armature=armature, loss=loss, motors=motors, axis=axis)
    if not gap:
        return found
    joint = f'axis="{axis}" range="{-gap / 2} {gap / 2}" damping="0.001" armature="1e-4" solreflimit="0.004 1"'
    between = f'<geom size="0.01" mass="0.001" contype="0"/><body><joint {joint}/><geom type="capsule"'
    return found.replace('<geom type="capsule"', between).replace("</worldbody>", "</body></body></worldbody>")


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("arm") / "servos.xml"
    path.write_text(text([0.01, 0.01], [30, 30], [1, 1], [0.02, 0.02]))
    return path


def commands(seed):
    """(T, 2) rad, smooth motions between random positions, twice a second, from rest."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, SECONDS, DT)
    knots = np.concatenate([np.zeros((2, 2)), rng.uniform(-1, 1, (int(2 * SECONDS), 2))])
    share = np.clip(2.0 * (2.0 * t % 1.0), 0.0, 1.0)[:, None]  # a ramp, then a stop
    before = knots[(2 * t).astype(int)]
    after = knots[(2 * t).astype(int) + 1]
    return before + (after - before) * share * share * (3 - 2 * share)


def measured(command, axis="0 1 0", gap=0.0, real=TRUE):
    """What encoders of 12 bits read of the real arm, stepped by MuJoCo."""
    model = mujoco.MjModel.from_xml_string(
        text(real["armature"], real["stiffness"], real["damping"], real["coulomb_friction"], axis, gap)
    )
    model.opt.timestep = STEP
    data = mujoco.MjData(model)
    servos = [model.joint(name).qposadr[0] for name in "ab"]
    steps = round(DT / STEP)
    lag = round(DELAY / STEP)
    q = []
    for tick in range(-50, len(command)):
        if tick >= 0:
            q.append(data.qpos[servos])
        for step in range(steps):
            data.ctrl[:] = command[max(0, (tick * steps + step - lag) // steps)]
            mujoco.mj_step(model, data)
    return np.round((np.array(q) + real["offset"]) / COUNT) * COUNT


def recorded(arm, seed, axis="0 1 0", gap=0.0, real=TRUE):
    command = commands(seed)
    return armctl.Log.from_positions(DT, measured(command, axis, gap, real), command, joint_names=arm.joint_names)


@pytest.fixture(scope="module")
def known(file):
    arm = armctl.load(file)
    return arm, armctl.identify_servo(arm, recorded(arm, 1), judge=recorded(arm, 2), source=file)


def test_parameters_are_those_of_the_real_servos(known):
    _, found = known
    assert found, found.reason
    assert found.unseen == ("b backlash",)  # 8 s do not exclude 6 mrad
    assert not found.parameters.backlash.any()
    for name, true in TRUE.items():
        assert getattr(found.parameters, name) == pytest.approx(true, rel=0.1), name
    assert found.parameters.delay == pytest.approx(DELAY, rel=0.02)
    assert 0 < found.errors.delay < 1e-3


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("stiffness", "damping"),
    [([500, 1.1], [7.0, 0.1]), ([17, 22], [7.0, 0.05])],
    ids=["one 30 times softer than the file and one 20 times stiffer", "other damping ratios"],
)
def test_servos_are_found_from_files_with_others(tmp_path, stiffness, damping):
    path = tmp_path / "others.xml"
    path.write_text(text([0.01, 0.01], stiffness, damping, [0.02, 0.02]))
    arm = armctl.load(path)
    found = armctl.identify_servo(arm, recorded(arm, 1), judge=recorded(arm, 2), source=path)
    assert found, found.reason
    assert not found.parameters.backlash.any()
    for name, true in TRUE.items():
        assert getattr(found.parameters, name) == pytest.approx(true, rel=0.1), name
    assert found.parameters.delay == pytest.approx(DELAY, rel=0.02)


@pytest.mark.nightly
def test_stiff_servos_are_within_their_errors_and_have_no_backlash(known, file):
    """Steps of 2 ms damp servos of 70 rad/s by a tenth less: the errors say so, whatever the noise is."""
    arm, _ = known
    real = {**TRUE, "stiffness": np.array([160.0, 170.0]), "damping": np.array([3.0, 2.6])}
    found = armctl.identify_servo(arm, recorded(arm, 1, real=real), judge=recorded(arm, 2, real=real), source=file)
    assert found, found.reason
    assert not found.parameters.backlash.any()
    assert found.parameters.delay == pytest.approx(DELAY, abs=0.001)
    for name, true in real.items():
        error = np.abs(getattr(found.parameters, name) - true)
        assert (error <= 4.0 * getattr(found.errors, name) + 0.02 * np.abs(true)).all(), name
    assert found.errors.delay < 0.001


@pytest.mark.nightly
def test_an_error_above_the_noise_of_the_positions_is_not_ok(known, file):
    """Gears that are not round add 4 mrad to both motions in the same way: neither the file nor the recording shows it."""
    arm, exact = known
    assert exact.noise == pytest.approx(COUNT / np.sqrt(12), rel=0.25)
    logs = [recorded(arm, seed) for seed in (1, 2)]
    logs = [replace(log, q=np.round((log.q + 0.004 * np.sin(12 * log.q)) / COUNT) * COUNT) for log in logs]
    found = armctl.identify_servo(arm, logs[0], judge=logs[1], source=file)
    assert not found
    assert "the noise of its positions" in found.reason
    assert found.judge_rms.max() > 2.5 * found.noise.max()


@pytest.mark.nightly
def test_backlash_is_found_where_there_is_one(known, file):
    arm, without = known
    assert not without.parameters.backlash.any()
    found = armctl.identify_servo(arm, recorded(arm, 1, gap=0.02), judge=recorded(arm, 2, gap=0.02), source=file)
    assert found, found.reason
    assert found.unseen == ()
    assert found.parameters.backlash == pytest.approx(0.02, rel=0.3)
    assert found.parameters.armature == pytest.approx(TRUE["armature"], rel=0.1)
    assert (found.errors.backlash > 0).all()


@pytest.mark.parametrize(("seed", "slow", "told"), [(2, False, True), (None, True, False)], ids=["reversals", "at rest"])
def test_a_backlash_stays_only_if_the_judge_rejects_the_fit_without_it(file, seed, slow, told):
    """The rival has the same true parameters and no gaps: it fails along reversals, and not where both arms rest."""
    arm = armctl.load(file)
    log = recorded(arm, 1, gap=0.02)
    judge = replace(log, q=np.tile(log.q[:1], (len(log), 1)), q_ref=np.tile(log.q_ref[:1], (len(log), 1))) if slow else None
    fits = []
    for gap in (0.02, 0.0):
        true = ServoParameters(**TRUE, backlash=np.full(2, gap), delay=DELAY)
        fit = ServoFit(arm, log, true)
        fit.z[8:10] = TRUE["offset"]
        fit.z[10:12] = 100 * gap
        fit.z[-1] = DELAY / DT
        fit._simulation = ServoSimulation(arm, DT, gap > 0)
        fits.append(fit)
    reason = better_rival(fits[0], fits[1:], judge or recorded(arm, seed, gap=0.02))
    assert (reason == "") is told
    assert told or "as well without a backlash as with one of 20 mrad" in reason


@pytest.mark.nightly
def test_rotor_inertia_that_is_small_beside_that_of_links_is_within_its_error(known, file):
    """A rotor with 5 % of its joint's inertia: steps of 2 ms move the arm by more than the whole rotor does."""
    arm, _ = known
    real = {**TRUE, "armature": np.array([0.0012, 0.003])}
    found = armctl.identify_servo(arm, recorded(arm, 1, real=real), judge=recorded(arm, 2, real=real), source=file)
    for joint, name in enumerate(arm.joint_names):
        error = abs(found.parameters.armature[joint] - real["armature"][joint])
        assert f"{name} armature" in found.unseen or error <= 4.0 * found.errors.armature[joint]


def test_a_gap_is_between_the_motor_and_the_link_of_the_arm_and_not_of_its_file(known):
    """The links of a heavy arm with gaps droop from motors without friction by half a gap, towards the side of their weight."""
    arm, found = known
    heavy = copy.copy(arm.model)
    heavy.body_mass[:] *= 2
    simulation = ServoSimulation(with_model(arm, heavy), DT, True)
    model = simulation.model(replace(found.parameters, backlash=np.array([0.02, 0.03])))
    assert model.body_mass[: heavy.nbody] == pytest.approx(heavy.body_mass)
    data = mujoco.MjData(model)
    data.ctrl[:] = data.qpos[:2] = data.qpos[2:] = (0.5, 0.3)
    mujoco.mj_step(model, data, 2000)
    assert data.qpos[:2] - data.qpos[2:] == pytest.approx([0.01, 0.015], abs=1e-3)


def test_another_motion_is_predicted_to_the_resolution_of_the_encoder(known):
    arm, found = known
    fresh = recorded(arm, 3)
    error = (found.positions(fresh) - fresh.q)[15:]
    assert np.sqrt(np.mean(error**2)) < 1.2 * COUNT / np.sqrt(12)
    assert (found.judge_rms < 0.05 * found.judge_file_rms).all()


def test_files_have_the_identified_servos(known, file, tmp_path):
    arm, found = known
    model = mujoco.MjModel.from_xml_path(str(found.to_mjcf(tmp_path / "new.xml", source=file)))
    known = found.parameters
    assert model.actuator_gainprm[:, 0] == pytest.approx(known.stiffness, rel=1e-5)
    assert model.actuator_biasprm[:, 2] == pytest.approx(-known.damping, rel=1e-5)
    assert model.dof_armature == pytest.approx(known.armature, rel=1e-5)
    assert model.dof_frictionloss == pytest.approx(known.coulomb_friction, rel=1e-5)
    assert model.actuator_delay == pytest.approx(known.delay, rel=1e-5)
    # MuJoCo's own delay and servos move as the simulation in the arm's steps does.
    command = commands(3)
    data = mujoco.MjData(model)
    q = []
    for row in command:
        q.append(data.qpos.copy())
        data.ctrl[:] = row
        mujoco.mj_step(model, data, round(DT / model.opt.timestep))
    step = model.opt.timestep
    whole = step * (np.ceil(known.delay / step) - 0.5)  # MuJoCo delays by whole steps; its positions are half a step early
    log = armctl.Log.from_positions(DT, np.zeros_like(command), command, joint_names=arm.joint_names)
    simulated = ServoSimulation(arm, DT, False).positions([replace(known, delay=whole)], log)[0]  # in the steps of the file
    assert np.abs(np.array(q) + known.offset - simulated)[25:].max() < 2e-3
    urdf = armctl.load(found.to_urdf(tmp_path / "new.urdf"), tip="tip")
    assert urdf.model.dof_frictionloss[urdf.dof_adr] == pytest.approx(known.coulomb_friction)
    assert found.applied_to(arm).mass_matrix(arm.home)[1, 1] > arm.mass_matrix(arm.home)[1, 1]


@pytest.mark.full
@pytest.mark.parametrize(
    ("before", "after"),
    [
        pytest.param('<motor joint="a" gear="2" ctrlrange="-1 1"/>', "", marks=pytest.mark.nightly),
        pytest.param(
            "", '<position joint="a" kp="20" kv="1" ctrlrange="-1.5 1.5" forcerange="-20 20"/>', marks=pytest.mark.nightly
        ),
        pytest.param(
            '<velocity joint="b" kv="1" forcerange="-5 5"/>',
            '<motor joint="a" forcerange="-1 1"/>',
            marks=pytest.mark.nightly,
        ),
    ],
    ids=["a motor before the servo", "two servos", "two on both"],
)
def test_a_joint_with_two_actuators_gets_one_servo_with_the_gains_of_both(before, after, tmp_path):
    path = tmp_path / "two.xml"
    more = f"<actuator>{before}"
    count = 2 + sum(bool(each) for each in (before, after))
    key = f'</actuator><keyframe><key ctrl="{" ".join(["0"] * count)}"/></keyframe>'
    plain = text([0.01, 0.01], [30, 30], [1, 1], [0.02, 0.02])
    path.write_text(plain.replace("<actuator>", more).replace("</actuator>", f"{after}{key}"))
    with pytest.warns(armctl.ArmctlWarning, match="one motor with the sum of their torques replaces them"):
        arm = armctl.load(path)
    found = armctl.identify_servo(arm, recorded(arm, 1), judge=recorded(arm, 2), source=path)
    assert found, found.reason
    assert found.parameters.stiffness == pytest.approx(TRUE["stiffness"], rel=0.1)
    model = mujoco.MjModel.from_xml_path(str(found.to_mjcf(tmp_path / "new.xml", source=path)))
    joints = [model.joint(int(joint)).name for joint in model.actuator_trnid[:, 0]]
    assert sorted(joints) == ["a", "b"]
    order = [joints.index(name) for name in arm.joint_names]
    assert model.actuator_gainprm[order, 0] == pytest.approx(found.parameters.stiffness, rel=1e-5)
    assert -model.actuator_biasprm[order, 2] == pytest.approx(found.parameters.damping, rel=1e-5)
    assert model.actuator_forcerange[order, 1] == pytest.approx(arm.limits.tau_max)


@pytest.mark.nightly
def test_without_gravity_the_scale_is_not_shown(tmp_path):
    """Both joints turn about the vertical, with links on their axes: positions show ratios only."""
    path = tmp_path / "vertical.xml"
    path.write_text(text([0.01, 0.01], [30, 30], [1, 1], [0.02, 0.02], "0 0 1"))
    arm = armctl.load(path)
    found = armctl.identify_servo(arm, recorded(arm, 1, "0 0 1"), judge=recorded(arm, 2, "0 0 1"), source=path)
    assert found, found.reason
    assert {"a stiffness", "b stiffness"} <= set(found.unseen)
    ratio = TRUE["stiffness"] / TRUE["armature"]
    assert found.parameters.stiffness / found.parameters.armature == pytest.approx(ratio, rel=0.1)
    assert found.parameters.delay == pytest.approx(DELAY, rel=0.1)


@pytest.mark.full
def test_a_judge_that_moves_otherwise_rejects(known, file):
    arm, _ = known
    judge = recorded(arm, 2)
    judge = replace(judge, q=judge.q + 0.05 * np.sin(3 * judge.t)[:, None])
    compiled = armctl.load(mujoco.MjModel.from_xml_path(str(file)), tip="tip")  # it can get no gaps
    found = armctl.identify_servo(compiled, recorded(arm, 1), judge=judge, source=file)
    assert not found
    assert "along the judge" in found.reason
    assert found.unseen == ("a backlash", "b backlash")
    assert np.isnan(found.errors.backlash).all()
    with pytest.raises(armctl.InputError, match="not identified"):
        found.applied_to(arm)


def test_bad_recordings_are_one_sentence(known, file):
    arm, _ = known
    log = recorded(arm, 1)
    with pytest.raises(armctl.InputError, match="judge: it has the same commands"):
        armctl.identify_servo(arm, log, judge=log, source=file)
    with pytest.raises(armctl.InputError, match="q_ref holds the commanded positions"):
        armctl.identify_servo(arm, replace(log, q_ref=np.full_like(log.q, np.nan)), judge=log, source=file)
    short = armctl.Log.from_positions(DT, log.q[:100], log.q_ref[:100], joint_names=arm.joint_names)
    other = armctl.Log.from_positions(DT, log.q, log.q_ref, joint_names=("x", "y"))
    with pytest.raises(armctl.InputError, match="at least 3 s"):
        armctl.identify_servo(arm, short, judge=log, source=file)
    with pytest.raises(armctl.InputError, match="expected the shape of q"):
        armctl.Log.from_positions(DT, log.q, log.q_ref[:9], joint_names=arm.joint_names)
    with pytest.raises(armctl.InputError, match="it is of the joints"):
        armctl.identify_servo(arm, other, judge=log, source=file)


@pytest.mark.parametrize(
    "wrong",
    [
        {"joint_names": 5},
        {"joint_names": "xy"},
        {"joint_names": np.array(1.0)},
        {"joint_names": ["x", 1]},
        {"units": ["rad", "deg"]},
        {"units": ["m"]},
        {"robot": 5},
    ],
)
def test_wrong_names_and_units_of_positions_are_refused(wrong):
    (name,) = wrong
    q = np.zeros((10, 2))
    with pytest.raises(armctl.InputError, match=f"^{name}: expected"):
        armctl.Log.from_positions(DT, q, q, **{"joint_names": ["x", "y"], **wrong})


def test_a_log_of_positions_is_written_and_read(known, tmp_path):
    arm, _ = known
    log = recorded(arm, 1)
    again = armctl.Log.load(log.save(tmp_path / "run.npz"))
    assert np.array_equal(again.q, log.q)
    assert np.array_equal(again.q_ref, log.q_ref)
