"""What is between motors, links and controllers of a plant: springs, gaps, windings, bristles, sensors."""

import pickle
from dataclasses import replace

import instability
import mujoco
import numpy as np
import pytest
from arms import some_of
from instability import grows
from synthetic import FAST, limb, mjcf, motors, rotor_spring_link

import armctl

JOINT = 'armature="0.1" damping="0.5"'
SPRING = {"elasticity": 1000.0, "rotor_inertia": 0.2}
PLANTS = [
    armctl.Plant(jitter=2),
    armctl.Plant(sensor_delay=2),
    armctl.Plant(continuous=True, velocity="true"),
    armctl.Plant(continuous=True, **SPRING),
    armctl.Plant(motor=0.003),
    armctl.Plant(**SPRING),
    armctl.Plant(**SPRING, encoder_side="link"),
    armctl.Plant(**SPRING, motor=0.002, sensor_delay=1),
    armctl.Plant(elasticity=[0.0, 1000.0], rotor_inertia=0.2),
]


@pytest.fixture
def arm(load):
    return load(limb("a b", joint=JOINT), FAST + motors("a b"))


def motion(arm):
    return armctl.move_j(arm, arm.home, arm.home + 0.4)


@pytest.mark.parametrize("plant", some_of(PLANTS, PLANTS[1:8:2]), ids=str)
@pytest.mark.parametrize("law", some_of(["pd", "computed-torque-observer"], ["pd"]))
def test_margins_with_a_plants_imperfections_are_those_of_its_simulation_to_the_tick(arm, law, plant):
    loop = armctl.linearize(arm, law, arm.home, plant)
    found = loop.margins()
    if not found.ok:
        assert plant.encoder_side == "link"
        assert grows(arm, law, loop, 0, plant)
        return
    ticks = int(found.delay_margin / loop.dt)
    assert not grows(arm, law, loop, ticks, plant)
    assert grows(arm, law, loop, ticks + 1, plant)


@pytest.mark.parametrize("law", ["pd", "computed-torque-observer"])
def test_margins_hold_to_the_tick_with_steps_of_an_encoder_below_the_deviation(arm, law, monkeypatch):
    monkeypatch.setattr(instability, "DEVIATION", 1e-3)
    plant = armctl.Plant(encoder_bits=26)
    loop = armctl.linearize(arm, law, arm.home, plant)
    ticks = int(loop.margins().delay_margin / loop.dt)
    assert not grows(arm, law, loop, ticks, plant)
    assert grows(arm, law, loop, ticks + 1, plant)


@pytest.mark.parametrize(
    "plant",
    some_of([armctl.Plant(), armctl.Plant(sensor_delay=1), armctl.Plant(motor=0.001)], [armctl.Plant(motor=0.001)]),
    ids=str,
)
def test_the_margin_with_feedback_of_the_springs_is_that_of_its_simulation_to_the_tick(arm, plant):
    plant = replace(plant, **SPRING)
    law = armctl.ElasticFeedback(arm, **SPRING)
    loop = armctl.linearize(arm, law, arm.home, plant)
    ticks = int(loop.margins().delay_margin / loop.dt)
    assert not grows(arm, law, loop, ticks, plant)
    assert grows(arm, law, loop, ticks + 1, plant)


def test_an_elastic_plant_moves_as_the_same_elastic_joint_of_a_file(load):
    with pytest.warns(armctl.ArmctlWarning):
        written = load(rotor_spring_link("a", 400.0, 0.0, 0.1).replace('mass="0.1"', 'mass="1e-9"'), FAST + motors("a"))
    rigid_body = rotor_spring_link("a", 400.0, 0.0, 0.1).replace('name="sa"', 'name="x"').replace('name="a"', 'name="sa"')
    text = rigid_body.replace('mass="0.1"', 'mass="1e-9"')
    text = text.replace('<joint name="x" axis="0 1 0" stiffness="400.0" damping="0.0"/>', "")
    rigid = load(text, FAST + motors("sa"))
    rest = np.zeros(1)
    torque = _Torque(rest + 3.0)
    still = armctl.move_j(written, written.home, written.home + 0.3)
    log = armctl.simulate(written, torque, still)
    plant = armctl.Plant(elasticity=400.0, elastic_damping=0.0)
    other = armctl.simulate(rigid, torque, armctl.move_j(rigid, rigid.home, rigid.home + 0.3), plant)
    link = log.qpos[:, 0] + log.qpos[:, 1]
    assert np.abs(log.qpos[:, 1]).max() > 1e-3
    assert log.q[:, 0] == pytest.approx(link, abs=1e-15)
    assert np.ptp(link[:300]) > 0.5
    assert other.q[:300] == pytest.approx(log.q[:300], abs=2e-4)
    assert other.v[:300] == pytest.approx(log.v[:300], abs=2e-3)


