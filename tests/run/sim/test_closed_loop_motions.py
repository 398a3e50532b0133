"""Motions of arms with closed loops: each setpoint is closed, proofs hold, and a simulation stays closed. MuJoCo judges."""

from itertools import pairwise
from pathlib import Path

import mujoco
import numpy as np
import pytest

import armctl
from armctl.core.trajectory import Setpoint

pytestmark = pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")

PALLETIZER = Path(__file__).parents[3] / "examples/models/parallel_link_arm.xml"
CLOSED_M = 1e-6
SOFT_M = 1e-4  # in a simulation, where MuJoCo's constraints yield
LINK = '<geom type="capsule" size="0.01" fromto="0 0 0 0 0 0.2" mass="1"/>'
PARALLELOGRAM = f"""
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="crank"><joint name="crank" axis="0 1 0" range="-3.3 3.3"/>{LINK}
      <body name="coupler" pos="0 0 0.2"><joint name="coupler" axis="0 1 0"/>
        <geom type="capsule" size="0.01" fromto="0 0 0 0.4 0 0" mass="1"/><site name="tip" pos="0.2 0 0.1"/>
      </body>
    </body>
    <body name="rocker" pos="0.4 0 0"><joint name="rocker" axis="0 1 0"/>{LINK}</body>
  </worldbody>
  <equality><connect name="loop" body1="coupler" body2="rocker" anchor="0.4 0 0"/></equality>
  <actuator><motor joint="crank" ctrlrange="-50 50"/></actuator>
</mujoco>
"""
POST = armctl.World().add("post", armctl.Box([0.06, 0.06, 1.2]), [0.55, 0.35, 0.6])


@pytest.fixture(scope="module")
def arm():
    return armctl.load(PALLETIZER, scene=POST)


@pytest.fixture(scope="module")
def goals(arm):
    rng = np.random.default_rng(1)
    return arm.joint_map.closure.inward(arm.home, arm.limits.random(arm.home, 12, rng))


def largest_gap(arm, q):
    """The largest distance, m, between the points that loops hold together, at q (T, n)."""
    data = mujoco.MjData(arm.model)
    worst = 0.0
    for row in q:
        data.qpos[:] = arm.qpos(row)
        mujoco.mj_fwdPosition(arm.model, data)
        worst = max(worst, np.abs(data.efc_pos[data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY]).max())
    return worst


def least_distance(arm, q):
    """The least distance, m, of the geoms that can touch, by MuJoCo, at q (T, n)."""
    model = arm.model
    data = mujoco.MjData(model)
    own = model.body_weldid[model.geom_bodyid]
    above = model.body_weldid[model.body_parentid[own]]
    pairs = [
        (a, b)
        for a in range(model.ngeom)
        for b in range(a + 1, model.ngeom)
        if own[a] != own[b] and (0 in (own[a], own[b]) or (own[a] != above[b] and own[b] != above[a]))
        if model.geom_contype[a] and model.geom_contype[b]
    ]
    least = np.inf
    for row in q:
        data.qpos[:] = arm.qpos(row)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        least = min(least, *(mujoco.mj_geomDistance(model, data, a, b, 1.0, None) for a, b in pairs))
    return least


def times(motion):
    return np.linspace(0.0, motion.duration, 200)


def test_every_setpoint_of_motions_is_closed(arm, goals):
    for start, goal in pairwise(goals):
        motion = armctl.move_j(arm, start, goal)
        q = motion.sample(times(motion)).q
        assert largest_gap(arm, q) < CLOSED_M
        passive = arm.joint_map.positions(q)[:, arm.joint_map.closure.passive]
        assert (passive <= arm.joint_map.closure.q_max + 1e-9).all()
        assert (passive >= arm.joint_map.closure.q_min - 1e-9).all()


def test_inverse_kinematics_finds_points_and_poses_with_the_loops_closed(arm, goals):
    for goal in goals:
        T = arm.fk(goal)
        for target in (T, T.position):
            result = armctl.solve_ik(arm, target)
            assert result.ok, result.reason
            assert np.linalg.norm(arm.fk(result.q).position - T.position) < 1e-5
            arm.checked("q", result.q)
    batch = armctl.solve_ik_batch(arm, [arm.fk(goal) for goal in goals])
    assert batch.ok.all()
    assert np.array_equal(batch.q[0], armctl.solve_ik(arm, arm.fk(goals[0])).q)
    assert not armctl.solve_ik(arm, [3.0, 0.0, 0.5])


