"""Force control on walls of different stiffness, with delay and noise, without knowing where the wall is."""

from pathlib import Path

import numpy as np
import pytest
from motions import Still
from synthetic import BENT, serial_arm

import armctl

FORCE = 20.0  # N
WALLS = {"a tenth of the stiffness": 0.0632, "MuJoCo's stiffness": 0.02, "ten times the stiffness": 0.00632}  # solref[0], s
GAP = 0.001  # m
STEADY_S = 0.15
BALL = '<geom type="sphere" size="0.01" mass="0" pos="{site}"/><site name="tip" pos="{site}"'


def arm_at_wall(folder: Path, shape: str, time_constant: float = 0.02, gap: float = GAP) -> armctl.Arm:
    """A serial arm with a ball at its tip, and a plate above the ball."""
    tip = serial_arm(folder, BENT[shape]).fk
    text = (folder / "serial.xml").read_text()
    site = text.split('<site name="tip" pos="')[1].split('"')[0]
    x, y, z = tip(np.fromstring(BENT[shape].home, sep=" ")).position
    plate = (
        f'<geom name="wall" type="box" size="0.1 0.1 0.02" pos="{x} {y} {z + 0.03 + gap}" '
        f'solref="{time_constant} 1" priority="1"/>'
    )
    text = text.replace(f'<site name="tip" pos="{site}"', BALL.format(site=site)).replace("<worldbody>", f"<worldbody>{plate}")
    path = folder / "wall.xml"
    path.write_text(text)
    return armctl.load(path)


def pressed(arm, plant, seconds=0.6, target=FORCE, **how):
    """The run of an arm that presses up, and the force that it exerts over time."""
    controller = armctl.HybridForce(arm, {"z": target}, **how)
    log = armctl.simulate(arm, controller, Still(arm.home, seconds), plant, dwell=0.0)
    assert not log.failure
    return log, -log.wrench[:, 2]


def check_targets(log, force):
    """Overshoot below 10 % from the impact on, within 5 % after 0.1 s, and a steady force within 0.1 N."""
    first = int(np.argmax(force > 0.02 * FORCE))
    outside = np.flatnonzero(np.abs(force - FORCE) > 0.05 * FORCE)[-1]
    assert force.max() < 1.1 * FORCE
    assert (outside - first) * log.dt < 0.1
    assert force[log.t > log.t[-1] - STEADY_S].mean() == pytest.approx(FORCE, abs=0.1)


@pytest.mark.parametrize("wall", WALLS)
@pytest.mark.parametrize("shape", ["planar", "six joints"])
def test_the_force_settles_on_any_wall_with_a_delay_of_4_ms(tmp_path, shape, wall):
    arm = arm_at_wall(tmp_path, shape, WALLS[wall])
    check_targets(*pressed(arm, armctl.Plant(timestep=0.001, delay=4)))


def test_damping_does_not_delay_a_tip_that_sinks_deep_into_a_wall(tmp_path):
    arm = arm_at_wall(tmp_path, "six joints", 0.1)  # a 25th of MuJoCo's stiffness
    log, force = pressed(arm, armctl.Plant(timestep=0.001, delay=4))
    assert np.ptp(log.tip[force > 1.0, 2]) > 0.004
    check_targets(log, force)


def with_spring(arm: armctl.Arm, stiffness: float, damping_ratio: float) -> armctl.Arm:
    """The arm at a wall that is a spring with a damper, N/m; MuJoCo adds a virtual mass that is small at this impedance."""
    impedance = 0.3
    model = arm.model
    wall = model.geom("wall").id
    mobility = model.body_invweight0[arm.tip_body, 0]
    rate = stiffness * mobility * (1 - impedance) / impedance**2
    model.geom_solimp[wall] = [impedance, impedance, 0.001, 0.5, 2]
    model.geom_solref[wall] = [-rate * impedance**2, -2 * damping_ratio * np.sqrt(rate) * impedance]
    return arm


@pytest.mark.parametrize(("shape", "damping_ratio"), [("six joints", 1.0), ("six joints", 0.3), ("redundant", 1.0)])
def test_the_force_on_foam_settles_in_a_third_of_a_second(tmp_path, shape, damping_ratio):
    arm = with_spring(arm_at_wall(tmp_path, shape), 1000.0, damping_ratio)
    noise = {"force_noise": 0.3, "moment_noise": 0.01, "encoder_noise": 1e-5, "seed": 5}
    log, force = pressed(arm, armctl.Plant(timestep=0.001, delay=4, **noise), seconds=2.5)
    first = int(np.argmax(force > 0.02 * FORCE))
    depth = np.ptp(log.tip[first:, 2])
    assert force[-1] / depth == pytest.approx(1000.0, rel=0.1)
    outside = np.flatnonzero(np.abs(force - FORCE) > 0.05 * FORCE)[-1]
    assert (outside - first) * log.dt < 0.33
    assert force.max() < 1.1 * FORCE
    late = np.convolve(force[first + 1500 :] - FORCE, np.ones(50) / 50, "valid")
    assert np.abs(late).max() < 0.1


@pytest.mark.parametrize("gap", [0.0, 0.002])
def test_the_position_of_the_wall_need_not_be_known(tmp_path, gap):
    arm = arm_at_wall(tmp_path, "redundant", gap=gap)
    check_targets(*pressed(arm, armctl.Plant(timestep=0.001)))


def test_a_noisy_delayed_sensor_is_good_enough(tmp_path):
    arm = arm_at_wall(tmp_path, "six joints")
    noise = {"force_noise": 0.3, "moment_noise": 0.01, "encoder_noise": 1e-5}
    check_targets(*pressed(arm, armctl.Plant(timestep=0.001, wrench_delay=4, **noise)))


