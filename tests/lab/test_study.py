"""A study makes each of its runs once, with the same bits wherever and whenever, and survives whatever ends it."""

import contextlib
import ctypes
import json
import os
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from multiprocessing import get_all_start_methods
from pathlib import Path

import mujoco
import numpy as np
import pytest
from arms import some_of

import armctl
from armctl.lab.study.study import Store
from armctl.lab.study.study_runner import StudyRunner, failed_outcome, model_digest, run_chunk, versions
from armctl.run.sim.mujoco_library import library


def digests(result: armctl.StudyResult) -> list[str]:
    assert result.ok
    return result.table()["digest"].tolist()


class Inline(Executor):
    """Makes each task at once, and calls `before` first."""

    def __init__(self, before):
        self._before = before

    def submit(self, fn, /, *args, **kwargs):
        future = Future()
        try:
            self._before(*args)
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def test_a_study_has_a_row_for_every_controller_at_every_point(finished):
    table = finished.table()
    assert len(finished) == 2 * 8 * 2
    assert table["ok"].all() or table["completed"].all()
    assert set(zip(table["controller"], table["delay"], strict=True)) == {
        (name, delay) for name in ("pd-gravity", "computed-torque") for delay in (0, 2)
    }
    assert len(set(table["digest"])) == len(finished)


def test_a_run_is_that_of_simulate(finished, short):
    row = {name: column[5] for name, column in finished.table().items()}
    arm = armctl.load("robot_arm_3dof")
    plant = armctl.Plant(
        payload=row["payload"], delay=row["delay"], encoder_noise=1e-5, velocity_noise=1e-3, seed=int(row["seed"])
    )
    log = armctl.simulate(arm, row["controller"], armctl.JointTrajectory.load(short), plant, dwell=0.02)
    report = armctl.Report.from_log(log)
    assert row["tip_rms_m"] == report.tip_rms_m
    assert row["chatter_nm"] == report.chatter_nm
    assert row["ok"] == report.ok


def test_controllers_meet_the_same_noise_and_points_and_repetitions_different_noise(study):
    runs = study(repeats=2).runs
    pairs = {}
    for run in runs:
        pairs.setdefault((repr(run.point), run.repeat), []).append(run.seed)
    assert all(len(seeds) == 2 and len(set(seeds)) == 1 for seeds in pairs.values())
    assert len({seeds[0] for seeds in pairs.values()}) == len(pairs) == 32


def test_the_seed_and_key_of_a_run_do_not_depend_on_the_other_runs(study):
    few = {(run.controller, repr(run.point)): (run.key, run.seed) for run in study(samples=4).runs}
    many = {
        (run.controller, repr(run.point)): (run.key, run.seed) for run in study(samples=8, repeats=2).runs if not run.repeat
    }
    assert few.items() <= many.items()


@pytest.mark.parametrize("changes", [{"dwell": 0.03}, {"tolerance": 0.01}, {"motion": "out-and-back"}, {"seed": 1}])
def test_another_study_has_other_keys(study, changes: dict):
    assert not {run.key for run in study().runs} & {run.key for run in study(**changes).runs}


def test_threads_make_the_same_bits(study, finished, tmp_path):
    with ThreadPoolExecutor(3) as pool:
        assert digests(study().run(pool, folder=tmp_path)) == digests(finished)


def test_a_second_start_makes_nothing_again(study, finished, tmp_path, monkeypatch):
    study().run(folder=tmp_path)
    monkeypatch.setattr(StudyRunner, "outcomes", None)
    assert digests(study().run(folder=tmp_path)) == digests(finished)


def test_an_interrupted_study_keeps_what_is_finished(study, finished, tmp_path):
    started = []

    def interrupt(runs):
        started.append(len(runs))
        if len(started) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        study().run(Inline(interrupt), folder=tmp_path)
    partial = study().result(tmp_path)
    assert not partial
    assert partial.reason == "16 of 32 runs are not finished"
    assert digests(study().run(folder=tmp_path)) == digests(finished)


def test_more_samples_use_the_runs_that_are_finished(study, tmp_path):
    study(samples=4).run(folder=tmp_path)
    made = []
    study().run(Inline(made.extend), folder=tmp_path)
    assert len(made) == 16