def test_a_line_of_the_tip_keeps_the_loops_closed(arm):
    start = armctl.solve_ik(arm, [0.75, -0.2, 0.5]).q
    motion = armctl.move_l(arm, start, [0.75, -0.3, 0.7])
    q = motion.sample(times(motion)).q
    assert largest_gap(arm, q) < CLOSED_M
    tips = arm.fk_many(q)[0]
    assert np.abs(tips[:, 0] - 0.75).max() < 1e-5
    rounded = armctl.move_through(arm, [start, arm.home, start])
    assert largest_gap(arm, rounded.sample(times(rounded)).q) < CLOSED_M


def test_a_motion_through_what_its_loops_forbid_is_refused(arm):
    # At both ends the elbow is inside its limits; between them it is not.
    low, high = np.array([0.0, 0.85, -0.5]), np.array([0.0, -0.85, 0.5])
    assert armctl.move_j(arm, low, high).duration > 0
    with pytest.raises(armctl.LimitError, match="q_goal: the passive joint elbow would be at"):
        armctl.move_j(arm, low, [0.0, 1.2, -1.2])

    class Swing:
        joint_names = arm.joint_names
        duration = 1.0

        def __call__(self, t):
            return Setpoint(np.array([0.0, 0.5, -1.2 * np.sin(np.pi * t)]), np.zeros(3), np.zeros(3))

        def sample(self, t):
            t = np.asarray(t)
            q = np.column_stack([0 * t, 0.5 + 0 * t, -1.2 * np.sin(np.pi * t)])
            return Setpoint(q, 0 * q, 0 * q)

    with pytest.raises(armctl.PlanError, match=r"the passive joint elbow would be at .* of the motion"):
        armctl.Simulation(arm).run(Swing())


def test_no_motion_crosses_the_position_at_which_a_parallelogram_is_folded():
    """There, at a quarter turn of the crank, the rocker could turn either way."""
    arm = armctl.load(mujoco.MjSpec.from_string(PARALLELOGRAM), tip="tip")
    assert armctl.move_j(arm, [0.0], [1.4]).duration > 0
    assert arm.fk([2.0])  # closed, too, but not to be reached from zero
    with pytest.raises(armctl.LimitError, match=r"cannot be closed, or only in a singular position, at \[1.571\]"):
        arm.fk([np.pi / 2])
    with pytest.raises(armctl.PlanError, match=r"the motion leaves where its closed loops are known to close, at 0\.8"):
        armctl.move_j(arm, [0.0], [2.5])


def test_a_proof_covers_the_whole_motion_and_what_it_bounds_is_there(arm, goals):
    proved = 0
    for start, goal in pairwise(goals):
        motion = armctl.move_j(arm, start, goal)
        check = armctl.check_clearance(arm, motion)
        least = least_distance(arm, motion.sample(times(motion)).q)
        assert check.ok == (least > 0.0)
        if check.ok:
            proved += 1
            assert check.distance <= least + 1e-6
            assert check.distance > least - 0.02  # 200 samples do not meet the least distance
    assert proved >= 3


def test_a_planned_motion_goes_around_an_obstacle(arm):
    start = armctl.solve_ik(arm, [0.6, -0.2, 0.6]).q
    goal = armctl.solve_ik(arm, [0.35, 0.75, 0.6]).q
    straight = armctl.check_clearance(arm, armctl.move_j(arm, start, goal))
    assert not straight.ok
    assert "post" in straight.reason
    motion = armctl.move_free(arm, start, goal)
    assert armctl.check_clearance(arm, motion).ok
    q = motion.sample(times(motion)).q
    assert least_distance(arm, q) > 0.0
    assert largest_gap(arm, q) < CLOSED_M


def test_a_simulation_starts_closed_stays_closed_and_arrives(arm):
    sim = armctl.Simulation(arm)
    data = mujoco.MjData(arm.model)
    for point in ([0.75, -0.2, 0.5], [0.6, -0.4, 0.75]):
        result = sim.move_to(np.array(point))
        assert result.ok, result.reason
        gaps = []
        for qpos in result.log.qpos[::10]:
            data.qpos[:] = qpos
            mujoco.mj_fwdPosition(arm.model, data)
            gaps.append(np.abs(data.efc_pos[data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY]).max())
        assert max(gaps) < SOFT_M
        assert np.abs(result.log.q - result.log.q_ref).max() < 1e-4


