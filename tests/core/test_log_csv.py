"""A CSV of a real robot becomes a log, with uneven and repeated rows and any units; other files are refused in a sentence."""

from contextlib import suppress

import numpy as np
import pytest

import armctl
from armctl.core.filtering import choose_cutoff, derivatives, low_pass

SECONDS = 4.0


def signal(t):
    return np.column_stack([np.sin(2 * t), 0.5 * np.cos(3 * t)])


def speed(t):
    return np.column_stack([2 * np.cos(2 * t), -1.5 * np.sin(3 * t)])


def write(path, t, q, tau, header="t,q1,q2,tau1,tau2", delimiter=","):
    rows = [delimiter.join(map(repr, row)) for row in np.column_stack([t, q, tau]).tolist()]
    path.write_text("\n".join([header.replace(",", delimiter), *rows]) + "\n")
    return path


def uneven(seed=0):
    rng = np.random.default_rng(seed)
    return np.cumsum(1e-3 * (1 + 0.3 * rng.uniform(-1, 1, int(1000 * SECONDS))))


def test_uneven_and_repeated_rows_become_an_even_log_with_velocity(tmp_path):
    t = uneven()
    rows = np.sort(np.concatenate([np.arange(len(t)), np.arange(50, len(t), 40)]))
    q = signal(t)[rows]
    log = armctl.Log.from_csv(write(tmp_path / "run.csv", t[rows], q, 10 * q), joint_names=("a", "b"), robot="mine")
    assert (log.robot, log.joint_names, log.units) == ("mine", ("a", "b"), ("rad", "rad"))
    assert np.allclose(np.diff(log.t), log.dt, rtol=1e-9)
    inside = slice(500, -500)
    assert np.abs(log.q - signal(log.t + t[0]))[inside].max() < 1e-5
    assert np.abs(log.tau - 10 * log.q).max() < 1e-9
    assert np.abs(log.v - speed(log.t + t[0]))[inside].max() < 5e-3
    assert np.isnan(log.tip).all()
    assert f"{len(range(50, len(t), 40))} repeated rows" in log.plant
    assert "Hz" in log.plant


def test_a_stale_row_with_a_new_time_is_left_out_but_a_rest_is_kept(tmp_path):
    t = 1e-3 * np.arange(3000)
    q = signal(np.maximum(t - 1.0, 0.0))  # one second of rest, then motion
    q[1500] = q[1499]
    log = armctl.Log.from_csv(write(tmp_path / "run.csv", t, q, q))
    assert "1 repeated rows" in log.plant
    assert np.ptp(log.q[:990], axis=0).max() == 0.0
    assert np.abs(log.q[1500] - signal(np.array([0.5]))).max() < 1e-5


def test_units_and_names_of_columns(tmp_path):
    t = uneven()
    path = write(tmp_path / "run.csv", 1e3 * t, np.rad2deg(signal(t)), signal(t), "time,pos0,pos1,effort_a,effort_b", ";")
    columns = {"t": "time", "q": "pos*", "tau": ["effort_b", "effort_a"]}
    log = armctl.Log.from_csv(path, columns, units={"t": "ms", "q": "deg"})
    assert log.joint_names == ("pos0", "pos1")
    assert log.t[-1] == pytest.approx(t[-1] - t[0], abs=2e-3)
    assert np.abs(log.q[:, ::-1] - log.tau).max() < 1e-9


def test_joints_of_different_kinds_have_units_of_their_own(tmp_path):
    t = uneven()
    path = write(tmp_path / "run.csv", t, signal(t) * [1e3, 1.0], signal(t))
    log = armctl.Log.from_csv(path, units={"q": ["mm", "rad"], "tau": ["N", "N m"]})
    assert log.units == ("m", "rad")
    assert np.abs(log.q - log.tau).max() < 1e-9
    with pytest.raises(armctl.InputError, match=r"units: q: expected one unit or 2, got 3$"):
        armctl.Log.from_csv(path, units={"q": ["mm", "rad", "rad"]})


def test_a_log_from_csv_is_saved_and_loaded(tmp_path):
    t = uneven()
    log = armctl.Log.from_csv(write(tmp_path / "run.csv", t, signal(t), signal(t)))
    loaded = armctl.Log.load(log.save(tmp_path / "run.npz"))
    assert np.array_equal(loaded.q, log.q)


