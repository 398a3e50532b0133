"""Tuned gains satisfy the bounds that were asked for, and the next higher ones do not."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from arms import arm_of, some_of
from synthetic import BENT, serial_arm

import armctl
from armctl.lab.loops.gain_family import tunable_laws

PLANT = armctl.Plant(timestep=0.002)


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    return serial_arm(tmp_path_factory.mktemp("planar"), BENT["planar"])


@pytest.mark.parametrize("law", some_of(tunable_laws(), ["computed-torque-observer"]))
def test_tuned_gains_satisfy_the_bounds(arm, law):
    found = armctl.tune(arm, law, delay_margin=8e-3, peak_sensitivity=1.65, configurations=3, plants=[PLANT])
    assert found, found.reason
    margins = armctl.margins(arm, found.controller, 3, [PLANT])
    assert margins.delay.value == found.after.delay_margin >= 8e-3
    assert margins.peak_sensitivity.value == pytest.approx(found.after.peak_sensitivity)
    assert found.after.peak_sensitivity <= 1.65
    # At configurations that neither the design nor the judge knew.
    fresh = arm.limits.random(arm.home, 40, np.random.default_rng(5))
    assert armctl.margins(arm, found.controller, fresh, [PLANT]).delay.value >= 8e-3
    assert set(found.active) <= {"delay margin", "peak sensitivity", "none"}
    assert found.to_dict()["ok"] is True
    assert "active bound" in str(found)


@pytest.mark.full
def test_a_bound_on_torque_noise_is_active(arm):
    free = armctl.tune(arm, "computed-torque", configurations=2, plants=[PLANT])
    bounded = armctl.tune(arm, "computed-torque", chatter=0.5 * free.after.chatter, configurations=2, plants=[PLANT])
    assert bounded.active == ("chatter",)
    assert bounded.after.chatter <= 0.5 * free.after.chatter
    assert bounded.after.compliance > free.after.compliance


@pytest.mark.nightly
def test_default_gains_that_violate_a_bound_are_raised_if_higher_ones_satisfy_it():
    arm = arm_of("panda")
    assert armctl.margins(arm, "impedance", 4, [PLANT]).peak_sensitivity.value > 3.0
    found = armctl.tune(arm, "impedance", peak_sensitivity=3.0, configurations=4, plants=[PLANT])
    assert found, found.reason
    assert found.gains["bandwidth"] > 40.0
    assert found.after.peak_sensitivity <= 3.0


@pytest.mark.full
def test_default_pd_of_a_damped_arm_is_nearly_as_stiff_as_the_tuned_one(tmp_path):
    arm = serial_arm(tmp_path, replace(BENT["planar"], joint='damping="60"'))
    found = armctl.tune(arm, "pd-gravity", configurations=3, plants=[PLANT])
    assert found, found.reason
    assert 0.3 * found.before.compliance < found.after.compliance < found.before.compliance


def test_bounds_that_no_gains_satisfy_are_a_result(arm):
    found = armctl.tune(arm, "pd", delay_margin=5.0, configurations=2, plants=[PLANT])
    assert not found
    assert "no gains of pd satisfy" in str(found)


def elevator(mass, damping, dt):
    return armctl.load(
        mujoco.MjSpec.from_string(f"""
        <mujoco><option timestep="{dt}"/><worldbody><body>
          <joint name="lift" type="slide" axis="0 0 1" range="0 2" damping="{damping}"/>
          <inertial pos="0 0 0" mass="{mass}" diaginertia="0.1 0.1 0.1"/><site name="tool"/>
        </body></worldbody><actuator><motor joint="lift" ctrlrange="-400 400"/></actuator></mujoco>"""),
        tip="tool",
    )


def margins_of_elevator(kp, kd, mass, damping, dt, lag, count=4000):
    """Delay margin, s, and Ms of PD gains in MuJoCo's step, by a grid of frequencies; of an unstable loop zero and infinity."""
    w = np.geomspace(1e-2, 0.999 * np.pi / dt, count)
    z = np.exp(1j * w * dt)
    pushed = dt / (mass + dt * damping) / (z - mass / (mass + dt * damping))
    L = pushed * (kp * dt * z / (z - 1) + kd) * z**-lag
    winding = np.unwrap(np.angle(L))
    crossings = np.flatnonzero(np.diff(np.sign(np.abs(L) - 1)))
    if len(crossings) != 1 or winding[crossings[0]] <= -np.pi:
        return 0.0, np.inf
    (i,) = crossings
    return (np.pi + winding[i]) / w[i], np.abs(1 / (1 + L)).max()


