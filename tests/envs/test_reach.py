"""Environments of the task Reach: limits, seeds, threads, and what Gymnasium asks of an environment."""

import dataclasses
import os
import subprocess
import sys
from dataclasses import replace

import mujoco
import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="pip install -e '.[envs]'")

import gymnasium
from gymnasium.utils.env_checker import check_env
from synthetic import FAST, mjcf, motors

import armctl
import armctl.envs
from armctl.envs.actions import target_limits

ROBOT = "robot_arm_3dof"
ACTIONS = ("torque", "joint_delta", "joint_target", "cartesian_delta", "cartesian_pose", "joint_delta_smooth")


@pytest.fixture(scope="module")
def arm():
    return armctl.load(ROBOT)


def run(env, actions):
    """The observations of some steps."""
    return np.array([env.step(action)[0] for action in actions])


@pytest.mark.filterwarnings("ignore:.*A Box observation space")
@pytest.mark.parametrize("name", ["armctl.envs:armctl/Reach-v0", "armctl.envs:armctl/ReachGoal-v0"])
def test_gymnasium_accepts_the_environment(arm, name):
    check_env(gymnasium.make(name, robot=arm).unwrapped, skip_render_check=True)


def test_gymnasium_finds_environments_by_the_module_in_their_name_and_not_by_entry_points(tmp_path):
    options = "entry_point='gymnasium:Env', disable_env_checker=True, order_enforce=False"
    register = f"def register():\n    gymnasium.register('plugin/A-v0', {options})\n"
    (tmp_path / "plugin.py").write_text(f"import gymnasium\n{register}register()\n")
    metadata = tmp_path / "plugin-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: plugin\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text("[gymnasium.envs]\n__root__ = plugin:register\nplugin = plugin:register\n")
    script = """
import importlib.metadata, gymnasium
print(len(importlib.metadata.entry_points(group="gymnasium.envs")))
for name in ("plugin/A-v0", "plugin:plugin/A-v0"):
    try:
        print(gymnasium.make(name).spec.id)
    except gymnasium.error.Error as error:
        print(type(error).__name__)
"""
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    ended = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True)
    assert ended.stdout.split() == ["2", "NamespaceNotFound", "plugin/A-v0"]


@pytest.mark.parametrize("contacts", [True, False])
@pytest.mark.parametrize("action", ACTIONS)
def test_joint_limits_hold_whatever_the_policy_does(arm, action, contacts):
    env = armctl.envs.ArmEnv(arm, action=action, contacts=contacts)
    env.reset(seed=0)
    size = env.action_space.shape[0]
    pushes = np.sign(np.random.default_rng(1).uniform(-1.0, 1.0, (8, size)))
    for push in np.repeat(pushes, 12, axis=0):
        env.step(push)
        assert arm.limits.contains(env.batch.rows.q)


def pushed(env) -> np.ndarray:
    """(T, n) rad, the positions at each tick of an episode with abrupt actions and a rest."""
    env.reset(seed=4)
    q = [env.batch.rows.q[0].copy()] * 3
    for push in np.repeat([[1.0, 1.0, 1.0], [-1.0, -1.0, -1.0], [1.0, -1.0, 0.0], [0.0, 0.0, 0.0]], [60, 90, 60, 390], axis=0):
        env.step(push)
        q.append(env.batch.rows.q[0].copy())
    return np.array(q)


@pytest.mark.parametrize("action", ["joint_delta_smooth", "cartesian_delta_smooth"])
def test_smooth_actions_keep_the_jerk_limits_and_every_episode_begins_at_rest(arm, action):
    env = armctl.envs.ArmEnv(arm, action=action, ticks=1, horizon=1000)
    q = pushed(env)
    assert (np.abs(np.diff(q, axis=0)) <= 1.001 * arm.dt * arm.limits.v_max).all()
    assert (np.abs(np.diff(q, 2, axis=0)) <= 1.001 * arm.dt**2 * arm.limits.a_max).all()
    assert (np.abs(np.diff(q, 3, axis=0)) <= 1.001 * arm.dt**3 * arm.limits.j_max).all()
    assert q[-1] == pytest.approx(env.batch.rows.target[0], abs=1e-9)
    assert np.array_equal(q, pushed(env))
    other = pushed(armctl.envs.ArmEnv(arm, action=action.removesuffix("_smooth"), ticks=1, horizon=1000))
    assert (np.abs(np.diff(other, 3, axis=0)) > 10 * arm.dt**3 * arm.limits.j_max).any()


