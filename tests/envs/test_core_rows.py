"""The steps of environments in the compiled core refuse wrong arguments, and a second thread."""

import threading
import time

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="pip install -e '.[envs]'")

import gymnasium

import armctl
import armctl.envs
from armctl import _core
from armctl.envs.batch_simulation import BatchSimulation
from armctl.run.sim.mujoco_library import mujoco_api

pytestmark = pytest.mark.core
ROBOT = "robot_arm_3dof"


@pytest.fixture
def env():
    made = armctl.envs.ArmVectorEnv(ROBOT, "Track", "joint_delta", num_envs=2)
    made.reset(seed=0)
    yield made
    made.close()


def remade(rows: BatchSimulation, **changes: object) -> _core.EnvironmentBatch:
    """The core's rows of an environment with other arguments."""
    made = {}

    def record(api, **options):
        made.update(options)
        return rows._core

    original = _core.EnvironmentBatch
    _core.EnvironmentBatch = record
    try:
        law = _core.PD(stiffness=np.ones(3), damping=np.ones(3))
        rows._compiled_batch(law, 2, rows.mode.kind, rows.action, rows.ticks)
    finally:
        _core.EnvironmentBatch = original
    return _core.EnvironmentBatch(mujoco_api(), **(made | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"law": _core.PD(stiffness=np.ones(1), damping=np.ones(1))}, "law, arm: they are not for 3 joints"),
        ({"action": np.zeros((2, 4))}, r"action: need an array of shape \(2, 3\), got \(2, 4\)"),
        ({"noise": np.zeros((2, 1, 2, 3))}, r"noise: need an array of shape \(2, 25, 2, 3\)"),
        ({"gear": np.ones(2)}, r"qpos_addresses: need an array of shape \(2,\), got \(3,\)"),
        ({"gripper_ctrl": np.zeros(1, np.int64)}, r"gripper_length: need an array of shape \(1,\)"),
        ({"touched": np.zeros(2)}, "touched: need a contiguous, writable array of type int64"),
        ({"tip_sizes": np.ones(2, np.int64)}, r"tip_sizes: need an array of shape \(1,\), got \(2,\)"),
        ({"tip_sizes": np.full(1, 4)}, "tip_sizes: need 3 or 6 numbers for each tip"),
        ({"tip_joints": np.full(1, 3)}, "tip_joints: need -1 or one of 3 joints, got 3"),
        ({"tip_joints": np.full(1, -2)}, "tip_joints: need -1 or one of 3 joints, got -2"),
        ({"tip_placements": np.zeros((1, 7))}, r"tip_placements: need an array of shape \(1, 12\), got \(1, 7\)"),
        ({"mode": 3, "tip_sizes": np.full(1, 6)}, "action: need a number for each joint, or a block for each tip"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_wrong_arguments_of_rows_are_refused_in_one_sentence(env: gymnasium.vector.VectorEnv, changes, message: str):
    with pytest.raises(armctl.InputError, match=message):
        remade(env.batch.rows, **changes)


def test_rows_are_refused_that_do_not_exist_or_have_no_simulation(env: gymnasium.vector.VectorEnv):
    rows = env.batch.rows
    core = remade(rows)
    with pytest.raises(armctl.InputError, match="row: there are 2 rows"):
        core.step(0, 3)
    with pytest.raises(armctl.InputError, match="row 0: it has no simulation"):
        core.step(0, 1)
    other = rows.simulated
    core.set_simulation(0, other.model(0), other.data(0))
    assert core.step(0, 1) == ""
    with pytest.raises(armctl.InputError, match="ticks: need at most 2, got 3"):
        core.restart(0, 3)
    with pytest.raises(armctl.InputError, match="motors: the model has no such joint or motor"):
        remade(rows, ctrl_addresses=np.array([0, 1, 99])).set_simulation(0, other.model(0), other.data(0))
    with pytest.raises(armctl.InputError, match="object: the model has no such joint"):
        remade(rows, object_addresses=np.zeros(2, np.int64)).set_simulation(0, other.model(0), other.data(0))


def test_an_error_of_mujoco_ends_a_step_in_one_sentence(env: gymnasium.vector.VectorEnv):
    env.batch.rows.simulated.model(0).opt.integrator = 99
    with pytest.raises(armctl.SimulationError, match=r"mj_step: .*integrator"):
        env.step(np.zeros(env.action_space.shape))


def test_a_second_thread_on_an_environment_gets_one_sentence():
    env = armctl.envs.ArmVectorEnv(ROBOT, "Track", "joint_delta", num_envs=2, ticks=20_000)
    env.reset(seed=0)
    rows = env.batch.rows
    thread = threading.Thread(target=rows.step)
    thread.start()
    while rows.simulated.data(0).time == 0.0:
        time.sleep(1e-4)
    with pytest.raises(armctl.InputError, match="another thread steps it; give each thread an environment of its own"):
        rows.step()
    thread.join()
    rows.step()
    assert rows.simulated.data(1).time == pytest.approx(2 * env.batch.step_time)
    env.close()
