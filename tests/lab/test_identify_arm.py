"""An arm is identified from a recording: inertia, friction, offsets and delay, or a reason why not."""

import copy
import json
import re
from dataclasses import replace
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest
from arms import some_of
from synthetic import BENT, limb, motors, serial_arm, ties

import armctl
from armctl.cli.main import main
from armctl.core.filtering import derivatives
from armctl.lab.identification.fit_samples import speeds_of_torques
from armctl.lab.identification.pseudo_inertia import from_log_cholesky, inertial_parameters, pseudo_inertia, to_log_cholesky
from armctl.lab.identification.regressor import FrictionShape
from armctl.model.arm.arm import with_model
from armctl.model.arm.dynamics import Dynamics
from armctl.model.arm.passive_forces import DryFriction

TICK = 0.002


def changed(arm, seed=1, coulomb=0.0):
    """The arm with masses, centres, inertia, rotor inertia and damping up to 20 % wrong."""
    rng = np.random.default_rng(seed)
    model = copy.copy(arm.model)
    for body in range(1, model.nbody):
        model.body_mass[body] *= 1 + 0.2 * rng.uniform(-1, 1)
        model.body_ipos[body] *= 1 + 0.2 * rng.uniform(-1, 1, 3)
        model.body_inertia[body] *= 1 + 0.2 * rng.uniform(-1, 1)
        model.body_simple[body] = 0
        model.body_sameframe[body] = 0
    model.dof_simplenum[:] = 0
    model.dof_armature[arm.dof_adr] *= 1 + 0.2 * rng.uniform(-1, 1, arm.n)
    model.dof_damping[arm.dof_adr] *= 1 + 0.2 * rng.uniform(-1, 1, arm.n)
    model.dof_frictionloss[arm.dof_adr] += coulomb
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return with_model(arm, model)


def recorded(real, motion, seed=0, noise=0.1):
    log = armctl.simulate(real, "computed-torque-observer", motion, armctl.Plant(timestep=TICK), dwell=0.0)
    rng = np.random.default_rng(seed)
    q = log.q + noise * 1e-5 * rng.standard_normal(log.q.shape)
    tau = log.tau + noise * 2e-3 * log.tau_max * rng.standard_normal(log.tau.shape)
    return replace(log, q=q, tau=tau, v=np.full_like(q, np.nan))


@pytest.fixture(scope="module")
def arms(tmp_path_factory):
    return {name: serial_arm(tmp_path_factory.mktemp("arm"), BENT[name]) for name in ("planar", "six joints")}


@pytest.fixture(scope="module")
def motions(arms):
    """An excitation of each arm, made when a test asks for it."""

    class Motions(dict):
        def __missing__(self, name):
            return self.setdefault(name, armctl.excitation(arms[name], for_="arm"))

    return Motions()


@pytest.fixture(scope="module")
def planar(arms, motions):
    """The arm, the real one, and the estimate."""
    arm = arms["planar"]
    real = changed(arm, coulomb=0.3)
    return arm, real, armctl.identify(arm, recorded(real, motions["planar"]))


def tracking_error(real, model):
    motion = armctl.move_j(real, real.home, real.home + 0.5)
    log = armctl.simulate(real, armctl.ComputedTorque(model), motion, armctl.Plant(timestep=TICK))
    return armctl.Report.from_log(log).joint_rms_rad


@pytest.mark.parametrize("name", some_of(["planar", "six joints"], ["planar"]))
def test_an_identified_model_tracks_far_better(arms, motions, name):
    arm = arms[name]
    before = 0.0
    after = 0.0
    for seed in (1, 2):
        real = changed(arm, seed)
        found = armctl.identify(arm, recorded(real, motions[name]))
        assert found.ok, found.reason
        before += tracking_error(real, arm)
        after += tracking_error(real, found.applied_to(arm))
    assert after < 0.1 * before


def test_dry_friction_is_identified(planar):
    _, _, found = planar
    assert found.ok, found.reason
    assert found.coulomb_friction == pytest.approx(0.3, rel=0.02)
    assert any("frictionloss" in sentence and "too low" in sentence for sentence in found.findings)