def test_a_push_bends_the_spring_of_a_file_as_that_of_a_plant(load):
    with pytest.warns(armctl.ArmctlWarning):
        arm = load(rotor_spring_link("a b", 400.0), FAST + motors("a b"))
    push = armctl.Push(0.0, 9.0, force=[0.0, 0.0, 20.0])
    log = armctl.simulate(arm, "pd-gravity", armctl.move_j(arm, arm.home, arm.home), armctl.Plant(pushes=push), dwell=3.0)
    data = mujoco.MjData(arm.model)
    data.qpos[:] = log.qpos[-1]
    mujoco.mj_forward(arm.model, data)
    load_torque = arm.jacobian(log.q[-1])[:3].T @ [0.0, 0.0, 20.0]
    assert 400.0 * log.qpos[-1, [1, 3]] == pytest.approx(load_torque - data.qfrc_bias[[1, 3]], abs=1e-4)


class _Torque:
    def __init__(self, torque):
        self._torque = torque

    def torque(self, state, setpoint):
        return self._torque


def test_a_spring_carries_gravity_at_rest_and_shifts_a_motor_side_encoder_by_its_deflection(arm):
    plant = armctl.Plant(**SPRING)
    sim = armctl.Simulation(arm, "pd-gravity", plant)
    assert sim.state.q == pytest.approx(arm.home)
    seen = sim.measured_state.q
    assert seen - arm.home == pytest.approx(arm.gravity(arm.home) / 1000.0, abs=1e-9)
    at_link = armctl.Simulation(arm, "pd-gravity", replace(plant, encoder_side="link"))
    assert at_link.measured_state.q == pytest.approx(arm.home, abs=1e-12)
    log = armctl.simulate(arm, "pd-gravity", motion(arm), plant, dwell=2.0)
    assert not log.failure
    assert log.qpos.shape[1] == arm.model.nq
    # The motors hold the arm: their torque is gravity's.
    assert log.tau[-1] == pytest.approx(arm.gravity(log.q[-1]), abs=0.02)


def test_a_gap_lets_the_link_move_while_the_motor_stands_still(arm):
    gap = 0.01
    log = armctl.simulate(arm, "pd-gravity", motion(arm), armctl.Plant(backlash=gap), dwell=2.0)
    error = np.abs(log.q - log.q_ref)
    assert not log.failure
    assert 0.2 * gap < error[-1].max() < gap
    assert armctl.simulate(arm, "pd-gravity", motion(arm), dwell=2.0).q[-1] == pytest.approx(log.q_ref[-1], abs=1e-9)


def test_the_torque_of_a_motor_follows_a_step_of_the_command_with_its_time_constant(arm):
    lag = 0.004
    law = _Torque(np.array([1.0, 0.5]))
    log = armctl.simulate(arm, law, motion(arm), armctl.Plant(motor=lag))
    held = arm.gravity(arm.home)[0]  # the torque before the run
    share = (log.tau[:12, 0] - held) / (1.0 - held)
    after = 0.001 * np.arange(1, 13)
    assert share == pytest.approx(1 - np.exp(-after / lag), abs=1e-3)


