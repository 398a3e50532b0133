"""Demonstrations: the data set of an expert has the structure of LeRobotDataset v3.0 and the rows of the episodes."""

import json

import numpy as np
import pytest

pytest.importorskip("av", reason="pip install -e '.[view]'")
pytest.importorskip("pandas", reason="pip install -e '.[study]'")
pytest.importorskip("pyarrow", reason="pip install -e '.[study]'")

import av
import pandas as pd
import pyarrow.parquet as pq
from synthetic import PAIR, mjcf, motors

import armctl
import armctl.envs
from armctl.envs.lerobot import FRONT, Feature, LeRobotWriter

SEED = 3
EPISODES = 2
INDICES = ("timestamp", "frame_index", "episode_index", "index", "task_index")


@pytest.fixture(scope="module")
def env():
    env = armctl.envs.ArmEnv("robot_arm_3dof", "ReachPast", "joint_target", render_mode="rgb_array", width=64, height=48)
    yield env
    env.close()


@pytest.fixture(scope="module")
def dataset(env, tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "reach_past"
    result = armctl.envs.save_demonstrations(env, folder, EPISODES, seed=SEED)
    assert result
    assert (result.episodes, result.failures) == (EPISODES, 0)
    return folder


@pytest.fixture(scope="module")
def info(dataset):
    return json.loads((dataset / "meta/info.json").read_text())


@pytest.fixture(scope="module")
def rows(dataset):
    return pq.read_table(dataset / "data/chunk-000/file-000.parquet")


def test_the_rows_are_those_of_the_episodes(env, rows, info):
    policy = armctl.envs.ExpertPolicy(env)
    states = np.array(rows["observation.state"].to_pylist(), np.float32)
    actions = np.array(rows["action"].to_pylist(), np.float32)
    at = 0
    for episode in range(EPISODES):
        observation, _ = env.reset(seed=SEED + episode)
        frame = 0
        while at < len(states) and rows["episode_index"][at].as_py() == episode:
            action = policy()
            assert np.array_equal(states[at], observation)
            assert np.array_equal(actions[at], action)
            observation, reward, _, _, information = env.step(action)
            assert rows["next.reward"][at].as_py() == pytest.approx(reward)
            assert rows["next.success"][at].as_py() == information["is_success"]
            assert [rows[name][at].as_py() for name in INDICES] == pytest.approx([frame / info["fps"], frame, episode, at, 0])
            frame += 1
            at += 1
        assert rows["next.done"][at - 1].as_py()
        assert rows["next.success"][at - 1].as_py()
    assert at == len(states) == info["total_frames"]


def test_the_structure_is_that_of_the_format(dataset, info, rows):
    files = {str(path.relative_to(dataset)) for path in dataset.rglob("*") if path.is_file()}
    assert files == {
        "data/chunk-000/file-000.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
        f"videos/{FRONT}/chunk-000/file-000.mp4",
    }
    assert info["codebase_version"] == "v3.0"
    assert info["fps"] == 20
    assert info["splits"] == {"train": f"0:{EPISODES}"}
    assert info["data_path"].format(chunk_index=0, file_index=0) in files
    assert info["video_path"].format(video_key=FRONT, chunk_index=0, file_index=0) in files
    assert set(info["features"]) == {*rows.column_names, FRONT}
    for name in rows.column_names:
        feature = info["features"][name]
        assert feature["shape"] == [len(feature["names"]) if feature["names"] else 1]
        kind = rows.schema.field(name).type
        kind, size = (kind.value_type, kind.list_size) if hasattr(kind, "list_size") else (kind, 1)
        assert ({"float": "float32"}.get(str(kind), str(kind)), [size]) == (feature["dtype"], feature["shape"])
    tasks = pd.read_parquet(dataset / "meta/tasks.parquet")
    assert tasks.loc["Move the tip to the target without touching the obstacle."].task_index == 0


def test_episodes_and_statistics_describe_the_rows(dataset, rows):
    episodes = pq.read_table(dataset / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    states = np.array(rows["observation.state"].to_pylist())
    statistics = json.loads((dataset / "meta/stats.json").read_text())
    assert [each["dataset_to_index"] for each in episodes] == [episodes[1]["dataset_from_index"], len(rows)]
    for each in episodes:
        own = states[each["dataset_from_index"] : each["dataset_to_index"]]
        assert len(own) == each["length"]
        assert each["stats/observation.state/mean"] == pytest.approx(own.mean(axis=0), abs=1e-6)
        assert each["stats/observation.state/count"] == [len(own)]
        duration = each[f"videos/{FRONT}/to_timestamp"] - each[f"videos/{FRONT}/from_timestamp"]
        assert duration == pytest.approx(len(own) / 20)
    for what, expected in (("mean", states.mean(axis=0)), ("std", states.std(axis=0)), ("max", states.max(axis=0))):
        assert statistics["observation.state"][what] == pytest.approx(expected, abs=1e-6)
    medians = [np.median(states[each["dataset_from_index"] : each["dataset_to_index"]], axis=0) for each in episodes]
    expected = np.average(medians, axis=0, weights=[each["length"] for each in episodes])
    assert statistics["observation.state"]["q50"] == pytest.approx(expected, abs=1e-6)
    assert np.shape(statistics[FRONT]["q99"]) == (3, 1, 1)
    assert np.shape(statistics[FRONT]["mean"]) == (3, 1, 1)
    assert 0.0 < np.mean(statistics[FRONT]["mean"]) < 1.0


def test_the_film_has_a_picture_for_each_row(dataset, env, rows):
    with av.open(dataset / f"videos/{FRONT}/chunk-000/file-000.mp4") as film:
        pictures = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
        rate = film.streams.video[0].average_rate
    assert (len(pictures), rate) == (len(rows), 20)
    env.reset(seed=SEED)
    first = env.render()
    assert first.shape == (48, 64, 3)
    assert np.abs(pictures[0].astype(float) - first).mean() < 12.0
    assert np.abs(pictures[0].astype(float) - pictures[-1]).mean() > 0.5


def test_files_are_numbered_when_they_are_full(tmp_path, monkeypatch):
    monkeypatch.setattr("armctl.envs.lerobot._DATA_FILE_MB", 0)
    writer = LeRobotWriter(
        tmp_path, frames_per_second=20, robot="arm", features={"action": Feature("float32", ["a"])}, films={}
    )
    for k in range(2):
        writer.add("wave", {"action": np.full((3, 1), k, np.float32)}, {})
    writer.finish()
    episodes = pq.read_table(tmp_path / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [each["data/file_index"] for each in episodes] == [0, 1]
    second = pq.read_table(tmp_path / "data/chunk-000/file-001.parquet")
    assert second["index"].to_pylist() == [3, 4, 5]
    assert second["action"].to_pylist() == [1.0, 1.0, 1.0]  # lerobot reads lists of one as numbers
    assert json.loads((tmp_path / "meta/info.json").read_text())["video_path"] is None


def test_the_actions_of_a_policy_are_recorded_and_their_replay_ends_in_the_same_state(tmp_path):
    env = armctl.envs.ArmEnv("robot_arm_3dof", "Reach", "cartesian_delta")
    to_goal = env.batch.observer.columns["to_goal"]
    seen = []

    def policy(observation):
        seen.append(observation)
        return np.clip(6.0 * observation[to_goal].astype(float), -1.0, 1.0)

    result = armctl.envs.save_demonstrations(env, tmp_path / "data", 1, seed=5, policy=policy)
    assert result, result.reason
    rows = pq.read_table(tmp_path / "data/data/chunk-000/file-000.parquet")
    assert np.array_equal(np.array(rows["observation.state"].to_pylist(), np.float32), np.array(seen))
    observation, _ = env.reset(seed=5)
    successes = []
    for action, expected in zip(rows["action"].to_pylist(), seen, strict=True):
        assert np.array_equal(observation, expected)
        observation, _, _, _, information = env.step(np.array(action, np.float32))
        successes.append(information["is_success"])
    assert successes == rows["next.success"].to_pylist()
    assert successes[-1]
    with pytest.raises(armctl.InputError, match="policy: expected a function of an observation, got 'joystick'"):
        armctl.envs.save_demonstrations(env, tmp_path / "more", 1, policy="joystick")


@pytest.mark.parametrize("action", ["cartesian_delta", "joint_delta"])
def test_each_number_of_several_tips_has_a_name(tmp_path, action):
    path = tmp_path / "pair.xml"
    path.write_text(mjcf(PAIR, motors("a b c d e f")))
    env = armctl.envs.ArmEnv(path, "Reach", action, load_options={"tips": ["C", "F"]})
    result = armctl.envs.save_demonstrations(env, tmp_path / "data", 1)
    assert result, result.reason
    features = json.loads((tmp_path / "data/meta/info.json").read_text())["features"]
    by_tip = [f"{tip}/{axis}" for tip in "CF" for axis in "xyz"]
    assert features["action"]["names"] == (by_tip if action == "cartesian_delta" else list("abcdef"))
    expected = [f"{quantity}/{joint}" for quantity in ("q", "v", "to_target") for joint in "abcdef"]
    expected += [f"{quantity}/{name}" for quantity in ("tip", "goal", "to_goal") for name in by_tip]
    assert features["observation.state"]["names"] == expected
    assert features["observation.state"]["shape"] == list(env.observation_space.shape)
    rows = pq.read_table(tmp_path / "data/data/chunk-000/file-000.parquet")
    assert np.array(rows["observation.state"].to_pylist()).shape[1] == len(expected)


def test_each_camera_has_a_film_also_one_at_the_wrist(tmp_path):
    arm = armctl.load("robot_arm_3dof")
    wrist = armctl.Camera(armctl.Pose([0.0, 0.0, 0.05]), on=arm.model.body(arm.tip_body).name, name="wrist")
    above = armctl.Camera(armctl.Pose([0.3, 0.0, 1.2], rpy=[np.pi, 0.0, 0.0]), name="above")
    env = armctl.envs.ArmEnv(arm, "Reach", "joint_target", width=64, height=48, cameras=[wrist, above])
    env.reset(seed=0)
    seen = env.see()
    assert list(seen) == ["wrist", "above"]
    assert seen["above"].points.shape[1] == 3
    first = seen["wrist"].T_world_camera.position
    env.step(np.full(env.action_space.shape, 0.8, np.float32))
    assert np.linalg.norm(env.see()["wrist"].T_world_camera.position - first) > 1e-4
    result = armctl.envs.save_demonstrations(env, tmp_path / "data", 1, seed=SEED)
    assert result, result.reason
    info = json.loads((tmp_path / "data/meta/info.json").read_text())
    for name in ("wrist", "above"):
        with av.open(tmp_path / f"data/videos/observation.images.{name}/chunk-000/file-000.mp4") as film:
            assert len([None for _ in film.decode(video=0)]) == result.frames
        assert info["features"][f"observation.images.{name}"]["shape"] == [48, 64, 3]
    assert FRONT not in info["features"]
    env.close()


@pytest.mark.parametrize(
    ("cameras", "error", "message"),
    [
        ("wrist", armctl.InputError, "cameras: expected a list"),
        ([3], armctl.InputError, "cameras: expected a list .* got 3"),
        ([armctl.Camera(armctl.Pose([0, 0, 1]))] * 2, armctl.InputError, "two are called 'camera'"),
        (["wrist"], armctl.UnknownNameError, "camera"),
    ],
)
def test_cameras_that_are_none_are_refused_before_an_episode(cameras, error, message):
    with pytest.raises(error, match=message):
        armctl.envs.ArmEnv("robot_arm_3dof", cameras=cameras)


def test_wrong_calls_leave_nothing_behind(env, tmp_path, monkeypatch):
    with pytest.raises(armctl.InputError, match="exists already"):
        armctl.envs.save_demonstrations(env, tmp_path, 1)
    with pytest.raises(armctl.InputError, match="no single environment"):
        armctl.envs.save_demonstrations(armctl.envs.ArmVectorEnv("robot_arm_3dof"), tmp_path / "data", 1)
    odd = armctl.envs.ArmEnv("robot_arm_3dof", action="joint_target", ticks=7)
    with pytest.raises(armctl.InputError, match="whole number"):
        armctl.envs.save_demonstrations(odd, tmp_path / "data", 1)
    monkeypatch.setattr("armctl.envs.demonstrations._MAX_FAILURES", 2)
    hopeless = armctl.envs.ArmEnv("robot_arm_3dof", "ReachPast", "joint_target", horizon=1)
    result = armctl.envs.save_demonstrations(hopeless, tmp_path / "data", 1)
    assert not result
    assert "failed" in result.reason
    assert not list(tmp_path.iterdir())
