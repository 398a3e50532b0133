"""A log is the same after any of its formats; other files and other programs' files are what they claim to be."""

import dataclasses

import numpy as np
import pytest
from motions import Sway

import armctl
from armctl.core.log_files import LogContent, save

ENDINGS = (".npz", ".parquet", ".csv")


@pytest.fixture(scope="module")
def log():
    arm = armctl.load("robot_arm_3dof")
    return armctl.simulate(arm, "pd", Sway(arm), armctl.Plant(encoder_noise=1e-4), dwell=0.0)


def same(one: object, other: object) -> bool:
    if isinstance(one, np.ndarray):
        assert isinstance(other, np.ndarray)
        return one.dtype == other.dtype and np.array_equal(one, other, equal_nan=True)
    return one == other


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("kind", ["a run", "a recording", "no ticks", "two tips", "two tips, no ticks"])
def test_a_log_is_the_same_after_saving_and_loading(log, tmp_path, ending: str, kind: str):
    contact = armctl.Contact("arm", "wall, left", 0.1, 0.2)
    odd = dataclasses.replace(
        log, units=("m", "rad", "rad"), failure="it\ndiverged", contacts=(contact,), robot="é,#", wrench=np.ones((len(log), 6))
    )
    if kind == "a recording":
        odd = dataclasses.replace(
            odd,
            source=armctl.LogSource.RECORDING,
            continuous=True,
            torques=armctl.LogTorques.COMMANDED,
            q_ref=np.full_like(log.q, np.nan),
            tau_max=np.full(3, np.inf),
            qpos=np.zeros((0, 0)),
            wrench=log.wrench,
        )
    if "two tips" in kind:
        other = np.column_stack([0.5 * odd.tip, odd.tip_quat])
        end = np.concatenate([np.zeros(3), np.full(4, np.nan)])
        more = {"tip_names": ("left/hand", "right, hand"), "other_tips": other, "other_tips_ref": other, "other_targets": end}
        odd = dataclasses.replace(odd, **more)
    if "no ticks" in kind:
        over_time = [f.name for f in dataclasses.fields(log) if np.ndim(getattr(odd, f.name)) and len(getattr(odd, f.name)) > 9]
        odd = dataclasses.replace(odd, **{name: getattr(odd, name)[:0] for name in over_time})
        odd = dataclasses.replace(odd, qpos=np.zeros((0, 0)), wrench=np.zeros((0, 6)))
    loaded = armctl.Log.load(odd.save(tmp_path / f"run{ending}"))
    different = [f.name for f in dataclasses.fields(log) if not same(getattr(odd, f.name), getattr(loaded, f.name))]
    assert different == []


def test_a_file_of_one_tip_says_nothing_of_others(log, tmp_path):
    with np.load(log.save(tmp_path / "run.npz")) as file:
        assert not {name for name in file.files if "other" in name}
        assert "tip_names" not in str(file["meta"])
    assert list(log.tips) == ["tip"]
    assert log.tips["tip"].position is log.tip


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize(
    ("controller", "plant", "expected"),
    [
        ("pd", "nominal", (armctl.LogSource.SIMULATION, False, armctl.LogTorques.BOTH)),
        ("pd", "continuous, delay 2 ticks", (armctl.LogSource.SIMULATION, True, armctl.LogTorques.BOTH)),
        ("fr3's own servo", "robot: fr3", (armctl.LogSource.ROBOT, True, armctl.LogTorques.MEASURED)),
        ("recorded", "cut-off 20 Hz", (armctl.LogSource.RECORDING, True, armctl.LogTorques.MEASURED)),
    ],
)
def test_a_file_without_a_source_gets_it_from_its_texts(
    log, tmp_path, ending: str, controller: str, plant: str, expected: tuple
):
    old = dataclasses.replace(log, controller=controller, plant=plant)
    facts = {f.name: getattr(old, f.name) for f in dataclasses.fields(old) if f.name not in ("source", "continuous", "torques")}
    arrays = {name: value for name, value in facts.items() if isinstance(value, np.ndarray)}
    content = LogContent(arrays, {name: value for name, value in facts.items() if name not in arrays})
    save(tmp_path / f"old{ending}", content)
    loaded = armctl.Log.load(tmp_path / f"old{ending}")
    assert (loaded.source, loaded.continuous, loaded.torques) == expected


def test_the_flat_table_has_named_columns_of_equal_length(log):
    table = log.to_dict()
    assert list(table)[:3] == ["t", "q/shoulder_yaw", "q/shoulder_pitch"]
    assert {len(column) for column in table.values()} == {len(log)}
    assert np.array_equal(table["tau_cmd/elbow"], log.tau_cmd[:, 2])
    assert np.array_equal(table["tip_quat/z"], log.tip_quat[:, 3])