def test_bristles_hold_a_joint_below_the_static_friction_and_slide_above_the_dry_friction(arm):
    flat = armctl.Plant(coulomb_friction=1.0, friction="lugre", stiction=1.5)
    start = arm.home
    held = arm.gravity(start)
    push = np.array([0.9, 0.0])
    still = armctl.simulate(arm, _Torque(held + push), motion(arm), flat)
    slides = armctl.simulate(arm, _Torque(held + 2.5 / 0.9 * push), motion(arm), flat)
    free = armctl.simulate(arm, _Torque(held + push), motion(arm))
    assert np.abs(still.q[:, 0] - start[0]).max() < 1e-3
    assert np.abs(free.q[:, 0] - start[0]).max() > 0.05
    assert np.abs(slides.q[:, 0] - start[0]).max() > 0.05


def test_an_encoder_counts_steps_of_a_turn_and_of_a_metre(load):
    slide = limb("a b", joint=JOINT).replace('name="b" axis="0 0 1"', 'name="b" type="slide" axis="0 0 1"')
    arm = load(slide, FAST + motors("a b"))
    sim = armctl.Simulation(arm, "pd", armctl.Plant(encoder_bits=10))
    sim.reset([0.1234, 0.1234])
    seen = sim.measured_state.q
    steps = seen / [2 * np.pi / 1024, 1 / 1024]
    assert steps == pytest.approx(np.round(steps), abs=1e-9)
    assert seen == pytest.approx([0.1234, 0.1234], abs=np.pi / 1024)


def test_differenced_velocities_are_those_of_the_measured_positions(arm):
    seen = []

    class Watching(armctl.PD):
        def torque(self, state, setpoint):
            seen.append((state.q.copy(), state.v.copy()))
            return super().torque(state, setpoint)

    armctl.simulate(arm, Watching(arm), motion(arm), armctl.Plant(encoder_bits=14, continuous=True))
    q, v = (np.array(column) for column in zip(*seen, strict=True))
    assert v[1:] == pytest.approx(np.diff(q, axis=0) / arm.dt, abs=1e-9)


def test_measurements_are_late_by_the_sensors_delay(arm):
    seen = []

    class Watching(armctl.PD):
        def torque(self, state, setpoint):
            seen.append(state.q.copy())
            return super().torque(state, setpoint)

    log = armctl.simulate(arm, Watching(arm), motion(arm), armctl.Plant(sensor_delay=3))
    assert np.array(seen)[3:] == pytest.approx(log.q[:-3], abs=0.0)


def test_jitter_delays_commands_at_random_but_never_exchanges_them(arm):
    plant = armctl.Plant(jitter=3, delay=1)
    log = armctl.simulate(arm, "pd-gravity", motion(arm), plant)
    ages = []
    for k in range(10, round(motion(arm).duration / log.dt)):
        same = [age for age in range(8) if np.allclose(log.tau[k], log.tau_cmd[k - age], rtol=0.0, atol=1e-13)]
        ages.append(min(same))
    assert set(ages) == {1, 2, 3, 4}
    assert (np.diff(ages) <= 1).all()
    again = armctl.simulate(arm, "pd-gravity", motion(arm), plant)
    assert np.array_equal(log.q, again.q)
    other = armctl.simulate(arm, "pd-gravity", motion(arm), replace(plant, seed=1))
    assert not np.array_equal(log.q, other.q)


@pytest.mark.parametrize(("plant", "message"), [
    (armctl.Plant(elasticity=1e7, rotor_inertia=0.1), r"elasticity: 1e\+07 N m/rad of b is too stiff for steps of 1 ms"),
    (armctl.Plant(elasticity=[1.0, 2.0, 3.0]), "elasticity: expected 1 or 2 numbers, got 3"),
])  # fmt: skip
def test_an_impossible_drivetrain_is_refused_in_one_sentence(arm, plant, message):
    with pytest.raises(armctl.InputError, match=message):
        armctl.simulate(arm, "pd", motion(arm), plant)


def test_a_rotor_needs_an_inertia(load):
    bare = load(limb("a b"), FAST + motors("a b"))
    with pytest.raises(armctl.InputError, match="a has no rotor inertia in the model; give rotor_inertia"):
        armctl.Plant(elasticity=100.0).model(bare)


def test_a_compiled_model_gets_no_rotors():
    arm = armctl.load(mujoco.MjModel.from_xml_string(mjcf(limb("a b", joint=JOINT), FAST + motors("a b"))))
    with pytest.raises(
        armctl.ModelError, match="a compiled MjModel cannot get rotors or windings; load the MjSpec or the file"
    ):
        armctl.Plant(**SPRING).model(arm)


