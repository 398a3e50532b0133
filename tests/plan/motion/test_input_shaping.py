"""Input shaping: limits are kept, the end is reached later by a known time, and a known vibration does not remain."""

import numpy as np
import pytest
from synthetic import FAST, limb, motors

import armctl

STIFFNESS = 500.0
NO_GRAVITY = '<option gravity="0 0 0"/>'


@pytest.fixture
def vibrating(load):
    """An arm of one elastic joint, its controller, its plant, and its slowest vibration: frequency, damping ratio."""
    body = limb("a", inside='<site name="tip" pos="0.5 0 0"/>', joint='armature="2.0"').replace('mass="0.5"', 'mass="20"')
    arm = load(body, FAST + motors("a").replace("-20 20", "-2000 2000") + NO_GRAVITY)
    plant = armctl.Plant(elasticity=STIFFNESS, elastic_damping=0.005)
    law = armctl.PD(arm, stiffness=40000.0, damping=800.0)
    modes = armctl.linearize(arm, law, arm.home, plant).modes()
    return arm, law, plant, modes[0]


def remaining(vibrating, motion):
    arm, law, plant, _ = vibrating
    log = armctl.simulate(arm, law, motion, plant, dwell=2.0)
    assert not log.failure
    return armctl.Report.from_log(log).residual_vibration_m


def test_zv_cancels_a_known_vibration_and_lowers_one_that_is_a_tenth_off(vibrating):
    arm, _, _, (frequency, damping_ratio) = vibrating
    motion = armctl.move_j(arm, [0.0], [0.5])
    plain = remaining(vibrating, motion)
    shaped = armctl.shape_motion(motion, frequency, damping_ratio)
    assert shaped.duration == pytest.approx(motion.duration + np.pi / frequency)
    assert remaining(vibrating, shaped) < plain / 10
    for wrong in (0.9, 1.1):
        assert remaining(vibrating, armctl.shape_motion(motion, wrong * frequency, damping_ratio)) < plain / 3


def test_more_copies_forgive_a_wrong_frequency_and_take_longer(vibrating):
    arm, _, _, (frequency, damping_ratio) = vibrating
    motion = armctl.move_j(arm, [0.0], [0.5])
    zv, zvd, zvdd = (armctl.shape_motion(motion, 1.15 * frequency, damping_ratio, kind) for kind in ("zv", "zvd", "zvdd"))
    left = [remaining(vibrating, each) for each in (zv, zvd, zvdd)]
    assert left[2] < left[1] < left[0]
    assert zv.duration < zvd.duration < zvdd.duration


def test_a_shaped_motion_is_the_weighted_sum_of_its_copies(bundled):
    motion = armctl.move_j(bundled, bundled.home, bundled.home + np.array([0.4, -0.2, 0.3]))
    shaped = armctl.shape_motion(motion, 20.0, 0.1, "zvd")
    decay = np.exp(-np.pi * 0.1 / np.sqrt(1 - 0.01))
    weights = np.array([1, 2 * decay, decay**2]) / (1 + decay) ** 2
    times = np.linspace(0.0, shaped.duration, 400)
    expected = sum(w * motion.sample(times - k * np.pi / 20.0).q for k, w in enumerate(weights))
    assert shaped.sample(times).q == pytest.approx(expected, abs=1e-12)
    assert shaped.check_limits()
    assert shaped(shaped.duration).q == pytest.approx(motion(motion.duration).q, abs=1e-12)


def test_a_motion_that_does_not_rest_at_its_ends_is_refused(bundled):
    motion = armctl.move_j(bundled, bundled.home, bundled.home + 0.3)
    with pytest.raises(armctl.InputError, match="it does not start and end at rest"):
        armctl.shape_motion(motion.until(0.5 * motion.duration), 20.0)
    with pytest.raises(armctl.InputError, match="shaper: expected one of zv, zvd, zvdd, got 'ei'"):
        armctl.shape_motion(motion, 20.0, shaper="ei")


def test_the_modes_of_a_loop_are_those_of_its_simulation(vibrating):
    arm, law, plant, (frequency, damping_ratio) = vibrating
    log = armctl.simulate(arm, law, armctl.move_j(arm, [0.0], [0.5]), plant, dwell=2.0)
    rest = log.q[log.t > log.motion_duration + 0.1, 0] - log.q_ref[-1, 0]
    crossings = np.flatnonzero((rest[1:] > 0) != (rest[:-1] > 0))
    assert len(crossings) > 4
    assert np.pi / (np.diff(crossings).mean() * log.dt) == pytest.approx(frequency, rel=0.01)
    assert 0.0 < damping_ratio < 0.2
