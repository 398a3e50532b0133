"""move_l with targets by tip: MuJoCo judges that each tip stays on its line, and that all are on the way together."""

import mujoco
import numpy as np
import pytest
from arms import MISSING, at_hand, some_of
from synthetic import limb, mjcf, motors

import armctl
from armctl import STAY, LookAt, Pose, RelativeTo

pytestmark = pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")

LEFT = limb("a b c p q r", '<site name="left" pos="0.1 0 0"/>')
RIGHT = limb("d e f g h i", '<site name="right" pos="0 0.1 0" euler="0.3 0 0"/>')
TORSO = mjcf(limb("torso", LEFT + RIGHT), motors("torso a b c p q r d e f g h i") + '<option timestep="0.001"/>')
ROBOTS = {"a torso": ["left", "right"], "aloha": ["left/gripper", "right/gripper"]}
START = np.array([0.73, 0.74, 0.04, -0.51, -1.07, -0.28, -0.22, -1.09, -1.08, 1.2, 0.37, -0.64, -0.16])
ON_LINE_M = 1e-5  # between the points at which the path was computed


@pytest.fixture(scope="module", params=some_of(ROBOTS, ["a torso"]))
def arm(request):
    if request.param == "a torso":
        return armctl.load(mujoco.MjSpec.from_string(TORSO), tips=ROBOTS[request.param])
    if not at_hand(request.param):
        pytest.skip(f"{request.param}: {MISSING}")
    return armctl.load(request.param, tips=ROBOTS[request.param])


@pytest.fixture(scope="module")
def start(arm):
    return START if arm.n == len(START) else arm.home


def tips_along(arm, motion, count=400):
    """Positions (T, K, 3) and rotations (T, K, 3, 3) of the tips along a motion, by MuJoCo."""
    data = mujoco.MjData(arm.model)
    positions = np.empty((count, len(arm.tips), 3))
    rotations = np.empty((count, len(arm.tips), 3, 3))
    for k, q in enumerate(motion.sample(np.linspace(0.0, motion.duration, count)).q):
        data.qpos[:] = arm.qpos(q)
        mujoco.mj_kinematics(arm.model, data)
        for i, frame in enumerate(arm.tip_frames):
            R = data.xmat[frame.body].reshape(3, 3)
            positions[k, i] = data.xpos[frame.body] + R @ frame.T_body_tip.position
            rotations[k, i] = R @ frame.T_body_tip.rotation
    return positions, rotations


def moved(pose, by, turn=0.0):
    return Pose.from_rotation(pose.position + by, pose.rotation @ Pose([0, 0, 0], rpy=[turn, 0, 0]).rotation)


def shifted(pose, by):
    return pose.position + np.array(by)


def poses(arm, q):
    return [arm.fk(q, tip) for tip in arm.tips]


def test_each_tip_stays_on_its_line_and_all_are_on_the_way_together(arm, start):
    first, second = arm.tips
    left, right = poses(arm, start)
    targets = {first: moved(left, [0.02, 0.03, 0.04], 0.15), second: shifted(right, [0.0, -0.02, 0.05])}
    motion = armctl.move_l(arm, start, targets)
    assert motion.check_limits().ok
    positions, rotations = tips_along(arm, motion)
    shares = []
    for i, end in enumerate((targets[first].position, targets[second])):
        way = positions[:, i] - positions[0, i]
        line = end - positions[0, i]
        share = way @ line / (line @ line)
        assert np.linalg.norm(way - share[:, None] * line, axis=1).max() < ON_LINE_M
        assert np.linalg.norm(positions[-1, i] - end) < 1e-8
        shares.append(share)
    assert np.abs(shares[0] - shares[1]).max() < 1e-3
    assert np.diff(shares[0]).min() > -1e-6
    assert np.abs(rotations[-1, 0] - targets[first].rotation).max() < 1e-8


