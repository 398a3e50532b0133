"""Joints tied to each other by equalities: one actuator moves them as one, in kinematics, dynamics and simulation."""

import mujoco
import numpy as np
import pytest
from synthetic import FAST, FINGERS, PULL, RIGID, TIED, limb, mjcf, motors, tendon, ties

import armctl
from armctl.model.arm.dynamics import Dynamics
from armctl.model.arm.parity import check_parity
from armctl.model.mjmodel.transmissions import Transmission, Transmissions
from armctl.plan.ik.solve_batch import solve_ik_batch


@pytest.fixture(params=TIED)
def tied(request: pytest.FixtureRequest, load) -> armctl.Arm:
    bodies, rest, how, joints = TIED[request.param]
    arm = load(bodies, rest, **how)
    assert " ".join(arm.joint_names) == joints
    return arm


def test_the_model_is_mujocos(tied: armctl.Arm):
    assert check_parity(tied, samples=20) < 1e-12
    rng = np.random.default_rng(1)
    dynamics = Dynamics(tied.model, tied.pinocchio_model)
    for _ in range(3):  # also where the same memory is used again
        q = tied.limits.random(tied.home, 1, rng)[0]
        assert np.linalg.eigvalsh(dynamics.mass_matrix(q)).min() > 0
        torque = dynamics.inverse_dynamics(q, np.zeros(tied.n), np.ones(tied.n)) - dynamics.gravity(q)
        assert dynamics.mass_matrix(q).sum(axis=1) == pytest.approx(torque, abs=1e-9)


def test_forward_kinematics_and_jacobian_agree(tied: armctl.Arm):
    rng = np.random.default_rng(0)
    step = 1e-6
    many = tied.limits.random(tied.home, 5, rng)
    positions, rotations = tied.fk_many(many)
    for q, position, rotation in zip(many, positions, rotations, strict=True):
        assert np.allclose(tied.fk(q).position, position, atol=1e-12)
        assert np.allclose(tied.fk(q).rotation, rotation, atol=1e-12)
        moved = [tied.fk(q + step * e).position - tied.fk(q - step * e).position for e in np.eye(tied.n)]
        assert np.allclose(tied.jacobian(q)[:3], np.transpose(moved) / (2 * step), atol=1e-8)


def test_reachable_poses_are_found(tied: armctl.Arm):
    targets = [tied.fk(q) for q in tied.limits.random(tied.home, 200, np.random.default_rng(0))]
    assert solve_ik_batch(tied, targets).ok.all()
    for target in targets[:3]:
        result = armctl.solve_ik(tied, target)
        assert result.ok, result
        assert np.allclose(tied.fk(result.q).position, target.position, atol=1e-5)
        assert tied.limits.contains(result.q)


def test_computed_torque_is_exact_where_the_tie_is_rigid(tied: armctl.Arm):
    goal = tied.limits.clamp(tied.home + 0.2)
    sim = armctl.Simulation(tied)
    log = sim.run(armctl.move_j(tied, tied.home, goal), dwell=0.1)
    assert np.abs(log.q - log.q_ref).max() < 1e-6
    assert np.allclose(log.tau, log.tau_cmd, atol=1e-9), "what the motors make, they make at the arm's joints"
    joint_map = tied.joint_map
    assert np.allclose(sim.data.qpos[joint_map.qpos_adr], joint_map.positions(goal), atol=1e-5)


def test_chains_name_what_goes_along(load, tmp_path):
    load(limb("a b c d", FINGERS), ties("c b 0 0.5", "right left 0 -1") + motors("a b d left"))
    found = [(chain.tip, chain.joint_names, chain.followers) for chain in armctl.chains(tmp_path / "trap.xml")]
    assert found == [("D", ("a", "b", "d"), ("c",)), ("LEFT", ("left",), ("right",)), ("RIGHT", ("right",), ("left",))]


def test_limits_are_those_of_all_that_go_along(load):
    arm = load(limb("a b c"), ties("c b 0.5 -2") + motors("a b"))  # all in -2 .. 2: c is at its limits first
    assert arm.limits.q_min[1] == pytest.approx(-0.75)
    assert arm.limits.q_max[1] == pytest.approx(1.25)
    assert arm.limits.v_max[1] == pytest.approx(1.0)  # half of the default, for c turns twice as fast
    far = load(limb("a b c"), ties("b c 0.5 -2") + motors("a b"))
    assert far.limits.q_max[1] == pytest.approx(2.0)
    rope = tendon(b=0.5).replace('name="cable"', 'name="cable" limited="true" range="-0.3 0.4"')
    assert load(limb("a b"), rope + motors("a b")).limits.q_max == pytest.approx([2, 0.8])
    with pytest.raises(armctl.ModelError, match="joint 'b' and those that follow it have no position inside the limits of all"):
        load(limb("a b c"), ties("c b 5 0.1") + motors("a b"))


