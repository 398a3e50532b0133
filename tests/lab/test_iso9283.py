"""The standard's figures: from offsets that are known by hand, and from arms whose figures must be small, or must not be."""

import numpy as np
import pytest
from arms import arm_of

import armctl
from armctl.lab.iso9283 import compliance, iso9283_cycles
from armctl.lab.iso9283_figures import (
    accuracy,
    cornering,
    deviations_in_planes,
    distance,
    drift,
    orientation,
    path_speed,
    posing_time,
    stabilisation,
    turn_between,
)


class FakeLog:
    """A tip on a line over time."""

    def __init__(self, x, dt=0.001):
        self.tip = np.column_stack([x, 0 * x, 0 * x])
        self.dt = dt
        self.t = dt * np.arange(len(x))


def test_accuracy_and_repeatability_by_hand():
    offsets = np.array([[[1.0, 0, 0]], [[3.0, 0, 0]]])  # two cycles of one pose: mean 2, each 1 from it, no spread of that
    assert accuracy(offsets) == (2.0, 1.0)
    offsets = np.array([[[0.0, 0, 0]], [[0.0, 0, 0]], [[3.0, 0, 0]]])
    found = accuracy(offsets)
    assert found.accuracy == pytest.approx(1.0)
    assert found.repeatability == pytest.approx(4 / 3 + 3 * np.std([1.0, 1.0, 2.0], ddof=1))


def test_stabilisation_counts_from_the_first_entry_to_the_last():
    x = np.array([1.0, 0.5, 0.05, -0.3, -0.2, 0.05, 0.0, 0.0])
    time, overshoot = stabilisation(FakeLog(x), 0.1)
    assert time == pytest.approx(0.003)
    assert overshoot == pytest.approx(0.3)
    assert stabilisation(FakeLog(np.array([1.0, 0.5, 0.05, 0.0])), 0.1) == (0.0, 0.0)


def test_orientation_by_hand():
    angles = np.array([[[0.01, 0.0, 0.0]], [[0.03, 0.0, -0.02]]])
    worst, repeatability = orientation(angles)
    assert worst == pytest.approx((0.02, 0.0, 0.01))
    assert repeatability == pytest.approx((3 * np.std([0.01, 0.03], ddof=1), 0.0, 3 * np.std([0.0, 0.02], ddof=1)))


def test_a_rotation_vector_points_from_the_reference_to_the_attained_orientation():
    pose = armctl.Pose([0, 0, 0], rpy=[0.3, -0.2, 0.1])
    turned = armctl.Pose([0, 0, 0], rpy=[0.0, 0.0, 0.02]) @ pose
    assert turn_between(pose.quat, turned.quat) == pytest.approx([0.0, 0.0, 0.02])
    assert turn_between(pose.quat, -turned.quat) == pytest.approx([0.0, 0.0, 0.02])


def test_distance_and_drift_by_hand():
    first = np.zeros((3, 3))
    second = np.array([[1.0, 0, 0], [1.0, 0, 0], [1.3, 0, 0]])
    found = distance(first, second, 1.0)
    assert found.accuracy == pytest.approx(0.1)
    assert found.repeatability == pytest.approx(3 * np.std([1.0, 1.0, 1.3], ddof=1))
    assert drift(np.array([[[0.1, 0, 0]], [[9.0, 0, 0]], [[0.3, 0, 0]]])) == pytest.approx(0.2)


def test_a_late_tip_on_the_line_has_no_path_deviation():
    x = np.linspace(0.0, 1.0, 101) ** 2
    log = FakeLog(x)
    log.tip[:, 1] = 0.01 * x
    planes = deviations_in_planes(log, np.zeros(3), np.array([1.0, 0, 0]), 1.0)
    assert planes[:, 1] == pytest.approx(0.01 * np.arange(0.05, 1.0, 0.1))
    assert not planes[:, [0, 2]].any()