def test_a_run_that_ends_its_worker_is_found_and_made_again_at_the_next_start(study, finished, tmp_path):
    victim = study().runs[11]

    def end(runs):
        if victim in runs:
            raise ConnectionError("the worker is gone")

    result = study().run(Inline(end), folder=tmp_path)
    table = result.table()
    assert np.flatnonzero(~table["completed"]).tolist() == [11]
    assert "its worker failed (ConnectionError: the worker is gone)" in table["reason"][11]
    assert np.isnan(table["tip_rms_m"][11])
    assert digests(study().run(folder=tmp_path)) == digests(finished)


def test_an_executor_that_stops_is_one_sentence_and_loses_nothing(study, finished, tmp_path):
    from concurrent.futures.process import BrokenProcessPool

    started = []

    def stop(runs):
        started.append(runs)
        if len(started) == 2:
            raise BrokenProcessPool("a process died")

    with pytest.raises(armctl.ArmctlError, match="run the study again to make the runs that remain"):
        study().run(Inline(stop), folder=tmp_path)
    assert len(study().result(tmp_path)) == 24
    assert digests(study().run(folder=tmp_path)) == digests(finished)


CLIENT = """
import sys, armctl
study = armctl.Study.from_file(sys.argv[1])
class Slow:
    def submit(self, fn, runs):
        from concurrent.futures import Future
        import time
        future = Future()
        future.set_result(fn(runs))
        time.sleep(0.3)
        return future
import armctl.lab.study.study as module
module._MAX_PENDING = 1
study.run(Slow(), folder=sys.argv[2])
"""


@pytest.mark.full
def test_a_client_that_is_killed_loses_no_finished_run(study, finished, toml, tmp_path):
    (tmp_path / "trial.toml").write_text(toml)
    process = subprocess.Popen([sys.executable, "-c", CLIENT, tmp_path / "trial.toml", tmp_path])
    deadline = time.monotonic() + 60
    watched = study()
    while not (tmp_path / "trial.sqlite").exists() or not len(watched.result(tmp_path)):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.kill()
    process.wait()
    kept = study().result(tmp_path)
    assert 8 <= len(kept) < 32
    made = []
    result = study().run(Inline(made.extend), folder=tmp_path)
    assert len(made) == 32 - len(kept)
    assert digests(result) == digests(finished)


# In a process of its own: one that has imported JAX cannot be forked.
STARTING_PROCESSES = """
import sys, armctl
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
if __name__ == "__main__":
    study = armctl.Study.from_file(sys.argv[1])
    with ProcessPoolExecutor(1, get_context(sys.argv[3])) as executor:
        study.run(executor, folder=sys.argv[2])
"""


@pytest.mark.full
@pytest.mark.parametrize("method", some_of(sorted({"fork", "spawn"}.intersection(get_all_start_methods())), ["spawn"]))
def test_processes_find_what_one_thread_finds(study, finished, toml, tmp_path, method: str):
    (tmp_path / "trial.toml").write_text(toml)
    (tmp_path / "main.py").write_text(STARTING_PROCESSES)
    subprocess.run([sys.executable, tmp_path / "main.py", tmp_path / "trial.toml", tmp_path, method], check=True)
    assert digests(study().result(tmp_path)) == digests(finished)


@pytest.mark.nightly
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
def test_a_dask_worker_that_is_killed_loses_nothing(study, finished, tmp_path):
    from dask.distributed import Client, LocalCluster

    with (
        LocalCluster(2, threads_per_worker=1, dashboard_address=None, local_directory=tmp_path) as cluster,
        Client(cluster) as client,
    ):
        for nanny in cluster.workers.values():
            nanny.auto_restart = False  # one worker is enough for what remains
        pids = list(client.run(os.getpid).values())

        watched = study()

        def kill_one() -> None:
            while len(watched.result(tmp_path)) < 8:
                time.sleep(0.02)
            os.kill(pids[0], signal.SIGKILL)

        killer = threading.Thread(target=kill_one, daemon=True)
        killer.start()
        result = study().run(client.get_executor(pure=False), folder=tmp_path)
        killer.join(30)
        assert not killer.is_alive()
    assert digests(result) == digests(finished)


