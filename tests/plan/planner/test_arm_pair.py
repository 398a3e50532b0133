"""Two arms of one robot: planned together, proved against each other, and refused with names."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

import armctl
from armctl.model.collision.checkers import collision_checker

LINKS = (("0 0 1", 0.1), ("0 1 0", 0.3), ("0 1 0", 0.25), ("0 1 0", 0.1))

pytestmark = pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")


def limb(side: str, x: float) -> str:
    opened = ""
    height = 0.05
    for i, (axis, length) in enumerate(LINKS):
        place = f"{x} 0 {height}" if i == 0 else f"0 0 {height}"
        joint = f'<joint name="{side}{i}" axis="{axis}" range="-2.6 2.6" armature="0.02"/>'
        geom = f'<geom type="capsule" fromto="0 0 0 0 0 {length}" size="0.04" mass="0.5"/>'
        opened += f'<body name="{side}_link{i}" pos="{place}">{joint}{geom}'
        height = length
    return f'{opened}<site name="{side}_tip" pos="0 0 {height}"/>{"</body>" * len(LINKS)}'


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> armctl.Arm:
    motors = "".join(f'<motor joint="{s}{i}" ctrlrange="-80 80"/>' for s in ("left", "right") for i in range(len(LINKS)))
    text = (
        f'<mujoco><compiler angle="radian"/><worldbody>{limb("left", -0.35)}{limb("right", 0.35)}</worldbody>'
        f"<actuator>{motors}</actuator></mujoco>"
    )
    path = tmp_path_factory.mktemp("pair") / "pair.xml"
    path.write_text(text)
    return armctl.load(path)


INWARDS = np.array([0.0, 0.8, 0.3, 0.0, 0.0, -0.8, -0.3, 0.0])
LEFT_INWARDS = np.array([0.0, 0.8, 0.3, 0.0, -0.5, -0.3, -0.2, 0.0])
RIGHT_INWARDS = np.array([0.5, 0.3, 0.2, 0.0, 0.0, -0.8, -0.3, 0.0])
TIPS = ("left_tip", "right_tip")


def touching(arm: armctl.Arm, q: np.ndarray) -> list[list[int]]:
    """The pairs of bodies that touch at q for MuJoCo, but for neighbours."""
    data = mujoco.MjData(arm.model)
    data.qpos[:] = arm.qpos(q)
    mujoco.mj_kinematics(arm.model, data)
    mujoco.mj_collision(arm.model, data)
    parents = arm.model.body_parentid
    owners = arm.model.geom_bodyid[data.contact.geom].tolist()
    return [pair for pair in owners if parents[pair[0]] != pair[1] and parents[pair[1]] != pair[0]]


def test_arms_exchange_places_without_contact(arm):
    assert arm.tips == TIPS
    straight = armctl.move_j(arm, LEFT_INWARDS, RIGHT_INWARDS)
    assert any(touching(arm, straight(t).q) for t in np.linspace(0.0, straight.duration, 500))
    sim = armctl.Simulation(arm)
    sim.reset(q=LEFT_INWARDS)
    result = sim.move_to({tip: arm.fk(RIGHT_INWARDS, tip) for tip in TIPS})
    assert result, result.reason
    assert result.contacts == ()
    assert not any(touching(arm, q) for q in result.log.q)


def test_weak_motors_of_one_arm_slow_both_down_hardly_more_than_needed(arm):
    share = np.repeat([0.07, 1.0], 4)
    weak = arm.with_limits(replace(arm.limits, tau_max=share * arm.limits.tau_max))
    fast = armctl.move_free(arm, LEFT_INWARDS, RIGHT_INWARDS)
    slow = armctl.move_free(weak, LEFT_INWARDS, RIGHT_INWARDS)
    assert armctl.check_clearance(weak, slow)
    assert slow.duration > 1.2 * fast.duration
    assert 0.9 < armctl.check_torque(weak, slow).ratio <= 1.0


def test_targets_in_the_same_place_are_refused_with_the_bodies(arm):
    result = armctl.Simulation(arm).move_to({tip: [0.0, 0.0, 0.4] for tip in TIPS})
    assert not result
    assert "left_link" in result.reason
    assert "right_link" in result.reason
    assert result.log is None


def test_without_avoidance_both_go_straight_and_touch(arm):
    result = armctl.Simulation(arm).move_to({tip: [0.0, 0.0, 0.4] for tip in TIPS}, avoid=False)
    assert result.contacts


def test_the_checker_of_both_arms_finds_a_contact_where_mujoco_does(arm):
    checker = collision_checker(arm)
    between = 0
    for q in INWARDS + np.random.default_rng(1).uniform(-0.6, 0.6, (300, 8)):
        pairs = touching(arm, q)
        assert (checker.hit(q) >= 0) == bool(pairs)
        between += any(len({arm.model.body(body).name[0] for body in pair}) == 2 for pair in pairs)  # left and right
    assert between > 5
