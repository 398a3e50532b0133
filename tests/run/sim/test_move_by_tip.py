"""Moves of several tips at once, and of an arm on a base that moves. MuJoCo judges."""

import dataclasses

import mujoco
import numpy as np
import pytest
from arms import MISSING, at_hand
from synthetic import TWO_ARMS, limb, mjcf, motors

import armctl
from armctl import STAY, Pose, RelativeTo

pytestmark = pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")


@pytest.fixture
def simulation():
    return armctl.Simulation(armctl.load(mujoco.MjSpec.from_string(TWO_ARMS)))


def site(simulation, name):
    return simulation.data.site(name).xpos.copy()


def test_both_tips_arrive_and_never_touch(simulation):
    simulation.move_j([0.3, 0.5, 0.6, 0.1, -0.3, 0.5, 0.6, -0.1])
    left = site(simulation, "l")
    right = site(simulation, "r")
    crossed = {"l": left + np.array([0.0, -0.2, 0.1]), "r": right + np.array([0.0, 0.05, 0.1])}
    result = simulation.move_to(crossed)
    assert result
    for name, target in crossed.items():
        assert np.linalg.norm(site(simulation, name) - target) < 1e-3
    assert not result.log.contacts
    assert result.clearance > 0.0
    assert result.position_error < 1e-3


