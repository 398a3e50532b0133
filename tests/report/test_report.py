"""Logs keep what happened, and reports say it right: figures of runs whose answer is known by hand."""

import json
import math
import re

import numpy as np
import pytest

import armctl
from armctl import Contact, InputError, Log, Report
from armctl.report.report import report_table, table


def made_log(**changes) -> Log:
    """A run of one second: the tip goes 0.1 m along x and stays 2 mm beyond, the joint lags by 0.01 rad."""
    t = np.arange(1001) * 1e-3
    ramp = np.clip(t / 0.5, 0, 1)
    q_ref = ramp[:, None]
    tip_ref = np.outer(ramp, [0.1, 0, 0])
    tip = tip_ref + np.where(t > 0.5, 0.002, 0.0)[:, None] * [1, 0, 0]
    upright = np.tile([1.0, 0, 0, 0], (1001, 1))
    tau = np.where(t < 0.25, 4.0, -1.0)[:, None]
    values = {
        "robot": "made",
        "controller": "by hand",
        "joint_names": ("j",),
        "dt": 1e-3,
        "tau_max": np.array([4.0]),
        "motion_duration": 0.5,
        "target": np.full(7, np.nan),
        "real_time_factor": 10.0,
        "failure": "",
        "t": t,
        "q": q_ref - 0.01,
        "v": np.gradient(q_ref[:, 0], t)[:, None],
        "q_ref": q_ref,
        "v_ref": np.gradient(q_ref[:, 0], t)[:, None],
        "a_ref": np.zeros((1001, 1)),
        "tau": tau,
        "tau_cmd": 1.5 * tau,
        "tip": tip,
        "tip_quat": upright,
        "tip_ref": tip_ref,
        "tip_ref_quat": upright,
    }
    return Log(**(values | changes))


def test_the_figures_are_what_they_say():
    report = Report.from_log(made_log())
    assert report.joint_rms_rad == pytest.approx(0.01)
    assert report.joint_max_rad == pytest.approx(0.01)
    assert report.tip_rms_m == pytest.approx(0.0)
    assert report.final_tip_error_m == pytest.approx(0.002)
    assert report.overshoot_m == pytest.approx(0.002)
    assert report.peak_torque_ratio == pytest.approx(1.0)
    assert report.saturated_fraction == pytest.approx(250 / 1001)
    assert report.duration_s == pytest.approx(1.001)
    assert report.final_orientation_error_rad == 0
    assert math.isnan(report.settling_time_s)
    assert not report.ok
    assert "2 mm from its goal" in report.verdict


def test_the_report_of_one_tip_says_nothing_of_others():
    report = Report.from_log(made_log())
    assert report.tip_errors == {}
    assert "tip_errors" not in report.to_dict()
    assert "  tip error    final 2 mm, <1e-06 deg; while moving RMS <1 nm, max <1 nm" in str(report).splitlines()


def test_the_goal_is_the_target_where_there_is_one():
    target = np.array([0.102, 0, 0, np.nan, np.nan, np.nan, np.nan])
    report = Report.from_log(made_log(target=target))
    assert report.ok
    assert report.final_tip_error_m == pytest.approx(0.0, abs=1e-15)
    assert report.settling_time_s == pytest.approx(0.0, abs=2e-3)
    turned = np.array([0.102, 0, 0, math.cos(0.25), 0, 0, math.sin(0.25)])
    report = Report.from_log(made_log(target=turned))
    assert report.final_orientation_error_rad == pytest.approx(0.5)
    assert not report.ok
    assert "0.5 rad from its orientation" in report.verdict


def test_the_orientation_is_shown_only_if_the_target_has_one():
    assert "final 2 mm, <1e-06 deg; while" in str(Report.from_log(made_log()))
    assert "at the goal  never settled, overshoot 2 mm" in str(Report.from_log(made_log()))
    point = str(Report.from_log(made_log(target=np.array([0.102, 0, 0, *[np.nan] * 4]))))
    assert "final <1 nm; while" in point
    assert "at the goal  settled after 0.00" in point