def test_a_run_that_fails_is_a_row_with_its_reason(study, tmp_path):
    factors = {"controller.share": [1.0, 13.0]}
    result = study(controllers={"own": "own_controller:Weak"}, factors=factors).run(folder=tmp_path)
    table = result.table()
    assert result.ok
    assert table["completed"].tolist() == [True, False]
    assert "thirteen" in table["reason"][1]
    assert np.isnan(table["tip_rms_m"]).tolist() == [False, True]


def test_runs_of_other_versions_are_kept_apart(study, tmp_path, monkeypatch):
    small = study(samples=1, factors={})
    small.run(folder=tmp_path)
    monkeypatch.setattr(armctl, "__version__", "9.9")
    with pytest.warns(armctl.ArmctlWarning, match="2 runs of other versions are kept, but not used; now armctl 9.9"):
        result = study(samples=1, factors={}).run(folder=tmp_path)
    assert len(result) == 2
    with sqlite3.connect(tmp_path / "trial.sqlite") as database:
        assert database.execute("select count(*) from runs").fetchone() == (4,)


@pytest.mark.parametrize("array", ["body_mass", "jnt_range", "dof_damping", "geom_friction", "actuator_gainprm"])
def test_models_that_differ_in_one_number_have_different_digests(array: str):
    arm = armctl.load("robot_arm_3dof")
    before = model_digest(arm)
    assert before == model_digest(armctl.load("robot_arm_3dof"))
    getattr(arm.model, array)[-1] += 1e-9
    assert model_digest(arm) != before


def test_a_worker_with_another_model_or_version_refuses(study):
    for changes, reason in (
        ({"model": "another"}, "differs from that of the study"),
        ({"versions": "armctl 9.9"}, "a worker has armctl .*, but the study was started with armctl 9.9"),
    ):
        with pytest.raises(armctl.ModelError, match=reason):
            run_chunk(json.dumps({**study().setup, **changes}), study().runs[:1])


def test_targets_and_speeds_are_factors(study, tmp_path):
    tip = armctl.load("robot_arm_3dof").fk([0.4, 0.3, 0.5]).position.round(3).tolist()
    factors = {"target": [tip, [9.0, 0.0, 0.0]], "speed": [1.0, 0.5]}
    table = study(motion="reach", controllers=["computed-torque"], factors=factors, dwell=0.3).run(folder=tmp_path).table()
    assert table["ok"].tolist() == [True, True, False, False]
    assert table["duration_s"][1] > 1.3 * table["duration_s"][0]
    assert "target: [9.0, 0.0, 0.0]: " in table["reason"][2]


def test_a_file_is_the_study_that_it_describes(study, toml, tmp_path):
    path = tmp_path / "trial.toml"
    path.write_text(toml)
    assert armctl.Study.from_file(path).to_dict() == study().to_dict()
    assert armctl.Study.from_dict(study().to_dict()).runs == study().runs


WRONG = {
    "a name with a slash": ({"name": "a/b"}, "name: expected .*got 'a/b'"),
    "an arm": ({"robot": 3}, "robot: expected a name, a file or a dict .* got 3"),
    "no controllers": ({"controllers": []}, "controllers: expected .*got none"),
    "a controller object": ({"controllers": [armctl.PD]}, "expected names, or a dict"),
    "an argument that is no data": (
        {"controllers": {"x": {"controller": "pd", "stiffness": armctl}}},
        "expected numbers, texts and lists",
    ),
    "no motion": ({"motion": "dance"}, "motion: expected .*got 'dance'"),
    "no target": ({"motion": "reach"}, "'reach' and the factor 'target' belong together"),
    "an unknown factor": ({"factors": {"paylod": [1]}}, "did you mean 'payload'"),
    "no repetition": ({"repeats": 0}, "repeats: expected .*got 0"),
}


@pytest.mark.parametrize(("changes", "reason"), WRONG.values(), ids=WRONG)
def test_a_wrong_study_is_one_sentence(study, changes: dict, reason: str):
    with pytest.raises(armctl.ArmctlError, match=reason):
        study(**changes)


