"""The standard's figures: from offsets that are known by hand, and from arms whose figures must be small, or must not be."""

import numpy as np
import pytest
from arms import arm_of

import armctl
from armctl.analysis.iso9283 import _accuracy, _stabilisation, iso9283_cycles


class FakeLog:
    """A tip on a line over time."""

    def __init__(self, x, dt=0.001):
        self.tip, self.dt = np.column_stack([x, 0 * x, 0 * x]), dt


def test_accuracy_and_repeatability_by_hand():
    offsets = np.array([[[1.0, 0, 0]], [[3.0, 0, 0]]])  # two cycles of one pose: mean 2, each 1 from it, no spread of that
    assert _accuracy(offsets) == (2.0, 1.0)
    offsets = np.array([[[0.0, 0, 0]], [[0.0, 0, 0]], [[3.0, 0, 0]]])
    accuracy, repeatability = _accuracy(offsets)
    assert accuracy == pytest.approx(1.0)
    assert repeatability == pytest.approx(4 / 3 + 3 * np.std([1.0, 1.0, 2.0], ddof=1))


def test_stabilisation_counts_from_the_first_entry_to_the_last():
    x = np.array([1.0, 0.5, 0.05, -0.3, -0.2, 0.05, 0.0, 0.0])
    time, overshoot = _stabilisation(FakeLog(x), 0.1)
    assert time == pytest.approx(0.003)
    assert overshoot == pytest.approx(0.3)
    assert _stabilisation(FakeLog(np.array([1.0, 0.5, 0.05, 0.0])), 0.1) == (0.0, 0.0)


@pytest.mark.parametrize("robot", ["robot_arm_3dof", "ur5e"])
def test_an_exact_arm_is_exact(robot):
    arm = arm_of(robot)
    figures = iso9283_cycles(arm, "computed-torque", cycles=2, path_cycles=2, dwell=0.1)
    assert figures.ok
    assert figures.pose_accuracy_m < 1e-8
    assert figures.pose_repeatability_m < 1e-9
    assert figures.stabilisation_time_s == 0.0
    assert figures.path_accuracy_m < 1e-5  # the line itself is planned to this


def test_an_unknown_payload_is_seen_and_an_observer_bears_it():
    arm, plant = arm_of("ur5e"), armctl.Plant(payload=1.0, encoder_noise=1e-5)
    without, observed = (
        iso9283_cycles(arm, name, plant, cycles=3, path_cycles=2) for name in ("computed-torque", "computed-torque-observer")
    )
    assert without.pose_accuracy_m > 1e-3
    assert observed.pose_accuracy_m < 2e-5
    assert observed.path_accuracy_m < 0.1 * without.path_accuracy_m
    assert observed.pose_repeatability_m > 0.0
    assert "payload 1 kg" in str(observed)
    assert observed.to_dict()["cube_m"] == observed.cube_m


def test_a_run_that_fails_says_why(bundled):
    class Gives:
        def torque(self, state, setpoint):
            return np.full(3, np.nan)

    figures = iso9283_cycles(bundled, Gives(), cycles=2, path_cycles=2)
    assert not figures.ok
    assert "no finite torque" in figures.reason
    assert figures.to_dict()["pose_accuracy_m"] is None


@pytest.mark.parametrize("arguments", [{"cycles": 1}, {"speed": 0.0}, {"dwell": -1.0}, {"band": -1.0}])
def test_wrong_conditions_are_refused(bundled, arguments):
    with pytest.raises(armctl.InputError, match=next(iter(arguments))):
        iso9283_cycles(bundled, **arguments)
