"""All tasks: what Gymnasium asks, what is randomized, what counts, and experts that solve them."""

import contextlib
from dataclasses import replace

import mujoco
import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="pip install -e '.[envs]'")

import gymnasium
from gymnasium.utils.env_checker import check_env
from synthetic import arm_with_gripper, short_arm_with_jaw

import armctl
import armctl.envs
from armctl.envs.experts import planned
from armctl.envs.experts.expert import within_step
from armctl.envs.tasks.tabletop import find_table
from armctl.envs.tasks.tool import Tool, find_tool
from armctl.plan.ik.solve import solve_ik
from armctl.plan.motion.move_j import move_j
from armctl.plan.planner.move_free import move_free

ROBOT = "robot_arm_3dof"
RANGES = {
    "object_size": armctl.Range(0.8, 1.1),
    "object_mass": armctl.Range(0.05, 0.1),
    "encoder_noise": armctl.Range(1e-5, 1e-4),
    "delay": armctl.Range(0, 2),
}
TASKS = ("Reach", "ReachPast", "Track", "Push", "PickPlace")
ON_A_TABLE = ("Push", "PickPlace")


@pytest.fixture(scope="module")
def gripping(tmp_path_factory):
    return arm_with_gripper(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def make(gripping):
    """Environments by task, made once."""
    made = {}

    def of(task):
        if task not in made:
            robot = gripping if task in ON_A_TABLE else ROBOT
            made[task] = armctl.envs.ArmVectorEnv(robot, task, "joint_target", num_envs=3)
        return made[task]

    yield of
    for env in made.values():
        env.close()


@pytest.mark.filterwarnings("ignore:.*A Box observation space")
@pytest.mark.parametrize(
    ("name", "action"),
    [("ReachPast", "torque"), ("TrackGoal", "joint_delta"), ("PushGoal", "joint_target"), ("PickPlace", "cartesian_pose")],
)
def test_gymnasium_accepts_the_tasks(gripping, name, action):
    robot = gripping if name.removesuffix("Goal") in ON_A_TABLE else ROBOT
    env = gymnasium.make(f"armctl.envs:armctl/{name}-v0", robot=robot, action=action, horizon=5)
    check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.parametrize("task", TASKS)
def test_the_expert_solves_the_task(make, task):
    env = make(task)
    policy = armctl.envs.ExpertPolicy(env)
    env.reset(seed=0)
    for _ in range(env.batch.horizon):
        _, _, _, ended, information = env.step(policy())
        assert env.batch.arm.limits.contains(env.batch.rows.q)
    assert ended.all()
    assert information["is_success"].all()


@pytest.mark.parametrize("task", ON_A_TABLE)
def test_a_short_arm_with_a_long_tool_and_one_moving_jaw_tilts_it(tmp_path, task):
    env = armctl.envs.ArmVectorEnv(short_arm_with_jaw(tmp_path), task, "joint_target", num_envs=2)
    policy = armctl.envs.ExpertPolicy(env)
    env.reset(seed=0)
    table = env.batch.task.table
    assert table.tilt > 0.0
    for _ in range(env.batch.horizon):
        information = env.step(policy())[4]
        if information["is_success"].all():
            break
    assert information["is_success"].all()
    end = policy.experts[0].end
    rotation = table.pose(end).rotation
    assert (rotation @ table.tool.end)[2] == pytest.approx(-np.cos(table.tilt) * table.tool.overhang)
    if task == "PickPlace":
        assert np.linalg.norm(env.batch.task.grasp) > 0.005


@pytest.mark.parametrize("action", ["joint_delta", "cartesian_delta"])
def test_the_expert_acts_by_other_actions(action):
    env = armctl.envs.ArmEnv(ROBOT, "Reach", action)
    policy = armctl.envs.ExpertPolicy(env)
    env.reset(seed=1)
    successes = [env.step(policy())[4]["is_success"] for _ in range(env.batch.horizon)]
    assert successes[-1]


def test_without_a_plan_the_expert_moves_straight_into_the_obstacle():
    """The goal is inside the obstacle."""
    env = armctl.envs.ArmEnv(ROBOT, "ReachPast", "joint_target")
    policy = armctl.envs.ExpertPolicy(env)
    env.reset(seed=0)
    batch = env.batch
    batch.goal[0] = batch.obstacle[0]
    away = np.linalg.norm(batch.rows.tip[0, :3] - batch.goal[0])
    information = [env.step(policy())[4] for _ in range(batch.horizon - 1)]
    assert np.linalg.norm(batch.rows.tip[0, :3] - batch.goal[0]) < 0.5 * away
    assert any(each["touched"] for each in information)


def test_an_action_that_is_too_large_is_shortened_and_a_delta_keeps_its_direction():
    for action, wanted, possible in (
        ("joint_delta", [2.0, -4.0, 1.0], [0.5, -1.0, 0.25]),
        ("joint_delta", [0.2, -0.4, 0.1], [0.2, -0.4, 0.1]),
        ("joint_target", [2.0, -4.0, 0.1], [1.0, -1.0, 0.1]),
        ("cartesian_delta", [0.5, 2.0, 1.0], [0.25, 1.0, 0.5]),
    ):
        batch = armctl.envs.ArmEnv(ROBOT, "Reach", action).batch
        assert within_step(batch, np.array(wanted)).tolist() == possible


def test_the_expert_rejects_a_plan_that_touches_in_the_rehearsal(make, monkeypatch):
    def straight_at_first(arm, start, goal, *, seed):
        return move_free(arm, start, goal, seed=seed) if seed else move_j(arm, start, solve_ik(arm, goal, start).q)

    monkeypatch.setattr(planned, "move_free", straight_at_first)
    env = make("ReachPast")

    def touched():
        env.reset(seed=0)
        policy = armctl.envs.ExpertPolicy(env)
        return sum(env.step(policy())[4]["touched"] for _ in range(env.batch.horizon - 1))

    assert not touched().any()
    monkeypatch.setattr(planned.ReachPastExpert, "_solves", lambda *_: True)
    assert touched().all()


@pytest.mark.parametrize("action", ["joint_delta", "joint_target", "cartesian_delta", "cartesian_pose"])
def test_a_rehearsal_moves_the_references_as_a_step_does(action):
    env = armctl.envs.ArmEnv(ROBOT, "Reach", action)
    env.reset(seed=0)
    rows = env.batch.rows
    state = [array[0].copy() for array in (rows.target, rows._q_ref, rows._v_ref)]
    for each in np.random.default_rng(0).uniform(-1.0, 1.0, (3, 3)):
        rows.rehearse(each, *state)
        env.step(each)
        assert np.array_equal(state, [rows.target[0], rows._q_ref[0], rows._v_ref[0]])


@pytest.mark.parametrize("task", ["Track", "PickPlace"])
def test_a_seed_gives_the_same_bits_on_any_number_of_threads(gripping, task):
    robot = gripping if task in ON_A_TABLE else ROBOT
    ranges = RANGES if task in ON_A_TABLE else {name: RANGES[name] for name in ("encoder_noise", "delay")}
    seen = []
    for threads in (1, 3):
        env = armctl.envs.ArmVectorEnv(robot, task, "joint_delta", 3, threads, randomize=ranges, horizon=4)
        rng = np.random.default_rng(0)
        first, _ = env.reset(seed=5)
        steps = [env.step(rng.uniform(-1.0, 1.0, env.action_space.shape))[0] for _ in range(6)]
        seen.append([first, *steps])
        env.close()
    assert np.array_equal(*seen)


@pytest.mark.parametrize("task", TASKS)
def test_each_environment_of_several_is_the_single_one_with_its_seed(gripping, task):
    """Observations, rewards and ends, also in the episodes that follow; the noise and the delay differ in each episode."""
    robot = gripping if task in ON_A_TABLE else ROBOT
    ranges = RANGES if task in ON_A_TABLE else {name: RANGES[name] for name in ("encoder_noise", "delay")}
    options = {"randomize": ranges, "horizon": 3}
    envs = armctl.envs.ArmVectorEnv(robot, task, "joint_delta", 3, **options)
    observations, _ = envs.reset(seed=20)
    actions = np.random.default_rng(1).uniform(-1.0, 1.0, (7, *envs.action_space.shape))
    seen = [envs.step(each) for each in actions]
    envs.close()
    assert not np.array_equal(observations[0], observations[1])
    assert sum(bool(ended[1] or cut[1]) for _, _, ended, cut, _ in seen) >= 2
    with contextlib.closing(armctl.envs.ArmEnv(robot, task, "joint_delta", **options)) as env:
        assert np.array_equal(env.reset(seed=21)[0], observations[1])
        for action, (after, rewards, ended, cut, infos) in zip(actions[:, 1], seen, strict=True):
            observation, reward, is_ended, is_cut, _ = env.step(action)
            assert (reward, is_ended, is_cut) == (rewards[1], ended[1], cut[1])
            if is_ended or is_cut:
                assert np.array_equal(observation, infos["final_obs"][1])
                observation, _ = env.reset()
            assert np.array_equal(observation, after[1])


def test_a_touched_obstacle_costs_and_rules_success_out(make):
    env = make("ReachPast")
    env.reset(seed=0)
    batch = env.batch
    middles = [armctl.solve_ik(batch.arm, *where).q for where in zip(batch.obstacle.copy(), batch.rows.q.copy(), strict=True)]
    low, high = batch.rows.limits[:2]
    for _ in range(20):
        observation, reward, _, _, information = env.step(2.0 * (np.array(middles) - low) / (high - low) - 1.0)
        distance = information["distance"]
        assert reward == pytest.approx((distance < 0.02) - 5.0 * distance - information["touched"])
        goals = (batch.observer.achieved(observation), batch.observer.desired(observation))
        assert env.compute_reward(*goals, information) == pytest.approx(reward)
        assert env.compute_reward(*goals, [{"touched": each} for each in information["touched"]]) == pytest.approx(reward)
    assert information["touched"].any()
    assert not information["is_success"][batch.was_touched].any()


def test_a_varied_object_stands_on_the_table_and_has_its_mass(gripping):
    env = armctl.envs.ArmVectorEnv(gripping, "Push", "joint_delta", 3, randomize={k: RANGES[k] for k in list(RANGES)[:2]})
    env.reset(seed=0)
    for _ in range(4):
        env.step(np.zeros(env.action_space.shape))
    batch = env.batch
    top = batch.task.table.center[2]
    masses = set()
    for row in range(3):
        model = batch.rows.simulated.model(row)
        body = model.body("object")
        half = float(model.geom("object").size[1])
        assert batch.rows.object[row, 2] == pytest.approx(top + half, abs=1e-3)
        assert 0.05 <= float(body.mass[0]) <= 0.1
        masses.add(float(body.mass[0]))
    assert len(masses) == 3
    env.close()


def test_noise_is_observed_with_its_deviation_and_moves_nothing_by_itself():
    env = armctl.envs.ArmVectorEnv(ROBOT, "Track", "joint_delta", 40, randomize={"encoder_noise": armctl.Range(1e-3, 1.001e-3)})
    env.reset(seed=0)
    observations = [env.step(np.zeros(env.action_space.shape))[0] for _ in range(5)]
    n = env.batch.arm.n
    error = observations[-1][:, :n] - env.batch.rows.q
    assert error.std() == pytest.approx(1e-3, rel=0.25)
    env.close()


def test_a_goal_of_track_moves_with_the_velocity_that_is_observed(make):
    env = make("Track")
    columns = env.batch.observer.columns
    first, _ = env.reset(seed=0)
    second = env.step(np.zeros(env.action_space.shape))[0]
    moved = second[:, columns["goal"]] - first[:, columns["goal"]]
    assert moved == pytest.approx(env.batch.step_time * first[:, columns["goal_velocity"]], abs=1e-6)
    assert np.linalg.norm(moved, axis=1).min() > 0.0


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_tool_with_the_tip_at_its_joint_points_to_where_it_extends_farther(side):
    file = f"""<mujoco><worldbody><body name="link"><joint name="a" axis="0 1 0"/><geom size="0.03" mass="1"/>
      <body name="wrist" pos="0 0 0.3"><joint name="b" axis="0 0 1"/>
        <geom type="capsule" fromto="0 0 {-0.02 * side} 0 0 {0.1 * side}" size="0.01" mass="0.1"/>
      </body></body></worldbody><default><motor forcerange="-9 9"/></default>
      <actuator><motor joint="a"/><motor joint="b"/></actuator></mujoco>"""
    arm = armctl.load(mujoco.MjSpec.from_string(file), tip="wrist")
    data = mujoco.MjData(arm.model)
    mujoco.mj_kinematics(arm.model, data)
    tool = find_tool(arm, [data])
    assert (tool.axis, tool.sign) == ("z", side)
    assert tool.overhang == pytest.approx(0.11, abs=1e-6)


@pytest.mark.parametrize("axis", "xyz")
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_tool_that_points_down_is_turned_and_not_mirrored(axis, sign):
    tool = Tool(axis, sign, 0.1, 0.02)
    rotation = tool.rotation_down
    assert rotation @ rotation.T == pytest.approx(np.eye(3))
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert rotation @ tool.end == pytest.approx([0.0, 0.0, -0.1])


@pytest.mark.parametrize("turn", [1.0, -0.7])
def test_a_table_is_ahead_of_the_arm_wherever_its_home_looks(gripping, turn):
    arm = armctl.load(gripping)
    state = mujoco.MjData(arm.model)
    state.qpos[:] = arm.home_qpos
    mujoco.mj_forward(arm.model, state)
    tool = find_tool(arm, [state])
    headings = []
    for each in (arm, replace(arm, home=arm.home + turn * np.eye(arm.n)[0])):
        table, _ = next(find_table(each, tool, low=0.05, lift=0.05, margin=0.02, height=0.05, task="Push"))
        x, y = table.center[:2] - table.base
        headings.append(np.arctan2(y, x))
    assert headings[1] - headings[0] == pytest.approx(turn, abs=1e-6)


def test_over_the_table_no_joint_is_near_its_limits(gripping):
    arm = armctl.load(gripping)
    state = mujoco.MjData(arm.model)
    state.qpos[:] = arm.home_qpos
    mujoco.mj_forward(arm.model, state)
    tool = find_tool(arm, [state])

    def corners(arm: armctl.Arm) -> np.ndarray:
        _, found = next(find_table(arm, tool, low=0.05, lift=0.05, margin=0.02, height=0.05, task="Push"))
        return np.array(found)

    highest = corners(arm).max(axis=0)
    for joint in range(arm.n):
        q_max = np.where(np.arange(arm.n) == joint, highest + 0.03, arm.limits.q_max)
        near = arm.with_limits(replace(arm.limits, q_max=np.minimum(q_max, arm.limits.q_max)))
        with contextlib.suppress(armctl.InputError):  # there may be no other place
            assert (corners(near) <= near.limits.q_max - 0.05).all(), joint


def test_an_arm_that_does_not_fit_is_refused_in_one_sentence():
    for options, message in (
        ({"robot": ROBOT, "task": "PickPlace"}, "needs a gripper"),
        ({"robot": ROBOT, "task": "Push"}, "points down over a table"),
        ({"robot": armctl.load(ROBOT), "task": "ReachPast"}, "loaded already"),
        ({"robot": armctl.load(ROBOT), "load_options": {"tip": "link2"}}, "loaded already"),
        ({"robot": ROBOT, "load_options": {"scene": armctl.World()}}, "belongs to the task"),
        ({"robot": ROBOT, "task": "ReachPast", "contacts": False}, "contacts"),
        ({"robot": ROBOT, "randomize": {"object_mass": armctl.Range(1, 2)}}, "object_mass cannot vary"),
    ):
        with pytest.raises(armctl.InputError, match=message):
            armctl.envs.ArmEnv(**options)
    with pytest.raises(armctl.UnknownNameError, match="colour"):
        armctl.envs.ArmEnv(ROBOT, randomize={"colour": armctl.Range(1, 2)})
    with pytest.raises(armctl.InputError, match="torque"):
        armctl.envs.ExpertPolicy(armctl.envs.ArmEnv(ROBOT, action="torque"))
