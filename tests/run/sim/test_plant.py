"""Each way in which a plant departs from the model: what it does, that it is seeded, and that the log records the truth."""

import math

import mujoco
import numpy as np
import pytest
from arms import arm_of
from motions import Still
from synthetic import mjcf, motors

import armctl


class Holding:
    """Holds the arm's weight and nothing else, and remembers what it was told."""

    def __init__(self, arm, extra=0.0):
        self.arm = arm
        self.extra = extra
        self.states = []

    def torque(self, state, setpoint):
        self.states.append(state)
        return self.arm.gravity(setpoint.q) + self.extra


class Counting:
    """Commands the number of the tick, so that a delay can be read off."""

    def __init__(self, n):
        self.n, self.k = n, -1

    def torque(self, state, setpoint):
        self.k += 1
        return np.full(self.n, 0.001 * self.k)


def test_nothing_departs_by_default(arm):
    model = armctl.Plant().model(arm)
    assert np.array_equal(model.body_mass, arm.model.body_mass)
    assert str(armctl.Plant()) == "nominal"
    assert not armctl.Plant().has_signal_disturbances


@pytest.mark.parametrize("robot", ["panda", "gantry", "planar"])
def test_a_payload_weighs_what_it_weighs(robot):
    arm = arm_of(robot)
    center, mass = np.array([0.05, -0.02, 0.1]), 1.5
    model = armctl.Plant(payload=mass, payload_center=center).model(arm)
    data = mujoco.MjData(model)
    data.qpos[:] = arm.qpos(arm.home)
    mujoco.mj_forward(model, data)
    J = arm.jacobian(arm.home)
    lever = arm.fk(arm.home).rotation @ center
    force = -mass * model.opt.gravity
    expected = arm.gravity(arm.home) + J.T @ np.concatenate([force, np.cross(lever, force)])
    assert np.allclose(data.qfrc_bias[arm.dof_adr], expected, atol=1e-10)


def test_masses_scale(bundled):
    model = armctl.Plant(mass_scale=1.2).model(bundled)
    assert np.allclose(model.body_mass, 1.2 * bundled.model.body_mass)
    assert np.allclose(model.body_inertia, 1.2 * bundled.model.body_inertia)


def test_coulomb_friction_holds_what_is_less(bundled):
    pushed = Holding(bundled, extra=np.array([0.9, 0.0, 0.0]))
    stuck = armctl.simulate(bundled, pushed, Still(bundled.home, 1.0), armctl.Plant(coulomb_friction=1.0), dwell=0.0)
    free = armctl.simulate(bundled, pushed, Still(bundled.home, 1.0), dwell=0.0)
    assert np.abs(stuck.v).max() < 0.05 * np.abs(free.v).max()


def test_viscous_friction_takes_its_power(bundled):
    damped = armctl.Plant(viscous_friction=[3.0, 0.0, 0.0]).model(bundled)
    assert np.allclose((damped.dof_damping - bundled.model.dof_damping)[bundled.dof_adr], [3.0, 0.0, 0.0])


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_a_delay_is_so_many_ticks(bundled, delay):
    log = armctl.simulate(bundled, Counting(3), Still(bundled.home, 0.05), armctl.Plant(delay=delay), dwell=0.0)
    late = np.maximum(np.arange(len(log)) - delay, 0)
    assert np.allclose(log.tau[:, 0], 0.001 * late)
    assert np.allclose(log.tau_cmd[:, 0], 0.001 * np.arange(len(log)))


def test_noise_has_its_size_and_the_log_the_truth(bundled):
    plant, holding = armctl.Plant(encoder_noise=1e-3, velocity_noise=2e-2), Holding(bundled)
    log = armctl.simulate(bundled, holding, Still(bundled.home, 2.0), plant, dwell=0.0)
    q, v = (np.array([getattr(s, k) for s in holding.states]) for k in ("q", "v"))
    assert np.std(q - log.q) == pytest.approx(1e-3, rel=0.1)
    assert np.std(v - log.v) == pytest.approx(2e-2, rel=0.1)
    assert np.abs(log.q - bundled.home).max() < 1e-9


def test_without_a_velocity_sensor_the_velocity_is_differenced_from_noisy_positions(bundled):
    holding = Holding(bundled)
    log = armctl.simulate(bundled, holding, Still(bundled.home, 0.1), armctl.Plant(encoder_noise=1e-4), dwell=0.0)
    q = np.array([state.q for state in holding.states])
    v = np.array([state.v for state in holding.states])
    assert np.allclose(np.diff(q, axis=0) / log.dt, v[1:], atol=1e-9)
    assert np.std(v) == pytest.approx(np.sqrt(2) * 1e-4 / log.dt, rel=0.2)


