"""`state.wrench`: the true wrench on the tip, and what noisy, delayed or torque-based sensors make of it."""

from pathlib import Path

import numpy as np
import pytest
from motions import Still
from synthetic import BENT, limb, mjcf, motors, serial_arm

import armctl

PAIR = limb("a b c") + limb("d e f").replace('pos="0.1 0 0.1"', 'pos="-0.5 0 0.1"', 1)
WALL_FACE = 0.44  # m
FORCE = np.array([3.0, -2.0, 4.0])
MOMENT = np.array([0.2, 0.1, -0.3])


class Watching:
    """A controller that asks for the wrench and keeps what it gets."""

    needs_wrench = True

    def __init__(self, controller):
        self._controller = controller
        self.seen = []

    def torque(self, state, setpoint):
        self.seen.append(state.wrench)
        return self._controller.torque(state, setpoint)


@pytest.fixture(scope="module")
def at_wall() -> armctl.Arm:
    scene = armctl.World().add("wall", armctl.Box([0.1, 1.0, 1.0]), at=[WALL_FACE + 0.05, 0.0, 0.5])
    return armctl.load("robot_arm_3dof", scene=scene)


@pytest.fixture(scope="module")
def six_joints(tmp_path_factory) -> armctl.Arm:
    return serial_arm(Path(tmp_path_factory.mktemp("six")), BENT["six joints"])


def pressed(arm, plant, seconds=0.6):
    controller = Watching(armctl.Impedance(arm, stiffness=[2000, 2000, 2000, 0, 0, 0]))
    simulation = armctl.Simulation(arm, controller, plant)
    press = armctl.move_l(arm, arm.home, [WALL_FACE + 0.01, 0.0, arm.fk(arm.home).position[2]], tip_speed=0.2)
    log = simulation.run(press, dwell=seconds)
    return log, np.array(controller.seen), simulation


def pushed(arm, **plant):
    push = armctl.Push(0.0, 10.0, force=FORCE, torque=MOMENT)
    controller = Watching(armctl.ComputedTorque(arm))
    simulation = armctl.Simulation(arm, controller, armctl.Plant(timestep=0.001, pushes=push, **plant))
    log = simulation.run(Still(arm.home, 0.5))
    return log, np.array(controller.seen), simulation


def test_at_rest_the_wrench_of_a_contact_balances_the_motors(at_wall):
    log, seen, simulation = pressed(at_wall, armctl.Plant(timestep=0.001))
    balance = at_wall.gravity(log.q[-1]) - at_wall.jacobian(log.q[-1]).T @ seen[-1]
    assert seen[-1][0] < -10.0  # the wall at +x pushes the tip back
    assert log.tau[-1] == pytest.approx(balance, abs=0.02)
    assert np.array_equal(log.wrench, seen)
    assert simulation.state.wrench == pytest.approx(seen[-1], rel=1e-3)


def test_without_contact_the_wrench_is_the_push(six_joints):
    log, seen, simulation = pushed(six_joints)
    assert seen[-1] == pytest.approx(np.concatenate([FORCE, MOMENT]))
    assert simulation.measured_state.wrench == pytest.approx(seen[-1])
    assert log.wrench.shape == (len(log), 6)


CONFIGURATIONS = ([0.2, 0.4, 0.9, -0.3, 0.8, 0.4], [-1.2, -0.7, 0.6, 1.1, -0.9, -1.5], [1.6, 1.1, -1.3, -0.8, 0.3, 1.9])


@pytest.mark.parametrize("q", CONFIGURATIONS)
def test_a_force_at_a_point_of_the_hand_has_its_lever_about_the_tip(six_joints, q):
    simulation = armctl.Simulation(six_joints, "computed-torque", armctl.Plant(timestep=0.001))
    simulation.reset(q)
    body, data = six_joints.tip_body, simulation.data
    data.xfrc_applied[body] = np.concatenate([FORCE, MOMENT])  # at the body's center of mass
    simulation.step()
    lever = data.xipos[body] - six_joints.fk(q).position
    assert np.linalg.norm(lever) > 0.02
    measured = simulation.state.wrench
    assert measured[:3] == pytest.approx(FORCE, abs=1e-9)
    assert measured[3:] == pytest.approx(MOMENT + np.cross(lever, FORCE), abs=1e-3)


def test_torques_and_motion_tell_the_wrench(six_joints):
    log, seen, _ = pushed(six_joints, wrench_source="torques")
    assert seen[-1] == pytest.approx(np.concatenate([FORCE, MOMENT]), abs=1e-3)
    assert np.abs(seen[5] - log.wrench[5]).max() > 0.1  # the low-pass takes its time


