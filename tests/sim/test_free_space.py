"""A plant in free space moves as `mj_step` moves it, and tells when it touched something."""

from pathlib import Path

import numpy as np
import pytest
from motions import Still, Sway
from synthetic import TIED, limb, mjcf, motors
from test_compiled_loop import InPython, same

import armctl

PLANTS = {
    "nominal": {},
    "disturbed": {
        "payload": 0.3,
        "mass_scale": 1.1,
        "viscous_friction": 0.2,
        "delay": 1,
        "encoder_noise": 1e-5,
        "timestep": 0.001,
        "pushes": armctl.Push(0.05, 0.1, force=[3, 0, 1]),
    },
}
DRY = mjcf(limb("a b", joint='frictionloss="0.1"'), motors("a b"))
SPRUNG = mjcf(limb("a b", joint='stiffness="1"'), motors("a b"))
WATER = '<option density="1000" viscosity="1"/>'


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("controller", ["pd", "computed-torque"])
def test_the_arm_moves_as_mj_step_moves_it(bundled, controller: str, plant: str):
    bounded = armctl.simulate(bundled, controller, Sway(bundled), armctl.Plant(**PLANTS[plant]))
    free = armctl.simulate(bundled, controller, Sway(bundled), armctl.Plant(**PLANTS[plant], free_space=True))
    assert free.failure == bounded.failure == ""
    assert np.abs(free.q - bounded.q).max() <= 1e-12
    assert np.array_equal(free.t, bounded.t)
    assert np.abs(free.tau - bounded.tau).max() <= 1e-8


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("law", [armctl.PDGravity, armctl.ComputedTorque])
def test_the_python_loop_gives_the_same_bits(bundled, law: type[armctl.PDGravity | armctl.ComputedTorque], plant: str):
    free = armctl.Plant(**PLANTS[plant], free_space=True)
    sim, in_python = (armctl.Simulation(bundled, wrap(law(bundled)), free) for wrap in (lambda law: law, InPython))
    assert same(sim.run(Sway(bundled)), in_python.run(Sway(bundled)))
    assert sim.data.time == in_python.data.time


def test_motors_saturate_as_those_of_mujoco(bundled):
    far = Still(bundled.home + np.array([1.0, 0.3, -0.3]), 0.3)
    bounded, free = (
        armctl.Simulation(bundled, armctl.PD(bundled, stiffness=1e4), armctl.Plant(free_space=kind)).run(far)
        for kind in (False, True)
    )
    assert (np.abs(bounded.tau_cmd) > bundled.limits.tau_max).any()
    assert np.abs(free.tau - bounded.tau).max() <= 1e-9
    assert np.abs(free.q - bounded.q).max() <= 1e-12


@pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")  # of the drag
@pytest.mark.parametrize(
    ("text", "plant", "reason"),
    [
        (DRY, {}, "dry friction"),
        (SPRUNG, {}, "springs"),
        (mjcf(*TIED["a follower in the chain"][:2]), {}, "follows another"),
        (mjcf(limb("a b"), motors("a b") + WATER), {}, "differs by .* from MuJoCo's"),
        (mjcf(limb("a b"), motors("a b")), {"continuous": True}, "Runge-Kutta"),
        (mjcf(limb("a b"), motors("a b")), {"coulomb_friction": 0.1}, "dry friction"),
        (mjcf(limb("a b") + '<body pos="3 0 3"><freejoint/><geom size="0.1"/></body>', motors("a b")), {}, "scene can move"),
    ],
)
def test_what_does_not_move_freely_is_refused_with_the_reason(tmp_path: Path, text: str, plant: dict, reason: str):
    (tmp_path / "arm.xml").write_text(text)
    arm = armctl.load(tmp_path / "arm.xml")
    with pytest.raises(armctl.InputError, match=f"^free_space: .*{reason}"):
        armctl.simulate(arm, "pd", Still(arm.home), armctl.Plant(**plant, free_space=True))


def test_a_run_that_touches_something_fails_and_says_what(tmp_path: Path):
    """A ball on a slide goes through a block that would have stopped it."""
    slide = '<body name="slider" pos="0 0 0.3"><joint name="x" type="slide" axis="1 0 0" range="-9 9" damping="1"/>'
    slide += '<geom size="0.02" mass="1"/><site name="tip"/></body>'
    block = '<body name="block" pos="0.3 0 0.3"><geom type="box" size="0.02 0.2 0.2"/></body>'
    (tmp_path / "arm.xml").write_text(mjcf(slide + block, motors("x")))
    arm = armctl.load(tmp_path / "arm.xml")
    log = armctl.simulate(arm, "computed-torque", armctl.move_j(arm, arm.home, [0.5]), armctl.Plant(free_space=True))
    assert "slider touches block" in log.failure or "block touches slider" in log.failure
    assert log.contacts[0].start == pytest.approx(log.t[np.flatnonzero(log.q[:, 0] > 0.26)[0]], abs=0.05)
    assert not armctl.Report.from_log(log).ok
    short = armctl.simulate(arm, "computed-torque", armctl.move_j(arm, arm.home, [0.2]), armctl.Plant(free_space=True))
    assert short.failure == ""


def test_a_run_that_reaches_a_joint_limit_fails(bundled):
    plant = armctl.Plant(free_space=True, pushes=armctl.Push(0.0, 2.0, force=[0, 0, -200]))
    log = armctl.simulate(bundled, armctl.PD(bundled, stiffness=0.0), Still(bundled.home, 1.0), plant)
    assert "free_space" in log.failure