@pytest.mark.parametrize(
    ("mass", "damping", "dt", "lag", "delay_margin"),
    [
        (6.0, 8.0, 0.005, 10, 0.01),
        pytest.param(6.0, 8.0, 0.005, 0, 0.06, marks=pytest.mark.full),
        pytest.param(60.0, 0.0, 0.002, 0, 0.12, marks=pytest.mark.full),
        (3.0, 400.0, 0.004, 5, 0.02),
    ],
)
def test_the_stiffness_of_an_elevator_is_the_highest_that_a_grid_of_gains_finds(mass, damping, dt, lag, delay_margin):
    arm = elevator(mass, damping, dt)
    found = armctl.tune(arm, "pd-gravity", delay_margin=delay_margin, configurations=2, plants=[armctl.Plant(sensor_delay=lag)])
    assert found, found.reason
    kp = float(found.gains["stiffness"][0])
    kd = float(found.gains["damping"][0])
    margin, peak = margins_of_elevator(kp, kd, mass, damping, dt, lag)
    assert margin >= 0.998 * delay_margin
    assert peak <= 1.705
    best = 0.0
    for stiffness in np.append(np.geomspace(kp, 2.0 * kp, 10), np.geomspace(2.5 * kp, 20 * kp, 8)):
        for rate in np.geomspace(1.0, 1000.0, 60):
            margin, peak = margins_of_elevator(stiffness, stiffness / rate, mass, damping, dt, lag, 1000)
            if margin >= delay_margin and peak <= 1.7:
                best = stiffness
    assert best <= 1.1 * kp


@pytest.mark.nightly
@pytest.mark.parametrize("damping", [0.5, 20.0])
def test_looser_bounds_never_give_worse_gains(tmp_path, damping):
    arm = serial_arm(tmp_path, replace(BENT["planar"], joint=f'damping="{damping}"'))
    frequencies = 2 * np.pi * np.array([0.01, 0.1, 1.0])
    displacements = []
    for delay_margin in (0.003, 0.012, 0.04):
        found = armctl.tune(arm, "pd-gravity", delay_margin=delay_margin, configurations=2, plants=[PLANT])
        assert found, found.reason
        assert found.after.delay_margin >= delay_margin
        loops = [armctl.linearize(arm, found.controller, [q, 0.5, -q], PLANT) for q in (-0.5, 0.2, 1.0)]
        shares = [loop.joint_compliance(frequencies) * arm.limits.tau_max for loop in loops]
        displacements.append(np.sqrt(np.mean(np.abs(shares) ** 2)))
    assert (np.diff(displacements) > 0.0).all()


@pytest.mark.parametrize(
    ("call", "error"),
    [
        (lambda arm: armctl.tune(arm, "pdd"), armctl.UnknownNameError),
        (lambda arm: armctl.tune(arm, "computed-torque-textbook"), armctl.UnknownNameError),
        (lambda arm: armctl.tune(arm, "pd", peak_sensitivity=0.5), armctl.InputError),
        (lambda arm: armctl.tune(arm, "pd", plants=PLANT), armctl.InputError),
        (lambda arm: armctl.tune(arm, "pd", plants=[PLANT, armctl.Plant(timestep=0.001)]), armctl.InputError),
    ],
)
def test_a_wrong_call_is_an_error(arm, call, error):
    with pytest.raises(error):
        call(arm)
