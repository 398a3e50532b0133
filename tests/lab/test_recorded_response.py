"""Frequency responses from recordings of a multisine: bounds, resonances, and filters that follow from them."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from synthetic import BENT, Shape, serial_arm

import armctl

SPRING = np.array([0.0, 600.0, 0.0])
ELASTIC = armctl.Plant(timestep=0.002, elasticity=SPRING, rotor_inertia=0.1, elastic_damping=0.02, delay=1)
STIFF = {"stiffness": np.array([300.0, 600.0, 100.0]), "damping": np.array([15.0, 30.0, 5.0])}


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    shape = replace(BENT["planar"], joint='armature="0.1" damping="0.5"')
    return serial_arm(tmp_path_factory.mktemp("planar"), shape)


@pytest.fixture(scope="module")
def motion(arm):
    return armctl.excitation(arm, for_="frequency")


def recorded(arm, motion, plant):
    """A log of a PD on a plant, and the positions that it measured."""
    seen = []

    class Watching(armctl.PDGravity):
        def torque(self, state, setpoint):
            seen.append(state.q.copy())
            return super().torque(state, setpoint)

    return armctl.simulate(arm, Watching(arm, **STIFF), motion, plant, dwell=0.0), np.array(seen)


@pytest.fixture(scope="module")
def elastic(arm, motion):
    return recorded(arm, motion, replace(ELASTIC, encoder_noise=1e-6))


@pytest.fixture(scope="module")
def fits(motion, elastic):
    log, seen = elastic
    return [armctl.FrequencyResponse.from_log(log, motion, joint, positions=seen).two_mass() for joint in range(3)]


def test_the_motion_keeps_all_limits_and_never_turns_in_a_measured_period(arm, motion):
    assert motion.check_limits().ok
    assert armctl.check_torque(arm, motion).ok
    assert np.isnan(motion.clearance)  # its links have no shapes
    assert not motion(0.0).v.any()
    assert np.abs(motion(motion.duration).v).max() < 1e-12
    multisine = motion.multisine
    for start in multisine.starts:
        speed = motion.sample(np.linspace(start, start + multisine.period, 500)).v
        assert (np.abs(np.sign(speed).sum(axis=0)) == 500).all()
    assert (multisine.lines % 2 == 1).all()


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("plant", "largest_bound"),  # MuJoCo's dry friction is viscous at low speed: more of it, the lighter the rotor
    [
        (armctl.Plant(timestep=0.002, coulomb_friction=1.0, delay=2), 0.1),
        (replace(ELASTIC, coulomb_friction=0.1, elastic_damping=0.1), 0.2),
    ],
)
def test_the_true_response_is_within_the_bounds_in_spite_of_friction_delay_noise_and_springs(arm, plant, largest_bound):
    inside = []
    for seed in range(3):
        start = arm.home + np.random.default_rng(seed).uniform(-0.3, 0.3, arm.n)
        motion = armctl.excitation(arm, for_="frequency", seed=seed, start=start)
        plant = replace(plant, encoder_noise=2e-6, seed=seed)
        log, seen = recorded(arm, motion, plant)
        sagged = log.q[np.round((motion.multisine.starts + 1.0) / log.dt).astype(int)].mean(axis=0)
        loop = armctl.linearize(arm, armctl.PDGravity(arm, **STIFF), sagged, plant)
        for joint, of in product(range(arm.n), ("plant", "sensitivity")):
            found = armctl.FrequencyResponse.from_log(log, motion, joint, of, loop=loop, positions=seen)
            assert found.ok, found.reason
            assert np.median(found.bound / np.abs(found.measured)) < largest_bound
            inside.append(np.abs(found.measured - found.predicted) <= found.bound)
    assert 0.90 < np.mean(inside) < 0.99


def test_a_spring_shows_its_resonance_and_a_rigid_joint_none(arm, fits):
    assert fits[1], fits[1].reason
    poles = np.log(np.linalg.eigvals(armctl.linear_arm(arm, arm.home, ELASTIC).A).astype(complex)) / 0.002
    [true] = np.abs(poles[poles.imag > 20.0])
    assert fits[1].resonance == pytest.approx(true, rel=0.02)
    assert fits[1].side == "motor"
    assert fits[1].stiffness == pytest.approx(600.0, rel=0.1)
    assert not fits[0]
    assert "no spring" in str(fits[0])
    assert "resonance" in str(fits[1])
    plant = armctl.TwoMass.plant(arm, fits, arm.home)
    assert np.flatnonzero(plant.elasticity).tolist() == [1]  # a neighbour vibrates with it


def test_links_show_the_resonance_without_an_antiresonance(arm, motion, elastic):
    log, _ = elastic
    found = armctl.FrequencyResponse.from_log(log, motion, 1)
    assert found.two_mass().side == "link"


@pytest.mark.full
def test_the_proposed_notch_raises_the_margin_as_predicted(arm, fits):
    known = armctl.TwoMass.plant(arm, fits, arm.home, armctl.Plant(timestep=0.002, delay=1))
    law = armctl.ComputedTorque(arm)
    proposal = armctl.propose_filter(arm, law, arm.home, known, delay_margin=3e-3)
    assert proposal, proposal.reason
    assert isinstance(proposal.controller, armctl.TorqueFilter)
    true = armctl.linearize(arm, proposal.controller, arm.home, ELASTIC).margins()
    before = armctl.linearize(arm, law, arm.home, ELASTIC).margins()
    assert before.peak_sensitivity > 1.7 or before.delay_margin < 3e-3
    assert true.delay_margin == pytest.approx(proposal.after.delay_margin, rel=0.1)
    assert true.peak_sensitivity == pytest.approx(proposal.after.peak_sensitivity, rel=0.1)
    impossible = armctl.propose_filter(arm, law, arm.home, known, delay_margin=0.9)
    assert not impossible
    assert "no filter" in str(impossible)


def test_one_joint_alone_and_no_torques(arm):
    motion = armctl.excitation(arm, for_="frequency", joint=2, duration=40.0)
    assert not np.ptp(motion.coefficients[:, 0, :2], axis=0).any()
    plant = armctl.Plant(timestep=0.002)
    law = armctl.PDGravity(arm, **STIFF)
    log = armctl.simulate(arm, law, motion, plant, dwell=0.0)
    found = armctl.FrequencyResponse.from_log(log, motion, "j2", loop=armctl.linearize(arm, law, arm.home, plant))
    assert found.error.max() < 0.01
    nothing = np.full_like(log.tau, np.nan)
    blind = replace(log, tau=nothing, tau_cmd=nothing)
    closed = armctl.FrequencyResponse.from_log(blind, motion, 2, "closed loop")
    assert closed
    assert abs(closed.measured[0]) == pytest.approx(1.0, abs=0.3)
    with pytest.raises(armctl.InputError, match="it has no torques"):
        armctl.FrequencyResponse.from_log(blind, motion, 2)


def test_a_response_is_drawn(tmp_path, motion, elastic):
    log, seen = elastic
    found = armctl.FrequencyResponse.from_log(log, motion, 1, positions=seen)
    assert found.plot(tmp_path / "bode.svg").read_text().startswith("<?xml")
    assert "40 frequencies" not in str(found)
    assert "bounds of 95 %" in str(found)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda arm, motion, log: armctl.FrequencyResponse.from_log(log, motion, 7), "joint"),
        (lambda arm, motion, log: armctl.FrequencyResponse.from_log(log, motion, "elbow"), "joint: there is no joint"),
        (lambda arm, motion, log: armctl.FrequencyResponse.from_log(log, motion, 1, "open"), "of"),
        (
            lambda arm, motion, log: armctl.FrequencyResponse.from_log(log, motion, 1, "sensitivity"),
            "loop: a sensitivity needs",
        ),
        (lambda arm, motion, log: armctl.FrequencyResponse.from_log(log, motion, 1, positions=[1.0]), "positions"),
        (lambda arm, motion, log: armctl.FrequencyResponse.from_log(log, armctl.excitation(arm), 1), "motion: it excites"),
        (lambda arm, motion, log: armctl.FrequencyResponse.from_log(motion, motion, 1), "log"),
        (lambda arm, motion, log: armctl.FrequencyResponse.from_log(replace(log, dt=0.003), motion, 1), "interval"),
        (
            lambda arm, motion, log: armctl.FrequencyResponse.from_log(replace(log, q=log.q[:100], t=log.t[:100]), motion, 1),
            "log",
        ),
        (
            lambda arm, motion, log: armctl.FrequencyResponse.from_log(
                replace(log, tau=0 * log.tau, tau_cmd=0 * log.tau), motion, 1
            ),
            "log: a joint did not move",
        ),
        (lambda arm, motion, log: armctl.excitation(arm, for_="arm", joint=1), "joint: a motion that identifies"),
        (lambda arm, motion, log: armctl.excitation(arm, for_="frequency", duration=5.0), "duration: expected at least"),
        (lambda arm, motion, log: armctl.excitation(arm, for_="frequency", joint="elbow"), "joint: there is no joint"),
    ],
)
def test_wrong_calls_are_input_errors(arm, motion, elastic, call, message):
    with pytest.raises(armctl.InputError, match=message):
        call(arm, motion, elastic[0])


def test_a_joint_without_room_is_refused_or_moves_less(tmp_path):
    with pytest.warns(armctl.ArmctlWarning, match="are these numbers radians"):
        tight = serial_arm(tmp_path, Shape(0.3, 2.0, 100.0, joints=2, joint='armature="0.1"', range="-0.02 0.02"))
    motion = armctl.excitation(tight, for_="frequency")
    assert motion.check_limits().ok
    assert np.abs(motion.coefficients[:, 0]).max() < 0.02
    with pytest.raises(armctl.PlanError, match="j1 has no room"):
        armctl.excitation(tight, for_="frequency", start=[0.0, 0.02])
