"""Notches and low-passes for the torques of any controller: SciPy's sections, compiled, and what they do to a loop."""

import numpy as np
import pytest
from scipy.signal import sosfilt, sosfilt_zi
from synthetic import FAST, limb, motors, rotor_spring_link

import armctl

FILTERS = [armctl.Notch(60.0), armctl.LowPass(400.0, order=3)]
DT = 0.001


@pytest.fixture
def arm(load):
    return load(limb("a b", joint='armature="0.05" damping="0.5"'), FAST + motors("a b"))


class InPython(armctl.PDGravity):
    """The same law without a compiled one."""

    def torque(self, state, setpoint):
        return super().torque(state, setpoint)


def test_torques_are_those_of_scipys_filter_settled_at_the_first_one(arm):
    law = armctl.TorqueFilter(arm, armctl.PDGravity(arm), FILTERS)
    plain = armctl.PDGravity(arm)
    rng = np.random.default_rng(0)
    rest = np.zeros(arm.n)
    setpoint = armctl.Setpoint(arm.home, rest, rest, rest, rest)
    states = [armctl.State(arm.home + 0.01 * rng.normal(size=arm.n), rng.normal(size=arm.n), k * DT, DT) for k in range(200)]
    filtered = np.array([law.torque(state, setpoint) for state in states])
    torques = np.array([plain.torque(state, setpoint) for state in states])
    sections = law.sections(DT)
    expected, _ = sosfilt(sections, torques, axis=0, zi=sosfilt_zi(sections)[:, :, None] * torques[0])
    assert filtered == pytest.approx(expected, abs=1e-10)
    assert filtered[0] == pytest.approx(torques[0])


def test_a_compiled_controller_and_the_same_one_in_python_are_filtered_alike(arm):
    motion = armctl.move_j(arm, arm.home, arm.home + 0.3)
    compiled = armctl.TorqueFilter(arm, armctl.PDGravity(arm), FILTERS)
    python = armctl.TorqueFilter(arm, InPython(arm), FILTERS)
    assert compiled.is_compiled
    assert not python.is_compiled
    logs = [armctl.simulate(arm, law, motion) for law in (compiled, python)]
    assert logs[0].q == pytest.approx(logs[1].q, abs=1e-10)
    assert np.array_equal(logs[0].q, armctl.simulate(arm, compiled, motion).q)


def test_a_notch_removes_its_frequency_and_margins_know_it(arm):
    loop = armctl.linearize(arm, armctl.TorqueFilter(arm, armctl.PD(arm), armctl.Notch(60.0)), arm.home)
    plain = armctl.linearize(arm, "pd", arm.home)
    at_notch = np.abs(loop.transfer([60.0])).max() / np.abs(plain.transfer([60.0])).max()
    beside = np.abs(loop.transfer([3.0])).max() / np.abs(plain.transfer([3.0])).max()
    assert at_notch < 1e-6
    assert beside == pytest.approx(1.0, abs=0.01)
    assert loop.margins().delay_margin < plain.margins().delay_margin


def test_a_low_pass_takes_noise_off_the_torques(arm):
    motion = armctl.move_j(arm, arm.home, arm.home + 0.3)
    noisy = armctl.Plant(encoder_noise=1e-4)
    law = armctl.ComputedTorque(arm)
    plain = armctl.simulate(arm, law, motion, noisy)
    smooth = armctl.simulate(arm, armctl.TorqueFilter(arm, law, armctl.LowPass(300.0)), motion, noisy)
    chatter = [np.abs(np.diff(log.tau_cmd, 2, axis=0)).mean() for log in (plain, smooth)]
    assert chatter[1] < 0.1 * chatter[0]
    assert np.abs(smooth.q[-1] - motion(10.0).q).max() < 0.01


def test_a_notch_stabilizes_a_loop_that_an_elastic_joint_makes_unstable(load):
    with pytest.warns(armctl.ArmctlWarning):
        arm = load(rotor_spring_link("a", 200.0, 0.02, 0.01), FAST + motors("a"))
    plant = armctl.Plant(encoder_side="link")
    law = armctl.PD(arm, stiffness=8.0, damping=0.4)
    assert not armctl.linearize(arm, law, arm.home, plant).margins()
    poles = np.linalg.eigvals(armctl.linear_arm(arm, arm.home).A)
    resonance = np.abs(np.angle(poles)).max() / arm.dt
    notched = armctl.TorqueFilter(arm, law, armctl.Notch(resonance, quality=0.7))
    found = armctl.linearize(arm, notched, arm.home, plant).margins()
    assert found.ok, found.reason


@pytest.mark.parametrize(("make", "message"), [
    (lambda arm: armctl.Notch(0.0), "frequency: expected a number in"),
    (lambda arm: armctl.LowPass(10.0, order=0), "order: expected a number in"),
    (lambda arm: armctl.TorqueFilter(arm, armctl.PD(arm), []), "filters: expected 1 to 16 filters, got 0"),
    (lambda arm: armctl.TorqueFilter(arm, armctl.PD(arm), [3.0]), r"filters: 3\.0 is no filter; armctl\.Notch"),
    (lambda arm: armctl.TorqueFilter(arm, "pd", armctl.Notch(10.0)), "has no method torque"),
    (
        lambda arm: armctl.TorqueFilter(arm, armctl.PD(arm), armctl.LowPass(4000.0)).make_law(0.001, False),
        r"the frequency must be below pi / dt = 3141\.59 rad/s",
    ),
])  # fmt: skip
def test_an_impossible_filter_is_refused_in_one_sentence(arm, make, message):
    with pytest.raises(armctl.InputError, match=message):
        make(arm)