@pytest.mark.parametrize("name", some_of(["planar", "six joints"], ["planar"]))
def test_every_link_is_one_that_a_body_can_be(arms, motions, name):
    """Checked by the principal moments and by the linear matrix inequality, both written out here."""
    arm = arms[name]
    found = armctl.identify(arm, recorded(changed(arm), motions[name], noise=5.0))
    assert found.consistent.all()
    for m, hx, hy, hz, xx, xy, yy, xz, yz, zz in found.inertia:
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        h = np.array([hx, hy, hz])
        matrix = np.block([[np.trace(inertia) / 2 * np.eye(3) - inertia, h[:, None]], [h[None], np.array([[m]])]])
        assert np.linalg.eigvalsh(matrix).min() > 0
        skew = np.array([[0, -hz, hy], [hz, 0, -hx], [-hy, hx, 0]])
        moments = np.linalg.eigvalsh(inertia + skew @ skew / m)
        assert m > 0
        assert moments.min() > 0
        assert moments[0] + moments[1] > moments[2]


def test_the_applied_model_has_the_identified_parameters(planar):
    arm, _, found = planar
    known = found.applied_to(arm)
    for i in range(arm.n):
        assert known.pinocchio_model.pin_model.inertias[i + 1].toDynamicParameters() == pytest.approx(
            found.inertia[i], abs=1e-9
        )
    assert known.model.dof_damping[arm.dof_adr] == pytest.approx(found.viscous_friction)
    assert known.model.dof_frictionloss[arm.dof_adr] == pytest.approx(found.coulomb_friction)
    q = arm.home
    v = np.full(arm.n, 0.5)
    zero = np.zeros(arm.n)
    viscous = known.inverse_dynamics(q, v, zero) - known.inverse_dynamics(q, zero, zero) - known.coriolis(q, v) @ v
    assert viscous == pytest.approx(0.5 * found.viscous_friction)
    assert found.friction_torque(v) == pytest.approx(0.5 * found.viscous_friction + found.coulomb_friction, rel=1e-3)


def test_a_written_urdf_is_the_identified_arm(planar, tmp_path):
    arm, _, found = planar
    known = found.applied_to(arm)
    q = arm.home + 0.1
    path = found.to_urdf(tmp_path / "arm.urdf")
    assert ElementTree.parse(path).getroot().get("name") == "serial"
    written = armctl.load(path, tip="tip")
    assert written.gravity(q) == pytest.approx(known.gravity(q), abs=1e-6)
    rotors = np.diag(known.model.dof_armature[known.dof_adr] - written.model.dof_armature[written.dof_adr])
    assert written.mass_matrix(q) + rotors == pytest.approx(known.mass_matrix(q), abs=1e-9)
    assert written.coriolis(q, q + 0.3) == pytest.approx(known.coriolis(q, q + 0.3), abs=1e-9)
    damping = known.model.dof_damping[known.dof_adr]
    assert written.model.dof_damping[written.dof_adr] == pytest.approx(damping)
    for bound in ("q_min", "q_max", "v_max", "tau_max"):
        assert getattr(written.limits, bound) == pytest.approx(getattr(known.limits, bound)), bound
    assert written.fk(q).position == pytest.approx(known.fk(q).position, abs=1e-9)


def test_a_written_mjcf_is_the_identified_arm(tmp_path):
    arm = serial_arm(tmp_path, BENT["planar"])
    found = armctl.identify(arm, recorded(changed(arm), armctl.excitation(arm, for_="arm")))
    known = found.applied_to(arm)
    written = armctl.load(found.to_mjcf(tmp_path / "out" / "arm.xml", tmp_path / "serial.xml"))
    q = arm.home + 0.1
    assert written.mass_matrix(q) == pytest.approx(known.mass_matrix(q), rel=1e-5, abs=1e-6)  # MuJoCo writes six digits
    assert written.gravity(q) == pytest.approx(known.gravity(q), abs=1e-4)
    with pytest.raises(armctl.ArmctlError):
        found.to_mjcf(tmp_path / "other.xml", "robot_arm_3dof")
    assert not (tmp_path / "other.xml").exists()


def test_the_validation_uses_torques_that_the_fit_has_not_seen(arms, motions):
    arm = arms["planar"]
    log = recorded(changed(arm), motions["planar"])
    tau = log.tau.copy()
    last = int(0.8 * len(tau))
    tau[last:] = 0.0
    found = armctl.identify(arm, log)
    spoiled = armctl.identify(arm, replace(log, tau=tau))
    assert found.validation.ok
    assert found.validation.rms == pytest.approx(
        np.sqrt(((found.validation.measured - found.validation.predicted) ** 2).mean(axis=0))
    )
    assert not spoiled
    # The arm of the model is weaker than the real one, so that torques of zero are nearer to its own.
    assert spoiled.reason.startswith("validation failed: ")
    assert spoiled.reason.endswith(" N m by the model before the fit")
    assert found.validation.t[0] >= 0.79 * log.t[-1]
    assert spoiled.inertia == pytest.approx(found.inertia, abs=0.3)


