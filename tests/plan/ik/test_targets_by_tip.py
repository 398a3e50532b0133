"""Targets by tip: inverse kinematics of two arms, of hands and of limbs that share a torso. MuJoCo and mink judge it."""

from dataclasses import replace

import mink
import mujoco
import numpy as np
import pytest
from arms import MISSING, at_hand, some_of
from synthetic import limb, mjcf, motors, ties

import armctl
from armctl import STAY, LookAt, Pose, RelativeTo

pytestmark = pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")

LEFT = limb("a b c p q r", '<site name="left" pos="0.1 0 0"/>')
RIGHT = limb("d e f g h i", '<site name="right" pos="0 0.1 0" euler="0.3 0 0"/>')
OPTION = '<option timestep="0.001" integrator="implicitfast"/>'
TORSO = mjcf(limb("torso", LEFT + RIGHT), motors("torso a b c p q r d e f g h i") + OPTION)
GUIDED = TORSO.replace(
    '<joint name="torso" axis="0 0 1" range="-2 2"', '<joint name="torso" type="slide" axis="1 0 0" range="-1 1"'
)
TIED = mjcf(limb("torso", LEFT + RIGHT), motors("torso a b c p q r d e f g h") + ties("i g 0.1 -0.5"))
ROBOTS = {
    "a torso": ["left", "right"],
    "on a guide": ["left", "right"],
    "with tied joints": ["left", "right"],
    "aloha": ["left/gripper", "right/gripper"],
    "wonik_allegro": ["ff_tip", "mf_tip", "rf_tip", "th_tip"],
}


def loaded(name):
    if text := {"a torso": TORSO, "on a guide": GUIDED, "with tied joints": TIED}.get(name):
        return armctl.load(mujoco.MjSpec.from_string(text), tips=ROBOTS[name])
    if not at_hand(name):
        pytest.skip(f"{name}: {MISSING}")
    return armctl.load(name, tips=ROBOTS[name])


@pytest.fixture(scope="module", params=some_of(ROBOTS, ["a torso", "on a guide", "with tied joints"]))
def arm(request):
    return loaded(request.param)


@pytest.fixture(scope="module")
def torso():
    return loaded("a torso")


def configurations(arm, count, seed=0):
    return arm.limits.random(arm.home, count, np.random.default_rng(seed))


def mujoco_pose(arm, q, tip):
    data = mujoco.MjData(arm.model)
    data.qpos[:] = arm.qpos(q)
    mujoco.mj_kinematics(arm.model, data)
    frame = arm.tip_frames[arm.tips.index(tip)]
    rotation = data.xmat[frame.body].reshape(3, 3)
    return data.xpos[frame.body] + rotation @ frame.T_body_tip.position, rotation @ frame.T_body_tip.rotation


