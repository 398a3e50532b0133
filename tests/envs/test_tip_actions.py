"""Cartesian actions of arms with several tips: each tip has its block, and all are solved for together."""

from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
from arms import MISSING, at_hand, some_of
from gymnasium.utils.env_checker import check_env
from scipy.spatial.transform import Rotation
from synthetic import BENT, PAIR, limb, mjcf, motors, serial_arm

import armctl
import armctl.envs
from armctl.model.collision.checkers import collision_checker

pytestmark = pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning", "ignore:.*A Box observation space")

LEFT = limb("a b c d e i", '<site name="left" pos="0.1 0.05 0"/>')
RIGHT = limb("f g h", '<site name="right" pos="0.1 0 0"/>').replace('pos="0.1 0 0.1"', 'pos="-0.2 -0.3 0.1"', 1)
TORSO_HOME = '<keyframe><key name="home" qpos="0.7 0.9 -0.2 1.2 0 -0.7 0.6 -0.6 0.3 0.4"/></keyframe>'
TORSO = mjcf(limb("torso", LEFT + RIGHT), motors("torso a b c d e i f g h") + TORSO_HOME)
BESIDE = PAIR.replace('contype="0" conaffinity="0"', "").replace('pos="-0.5 0 0.1"', 'pos="0.1 0.25 0.1"')
TOUCHING_PAIR = mjcf(BESIDE, motors("a b c d e f"))
CLOSED_LOOPS = Path(__file__).parents[2] / "examples/models/parallel_link_arm.xml"
CARTESIAN = ("cartesian_delta", "cartesian_pose")
LENGTHS = {"cartesian_delta": (0.025, 0.1), "cartesian_pose": (0.5, 1.0)}  # m and rad of a full action
ARMS = {
    "one tip": lambda folder: serial_arm(folder, BENT["six joints"]),
    "two arms": lambda _: armctl.load(mujoco.MjSpec.from_string(mjcf(PAIR, motors("a b c d e f"))), tips=["C", "F"]),
    "a torso": lambda _: armctl.load(mujoco.MjSpec.from_string(TORSO), tips=["left", "right"]),
    "closed loops": lambda _: armctl.load(CLOSED_LOOPS, tips=["suction_cup", "upper_arm"]),
}
SIZES = {"one tip": [6], "two arms": [3, 3], "a torso": [6, 3], "closed loops": [3, 3]}