def test_a_joint_that_stands_still_is_named(arms):
    arm = arms["planar"]
    step = np.array([0.8, 0.0, 0.5])
    motion = armctl.move_through(arm, [arm.home, arm.home + step, arm.home - step, arm.home])
    found = armctl.identify(arm, recorded(arm, motion.scaled(0.4)))
    assert not found
    assert found.reason.startswith(f"these joints do not move: {arm.joint_names[1]};")
    assert any(arm.joint_names[1] in name for name in found.unexcited)
    with pytest.raises(armctl.InputError, match="not identified"):
        found.applied_to(arm)


def test_a_motion_that_conditions_the_regressor_badly_is_refused(arms):
    arm = arms["six joints"]
    motion = armctl.move_j(arm, arm.home, arm.home + 0.15, speed=0.05)
    found = armctl.identify(arm, recorded(arm, motion))
    assert not found
    assert found.reason.startswith("the condition number is ")
    assert found.condition_number > 1e5


def test_a_recording_that_is_delayed_is_aligned(arms, motions, tmp_path):
    arm = arms["planar"]
    log = recorded(changed(arm), motions["planar"], noise=0.1)
    shift = 4
    table = np.column_stack([log.t[shift:], log.q[shift:], log.tau[:-shift] + np.array([0.0, 0.5, -0.3])])
    path = tmp_path / "run.csv"
    header = "t,q1,q2,q3,tau1,tau2,tau3"
    np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.9g")
    found = armctl.identify(arm, path)
    assert found.ok, found.reason
    assert found.delay == pytest.approx(shift * TICK, abs=0.25 * TICK * shift)
    page = tmp_path / "page.html"
    assert armctl.identification_page(found, page) == page
    assert "<svg" in page.read_text()
    assert f"{found.cutoff:.3g} Hz" in page.read_text()


def test_what_a_robot_measured_may_be_late_whatever_its_names_say(arms, motions):
    arm = arms["planar"]
    log = recorded(changed(arm, coulomb=0.3), motions["planar"], noise=0.1)
    late = replace(log, t=log.t[:-4], q=log.q[4:], v=log.v[4:], tau=log.tau[:-4])
    found = armctl.identify(
        arm, replace(late, source=armctl.LogSource.ROBOT, continuous=True, controller="servo", plant="robot")
    )
    same = armctl.identify(arm, replace(late, source=armctl.LogSource.RECORDING, continuous=True))
    assert found.delay == same.delay == pytest.approx(4 * TICK, abs=TICK)
    assert np.array_equal(found.coulomb_friction, same.coulomb_friction)


def test_the_names_of_a_plant_decide_nothing(arms, motions):
    arm = arms["planar"]
    real = changed(arm, coulomb=0.3)
    for continuous, name in ((True, "worn gears"), (False, "discontinuous gears")):
        plants = [armctl.Plant(continuous=continuous, timestep=TICK, name=each) for each in ("", name)]
        logs = [armctl.simulate(real, "computed-torque-observer", motions["planar"], plant, dwell=0.0) for plant in plants]
        assert [log.continuous for log in logs] == [continuous, continuous]
        estimates = [armctl.identify(arm, log) for log in logs]
        assert np.array_equal(estimates[0].coulomb_friction, estimates[1].coulomb_friction)


def test_damping_that_the_model_has_too_much_of_is_a_finding(arms, motions):
    arm = arms["planar"]
    model = arm.with_payload(0.0, viscous_friction=[0.0, 3.0, 0.0])
    found = armctl.identify(model, recorded(arm, motions["planar"]))
    assert found.ok, found.reason
    [finding] = [each for each in found.findings if "damping" in each]
    amount = re.fullmatch(r"the model's damping of j1 is (\S+) N m s/rad too high", finding)
    assert amount is not None, finding
    assert float(amount[1]) == pytest.approx(3.0, rel=0.05)