def placed(position, rotation):
    return Pose.from_matrix(np.block([[rotation, position[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]]))


def gap(arm, q, tip, target):
    """Position and orientation error of a tip by MuJoCo's kinematics."""
    position, rotation = mujoco_pose(arm, q, tip)
    turn = np.arccos(np.clip(0.5 * (np.trace(rotation.T @ target.rotation) - 1.0), -1.0, 1.0))
    return np.linalg.norm(position - target.position), turn


def test_all_tips_reach_poses_that_can_be_reached(arm):
    """From random starts. The fingers of a hand have too few joints for poses: they get points."""
    by_point = arm.n < 6 * len(arm.tips) - 1
    goals = configurations(arm, 100, seed=1)
    starts = configurations(arm, 100, seed=2)
    solved = 0
    for goal, start in zip(goals, starts, strict=True):
        poses = {tip: arm.fk(goal, tip) for tip in arm.tips}
        targets = {tip: pose.position if by_point else pose for tip, pose in poses.items()}
        found = armctl.solve_ik(arm, targets, start)
        solved += found.ok
        assert ((found.q >= arm.limits.q_min) & (found.q <= arm.limits.q_max)).all()
        for tip, pose in poses.items():
            position, turn = gap(arm, found.q, tip, pose)
            assert found.tip_errors[tip][0] == pytest.approx(position, abs=1e-9)
            if found.ok:
                assert position < 1e-5
                assert by_point or turn < 1.1e-4
    assert solved >= 99


def test_the_same_call_gives_the_same_bits_and_is_near_its_start(arm):
    start = configurations(arm, 1, seed=3)[0]
    near = arm.limits.clamp(start + 0.03)
    targets = {tip: arm.fk(near, tip).position for tip in arm.tips}
    one, other = (armctl.solve_ik(arm, targets, start, seed=4) for _ in range(2))
    assert one
    assert one.q.tobytes() == other.q.tobytes()
    assert np.abs(one.q - start).max() < 0.3


def test_a_batch_of_targets_by_tip_gives_the_answers_of_single_calls(torso):
    left, right = torso.tips[:2]
    targets = [{left: torso.fk(q, left), right: torso.fk(q, right).position} for q in configurations(torso, 6)]
    batch = armctl.solve_ik_batch(torso, targets, threads=2)
    assert batch
    for target, found in zip(targets, batch, strict=True):
        assert np.array_equal(found.q, armctl.solve_ik(torso, target).q)
    starts = np.array(configurations(torso, 6, seed=1))
    for target, start, found in zip(targets, starts, armctl.solve_ik_batch(torso, targets, starts), strict=True):
        assert np.array_equal(found.q, armctl.solve_ik(torso, target, start).q)
    with pytest.raises(armctl.ArmctlError, match="elbow"):
        armctl.solve_ik_batch(torso, [*targets, {"elbow": [0.0, 0.0, 1.0]}])
    with pytest.raises(armctl.InputError):
        armctl.solve_ik_batch(torso, [targets[0], [0.1, 0.2, 0.3]])


def test_a_tip_without_target_is_free_and_an_arm_with_one_tip_takes_targets_by_tip_too(torso):
    target = torso.fk(configurations(torso, 1)[0], "right")
    found = armctl.solve_ik(torso, {"right": target})
    assert found
    assert gap(torso, found.q, "right", target)[0] < 1e-5
    one = armctl.load("robot_arm_3dof")
    point = one.fk(np.full(3, 0.3)).position
    assert armctl.solve_ik(one, {one.tip: point}).q == pytest.approx(armctl.solve_ik(one, point).q, abs=1e-4)


def test_targets_out_of_reach_are_told_apart_by_tip(torso):
    home = torso.home
    far = torso.fk(home, "left").position + np.array([0.0, 0.0, 5.0])
    found = armctl.solve_ik(torso, {"left": far, "right": torso.fk(home, "right")})
    assert not found
    assert found.reason.startswith("left is ")
    assert "right is " in found.reason
    stays = armctl.solve_ik(torso, {"left": far, "right": STAY})
    assert "right is there" in stays.reason
    position, turn = gap(torso, stays.q, "right", torso.fk(home, "right"))
    assert position < 1e-8
    assert turn < 1e-6


def test_the_best_approximation_is_a_minimum(torso):
    """No small change of the joints that keeps the one hand brings the other nearer."""
    start = 0.5 * configurations(torso, 1, seed=8)[0]
    far = torso.fk(start, "left").position + np.array([0.3, 0.4, 5.0])
    q = armctl.solve_ik(torso, {"left": far, "right": STAY}, start).q
    nearest = np.linalg.norm(torso.fk(q, "left").position - far)
    held = torso.fk(start, "right")
    J = torso.jacobian(q, "right")
    free = np.linalg.svd(J)[2][np.linalg.matrix_rank(J, tol=1e-6) :]
    rng = np.random.default_rng(0)
    for _ in range(200):
        other = torso.limits.clamp(q + 3e-4 * rng.normal(size=len(free)) @ free)
        if gap(torso, other, "right", held)[0] < 1e-6:
            assert np.linalg.norm(torso.fk(other, "left").position - far) > nearest - 1e-5


def test_a_relative_target_holds_before_one_in_the_world(torso):
    start = 0.5 * configurations(torso, 1, seed=9)[0]
    left, right = (torso.fk(start, tip) for tip in torso.tips)
    relative = left.inverse() @ right
    moved = torso.fk(start + 0.02, "left")
    found = armctl.solve_ik(torso, {"left": moved, "right": RelativeTo("left", relative)}, start)
    assert found
    assert gap(torso, found.q, "right", moved @ relative)[0] < 1e-5
    beyond = armctl.solve_ik(torso, {"left": [0.0, 0.0, 9.0], "right": RelativeTo("left", relative)}, start)
    assert "right is there" in beyond.reason
    position, rotation = mujoco_pose(torso, beyond.q, "left")
    assert gap(torso, beyond.q, "right", placed(position, rotation) @ relative)[0] < 1e-7


def test_a_tip_looks_at_a_point(torso):
    point = np.array([1.0, -0.4, 0.9])
    found = armctl.solve_ik(torso, {"right": LookAt(point), "left": torso.fk(torso.home, "left").position})
    assert found
    position, rotation = mujoco_pose(torso, found.q, "right")
    away = point - position
    assert rotation[:, 2] @ away / np.linalg.norm(away) == pytest.approx(1.0, abs=1e-8)


def test_the_center_of_mass_stays_over_a_polygon(torso):
    data = mujoco.MjData(torso.model)

    def center(q):
        data.qpos[:] = torso.qpos(q)
        mujoco.mj_kinematics(torso.model, data)
        mujoco.mj_comPos(torso.model, data)
        return data.subtree_com[torso.model.body_rootid[torso.tip_body], :2].copy()

    x, y = center(torso.home)
    square = np.array([[x - 0.02, y - 0.02], [x + 0.02, y - 0.02], [x + 0.02, y + 0.02], [x - 0.02, y + 0.02]])
    far = {"left": [2.0, 2.0, 0.5]}
    free = armctl.solve_ik(torso, far)
    assert np.abs(center(free.q) - [x, y]).max() > 0.05
    kept = armctl.solve_ik(torso, far, center_of_mass_within=square)
    assert np.abs(center(kept.q) - [x, y]).max() < 0.02 + 1e-6
    ik = armctl.DifferentialIk(torso, center_of_mass_within=square)
    q = torso.home
    for _ in range(1000):
        q = q + 0.005 * ik.step(q, far, 0.005)
        assert np.abs(center(q) - [x, y]).max() < 0.02 + 1e-4


def test_solutions_without_contact():
    """Two arms side by side: with their tips at the same place the links would touch."""
    link = '<geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03" mass="1"/>'

    def planar(side, y):
        hinge = '<joint name="{}" axis="0 0 1" range="-2.5 2.5"/>'
        outer = f'<geom type="capsule" fromto="0.08 0 0 0.4 0 0" size="0.03" mass="1"/><site name="{side}" pos="0.42 0 0"/>'
        inner = f'<body pos="0.4 0 0">{hinge.format(side + "2")}{outer}</body>'
        return f'<body name="base {side}" pos="0 {y} 0.2">{hinge.format(side + "1")}{link}{inner}</body>'

    text = mjcf(planar("l", 0.3) + planar("r", -0.3), motors("l1 l2 r1 r2"))
    arm = armctl.load(mujoco.MjSpec.from_string(text), tips=["l", "r"])
    data = mujoco.MjData(arm.model)
    for seed in range(10):
        q = configurations(arm, 1, seed=100 + seed)[0]
        targets = {tip: arm.fk(q, tip).position for tip in arm.tips}
        found = armctl.solve_ik(arm, targets, avoid=True)
        if found:
            data.qpos[:] = arm.qpos(found.q)
            mujoco.mj_forward(arm.model, data)
            assert not any(contact.dist < 0.0 for contact in data.contact)
        else:
            assert found.reason.startswith("no solution without contact found in 3") or "away" in found.reason


def free_limits(arm):
    """The arm without limits of speed and acceleration."""
    n = arm.n
    limits = arm.limits
    wide = armctl.Limits(limits.q_min, limits.q_max, np.full(n, 1e6), np.full(n, 1e9), np.full(n, 1e12), limits.tau_max)
    return arm.with_limits(wide)


class Rows(mink.Task):
    """A task of mink from rows that MuJoCo gives: error and Jacobian, (6 T,) and (6 T, nv)."""

    def __init__(self, error, J):
        super().__init__(cost=np.ones(len(error)), gain=1.0, lm_damping=0.0)
        self.error, self.J = error, J

    def compute_error(self, configuration):
        return -self.error

    def compute_jacobian(self, configuration):
        return self.J


class Square(mink.Task):
    """A cost on the step itself, (nv,) weights."""

    def __init__(self, weights):
        super().__init__(cost=np.sqrt(weights), gain=1.0, lm_damping=0.0)

    def compute_error(self, configuration):
        return np.zeros(len(self.cost))

    def compute_jacobian(self, configuration):
        return np.eye(len(self.cost))


REACH = 0.1 * np.sqrt(2.0) * 6 + 0.1  # m, of the torso: six links and the site


def rows_at(arm, q, goals):
    """Errors of tips and their Jacobian by MuJoCo, (6 T,) and (6 T, nv): lengths in reaches, angles with a third of a reach."""
    third = REACH / 3.0  # m per rad
    data = mujoco.MjData(arm.model)
    data.qpos[:] = arm.qpos(q)
    mujoco.mj_kinematics(arm.model, data)
    mujoco.mj_comPos(arm.model, data)
    error, jacobian = [], []
    for tip, goal in goals.items():
        position, rotation = mujoco_pose(arm, q, tip)
        J = np.zeros((6, arm.model.nv))
        mujoco.mj_jac(arm.model, data, J[:3], J[3:], position, arm.tip_frames[arm.tips.index(tip)].body)
        turn = np.zeros(3)
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, (goal.rotation @ rotation.T).ravel())
        mujoco.mju_quat2Vel(turn, quat, 1.0)
        error.append(np.concatenate([goal.position - position, third * turn]) / REACH)
        jacobian.append(np.concatenate([J[:3], third * J[3:]]) / REACH)
    return np.concatenate(error), np.concatenate(jacobian)


