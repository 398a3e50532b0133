"""Every controller, with its default gains, on arms that nobody has at hand: light, heavy, damped, geared, sliding."""

import numpy as np
import pytest
from motions import Still, Sway

import armctl
from armctl.control import CONTROLLERS

EXACT = ("computed-torque", "computed-torque-observer", "operational-space", "impedance", "adaptive")
AXES = ("0 0 1", "0 1 0", "0 1 0", "0 0 1", "0 1 0", "0 0 1")
LINK = """<body pos="0 0 {below:g}"><joint name="j{i}" type="{kind}" axis="{axis}" range="-2 2" {joint}/>
<geom type="capsule" fromto="0 0 0 0 0 {length:g}" size="{radius:g}" mass="{mass:g}" contype="0" conaffinity="0"/>"""
MOTOR = '<motor joint="j{i}" gear="{gear:g}" ctrlrange="-{most:g} {most:g}"/>'
TEXT = """<mujoco><compiler angle="radian"/><option integrator="{integrator}"/>
<worldbody>{links}<site name="tip" pos="0 0 {length:g}"/>{ends}</worldbody><actuator>{motors}</actuator></mujoco>"""

# length m, mass kg, strength N m of the first link, shrinking from link to link, gear, what joints have, which of them slide
ARMS = {
    "light": (0.02, 0.003, 0.05, 1.0, 1.0, "", 0),  # 1e-8 to 1e-5 kg m^2
    "heavy": (2.0, 200.0, 2e6, 1.0, 1.0, "", 0),  # 1 to 1e4 kg m^2
    "tapering": (0.4, 12.0, 400.0, 0.6, 1.0, "", 0),  # 1e-7 kg m^2 behind 0.1
    "damped": (0.3, 2.0, 300.0, 1.0, 1.0, 'damping="10"', 0),
    "geared": (0.3, 2.0, 300.0, 1.0, -100.0, 'damping="1" armature="5" frictionloss="3"', 0),
    "sliding": (0.3, 20.0, 2000.0, 0.6, 1.0, "", 2),
}


def arm_of(folder, name: str, integrator: str) -> armctl.Arm:
    length, mass, most, taper, gear, joint, slides = ARMS[name]
    links = motors = ""
    below = 0.0
    for i, axis in enumerate(AXES):
        size, kind = taper**i, "slide" if i < slides else "hinge"
        values = {"below": below, "length": length * size, "radius": 0.1 * length * size, "mass": mass * size**3}
        links += LINK.format(i=i, kind=kind, axis=axis, joint=joint, **values)
        motors += MOTOR.format(i=i, gear=gear, most=most * size**4 / abs(gear))
        below = length * size
    path = folder / f"{name}.xml"
    path.write_text(TEXT.format(integrator=integrator, links=links, length=below, ends="</body>" * len(AXES), motors=motors))
    return armctl.load(path)


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "implicit", "continuous"])
@pytest.mark.parametrize("dt", [0.001, 0.004])
@pytest.mark.parametrize("shape", ARMS)
def test_default_gains_hold_on_extreme_arms(tmp_path, shape, dt, integrator):
    continuous = integrator == "continuous"
    arm = arm_of(tmp_path, shape, "Euler" if continuous else integrator)
    plant = armctl.Plant(timestep=dt, continuous=continuous)
    for name in CONTROLLERS:
        log = armctl.simulate(arm, name, Sway(arm), plant, dwell=0.2)
        kicked = armctl.Simulation(arm, name, plant)
        kicked.reset(arm.home, np.minimum(0.2, 0.05 * arm.limits.v_max))
        after = kicked.run(Still(arm.home, 0.5))
        assert not log.failure + after.failure, name
        if name in EXACT and not continuous:
            assert np.abs(log.q - log.q_ref).max() < 1e-8, name
        if name != "pd":  # which lets go of a light arm, so that it falls as fast as it can
            jitter = max(np.abs(np.diff(run.v[-10:], axis=0)).max() / dt for run in (log, after))
            assert jitter < 20.0, name


@pytest.mark.parametrize("dt", [0.001, 0.004])
def test_a_payload_that_shows_at_once_is_not_learnt_faster_than_ticks_bear(tmp_path, dt):
    """The tip of a heavy arm is thrown about at eight times gravity, so a wrong payload shows 64 times as much as at rest."""
    arm = arm_of(tmp_path, "heavy", "Euler")
    log = armctl.simulate(arm, "adaptive", Sway(arm), armctl.Plant(timestep=dt, delay=1), dwell=0.5)
    assert not log.failure
    assert np.abs(log.q - log.q_ref).max() < 0.02