def test_dry_friction_of_the_joints_is_overcome(tmp_path):
    arm = arm_at_wall(tmp_path, "rubbing")
    check_targets(*pressed(arm, armctl.Plant(timestep=0.001), seconds=0.9))


def test_dry_friction_does_not_hold_the_tip_beside_its_reference(tmp_path):
    arm = serial_arm(tmp_path, BENT["rubbing"])
    push = armctl.Push(0.0, 0.1, force=[30.0, 0.0, 0.0])
    plant = armctl.Plant(timestep=0.001, pushes=push)
    log = armctl.simulate(arm, armctl.HybridForce(arm, {"z": 0.0}), Still(arm.home, 0.4), plant, dwell=0.0)
    apart = np.abs(log.tip - log.tip_ref)[:, 0]
    assert apart.max() > 1e-4
    assert apart[-1] < 0.1 * apart.max()


def test_a_force_estimated_from_torques_is_good_enough(tmp_path):
    arm = arm_at_wall(tmp_path, "six joints")
    log, force = pressed(arm, armctl.Plant(timestep=0.001, wrench_source="torques"))
    assert force[log.t > log.t[-1] - STEADY_S].mean() == pytest.approx(FORCE, abs=0.1)


def test_motion_axes_stay_where_they_are(tmp_path):
    arm = arm_at_wall(tmp_path, "six joints")
    log, _ = pressed(arm, armctl.Plant(timestep=0.001))
    assert np.abs(log.tip - log.tip_ref)[:, :2].max() < 2e-4
    assert (log.tip - log.tip_ref)[-1, 2] > 0.5 * GAP


def test_the_target_can_change_and_the_contact_be_lost(tmp_path):
    arm = arm_at_wall(tmp_path, "six joints")
    controller = armctl.HybridForce(arm, {"z": FORCE})
    simulation = armctl.Simulation(arm, controller, armctl.Plant(timestep=0.001))
    assert not controller.in_contact
    simulation.run(Still(arm.home, 0.4))
    assert controller.in_contact
    controller.force = {"z": 0.5 * FORCE}
    log = simulation.run(Still(arm.home, 0.4))
    assert -log.wrench[-1, 2] == pytest.approx(0.5 * FORCE, abs=0.1)
    controller.force = {"z": -FORCE}  # away from the wall
    simulation.run(Still(arm.home, 0.2))
    assert not controller.in_contact
    assert np.abs(simulation.state.v).max() < 0.5  # it approaches slowly, where there is nothing


def test_an_axis_without_force_yields(tmp_path):
    arm = serial_arm(tmp_path, BENT["six joints"])
    push = armctl.Push(0.0, 0.1, force=[0.0, 0.0, 5.0])
    plant = armctl.Plant(timestep=0.001, pushes=push)
    yielding = armctl.simulate(arm, armctl.HybridForce(arm, {"z": 0.0}), Still(arm.home, 0.2), plant)
    held = armctl.simulate(arm, armctl.HybridForce(arm, {"x": 0.0}), Still(arm.home, 0.2), plant)
    assert yielding.tip[-1, 2] - yielding.tip[0, 2] > 0.01
    assert held.tip[-1, 2] - held.tip[0, 2] < 0.005


def test_axes_can_turn_with_the_tip(tmp_path):
    arm = arm_at_wall(tmp_path, "six joints")
    up = arm.fk(arm.home).rotation.T @ np.array([0.0, 0.0, 1.0])
    axis = int(np.argmax(np.abs(up)))
    controller = armctl.HybridForce(arm, {"xyz"[axis]: np.sign(up[axis]) * FORCE}, frame="tip")
    log = armctl.simulate(arm, controller, Still(arm.home, 0.8), armctl.Plant(timestep=0.001), dwell=0.0)
    along = -log.wrench[-1, :3] @ arm.fk(log.q[-1]).rotation[:, axis]
    assert abs(along) == pytest.approx(FORCE, abs=0.5)


@pytest.mark.parametrize(
    ("arguments", "error", "sentence"),
    [
        ({"force": {}}, armctl.InputError, "expected a table of axes"),
        ({"force": 20.0}, armctl.InputError, "expected a table of axes"),
        ({"force": {"up": 1.0}}, armctl.UnknownNameError, "axis"),
        ({"force": {"z": "much"}}, armctl.InputError, "force along z"),
        ({"force": {"z": 1.0}, "frame": "base"}, armctl.InputError, "frame"),
        ({"force": {"z": 1.0}, "approach_speed": 0.0}, armctl.InputError, "approach_speed"),
        ({"force": {"z": 1.0}, "contact_force": -1.0}, armctl.InputError, "contact_force"),
    ],
)
def test_wrong_arguments_are_rejected(bundled, arguments, error, sentence):
    with pytest.raises(error, match=sentence):
        armctl.HybridForce(bundled, **arguments)


@pytest.mark.parametrize("wrench", [None, np.zeros(1), np.zeros(3), 5.0])
def test_without_a_measured_wrench_there_is_one_sentence(bundled, wrench):
    zero = np.zeros(bundled.n)
    with pytest.raises(armctl.InputError, match="hybrid-force needs the measured wrench"):
        armctl.HybridForce(bundled, {"z": 1.0}).torque(
            armctl.State(bundled.home, zero, 0.0, 0.001, wrench=wrench), armctl.Setpoint(bundled.home, zero, zero)
        )