def test_a_start_that_breaks_a_loop_is_refused(arm):
    with pytest.raises(armctl.LimitError, match="q_start: the passive joint elbow would be at"):
        armctl.move_j(arm, [0.0, 1.2, -1.2], arm.home)
    geom = '<geom type="capsule" fromto="0 0 0 {0} 0 0" size="0.02" mass="1" contype="0" conaffinity="0"/></body>'
    rod = f'<body name="ROD" pos="0.5 0 0"><joint name="rod" axis="0 1 0"/>{geom.format(0.4)}'
    crank = f'<body name="CRANK"><joint name="crank" axis="0 1 0" range="-3 3"/>{rod}{geom.format(0.5)}'
    cart = f'<body name="CART" pos="0.8 0 0.1"><joint name="cart" type="slide" axis="1 0 0" range="-1 1"/>{geom.format(0.1)}'
    pin = '<equality><connect name="pin" body1="ROD" body2="CART" anchor="0.4 0 0"/></equality>'
    motor = '<actuator><motor joint="crank" ctrlrange="-50 50"/></actuator>'
    text = f'<mujoco><compiler angle="radian" autolimits="true"/><worldbody>{crank}{cart}</worldbody>{pin}{motor}</mujoco>'
    crank_arm = armctl.load(mujoco.MjSpec.from_string(text), tip="CART")
    with pytest.raises(armctl.LimitError, match="the loop of the equality 'pin' cannot be closed"):
        armctl.Simulation(crank_arm).reset([-1.5])  # the end of the crank is 0.5 m above the slide, and the rod is 0.4 m long
    with pytest.raises(armctl.LimitError, match="q_goal: the loop of the equality 'pin' cannot be closed"):
        armctl.move_j(crank_arm, crank_arm.home, [-1.5])


def test_a_gripper_of_two_parallel_fingers_is_one_joint_with_two_tips():
    geom = '<geom type="capsule" fromto="0 0 0 {} 0 {}" size="0.004" mass="0.05" contype="0" conaffinity="0"/>'

    def finger(side, x):
        axis = f'axis="0 {1 if x > 0 else -1} 0"'
        pad = f'<body name="{side}_pad" pos="0 0 0.05"><joint name="{side}_pad" {axis}/>{geom.format(0, 0.03)}'
        pad += f'<site name="{side}_tip" pos="0 0 0.03"/></body>'
        link = f'<body name="{side}_link" pos="{x} 0 0"><joint name="{side}_link" {axis} range="-0.2 0.9"/>'
        bar = f'<body name="{side}_bar" pos="{x + 0.02} 0 0"><joint name="{side}_bar" {axis}/>'
        return f"{link}{geom.format(0, 0.05)}{pad}</body>{bar}{geom.format(0, 0.05)}</body>"

    equalities = (
        '<connect name="right loop" body1="right_bar" body2="right_pad" anchor="0 0 0.05"/>'
        '<connect name="left loop" body1="left_bar" body2="left_pad" anchor="0 0 0.05"/>'
        '<joint name="both" joint1="left_link" joint2="right_link" polycoef="0 1 0 0 0"/>'
    )
    motor = '<actuator><motor joint="right_link" ctrlrange="-5 5"/></actuator>'
    text = (
        '<mujoco model="gripper"><compiler angle="radian" autolimits="true"/>'
        f"<worldbody><body name='palm'>{finger('right', 0.03)}{finger('left', -0.05)}</body></worldbody>"
        f"<equality>{equalities}</equality>{motor}</mujoco>"
    )
    gripper = armctl.load(mujoco.MjSpec.from_string(text))
    assert gripper.joint_names == ("right_link",)
    assert set(gripper.tips) == {"right_tip", "left_tip"}
    for q in np.linspace(-0.2, 0.9, 12):
        assert largest_gap(gripper, [[q]]) < CLOSED_M
        for tip in gripper.tips:
            assert gripper.fk([q], tip).rotation == pytest.approx(gripper.fk([0.0], tip).rotation, abs=1e-9)  # parallel
    found = armctl.solve_ik(gripper, {"right_tip": gripper.fk([0.6], "right_tip")})
    assert found.q == pytest.approx([0.6], abs=1e-4)