def test_torque_limits_count_at_the_joint(load):
    arm = load(limb("a b c"), ties("b c 0 -0.5") + motors("a c"))  # 20 N m at c, which turns twice as far as b
    assert arm.limits.tau_max == pytest.approx([20, 40])
    assert arm.gear == pytest.approx([1, -2])
    pulled = load(limb("a b c"), ties("c b 0 2") + tendon(b=0.5, c=0.25) + motors("a c", c=PULL))
    assert pulled.gear == pytest.approx([1, 3 * (0.5 + 2 * 0.25)])
    assert pulled.limits.tau_max == pytest.approx([20, 60])


def test_a_payload_at_a_tied_joint_is_known(load):
    arm = load(limb("a b c d"), ties("c b 0.1 -0.5") + motors("a b d"))
    heavy = arm.with_payload(0.5, [0, 0, 0.02])
    assert check_parity(heavy) < 1e-12
    plant = armctl.Plant(payload=0.5, payload_center=[0, 0, 0.02])
    log = armctl.simulate(arm, armctl.ComputedTorque(heavy), armctl.move_j(arm, arm.home, arm.home + 0.1), plant)
    assert np.abs(log.q - log.q_ref).max() < 1e-6
    with pytest.raises(armctl.ModelError, match="no payload can be identified where one joint follows another"):
        armctl.identify_payload(arm, log)


def test_inverse_kinematics_keeps_what_follows_clear_too(load):
    solid = limb("a b c d").replace('contype="0" conaffinity="0"', "")
    arm = load(solid, ties("c b 0.1 -0.5") + motors("a b d"))
    target = arm.fk(arm.home + 0.3).position
    wall = armctl.World().add("wall", armctl.Box([0.05, 0.05, 0.05]), target)
    arm = load(solid, ties("c b 0.1 -0.5") + motors("a b d"), scene=wall)
    assert armctl.solve_ik(arm, target).ok
    assert not armctl.solve_ik(arm, target, avoid=True).ok


def test_tied_chains_of_one_arm(load):
    bodies = limb("a", limb("b c")) + limb("d", limb("e f")).replace('pos="0.1 0 0.1"', 'pos="-0.6 0 0.1"', 1)
    arm = load(bodies, ties("c b 0 0.5", "f e 0 -1") + motors("a b d e"), tips=["C", "F"])
    log = armctl.simulate(
        arm, "computed-torque", armctl.move_j(arm, arm.home, arm.home + np.array([0.5, 0.5, 0.0, 0.0])), dwell=0.1
    )
    assert np.abs(log.q - log.q_ref).max() < 1e-6
    assert np.abs(log.q[:, 2:] - arm.home[2:]).max() < 1e-6