def test_parquet_says_the_units_and_is_read_by_pandas(log, tmp_path):
    import pandas
    import pyarrow.parquet

    path = dataclasses.replace(log, units=("m", "rad", "rad")).save(tmp_path / "run.parquet")
    schema = pyarrow.parquet.read_schema(path)
    units = {
        name: schema.field(name).metadata[b"unit"].decode() for name in ("t", "v/shoulder_yaw", "tau/shoulder_yaw", "tau/elbow")
    }
    assert units == {"t": "s", "v/shoulder_yaw": "m/s", "tau/shoulder_yaw": "N", "tau/elbow": "N m"}
    assert pandas.read_parquet(path)["q/elbow"].tolist() == log.q[:, 2].tolist()


def test_a_csv_is_read_by_pandas_and_by_from_csv(log, tmp_path):
    import pandas

    path = log.save(tmp_path / "run.csv")
    assert pandas.read_csv(path, comment="#")["q/elbow"].to_numpy() == pytest.approx(log.q[:, 2], rel=1e-15)
    columns = {kind: [f"{kind}/{joint}" for joint in log.joint_names] for kind in ("q", "tau")}
    recorded = armctl.Log.from_csv(path, columns, joint_names=log.joint_names)
    assert recorded.tau == pytest.approx(log.tau[: len(recorded)], abs=1e-9)


FOREIGN = {
    "pandas.csv": b"a,b\n1,2\n",
    "half.csv": b'# armctl log {"robot": "x"}\nt\n0\n',
    "list.csv": b"# armctl log [1]\nt\n0\n",
    "bomb.csv": b'# armctl log {"arrays": {}, "joint_names": [], "units": [], "nq": 1000000000000}\nt\n0\n',
    "noise.parquet": b"PAR1" + bytes(range(256)) + b"PAR1",
    "noise.csv": bytes(range(256)),
    "run.xlsx": b"PK",
}


@pytest.mark.parametrize(("name", "content"), FOREIGN.items(), ids=FOREIGN)
def test_a_foreign_file_is_refused_in_one_sentence(tmp_path, name: str, content: bytes):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(armctl.InputError, match="no log that armctl wrote") as error:
        armctl.Log.load(tmp_path / name)
    assert "\n" not in str(error.value)


def test_a_parquet_of_another_program_is_refused(tmp_path):
    import pandas

    pandas.DataFrame({"t": [0.0]}).to_parquet(tmp_path / "other.parquet")
    with pytest.raises(armctl.InputError, match="its metadata contain no log"):
        armctl.Log.load(tmp_path / "other.parquet")


@pytest.mark.parametrize("ending", [".parquet", ".csv"])
def test_a_damaged_file_is_usable_or_refused(log, tmp_path, ending: str):
    good = log.save(tmp_path / f"run{ending}").read_bytes()
    rng = np.random.default_rng(2)
    messages = []
    for _ in range(40):
        data = bytearray(good[: rng.integers(1, 2 * len(good))])
        for place in rng.integers(0, len(data), 20):
            data[place] = rng.integers(0, 256)
        (tmp_path / f"run{ending}").write_bytes(data)
        try:
            assert np.isfinite(armctl.Log.load(tmp_path / f"run{ending}").q).all()
        except armctl.InputError as error:
            messages.append(str(error))
    assert len(messages) > 10
    assert not any("\n" in message for message in messages)


def test_mcap_has_joint_states_that_ros_reads(log, tmp_path):
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with log.save(tmp_path / "run.mcap").open("rb") as file:
        messages = list(make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    states = [each.decoded_message for each in messages if each.channel.topic == "/joint_states"]
    assert {each.channel.topic for each in messages} == {"/joint_states", "/joint_references", "/tip", "/tip_reference"}
    assert len(states) == len(log)
    assert states[-1].name == list(log.joint_names)
    assert states[-1].position == log.q[-1].tolist()
    assert states[-1].effort == log.tau[-1].tolist()
    assert states[-1].header.stamp.nanosec == round(1e9 * log.t[-1])
    pose = next(each.decoded_message.pose for each in messages if each.channel.topic == "/tip")
    assert [pose.orientation.w, pose.orientation.x] == log.tip_quat[0, :2].tolist()


@pytest.mark.parametrize(("name", "extra"), [("run.parquet", "study"), ("run.mcap", "ros")])
def test_a_missing_package_is_named(log, tmp_path, monkeypatch, name: str, extra: str):
    for package in ("pyarrow", "mcap_ros2.writer"):
        monkeypatch.setitem(__import__("sys").modules, package, None)
    with pytest.raises(armctl.NotInstalledError, match=rf"its extra \[{extra}\]"):
        log.save(tmp_path / name)
    assert list(tmp_path.iterdir()) == []