def test_three_joints_tell_the_force_only(at_wall):
    log, seen, _ = pressed(at_wall, armctl.Plant(timestep=0.001, wrench_source="torques"))
    assert seen[-1][:3] == pytest.approx(log.wrench[-1][:3], abs=0.5)
    assert not seen[:, 3:].any()


def test_a_delayed_sensor_shows_the_wrench_of_earlier_ticks(at_wall):
    log, seen, _ = pressed(at_wall, armctl.Plant(timestep=0.001, wrench_delay=4), 0.1)
    assert log.wrench.any()
    assert np.array_equal(seen[4:], log.wrench[:-4])


def test_noise_has_the_given_deviation_and_repeats(six_joints):
    noisy = {"force_noise": 0.5, "moment_noise": 0.02, "seed": 3}
    log, seen, _ = pushed(six_joints, **noisy)
    _, again, _ = pushed(six_joints, **noisy)
    deviation = (seen - log.wrench).std(axis=0)
    assert deviation[:3] == pytest.approx([0.5] * 3, rel=0.15)
    assert deviation[3:] == pytest.approx([0.02] * 3, rel=0.15)
    assert np.array_equal(seen, again)


def test_nobody_pays_for_a_wrench_that_nobody_asks_for(at_wall):
    log = armctl.simulate(at_wall, "computed-torque", Still(at_wall.home, 0.1))
    assert log.wrench.shape == (0, 6)


def test_a_link_that_touches_in_front_of_the_sensor_is_named(tmp_path):
    scene = armctl.World().add("shelf", armctl.Box([0.05, 0.05, 0.05]), at=[0.15, 0.0, 0.3])
    arm = armctl.load("robot_arm_3dof", scene=scene)
    plant = armctl.Plant(timestep=0.001)
    still = Still(arm.home, 0.01)
    with pytest.warns(armctl.ArmctlWarning, match="does not measure the force on link2, which touched"):
        log = armctl.simulate(arm, armctl.HybridForce(arm, {"x": 5.0}), still, plant)
    again = armctl.Log.load(log.save(tmp_path / "log.npz"))
    assert again.unmeasured_bodies == ("link2",)
    assert "does not measure the force on link2" in str(armctl.Report.from_log(again))
    unaware = armctl.simulate(arm, "pd-gravity", still, plant)
    assert unaware.contacts
    assert not unaware.unmeasured_bodies


@pytest.mark.parametrize("tips", [["C", "F"], ["F", "C"]])
def test_the_wrench_of_an_arm_with_several_tips_is_that_of_the_first(tmp_path, tips):
    path = tmp_path / "pair.xml"
    path.write_text(mjcf(PAIR, motors("a b c d e f")))
    arm = armctl.load(path, tips=tips)
    watching = Watching(armctl.ComputedTorque(arm))
    sim = armctl.Simulation(arm, watching)
    sim.data.xfrc_applied[sim.model.body("F").id, :3] = FORCE
    log = sim.run(armctl.move_j(arm, arm.home, arm.home + 0.01))
    expected = FORCE if arm.tip == "F" else np.zeros(3)
    assert log.wrench[-1][:3] == pytest.approx(expected)
    assert watching.seen[-1][:3] == pytest.approx(expected)


def test_a_log_keeps_the_wrench_in_a_file(at_wall, tmp_path):
    log, _, _ = pressed(at_wall, armctl.Plant(timestep=0.001), 0.05)
    assert np.array_equal(armctl.Log.load(log.save(tmp_path / "log.npz")).wrench, log.wrench)


def test_what_accelerates_the_arm_is_no_wrench(six_joints):
    motion = armctl.move_j(six_joints, six_joints.home, six_joints.home + 0.4)
    watching = Watching(armctl.ComputedTorque(six_joints))
    armctl.simulate(six_joints, watching, motion, armctl.Plant(timestep=0.001, wrench_source="torques"), dwell=0.0)
    seen = np.abs(watching.seen)
    at_rest = six_joints.inverse_dynamics(six_joints.home, *np.zeros((2, 6)))
    moving = six_joints.inverse_dynamics(six_joints.home, np.zeros(6), motion.sample(np.array([0.02])).a[0])
    assert np.abs(moving - at_rest).max() > 3.0  # N m
    assert seen.max() < 0.1


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"wrench_source": "wrist"}, "wrench_source"),
        ({"force_noise": -1.0}, "force_noise"),
        ({"wrench_delay": -1}, "wrench_delay"),
    ],
)
def test_wrong_sensors_are_rejected(wrong, sentence):
    with pytest.raises(armctl.InputError, match=sentence):
        armctl.Plant(**wrong)
