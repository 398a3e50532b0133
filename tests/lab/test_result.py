"""What follows from the table of a study is right where the right answer is known."""

import dataclasses
import math
import re

import numpy as np
import pytest

import armctl
from armctl.lab.study import statistics
from armctl.lab.study.study_runner import FIGURES


def with_columns(result: armctl.StudyResult, **columns) -> armctl.StudyResult:
    return dataclasses.replace(result, _columns={**result.table(), **columns})


def test_the_median_and_its_interval_are_those_of_a_plain_bootstrap():
    values = np.random.default_rng(3).exponential(size=41)
    found = statistics.median(values)
    draws = np.median(np.random.default_rng(0).choice(values, (20_000, 41)), axis=1)
    ordered = np.sort(values)
    low, high = np.searchsorted(ordered, np.quantile(draws, [0.025, 0.975]))
    assert found.value == np.median(values)
    assert abs(np.searchsorted(ordered, found.low) - low) <= 1
    assert abs(np.searchsorted(ordered, found.high) - high) <= 1


def test_the_interval_contains_the_median_as_often_as_it_says():
    rng = np.random.default_rng(1)
    found = [statistics.median(rng.normal(size=40)) for _ in range(1000)]
    assert np.mean([each.low <= 0.0 <= each.high for each in found]) == pytest.approx(0.95, abs=0.025)


def test_runs_that_failed_count_as_the_worst():
    values = np.array([1.0, 2.0, 3.0, np.nan, np.nan])
    assert statistics.median(values).value == 3.0
    assert statistics.median(values).high == math.inf
    assert statistics.median(np.array([1.0, np.nan, np.nan])).value == math.inf
    differences = statistics.paired_differences(np.array([1.0, np.nan, 1.0, np.nan]), np.array([3.0, 3.0, np.nan, np.nan]))
    assert differences.tolist() == [-2.0, math.inf, -math.inf, 0.0]


def test_wilsons_interval_is_that_of_the_textbook():
    found = statistics.success(np.array([True] * 8 + [False] * 2))
    assert (found.value, round(found.low, 4), round(found.high, 4)) == (0.8, 0.4902, 0.9433)


def test_the_summary_pairs_runs_of_equal_points(finished):
    table = finished.table()
    payload = table["payload"]
    first = table["controller"] == "pd-gravity"
    error = np.where(first, payload, payload + 0.001)  # paired, the difference is one number; unpaired it is lost in the spread
    summary = with_columns(finished, tip_rms_m=error).summary(["tip_rms_m"])
    pd_gravity, computed_torque = summary.controllers
    difference = computed_torque.differences["tip_rms_m"]
    assert pd_gravity.differences == {}
    assert [difference.low, difference.value, difference.high] == pytest.approx([0.001] * 3)
    assert pd_gravity.medians["tip_rms_m"].value == pytest.approx(np.median(payload[first]))
    assert (pd_gravity.runs, pd_gravity.completed) == (16, 16)
    assert "computed-torque" in str(summary)
    assert summary.to_dict()["ok"] is True


@pytest.fixture(scope="module")
def saltelli(study, tmp_path_factory):
    factors = {"payload": armctl.Range(0, 1), "friction": armctl.Range(0, 0.02), "mass_scale": armctl.Range(0.9, 1.1)}
    made = study(name="saltelli", controllers=["computed-torque"], factors=factors, sampling="saltelli", samples=4)
    assert len(made.runs) == 5 * 4
    return made.run(folder=tmp_path_factory.mktemp("saltelli"))


def test_the_sobol_indices_of_a_known_function_are_right(saltelli):
    # The design of many samples, without making its runs: a linear function, whose indices are known.
    study = armctl.Study.from_dict({**saltelli.study.to_dict(), "samples": 2048})
    weights = {"payload": 3.0, "friction": 100.0, "mass_scale": 0.0}
    values = np.array([sum(weights[name] * run.point[name] for name in weights) for run in study.runs])
    columns = {"controller": np.array(["computed-torque"] * len(values), dtype=object), "tip_rms_m": values}
    found = dataclasses.replace(saltelli, study=study, _columns={**saltelli.table(), "run": values, **columns}).sensitivity()
    shares = {each.factor: each for each in found.factors}
    variances = {"payload": 9 / 12, "friction": 4 / 12, "mass_scale": 0.0}
    for name, variance in variances.items():
        share = variance / sum(variances.values())
        assert shares[name].first_order.value == pytest.approx(share, abs=0.02)
        assert shares[name].total.value == pytest.approx(share, abs=0.02)
        assert shares[name].total.low <= share + 1e-9 <= shares[name].total.high + 2e-9
    assert found.ok
    assert [each.factor for each in found.factors] == ["payload", "friction", "mass_scale"]