def test_two_hands_that_hold_one_thing_keep_their_relative_pose(arm, start):
    first, second = arm.tips
    left, right = poses(arm, start)
    targets = {first: moved(left, [0.0, 0.02, 0.05], 0.1), second: RelativeTo(first, left.inverse() @ right)}
    positions, rotations = tips_along(arm, armctl.move_l(arm, start, targets))
    relative = np.einsum("tji,tj->ti", rotations[:, 0], positions[:, 1] - positions[:, 0])
    assert np.abs(relative - relative[0]).max() < ON_LINE_M
    turned = np.einsum("tji,tjk->tik", rotations[:, 0], rotations[:, 1])
    assert np.abs(turned - turned[0]).max() < ON_LINE_M
    assert np.linalg.norm(positions[-1, 0] - targets[first].position) < 1e-8


def test_a_tip_that_stays_stays_and_one_without_target_is_free(arm, start):
    first, second = arm.tips
    target = shifted(arm.fk(start, first), [0.02, 0.02, 0.03])
    positions, rotations = tips_along(arm, armctl.move_l(arm, start, {first: target, second: STAY}))
    assert np.abs(positions[:, 1] - positions[0, 1]).max() < ON_LINE_M
    assert np.abs(rotations[:, 1] - rotations[0, 1]).max() < ON_LINE_M
    alone = armctl.move_l(arm, start, {first: target})
    assert np.linalg.norm(arm.fk(alone(alone.duration).q, first).position - target) < 1e-8


def test_speeds_of_tips_are_limits_of_each(arm, start):
    first, second = arm.tips
    left, right = poses(arm, start)
    targets = {first: shifted(left, [0, 0.01, 0.02]), second: shifted(right, [0, -0.03, 0.06])}
    fast = armctl.move_l(arm, start, targets)
    slow = armctl.move_l(arm, start, targets, tip_speed=0.05)
    times = np.linspace(0.0, slow.duration, 2000)
    positions, _ = tips_along(arm, slow, len(times))
    speeds = np.linalg.norm(np.diff(positions, axis=0), axis=2) / times[1]
    assert 0.045 < speeds[:, 1].max() < 0.05 * (1 + 1e-6)
    assert slow.duration > fast.duration
    assert armctl.move_l(arm, start, targets, duration=3.0).duration == pytest.approx(3.0)


def test_a_start_in_motion_brakes_onto_the_lines(arm, start):
    moving = armctl.Setpoint(start, np.full(arm.n, 0.1), np.zeros(arm.n))
    first = arm.tips[0]
    target = shifted(arm.fk(start, first), [0.02, 0.02, 0.03])
    motion = armctl.move_l(arm, moving, {first: target})
    assert np.allclose(motion(0.0).v, 0.1)
    assert np.linalg.norm(arm.fk(motion(motion.duration).q, first).position - target) < 1e-8


def test_a_simulation_moves_the_tips_on_lines(arm, start):
    first, second = arm.tips
    sim = armctl.Simulation(arm)
    sim.reset(start)
    left, right = poses(arm, start)
    result = sim.move_l({first: shifted(left, [0.0, 0.02, 0.03]), second: STAY}, speed=0.5, avoid=arm.n != len(START))
    assert result.ok, result.reason
    assert np.linalg.norm(sim.tips[second].position - right.position) < 1e-3
    far = sim.move_l({first: shifted(left, [0.0, 0.0, 9.0])}, avoid=False)
    assert not far.ok
    assert f"{first} is" in far.reason


def test_wrong_lines_are_one_sentence(arm, start):
    first, second = arm.tips
    here = arm.fk(start, first)
    for targets, text in (
        ({}, "target: no tip has a target"),
        ({"tail": here}, "tail"),
        ({first: LookAt([1, 1, 1])}, "looks at a point, which is no end of a line; move_to takes it"),
        ({first: [0.0, 0.0]}, "expected"),
        ({first: RelativeTo(second, here), second: RelativeTo(first, here)}, "relative to each other"),
    ):
        with pytest.raises(armctl.ArmctlError, match=text):
            armctl.move_l(arm, start, targets)
    with pytest.raises(armctl.InputError, match="q_start: targets by tip start at joint positions"):
        armctl.move_l(arm, here, {first: here})
    with pytest.raises(armctl.PlanError, match=rf"move_l: at .* % of the lines .*{second} is there; the end of the lines"):
        armctl.move_l(arm, start, {first: shifted(here, [0.0, 0.0, 9.0]), second: STAY})
    assert armctl.move_l(arm, start, {first: here, second: STAY}).duration == 0.0
