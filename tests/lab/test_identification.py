"""A payload is found by its torques: mass, centre and friction from one run, with honest errors, or a reason why not."""

import re
from dataclasses import replace

import numpy as np
import pytest
from arms import arm_of, some_of
from synthetic import limb, motors

import armctl
from armctl.lab.identification.payload import RowFilter
from armctl.model.collision.checkers import collision_checker
from armctl.plan.motion.torque_limits import check_torque

ROBOTS = ("robot_arm_3dof", "panda", "ur5e", "iiwa14", "so_arm100", "gantry")
MADE = ("robot_arm_3dof", "panda", "gantry")  # of which `make test` runs the tests
CENTER = np.array([0.02, 0.01, 0.05])


def run(arm, motion, controller="computed-torque-observer", **plant):
    return armctl.simulate(arm, controller, motion, armctl.Plant(timestep=0.002, **plant))


@pytest.fixture(scope="module")
def motions():
    made = {}

    def motion_of(robot):
        if robot not in made:
            made[robot] = armctl.excitation(arm_of(robot))
        return made[robot]

    return motion_of


@pytest.mark.parametrize("robot", some_of(ROBOTS, MADE))
def test_an_excitation_is_safe(robot, motions):
    arm, motion = arm_of(robot), motions(robot)
    path = motion.sample(np.arange(0.0, motion.duration, 0.005))
    assert arm.limits.contains(path.q, 1e-9)
    assert (np.abs(path.v) <= arm.limits.v_max * (1 + 1e-6)).all()
    assert (np.abs(path.a) <= arm.limits.a_max * (1 + 1e-6)).all()
    assert check_torque(arm, motion).ok
    assert check_torque(arm.with_payload(1.0), motion).ok
    assert not collision_checker(arm).along(path.q)
    assert np.allclose(path.q[0], arm.home)
    assert np.abs(path.v[[0]]).max() == 0.0


@pytest.mark.parametrize("robot", some_of([*ROBOTS, "xarm7"], MADE))
def test_what_takes_much_torque_is_shown_more_slowly(robot):
    arm = arm_of(robot)
    motion = armctl.excitation(arm, payload=2.0)
    assert check_torque(arm.with_payload(2.0), motion).ratio < 0.9
    assert check_torque(arm, motion).ratio < 0.9


@pytest.mark.parametrize("mass", [0.5, 2.0])
@pytest.mark.parametrize("robot", some_of(ROBOTS, MADE))
def test_a_payload_is_found_within_one_percent(robot, mass, motions):
    arm = arm_of(robot)
    log = run(arm, motions(robot), payload=mass, payload_center=CENTER)
    assert (np.abs(log.tau) < arm.limits.tau_max).all()
    found = armctl.identify_payload(arm, log)
    assert found.ok, found.reason
    assert found.mass == pytest.approx(mass, rel=0.01)
    shown = found.center_error < 0.02  # a gantry's slides do not show where along them a mass hangs
    assert np.abs(found.center - CENTER)[shown].max() < 2e-3


@pytest.mark.parametrize("robot", some_of(["panda", "ur5e", "iiwa14"]))
def test_a_payload_is_found_through_friction_and_noise(robot, motions):
    arm, rng = arm_of(robot), np.random.default_rng(3)
    coulomb, viscous = 0.02 * arm.limits.tau_max, 0.01 * arm.limits.tau_max
    friction = {"coulomb_friction": coulomb, "viscous_friction": viscous}
    log = run(arm, motions(robot), payload=1.0, encoder_noise=1e-5, velocity_noise=1e-3, **friction)
    seen = replace(log, q=log.q + 1e-5 * rng.normal(size=log.q.shape), v=log.v + 1e-3 * rng.normal(size=log.v.shape))
    found = armctl.identify_payload(arm, seen)
    assert found.ok, found.reason
    assert found.mass == pytest.approx(1.0, rel=0.03)
    assert np.abs(found.coulomb_friction / coulomb - 1).max() < 1.0  # MuJoCo's dry friction is partly viscous at low speed
    assert abs(found.mass - 1.0) < 5 * found.mass_error


