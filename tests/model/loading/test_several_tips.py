"""An arm with several tips: two arms, the fingers of a hand, limbs that share a torso. MuJoCo judges it."""

import itertools
import pickle

import mujoco
import numpy as np
import pytest
from arms import MISSING, at_hand, some_of
from synthetic import limb, mjcf, motors

import armctl

TORSO = mjcf(
    limb(
        "torso",
        limb("a b c", '<site name="left" pos="0.1 0 0"/>') + limb("d e", '<site name="right" pos="0 0.1 0" euler="0.3 0 0"/>'),
    ),
    motors("torso a b c d e") + '<option timestep="0.001" integrator="implicitfast"/>',
)
ROBOTS = {
    "a torso": ["left", "right"],
    "aloha": ["left/gripper", "right/gripper"],
    "wonik_allegro": ["ff_tip", "mf_tip", "rf_tip", "th_tip"],
    "unitree_h1": ["left_elbow_link", "right_ankle_link", "left_ankle_link", "right_elbow_link"],
}


@pytest.fixture(scope="module", params=some_of(ROBOTS, ["a torso", "aloha"]))
def arm(request):
    if request.param == "a torso":
        return armctl.load(mujoco.MjSpec.from_string(TORSO), tips=ROBOTS[request.param])
    if not at_hand(request.param):
        pytest.skip(f"{request.param}: {MISSING}")
    return armctl.load(request.param, tips=ROBOTS[request.param])


pytestmark = pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")


def configurations(arm, count):
    return arm.limits.random(arm.home, count, np.random.default_rng(3))


def test_every_tip_is_where_mujoco_puts_it_and_moves_as_it_says(arm):
    data = mujoco.MjData(arm.model)
    for q in configurations(arm, 20):
        data.qpos[:] = arm.qpos(q)
        mujoco.mj_kinematics(arm.model, data)
        mujoco.mj_comPos(arm.model, data)
        for frame in arm.tip_frames:
            pose = arm.fk(q, tip=frame.name)
            rotation = data.xmat[frame.body].reshape(3, 3)
            position = data.xpos[frame.body] + rotation @ frame.T_body_tip.position
            assert pose.position == pytest.approx(position, abs=1e-12)
            assert pose.rotation == pytest.approx(rotation @ frame.T_body_tip.rotation, abs=1e-12)
            J = np.zeros((6, arm.model.nv))
            mujoco.mj_jac(arm.model, data, J[:3], J[3:], position, frame.body)
            assert arm.jacobian(q, tip=frame.name) == pytest.approx(arm.joint_map.reduced(J), abs=1e-12)


def test_its_joints_are_those_that_move_a_tip_each_once(arm):
    assert len(set(arm.joint_names)) == arm.n
    moved = sum(np.abs(arm.jacobian(q, tip)).max(axis=0) for q in configurations(arm, 3) for tip in arm.tips)
    assert (moved > 1e-6).all()
    alone = [armctl.load(arm.model, tip=tip).joint_names for tip in arm.tips]
    assert set(arm.joint_names) == set().union(*alone)
    assert arm.joint_names[: len(alone[0])] == alone[0]


def test_joints_are_in_the_order_of_a_tree_whatever_the_order_of_the_tips():
    """Pinocchio takes the joints behind a joint for those after it."""
    inner = limb("b", limb("c", '<site name="one"/>') + limb("d", '<site name="two"/>'))
    spec = mujoco.MjSpec.from_string(mjcf(limb("a", inner + limb("e", '<site name="three"/>')), motors("a b c d e")))
    orders = {tips: armctl.load(spec, tips=tips).joint_names for tips in itertools.permutations(["one", "two", "three"])}
    assert orders["one", "three", "two"] == ("a", "b", "c", "d", "e")
    assert orders["three", "one", "two"] == ("a", "e", "b", "c", "d")
    assert orders["two", "three", "one"] == ("a", "b", "d", "c", "e")


def test_calls_without_a_tip_mean_the_first(arm):
    assert arm.tips[0] == arm.tip
    assert arm.fk(arm.home).position.tolist() == arm.fk(arm.home, arm.tip).position.tolist()
    assert arm.jacobian(arm.home).tolist() == arm.jacobian(arm.home, arm.tip).tolist()
    assert arm.fk_many([arm.home])[0][0] == pytest.approx(arm.fk(arm.home).position, abs=1e-12)


def test_its_dynamics_are_those_of_mujoco(arm):
    data = mujoco.MjData(arm.model)
    dense = np.zeros((arm.model.nv, arm.model.nv))
    rng = np.random.default_rng(4)
    for q in configurations(arm, 5):
        v, a = rng.normal(size=(2, arm.n))
        data.qpos[:] = arm.qpos(q)
        data.qvel[:] = arm.qvel(v)
        mujoco.mj_forward(arm.model, data)
        mujoco.mj_fullM(arm.model, data, dense)
        M = arm.joint_map.reduced_matrix(dense)
        assert arm.mass_matrix(q) == pytest.approx(M, abs=1e-9 * np.abs(M).max())
        torque = arm.joint_map.reduced(data.qfrc_bias - data.qfrc_passive) + M @ a
        assert arm.inverse_dynamics(q, v, a) == pytest.approx(torque, abs=1e-8 * np.abs(torque).max())


