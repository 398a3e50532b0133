"""Environments of an arm with several tips: each has its goal."""

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="pip install -e '.[envs]'")

from gymnasium.utils.env_checker import check_env
from synthetic import PAIR, mjcf, motors

import armctl
import armctl.envs

pytestmark = pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning", "ignore:.*A Box observation space")


@pytest.fixture(scope="module")
def pair(tmp_path_factory) -> armctl.Arm:
    path = tmp_path_factory.mktemp("pair") / "pair.xml"
    path.write_text(mjcf(PAIR, motors("a b c d e f")))
    return armctl.load(path, tips=["C", "F"])


def test_gymnasium_accepts_a_goal_for_each_tip(pair):
    env = armctl.envs.ArmEnv(pair, action="joint_delta", goal_conditioned=True)
    check_env(env, skip_render_check=True)
    assert env.observation_space["desired_goal"].shape == (6,)
    assert env.action_space.shape == (6,)


@pytest.mark.parametrize("task", ["Reach", "Track"])
def test_observations_have_both_tips_and_the_farther_one_counts(pair, task):
    env = armctl.envs.ArmVectorEnv(pair, task, "joint_delta", 2)
    env.reset(seed=0)
    observations, rewards, _, _, information = env.step(np.full((2, 6), 0.5))
    columns = env.batch.observer.columns
    for row in range(2):
        q = env.batch.rows.q[row]
        tips = np.concatenate([pair.fk(q, tip).position for tip in pair.tips])
        ways = (env.batch.goal[row] - tips).reshape(2, 3)
        assert np.allclose(observations[row, columns["tip"]], tips, atol=1e-6)
        assert np.allclose(observations[row, columns["to_goal"]], ways.ravel(), atol=1e-6)
        assert information["distance"][row] == pytest.approx(np.linalg.norm(ways, axis=1).max(), abs=1e-6)
        assert rewards[row] == pytest.approx(-5.0 * information["distance"][row], abs=1e-6)


def test_success_needs_both_tips(pair):
    batch = armctl.envs.ArmEnv(pair, action="joint_delta").batch
    goal = np.arange(6.0)
    there = goal + 0.01
    one = there + np.array([0, 0, 0, 0.05, 0, 0])
    _, success, _ = batch.task.reward(np.array([there, one]), np.array([goal, goal]), False, is_sparse=False)
    assert success.tolist() == [True, False]
    with pytest.raises(armctl.InputError, match=r"achieved_goal: expected three of each tip, \(\.\.\., 6\) m"):
        batch.reward(goal[:3], goal[:3], None)


@pytest.mark.parametrize("task", ["Reach", "Track"])
def test_the_expert_brings_both_tips_to_their_goals(pair, task):
    env = armctl.envs.ArmEnv(pair, task, "joint_delta")
    policy = armctl.envs.ExpertPolicy(env)
    env.reset(seed=1)
    information = {"is_success": False}
    for _ in range(env.batch.horizon):
        *_, information = env.step(policy())
    assert information["is_success"]


def test_a_goal_that_one_tip_cannot_reach_names_the_tip(pair):
    env = armctl.envs.ArmEnv(pair, action="joint_delta")
    near = env.batch.task.goals[0, 0].copy()
    env.reset(seed=0, options={"goal": near})
    observation, _ = env.reset(seed=0, options={"goal": {"F": near[3:], "C": near[:3]}})
    assert np.allclose(observation[env.batch.observer.columns["goal"]], near)
    with pytest.raises(armctl.InputError, match="there is none for F"):
        env.reset(seed=0, options={"goal": {"C": near[:3]}})
    with pytest.raises(armctl.UnknownNameError, match="unknown tip of pair 'f'"):
        env.reset(seed=0, options={"goal": {"C": near[:3], "f": near[3:]}})
    near[3:] = 9.0
    with pytest.raises(armctl.InputError, match=r"F is .* m away"):
        env.reset(seed=0, options={"goal": near})


@pytest.mark.parametrize("action", ["joint_delta", "cartesian_delta"])
def test_what_is_for_one_tip_says_so(action, tmp_path):
    path = tmp_path / "pair.xml"
    path.write_text(mjcf(PAIR, motors("a b c d e f")))
    for task in ("ReachPast", "Push"):
        with pytest.raises(armctl.InputError, match="it has the tips 'C', 'F', and a pose is for one; load it with tip='C'"):
            armctl.envs.ArmEnv(path, task, action, load_options={"tips": ["C", "F"]})