def curvature_bound(arm, q, goals):
    """(nv,) the sums of absolute values of the curvature of the tasks."""
    e = rows_at(arm, q, goals)[0]
    curvature = np.zeros((arm.model.nv, arm.model.nv))
    step = 1e-6
    for k in range(len(goals)):
        own = slice(6 * k, 6 * k + 6)
        for j in range(arm.n):
            moved = np.eye(arm.n)[j] * step
            change = (rows_at(arm, q + moved, goals)[1] - rows_at(arm, q - moved, goals)[1]) / (2 * step)
            curvature[arm.dof_adr[j]] += e[own] @ change[own]
    return np.abs(0.5 * (curvature + curvature.T)).sum(axis=1)


def test_a_step_is_the_optimum_of_minks_program(torso):
    """Without limits in the way: errors, Jacobians and their derivatives by MuJoCo, the program by mink."""
    arm = free_limits(torso)
    rng = np.random.default_rng(5)
    order = np.argsort(arm.dof_adr)
    for q in 0.5 * configurations(arm, 10, seed=6):
        other = arm.limits.clamp(q + 0.1 * rng.normal(size=arm.n))
        goals = {tip: arm.fk(other, tip) for tip in arm.tips}
        v = armctl.DifferentialIk(arm, posture_gain=0.0).step(q, goals, 1.0)
        configuration = mink.Configuration(arm.model, arm.qpos(q))
        tasks = [Rows(*rows_at(arm, q, goals)), Square(curvature_bound(arm, q, goals) + 1e-10)]
        expected = mink.solve_ik(configuration, tasks, 1.0, "daqp", damping=0.0, limits=[])
        assert v[order] == pytest.approx(expected, abs=1e-6)