@pytest.fixture(scope="module", params=ARMS)
def named_arm(request, tmp_path_factory):
    return request.param, ARMS[request.param](tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def torso():
    return ARMS["a torso"](None)


@pytest.fixture(scope="module")
def pair():
    return ARMS["two arms"](None)


def moved(pose, block, lengths):
    """Position and rotation of a pose moved by the block of a tip."""
    turn = Rotation.from_rotvec(lengths[1] * block[3:]) if len(block) == 6 else Rotation.identity()
    return pose.position + lengths[0] * block[:3], turn * Rotation.from_matrix(pose.rotation)


def blocks_of(action, sizes):
    return np.split(action, np.cumsum(sizes)[:-1])


def solved_by_hand(batch, action, sizes):
    """The joint targets after an action: damped least squares over the errors of all tips, by NumPy."""
    arm = batch.arm
    low, high, speed = batch.rows.limits[:3]
    start = batch.rows.target[0].copy()
    origin = arm.home if batch.action == "cartesian_pose" else start
    blocks = dict(zip(arm.tips, blocks_of(action, sizes), strict=True))
    goals = {tip: moved(arm.fk(origin, tip), block, LENGTHS[batch.action]) for tip, block in blocks.items()}
    q = start.copy()
    for _ in range(4):
        errors = []
        jacobians = []
        for tip, (position, rotation) in goals.items():
            pose = arm.fk(q, tip)
            turn = (rotation * Rotation.from_matrix(pose.rotation).inv()).as_rotvec()
            errors.append(np.concatenate([position - pose.position, turn])[: len(blocks[tip])])
            jacobians.append(arm.jacobian(q, tip)[: len(blocks[tip])])
        error = np.concatenate(errors)
        if error @ error < 1e-10:
            break
        J = np.concatenate(jacobians)
        q = q + J.T @ np.linalg.solve(J @ J.T + 1e-4 * np.eye(len(J)), error)
        way = batch.step_time * speed
        q = np.clip(np.clip(q, start - way, start + way), low, high)
    return q


@pytest.mark.parametrize("action", CARTESIAN)
@pytest.mark.parametrize("ticks", [2, 25])
def test_targets_are_those_of_least_squares_over_all_tips(named_arm, action, ticks):
    name, arm = named_arm
    env = armctl.envs.ArmEnv(arm, action=action, ticks=ticks)
    assert env.batch.rows.tip_sizes == SIZES[name]
    assert env.action_space.shape == (sum(SIZES[name]),)
    env.reset(seed=4)
    rng = np.random.default_rng(4)
    limited = 0
    total = 0.0
    for _ in range(25):
        given = rng.uniform(-1.0, 1.0, env.action_space.shape)
        expected = solved_by_hand(env.batch, given, SIZES[name])
        before = env.batch.rows.target[0].copy()
        env.step(given)
        way = np.abs(env.batch.rows.target[0] - before)
        assert env.batch.rows.target[0] == pytest.approx(expected, abs=1e-7)
        total += way.max()
        limited += (way > (1.0 - 1e-9) * env.batch.step_time * arm.limits.v_max).any()
    assert total > 0.01
    assert limited > 0 or ticks == 25


@pytest.mark.parametrize("action", CARTESIAN)
def test_each_tip_moves_by_its_lengths_and_angles(torso, action):
    env = armctl.envs.ArmEnv(torso, action=action, ticks=200)  # so long that speed limits do not bind
    env.reset(seed=2)
    lengths = LENGTHS[action]
    given = np.random.default_rng(2).uniform(-1.0, 1.0, 9) * (0.3 if action == "cartesian_delta" else 0.03)
    start = env.batch.rows.target[0].copy() if action == "cartesian_delta" else torso.home
    env.step(given)
    for tip, block in zip(torso.tips, blocks_of(given, [6, 3]), strict=True):
        position, rotation = moved(torso.fk(start, tip), block, lengths)
        pose = torso.fk(env.batch.rows.target[0], tip)
        assert pose.position == pytest.approx(position, abs=2e-4)
        if len(block) == 6:
            assert (Rotation.from_matrix(pose.rotation) * rotation.inv()).magnitude() < 2e-3


@pytest.mark.parametrize("which", [0, 1])
def test_a_tip_without_a_delta_stays_while_another_one_moves_with_the_torso(torso, which):
    """The joints that would move one tip alone, the torso among them, would move the other one too."""
    env = armctl.envs.ArmEnv(torso, ticks=200)
    env.reset(seed=0)
    rng = np.random.default_rng(which)
    size = env.batch.rows.tip_sizes[which]
    moving, staying = torso.tips if which == 0 else reversed(torso.tips)
    alone = 0.0
    together = 0.0
    for _ in range(10):
        block = rng.uniform(-1.0, 1.0, size)
        before = env.batch.rows.target[0].copy()
        env.step(np.concatenate([block, np.zeros(3)] if which == 0 else [np.zeros(6), block]))
        after = env.batch.rows.target[0]
        twist = block * np.repeat(LENGTHS["cartesian_delta"], 3)[:size]
        turns = np.linalg.pinv(torso.jacobian(before, moving)[:size]) @ twist
        alone += np.linalg.norm(torso.jacobian(before, staying)[:3] @ turns)
        together += np.linalg.norm(torso.fk(after, staying).position - torso.fk(before, staying).position)
        way = torso.fk(after, moving).position - torso.fk(before, moving).position
        assert way == pytest.approx(twist[:3], abs=2e-4)
    assert alone > 0.02
    assert together < 0.01 * alone


def test_nothing_moves_where_all_blocks_are_zero(torso):
    env = armctl.envs.ArmEnv(torso)
    env.reset(seed=0)
    before = env.batch.rows.target[0].copy()
    for _ in range(5):
        env.step(np.zeros(9))
    assert np.array_equal(env.batch.rows.target[0], before)


def straight(batch):
    """The action that moves each tip of the targets to its goal, and turns it as it is at a solution of all goals."""
    goal_q = batch.task.goal_q[batch.goal_number[0]]
    target = batch.rows.target[0]
    parts = []
    for tip, size, goal in zip(batch.arm.tips, batch.rows.tip_sizes, batch.goal[0].reshape(-1, 3), strict=True):
        now = batch.arm.fk(target, tip)
        parts.append((goal - now.position) / 0.025)
        if size == 6:
            wanted = Rotation.from_matrix(batch.arm.fk(goal_q, tip).rotation)
            parts.append((wanted * Rotation.from_matrix(now.rotation).inv()).as_rotvec() / 0.1)
    return np.concatenate([part / max(1.0, np.abs(part).max()) for part in parts])


@pytest.mark.parametrize("action", ["cartesian_delta", "cartesian_delta_smooth"])
@pytest.mark.parametrize("robot", some_of(["two arms", "a torso", "aloha"], ["two arms", "a torso"], ["aloha"]))
def test_a_policy_that_moves_straight_to_its_goals_reaches_them(robot, action):
    if robot not in ARMS and not at_hand(robot):
        pytest.skip(f"{robot}: {MISSING}")
    env = armctl.envs.ArmEnv(ARMS[robot](None) if robot in ARMS else robot, "Reach", action)
    for seed in range(5):
        env.reset(seed=seed)
        for _ in range(env.batch.horizon):
            information = env.step(straight(env.batch))[4]
        assert information["is_success"], seed


@pytest.mark.parametrize("task", ["Reach", "Track"])
@pytest.mark.parametrize("robot", ["two arms", "a torso"])
def test_the_expert_acts_by_blocks(robot, task):
    env = armctl.envs.ArmEnv(ARMS[robot](None), task, "cartesian_delta")
    policy = armctl.envs.ExpertPolicy(env)
    for seed in range(3):
        env.reset(seed=seed)
        for _ in range(env.batch.horizon):
            given = policy()
            assert np.abs(given).max() <= 1.0
            information = env.step(given)[4]
        assert information["is_success"], seed


@pytest.mark.parametrize("action", ["cartesian_delta", "cartesian_pose", "cartesian_delta_smooth"])
def test_a_batch_on_two_threads_is_single_environments(torso, action):
    envs = armctl.envs.ArmVectorEnv(torso, action=action, num_envs=3, threads=2)
    envs.reset(seed=6)
    singles = [armctl.envs.ArmEnv(torso, action=action) for _ in range(3)]
    for k, env in enumerate(singles):
        env.reset(seed=6 + k)
    for given in np.random.default_rng(0).uniform(-1.0, 1.0, (10, 3, 9)).astype(np.float32):
        observations = envs.step(given)[0]
        for env, row, own in zip(singles, observations, given, strict=True):
            assert np.array_equal(env.step(own)[0], row)
    envs.close()


def test_gymnasium_makes_and_checks_environments_of_two_arms(pair):
    env = gymnasium.make("armctl.envs:armctl/Reach-v0", robot=pair, action="cartesian_delta")
    check_env(env.unwrapped, skip_render_check=True)
    assert env.action_space.shape == (6,)
    assert env.unwrapped.batch.action_names == ["C/x", "C/y", "C/z", "F/x", "F/y", "F/z"]
    envs = gymnasium.make_vec("armctl.envs:armctl/ReachGoal-v0", num_envs=2, robot=pair)
    assert envs.action_space.shape == (2, 6)
    envs.close()


def test_the_numbers_of_one_tip_and_of_joints_have_plain_names(pair, tmp_path):
    one = armctl.envs.ArmEnv(serial_arm(tmp_path, BENT["six joints"]))
    assert one.batch.action_names == ["x", "y", "z", "rotation_x", "rotation_y", "rotation_z"]
    assert armctl.envs.ArmEnv(pair, action="joint_delta").batch.action_names == list(pair.joint_names)


def test_an_action_of_another_shape_is_refused_with_the_numbers_of_each_tip(torso):
    env = armctl.envs.ArmEnv(torso)
    env.reset(seed=0)
    blocks = "it has 6 numbers for left and 3 numbers for right"
    with pytest.raises(armctl.InputError, match=rf"action: expected shape \(9,\), got \(6,\); {blocks}$"):
        env.step(np.zeros(6))
    envs = armctl.envs.ArmVectorEnv(torso, num_envs=2)
    envs.reset(seed=0)
    with pytest.raises(armctl.InputError, match=rf"action: expected shape \(2, 9\), got \(9,\); {blocks}$"):
        envs.step(np.zeros(9))
    with pytest.raises(armctl.InputError, match=r"action: expected shape \(10,\), got \(2,\)$"):
        armctl.envs.ArmEnv(torso, action="torque").step(np.zeros(2))
    for wrong, message in ((np.full(9, np.nan), "action: expected numbers"), (np.full(9, 25.0), "action: 25 is far outside")):
        with pytest.raises(armctl.InputError, match=message):
            env.step(wrong)


@pytest.mark.parametrize("tips", [["C", "F"], ["C", "F", "B", "E"]], ids=["as many numbers as joints", "more"])
def test_two_arms_that_would_touch_do_not_with_a_gate(tips):
    arm = armctl.load(mujoco.MjSpec.from_string(TOUCHING_PAIR), tips=tips)
    checker = collision_checker(arm)
    refused = 0
    touched = {False: 0, True: 0}
    for gate in (False, True):
        env = armctl.envs.ArmEnv(arm, gate=gate)
        env.reset(seed=0)
        for _ in range(40):
            target = env.batch.rows.target[0]
            way = arm.fk(target, "C").position - arm.fk(target, "F").position
            block = way / np.linalg.norm(way)
            information = env.step(np.concatenate([-block, block] * (len(tips) // 2)))[4]
            touched[gate] += bool(checker.at(env.batch.rows.reference(0)[0]))
            if gate and information["refusal"]:
                refused += 1
                assert not env.batch.rows.action.any()
    assert touched[False] > 0
    assert touched[True] == 0
    assert refused > 0