def test_settling_is_counted_from_the_end_of_the_motion():
    log = made_log()
    tip = np.array(log.tip_ref)
    late = (log.t > 0.5) & (log.t < 0.7)
    tip[late, 1] = 0.01
    report = Report.from_log(made_log(tip=tip))
    assert report.settling_time_s == pytest.approx(0.2, abs=2e-3)
    assert report.ok


def test_overshoot_is_that_beyond_the_reference():
    """A reference whose tip passes its goal is no fault of the run that follows it."""
    log = made_log()
    tip_ref = log.tip_ref + np.where(log.t > 0.9, 0.0, 0.005 * (log.t > 0.5))[:, None] * [1, 0, 0]
    assert Report.from_log(made_log(tip_ref=tip_ref, tip=tip_ref)).overshoot_m == 0.0
    assert Report.from_log(made_log(tip_ref=tip_ref, tip=tip_ref + np.array([0.001, 0, 0]))).overshoot_m == pytest.approx(0.001)


def test_an_exact_run_has_no_chatter_and_no_overshoot(bundled):
    motion = armctl.move_j(bundled, bundled.home, bundled.home + 0.4)
    report = Report.from_log(armctl.simulate(bundled, "computed-torque", motion))
    assert report.chatter_nm < 1e-3
    assert report.overshoot_m < 1e-9
    assert math.isnan(Report.from_log(armctl.simulate(bundled, "computed-torque", motion, dwell=0.0)).chatter_nm)


def test_the_verdict_names_a_loop_that_is_unstable_at_its_period(bundled):
    motion = armctl.move_j(bundled, bundled.home, bundled.home + 0.2)
    for bandwidth in (20.0, 200.0, 1000.0):
        law = armctl.ComputedTorque(bundled, bandwidth=bandwidth)
        stable = armctl.margins(bundled, law, [motion(motion.duration).q]).ok
        report = Report.from_log(armctl.simulate(bundled, law, motion))
        assert report.ok == stable
        assert ("unstable at its period of 2 ms" in report.verdict) == (not stable)
    assert "lower the gains of computed-torque" in report.reason


def test_chatter_is_what_alternates():
    tau = np.zeros((1001, 1))
    tau[::2] = 1.0
    assert Report.from_log(made_log(tau=tau)).chatter_nm == pytest.approx(1.0)
    assert Report.from_log(made_log(tau=np.linspace(0, 4, 1001)[:, None])).chatter_nm == pytest.approx(0.0, abs=1e-12)


def test_a_run_that_ended_early_fails_first():
    report = Report.from_log(made_log(failure="diverged at 0.5 s: j moves at 1e+05 rad/s"))
    assert not report.ok
    assert str(report).startswith("failed: diverged at 0.5 s")


def test_figures_are_fit_for_json():
    figures = json.loads(json.dumps(Report.from_log(made_log()).to_dict()))
    figures_of_a_report = (
        "ok joint_rms_rad joint_max_rad tip_rms_m tip_max_m final_tip_error_m final_orientation_error_rad settling_time_s "
        "overshoot_m peak_torque_ratio saturated_fraction chatter_nm duration_s real_time_factor robot controller"
    )
    assert set(figures_of_a_report.split()) <= set(figures)
    assert figures["settling_time_s"] is None


def test_a_table_has_a_row_for_every_report():
    lines = table([Report.from_log(made_log()), Report.from_log(made_log(controller="another"))]).splitlines()
    assert len(lines) == 4
    assert len({len(line) for line in lines}) == 1
    assert "another" in lines[3]


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_plots_are_drawn(tmp_path, suffix: str):
    path = Report.from_log(made_log()).plot(tmp_path / "new" / f"run{suffix}")
    assert path.stat().st_size > 5000


