"""A momentum observer finds pushes and nothing else; reactions keep all limits; a floating arm follows a hand."""

import mujoco
import numpy as np
import pytest
from synthetic import BENT, limb, mjcf, motors, serial_arm

import armctl

TICK_S = 0.002
PUSH = armctl.Push(0.4, 0.1, force=[0.0, 50.0, 0.0])


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    return serial_arm(tmp_path_factory.mktemp("six"), BENT["six joints"])


def recorded(arm, plant, seed):
    """A random motion with noise: positions, their differences and torques."""
    rng = np.random.default_rng(seed)
    points = np.vstack([arm.home, arm.home + rng.uniform(-0.6, 0.6, (3, arm.n))])
    log = armctl.simulate(arm, "computed-torque-observer", armctl.move_through(arm, points), plant)
    q = log.q + 1e-5 * rng.normal(size=log.q.shape)
    return q, np.diff(q, axis=0, prepend=q[:1]) / log.dt, log.tau


def alarms(force, q, v, tau):
    """The ticks at which there is an alarm."""
    force.reset()
    found = []
    for k in range(1, len(q)):
        force.update(q[k], v[k], tau[k - 1], TICK_S)
        if force.alarm:
            found.append(k)
    return found


def test_the_estimate_is_the_true_torque_of_a_push(arm):
    plant = armctl.Plant(timestep=TICK_S, pushes=armctl.Push(0.2, 1.0, force=[5.0, 20.0, -10.0], torque=[1.0, 0.0, 0.5]))
    log = armctl.simulate(arm, "pd-gravity", armctl.move_j(arm, arm.home, arm.home + 0.3), plant)
    force = armctl.ExternalForce(arm, model_error=0.0)
    for k in range(300):
        force.update(log.q[k], log.v[k], log.tau[k - 1], TICK_S)
    wrench = np.array([5.0, 20.0, -10.0, 1.0, 0.0, 0.5])
    assert force.torque == pytest.approx(arm.jacobian(log.q[299]).T @ wrench, rel=0.05, abs=0.1)
    assert force.wrench(log.q[299]) == pytest.approx(wrench, abs=1.5)


def test_a_push_is_found_at_once_and_wrong_masses_are_no_push(arm):
    wrong = {"timestep": TICK_S, "mass_scale": 1.05, "coulomb_friction": 0.002 * arm.limits.tau_max}
    force = armctl.ExternalForce(arm).calibrated(*recorded(arm, armctl.Plant(**wrong), 0), TICK_S)
    for seed in range(1, 4):
        assert not alarms(force, *recorded(arm, armctl.Plant(**wrong), seed))
    first = alarms(force, *recorded(arm, armctl.Plant(**wrong, pushes=PUSH), 5))[0]
    assert 0.4 < first * TICK_S <= 0.42
    assert force.alarm == "" or "from outside at j" in force.alarm


def test_an_alarm_is_a_torque_above_its_threshold(arm):
    slow = armctl.Push(0.1, 0.8, force=[0.0, 0.0, 40.0])
    log = armctl.simulate(arm, "pd-gravity", armctl.move_j(arm, arm.home, arm.home + 0.1), armctl.Plant(pushes=slow))
    force = armctl.ExternalForce(arm, bandwidth=1.0)
    shares = []
    for q, v, tau in zip(log.q[1:], log.v[1:], log.tau, strict=False):
        force.update(q, v, tau, log.dt)
        shares.append((np.abs(force.torque) / force.threshold).max())
        assert bool(force.alarm) == (shares[-1] > 1.0)
    assert 1.0 < min(share for share in shares if share > 1.0) < 1.2