WRONG_FOR_ROBOT = {
    "a controller": ({"controllers": ["pdd"]}, "unknown controller 'pdd'"),
    "an argument": ({"controllers": {"x": {"controller": "pd", "stifness": 3}}}, "pd cannot be made with"),
    "a module": ({"controllers": ["nowhere:Controller"]}, "cannot be imported"),
    "a value": ({"factors": {"payload": armctl.Range(-1, 1)}}, "payload: expected .*got -1"),
    "a length": (
        {"factors": {"coulomb_friction": [[0.1, 0.2]]}},
        "coulomb_friction: expected 1 or 3 numbers for robot_arm_3dof, got 2",
    ),
    "a speed": ({"factors": {"speed": [2.0]}}, "speed: expected .*got 2"),
    "a robot": ({"robot": "no_such_robot"}, "no_such_robot"),
}


@pytest.mark.parametrize(("changes", "reason"), WRONG_FOR_ROBOT.values(), ids=WRONG_FOR_ROBOT)
def test_what_does_not_fit_the_robot_is_refused_before_anything_runs(study, tmp_path, changes: dict, reason: str):
    with pytest.raises(armctl.ArmctlError, match=reason):
        study(**changes).run(folder=tmp_path)
    assert not list(tmp_path.iterdir())


def test_of_many_values_to_choose_from_only_those_of_the_runs_are_checked(study, monkeypatch):
    planned = study(factors={"payload": armctl.Choice(np.linspace(0.0, 1.0, 100_000))}, samples=4)
    checked = []
    monkeypatch.setattr(StudyRunner, "check_plant", lambda runner, run: checked.append(run.point["payload"]))
    planned._check()
    assert sorted(checked) == sorted({run.point["payload"] for run in planned.runs})
    assert len(checked) == 4


def test_a_foreign_database_and_a_foreign_executor_are_refused(study, tmp_path):
    with pytest.raises(armctl.InputError, match=r"expected Executor, .* for Dask pass client.get_executor"):
        study().run(3, folder=tmp_path)
    Path(tmp_path / "trial.sqlite").write_bytes(b"no database" * 100)
    with pytest.raises(armctl.InputError, match="it is not a file of a study"):
        study().run(folder=tmp_path)


@pytest.mark.parametrize("outcome", ["[]", "{}", "1", "x", "[" * 100_000, b"\xff", 7, None, '{"tip_rms_m": "x"}'])
def test_a_damaged_outcome_is_refused_in_one_sentence(study, tmp_path, outcome):
    planned = study()
    with Store(tmp_path / "trial.sqlite", versions()) as store:
        store.add(planned.runs[:1], [failed_outcome("lost")])
    whole = failed_outcome("lost")
    if isinstance(outcome, str) and outcome.startswith('{"'):
        outcome = json.dumps(whole | json.loads(outcome))
    with contextlib.closing(sqlite3.connect(tmp_path / "trial.sqlite")) as database, database:
        database.execute("update runs set outcome = ?", [outcome])
    with pytest.raises(armctl.InputError, match="it is not a file of a study"):
        planned.result(tmp_path)


@pytest.mark.parametrize("text", ["name = ", "name = 3", 'name = "x"', "\x00", 'name = "x"\nrobot = "y"\nfoo = 1'])
def test_a_file_that_is_no_study_is_refused_in_one_sentence(tmp_path, text: str):
    path = tmp_path / "study.toml"
    path.write_text(text)
    with pytest.raises(armctl.InputError, match=r"study\.toml") as error:
        armctl.Study.from_file(path)
    assert "\n" not in str(error.value)


def test_a_worker_frees_the_files_that_mujoco_keeps(study, tmp_path):
    """A mesh from a file stays in MuJoCo's cache until a worker has loaded its robot."""
    (tmp_path / "tetrahedron.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n")
    path = tmp_path / "scene.xml"
    path.write_text('<mujoco><asset><mesh name="m" file="tetrahedron.obj"/></asset></mujoco>')
    mujoco.MjModel.from_xml_path(str(path))
    functions = library()
    functions.mj_getCache.restype = ctypes.c_void_p
    functions.mj_getCacheSize.argtypes = [ctypes.c_void_p]
    functions.mj_getCacheSize.restype = ctypes.c_size_t
    assert functions.mj_getCacheSize(functions.mj_getCache()) > 0
    assert run_chunk(json.dumps(study(dwell=0.03).setup), []) == []
    assert functions.mj_getCacheSize(functions.mj_getCache()) == 0