@pytest.mark.parametrize("gain", [1.0, 1e-3])
def test_a_run_that_oscillates_is_refused(gain, motions):
    arm = arm_of("gantry")
    unstable = armctl.ComputedTorqueObserver(arm, bandwidth=80.0, damping_ratio=0.4, observer_bandwidth=140.0)
    log = run(arm, motions("gantry"), unstable, payload=2.0, payload_center=CENTER)
    # With smaller torques of the same shape, no motor is at its limit: then the oscillation itself is seen.
    found = armctl.identify_payload(arm, replace(log, tau=gain * log.tau))
    assert not found
    assert ("at its torque limit in" in found.reason) == (gain == 1.0)
    assert "oscillates" in found.reason


@pytest.mark.parametrize(
    ("robot", "moments"),
    [("ur5e", [0.02, 0.03, 0.015]), ("panda", [0.03, 0.02, 0.02]), ("iiwa14", [0.0, 0.04, 0.04])],
)
def test_the_inertia_of_a_payload_is_found_and_spoils_nothing_else(robot, moments, motions):
    arm = arm_of(robot)
    turn = armctl.Pose([0, 0, 0], rpy=[0.3, -0.5, 0.9]).rotation
    inertia = turn @ np.diag(moments) @ turn.T
    held = {"payload": 2.0, "payload_center": CENTER, "payload_inertia": inertia}
    log = run(arm, motions(robot), "computed-torque", encoder_noise=1e-5, **held)
    found = armctl.identify_payload(arm, log)
    assert found.ok, found.reason
    assert not found.findings
    assert found.mass == pytest.approx(2.0, rel=1e-3)
    assert found.center == pytest.approx(CENTER, abs=1e-3)
    assert found.inertia == pytest.approx(inertia, abs=0.003)
    assert (np.abs(found.inertia - inertia) < 3 * found.inertia_error).all()
    assert (found.inertia_error < 0.01).all()
    assert "moments of inertia [" in str(found)
    q = arm.home + 0.1
    carrying = arm.with_payload(2.0, CENTER, inertia)
    assert found.applied_to(arm).mass_matrix(q) == pytest.approx(carrying.mass_matrix(q), rel=0.02, abs=0.003)


def test_the_inertia_of_a_point_is_found_to_be_small(motions):
    found = armctl.identify_payload(arm_of("ur5e"), run(arm_of("ur5e"), motions("ur5e"), payload=1.0, payload_center=CENTER))
    assert found.ok, found.reason
    assert np.abs(found.inertia).max() < 1e-3
    assert "moments" not in str(found)


def test_an_inertia_that_no_motion_shows_is_said_to_be_unknown(tmp_path):
    arm = scara(tmp_path)
    motion = armctl.excitation(arm, payload=3.0)
    log = run(arm, motion, payload=3.0, payload_center=CENTER, payload_inertia=[0.02, 0.02, 0.03])
    found = armctl.identify_payload(arm, log)
    assert found.ok, found.reason
    assert found.inertia[2, 2] == pytest.approx(0.03, abs=found.inertia_error[2, 2])
    assert np.isfinite(found.inertia_error).tolist() == [[False] * 3, [False] * 3, [False, False, True]]
    assert "[not shown, not shown, 0.02" in str(found)


def test_nothing_held_is_found_to_be_nothing(motions):
    arm = arm_of("ur5e")
    found = armctl.identify_payload(arm, run(arm, motions("ur5e")))
    assert found.ok, found.reason
    assert abs(found.mass) < 0.02


def test_too_much_damping_in_the_model_is_reported_and_corrected(motions):
    real = arm_of("robot_arm_3dof")
    model = real.with_payload(0.0, viscous_friction=[0.0, 1.5, 0.0])
    found = armctl.identify_payload(model, run(real, motions("robot_arm_3dof"), "computed-torque", payload=0.5))
    assert found.ok, found.reason
    (finding,) = found.findings
    assert re.fullmatch(r"the model's damping of shoulder_pitch is 1\.(49|50?|51)\d? N m s/rad too high", finding), finding
    assert finding in str(found)
    with pytest.raises(armctl.InputError, match="arm: 4 joints, but the estimate is of an arm with 3"):
        found.applied_to(arm_of("gantry"))
    corrected = found.applied_to(model)
    assert corrected.model.dof_damping[corrected.dof_adr] == pytest.approx(real.model.dof_damping[real.dof_adr], rel=0.02)
    v = np.array([0.0, 1.0, 0.0])
    loaded = real.with_payload(found.mass, found.center)
    torques = [arm.inverse_dynamics(arm.home, v, np.zeros(3))[1] for arm in (corrected, loaded)]
    assert torques[0] == pytest.approx(torques[1], abs=0.05)


