"""Springs of elastic joints from recordings of both sides, of the motors where the motion shows them, and of rigid arms."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic import FAST, limb, motors

import armctl

STIFFNESS = np.array([900.0, 400.0])
SPRINGS = {"elasticity": STIFFNESS, "rotor_inertia": 0.2}


@pytest.fixture
def recorded(load):
    """An arm, a log of its links on springs, and the positions of its motors."""
    arm = load(limb("a b", joint='armature="0.1" damping="0.5"'), FAST + motors("a b"))
    motion = armctl.excitation(arm, duration=4.0, for_="arm")
    positions = []

    class Watching(armctl.ElasticFeedforward):
        def torque(self, state, setpoint):
            positions.append(state.q.copy())
            return super().torque(state, setpoint)

    log = armctl.simulate(arm, Watching(arm, **SPRINGS), motion, armctl.Plant(**SPRINGS))
    return arm, log, np.array(positions), motion


def test_both_sides_show_the_springs_with_noise_of_encoders(recorded):
    arm, log, positions, _ = recorded
    rng = np.random.default_rng(0)
    noisy = replace(log, q=log.q + 1e-5 * rng.normal(size=log.q.shape))
    found = armctl.identify_elasticity(arm, noisy, positions + 1e-5 * rng.normal(size=log.q.shape))
    assert found, found.reason
    assert found.elasticity == pytest.approx(STIFFNESS, rel=0.02)


@pytest.mark.nightly
def test_motors_alone_show_springs_within_the_stated_errors_or_it_is_said(recorded):
    arm, log, positions, motion = recorded
    found = armctl.identify_elasticity(arm, replace(log, q=positions))
    assert np.isfinite(found.elasticity).any()
    seen = np.isfinite(found.elasticity)
    assert (np.abs(found.compliance - 1 / STIFFNESS)[seen] < 3 * found.compliance_error[seen] + 0.02 / STIFFNESS[seen]).all()
    rigid = armctl.identify_elasticity(arm, armctl.simulate(arm, "pd-gravity", motion))
    assert not rigid
    assert rigid.reason.startswith("the motion does not show the elasticity of a, b")
    assert np.isinf(rigid.elasticity).all()


def test_positions_of_another_shape_are_refused(recorded):
    arm, log, positions, _ = recorded
    with pytest.raises(armctl.InputError, match=r"motor_positions: expected finite numbers"):
        armctl.identify_elasticity(arm, log, positions[1:])