GOOD = "t,q1,tau1\n" + "".join(f"{k / 100},{k / 1000 + 0.01 * (k % 7)},{k}\n" for k in range(200))
BAD = {
    "no header": ("", "there is no column 't' for t"),
    "no torque": (GOOD.replace("tau1", "effort"), "there is no column 'tau\\*' for tau"),
    "too short": ("\n".join(GOOD.splitlines()[:20]), "expected at least .* rows, found 19"),
    "text": (GOOD.replace("0.5,", "x,"), "'x' is not a number"),
    "nan": (GOOD.replace("0.5,", "nan,"), "not finite"),
    "ragged": (GOOD + "3,4\n", "line 202 has 2 columns"),
    "backwards": (GOOD + "0.1,1,1\n", "the time of row 201 is before"),
    "a gap": (GOOD + "9.0,1,1\n", "nothing is recorded for 7.01 s"),
    "huge": (GOOD + "2.0,1e30,1\n", "above 1e\\+09"),
    "twice": (GOOD.replace("t,q1,tau1", "t,q1,q1"), "two columns of one name"),
    "frozen": ("t,q1,tau1\n" + "0,1,1\n" * 100, "only 1 rows differ"),
}


@pytest.mark.parametrize(("text", "reason"), BAD.values(), ids=BAD)
def test_a_file_that_is_no_recording_is_refused_in_one_sentence(tmp_path, text, reason):
    path = tmp_path / "run.csv"
    path.write_text(text)
    with pytest.raises(armctl.InputError, match=reason) as error:
        armctl.Log.from_csv(path)
    assert len(str(error.value)) <= 400


@pytest.mark.parametrize(
    "content", [b"\x00\x01\xff\xfe" * 200, b"PK\x03\x04" + bytes(range(256)), b't,"q1\n' * 50, b"\n" * 500]
)
def test_any_bytes_are_refused_with_an_input_error(tmp_path, content):
    path = tmp_path / "run.csv"
    path.write_bytes(content)
    with pytest.raises(armctl.InputError):
        armctl.Log.from_csv(path)


def test_truncated_and_damaged_copies_raise_nothing_but_input_errors(tmp_path):
    rng = np.random.default_rng(1)
    path = tmp_path / "run.csv"
    for _ in range(60):
        data = bytearray(GOOD.encode()[: rng.integers(1, len(GOOD))])
        for place in rng.integers(0, len(data), 3):
            data[place] = rng.integers(0, 256)
        path.write_bytes(data)
        with suppress(armctl.InputError):
            assert np.isfinite(armctl.Log.from_csv(path).q).all()


WRONG_CALLS = [
    ({"columns": 3}, "columns: 3 is not a table"),
    ({"columns": {"v": "x"}}, "columns: 'v' is not one of"),
    ({"columns": {"q": 3}}, "columns: q: 3 is neither"),
    ({"units": {"q": "turns"}}, "units: q: expected .*got 'turns'"),
    ({"joint_names": ("a", "b")}, "1 joints are recorded, 2 are named"),
    ({"robot": 3}, "robot: expected str, got 3"),
]


@pytest.mark.parametrize(("arguments", "reason"), WRONG_CALLS)
def test_wrong_arguments_are_refused(tmp_path, arguments, reason):
    path = tmp_path / "run.csv"
    path.write_text(GOOD)
    with pytest.raises(armctl.InputError, match=reason):
        armctl.Log.from_csv(path, **arguments)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(armctl.InputError, match="cannot be read"):
        armctl.Log.from_csv(tmp_path / "none.csv")


def test_the_cut_off_falls_with_the_noise_and_the_filter_has_no_delay():
    dt = 1e-3
    t = dt * np.arange(8000)
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((len(t), 2))
    cutoffs = [choose_cutoff(signal(t) + level * noise, dt) for level in (1e-6, 1e-5, 1e-4, 1e-3)]
    assert cutoffs == sorted(cutoffs, reverse=True)
    assert cutoffs[0] > 2 * cutoffs[-1]
    smooth = low_pass(signal(t) + 1e-5 * noise, 10.0, dt)
    velocity, acceleration = derivatives(smooth, dt)
    inside = slice(500, -500)
    assert np.abs(velocity - speed(t))[inside].max() < 2e-3
    assert np.abs(acceleration + signal(t) * [4, 9])[inside].max() < 0.1