def test_the_same_seed_gives_the_same_bits(bundled):
    first, second, other = (
        armctl.simulate(bundled, "pd-gravity", Still(bundled.home), armctl.Plant(encoder_noise=1e-4, seed=seed))
        for seed in (7, 7, 8)
    )
    assert np.array_equal(first.q, second.q)
    assert not np.array_equal(first.q, other.q)


def test_a_push_moves_the_tip_while_it_lasts():
    arm = arm_of("redundant")
    push = armctl.Push(0.1, 0.2, force=[0.0, 20.0, 0.0])
    log = armctl.simulate(arm, "impedance", Still(arm.home, 1.5), armctl.Plant(pushes=[push]), dwell=0.0)
    off = (log.tip - log.tip_ref)[:, 1]
    assert np.abs(off[log.t < 0.1]).max() < 1e-9
    assert off.max() > 2e-3
    assert np.abs(off[-1]) < 0.05 * off.max()


def test_a_push_is_a_wrench_at_the_tip():
    arm = arm_of("redundant")
    push = armctl.Push(0.0, 1.0, force=[5.0, -3.0, 2.0], torque=[0.1, 0.2, -0.3])
    simulation = armctl.Simulation(arm, Holding(arm, -arm.jacobian(arm.home).T @ push.wrench), armctl.Plant(pushes=push))
    log = simulation.run(Still(arm.home, 0.05))
    assert np.abs(log.v).max() < 1e-9


def test_continuous_motion_is_what_finer_steps_converge_to(bundled):
    """The same held torques, by the plant's own steps and by MuJoCo's Euler steps a hundred times finer."""
    tau = np.array([2.0, -60.0, 5.0])

    class Constant:
        def torque(self, state, setpoint):
            assert state.continuous
            return tau

    log = armctl.simulate(bundled, Constant(), Still(bundled.home, 0.1), armctl.Plant(continuous=True), dwell=0.0)
    model = armctl.Plant(timestep=bundled.dt / 200).model(bundled)
    data = mujoco.MjData(model)
    data.qpos[:] = bundled.qpos(bundled.home)
    data.ctrl[bundled.ctrl_adr] = tau / bundled.gear
    mujoco.mj_step(model, data, 200 * (len(log) - 1))
    assert np.abs(data.qpos[bundled.qpos_adr] - log.q[-1]).max() < 2e-4 * np.abs(log.q[-1] - bundled.home).max()


def test_a_plant_says_what_differs():
    plant = armctl.Plant(payload=1.0, mass_scale=1.2, coulomb_friction=0.5, delay=2, encoder_noise=1e-5)
    assert str(plant) == "payload 1 kg, masses x 1.2, Coulomb friction 0.5 N m, delay 2, encoder noise 1e-05 rad"
    assert str(armctl.Plant(payload=1.0, name="with a tool")) == "with a tool"


PLANT_PAIRS = [
    ({"payload": 1.0}, {"payload": 1.0 + 1e-12}),
    ({"payload": 1.0}, {"payload": 1.0, "payload_center": [0, 0, 0.1]}),
    ({"mass_scale": 1.1}, {"mass_scale": 1.2}),
    ({"coulomb_friction": 0.01}, {"coulomb_friction": 0.05}),
    ({"coulomb_friction": 0.1}, {"viscous_friction": 0.1}),
    ({"viscous_friction": [0.1, 0.2, 0.3]}, {"viscous_friction": [0.1, 0.2, 0.4]}),
    ({"delay": 1}, {"delay": 2}),
    ({"encoder_noise": 1e-5}, {"encoder_noise": 2e-5}),
    ({"encoder_noise": 1e-5}, {"velocity_noise": 1e-5}),
    ({"encoder_noise": 1e-5}, {"encoder_noise": 1e-5, "seed": 1}),
    ({"pushes": armctl.Push(0, 1, force=[1, 0, 0])}, {"pushes": armctl.Push(0, 1, force=[0, 1, 0])}),
    ({"pushes": armctl.Push(0, 1, force=[1, 0, 0])}, {"pushes": armctl.Push(0, 1, torque=[1, 0, 0])}),
    ({"pushes": armctl.Push(0, 1, force=[1, 0, 0])}, {"pushes": armctl.Push(0, 2, force=[1, 0, 0])}),
    ({}, {"continuous": True}),
    ({"timestep": 1e-3}, {"timestep": 2e-3}),
]


@pytest.mark.parametrize(("first", "second"), PLANT_PAIRS)
def test_two_plants_of_the_same_kind_have_different_texts_and_keys(first, second):
    assert str(armctl.Plant(**first)) != str(armctl.Plant(**second))
    assert armctl.Plant(**first).key != armctl.Plant(**second).key
    assert armctl.Plant(**first).key == armctl.Plant(**first).key