def test_less_friction_than_none_is_refused():
    arm = arm_of("robot_arm_3dof")
    with pytest.raises(armctl.InputError, match=r"^viscous_friction: shoulder_yaw: expected at least -2, got -2.5$"):
        arm.with_payload(0.0, viscous_friction=-2.5)


def test_the_result_goes_into_a_controller(motions):
    arm = arm_of("ur5e")
    motion, plant = motions("ur5e"), armctl.Plant(timestep=0.002, payload=1.0, payload_center=CENTER)
    found = armctl.identify_payload(arm, run(arm, motion, payload=1.0, payload_center=CENTER))
    before, after = (
        armctl.Report.from_log(armctl.simulate(arm, armctl.ComputedTorque(model), motion, plant))
        for model in (arm, found.applied_to(arm))
    )
    assert after.joint_rms_rad < 0.02 * before.joint_rms_rad


def test_an_arm_with_a_payload_is_the_plant_with_that_payload():
    arm = arm_of("panda")
    known = arm.with_payload(1.3, CENTER, coulomb_friction=0.2, viscous_friction=0.1)
    motion = armctl.move_j(arm, arm.home, arm.home + 0.2)
    plant = armctl.Plant(payload=1.3, payload_center=CENTER, coulomb_friction=0.2, viscous_friction=0.1)
    log = armctl.simulate(arm, armctl.ComputedTorque(known), motion, plant)
    assert np.abs(log.q - log.q_ref).max() < 1e-8
    q = arm.home
    more = known.gravity(q) - arm.gravity(q)
    assert np.abs(more).max() > 1.0


@pytest.mark.parametrize(
    ("motion", "reason"),
    [
        (lambda arm: armctl.move_j(arm, arm.home, arm.home + 1e-4), "no joint moves|at least"),
        (lambda arm: armctl.move_j(arm, arm.home, arm.home + 0.9 * np.eye(6)[0]), "the mass is known to"),
        (lambda arm: armctl.move_j(arm, arm.home, arm.home + 0.02), "at least"),
    ],
)
def test_a_poor_excitation_is_refused_with_its_reason(motion, reason):
    arm = arm_of("ur5e")
    found = armctl.identify_payload(arm, run(arm, motion(arm), payload=1.0))
    assert not found.ok
    assert not found
    assert re.search(reason, str(found))
    with pytest.raises(armctl.InputError, match="not identified"):
        found.applied_to(arm)


def scara(tmp_path, joints="zzp"):
    """Hinges about the vertical and a slide along it: no motion shows how high a payload is."""
    kinds = {
        "z": 'axis="0 0 1" range="-2 2"',
        "p": 'type="slide" axis="0 0 1" range="-0.2 0"',
        "y": 'axis="0 1 0" range="-2 2"',
    }
    geom = '<geom type="capsule" size="0.03" fromto="0 0 0 0.25 0 0" mass="1" contype="0" conaffinity="0"/>'
    bodies = "".join(f'<body pos="0.25 0 0.05"><joint name="j{i}" {kinds[kind]}/>{geom}' for i, kind in enumerate(joints))
    motors = "".join(f'<motor joint="j{i}" ctrlrange="-50 50"/>' for i in range(len(joints)))
    world = f'<worldbody>{bodies}<site name="tip" pos="0.25 0 0"/>{"</body>" * len(joints)}</worldbody>'
    path = tmp_path / "scara.xml"
    path.write_text(f'<mujoco><compiler angle="radian" autolimits="true"/>{world}<actuator>{motors}</actuator></mujoco>')
    return armctl.load(path)


def test_a_height_that_no_motion_shows_is_said_to_be_unknown(tmp_path):
    arm = scara(tmp_path)
    found = armctl.identify_payload(arm, run(arm, armctl.excitation(arm), payload=0.5, payload_center=CENTER))
    assert found.ok
    assert found.mass == pytest.approx(0.5, rel=0.01)
    assert found.center[:2] == pytest.approx(CENTER[:2], abs=1e-3)
    assert np.isfinite(found.center_error).tolist() == [True, True, False]
    assert "not shown] mm" in str(found)


