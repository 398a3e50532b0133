"""Environments of the task Reach: limits, seeds, threads, and what Gymnasium asks of an environment."""

import os
import subprocess
import sys

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from synthetic import FAST, limb, mjcf, motors

import armctl
import armctl.envs
from armctl.envs.plants import FreePlants
from armctl.envs.step_kernel import EVERYTHING, GEOMETRY, NOTHING
from armctl.robot.dynamics_kernel import DRIVE_COLUMNS, FRICTION_GAIN
from armctl.sim.free_space import FreeSpace

ROBOT = "robot_arm_3dof"
ACTIONS = ("torque", "joint_delta", "joint_target", "cartesian_delta", "cartesian_pose")


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


@pytest.mark.parametrize("free_space", [True, False])
@pytest.mark.parametrize("action", ACTIONS)
def test_joint_limits_hold_whatever_the_policy_does(arm, action, free_space):
    env = armctl.envs.ArmEnv(arm, action=action, free_space=free_space)
    env.reset(seed=0)
    size = env.action_space.shape[0]
    pushes = np.sign(np.random.default_rng(1).uniform(-1.0, 1.0, (8, size)))
    for push in np.repeat(pushes, 12, axis=0):
        env.step(push)
        assert arm.limits.contains(env.batch.rows.q)


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


VARIED = {
    "payload": armctl.Range(0.1, 0.2),
    "mass_scale": armctl.Range(0.9, 1.1),
    "viscous_friction": armctl.Range(0.1, 0.5),
}


@pytest.mark.parametrize("action", ["torque", "joint_delta"])
@pytest.mark.parametrize("randomize", [None, {"payload": VARIED["payload"]}, VARIED], ids=["nominal", "payload", "varied"])
def test_dynamics_that_controller_and_plant_share_make_the_same_motion(arm, monkeypatch, action, randomize):
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (5, 4, arm.n))
    seen = []
    for shares in (EVERYTHING if randomize is None else GEOMETRY, NOTHING):
        if shares == NOTHING:
            monkeypatch.setattr("armctl.envs.rows.Rows._computes_with_nominal", lambda *_: False)
        env = armctl.envs.ArmVectorEnv(arm, action=action, num_envs=4, randomize=randomize)
        env.reset(seed=10)
        seen.append(run(env, actions))
        assert (env.batch.rows._shared == shares).all()
    assert seen[0] == pytest.approx(seen[1], abs=1e-6)


def test_only_controllers_that_know_the_positions_and_the_model_share_dynamics(arm):
    for options, shares in (
        ({}, EVERYTHING),
        ({"controller": "pd-gravity"}, NOTHING),
        ({"controller": "computed-torque-textbook"}, NOTHING),
        ({"randomize": {"payload": armctl.Range(0.1, 0.2)}}, GEOMETRY),
        ({"randomize": {"encoder_noise": armctl.Range(0.0, 1e-4)}}, NOTHING),
    ):
        env = armctl.envs.ArmEnv(arm, action="joint_delta", **options)
        env.reset(seed=0)
        assert env.batch.rows._shared == shares


def test_steps_without_collision_detection_have_the_same_bits(arm, monkeypatch):
    options = {"action": "joint_delta", "free_space": False, "randomize": {"payload": armctl.Range(0.0, 0.2)}, "horizon": 4}
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (10, 4, arm.n))
    seen = []
    for threads, least_steps in ((1, 10**9), (2, 1)):
        monkeypatch.setattr("armctl.envs.simulated_arms._MIN_SKIP_STEPS", least_steps)
        monkeypatch.setattr("armctl.collision.free_boxes._MIN_STEPS", least_steps)
        env = armctl.envs.ArmVectorEnv(arm, num_envs=4, threads=threads, **options)
        env.reset(seed=10)
        seen.append(run(env, actions))
        skipped = env.batch.rows.simulated.skipped
        assert (skipped > 0) == (threads == 2)
        env.close()
    assert np.array_equal(*seen)


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


@pytest.mark.parametrize("lifted", [0.0, 0.6])
def test_a_varied_plant_has_the_dynamics_of_its_model(lifted):
    robot = mjcf(limb("a b c", joint='damping="0.1"').replace("<body", f'<body gravcomp="{lifted}"'), motors("a b c") + FAST)
    arm = armctl.load(mujoco.MjSpec.from_string(robot))

    def without_friction(found):
        drives = len(found) - arm.n * (DRIVE_COLUMNS + arm.n)
        found[drives + FRICTION_GAIN :: DRIVE_COLUMNS][: arm.n] = 0.0  # of dry friction, which there is none of
        return found

    plant = armctl.Plant(payload=0.3, mass_scale=1.2, viscous_friction=0.4)
    model = plant.model(arm)
    expected = FreeSpace(arm, model, mujoco.MjData(model)).vector
    varied = FreePlants(arm).of(plant).vector
    assert without_friction(varied) == pytest.approx(without_friction(expected), rel=1e-9, abs=1e-12)


def test_wrong_arguments_are_explained(arm):
    for options in ({"action": "jump"}, {"randomize": {"torque_ripple": armctl.Range(0, 2)}}):
        with pytest.raises(armctl.InputError, match=next(iter(options))):
            armctl.envs.ArmEnv(arm, **options)


def test_wrong_seeds_and_actions_are_explained(arm):
    env = armctl.envs.ArmVectorEnv(arm, num_envs=2)
    for seed in ("ab", 0.5, -1, [1], [1, 0.5]):
        with pytest.raises(armctl.InputError, match="seed"):
            env.reset(seed=seed)
    single = armctl.envs.ArmEnv(arm)
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

    monkeypatch.setattr("armctl.viewer.viewer.Viewer", lambda *_, **__: Page())
    env = armctl.envs.ArmEnv(arm, render_mode="human")
    env.reset(seed=0)
    env.step(np.ones(env.action_space.shape))
    env.close()
    assert [each[0] for each in shown[:2]] == ["reset", env.batch.step_time]
    assert np.array_equal(shown[1][1][arm.qpos_adr], env.batch.rows.q[0])
    assert shown[2:] == ["closed"]