def test_the_intervals_of_the_sobol_indices_are_those_of_a_plain_bootstrap(saltelli):
    study = armctl.Study.from_dict({**saltelli.study.to_dict(), "samples": 256})
    values = np.array([run.point["payload"] * (1.0 + 40.0 * run.point["friction"]) for run in study.runs])
    columns = {"controller": np.array(["computed-torque"] * len(values), dtype=object), "tip_rms_m": values}
    found = dataclasses.replace(saltelli, study=study, _columns={**saltelli.table(), "run": values, **columns}).sensitivity()
    shares = {each.factor: each.total for each in found.factors}
    rng = np.random.default_rng(5)
    first, second, *mixtures = np.split(values, 5)  # A, B, and A with one column of B for each factor
    mixed = dict(zip(study.factors, mixtures, strict=True))
    drawn = {name: [] for name in mixed}
    for _ in range(2000):
        rows = rng.integers(256, size=256)
        variance = np.concatenate([first[rows], second[rows]]).var()
        for name, mixture in mixed.items():
            drawn[name].append(0.5 * np.mean((first[rows] - mixture[rows]) ** 2) / variance)  # Jansen (1999)
    for name in ("payload", "friction"):
        low, high = np.quantile(drawn[name], [0.025, 0.975])
        assert shares[name].high - shares[name].low == pytest.approx(high - low, rel=0.15)
        assert shares[name].low == pytest.approx(low, abs=0.15 * (high - low))


def test_the_sensitivity_of_a_run_study_says_when_it_is_uncertain(saltelli):
    found = saltelli.sensitivity()
    assert {each.factor for each in found.factors} == {"payload", "friction", "mass_scale"}
    assert not found
    assert "take more samples than 4" in str(found)
    assert str(found) == str(saltelli.sensitivity())


