"""The world of a simulation: moves keep clear of what is seen in it, and the tip carries what is attached."""

import numpy as np
import pytest
from collidable import arm_among

import armctl
from armctl import Ball, Box, Cylinder, InputError, Pose, UnknownNameError
from armctl.model.collision.checkers import collision_checker

pytestmark = pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")

CRATE = '<body name="crate" pos="0.4 0.4 0.05"><freejoint/><geom name="crate_box" type="box" size="0.05 0.05 0.05"/></body>'


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> armctl.Arm:
    return arm_among(tmp_path_factory.mktemp("crate"), CRATE)


@pytest.fixture
def sim(arm) -> armctl.Simulation:
    return armctl.Simulation(arm)


def goal_of(arm: armctl.Arm) -> np.ndarray:
    return arm.limits.clamp(arm.home + np.array([1.2, 0.8, 0.6, 0.0, 0.4, 0.0]))


def test_a_move_goes_around_what_was_added_to_the_world(arm, sim):
    direct = armctl.move_j(arm, arm.home, goal_of(arm))
    halfway = direct(0.5 * direct.duration).q
    sim.world.add("lamp", Ball(0.06), arm.fk(halfway).position)
    result = sim.move_j(goal_of(arm))
    assert result.ok
    radii = np.linalg.norm([arm.fk(q).position - arm.fk(halfway).position for q in result.log.q], axis=1)
    assert radii.min() > 0.06 + 0.04
    sim.world.move("lamp", arm.fk(arm.home).position)
    refused = sim.move_j(arm.home)
    assert not refused.ok
    assert "lamp" in refused.reason
    sim.world.remove("lamp")
    assert sim.move_j(arm.home).ok


def test_an_attached_body_is_taken_from_where_it_is_and_left_where_it_is(arm, sim):
    at = sim.tip @ Pose([0.0, 0.0, 0.2])
    sim.world.add("stick", Cylinder(0.01, 0.2), at, mass=0.5)
    sim.world.attach("stick")
    body = sim.world["stick"]
    assert body.tip == arm.tip
    assert body.pose.position == pytest.approx([0.0, 0.0, 0.2], abs=1e-9)
    assert sim.move_j(arm.limits.clamp(arm.home + 0.3)).ok
    sim.world.detach("stick")
    expected = sim.tip @ Pose([0.0, 0.0, 0.2])
    assert sim.world["stick"].pose.position == pytest.approx(expected.position, abs=1e-9)
    assert sim.world["stick"].tip is None


def test_what_the_tip_carries_meets_the_scene(arm, sim):
    sim.world.add("stick", Cylinder(0.01, 0.3), sim.tip @ Pose([0.0, 0.0, 0.16])).attach("stick")
    alone = collision_checker(arm)
    carrying = collision_checker(arm, world=sim.world)
    goal = next(
        q
        for q in arm.limits.random(arm.home, 20_000, np.random.default_rng(2))
        if not alone.at(q) and {"stick", "crate"} == set(carrying.at(q).split(" touches "))
    )
    refused = sim.move_j(goal)
    assert not refused.ok
    assert "stick" in refused.reason
    assert "crate" in refused.reason
    assert sim.move_j(goal, allow=[("stick", "crate")]).ok
    sim.world.allow("stick", "crate")
    assert sim.move_j(arm.home).ok


def test_bodies_of_the_model_can_be_attached_and_the_robot_cannot(sim):
    sim.world.attach("crate")
    assert (sim.world["crate"].shape, sim.world.snapshot().carried_bodies(sim.arm)) == (
        None,
        {sim.arm.model.body("crate").id: sim.arm.tip_body},
    )
    sim.world.detach("crate")
    assert "crate" not in sim.world
    with pytest.raises(InputError, match="link2 is a part of the robot"):
        sim.world.attach("link2")
    with pytest.raises(InputError, match="at: crate is a body of the model"):
        sim.world.attach("crate", [0.0, 0.0, 0.0])
    with pytest.raises(InputError, match="the arm's model has a body crate already"):
        sim.world.add("crate", Box([0.1, 0.1, 0.1]))
    with pytest.raises(UnknownNameError, match="body in the world"):
        sim.world.attach("nothing")
    with pytest.raises(UnknownNameError, match="tip"):
        sim.world.add("ball", Ball(0.1)).attach("ball", tip="left")
