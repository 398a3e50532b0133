"""The linear loop contains what is between a command and a joint: delays, windings, springs; margins hold to a tick."""

import numpy as np
import pytest
from arms import some_of
from instability import grows
from synthetic import FAST, limb, motors, rotor_spring_link

import armctl

JOINT = 'armature="0.05" damping="0.5"'
DC = '<dcmotor name="m_{0}" joint="{0}" nominal="24 0.5 300" gear="50" {1}/>'
LATE = '<motor name="m_{0}" joint="{0}" ctrlrange="-20 20" delay="{1}" nsample="6"/>'
SENSORS = '<sensor><jointpos joint="a" nsample="9" {}/><actuatorvel actuator="m_b" nsample="9" {}/></sensor>'
# No whole number of ticks: with one, rounding of the time adds a tick after some seconds of a simulation.
FILES = {
    "one late actuator": (limb("a b", joint=JOINT), motors("a b", b=LATE.format("b", 0.0036))),
    "two delays": (limb("a b", joint=JOINT), motors("a b", a=LATE.format("a", 0.0025), b=LATE.format("b", 0.0036))),
    "inductance": (limb("a b", joint=JOINT), motors("a b", a=DC.format("a", 'inductance="0 0.004"'), b=DC.format("b", ""))),
    "late sensors": (limb("a b", joint=JOINT), motors("a b") + SENSORS.format('delay="0.0025"', 'delay="0.004"')),
    "sensors at intervals": (
        limb("a b", joint=JOINT),
        motors("a b") + SENSORS.format('interval="0.0035 -0.001"', 'interval="0.003" delay="0.001"'),
    ),
    "elastic joints": (rotor_spring_link("a b", 400.0), motors("a b")),
    "soft joints": (rotor_spring_link("a b", 40.0, 0.05), motors("a b")),
}


@pytest.fixture(params=FILES)
def imperfect(request, load):
    bodies, actuators = FILES[request.param]
    with pytest.warns(armctl.ArmctlWarning):
        return load(bodies, FAST + actuators)


@pytest.mark.parametrize("law", some_of(["pd", "computed-torque", "computed-torque-observer"], ["pd"]))
def test_the_predicted_delay_margin_is_that_of_the_simulation_to_the_tick(imperfect, law):
    loop = armctl.linearize(imperfect, law, imperfect.home)
    found = loop.margins()
    assert found.ok, found.reason
    ticks = int(found.delay_margin / loop.dt)
    assert not grows(imperfect, law, loop, ticks)
    assert grows(imperfect, law, loop, ticks + 1)


def test_a_resonance_narrower_than_the_grid_of_frequencies_counts(load):
    with pytest.warns(armctl.ArmctlWarning):
        arm = load(rotor_spring_link("a", 400.0, 1e-4), FAST + motors("a"))
    loop = armctl.linearize(arm, "pd", arm.home)
    found = loop.margins()
    assert found.ok
    ticks = int(found.delay_margin / loop.dt)
    assert loop.delayed(ticks).margins().ok
    assert not loop.delayed(ticks + 1).margins().ok


def test_friction_of_a_dc_motor_is_left_out_as_dry_friction_is(load):
    loops = []
    for friction in ("", ' lugre="90 1 0.01 0.02 0.1" thermal="1 2 0 0.0039 25 25"'):
        motor = DC.format("a", 'inductance="0 0.002"' + friction)
        with pytest.warns(armctl.ArmctlWarning):
            arm = load(limb("a b", joint=JOINT), FAST + motors("a b", a=motor))
        loops.append(armctl.linearize(arm, "pd", arm.home))
    assert np.allclose(loops[0].A, loops[1].A, atol=1e-6)
    assert loops[0].margins().delay_margin == pytest.approx(loops[1].margins().delay_margin)


def test_the_compliance_of_an_elastic_joint_is_that_of_its_spring_and_of_the_controller_in_series(load):
    bodies = rotor_spring_link("a", 400.0).replace("</body></body>", '<site name="tip" pos="0.5 0 0"/></body></body>')
    with pytest.warns(armctl.ArmctlWarning):
        arm = load(bodies, FAST + motors("a") + '<option gravity="0 0 0"/>')
    law = armctl.PD(arm)
    static = armctl.linearize(arm, law, arm.home).compliance([1e-3])[0]
    assert static == pytest.approx(0.5**2 * (1 / 400.0 + 1 / law.stiffness[0]), rel=1e-3)