def test_the_worst_runs_are_simulated_again_with_the_same_bits(finished, tmp_path):
    table = finished.table()
    worst = finished.worst(3, "tip_max_m", folder=tmp_path)
    assert [each.row["tip_max_m"] for each in worst] == sorted(table["tip_max_m"])[:-4:-1]
    for each in worst:
        assert armctl.Report.from_log(each.log).tip_max_m == each.row["tip_max_m"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["worst-1.npz", "worst-2.npz", "worst-3.npz"]
    only = finished.worst(1, controller="computed-torque")[0]
    assert only.row["controller"] == "computed-torque"
    failed = with_columns(finished, tip_max_m=np.where(table["run"] == 4, np.nan, table["tip_max_m"]))
    assert failed.worst(1, "tip_max_m")[0].row["run"] == 4


def test_a_result_is_the_same_after_saving_and_loading(finished, tmp_path):
    loaded = armctl.StudyResult.load(finished.save(tmp_path / "trial.parquet"))
    assert loaded.ok
    assert loaded.study.to_dict() == finished.study.to_dict()
    for name, column in finished.table().items():
        if name in FIGURES:
            assert np.array_equal(loaded.table()[name], column, equal_nan=True), name
        else:
            assert loaded.table()[name].tolist() == column.tolist(), name
    assert loaded.summary() == finished.summary()


def test_the_table_is_a_data_frame_and_a_csv(finished, tmp_path):
    import pandas

    frame = finished.to_pandas()
    assert frame.groupby("controller")["tip_rms_m"].median().to_dict() == {
        each.controller: each.medians["tip_rms_m"].value for each in finished.summary().controllers
    }
    again = pandas.read_csv(finished.save(tmp_path / "trial.csv"))
    assert again["tip_rms_m"].to_numpy() == pytest.approx(frame["tip_rms_m"].to_numpy(), rel=1e-12)


@pytest.mark.parametrize("missing", ["some", "all"])
def test_the_plots_are_drawn_also_where_runs_failed(finished, tmp_path, missing: str):
    table = finished.table()
    lost = {"some": table["payload"] > 0.5, "all": table["run"] >= 0}[missing]
    result = with_columns(finished, tip_rms_m=np.where(lost, np.nan, table["tip_rms_m"]))
    result.plot_quantiles(tmp_path / "quantiles.svg")
    result.plot_tornado(tmp_path / "tornado.svg")
    result.plot_success(tmp_path / "success.svg", "payload", "delay", metric="tip_rms_m", limit=0.01)
    texts = {path.stem: path.read_text() for path in tmp_path.iterdir()}
    assert set(texts) == {"quantiles", "tornado", "success"}
    assert all(text.startswith("<?xml") for text in texts.values())


def test_success_over_two_factors_shows_the_shares(finished, tmp_path, monkeypatch):
    from matplotlib.axes import Axes

    written = []
    monkeypatch.setattr(Axes, "text", lambda self, x, y, text, **more: written.append((x, y, text)))
    table = finished.table()
    result = with_columns(finished, ok=(table["delay"] == 0) & (table["controller"] == "pd-gravity"))
    result.plot_success(tmp_path / "success.svg", "delay", "payload")
    shares = {(column, text) for column, _, text in written[: len(written) // 2]}
    assert shares == {(0, "100"), (1, "0")}
    assert {text for _, _, text in written[len(written) // 2 :]} == {"0"}


WRONG = {
    "a metric": (lambda r, d: r.summary(["speed"]), "metrics: expected .*got 'speed'"),
    "no saltelli": (lambda r, d: r.sensitivity(), "needs sampling='saltelli'"),
    "a controller": (lambda r, d: r.worst(controller="pid"), "unknown controller of the study"),
    "films nowhere": (lambda r, d: r.worst(film=True), "folder: expected .*got none"),
    "no limit": (lambda r, d: r.plot_success(d / "x.png", metric="tip_rms_m"), "give a figure and its limit"),
    "one factor": (lambda r, d: r.plot_success(d / "x.png", "delay", "delay"), "'delay' twice"),
    "no factor": (lambda r, d: r.plot_quantiles(d / "x.png", over="noise"), "over: expected .*got 'noise'"),
    "an ending": (lambda r, d: r.save(d / "x.xlsx"), r"expected \.parquet or \.csv"),
    "no file": (lambda r, d: armctl.StudyResult.load(d / "x.parquet"), "cannot be read"),
}


@pytest.mark.parametrize(("call", "reason"), WRONG.values(), ids=WRONG)
def test_a_wrong_call_is_one_sentence(finished, tmp_path, call, reason: str):
    with pytest.raises(armctl.ArmctlError, match=reason):
        call(finished, tmp_path)


def test_a_damaged_or_foreign_parquet_is_refused(finished, tmp_path):
    path = finished.save(tmp_path / "trial.parquet")
    good = path.read_bytes()
    rng = np.random.default_rng(5)
    for _ in range(20):
        path.write_bytes(good[: rng.integers(len(good))])
        with pytest.raises(armctl.InputError, match="no result of a study"):
            armctl.StudyResult.load(path)
    log = finished.worst(1)[0].log
    with pytest.raises(armctl.InputError, match="no result of a study"):
        armctl.StudyResult.load(log.save(tmp_path / "log.parquet"))


@pytest.mark.full
def test_the_command_makes_a_study_and_writes_what_it_found(toml, tmp_path, capsys):
    from armctl.cli.main import main

    (tmp_path / "trial.toml").write_text(toml)
    command = ["study", str(tmp_path / "trial.toml"), "--folder", str(tmp_path)]
    assert main([*command, "--threads", "0"]) == 2
    assert "--threads: expected at least 1, got 0" in capsys.readouterr().err
    assert main([*command, "--threads", "1", "--out", str(tmp_path / "out")]) == 0
    assert re.search(r"^computed-torque +16 ", capsys.readouterr().out, re.MULTILINE)
    plots = {f"trial-{plot}.{ending}" for plot in ("quantiles", "tornado", "success") for ending in ("png", "pdf")}
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"trial.parquet", *plots}
    assert main(["study", str(tmp_path / "trial.toml"), "--dask", "nowhere://here"]) == 2
    assert "--dask: nowhere://here: " in capsys.readouterr().err


def test_every_figure_of_the_table_is_one_of_a_report():
    assert set(FIGURES) <= set(armctl.Report.__dataclass_fields__)


def test_repetitions_of_a_point_count_by_their_mean(saltelli):
    """What repetitions differ by cancels: the indices are those of one run at each point."""
    found = []
    for repeats in (1, 2):
        study = armctl.Study.from_dict({**saltelli.study.to_dict(), "samples": 64, "repeats": repeats})
        side = np.resize([1.0, -1.0] if repeats == 2 else [0.0], len(study.runs))
        values = np.array([run.point["payload"] + 30.0 * run.point["friction"] for run in study.runs]) + 0.2 * side
        columns = {"controller": np.array(["computed-torque"] * len(values), dtype=object), "tip_rms_m": values}
        table = {**saltelli.table(), "run": values, **columns}
        found.append(dataclasses.replace(saltelli, study=study, _columns=table).sensitivity().factors)
    for one, other in zip(*found, strict=True):
        assert one.factor == other.factor
        assert other.total.value == pytest.approx(one.total.value, abs=1e-9)
        assert other.first_order.value == pytest.approx(one.first_order.value, abs=1e-9)
