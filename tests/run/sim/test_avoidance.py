"""Moves go around what is in the way now, or are refused with names; `avoid=False` and `allow` let them touch."""

import numpy as np
import pytest
from collidable import arm_among

import armctl

WALL = '<geom name="wall" type="box" size="0.3 0.02 0.45" pos="0.45 0 0.45"/>'
START = np.array([-0.8, 1.0, 0.4, 0.0, 0.3, 0.0])
GOAL = np.array([0.8, 1.0, 0.4, 0.0, 0.3, 0.0])

pytestmark = pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> armctl.Arm:
    return arm_among(tmp_path_factory.mktemp("wall"), WALL)


def simulation_at(arm: armctl.Arm, q: np.ndarray) -> armctl.Simulation:
    sim = armctl.Simulation(arm)
    sim.reset(q)
    return sim


@pytest.mark.parametrize("kind", ["joints", "pose", "point"])
def test_a_move_goes_around_a_wall_and_touches_nothing(arm, kind):
    sim = simulation_at(arm, START)
    pose = arm.fk(GOAL)
    result = sim.move_j(GOAL) if kind == "joints" else sim.move_to(pose if kind == "pose" else pose.position)
    assert result.ok, result
    assert result.contacts == ()


def test_without_avoidance_the_arm_runs_into_the_wall(arm):
    result = simulation_at(arm, START).move_j(GOAL, avoid=False)
    assert any("wall" in str(contact) for contact in result.contacts)


def test_a_line_through_the_wall_is_refused_with_bodies_and_time_before_anything_moves(arm):
    sim = simulation_at(arm, START)
    start = arm.fk(START).position
    result = sim.move_l(start + np.array([0.0, 2 * abs(start[1]), 0.0]))
    assert not result
    assert "wall" in result.reason
    assert " s" in result.reason
    assert sim.data.time == 0.0
    np.testing.assert_array_equal(sim.state.q, START)


def test_a_target_in_the_wall_is_refused_and_may_be_allowed(arm):
    sim = simulation_at(arm, START)
    touching = START + np.array([0.62, 0, 0, 0, 0, 0])
    refused = sim.move_j(touching)
    assert not refused
    assert "without contact" in refused.reason
    allowed = sim.move_j(touching, allow=[(f"link{i}", "wall") for i in range(6)])
    assert allowed.log is not None


def test_an_unknown_name_in_allow_is_an_error(arm):
    with pytest.raises(armctl.UnknownNameError, match="wal"):
        simulation_at(arm, START).move_j(GOAL, allow=[("link1", "wal")])


def test_a_loose_body_is_where_the_simulation_has_it_now(tmp_path):
    """A post beside the arm is put where the goal is."""
    post = '<body name="post" pos="-1 -1 0.5"><freejoint/><geom type="box" size="0.02 0.02 0.5" mass="1"/></body>'
    arm = arm_among(tmp_path, post)
    assert simulation_at(arm, START).move_j(GOAL).ok
    sim = simulation_at(arm, START)
    address = arm.model.jnt_qposadr[arm.model.body("post").jntadr[0]]
    sim.data.qpos[address : address + 2] = arm.fk(GOAL).position[:2]
    refused = sim.move_j(GOAL)
    assert not refused.ok
    assert "post" in refused.reason


def test_a_height_field_is_a_refusal_that_says_what_to_do(tmp_path):
    arm = arm_among(tmp_path, '<geom type="hfield" name="hills" hfield="hills" pos="0 0 -0.5"/>', HILLS)
    result = armctl.Simulation(arm).move_j(arm.home + 0.1)
    assert not result
    assert "hills" in result.reason
    assert armctl.Simulation(arm).move_j(arm.home + 0.1, avoid=False).ok


HILLS = '<hfield name="hills" nrow="3" ncol="3" elevation="0 0 0 0 1 0 0 0 0" size="1 1 0.1 0.1"/>'


def test_the_same_call_gives_the_same_bits(arm):
    logs = [simulation_at(arm, START).move_j(GOAL).log for _ in range(2)]
    np.testing.assert_array_equal(logs[0].q, logs[1].q)


def test_avoid_is_true_or_false(arm):
    with pytest.raises(armctl.InputError, match="avoid"):
        simulation_at(arm, START).move_j(GOAL, avoid="no")
