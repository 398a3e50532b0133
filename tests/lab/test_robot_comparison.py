"""Laws compared on a robot: beside its simulation, from the same start, with the arm that its own runs identify."""

import numpy as np
import pytest
from arms import arm_of

import armctl
from armctl.lab.comparison_html import write_comparison

DT = 4e-3
LAWS = ["computed-torque", "mpc"]  # a link gives no reference of coming ticks, which the second one needs
FAST = {"speed": 0.5, "tip_speed": 1.0, "configurations": 0, "dwell": 0.1}


def link_to(lag: int = 0, delay: float | None = 0.0, **plant) -> armctl.links.PlantLink:
    arm = arm_of("robot_arm_3dof")
    interface = armctl.links.TorqueInterface(arm.limits.tau_max, delay=delay)
    return armctl.links.PlantLink(arm, armctl.Plant(timestep=DT, **plant), torque=interface, lag=lag)


class Drops:
    """PD with gravity until it forgets the weight, after which a joint leaves its path."""

    name = "drops"

    def __init__(self):
        self._inner = armctl.PDGravity(arm_of("robot_arm_3dof"))
        self._ticks = 0

    def torque(self, state, setpoint):
        self._ticks += bool(np.abs(setpoint.v).max() > 0.0)
        return self._inner.torque(state, setpoint) if self._ticks < 100 else np.zeros_like(state.q)


def short_motion() -> armctl.JointTrajectory:
    arm = arm_of("robot_arm_3dof")
    return armctl.move_j(arm, arm.home, arm.home + 0.2, speed=0.3)


def test_what_the_robot_tells_of_the_arm_makes_its_model_and_its_simulation_right():
    arm = arm_of("robot_arm_3dof")
    link = link_to(mass_scale=1.3, coulomb_friction=0.02 * arm.limits.tau_max, viscous_friction=0.05, encoder_noise=1e-5)
    reports = armctl.compare_on_robot(arm, link, LAWS, identified=True, **FAST)
    assert reports.estimate
    before, refused, simulated, after, _, simulated_after = reports
    assert (before.log.source, simulated.log.source) == ("robot", "simulation")
    assert simulated.joint_rms_rad == pytest.approx(before.joint_rms_rad, rel=0.25)
    assert after.joint_rms_rad < before.joint_rms_rad / 3
    assert simulated_after.joint_rms_rad < before.joint_rms_rad / 3
    assert [r.plant.partition(";")[0] for r in reports] == [
        *["robot: simulated robot_arm_3dof"] * 2,
        "simulation of the identified arm",
        *["robot: simulated robot_arm_3dof"] * 2,
        "simulation of the identified arm",
    ]
    assert (refused.ok, refused.outcome) == (False, "not run")
    assert "mpc needs the reference of coming ticks" in refused.reason


def test_a_law_that_the_link_cannot_bear_is_a_row_with_its_reason(tmp_path):
    arm = arm_of("robot_arm_3dof")
    link = link_to(lag=1, delay=DT)
    weak = armctl.PDGravity(arm, bandwidth=20.0)
    stiff = armctl.PDGravity(arm, bandwidth=60.0)
    reports = armctl.compare_on_robot(arm, link, [weak, stiff], short_motion(), **(FAST | {"configurations": 1}))
    assert [(r.controller, r.outcome) for r in reports] == [
        ("pd-gravity", "reached"),
        ("pd-gravity (2)", "not run"),
        ("pd-gravity", "reached"),
    ]
    assert "at the link's delay of 4 ms" in reports[1].reason
    assert reports.delay == pytest.approx(DT)
    assert reports[0].delay_margin_s == reports[2].delay_margin_s > 0.0
    assert reports[0].joint_rms_rad == pytest.approx(reports[2].joint_rms_rad, rel=0.25)
    assert reports[1].to_dict()["joint_rms_rad"] is None
    text = str(reports)
    assert text.startswith("pd-gravity (2) on robot: simulated robot_arm_3dof: controller: pd-gravity ")
    assert "not run" in text
    page = write_comparison(reports, tmp_path, "A motion")[2].read_text()
    assert page.count("<svg") == page.count("<h2>") == 2


@pytest.mark.full
def test_the_arm_comes_to_the_start_of_each_run():
    arm = arm_of("robot_arm_3dof")
    link = link_to()
    motion = short_motion()
    back = armctl.move_j(arm, motion(motion.duration).q, arm.home, speed=0.3)
    reports = armctl.compare_on_robot(arm, link, ["pd-gravity", "computed-torque"], back, **FAST)
    for report in reports:
        assert np.abs(report.log.q[0] - back(0.0).q).max() < 1e-3
        assert report, report.reason


def test_after_a_fault_no_law_is_run_unless_somebody_allows_it():
    arm = arm_of("robot_arm_3dof")
    laws = [Drops(), "pd-gravity"]
    reports = armctl.compare_on_robot(arm, link_to(), laws, short_motion(), identified=True, error_max=0.02, **FAST)
    assert [r.outcome for r in reports[:2]] == ["failed", "not run"]
    assert reports.estimate is None
    assert reports.remarks()[-1] == f"the arm was not identified: {reports[0].log.failure}"
    assert "the robot has a fault since an earlier run" in reports[1].reason
    faults: list[str] = []

    def allow(fault: str) -> bool:
        faults.append(fault)
        return True

    again = armctl.compare_on_robot(
        arm, link_to(), [Drops(), "pd-gravity"], short_motion(), error_max=0.02, recover=allow, **FAST
    )
    assert [r.outcome for r in again[:2]] == ["failed", "reached"]
    assert faults == [again[0].log.failure]


def test_a_link_that_takes_no_torques_runs_no_law():
    arm = arm_of("robot_arm_3dof")
    link = link_to()
    link.torque = None
    reports = armctl.compare_on_robot(arm, link, ["pd-gravity"], short_motion(), **FAST)
    assert [r.outcome for r in reports] == ["not run"]
    assert "takes no torques" in reports[0].reason
