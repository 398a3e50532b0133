"""The tutorial's arm and what is said of it: constant torque, four waypoints, and a PD law that rattles."""

import numpy as np
import pytest

import armctl

WAYPOINTS = [[0.0, -0.5, -1.0], [1.0, -0.3, -0.5], [-1.0, -0.3, -0.5], [0.0, 0.0, 0.0]]


class TutorialPD:
    """ctrl = clip(50 (q_ref - q) - 5 v, -5, 5), straight into the geared motors."""

    def __init__(self, arm: armctl.Arm):
        self.gear = arm.gear

    def torque(self, state: armctl.State, setpoint: armctl.Setpoint) -> np.ndarray:
        return self.gear * np.clip(50.0 * (setpoint.q - state.q) - 5.0 * state.v, -5.0, 5.0)


def visits(arm: armctl.Arm, controller: armctl.Controller, *, jump: bool) -> list[armctl.Report]:
    """The four waypoints one after the other, 3 s each; by a motion or, as in the tutorial, by a jump of the setpoint."""
    sim, start, reports = armctl.Simulation(arm, controller), arm.home, []
    for goal in WAYPOINTS:
        reports.append(armctl.Report.from_log(sim.run(armctl.move_j(arm, goal if jump else start, goal), dwell=3.0)))
        start = goal
    return reports


def test_the_published_law_rattles_between_its_limits_at_every_waypoint(bundled: armctl.Arm):
    for report, goal in zip(visits(bundled, TutorialPD(bundled), jump=True), WAYPOINTS, strict=True):
        last_second = report.log.tau[report.log.t > report.log.t[-1] - 1.0]
        assert report.chatter_nm > 100.0
        assert last_second.max() > 100.0
        assert last_second.min() < -100.0
        assert 0.02 < np.abs(report.log.q[-1] - goal).max() < 0.08


@pytest.mark.parametrize("controller", [armctl.PD, armctl.ComputedTorque])
def test_ours_settle_at_every_waypoint(bundled: armctl.Arm, controller: type):
    for report in visits(bundled, controller(bundled), jump=False):
        assert report.chatter_nm < 0.1
        assert np.abs(report.log.v[-1]).max() < 1e-3
        assert report.saturated_fraction == 0.0


def test_pd_sags_under_the_weight_and_computed_torque_does_not(bundled: armctl.Arm):
    law = armctl.PD(bundled)
    pd, computed = (visits(bundled, controller, jump=False) for controller in (law, armctl.ComputedTorque(bundled)))
    for report, goal in zip(pd, WAYPOINTS, strict=True):
        q = report.log.q[-1]
        free = np.less(goal, bundled.limits.q_max)  # at the last goal, the elbow's stop holds a part of its weight
        assert (law.stiffness * (goal - q))[free] == pytest.approx(bundled.gravity(q)[free], abs=1e-3)  # N m
        # Gravity torque / stiffness; the stiffness that margins permit is about 1000 N m/rad, where the former default was 100.
        assert 5e-4 < report.final_tip_error_m < 2e-3
    assert all(report.final_tip_error_m < 1e-9 for report in computed)


def test_constant_torque_flings_the_arm_against_its_limits(bundled: armctl.Arm):
    log = armctl.Simulation(bundled).apply_ctrl([0.5, -0.3, -0.2], duration=2.0)
    assert np.allclose(log.tau, [25.0, -15.0, -6.0])
    assert np.allclose(log.q[-1], [3.14, -1.57, -2.35], atol=0.01)
    assert np.abs(log.v[-1]).max() < 1e-3
