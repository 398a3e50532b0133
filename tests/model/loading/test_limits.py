"""Limits of joints: ranges far from zero, masses and time steps that nothing can be simulated with."""

import re
import warnings

import numpy as np
import pytest
from synthetic import limb, mjcf, motors

import armctl
from armctl.model.arm.parity import check_parity

RANGES = {
    "a hinge beyond pi": 'axis="0 0 1" range="3.5 6"',
    "a hinge below -pi": 'axis="0 0 1" range="-6 -3.5"',
    "a hinge with many turns": 'axis="0 0 1" range="12.566 37.699"',
    "a slide far from zero": 'type="slide" axis="1 0 0" range="4 6"',
    "a slide far below zero": 'type="slide" axis="1 0 0" range="-6 -4"',
}


@pytest.mark.parametrize("what", RANGES)
@pytest.mark.parametrize("has_motor_range", [True, False])
def test_a_range_that_does_not_contain_zero_loads(load, what: str, has_motor_range: bool):
    bodies = limb("a b").replace('axis="0 1 0" range="-2 2"', RANGES[what])
    assert RANGES[what] in bodies
    if has_motor_range:
        arm = load(bodies, motors("a b"))
    else:
        with pytest.warns(armctl.ArmctlWarning, match="no torque limit given"):
            arm = load(bodies, '<actuator><motor joint="a"/><motor joint="b"/></actuator>')
    assert check_parity(arm, samples=20) < 1e-9
    assert arm.limits.contains(arm.home)
    assert arm.limits.tau_max.min() > 0


def test_parity_is_measured_inside_the_limits(load, monkeypatch: pytest.MonkeyPatch):
    arm = load(limb("a").replace('range="-2 2"', 'range="3.5 6"'), motors("a"))
    seen = []
    whole = armctl.Arm.qpos
    monkeypatch.setattr(armctl.Arm, "qpos", lambda self, q: seen.append(q) or whole(self, q))
    check_parity(arm, samples=30)
    assert len(seen) == 31
    assert np.min(seen) >= 3.5
    assert np.ptp(seen) > 1.5


@pytest.mark.parametrize("timestep", ["0", "-1", "nan"])
def test_a_time_step_that_nothing_can_be_simulated_with_is_refused(load, timestep: str):
    with pytest.raises(armctl.ModelError, match=f"time step is {timestep} s; it must be above 0"):
        load(limb("a b"), motors("a b") + f'<option timestep="{timestep}"/>')


@pytest.mark.parametrize(("what", "unit"), [("armature", "kg m^2"), ("frictionloss", "N m")])
def test_an_inertia_or_a_friction_below_zero_is_refused(load, what: str, unit: str):
    with pytest.raises(armctl.ModelError, match=rf"the joint 'a' has {what} -1e-06 {re.escape(unit)}; it must be at least 0"):
        load(limb("a b", joint=f'{what}="-1e-6"'), motors("a b"))


def test_masses_that_leave_no_digit_of_the_accelerations_are_refused(load):
    with pytest.raises(armctl.ModelError, match=r"mass matrix at home is singular .*1e\+21 kg of 'A'"):
        load(limb("a b c").replace('mass="0.5"', 'mass="1e21"', 1), motors("a b c"))


@pytest.mark.filterwarnings("ignore:Inertia matrix is too close to singular:UserWarning")  # MuJoCo's
def test_masses_whose_products_overflow_are_refused(load):
    with pytest.raises(armctl.ModelError, match=r"^joint 'a': it moves an inertia of .*; check masses and inertias"):
        load(limb("a b c").replace('mass="0.5"', 'mass="1e307"'), motors("a b c"))


def test_a_chain_of_many_joints_loads_in_seconds(load):
    names = [f"j{i}" for i in range(150)]
    arm = load(limb(" ".join(names)), motors(" ".join(names)))
    assert arm.n == 150


LONG = "x" * 5000


@pytest.mark.parametrize(
    "text",
    [
        mjcf(f'<geom type="mesh" mesh="{LONG}"/>', f'<asset><mesh name="{LONG}" file="{LONG}.stl"/></asset>'),
        mjcf(limb(LONG), '<actuator><position joint="a"/></actuator>'),
        mjcf(limb(f"a {LONG}"), motors("a")),
        mjcf(
            f'<body name="{LONG}"><joint name="{LONG}" type="ball"/><geom size="0.1"/></body>',
            f'<actuator><motor joint="{LONG}"/></actuator>',
        ),
    ],
)
def test_messages_about_long_names_are_short(tmp_path, text: str):
    path = tmp_path / "long.xml"
    path.write_text(text)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            armctl.load(path)
            messages = [str(each.message) for each in warned]
        except armctl.ArmctlError as error:
            messages = [str(error)]
    assert messages
    assert max(map(len, messages)) <= 400
    assert not any("\n" in message for message in messages)


@pytest.mark.parametrize("lifted", [0.0, 0.5, 1.0])
def test_default_accelerations_are_half_of_what_the_torque_beyond_gravity_gives(load, lifted: float):
    bodies = limb("a b c", joint='armature="0.5"').replace("<body ", f'<body gravcomp="{lifted}" ')
    arm = load(bodies, motors("a b c").replace("-20 20", "-9 9"))
    headroom = np.maximum(9.0 - np.abs(arm.gravity(arm.home)), 0.9)
    expected = 0.5 * headroom / np.abs(arm.mass_matrix(arm.home)).sum(axis=1)
    assert arm.limits.a_max == pytest.approx(np.minimum(expected, 10.0 * arm.limits.v_max))
    assert (expected < 10.0 * arm.limits.v_max).any()
    assert arm.limits.j_max == pytest.approx(arm.limits.a_max / 0.05)