CABLE = f"<actuator>{PULL}</actuator>"
REFUSED = {
    "a curve": (
        '<equality><joint joint1="c" joint2="b" polycoef="0 1 1"/></equality>',
        "'c' is tied to 'b' by a curve, not a ratio",
    ),
    "a lock": ('<equality><joint name="pin" joint1="c"/></equality>', "joint 'c' is locked by the equality 'pin'"),
    "twice": (ties("c b 0 1", "b c 0 1"), "tied to 'c' twice by the equality"),
    "nobody": ("", "joint 'c' has no actuator of its own$"),
    "a free pair": (ties("d c 0 1"), "joint 'c' has no actuator of its own, nor has 'd', tied to it by equalities"),
    "a shared pull": (tendon(c=1, d=1) + CABLE, "joint 'c' shares the pull of the tendon 'cable'"),
    "a limited tendon": (
        tendon(c=1, b=-1).replace('name="cable"', 'name="cable" limited="true" range="0 1"'),
        "joint 'b' is coupled to others by the tendon 'cable'",
    ),
    "a springy tendon": (
        tendon(c=1).replace('name="cable"', 'name="cable" stiffness="3"') + CABLE,
        "joint 'c' is pulled by the tendon 'cable', and armctl does not model its spring, friction or bends",
    ),
    "a tie outside": (ties("c x 0 1") + tendon(x=1, y=1) + CABLE, "joint 'x' shares the pull of the tendon"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_no_one_actuator_moves_says_why(load, what: str):
    rest, sentence = REFUSED[what]
    with pytest.raises(
        armctl.ModelError, match=f"in the chain to 'C': .*{sentence.removesuffix('$')}.*; base= a body after this joint"
    ):
        load(limb("a b c d") + limb("x y"), rest + motors("a b"), tip="C")


def test_a_base_that_a_tied_joint_carries_is_refused(load):
    with pytest.raises(armctl.ModelError, match="joint 'c' is tied to 'a', which carries the base"):
        load(limb("a b c"), ties("c a 0 1") + motors("a b"), base="B")
    assert load(limb("a b c"), ties("c a 0 1") + motors("a b")).joint_names == ("a", "b")


def test_a_soft_tie_gives_way_and_a_rigid_one_does_not(load):
    errors = []
    for give in ("", RIGID):
        rest = f'<equality><joint joint1="c" joint2="b" {give}/></equality>{FAST}' + motors("a b")
        arm = load(limb("a b c"), rest)
        log = armctl.simulate(arm, "computed-torque", armctl.move_j(arm, arm.home, arm.home + 0.3))
        errors.append(np.abs(log.q - log.q_ref).max())
    assert errors[1] < 1e-6 < errors[0] < 1e-2


def test_ratios_go_both_ways_and_count_from_where_the_joints_are_drawn():
    bodies = limb("a b").replace('name="b"', 'name="b" ref="0.4"')
    model = mujoco.MjModel.from_xml_string(mjcf(bodies, ties("b a 0.1 2") + motors("a")))
    analysis = Transmissions(model)
    first = analysis.of(0)
    second = analysis.of(1)
    assert isinstance(first, Transmission)
    assert isinstance(second, Transmission)
    assert (first.coupled[1].ratio, first.coupled[1].offset) == pytest.approx((2, 0.5))  # 0.4 + 0.1 + 2 a
    assert (second.coupled[0].ratio, second.coupled[0].offset) == pytest.approx((0.5, -0.25))
    assert (first.gear, second.gear) == pytest.approx((1, 0.5))


def test_a_tie_starts_where_the_joints_are_drawn(load):
    """MuJoCo counts both joints of an equality from their `ref`; what it measures as the violation is the judge."""
    bodies = limb("a b c").replace('name="b"', 'name="b" ref="0.3"').replace('name="c"', 'name="c" ref="-0.2"')
    for tie in ("c b 0.1 -0.5", "b c 0.1 -0.5"):
        arm = load(bodies, ties(tie) + motors("a b"))
        data = mujoco.MjData(arm.model)
        for q in arm.limits.random(arm.home, 5, np.random.default_rng(0)):
            data.qpos[:] = arm.qpos(q)
            mujoco.mj_forward(arm.model, data)
            is_tie = data.efc_type[: data.nefc] == mujoco.mjtConstraint.mjCNSTR_EQUALITY
            assert np.abs(data.efc_pos[: data.nefc][is_tie]) == pytest.approx([0.0], abs=1e-12)


def test_the_limits_of_a_cable_over_tied_joints_are_reached_at_the_limits_of_the_arm(load):
    rope = tendon(b=0.5, c=0.25).replace('name="cable"', 'name="cable" limited="true" range="-0.3 0.4"')
    arm = load(limb("a b c"), ties("c b 0.6 0.8") + rope + motors("a b"))
    data = mujoco.MjData(arm.model)
    for q, length in ((arm.limits.q_min, -0.3), (arm.limits.q_max, 0.4)):
        data.qpos[:] = arm.qpos(np.array([0.0, q[1]]))
        mujoco.mj_forward(arm.model, data)
        assert data.ten_length == pytest.approx([length])


def test_a_spring_between_the_fingers_leaves_the_arm_alone(load):
    """Joints that move both ends of a cable do not change its length."""
    fingers = '<site name="root" pos="0 0 0.05"/>' + limb("left", '<site name="nail" pos="0.1 0 0.1"/>')
    spring = '<tendon><spatial name="spring" stiffness="5"><site site="root"/><site site="nail"/></spatial></tendon>'
    arm = load(limb("a b", fingers), FAST + spring + motors("a b"))
    assert arm.joint_names == ("a", "b")
    with pytest.raises(armctl.ModelError, match="joint 'left' is pulled by the tendon 'spring'"):
        load(limb("a b", fingers), FAST + spring + motors("a b left"), tip="LEFT")


def test_joints_lead_what_follows_them_in_each_chain(load):
    bodies = limb("a", limb("b c")) + limb("d", limb("e f")).replace('pos="0.1 0 0.1"', 'pos="-0.6 0 0.1"', 1)
    together = load(bodies, ties("c b 0.3 0.5", "f e 0 -1") + motors("a b d e"), tips=["C", "F"]).joint_map
    q = np.array([0.1, 0.2, 0.3, 0.4])
    assert together.positions(q)[together.leaders] == pytest.approx(q)
    assert together.positions(q) == pytest.approx([0.1, 0.2, 0.4, 0.3, 0.4, -0.4])