def test_a_log_comes_back_from_its_file(tmp_path):
    log = made_log(failure="diverged", target=np.array([1, 2, 3, 0, 1, 0, 0.0]), contacts=(Contact("hand", "table", 0.5, 0.2),))
    back = Log.load(log.save(tmp_path / "new" / "run.npz"))
    for name, value in vars(log).items():
        if isinstance(value, np.ndarray):
            assert np.array_equal(getattr(back, name), value, equal_nan=True)
            assert not getattr(back, name).flags.writeable
        else:
            assert getattr(back, name) == value


def test_a_log_as_csv_has_named_columns(tmp_path):
    rows = made_log().save(tmp_path / "run.csv").read_text().splitlines()
    assert rows[1].startswith("t,q/j,v/j,q_ref/j")
    assert len(rows) == 1003
    assert [float(x) for x in rows[2].split(",")][:2] == [0.0, -0.01]


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda d: made_log().save(d / "run.txt"), r"path: 'run.txt' ends in '.txt', expected .npz, .parquet, .csv or .mcap"),
        (lambda d: Log.load(d / "none.npz"), r"none\.npz: cannot be read: No such file or directory"),
        (lambda d: Report.from_log(made_log()).plot(d / "run.jpeg"), "expected .png, .svg or .pdf"),
        (lambda d: Report.from_log(made_log(q_ref=np.full((1001, 1), np.nan))), "nothing to report"),
    ],
)
def test_a_wrong_call_is_one_sentence(tmp_path, call, sentence: str):
    with pytest.raises(InputError, match=sentence):
        call(tmp_path)


def test_a_file_that_is_no_log_is_rejected(tmp_path):
    path = tmp_path / "run.npz"
    path.write_bytes(b"not a log")
    with pytest.raises(armctl.InputError, match="no log that armctl wrote"):
        Log.load(path)


UNFIT = {
    "no time": ({"t": np.zeros(1001)}, "t: the times are not 0.001 s apart"),
    "a negative tick": ({"dt": -1.0}, "dt: expected .*got -1"),
    "a word as tick": ({"dt": "x"}, "dt: 'x' is not a number"),
    "an endless motion": ({"motion_duration": math.inf}, "motion_duration: expected .*got inf"),
    "a short column": (
        {"tau": np.zeros((1000, 1))},
        r"tau: expected float64 of shape \(1001, 1\), got float64 of shape \(1000, 1\)",
    ),
    "whole numbers": ({"q": np.zeros((1001, 1), int)}, "q: expected float64 .* got int64 of shape"),
    "a quaternion of three": ({"tip_quat": np.ones((1001, 3))}, "tip_quat: expected float64 of shape"),
    "no rotation": ({"tip_quat": np.ones((1001, 4))}, "tip_quat: a quaternion does not have length 1"),
    "a hole in the state": ({"q": np.full((1001, 1), np.nan)}, "q: a number is not finite"),
    "an infinite reference": ({"q_ref": np.full((1001, 1), np.inf)}, "q_ref: a number is infinite"),
    "a huge position": ({"tip": np.full((1001, 3), 1e300)}, r"tip: a number is above 1e\+20"),
    "no torque": ({"tau_max": np.zeros(1)}, "tau_max: a torque limit is not greater than 0"),
    "joints without units": ({"units": ("rad", "rad")}, "units: expected 'rad' or 'm' for each of 1 joints, got .*'rad'"),
    "an unknown unit": ({"units": ("deg",)}, "units: expected 'rad' or 'm' for each of 1 joints, got .*'deg'"),
    "a number as name": ({"robot": 5}, "robot: expected str"),
    "a contact of one": ({"contacts": (("hand",),)}, "contacts: .* is not a contact"),
}


@pytest.mark.parametrize(("changes", "sentence"), UNFIT.values(), ids=UNFIT)
def test_a_loaded_log_must_mean_something(tmp_path, changes: dict, sentence: str):
    log = made_log()
    for name, value in changes.items():
        object.__setattr__(log, name, value)  # a log itself refuses some of these
    path = log.save(tmp_path / "run.npz")
    with pytest.raises(InputError, match=rf"run\.npz: no log that armctl wrote: {sentence}"):
        Log.load(path)


