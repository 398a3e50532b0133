"""Several arms: planned together, proved against each other, and refused with names."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

import armctl
from armctl.model.collision.checkers import collision_checker
from armctl.plan.planner.team_planner import ArmGroup, combined, plan_together

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
def arms(tmp_path_factory) -> tuple[armctl.Arm, ...]:
    motors = "".join(f'<motor joint="{s}{i}" ctrlrange="-80 80"/>' for s in ("left", "right") for i in range(len(LINKS)))
    text = (
        f'<mujoco><compiler angle="radian"/><worldbody>{limb("left", -0.35)}{limb("right", 0.35)}</worldbody>'
        f"<actuator>{motors}</actuator></mujoco>"
    )
    path = tmp_path_factory.mktemp("pair") / "pair.xml"
    path.write_text(text)
    return armctl.load_arms(path, ["left_tip", "right_tip"])


LEFT_INWARDS = np.array([0.0, 0.8, 0.3, 0.0])
RIGHT_INWARDS = np.array([0.0, -0.8, -0.3, 0.0])
UP = np.array([0.5, 0.3, 0.2, 0.0])


def team_at(arms, left: np.ndarray, right: np.ndarray) -> armctl.Team:
    """A team whose arms were moved to configurations one after the other, straight."""
    team = armctl.Team(arms)
    for arm, q in zip(arms, (left, right), strict=True):
        team.run({arm.tip: armctl.move_j(arm, arm.home, q)}, dwell=0.2)
    return team


def touches(team: armctl.Team) -> list[str]:
    return [str(contact) for log in team.logs.values() for contact in log.contacts]


def test_arms_exchange_places_without_contact(arms):
    left, right = arms
    team = team_at(arms, LEFT_INWARDS, -UP)
    results = team.move_to({"left_tip": left.fk(UP), "right_tip": right.fk(RIGHT_INWARDS)})
    assert all(result.ok for result in results.values()), results
    assert touches(team) == []


def exchanged(arms: tuple[armctl.Arm, ...]) -> list[armctl.JointTrajectory]:
    """The arms exchange places, planned together: each straight way would touch the other arm."""
    group = ArmGroup.from_arms(arms)
    left, right = arms
    starts = {left.tip: LEFT_INWARDS, right.tip: -UP}
    solutions = {left.tip: [UP], right.tip: [RIGHT_INWARDS]}
    checker = collision_checker(group, group.home_qpos)
    return list(plan_together(checker, {arm.tip: arm for arm in arms}, starts, solutions, 1.0).values())


def test_where_motors_are_weak_both_arms_are_slower_by_one_factor_that_is_hardly_more_than_needed(arms):
    left, right = arms
    weak = left.with_limits(replace(left.limits, tau_max=0.12 * left.limits.tau_max))
    slow = exchanged((weak, right))
    factors = [motion.duration / full.duration for motion, full in zip(slow, exchanged(arms), strict=True)]
    assert factors[0] == pytest.approx(factors[1])
    assert factors[0] > 1.2
    assert 0.9 < armctl.check_torque(weak, slow[0]).ratio <= 1.0


def test_targets_in_the_same_place_are_refused_with_the_bodies(arms):
    team = armctl.Team(arms)
    results = team.move_to({"left_tip": [0.0, 0.0, 0.4], "right_tip": [0.0, 0.0, 0.4]})
    assert not any(result.ok for result in results.values())
    assert all("left_link" in result.reason and "right_link" in result.reason for result in results.values())


def test_without_avoidance_both_go_straight_and_touch(arms):
    team = armctl.Team(arms)
    results = team.move_to({"left_tip": [0.0, 0.0, 0.4], "right_tip": [0.0, 0.0, 0.4]}, avoid=False)
    assert touches(team)
    assert all(result.log is not None for result in results.values())


def test_an_arm_out_of_reach_holds_and_the_other_moves(arms):
    left, _ = arms
    results = armctl.Team(arms).move_to({"left_tip": left.fk(left.home + 0.2).position, "right_tip": [5.0, 0.0, 0.0]})
    assert results["left_tip"].ok
    assert not results["right_tip"].ok
    assert "out of reach" in results["right_tip"].reason


def test_combined_motions_are_the_motions(arms):
    left, right = arms
    motions = {
        "left_tip": armctl.move_j(left, left.home, LEFT_INWARDS),
        "right_tip": armctl.move_through(right, [right.home, 0.5 * RIGHT_INWARDS, RIGHT_INWARDS]),
    }
    columns = {"left_tip": slice(0, 4), "right_tip": slice(4, 8)}
    knots, coefficients = combined(motions, columns, np.zeros(8))
    for time in np.linspace(0.0, knots[-1], 200):
        k = min(int(np.searchsorted(knots, time, side="right")), len(knots) - 1) - 1
        q = sum(coefficients[k, i] * (time - knots[k]) ** i for i in range(6))
        expected = np.concatenate([motion(float(time)).q for motion in motions.values()])
        np.testing.assert_allclose(q, expected, atol=1e-9)


def test_a_group_touches_where_mujoco_says_so(arms):
    group = ArmGroup.from_arms(arms)
    checker = collision_checker(group, group.home_qpos)
    between = 0
    inwards = np.concatenate([LEFT_INWARDS, RIGHT_INWARDS])
    for q in inwards + np.random.default_rng(1).uniform(-0.6, 0.6, (300, 8)):
        data = mujoco.MjData(group.model)
        data.qpos[group.joint_map.qpos_adr] = group.joint_map.positions(q)
        mujoco.mj_kinematics(group.model, data)
        mujoco.mj_collision(group.model, data)
        owners = group.model.geom_bodyid[data.contact.geom]
        parents = group.model.body_parentid
        far = [(a, b) for a, b in owners.tolist() if parents[a] != b and parents[b] != a]
        assert (checker.hit(q) >= 0) == bool(far)
        between += any(len({group.model.body(body).name[0] for body in pair}) == 2 for pair in far)  # left and right
    assert between > 5