def test_a_value_that_equals_its_default_is_no_difference():
    written = armctl.Plant(payload_center=np.zeros(3), payload_inertia=np.zeros((3, 3)), coulomb_friction=[0.0], delay=0.0)
    assert written.key == armctl.Plant().key
    assert str(written) == "nominal"


def test_what_plants_share_cannot_be_changed():
    with pytest.raises(ValueError, match="WRITEABLE"):
        armctl.Plant().coulomb_friction.setflags(write=True)
    assert armctl.Plant().coulomb_friction is armctl.Plant().coulomb_friction


@pytest.mark.parametrize(
    ("arguments", "sentence"), [(("0", 1), "start: '0' is not"), ((0, 1, [1, 2]), "force: expected 3 numbers, got 2")]
)
def test_a_push_that_cannot_be_is_refused(arguments, sentence):
    with pytest.raises(armctl.InputError, match=sentence):
        armctl.Push(*arguments)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"payload": -1.0}, "payload: expected a number at least 0, got -1"),
        ({"mass_scale": 0.0}, "mass_scale: expected .*got 0"),
        ({"delay": 1.5}, "delay: expected a whole number at least 0, got 1.5; the unit is ticks, that is control periods:"),
        ({"wrench_delay": 0.002}, "0.002; the unit is ticks, that is control periods: divide a time in seconds by"),
        ({"encoder_bits": 1.5}, r"encoder_bits: expected a whole number .* got 1.5$"),
        ({"delay": -1}, "delay: expected .*got -1"),
        ({"encoder_noise": math.nan}, "encoder_noise: expected .*got nan"),
        ({"coulomb_friction": [0.1, -0.2]}, "coulomb_friction: every value must be at least 0, got -0.2"),
        ({"viscous_friction": "much"}, "viscous_friction: .* is not an array of numbers"),
        ({"timestep": 1.0}, "timestep: expected .*got 1"),
        ({"payload_center": [0.0, 1.0]}, "payload_center: expected 3 numbers, got 2"),
        ({"viscous_friction": ()}, "viscous_friction: expected one number, or one for each joint, got none"),
        ({"pushes": 1}, r"pushes: expected Push, got 1; armctl\.Push"),
        ({"pushes": ["x"]}, "pushes: expected Push, got 'x'"),
        ({"payload": "1"}, "payload: '1' is not a number"),
        ({"delay": "1"}, "delay: '1' is not a number"),
        ({"seed": -1}, "seed: expected .*got -1"),
        ({"seed": np.random.default_rng(1)}, "seed: .* is not a number"),
        ({"continuous": "yes"}, "continuous: expected bool, got 'yes'"),
        ({"name": 3}, "name: expected str, got 3"),
    ],
)
def test_a_plant_that_cannot_be_is_refused(arguments, sentence):
    with pytest.raises(armctl.InputError, match=sentence):
        armctl.Plant(**arguments)


def test_friction_for_other_joints_is_refused(bundled):
    with pytest.raises(armctl.InputError, match="coulomb_friction: expected 1 or 3 numbers, got 2"):
        armctl.Plant(coulomb_friction=[0.1, 0.2]).model(bundled)


def test_pushes_at_the_same_time_add_up():
    arm = arm_of("redundant")
    first = armctl.Push(0.0205, 0.1, force=[5.0, 0.0, 3.0])
    second = armctl.Push(0.0505, 0.1, force=[0.0, -4.0, 1.0], torque=[0.1, 0.2, 0.0])
    both = armctl.Push(0.0505, 0.07, force=[5.0, -4.0, 4.0], torque=[0.1, 0.2, 0.0])
    alone = (armctl.Push(0.0205, 0.03, force=first.force), armctl.Push(0.1205, 0.03, force=second.force, torque=second.torque))
    plants = [armctl.Plant(timestep=0.001, pushes=pushes) for pushes in ([first, second], [*alone, both])]
    logs = [armctl.simulate(arm, "impedance", Still(arm.home, 0.2), plant, dwell=0.0) for plant in plants]
    assert logs[0].q == pytest.approx(logs[1].q, abs=1e-12)
    assert np.abs(logs[0].q[-1] - arm.home).max() > 1e-4


def test_without_a_velocity_sensor_a_continuous_plant_has_differences_of_positions(bundled):
    seen = []

    class Watching(armctl.PD):
        def torque(self, state, setpoint):
            seen.append((state.q.copy(), state.v.copy()))
            return super().torque(state, setpoint)

    motion = armctl.move_j(bundled, bundled.home, bundled.home + 0.3)
    plant = armctl.Plant(timestep=0.002, continuous=True)
    log = armctl.simulate(bundled, Watching(bundled), motion, plant)
    q, v = (np.array(column) for column in zip(*seen, strict=True))
    assert np.allclose(v[1:], np.diff(q, axis=0) / 0.002, rtol=0, atol=1e-9)
    assert np.abs(v - log.v).max() > 1e-3
    compiled = armctl.simulate(bundled, "pd", motion, plant)
    assert np.array_equal(compiled.q, log.q)
    seen.clear()
    log = armctl.simulate(
        bundled, Watching(bundled), motion, armctl.Plant(timestep=0.002, continuous=True, velocity_noise=1e-12)
    )
    assert np.allclose([v for _, v in seen], log.v, rtol=0, atol=1e-9)