@pytest.mark.parametrize("friction", ["none", "stribeck"])
def test_other_friction_models(arms, motions, friction):
    arm = arms["planar"]
    found = armctl.identify(arm, recorded(arm, motions["planar"]), friction)
    assert found.friction == friction
    assert found.validation.ok, found.validation.reason
    assert (found.breakaway >= 0).all()
    assert friction != "none" or not found.coulomb_friction.any()


def test_the_command_identifies_and_writes(arms, motions, tmp_path, capsys):
    arm = serial_arm(tmp_path, BENT["planar"])
    log = recorded(changed(arm), motions["planar"])
    np.savetxt(
        tmp_path / "run.csv",
        np.column_stack([1e3 * log.t, log.q, log.tau]),
        delimiter=",",
        header="time,a1,a2,a3,m1,m2,m3",
        comments="",
        fmt="%.9g",
    )
    words = ["identify", str(tmp_path / "serial.xml"), str(tmp_path / "run.csv"), "--json"]
    words += ["--columns", "t=time", "q=a*", "tau=m*", "--units", "t=ms"]
    files = [tmp_path / "page.html", tmp_path / "arm.xml", tmp_path / "arm.urdf"]
    status = main([*words, *(word for file in files for word in ("--out", str(file)))])
    out, _ = capsys.readouterr()
    assert json.loads(out)["ok"] == (status == 0)
    assert status == 0
    assert all(file.is_file() for file in files)
    assert main(["identify", str(tmp_path / "serial.xml"), str(tmp_path / "run.csv"), "--columns", "x=y"]) == 2


@pytest.mark.parametrize("name", some_of(["planar", "six joints"], ["planar"]))
def test_an_excitation_of_the_arm_is_safe_and_reports_its_condition(arms, motions, name):
    arm = arms[name]
    motion = motions[name]
    assert motion.duration == pytest.approx(5.0)
    assert motion.check_limits().ok
    assert armctl.check_torque(arm, motion).ok
    assert np.isnan(motion.clearance)  # these arms have no shapes
    assert 1.0 < motion.condition_number < 1e4
    assert motion.excites == "arm"
    assert np.allclose(motion(0.0).q, motion(5.0).q)


def test_an_excitation_of_an_arm_with_shapes_keeps_its_clearance(bundled):
    motion = armctl.excitation(bundled, for_="arm")
    assert motion.clearance > 0.004
    assert armctl.check_clearance(bundled, motion, 0.004).ok


def test_an_excitation_for_a_payload_reports_its_condition(bundled):
    motion = armctl.excitation(bundled)
    assert motion.excites == "payload"
    assert 1.0 <= motion.condition_number < 1e3


def test_coupled_joints_are_refused_with_the_reason(load):
    arm = load(limb("a b c d"), ties("c b 0.1 -0.5") + motors("a b d"))
    with pytest.raises(armctl.ModelError, match="follows another joint"):
        armctl.excitation(arm, for_="arm")


WRONG = [
    ({"friction": "viscous"}, "friction: expected .*got 'viscous'"),
    ({"consistent": 1}, "consistent: expected .*got 1"),
    ({"holdout": 0.0}, "holdout: expected .*got 0"),
    ({"log": 3}, "log: expected Log, got 3"),
]


@pytest.mark.parametrize(("arguments", "reason"), WRONG)
def test_wrong_arguments_are_refused(arms, motions, arguments, reason):
    arm = arms["planar"]
    given = {"log": recorded(arm, armctl.move_j(arm, arm.home, arm.home + 0.1))} | arguments
    with pytest.raises(armctl.InputError, match=reason):
        armctl.identify(arm, **given)


def test_a_short_or_foreign_log_is_refused(arms, bundled):
    arm = arms["six joints"]
    log = recorded(arm, armctl.move_j(arm, arm.home, arm.home + 0.1))
    with pytest.raises(armctl.InputError, match="expected at least 2 s"):
        armctl.identify(arm, log)
    with pytest.raises(armctl.InputError, match="6 joints are recorded"):
        armctl.identify(bundled, log)


