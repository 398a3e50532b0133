"""Options of `reset`: goal and start of an episode can be set, and everything else is refused."""

import mujoco
import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="pip install -e '.[envs]'")

import gymnasium

import armctl
from armctl.envs import ArmEnv, ArmVectorEnv

GOAL = [0.3, 0.2, 0.3]
START = [0.1, 0.2, -0.3]


@pytest.mark.parametrize("task", ["Reach", "ReachPast"])
def test_the_goal_is_set_and_the_reward_is_that_of_it(task):
    env = ArmEnv("robot_arm_3dof", task, goal_conditioned=True)
    observation, _ = env.reset(seed=3, options={"goal": GOAL})
    assert observation["desired_goal"] == pytest.approx(GOAL, abs=1e-6)
    for _ in range(3):
        observation, reward, *_, info = env.step(np.zeros(env.action_space.shape))
        assert observation["desired_goal"] == pytest.approx(GOAL, abs=1e-6)
        assert reward == pytest.approx(env.compute_reward(observation["achieved_goal"], np.array(GOAL), info), abs=1e-6)
        assert info["distance"] == pytest.approx(np.linalg.norm(observation["achieved_goal"] - GOAL), abs=1e-6)
    again, _ = env.reset(seed=3)
    drawn, _ = ArmEnv("robot_arm_3dof", task, goal_conditioned=True).reset(seed=3)
    assert all(np.array_equal(again[name], drawn[name]) for name in drawn)


def test_the_start_is_set():
    env = ArmEnv("robot_arm_3dof", goal_conditioned=True)
    observation, _ = env.reset(seed=3, options={"start": START, "goal": GOAL})
    arm = env.batch.arm
    assert observation["observation"][: arm.n] == pytest.approx(START, abs=1e-6)
    assert observation["achieved_goal"] == pytest.approx(arm.fk(START).position, abs=1e-6)
    assert env.batch.rows.simulated.data(0).qpos[arm.qpos_adr] == pytest.approx(START)


def test_a_vector_takes_one_for_all_or_one_for_each_and_the_next_episodes_are_drawn():
    env = ArmVectorEnv("robot_arm_3dof", num_envs=2, horizon=2, goal_conditioned=True)
    observations, _ = env.reset(seed=0, options={"goal": GOAL, "start": START})
    assert observations["desired_goal"] == pytest.approx(np.array([GOAL, GOAL]), abs=1e-6)
    goals = [GOAL, [0.25, -0.2, 0.35]]
    starts = [START, [0.0, 0.1, -0.2]]
    observations, _ = env.reset(seed=0, options={"goal": goals, "start": starts})
    assert observations["desired_goal"] == pytest.approx(np.array(goals), abs=1e-6)
    assert observations["observation"][:, :3] == pytest.approx(np.array(starts), abs=1e-6)
    for _ in range(2):
        observations, *_ = env.step(np.zeros(env.action_space.shape))
    assert (np.linalg.norm(observations["desired_goal"] - goals, axis=1) > 1e-3).all()


def test_each_episode_draws_its_goal_from_a_region():
    side = [[-0.05, 0.05]] * 3 + [[0, 0]] * 3
    far = armctl.Region([3.0, 0.0, 0.0], side)
    region = armctl.Region(GOAL, side)
    env = ArmVectorEnv("robot_arm_3dof", num_envs=4, goal_conditioned=True)
    goals = [env.reset(seed=seed, options={"goal": region | far})[0]["desired_goal"] for seed in (0, 0, 7)]
    assert np.array_equal(goals[0], goals[1])
    assert len({*map(bytes, goals[0]), *map(bytes, goals[2])}) == 8
    assert (np.abs(np.concatenate(goals) - GOAL) <= 0.05 + 1e-6).all()
    with pytest.raises(armctl.InputError, match="reaches none of 20 random positions of the region"):
        env.reset(options={"goal": far})


def test_it_works_through_gymnasium():
    env = gymnasium.make("armctl.envs:armctl/ReachGoal-v0", robot="robot_arm_3dof")
    observation, _ = env.reset(seed=0, options={"goal": np.array(GOAL)})
    assert observation["desired_goal"] == pytest.approx(GOAL, abs=1e-6)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"q": START}, "options: 'q' is not known; expected goal or start"),
        ({"unknown": 1}, "options: 'unknown' is not known"),
        ({"goal": GOAL, "seed": 3}, "options: 'seed' is not known"),
        ({"goal": [1.0, 2.0]}, "options: goal: expected 3 numbers"),
        ({"goal": [0.3, np.nan, 0.3]}, "options: goal: element"),
        ({"goal": [3.0, 0.0, 0.0]}, "options: goal: .*out of reach"),
        ({"goal": [GOAL, GOAL]}, "options: goal: 2 rows given for 1 environments"),
        ({"start": [9.0, 0.0, 0.0]}, "options: start: .* is outside .*degrees"),
        ({"start": [0.0, 0.0]}, "options: start: expected 3 numbers"),
        ("goal", "options: expected Mapping"),
        ([GOAL], "options: expected Mapping"),
    ],
)
def test_everything_else_is_refused(options, sentence):
    env = ArmEnv("robot_arm_3dof")
    with pytest.raises(armctl.InputError, match=sentence):
        env.reset(seed=3, options=options)


def test_a_start_that_touches_something_is_refused():
    """MuJoCo counts the contacts of random starts."""
    env = ArmEnv("robot_arm_3dof")
    arm = env.batch.arm
    data = mujoco.MjData(arm.model)
    refused = 0
    for q in arm.limits.random(arm.home, 30, np.random.default_rng(4)):
        data.qpos[:] = arm.qpos(q)
        mujoco.mj_forward(arm.model, data)
        if data.ncon == 0:
            env.reset(seed=0, options={"start": q})
        else:
            refused += 1
            with pytest.raises(armctl.InputError, match=r"options: start: .* touches "):
                env.reset(seed=0, options={"start": q})
    assert 0 < refused < 30


def test_a_goal_that_moves_cannot_be_set():
    with pytest.raises(armctl.InputError, match="options: goal: that of Track moves"):
        ArmEnv("robot_arm_3dof", "Track").reset(options={"goal": GOAL})


def test_an_action_in_degrees_is_refused_and_one_a_little_outside_counts_as_its_end():
    env = ArmEnv("robot_arm_3dof", action="joint_target")
    env.reset(seed=0)
    with pytest.raises(armctl.InputError, match=r"action: 90 is far outside \[-1, 1\]; degrees\?"):
        env.step(np.array([90.0, 0.0, -45.0]))
    env.step(np.array([1.5, -2.0, 3.0]))
    other = ArmEnv("robot_arm_3dof", action="joint_target")
    other.reset(seed=0)
    other.step(np.array([1.0, -1.0, 1.0]))
    assert np.array_equal(env.batch.rows.target, other.batch.rows.target)