def test_an_arm_whose_jerk_limits_would_delay_smooth_actions_by_seconds_is_refused(arm):
    slow = arm.with_limits(replace(arm.limits, j_max=arm.limits.a_max / 10))
    with pytest.raises(armctl.InputError, match="j_max: smooth actions would be averaged over 20 s; the most is 10 s"):
        armctl.envs.ArmEnv(slow, action="joint_delta_smooth")


def test_the_seed_decides_everything(arm):
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (5, arm.n))
    episodes = []
    for seed in (3, 3, 4):
        env = armctl.envs.ArmEnv(arm, action="joint_delta", randomize={"payload": armctl.Range(0.0, 0.2)})
        start, _ = env.reset(seed=seed)
        episodes.append(np.vstack([start, run(env, actions)]))
    assert np.array_equal(episodes[0], episodes[1])
    assert not np.allclose(episodes[0], episodes[2])


def test_a_batch_on_any_number_of_threads_is_its_single_environments(arm):
    options = {"action": "joint_delta", "randomize": {"payload": armctl.Range(0.0, 0.2)}, "horizon": 3}
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (7, 5, arm.n))
    batches = []
    for threads in (1, 3):
        env = armctl.envs.ArmVectorEnv(arm, num_envs=5, threads=threads, **options)
        env.reset(seed=10)
        batches.append(run(env, actions))
        env.close()
    assert np.array_equal(*batches)
    single = armctl.envs.ArmEnv(arm, **options)
    single.reset(seed=12)
    for step, action in enumerate(actions[:, 2]):
        observation, _, _, ended, _ = single.step(action)
        if ended:
            observation, _ = single.reset()
        assert np.array_equal(observation, batches[0][step, 2])


def test_the_last_observation_of_an_episode_is_kept(arm):
    env = gymnasium.make_vec("armctl.envs:armctl/ReachGoal-v0", num_envs=2, robot=arm, horizon=2)
    assert env.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.SAME_STEP
    first, _ = env.reset(seed=0)
    nothing = np.zeros(env.action_space.shape)
    env.step(nothing)
    observations, rewards, _, truncated, information = env.step(nothing)
    assert truncated.all()
    last = information["final_obs"][1]
    assert np.array_equal(last["desired_goal"], first["desired_goal"][1])
    assert not np.array_equal(observations["desired_goal"][1], last["desired_goal"])
    assert env.compute_reward(last["achieved_goal"], last["desired_goal"], {}) == rewards[1]


def test_contacts_are_simulated_where_they_are_asked_for():
    """A ball on a slide goes through a block, or is stopped by it."""
    slide = '<body name="slider" pos="0 0 0.3"><joint name="x" type="slide" axis="1 0 0" range="-1 1" damping="1"/>'
    slide += '<geom size="0.02" mass="1"/><site name="tip"/></body>'
    block = '<body name="block" pos="0.5 0 0.3"><geom type="box" size="0.02 0.2 0.2"/></body>'
    slider = armctl.load(mujoco.MjSpec.from_string(mjcf(slide + block, motors("x") + FAST)))
    ends = {}
    for contacts in (None, False, True):
        env = armctl.envs.ArmEnv(slider, action="joint_target", contacts=contacts)
        env.reset(seed=0)
        for _ in range(60):
            env.step(np.ones(1))
        ends[contacts] = env.batch.rows.q[0, 0]
    assert ends[None] == ends[False] > 0.6
    assert 0.4 < ends[True] < 0.5