def test_the_log_has_all_tips_and_the_report_tells_them_apart(simulation, tmp_path):
    target = site(simulation, "r") + np.array([-0.05, 0.0, 0.1])
    log = simulation.move_to({"r": target}).log
    data = mujoco.MjData(simulation.model)
    for k in (0, len(log) // 2, len(log) - 1):
        data.qpos[:] = log.qpos[k]
        mujoco.mj_kinematics(simulation.model, data)
        for name, tip in log.tips.items():
            assert np.allclose(tip.position[k], data.site(name).xpos, atol=1e-9)
            quat = np.empty(4)
            mujoco.mju_mat2Quat(quat, data.site(name).xmat)
            assert abs(tip.quat[k] @ quat) == pytest.approx(1.0, abs=1e-9)
    assert np.array_equal(log.tips["r"].target[:3], target)
    report = armctl.Report.from_log(log)
    assert report.ok
    assert set(report.tip_errors) == {"l", "r"}
    errors = report.tip_errors["r"]
    assert errors.final_m == pytest.approx(np.linalg.norm(log.tips["r"].position[-1] - target))
    assert errors.max_m == pytest.approx(np.linalg.norm(log.tips["r"].position - log.tips["r"].position_ref, axis=1).max())
    assert report.to_dict()["tip_errors"] == {name: each._asdict() for name, each in report.tip_errors.items()}
    assert [line.split()[0] for line in str(report).splitlines()[2:4]] == ["l", "r"]
    assert str(armctl.Report.from_log(armctl.Log.load(log.save(tmp_path / "run.parquet")))) == str(report)


def test_the_report_names_the_tip_that_missed(simulation):
    log = simulation.move_to({"r": site(simulation, "r") + np.array([-0.05, 0.0, 0.1])}).log
    shifted = log.other_targets.copy()
    shifted[2] += 0.05
    report = armctl.Report.from_log(dataclasses.replace(log, other_targets=shifted))
    assert not report.ok
    assert "r ended 50 mm from its goal" in report.reason
    assert "l ended" not in report.reason
    assert report.final_tip_error_m == pytest.approx(0.05, abs=1e-4)


def test_a_tip_that_stays_is_where_it_was_at_the_end(simulation):
    simulation.move_j([0.3, 0.5, 0.6, 0.1, -0.3, 0.5, 0.6, -0.1])
    right = site(simulation, "r")
    result = simulation.move_to({"l": site(simulation, "l") + np.array([0.05, 0.0, 0.1]), "r": STAY})
    assert result
    assert np.linalg.norm(site(simulation, "r") - right) < 1e-3


def test_an_arm_whose_tip_stays_rests_while_the_other_one_goes_around(simulation):
    simulation.move_j([0.3, 0.5, 0.6, 0.1, -0.3, 0.5, 0.6, -0.1])
    right = simulation.state.q[4:]
    for target in ([0.3, -0.1, 0.7], [-0.2, 0.5, 0.5]):
        for avoid in (True, False):
            result = simulation.move_to({"l": target, "r": STAY}, avoid=avoid)
            assert result, result.reason
            assert np.ptp(result.log.q_ref[:, 4:], axis=0).max() < 1e-9
    assert np.abs(simulation.state.q[4:] - right).max() < 1e-6


def test_an_arm_without_a_target_rests_unless_it_is_in_the_way(simulation):
    simulation.move_j([0.6, 0.5, 0.6, 0.1, 0.4, 0.5, 0.6, 0.1])
    right = site(simulation, "r")
    away = simulation.move_to({"l": [0.2, 0.6, 0.6]})
    assert away, away.reason
    assert np.ptp(away.log.q_ref[:, 4:], axis=0).max() < 1e-9
    there = simulation.move_to({"l": right})
    assert there, there.reason
    assert np.ptp(there.log.q_ref[:, 4:], axis=0).max() > 0.1
    assert not there.log.contacts


def test_a_hand_on_a_joint_that_has_to_move_stays_at_the_end():
    trunk = limb("t", limb("a b c") + limb("d e f"))
    simulation = armctl.Simulation(armctl.load(mujoco.MjSpec.from_string(mjcf(trunk, motors("t a b c d e f")))))
    left, right = simulation.arm.tips
    before = simulation.tips
    result = simulation.move_to({left: before[left].position + np.array([0.0, 0.05, -0.02]), right: STAY})
    after = simulation.tips[right]
    assert np.linalg.norm(after.position - before[right].position) < (1e-3 if result else 1e-12)
    assert simulation.tip.position == pytest.approx(simulation.tips[left].position)


JAWS = (
    '<body name="{0}1" pos="0.05 0.02 0.1"><joint name="{0}1" type="slide" axis="0 1 0" range="0 0.04"/>'
    '<geom name="{0}1" type="box" size="0.01 0.005 0.03" mass="0.05"/></body>'
    '<body name="{0}2" pos="0.05 -0.02 0.1"><joint name="{0}2" type="slide" axis="0 -1 0" range="0 0.04"/>'
    '<geom name="{0}2" type="box" size="0.01 0.005 0.03" mass="0.05"/></body>'
)


def test_each_tip_has_a_gripper_of_its_own():
    bodies = limb("a b c", JAWS.format("l")) + limb("d e f", JAWS.format("r")).replace('pos="0.1 0 0.1"', 'pos="-0.5 0 0.1"', 1)
    tied = '<equality><joint joint1="l2" joint2="l1"/><joint joint1="r2" joint2="r1"/></equality>'
    jaws = {jaw: f'<position joint="{jaw}" kp="500" kv="10" ctrlrange="0 0.04" forcerange="-20 20"/>' for jaw in ("l1", "r1")}
    text = mjcf(bodies, motors("a b c d e f l1 r1", **jaws) + tied + '<option timestep="0.001" gravity="0 0 0"/>')
    simulation = armctl.Simulation(armctl.load(mujoco.MjSpec.from_string(text), tips=["C", "F"]))
    left = simulation.gripper_at("C")
    right = simulation.gripper_at("F")
    assert simulation.gripper is left
    before = simulation.state.q
    assert left.open()
    assert right.move(0.04)
    assert left.width == pytest.approx(left.width_max, abs=1e-3)
    assert right.width == pytest.approx(0.04, abs=1e-3)
    assert simulation.state.q == pytest.approx(before, abs=1e-4)
    with pytest.raises(armctl.UnknownNameError, match="unknown tip of trap 'X'; known: C, F"):
        simulation.gripper_at("X")


def test_a_relative_tip_ends_where_the_other_one_takes_it(simulation):
    simulation.move_j([0.3, 0.5, 0.6, 0.1, -0.3, 0.5, 0.6, -0.1])
    left = site(simulation, "l") + np.array([0.03, 0.02, 0.05])
    arm = simulation.arm
    pose = arm.fk(simulation.state.q, "l")
    offset = pose.inverse().matrix @ np.append(site(simulation, "r"), 1.0)
    assert simulation.move_to({"l": left, "r": RelativeTo("l", offset[:3])})
    moved = arm.fk(simulation.state.q, "l").matrix @ offset
    assert np.linalg.norm(site(simulation, "r") - moved[:3]) < 1e-3


def test_targets_that_cannot_be_reached_move_nothing_and_are_told_apart(simulation):
    before = simulation.state.q
    result = simulation.move_to({"l": [0.0, 0.0, 5.0], "r": site(simulation, "r")})
    assert not result
    assert result.log is None
    assert "l is " in result.reason
    assert "r is there" in result.reason
    assert simulation.state.q.tolist() == before.tolist()


@pytest.mark.parametrize(
    ("target", "text"),
    [
        ({"x": [0.0, 0.0, 0.5]}, "unknown tip"),
        ({}, "no tip has a target"),
        ([0.3, 0.0, 0.5], "a pose is for one"),
        ({"l": [0.0, np.inf, 0.0]}, "finite"),
    ],
)
def test_wrong_targets_are_one_sentence(simulation, target, text):
    with pytest.raises(armctl.ArmctlError, match=text):
        simulation.move_to(target)
    with pytest.raises(armctl.InputError, match="keep"):
        simulation.move_to({"l": [0.3, 0.2, 0.5]}, keep="z")


def test_an_arm_with_one_tip_takes_a_target_by_its_name():
    simulation = armctl.Simulation("robot_arm_3dof")
    assert simulation.move_to({simulation.arm.tip: [0.4, 0.1, 0.35]})
    assert np.linalg.norm(simulation.tip.position - np.array([0.4, 0.1, 0.35])) < 1e-3


def test_an_arm_on_a_planar_base_goes_around_a_wall():
    cart = (
        '<body name="cart" pos="0 0 0.3"><geom type="box" size="0.15 0.15 0.1" mass="5"/>'
        + limb("a b c").replace('contype="0" conaffinity="0"', "").replace('pos="0.1 0 0.1"', 'pos="0.02 0 0.12"')
        + "</body>"
    )
    scene = armctl.World().add("wall", armctl.Box([0.1, 2.0, 1.0]), [1.0, 0.0, 0.5])
    arm = armctl.load(mujoco.MjSpec.from_string(mjcf(cart, motors("a b c"))), base="planar", scene=scene)
    simulation = armctl.Simulation(arm)
    tip = simulation.tip.position
    rng = np.random.default_rng(0)
    for _ in range(6):
        side = 2.0 if simulation.tip.position[0] < 1.0 else -1.0
        target = np.array([side, rng.uniform(-1.0, 1.0), tip[2]])
        result = simulation.move_to(target)
        assert result, result.reason
        assert np.linalg.norm(simulation.tip.position - target) < 1e-3
        assert "wall" not in {contact.other for contact in result.log.contacts}


def test_both_arms_of_aloha_swap_places():
    if not at_hand("aloha"):
        pytest.skip(f"aloha: {MISSING}")
    simulation = armctl.Simulation("aloha")
    arm = simulation.arm
    poses = {tip: arm.fk(arm.home, tip) for tip in arm.tips}
    near = {tip: Pose(pose.position + np.array([0.0, 0.05, -0.05]), quat=pose.quat) for tip, pose in poses.items()}
    result = simulation.move_to(near)
    assert result, result.reason
    for tip, pose in near.items():
        assert arm.fk(simulation.state.q, tip).position == pytest.approx(pose.position, abs=1e-3)