def test_log_cholesky_factors_are_the_inverse_and_their_jacobian_is_exact():
    rng = np.random.default_rng(0)
    A = rng.standard_normal((4, 4))
    parameters = inertial_parameters(A @ A.T)
    assert pseudo_inertia(parameters) == pytest.approx(A @ A.T)
    z = to_log_cholesky(parameters)
    value, jacobian = from_log_cholesky(z)
    assert value == pytest.approx(parameters)
    for k in range(10):
        step = 1e-6 * np.eye(10)[k]
        slope = (from_log_cholesky(z + step)[0] - from_log_cholesky(z - step)[0]) / 2e-6
        assert jacobian[:, k] == pytest.approx(slope, abs=1e-6)


def test_the_identified_friction_is_a_stribeck_curve(planar):
    _, _, found = planar
    shape = FrictionShape(np.array([0.01, 0.02, 0.03]), np.array([0.1, 0.2, 0.3]))
    curve = replace(found, breakaway=np.array([1.0, 2.0, 3.0]), friction_speeds=shape)
    sliding = found.viscous_friction * np.array([0.2, -0.1, 0.6]) + found.coulomb_friction * np.array([1.0, -1.0, 1.0])
    falling = np.array([1.0, -2.0, 3.0]) * np.exp([-4.0, -0.25, -4.0])
    assert curve.friction_torque([0.2, -0.1, 0.6]) == pytest.approx(sliding + falling)
    sticking = 0.5 * (curve.coulomb_friction + curve.breakaway * np.exp(-0.0025))
    assert curve.friction_torque(0.5 * shape.smoothing) == pytest.approx(
        sticking + curve.viscous_friction * 0.5 * shape.smoothing, rel=1e-2
    )


@pytest.fixture(scope="module")
def light(tmp_path_factory):
    """An arm like "planar" with 1 N m of dry friction. Its last joint is so light that MuJoCo's acts fully at 40 rad/s."""
    arm = serial_arm(tmp_path_factory.mktemp("light"), BENT["planar"])
    model = copy.copy(arm.model)
    model.dof_frictionloss[arm.dof_adr] = 1.0
    model.dof_damping[arm.dof_adr] = 0.5
    model.dof_solimp[arm.dof_adr[-1], 0] = 0.5
    last = model.jnt_bodyid[arm.joint_map.joints[-1]]
    model.body_mass[last] = 0.05
    model.body_inertia[last] = 2e-4
    model.body_ipos[last] = [0.0, 0.0, 0.02]
    model.dof_armature[arm.dof_adr] = [0.1, 0.1, 0.0]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return with_model(arm, model)


@pytest.fixture(scope="module")
def rubbing(light):
    """The light arm with 1.6 N m of friction instead of 1, and what is identified."""
    real = changed(light, coulomb=0.6)
    return real, armctl.identify(light, recorded(real, armctl.excitation(light, for_="arm"), noise=0.2))


def test_friction_that_no_motion_shows_fully_has_a_large_standard_error(rubbing):
    real, found = rubbing
    assert found.ok, found.reason
    off = np.abs(found.coulomb_friction - real.model.dof_frictionloss[real.dof_adr])
    assert off[-1] > 0.3
    assert found.coulomb_error[-1] > 0.5 * off[-1]
    assert (off[:-1] < 0.03).all()
    assert (off[:-1] < 5 * found.coulomb_error[:-1] + 0.01).all()
    damping = real.model.dof_damping[real.dof_adr]
    assert found.viscous_friction == pytest.approx(damping, abs=0.05)


def test_an_arm_with_friction_that_acts_slowly_tracks_better_with_the_identified_model(light, rubbing):
    real, found = rubbing
    assert tracking_error(real, found.applied_to(light)) < 0.1 * tracking_error(real, light)


def test_the_torque_of_a_motion_contains_all_friction(planar, motions):
    arm, real, found = planar
    states = motions["planar"].sample(np.linspace(0.5, 4.5, 40))
    torques = found.torque(states.q, states.v, states.a)
    sliding = np.abs(states.v) > 0.1
    expected = real.model.dof_frictionloss[real.dof_adr] * np.sign(states.v)
    expected += [real.inverse_dynamics(*row) for row in zip(states.q, states.v, states.a, strict=True)]
    assert torques[sliding] == pytest.approx(expected[sliding], abs=0.05)
    assert found.torque(states.q[3], states.v[3], states.a[3]) == pytest.approx(torques[3])
    without = found.applied_to(arm).inverse_dynamics(states.q[3], states.v[3], states.a[3])
    assert found.torque(states.q[3], states.v[3], states.a[3]) - without == pytest.approx(
        found.friction_torque(states.v[3]) - found.viscous_friction * states.v[3]
    )
    with pytest.raises(armctl.InputError, match="three arrays of one shape"):
        found.torque(states.q, states.v[0], states.a)