def test_a_step_with_a_tip_that_stays_is_the_optimum_of_minks_program_with_an_equality(torso):
    """The goals are near: what keeps the tip on its curve changes a step by the square of its length."""
    arm = free_limits(torso)
    rng = np.random.default_rng(7)
    order = np.argsort(arm.dof_adr)
    for q in 0.5 * configurations(arm, 10, seed=8):
        other = arm.limits.clamp(q + 3e-5 * rng.normal(size=arm.n))
        goals = {"left": arm.fk(other, "left")}
        stays = {"right": arm.fk(q, "right")}
        v = armctl.DifferentialIk(arm, posture_gain=0.0).step(q, {**goals, "right": STAY}, 1.0)
        configuration = mink.Configuration(arm.model, arm.qpos(q))
        tasks = [Rows(*rows_at(arm, q, goals)), Square(curvature_bound(arm, q, goals) + 1e-10)]
        exact = [Rows(*rows_at(arm, q, stays))]
        expected = mink.solve_ik(configuration, tasks, 1.0, "daqp", damping=0.0, limits=[], constraints=exact)
        assert np.abs(expected).max() > 1e-5
        assert v[order] == pytest.approx(expected, abs=1e-6)


def violations(arm, q, v, v_before, dt):
    limits = arm.limits
    after = q + dt * v
    return (
        (np.abs(v) > limits.v_max).any(),
        (np.abs(v - v_before) > limits.a_max * dt * (1 + 1e-9)).any(),
        ((after < limits.q_min) | (after > limits.q_max)).any(),
    )