@pytest.mark.parametrize("reaction", ["stop", "retreat", "float"])
def test_reactions_keep_all_limits_and_the_next_move_starts_where_they_end(arm, reaction):
    plant = armctl.Plant(timestep=TICK_S, encoder_noise=1e-5, pushes=PUSH)
    sim = armctl.Simulation(arm, "computed-torque-observer", plant)
    sim.reaction = armctl.ContactReaction(arm, reaction=reaction)
    goal = arm.home + np.array([0.8, 0.4, -0.4, 0.5, 0.3, 0.2])
    moved = sim.move_j(goal, avoid=False)
    assert not moved
    assert moved.reason.startswith("contact at 0.4")
    assert 0.4 < sim.reaction.time <= 0.42
    reference = sim.log.q_ref[np.isfinite(sim.log.q_ref).all(axis=1)]
    speed = np.diff(reference, axis=0) / TICK_S
    assert (np.abs(speed) <= 1.001 * arm.limits.v_max).all()
    assert (np.abs(np.diff(speed, axis=0)) / TICK_S <= 1.01 * arm.limits.a_max).all()
    felt_at = armctl.move_j(arm, arm.home, goal)(sim.reaction.time).q
    stopped = armctl.move_j(arm, arm.home, goal).stopped_at(sim.reaction.time + 0.004)
    if reaction == "retreat":
        assert np.abs(reference[-1] - arm.home).max() < np.abs(felt_at - arm.home).max()
    else:
        assert np.abs(reference[-1] - stopped(stopped.duration).q).max() < 0.01
    assert np.isnan(sim.log.q_ref[-1]).all() == (reaction == "float")
    again = sim.move_j(arm.home, avoid=False)
    assert again, again.reason
    assert not sim.reaction.contact


def test_without_a_contact_nothing_changes(arm):
    logs = []
    for reaction in (None, armctl.ContactReaction(arm)):
        sim = armctl.Simulation(arm, "pd-gravity", armctl.Plant(timestep=TICK_S))
        sim.reaction = reaction
        assert sim.move_j(arm.home + 0.2, avoid=False)
        assert sim.reaction is reaction
        logs.append(sim.log)
    assert np.array_equal(logs[0].q, logs[1].q)


def test_a_floating_arm_stays_follows_a_hand_and_comes_to_rest(arm):
    push = armctl.Push(0.2, 0.5, force=[0.0, 15.0, 0.0])
    sim = armctl.Simulation(arm, armctl.HandGuiding(arm), armctl.Plant(timestep=TICK_S, coulomb_friction=0.2, pushes=push))
    for _ in range(100):
        sim.step()
    assert np.abs(sim.state.q - arm.home).max() < 1e-3
    for _ in range(250):
        sim.step()
    assert np.abs(sim.state.q - arm.home).max() > 0.02
    for _ in range(1500):
        sim.step()
    assert np.abs(sim.state.v).max() < 0.2
    assert arm.limits.contains(sim.state.q, 0.05)


def test_hand_guiding_helps_against_friction_in_the_direction_of_motion():
    text = mjcf(limb("a", joint='frictionloss="2" damping="0.5"'), motors("a"))
    arm = armctl.load(mujoco.MjSpec.from_string(text))
    law = armctl.HandGuiding(arm, friction_share=0.5)
    setpoint = armctl.Setpoint(arm.home, np.zeros(1), np.zeros(1))
    for v in (-0.3, 0.3):
        tau = law.torque(armctl.State(arm.home, np.array([v])), setpoint)
        assert tau == pytest.approx(arm.gravity(arm.home) + 0.5 * (2.0 * np.sign(v) + 0.5 * v))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda arm: armctl.ExternalForce(arm, bandwidth=-1.0), "bandwidth"),
        (lambda arm: armctl.ExternalForce(arm, noise=[1.0]), "noise"),
        (lambda arm: armctl.ExternalForce(arm, noise=-np.ones(arm.n)), "noise: every value"),
        (lambda arm: armctl.ExternalForce(arm, friction=3), "friction: expected a function"),
        (lambda arm: armctl.ExternalForce(arm).update(arm.home, arm.home, arm.home, 0.0), "dt"),
        (lambda arm: armctl.ExternalForce(arm).calibrated([[1.0]], [[1.0]], [[1.0]], 0.001), "q, v and torque"),
        (lambda arm: armctl.ContactReaction(arm, reaction="flee"), "reaction"),
        (lambda arm: armctl.ContactReaction(arm, "stop"), "force"),
        (lambda arm: setattr(armctl.Simulation(arm), "reaction", "stop"), "reaction"),
        (lambda arm: armctl.HandGuiding(arm, 1.5), "friction_share"),
    ],
)
def test_wrong_calls_are_input_errors(arm, call, message):
    with pytest.raises(armctl.InputError, match=message):
        call(arm)