def test_computed_torque_of_all_joints_inverts_the_step_of_the_simulator(arm):
    motion = armctl.move_j(arm, arm.home, arm.limits.clamp(arm.home + 0.02))
    log = armctl.simulate(arm, "computed-torque", motion)
    assert not log.failure
    begun = min((contact.start for contact in log.contacts), default=np.inf)
    if begun == 0.0:
        pytest.skip("its feet stand on the floor")
    free = log.t < begun - 0.005  # an object falls onto the hand
    assert free.sum() > 50
    assert np.abs(log.q - log.q_ref)[free].max() < 1e-8


def standing_arm(side, y):
    hinge = (
        f'<joint name="{side}" axis="0 0 1" range="-3 3"/><geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03" mass="1"/>'
    )
    link = '<geom type="capsule" fromto="0.05 0 0 0.3 0 0" size="0.03" mass="1"/>'
    wrist = f'<joint name="{side}2" axis="0 1 0" range="-2 2"/>{link}<site name="tip_{side}" pos="0.3 0 0"/>'
    return f'<body name="base_{side}" pos="0 {y} 0.2">{hinge}<body name="arm_{side}" pos="0.4 0 0">{wrist}</body></body>'


def test_motions_keep_the_arms_clear_of_each_other():
    """Two arms that stand side by side: both turn inwards, and one makes way for the other."""
    text = mjcf(standing_arm("l", 0.3) + standing_arm("r", -0.3), motors("l l2 r r2"))
    arm = armctl.load(mujoco.MjSpec.from_string(text), tips=["tip_l", "tip_r"])
    found = armctl.check_clearance(arm, armctl.move_j(arm, [0.6, 0.0, -0.6, 0.0], [-0.6, 0.0, 0.6, 0.0]))
    assert not found
    assert {found.first[-1], found.second[-1]} == {"l", "r"}
    planned = armctl.move_free(arm, [-0.5, 0.0, -1.2, 0.0], [1.2, 0.0, 0.5, 0.0])
    assert armctl.check_clearance(arm, planned)
    data = mujoco.MjData(arm.model)
    for t in np.linspace(0.0, planned.duration, 500):
        data.qpos[:] = arm.qpos(planned(t).q)
        mujoco.mj_forward(arm.model, data)
        assert not any(contact.dist < 0.0 for contact in data.contact)


def test_other_processes_and_payloads_keep_the_tips(arm):
    for other in (pickle.loads(pickle.dumps(arm)), arm.with_payload(0.1)):
        assert other.tips == arm.tips
        assert other.fk(arm.home, arm.tips[-1]).position.tolist() == arm.fk(arm.home, arm.tips[-1]).position.tolist()


def test_one_name_is_the_arm_to_it():
    spec = mujoco.MjSpec.from_string(TORSO)
    one, other = armctl.load(spec, tips=["right"]), armctl.load(spec, tip="right")
    assert one.tips == ("right",)
    assert one.joint_names == other.joint_names == ("torso", "d", "e")
    assert armctl.solve_ik(one, one.fk([0.1, 0.2, 0.3]).position)


def test_a_data_sheet_of_one_arm_holds_for_two_equal_ones():
    if not at_hand("aloha"):
        pytest.skip(f"aloha: {MISSING}")
    both = armctl.load("aloha", tips=ROBOTS["aloha"])
    one = armctl.load("aloha", tip="left/gripper")
    assert both.limits.v_max.tolist() == [*one.limits.v_max, *one.limits.v_max]


@pytest.mark.parametrize(
    ("arguments", "error", "text"),
    [
        ({"tips": ["left", "left"]}, armctl.InputError, "'left' is given twice"),
        ({"tips": []}, armctl.InputError, "is not a list of names"),
        ({"tips": "left"}, armctl.InputError, "is not a list of names"),
        ({"tips": ["left", 3]}, armctl.InputError, "tip"),
        ({"tips": ["left", "lef"]}, armctl.UnknownNameError, "did you mean 'left'"),
        ({"tips": ["left"], "tip": "right"}, armctl.InputError, "both are given"),
        ({"tips": ["left", "right"], "tool": "robotiq_2f85"}, armctl.InputError, "one tip"),
        ({"tips": ["left", "world"]}, armctl.ArmctlError, "world"),
    ],
)
def test_wrong_tips_are_one_sentence(arguments, error, text):
    with pytest.raises(error, match=text):
        armctl.load(mujoco.MjSpec.from_string(TORSO), **arguments)


def test_an_unknown_tip_and_a_target_for_one_of_several_are_one_sentence():
    arm = armctl.load(mujoco.MjSpec.from_string(TORSO), tips=["left", "right"])
    with pytest.raises(armctl.UnknownNameError, match="did you mean 'right'"):
        arm.fk(arm.home, tip="rigth")
    with pytest.raises(armctl.InputError, match="a pose is for one"):
        armctl.solve_ik(arm, [0.3, 0.0, 0.3])
    with pytest.raises(armctl.InputError, match="a pose is for one"):
        armctl.Simulation(arm).move_to([0.3, 0.0, 0.3])
    with pytest.raises(armctl.InputError, match="a pose is for one"):
        armctl.move_l(arm, arm.home, [0.3, 0.0, 0.3])
    assert repr(arm) == "Arm('trap', 6 joints, tips 'left', 'right')"