def test_a_mass_that_no_motion_shows_is_refused_for_that(tmp_path):
    arm = scara(tmp_path, "z")
    found = armctl.identify_payload(arm, run(arm, armctl.excitation(arm), payload=0.5, payload_center=CENTER))
    assert not found
    assert "no motion of this arm separates it from the payload's center" in found.reason


def test_a_log_of_other_joints_is_refused():
    log = run(arm_of("ur5e"), armctl.move_j(arm_of("ur5e"), arm_of("ur5e").home, arm_of("ur5e").home + 0.1))
    with pytest.raises(armctl.InputError, match="log: it is of the joints"):
        armctl.identify_payload(arm_of("panda"), log)


def test_what_an_arm_cannot_carry_it_does_not_excite():
    with pytest.raises(armctl.PlanError, match="no motion from home shows a payload of 500 kg safely"):
        armctl.excitation(arm_of("robot_arm_3dof"), payload=500.0)


def test_an_excitation_that_fails_is_given_up_after_few_plans(bundled, monkeypatch):
    planned = []

    def fails(arm, waypoints):
        planned.append(np.abs(waypoints - arm.home).max())
        raise armctl.PlanError("it cannot be")

    monkeypatch.setattr("armctl.lab.identification.excitation.move_through", fails)
    with pytest.raises(armctl.PlanError, match="shows a payload of 1 kg safely: it cannot be"):
        armctl.excitation(bundled)
    assert len(planned) <= 8
    assert min(planned) < 0.5 * max(planned)  # sets near home had their turn as well


WRONG = [
    {"payload": -1.0},
    {"payload": 1e308},
    {"payload": np.nan},
    {"speed": 0.0},
    {"speed": 2.0},
    {"seed": -1},
    {"seed": 0.5},
    {"seed": np.random.default_rng(0)},
]


@pytest.mark.parametrize("arguments", WRONG, ids=" ".join)
def test_wrong_arguments_are_refused(bundled, arguments):
    with pytest.raises(armctl.InputError, match=f"{next(iter(arguments))}: "):
        armctl.excitation(bundled, **arguments)


def test_a_payload_that_the_motors_do_not_hold_at_home_is_refused_without_a_search(bundled, monkeypatch):
    def searched(*_):
        raise AssertionError("no set of configurations is needed")

    monkeypatch.setattr("armctl.lab.identification.excitation._ranked_sets", searched)
    with pytest.raises(armctl.PlanError, match="its weight there is more than the motors hold"):
        armctl.excitation(bundled, payload=1e6)


def test_a_seed_gives_the_same_motion_and_another_seed_another(bundled):
    one, same, other = (armctl.excitation(bundled, seed=seed) for seed in (3, 3, 4))
    assert np.array_equal(one.coefficients, same.coefficients)
    assert not np.array_equal(one.sample([1.0]).q, other.sample([1.0]).q)


def test_the_filter_is_a_gaussian_of_unit_gain_that_halves_the_power_at_ten_hertz():
    dt = 1e-3
    filtered = RowFilter(dt)
    t = dt * np.arange(4000)
    for frequency, gain in ((0.0, 1.0), (10.0, 2**-0.5)):
        angle = 2 * np.pi * frequency * t
        kept = filtered(np.column_stack([np.cos(angle), np.sin(angle)]))
        assert np.linalg.norm(kept, axis=1) == pytest.approx(gain, rel=2e-3)
    assert len(kept) == (4000 - 2 * filtered.radius - 1) // 25 + 1


def test_what_friction_leaves_of_a_motor_must_hold_the_payload(load):
    """Gravity and friction together exceed 90 % of what the motors give, neither of them alone."""
    arm = load(limb("a b c", joint='frictionloss="17"'), motors("a b c"))
    needed = np.abs(arm.with_payload(0.5).gravity(arm.home))
    assert needed.max() < 18.0 < needed.max() + 17.0
    with pytest.raises(armctl.PlanError, match="its weight there is more than the motors hold"):
        armctl.excitation(arm, payload=0.5)