def test_steps_keep_all_limits_and_approach_their_targets(arm):
    rng = np.random.default_rng(7)
    ik = armctl.DifferentialIk(arm)
    q = arm.home
    v = np.zeros(arm.n)
    for round_number in range(8):
        goal = configurations(arm, 1, seed=rng.integers(1000))[0]
        scale = 1.0 if round_number % 2 else 3.0
        dt = [0.001, 0.002, 0.01, 0.02][round_number // 2]
        ik.reset(v)
        targets = {tip: scale * arm.fk(goal, tip).position for tip in arm.tips}
        missed = []
        for _ in range(int(3.0 / dt)):
            before = v
            v = ik.step(q, targets, dt)
            assert violations(arm, q, v, before, dt) == (False, False, False)
            q = q + dt * v
            missed.append(sum(np.linalg.norm(arm.fk(q, tip).position - target) ** 2 for tip, target in targets.items()))
        assert missed[-1] < min(missed) + 1e-3


def test_steps_arrive_and_there_is_no_drift_when_targets_come_back(torso):
    ik = armctl.DifferentialIk(torso)
    near = {tip: torso.fk(torso.limits.clamp(torso.home + 0.2), tip) for tip in torso.tips}
    far = {tip: Pose(4.0 * pose.position, quat=pose.quat) for tip, pose in near.items()}
    q = torso.home
    for targets, seconds in ((near, 3.0), (far, 3.0), (near, 4.0)):
        for _ in range(int(seconds / 0.004)):
            q = q + 0.004 * ik.step(q, targets, 0.004)
    for tip, pose in near.items():
        position, turn = gap(torso, q, tip, pose)
        assert position < 1e-6
        assert turn < 1e-5


def test_joints_leave_the_limits_that_they_are_at(torso):
    """A joint that was beyond its limit by less than a rounding stood still for ever."""
    near = {tip: torso.fk(torso.home, tip) for tip in torso.tips}
    for limit in (0.52, 0.9, 1.3):
        arm = torso.with_limits(replace(torso.limits, q_min=torso.home - limit, q_max=torso.home + limit))
        for i in range(arm.n):
            for rounding in range(-4, 20):
                ik = armctl.DifferentialIk(arm)
                q = np.array(arm.home)
                start = arm.limits.q_max[i]
                q[i] = start - rounding * np.spacing(start)
                for _ in range(5):
                    q = q + 0.005 * ik.step(q, near, 0.005)
                assert q[i] < start - 1e-6


def test_tips_that_stay_or_are_relative_hold_at_every_step(torso):
    home = torso.home
    left, right = (torso.fk(home, tip) for tip in torso.tips)
    relative = left.inverse() @ right
    for dt in (0.001, 0.01):
        ik = armctl.DifferentialIk(torso)
        q = home
        for k in range(int(2.0 / dt)):
            far = left.position + np.array([0.3 * np.sin(3 * k * dt), 0.0, 3.0])
            q = q + dt * ik.step(q, {"right": STAY, "left": far}, dt)
            assert gap(torso, q, "right", right)[0] < 1e-6
        ik.reset()
        q = home
        for k in range(int(2.0 / dt)):
            goal = Pose(left.position + 0.2 * np.array([np.sin(k * dt), np.sin(2 * k * dt), 0.0]), quat=left.quat)
            q = q + dt * ik.step(q, {"left": goal, "right": RelativeTo("left", relative)}, dt)
            position, rotation = mujoco_pose(torso, q, "left")
            assert gap(torso, q, "right", placed(position, rotation) @ relative)[0] < 1e-6
            assert ik.status == "solved"


def statuses_on_feet(seed, steps, period, way):
    """How steps of a humanoid end whose feet stay, with other targets of its hands each period; feet and limits are judged."""
    if not at_hand("unitree_h1"):
        pytest.skip(f"unitree_h1: {MISSING}")
    robot = armctl.load("unitree_h1", base="free")
    hands = {tip: robot.fk(robot.home, tip).position for tip in ("left_elbow_link", "right_elbow_link")}
    feet = {tip: robot.fk(robot.home, tip) for tip in ("left_ankle_link", "right_ankle_link")}
    rng = np.random.default_rng(seed)
    ik = armctl.DifferentialIk(robot)
    q = robot.home
    v = np.zeros(robot.n)
    found = []
    for k in range(steps):
        if k % period == 0:
            targets = {tip: place + way(rng) for tip, place in hands.items()} | dict.fromkeys(feet, STAY)
        before = v
        v = ik.step(q, targets, 0.005)
        found.append(ik.status)
        assert violations(robot, q, v, before, 0.005) == (False, False, False)
        q = q + 0.005 * v
        assert max(gap(robot, q, tip, pose)[0] for tip, pose in feet.items()) < 1e-6
    return found


@pytest.mark.parametrize("seed", [0, 10])
def test_feet_stay_where_legs_are_stretched(seed):
    """What holds a foot near a straight leg needs accelerations that grow faster than braking takes the speed away."""
    found = statuses_on_feet(seed, 300, 200, lambda rng: rng.choice([0.3, 1.0, 2.0]) * rng.normal(size=3))
    assert "solved" in found


@pytest.mark.parametrize("seed", some_of(range(6), [3]))
def test_steps_are_hardly_held_back_where_targets_are_out_of_reach(seed):
    """Such targets stretch both legs: what was left of the errors of feet there stopped the joints again and again."""
    found = statuses_on_feet(seed, 4000, 400, lambda rng: 2.0 * rng.normal(size=3))
    assert found.count("held back") < 0.02 * len(found)


def test_hands_come_back_from_where_legs_are_stretched():
    """A leg that is straight can only leave that position slowly."""
    if not at_hand("unitree_h1"):
        pytest.skip(f"unitree_h1: {MISSING}")
    robot = armctl.load("unitree_h1", base="free")
    hands = {tip: robot.fk(robot.home, tip).position for tip in ("left_elbow_link", "right_elbow_link")}
    feet = dict.fromkeys(("left_ankle_link", "right_ankle_link"), STAY)
    rng = np.random.default_rng(1)
    ik = armctl.DifferentialIk(robot)
    q = robot.home
    for k in range(2200):
        if k % 200 == 0 and k < 1200:
            away = {tip: hands[tip] + rng.choice([0.1, 0.3, 2.0]) * rng.normal(size=3) for tip in hands}
        q = q + 0.005 * ik.step(q, (away if k < 1200 else hands) | feet, 0.005)
    assert max(np.linalg.norm(robot.fk(q, tip).position - point) for tip, point in hands.items()) < 1e-5


def test_a_joint_that_cannot_stop_in_time_is_slowed_from_the_first_step(torso):
    """A start at full speed towards a limit: the limit holds if it can, and the acceleration limit does in any case."""
    q = torso.home.copy()
    v = np.zeros(torso.n)
    v[0] = torso.limits.v_max[0]
    room = v[0] ** 2 / (2.0 * torso.limits.a_max[0])
    q[0] = torso.limits.q_max[0] - 1.2 * room
    ik = armctl.DifferentialIk(torso)
    ik.reset(v)
    dt = 0.002
    for _ in range(500):
        before = v
        v = ik.step(q, {"left": [0.0, 3.0, 0.5]}, dt)
        assert violations(torso, q, v, before, dt) == (False, False, False)
        q = q + dt * v


@pytest.mark.parametrize(
    ("targets", "text"),
    [
        ({}, "no tip has a target"),
        ({"lefty": [0, 0, 1]}, "did you mean 'left'"),
        ({"left": [0, 1]}, "expected 3 numbers"),
        ({"left": [0, np.nan, 1]}, "finite"),
        ({"left": "up"}, "expected a Pose, a point, STAY, RelativeTo or LookAt"),
        ({"left": RelativeTo("rigth", [0, 0, 0])}, "did you mean 'right'"),
        ({"left": RelativeTo("left", [0, 0, 0])}, "relative to each other"),
        ({"left": RelativeTo("right", [0, 0, 0]), "right": RelativeTo("left", [0, 0, 0])}, "relative to each other"),
    ],
)
def test_wrong_targets_are_one_sentence(torso, targets, text):
    with pytest.raises(armctl.ArmctlError, match=text):
        armctl.solve_ik(torso, targets)
    with pytest.raises(armctl.ArmctlError, match=text):
        armctl.DifferentialIk(torso).step(torso.home, targets, 0.01)


def test_wrong_polygons_and_points_are_one_sentence(torso):
    with pytest.raises(armctl.InputError, match="not convex"):
        armctl.solve_ik(torso, {"left": [0, 0, 1]}, center_of_mass_within=[[0, 0], [1, 0], [0.2, 0.2], [0, 1]])
    with pytest.raises(armctl.InputError, match="at least three"):
        armctl.solve_ik(torso, {"left": [0, 0, 1]}, center_of_mass_within=[[0, 0], [1, 0]])
    with pytest.raises(armctl.InputError, match="point"):
        LookAt([1, 2])
    with pytest.raises(armctl.InputError, match="tip"):
        RelativeTo(3, [0, 0, 0])
    with pytest.raises(armctl.InputError, match="a pose is for one"):
        armctl.DifferentialIk(torso).step(torso.home, [0, 0, 1], 0.01)
    with pytest.raises(armctl.InputError, match="one tip"):
        armctl.DifferentialIk(torso, avoid=True)
    with pytest.raises(armctl.InputError, match="not an array of numbers"):
        armctl.solve_ik(torso, {"left": [0, 0, 1]}, center_of_mass_within="square")


def test_nothing_that_was_asked_for_is_left_out_of_targets_by_tip():
    """Clearances are for a single target; a polygon counts for a single target, too."""
    one = armctl.load("robot_arm_3dof")
    point = one.fk(one.home).position + np.array([0.0, 0.3, 0.0])
    with pytest.raises(armctl.InputError, match="not for targets by tip"):
        armctl.DifferentialIk(one, avoid=True).step(one.home, {one.tip: point}, 0.01)
    data = mujoco.MjData(one.model)
    data.qpos[:] = one.qpos(one.home)
    mujoco.mj_forward(one.model, data)
    x, y = data.subtree_com[one.model.body_rootid[one.tip_body], :2]
    strip = [[x - 1.0, y - 0.01], [x + 1.0, y - 0.01], [x + 1.0, y + 0.01], [x - 1.0, y + 0.01]]
    ik = armctl.DifferentialIk(one, center_of_mass_within=strip)
    q = one.home
    for _ in range(400):
        q = q + 0.005 * ik.step(q, point, 0.005)
    data.qpos[:] = one.qpos(q)
    mujoco.mj_forward(one.model, data)
    assert 0.005 < data.subtree_com[one.model.body_rootid[one.tip_body], 1] - y < 0.01 + 1e-4


def test_contradictory_exact_targets_are_named(torso):
    found = armctl.solve_ik(torso, {"left": STAY, "right": RelativeTo("left", [5.0, 0.0, 0.0])})
    assert not found
    assert np.isfinite(found.q).all()
    assert "right is " in found.reason


def test_a_stream_takes_targets_by_tip(torso):
    """Both tips follow; one that stays does so at every target; the stream keeps its limits as with any target."""
    home = 0.5 * configurations(torso, 1, seed=9)[0]
    stream = armctl.Stream(torso, home)
    left, right = (torso.fk(home, tip) for tip in torso.tips)
    dt = 0.004
    before = stream.setpoint
    slip = 0.0
    for k in range(500):
        t = k / 30
        if t > 3.0:
            break
        goal = Pose(left.position + 0.01 * np.array([np.sin(t), np.sin(2.0 * t), 0.0]), quat=left.quat)
        stream.push_pose(stream.t + 0.05, {"left": goal, "right": STAY})
        for _ in range(8):
            setpoint = stream.step(dt)
            assert (np.abs(setpoint.v) <= torso.limits.v_max * (1 + 1e-9)).all()
            assert (np.abs(setpoint.a) <= torso.limits.a_max * (1 + 1e-6)).all()
            slip = max(slip, gap(torso, setpoint.q, "right", right)[0])
        before = setpoint
    assert gap(torso, before.q, "left", goal)[0] < 0.005
    assert slip < 0.01
    with pytest.raises(armctl.InputError, match="a pose is for one"):
        stream.push_pose(stream.t + 0.1, [0.3, 0.0, 0.3])
    with pytest.raises(armctl.UnknownNameError, match="did you mean 'right'"):
        stream.push_pose(stream.t + 0.1, {"rigth": [0.3, 0.0, 0.3]})
    with pytest.raises(armctl.LimitError, match="left is"):
        stream.push_pose(stream.t + 0.1, {"left": [300.0, 0.0, 300.0]})