def test_a_deviation_at_the_start_is_between_the_ten_planes_and_in_the_dense_ones():
    log = FakeLog(np.linspace(0.0, 1.0, 1001))
    log.tip[:, 1] = np.where(log.tip[:, 0] < 0.02, 0.01, 0.0)
    ends = np.zeros(3), np.array([1.0, 0, 0])
    assert not deviations_in_planes(log, *ends, 1.0).any()
    assert deviations_in_planes(log, *ends, 1.0, 1000)[:, 1].max() == pytest.approx(0.01)


def test_path_velocity_by_hand():
    logs = [FakeLog(0.001 * speed * np.arange(int(1000 / speed) + 1)) for speed in (0.9, 1.1)]
    found = path_speed(logs, np.zeros(3), np.array([1.0, 0, 0]), 9.0, 1.0)
    assert found.accuracy == pytest.approx(0.0, abs=1e-9)
    assert found.repeatability == pytest.approx(3 * np.std([0.9, 1.1], ddof=1))
    assert found.fluctuation == pytest.approx(0.0, abs=1e-9)


def test_cornering_by_hand():
    log = FakeLog(np.array([1.0, 0.3, 0.05, 0.0, -0.01, 0.0]))
    log.tip[:, 1] = [0.0, 0.0, 0.05, 0.3, 0.5, 1.0]
    found = cornering([log], np.zeros(3), np.array([0.0, 1.0, 0.0]), 0.2)
    assert found.round_off == pytest.approx(np.hypot(0.05, 0.05))
    assert found.overshoot == pytest.approx(0.01)


def test_posing_ends_when_the_tip_stays_in_the_band():
    assert posing_time(FakeLog(np.array([1.0, 0.05, 0.2, 0.05, 0.0])), 0.1) == pytest.approx(0.003)


def test_static_compliance_is_that_of_a_known_spring(bundled):
    controller = armctl.Impedance(bundled, stiffness=[1000.0, 2000.0, 4000.0, 0.0, 0.0, 0.0])
    found = compliance(bundled, controller, armctl.Plant(timestep=0.002))["compliance_m_per_N"]
    assert found == pytest.approx((1e-3, 5e-4, 2.5e-4), rel=1e-2)


@pytest.mark.parametrize("robot", ["robot_arm_3dof", "ur5e"])
def test_an_exact_arm_is_exact(robot):
    arm = arm_of(robot)
    figures = iso9283_cycles(arm, "computed-torque", cycles=2, path_cycles=2)
    assert figures.ok
    assert figures.pose_accuracy_m < 1e-8
    assert figures.pose_repeatability_m < 1e-9
    assert figures.stabilisation_time_s == 0.0
    assert figures.path_accuracy_m < 1e-5  # the line itself is planned to this
    assert max(figures.orientation_accuracy_rad) < 1e-8
    assert abs(figures.distance_accuracy_m) < 1e-8
    assert figures.drift_m < 1e-9
    assert abs(figures.speed_accuracy) < 1e-3
    assert figures.corner_overshoot_m < 1e-4
    assert 0.0 < figures.corner_round_off_m < 0.1 * figures.cube_m
    assert all(time > 0.0 for _, time in figures.posing_times)


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
    # The observer bears a static force, which displaces the arm without one.
    assert max(observed.compliance_m_per_N) < 0.1 * max(without.compliance_m_per_N)
    assert observed.to_dict()["cube_m"] == observed.cube_m


def test_a_run_that_fails_says_why(bundled):
    class Gives:
        def torque(self, state, setpoint):
            return np.full(3, np.nan)

    figures = iso9283_cycles(bundled, Gives(), cycles=2, path_cycles=2)
    assert not figures.ok
    assert "no finite torque" in figures.reason
    assert figures.to_dict()["pose_accuracy_m"] is None


@pytest.mark.parametrize("arguments", [{"cycles": 1}, {"speed": 0.0}, {"path_cycles": 1}])
def test_wrong_conditions_are_refused(bundled, arguments):
    with pytest.raises(armctl.InputError, match=next(iter(arguments))):
        iso9283_cycles(bundled, **arguments)