@pytest.mark.parametrize("path", [None, 5, b"run.npz", "", "a\0b"])
def test_what_is_no_name_of_a_file_is_rejected(path):
    with pytest.raises(InputError, match=r"^path: .* is not the name of a file$"):
        Log.load(path)
    with pytest.raises(InputError, match=r"^path: .* is not the name of a file$"):
        made_log().save(path)


@pytest.mark.parametrize("tolerance", [math.nan, math.inf, -1e-3, "1", True])
def test_a_tolerance_is_a_number_of_at_least_zero(tolerance):
    with pytest.raises(InputError, match=r"^tolerance: "):
        Report.from_log(made_log(), tolerance=tolerance)
    with pytest.raises(InputError, match=r"^angle_tolerance: "):
        Report.from_log(made_log(), angle_tolerance=tolerance)


def test_errors_of_hinges_and_slides_are_separate_quantities():
    both = {"joint_names": ("j", "s"), "units": ("rad", "m"), "tau_max": np.array([4.0, 8.0])}
    q_ref = np.zeros((1001, 2))
    columns = {name: np.zeros((1001, 2)) for name in ("v", "v_ref", "a_ref", "tau", "tau_cmd")}
    report = Report.from_log(made_log(**both, **columns, q_ref=q_ref, q=q_ref + np.array([0.1, 0.002])))
    assert report.joint_rms_rad == pytest.approx(0.1)
    assert report.joint_max_m == pytest.approx(0.002)
    assert "RMS 1.0e-01 rad and 2.0e-03 m, max" in str(report)
    hinges = Report.from_log(made_log())
    assert math.isnan(hinges.joint_rms_m)
    assert hinges.to_dict()["joint_max_m"] is None
    assert "joint RMS, rad" in table([hinges])
    lines = table([hinges, report]).splitlines()
    assert "joint RMS |" in " ".join(lines[0].split())
    assert "1.0e-02 rad" in lines[2]
    assert "1.0e-01 rad and 2.0e-03 m" in lines[3]


def test_what_was_touched_is_reported():
    contacts = tuple(Contact("hand", f"box {k}", 0.25 * k, 0.1) for k in range(5))
    report = Report.from_log(made_log(contacts=contacts))
    assert "contact      hand touched box 0 for 0.1 s from 0 s on; hand touched box 1" in str(report)
    assert str(report).endswith("; 2 more")
    assert json.loads(json.dumps(report.to_dict()))["contacts"][4] == {
        "body": "hand",
        "other": "box 4",
        "start": 1.0,
        "duration": 0.1,
        "on_tool": True,
    }
    without = Report.from_log(made_log())
    assert "contact " not in str(without)
    assert [row[-1].endswith(", with contact") for row in report_table([report, without]).rows] == [True, False]


def test_a_report_says_why_it_is_not_ok():
    report = Report.from_log(made_log())
    assert not report
    assert report.reason == "the tip ended 2 mm from its goal (1 mm allowed)"
    good = Report.from_log(made_log(), tolerance=0.01)
    assert good
    assert good.reason == ""


def test_a_pipe_in_a_name_breaks_no_table():
    odd = Report.from_log(made_log(controller="a|b <i>\nc", plant="x|y"))
    for line in table([odd, Report.from_log(made_log())]).splitlines():
        assert len(re.findall(r"(?<!\\)\|", line)) == 12
    page = report_table([odd]).html()
    assert page.count("<td") == page.count("<th>") == 11
    assert "a|b &lt;i&gt; c" in page


def test_after_follow_the_goal_is_the_target_that_was_given(bundled):
    sim = armctl.Simulation(bundled)
    target = bundled.fk(bundled.home + 0.3).position
    sim.follow(lambda t: target, duration=0.2)  # too short to arrive
    assert sim.log is not None
    report = Report.from_log(sim.log)
    missing = float(np.linalg.norm(sim.log.tip[-1] - target))
    assert missing > 1e-3
    assert report.final_tip_error_m == pytest.approx(missing)
    assert not report