@pytest.mark.parametrize("action", ["torque", "joint_delta"])
def test_a_varied_plant_moves_as_its_model_does(arm, action):
    """`mj_step` on the model of the plant, with the torques of the motors, reaches the same positions."""
    varied = {"payload": 0.15, "mass_scale": 1.1, "viscous_friction": 0.3}
    randomize = {name: armctl.Range(value, value + 1e-12) for name, value in varied.items()}
    env = armctl.envs.ArmEnv(arm, action=action, ticks=1, randomize=randomize)
    env.reset(seed=0)
    model = armctl.Plant(**varied).model(arm)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    data = mujoco.MjData(model)
    data.qpos[:] = arm.qpos(env.batch.rows.q[0])
    for push in np.random.default_rng(2).uniform(-1.0, 1.0, (40, arm.n)):
        env.step(push)
        data.ctrl[:] = env.batch.rows.simulated.data(0).ctrl
        mujoco.mj_step(model, data)
        assert data.qpos[arm.qpos_adr] == pytest.approx(env.batch.rows.q[0], abs=1e-9)


def test_wrong_arguments_are_explained(arm):
    for options in ({"action": "jump"}, {"randomize": {"wrench_delay": armctl.Range(0, 2)}}):
        with pytest.raises(armctl.InputError, match=next(iter(options))):
            armctl.envs.ArmEnv(arm, **options)


def test_targets_keep_away_from_stops_and_joints_without_stops_near_home(arm):
    limits = dataclasses.replace(arm.limits, q_min=np.array([-np.inf, -1.0, -2.0]), q_max=np.array([np.inf, 1.0, 2.0]))
    found = target_limits(arm.with_limits(limits))
    turn = 2.0 * np.pi * (1.0 - 2e-3)
    assert found.q_min == pytest.approx([arm.home[0] - turn, -0.998, -1.996])
    assert found.q_max == pytest.approx([arm.home[0] + turn, 0.998, 1.996])
    for what in ("v_max", "a_max", "j_max", "tau_max"):
        assert np.array_equal(getattr(found, what), getattr(limits, what))


@pytest.mark.parametrize("what", ["v_max", "a_max", "tau_max"])
def test_a_joint_without_a_limit_of_its_motion_is_refused(arm, what):
    limits = dataclasses.replace(arm.limits, **{what: np.full(arm.n, np.inf)})
    with pytest.raises(armctl.InputError, match=f"^{what}: .*finite limit of each joint"):
        armctl.envs.ArmEnv(arm.with_limits(limits))


@pytest.mark.parametrize("threads", [1, 2])
def test_closed_environments_make_no_step(arm, threads: int):
    envs = armctl.envs.ArmVectorEnv(arm, num_envs=2, threads=threads)
    envs.reset(seed=0)
    envs.close()
    with pytest.raises(armctl.InputError, match="step: the environments are closed"):
        envs.step(np.zeros(envs.action_space.shape))


def test_wrong_seeds_and_actions_are_explained(arm):
    env = armctl.envs.ArmVectorEnv(arm, num_envs=2)
    for seed in ("ab", 0.5, -1, [1], [1, 0.5]):
        with pytest.raises(armctl.InputError, match="seed"):
            env.reset(seed=seed)
    single = armctl.envs.ArmEnv(arm)
    for seed in ("ab", 0.5, -1, [[0]]):
        with pytest.raises(armctl.InputError, match="seed"):
            single.reset(seed=seed)
    for action in ("up", np.zeros(2), np.full(3, np.nan), ["a", "b", "c"]):
        with pytest.raises(armctl.InputError, match="action: expected"):
            single.step(action)


def test_the_mode_human_shows_each_step_to_the_viewer(arm, monkeypatch):
    shown = []

    class Page:
        def after_reset(self, data):
            shown.append(("reset", data.qpos.copy()))

        def before_run(self):
            pass

        def after_ticks(self, data, seconds):
            shown.append((seconds, data.qpos.copy()))

        def close(self):
            shown.append("closed")

    monkeypatch.setattr("armctl.view.viewer.Viewer", lambda *_, **__: Page())
    env = armctl.envs.ArmEnv(arm, render_mode="human")
    env.reset(seed=0)
    env.step(np.ones(env.action_space.shape))
    env.close()
    assert [each[0] for each in shown[:2]] == ["reset", env.batch.step_time]
    assert np.array_equal(shown[1][1][arm.qpos_adr], env.batch.rows.q[0])
    assert shown[2:] == ["closed"]