def test_rotors_are_added_to_an_arm_of_a_specification_but_not_in_another_process():
    arm = armctl.load(mujoco.MjSpec.from_string(mjcf(limb("a b", joint=JOINT), FAST + motors("a b"))))
    assert armctl.Plant(**SPRING).model(arm).njnt == arm.model.njnt + 2
    copied = pickle.loads(pickle.dumps(arm))
    with pytest.raises(armctl.ModelError, match="an arm of an MjSpec gets no further elements in another process"):
        armctl.Plant(**SPRING).model(copied)


def test_an_elastic_file_takes_no_further_springs(load):
    with pytest.warns(armctl.ArmctlWarning):
        arm = load(rotor_spring_link("a b", 400.0), FAST + motors("a b"))
    with pytest.raises(armctl.InputError, match="has elastic joints already"):
        armctl.Plant(elasticity=100.0).model(arm)


def test_a_simulation_takes_another_plant_with_and_without_rotors(arm):
    elastic = armctl.Plant(**SPRING)
    fresh = armctl.simulate(arm, "pd", motion(arm), elastic)
    plain = armctl.simulate(arm, "pd", motion(arm))
    again = armctl.simulate(arm, "pd", motion(arm), elastic)
    assert np.array_equal(fresh.q, again.q)
    assert not np.array_equal(fresh.q, plain.q)
    softer = armctl.simulate(arm, "pd", motion(arm), replace(elastic, elasticity=500.0))
    assert not np.array_equal(softer.q, fresh.q)


def test_a_payload_and_an_identified_arm_keep_their_masses_behind_springs(arm):
    loaded = arm.with_payload(0.5)
    model = armctl.Plant(**SPRING).model(loaded)
    assert model.body_mass[: arm.model.nbody] == pytest.approx(loaded.model.body_mass)
    assert model.body_mass.sum() > arm.model.body_mass.sum() + 0.49


def test_tune_says_that_a_law_takes_elastic_joints_as_rigid(arm):
    found = armctl.tune(arm, "computed-torque", delay_margin=0.5, configurations=1, plants=[armctl.Plant(**SPRING)])
    assert not found
    assert "on elastic joints, which it takes as rigid (ElasticFeedforward knows the springs)" in found.reason


@pytest.mark.parametrize("motor", [0.0, 0.002])
def test_the_torque_of_a_motor_is_what_it_was_commanded_whatever_friction_holds_the_joint(load, motor):
    """Bristles hold what the motor gives beyond gravity, and the motor's torque is the command all the same."""
    arm = load(limb("a b"), motors("a b"))
    friction = armctl.Plant(friction="lugre", coulomb_friction=4.0, motor=motor)

    class Half:
        def torque(self, state, setpoint):
            return arm.gravity(arm.home) + 2.0

    log = armctl.simulate(arm, Half(), armctl.move_j(arm, arm.home, arm.home + 0.01), friction, dwell=0.2)
    assert np.abs(log.v[-1]).max() < 1e-6  # after the bristles have bent
    assert log.tau[-1] == pytest.approx(log.tau_cmd[-1], abs=1e-6)


def test_a_simulated_robot_reports_the_torque_of_its_motors_with_bristles_too(load):
    arm = load(limb("a b"), motors("a b"))
    end = arm.home + np.array([1.2, -1.0])
    against_motion = []
    for plant in (armctl.Plant(friction="lugre", coulomb_friction=1.0), armctl.Plant()):
        with armctl.Robot(arm, armctl.links.PlantLink(arm, plant), speed=1.0, tip_speed=2.0, allow_contact=True) as robot:
            robot.move_j(end, avoid=False)
            log = robot.log
        moving = np.abs(log.v).min(axis=1) > 0.1
        assert moving.sum() > 50
        against_motion.append((log.tau * np.sign(log.v))[moving].mean(axis=0))
    assert against_motion[0] - against_motion[1] == pytest.approx([1.0, 1.0], rel=0.1)