def test_an_excitation_starts_elsewhere_if_home_is_too_close_to_something(bundled):
    tip = bundled.fk(bundled.home).position
    shapes = [
        geom for geom in range(bundled.model.ngeom) if bundled.model.geom_bodyid[geom] and bundled.model.geom_contype[geom]
    ]
    scene = armctl.World().add("ball", armctl.Ball(0.02), at=tip + np.array([0.0, 0.0, 0.2]))
    arm = armctl.load("robot_arm_3dof", scene=scene)
    data = mujoco.MjData(arm.model)
    data.qpos[:] = arm.home_qpos
    ball = arm.model.geom("ball").id
    body = arm.model.geom_bodyid[ball]
    for _ in range(10):  # until the closest link is 2 mm away
        mujoco.mj_kinematics(arm.model, data)
        closest = min(mujoco.mj_geomDistance(arm.model, data, geom, ball, 1.0, None) for geom in shapes)
        arm.model.body_pos[body, 2] -= closest - 0.002
    with pytest.warns(armctl.ArmctlWarning, match="as none from home is safe; move there first"):
        motion = armctl.excitation(arm, for_="arm")
    start = motion(0.0).q
    assert np.abs(start - arm.home).max() > 0.01
    assert motion(motion.duration).q == pytest.approx(start)
    assert armctl.check_clearance(arm, motion, 0.004).ok
    with pytest.raises(armctl.PlanError, match=r"touches .* within 5 mm"):
        armctl.excitation(arm, for_="arm", start=arm.home)


@pytest.mark.nightly
def test_a_long_excitation_is_found_among_obstacles():
    """Balls around the arm: of random straight ways a part is free, of thirty in a row none."""
    scene = armctl.World()
    for i, angle in enumerate(np.linspace(0.0, 2 * np.pi, 6, endpoint=False) + 0.5):
        scene = scene.add(f"ball{i}", armctl.Ball(0.05), at=[0.45 * np.cos(angle), 0.45 * np.sin(angle), 0.5])
    arm = armctl.load("robot_arm_3dof", scene=scene)
    motion = armctl.excitation(arm, duration=20.0, for_="arm", start=arm.home)
    assert motion.duration == pytest.approx(20.0)
    assert armctl.check_clearance(arm, motion, 0.004).ok
    assert armctl.check_torque(arm, motion).ratio < 1.0


def test_an_excitation_for_the_arm_starts_where_it_is_told_to(arms):
    arm = arms["planar"]
    start = arm.home + np.array([0.2, -0.1, 0.1])
    motion = armctl.excitation(arm, for_="arm", start=start)
    assert motion(0.0).q == pytest.approx(start)
    assert motion(motion.duration).q == pytest.approx(start)
    with pytest.raises(armctl.InputError, match="starts at home"):
        armctl.excitation(arm, start=start)


def test_torques_act_at_the_speeds_before_and_after_mujocos_step(tmp_path):
    arm = serial_arm(tmp_path, BENT["rubbing"])
    log = armctl.simulate(arm, "computed-torque", armctl.move_j(arm, arm.home, arm.home + 0.3))
    friction = DryFriction.from_model(arm.model, arm.joint_map)
    dynamics = Dynamics(arm.model, arm.pinocchio_model)
    speeds = speeds_of_torques(friction, dynamics, log, log.q, *derivatives(log.q, log.dt))
    assert np.abs(log.v).max() > 0.5
    assert speeds.start[2:-2] == pytest.approx(log.v[2:-2], abs=1e-8)
    assert speeds.end[2:-3] == pytest.approx(log.v[3:-2], abs=1e-8)


@pytest.mark.parametrize("share", [0.004, 0.01])
def test_friction_of_bristles_is_identified_like_dry_friction(arms, motions, share):
    arm = arms["six joints"]
    coulomb = share * arm.limits.tau_max
    plant = armctl.Plant(coulomb_friction=coulomb, friction="lugre", timestep=TICK)
    log = armctl.simulate(arm, "computed-torque-observer", motions["six joints"], plant, dwell=0.0)
    found = armctl.identify(arm, log)
    assert found.ok, found.reason
    assert found.coulomb_friction == pytest.approx(coulomb, rel=0.05)