def test_a_joint_torque_of_the_plant_acts_like_the_friction_that_it_describes(bundled):
    """Viscous friction as a function of the user, held for a tick, and as an attribute; the difference is of first order."""
    motion = armctl.move_j(bundled, bundled.home, bundled.home + 0.4)

    def positions(**plant):
        return armctl.simulate(bundled, "pd", motion, armctl.Plant(timestep=0.0005, **plant)).q

    without = positions()
    attribute = positions(viscous_friction=0.5)
    function = positions(joint_torque=lambda q, v, t: -0.5 * v)
    assert np.abs(attribute - without).max() > 5e-4
    assert np.abs(function - attribute).max() < 0.02 * np.abs(attribute - without).max()


@pytest.mark.parametrize(("torque", "friction"), [(1.9, 1.9), (3.0, 2.0), (-0.9, -0.9), (-3.0, -1.0)])
def test_a_constant_joint_torque_gives_coulomb_friction_another_value_in_each_direction(torque: float, friction: float):
    """2 N m forwards and 1 N m backwards; a smaller torque does not move the joint."""
    wheel = (
        '<body name="wheel"><joint name="a" axis="0 0 1" range="-1 1"/><geom type="cylinder" size="0.2 0.05" mass="50"/></body>'
    )
    arm = armctl.load(mujoco.MjSpec.from_string(mjcf(wheel, motors("a"))))
    plant = armctl.Plant(timestep=0.0005, coulomb_friction=(2.0 + 1.0) / 2, joint_torque=lambda q, v, t: [-(2.0 - 1.0) / 2])
    log = armctl.simulate(arm, Holding(arm, np.array([torque])), Still(arm.home, 0.1), plant, dwell=0.0)
    moved = 0.5 * (torque - friction) / arm.mass_matrix(arm.home)[0, 0] * log.t[-1] ** 2
    assert log.q[-1, 0] - log.q[0, 0] == pytest.approx(moved, rel=0.02, abs=2e-4)


def test_a_joint_torque_gets_true_states_and_acts_on_its_plant_only(bundled):
    seen = []

    def watching(q, v, t):
        seen.append((q.copy(), v.copy(), t))
        return np.zeros(3)

    noisy = armctl.Plant(joint_torque=watching, encoder_noise=1e-4)
    motion = armctl.move_j(bundled, bundled.home, bundled.home + 0.2)
    log = armctl.simulate(bundled, "computed-torque", motion, noisy)
    assert np.array([t for _, _, t in seen]) == pytest.approx(log.t)
    assert np.array_equal([q for q, _, _ in seen], log.q)
    assert np.array_equal([v for _, v, _ in seen], log.v)
    count = len(seen)
    plain = armctl.simulate(bundled, "computed-torque", motion, armctl.Plant(encoder_noise=1e-4))
    assert len(seen) == count
    assert np.array_equal(plain.q, log.q)  # no torque, no difference: the loops in Python and C++ give the same bits
    assert str(noisy).startswith("encoder noise 0.0001 rad, joint torque by watching")


def test_a_joint_torque_adds_to_pushes(bundled):
    push = armctl.Push(0.0, 1.0, force=[0.0, 0.0, 5.0])
    motion = armctl.move_j(bundled, bundled.home, bundled.home + 0.1)
    tips = []
    for sign in (0.0, -1.0):
        pushed = armctl.Plant(pushes=push, joint_torque=lambda q, v, t, sign=sign: sign * (bundled.jacobian(q)[2] * 5.0))
        tips.append(armctl.simulate(bundled, "computed-torque", motion, pushed))
    assert np.abs(tips[0].tip - tips[0].tip_ref).max() > 1e-4
    assert np.abs(tips[1].tip - tips[1].tip_ref).max() < 1e-10


@pytest.mark.parametrize("bad", [lambda q, v, t: [1.0, 2.0], lambda q, v, t: None, lambda q, v, t: np.full(3, np.nan)])
def test_a_joint_torque_of_a_wrong_form_is_one_sentence(bundled, bad):
    motion = armctl.move_j(bundled, bundled.home, bundled.home + 0.1)
    with pytest.raises(armctl.InputError, match="joint_torque: "):
        armctl.simulate(bundled, "pd", motion, armctl.Plant(joint_torque=bad))
    with pytest.raises(armctl.InputError, match="joint_torque: expected a function of q, v and t, got 3"):
        armctl.Plant(joint_torque=3)
