"""Motions around obstacles: proved free, inside every limit, the same bits for the same seed, and refusals with names."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from arms import HELPERS
from collidable import arm_among, placed

import armctl
from armctl.core.target import Target
from armctl.model.collision.checkers import collision_checker
from armctl.plan.planner.free_space import CLEARANCE_M
from armctl.plan.planner.goals import FreeGoals, GoalSearch

WALL = '<geom name="wall" type="box" size="0.3 0.02 0.45" pos="0.45 0 0.45"/>'
START = np.array([-0.8, 1.0, 0.4, 0.0, 0.3, 0.0])
GOAL = np.array([0.8, 1.0, 0.4, 0.0, 0.3, 0.0])

pytestmark = pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> armctl.Arm:
    return arm_among(tmp_path_factory.mktemp("wall"), WALL)


def assert_free(arm: armctl.Arm, motion: armctl.JointTrajectory) -> None:
    assert armctl.check_clearance(arm, motion)
    assert motion.check_limits().ok
    assert armctl.check_torque(arm, motion).ok
    for q in motion.sample(np.arange(0.0, motion.duration, 2e-3)).q:
        assert not any(contact.dist < 0.0 for contact in placed(arm, q).contact)


def test_it_goes_around_a_wall_that_the_straight_move_runs_into(arm):
    assert not armctl.check_clearance(arm, armctl.move_j(arm, START, GOAL))
    motion = armctl.move_free(arm, START, GOAL)
    assert_free(arm, motion)
    np.testing.assert_allclose(motion(0.0).q, START, atol=1e-12)
    np.testing.assert_allclose(motion(motion.duration).q, GOAL, atol=1e-12)
    np.testing.assert_allclose(motion(motion.duration).v, 0.0, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_the_way_around_has_no_shortcut(arm, seed):
    """The straight line between two places on the way saves little wherever it is free."""
    motion = armctl.move_free(arm, START, GOAL, seed=seed)
    q = motion.sample(np.linspace(0.0, motion.duration, 400)).q
    way = np.append(0.0, np.linalg.norm(np.diff(q, axis=0), axis=1).cumsum())
    checker = collision_checker(arm)
    pairs = np.sort(np.random.default_rng(seed).integers(0, len(q), (300, 2)))
    free = [(i, j) for i, j in pairs if checker.line_hit(q[i], q[j], 2e-3) is None]
    assert len(free) > 50
    assert max(way[j] - way[i] - np.linalg.norm(q[j] - q[i]) for i, j in free) < 0.1 * way[-1]


@pytest.mark.full
def test_weak_motors_make_the_way_around_slower_and_not_stop_on_it(arm):
    weak = arm.with_limits(replace(arm.limits, tau_max=0.25 * arm.limits.tau_max))
    motion = armctl.move_free(weak, START, GOAL)
    assert_free(weak, motion)
    assert motion.duration > 1.5 * armctl.move_free(arm, START, GOAL).duration
    inside = motion.sample(np.linspace(0.05, 0.95, 300) * motion.duration)
    assert np.abs(inside.v).max(axis=1).min() > 0.02


def test_it_starts_while_the_arm_moves_and_goes_around_the_wall(arm):
    first = armctl.move_j(arm, START - 0.2, START + np.array([0.3, 0.0, 0.3, 0.1, 0.0, 0.0]))
    state = first(0.5 * first.duration)
    motion = armctl.move_free(arm, state, GOAL)
    assert_free(arm, first.until(0.5 * first.duration).then(motion))
    for given, started in zip(state[:3], motion(0.0)[:3], strict=True):
        np.testing.assert_allclose(started, given, atol=1e-9)
    np.testing.assert_allclose(motion(motion.duration).q, GOAL, atol=1e-12)


@pytest.mark.parametrize(
    "share", [pytest.param(1.0001, marks=pytest.mark.nightly), 1.05, pytest.param(1.3, marks=pytest.mark.nightly)]
)
def test_a_start_beyond_a_speed_limit_is_braked_into_it_on_the_way_around_the_wall(arm, share):
    """A joint is beyond its limit no longer than a lone joint that brakes with the limits of acceleration and jerk."""
    v = np.zeros(arm.n)
    v[4] = share * arm.limits.v_max[4]
    motion = armctl.move_free(arm, armctl.Setpoint(START, v, np.zeros(arm.n)), GOAL)
    assert armctl.check_clearance(arm, motion)
    np.testing.assert_allclose(motion(0.0).v, v, atol=1e-9)
    np.testing.assert_allclose(motion(motion.duration).q, GOAL, atol=1e-9)
    np.testing.assert_allclose(motion(motion.duration).v, 0.0, atol=1e-9)
    excess = v[4] - arm.limits.v_max[4]
    a_max = arm.limits.a_max[4]
    j_max = arm.limits.j_max[4]
    alone = max(np.sqrt(2 * excess / j_max), excess / a_max + 0.5 * a_max / j_max)
    times = np.arange(0.0, motion.duration, 1e-4)
    moved = motion.sample(times)
    beyond = (np.abs(moved.v) > arm.limits.v_max * (1 + 1e-9)).any(axis=1)
    assert times[beyond].max(initial=0.0) <= alone + 2e-4
    assert (np.abs(moved.a) <= arm.limits.a_max * (1 + 1e-6)).all()
    for q in moved.q[::20]:
        assert not any(contact.dist < 0.0 for contact in placed(arm, q).contact)


def test_a_start_towards_the_wall_from_which_the_arm_cannot_stop_is_refused(arm):
    into = armctl.move_j(arm, START, GOAL)
    times = np.linspace(0.0, into.duration, 200)
    last = max(t for t in times if armctl.check_clearance(arm, into.until(t)).ok)
    state = into(last)
    with pytest.raises(armctl.PlanError, match=r"^start: the arm cannot stop in time: .*wall.*; start slower or allow"):
        armctl.move_free(arm, state, GOAL)


@pytest.mark.parametrize("gap", [5e-5, 5e-6])
def test_an_end_that_almost_touches_is_reached_and_left_around_the_wall(arm, tmp_path, gap):
    """The tip link ends a hair above a box."""
    data = placed(arm, GOAL)
    geom = int(np.flatnonzero(arm.model.geom_bodyid == arm.tip_body)[0])
    axis = data.geom_xmat[geom].reshape(3, 3)[:, 2] * arm.model.geom_size[geom, 1]
    x, y, z = data.geom_xpos[geom] - np.sign(axis[2]) * axis - np.array([0.0, 0.0, arm.model.geom_size[geom, 0] + gap + 0.01])
    near = arm_among(tmp_path, WALL + f'<geom name="box" type="box" size="0.02 0.02 0.01" pos="{x} {y} {z:.9f}"/>')
    assert collision_checker(near).nearest(GOAL)[1] == pytest.approx(gap, abs=1e-6)
    assert_free(near, armctl.move_free(near, START, GOAL))
    assert_free(near, armctl.move_free(near, GOAL, START))


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("gap", [3e-4, 2e-5])
def test_an_end_that_almost_touches_something_lets_the_arm_come_near_to_nothing_else(arm, tmp_path, gap, seed):
    """The distance to the wall is that of MuJoCo alone."""
    checker = collision_checker(arm)
    tip = arm.fk(START).position
    near = f'<geom name="post" type="sphere" size="0.01" pos="{tip[0]} {tip[1]} {{z}}"/>'
    # The post stands below the tip, so near that the gap is left.
    low, high = 0.0, tip[2]
    for _ in range(60):
        middle = 0.5 * (low + high)
        beside = arm_among(tmp_path, WALL + near.format(z=middle))
        if collision_checker(beside).nearest(START)[1] > gap:
            low = middle
        else:
            high = middle
    beside = arm_among(tmp_path, WALL + near.format(z=low))
    assert 0.5 * gap < collision_checker(beside).nearest(START)[1] < min(2 * gap, checker.nearest(START)[1])
    motion = armctl.move_free(beside, START, GOAL, seed=seed)
    assert_free(beside, motion)
    wall = beside.model.geom("wall").id
    moving = np.flatnonzero((beside.model.geom_bodyid > 0) & (beside.model.geom_contype > 0)).tolist()
    for q in motion.sample(np.arange(0.0, motion.duration, 2e-3)).q:
        data = placed(beside, q)
        for geom in moving:
            assert mujoco.mj_geomDistance(beside.model, data, geom, wall, 0.05, None) > 0.5 * CLEARANCE_M


def test_a_straight_move_that_is_free_is_taken(arm):
    straight = armctl.move_j(arm, START, START + 0.1)
    motion = armctl.move_free(arm, START, START + 0.1)
    np.testing.assert_array_equal(motion.coefficients, straight.coefficients)


def test_half_the_speed_takes_twice_as_long_on_a_straight_move(arm):
    fast = armctl.move_free(arm, START, START + 0.1)
    slow = armctl.move_free(arm, START, START + 0.1, speed=0.5)
    assert slow.duration == pytest.approx(2 * fast.duration, rel=0.05)


@pytest.mark.parametrize("kind", ["pose", "point", "list"])
def test_a_goal_is_a_pose_a_point_or_a_list(arm, kind):
    pose = arm.fk(GOAL)
    goal = {"pose": pose, "point": pose.position, "list": [arm.fk(START + 9e-2), GOAL]}[kind]
    motion = armctl.move_free(arm, START, goal)
    assert_free(arm, motion)
    reached = arm.fk(motion(motion.duration).q)
    if kind == "point":
        np.testing.assert_allclose(reached.position, pose.position, atol=1e-4)
    if kind == "pose":
        assert max(reached.distance(pose)) < 1e-3


def test_the_same_seed_gives_the_same_bits_in_another_process(arm, tmp_path):
    folders = [str(Path(__file__).parent), str(HELPERS)]
    code = (
        f"import sys, hashlib, warnings; warnings.simplefilter('ignore'); sys.path[:0] = {folders}\n"
        "from pathlib import Path; from collidable import arm_among; import armctl\n"
        "from test_move_free import WALL, START, GOAL\n"
        f"arm = arm_among(Path({str(tmp_path)!r}), WALL)\n"
        "print(hashlib.sha256(armctl.move_free(arm, START, GOAL, seed=3).coefficients.tobytes()).hexdigest())"
    )
    hashes = {subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout for _ in range(2)}
    assert len(hashes) == 1
    here = armctl.move_free(arm, START, GOAL, seed=3)
    again = armctl.move_free(arm, START, GOAL, seed=3)
    np.testing.assert_array_equal(here.coefficients, again.coefficients)


def test_a_start_that_touches_is_refused_with_the_bodies_and_the_depth(arm):
    inside = np.array([0.0, 1.0, 0.4, 0.0, 0.3, 0.0])
    with pytest.raises(armctl.PlanError, match=r"^start: link\d is \d+\.\d mm inside wall|^start: wall"):
        armctl.move_free(arm, inside, GOAL)


def test_a_goal_that_touches_is_refused_with_the_bodies(arm):
    inside = np.array([0.0, 1.0, 0.4, 0.0, 0.3, 0.0])
    with pytest.raises(armctl.PlanError, match=r"without contact: .*wall"):
        armctl.move_free(arm, START, inside)


def test_a_contact_that_is_allowed_may_be_made(arm):
    touching = next(
        GOAL - np.array([angle, 0, 0, 0, 0, 0])
        for angle in np.linspace(0.0, 0.8, 200)
        if collision_checker(arm).hit(GOAL - np.array([angle, 0, 0, 0, 0, 0])) >= 0
    )
    pairs = [(f"link{i}", "wall") for i in range(6)]
    motion = armctl.move_free(arm, GOAL, touching, allow=pairs)
    assert motion.duration > 0.0


def test_a_goal_out_of_reach_says_so(arm):
    with pytest.raises(armctl.PlanError, match="out of reach"):
        armctl.move_free(arm, START, [5.0, 0.0, 0.0])


def test_a_goal_behind_closed_walls_is_given_up_after_counted_samples(tmp_path, monkeypatch):
    walls = "".join(f'<geom type="box" size="1 0.01 2" pos="{side * 1.06} 0 1"/>' for side in (-1, 1))
    arm = arm_among(tmp_path, walls)
    monkeypatch.setattr("armctl.plan.planner.move_free.MAX_SAMPLES", 300)
    with pytest.raises(armctl.PlanError, match="no collision-free path found after 300 samples"):
        armctl.move_free(arm, np.array([-1.4, *START[1:]]), np.array([1.4, *GOAL[1:]]))


def test_what_the_tip_holds_must_not_touch_either(tmp_path):
    stick = '<body name="stick" pos="0 0 1.25"><freejoint/><geom type="capsule" size="0.02 0.15" mass="0.1"/></body>'
    bar = '<geom name="bar" type="box" size="0.02 0.5 0.02" pos="0.35 0 1.1"/>'
    arm = arm_among(tmp_path, stick + bar)
    start = np.zeros(6)
    goal = np.array([0.0, 0.5, 0.0, 0.0, 0.0, 0.0])
    empty = armctl.move_free(arm, start, goal, allow=[("stick", f"link{i}") for i in range(6)])
    assert empty.duration > 0.0
    carried = armctl.move_free(arm, start, start - 0.05, holding="stick")
    assert carried.duration > 0.0
    with pytest.raises(armctl.PlanError, match="stick"):
        armctl.move_free(arm, start, np.array([0.0, 0.37, 0.0, 0.0, 0.0, 0.0]), holding="stick")


LOW_WALL = '<geom name="wall" type="box" size="0.3 0.02 0.15" pos="0.45 0 0.15"/>'
POURING = np.array([-0.8, 1.2, 0.9, 0.0, np.pi - 2.1, 0.0])  # the tip points down
POURED = np.array([0.8, 1.2, 0.9, 0.0, np.pi - 2.1, 0.0])


@pytest.fixture(scope="module")
def waiter(tmp_path_factory) -> armctl.Arm:
    return arm_among(tmp_path_factory.mktemp("low_wall"), LOW_WALL)


def tilt(arm: armctl.Arm, q: np.ndarray) -> float:
    return float(np.arccos(np.clip(arm.fk(POURING).rotation[:, 2] @ arm.fk(q).rotation[:, 2], -1.0, 1.0)))


@pytest.mark.parametrize("within", [0.2, 0.05])
def test_an_axis_keeps_its_direction_around_a_wall(waiter, within):
    motion = armctl.move_free(waiter, POURING, POURED, keep="z", keep_within=within)
    assert_free(waiter, motion)
    assert max(tilt(waiter, q) for q in motion.sample(np.linspace(0.0, motion.duration, 500)).q) <= within
    assert armctl.check_clearance(waiter, motion, keep="z", keep_within=within)
    unkept = armctl.check_clearance(waiter, armctl.move_free(waiter, POURING, POURED), keep="z", keep_within=within)
    assert not unkept
    assert "the tip's z axis tilts by more than" in unkept.reason


def test_a_point_is_reached_with_the_axis_kept(waiter):
    motion = armctl.move_free(waiter, POURING, waiter.fk(POURED).position, keep="z")
    assert tilt(waiter, motion(motion.duration).q) < 1e-3


def test_a_goal_that_tilts_the_axis_is_refused(waiter):
    tilted = POURED + np.array([0.0, 0.0, 0.0, 0.0, 0.3, 0.0])
    with pytest.raises(armctl.PlanError, match=r"goal: the tip's z axis tilts by 0\.3 rad .* expected less than 0\.1"):
        armctl.move_free(waiter, POURING, tilted, keep="z")


def test_a_tilt_that_no_sample_sees_is_found(waiter):
    """A joint leaves for a moment shorter than any sample's step and comes back."""
    there = POURING + np.array([0.0, 0.0, 0.0, 0.0, 0.02, 0.0])
    out = armctl.move_j(waiter, POURING, there).then(armctl.move_j(waiter, there, POURING))
    waiting = armctl.move_j(waiter, POURING, POURING - np.array([0.6, 0, 0, 0, 0, 0]), speed=0.01)
    motion = out.then(waiting)
    assert armctl.check_clearance(waiter, motion, keep="z", keep_within=0.0201)
    refused = armctl.check_clearance(waiter, motion, keep="z", keep_within=0.0199)
    assert not refused
    assert refused.time == pytest.approx(out.duration / 2, abs=0.1)


def test_a_simulated_move_keeps_the_axis(waiter):
    sim = armctl.Simulation(waiter)
    sim.reset(POURING)
    assert sim.move_to(waiter.fk(POURED).position, keep="z")
    assert max(tilt(waiter, q) for q in sim.log.q_ref) <= 0.1
    with pytest.raises(armctl.InputError, match="avoid=True"):
        sim.move_to(waiter.fk(POURING), keep="z", avoid=False)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"goal": "home"}, armctl.InputError, "goal"),
        ({"goal": []}, armctl.InputError, "goal"),
        ({"goal": [1.0, 2.0]}, armctl.InputError, "goal"),
        ({"goal": GOAL + 9.0}, armctl.LimitError, "goal"),
        ({"goal": GOAL, "clearance": -1.0}, armctl.InputError, "clearance"),
        ({"goal": GOAL, "seed": 0.5}, armctl.InputError, "seed"),
        ({"goal": GOAL, "speed": 2.0}, armctl.InputError, "speed"),
        ({"goal": GOAL, "keep": "up"}, armctl.UnknownNameError, "up"),
        ({"goal": GOAL, "keep": "z", "keep_within": 4.0}, armctl.InputError, "keep_within"),
        ({"goal": GOAL, "holding": "cup"}, armctl.UnknownNameError, "cup"),
        ({"goal": GOAL, "allow": ["wall"]}, armctl.InputError, "allow"),
    ],
)
def test_wrong_calls_are_one_sentence(arm, arguments, error, message):
    with pytest.raises(error, match=message):
        armctl.move_free(arm, START, **arguments)


def test_more_solutions_of_a_point_are_looked_for_as_long_as_none_is_free(arm):
    point = Target.read(arm.fk(GOAL).position)
    tried: list[np.ndarray] = []

    def is_free(q: np.ndarray) -> bool:
        tried.append(q)
        return len(tried) > 30

    search = GoalSearch(arm, START, point, np.random.default_rng(0), is_free)
    search.extend(500, 1)
    assert len(search.found) > 30
    assert not search.refusal


def test_what_was_found_from_few_starts_is_extended_from_more(arm):
    point = Target.read(arm.fk(GOAL).position)

    def searched(*tries: int) -> np.ndarray:
        search = GoalSearch(arm, START, point, np.random.default_rng(0), lambda q: False)
        for most in tries:
            search.extend(most, 1)
        return np.array(search.found)

    whole = searched(60)
    assert np.array_equal(searched(25, 60), whole)
    assert len(searched(25)) < len(whole)
    apart = np.abs(whole[:, None] - whole[None]).max(axis=2) + np.eye(len(whole))
    assert apart.min() > 1e-3


def test_a_goal_that_is_blocked_costs_little_beside_one_that_is_free(tmp_path):
    arm = arm_among(tmp_path)
    checker = collision_checker(arm)
    drawn = arm.limits.random(arm.home, 400, np.random.default_rng(2))
    free = next(q for q in drawn if checker.hit(q, 0.02) < 0)
    inside = arm.fk(next(q for q in drawn if checker.nearest(q)[1] <= 0.0))
    alone = FreeGoals(checker, None, arm, free, arm.fk(free), np.random.default_rng(0)).first().q
    both = FreeGoals(checker, None, arm, free, [arm.fk(free), inside], np.random.default_rng(0)).first().q
    assert {q.tobytes() for q in alone} <= {q.tobytes() for q in both}


def test_where_no_path_leads_to_the_first_goals_there_are_more_unless_the_goal_is_one_configuration(tmp_path):
    arm = arm_among(tmp_path)
    checker = collision_checker(arm)
    free = next(q for q in arm.limits.random(arm.home, 400, np.random.default_rng(2)) if checker.hit(q, 0.02) < 0)
    anywhere = armctl.Region(arm.fk(free), [[-0.1, 0.1]] * 3 + [[-np.pi, np.pi], [-1.0, 1.0], [-np.pi, np.pi]])
    goals = FreeGoals(checker, None, arm, free, [arm.fk(free), anywhere], np.random.default_rng(0))
    first = goals.first().q
    more = goals.more()
    assert more is not None
    assert {q.tobytes() for q in first} < {q.tobytes() for q in more.q}
    assert all(checker.hit(q) < 0 for q in more.q)
    assert goals.more() is None
    single = FreeGoals(checker, None, arm, free, free, np.random.default_rng(0))
    assert len(single.first().q) == 1
    assert single.more() is None


def test_no_simulated_move_among_things_touches_anything(tmp_path):
    arm = arm_among(tmp_path)
    checker = collision_checker(arm)
    start = next(q for q in arm.limits.random(arm.home, 200, np.random.default_rng(2)) if checker.hit(q, 0.02) < 0)
    goals = [q for q in arm.limits.random(arm.home, 200, np.random.default_rng(3)) if checker.hit(q, 0.02) < 0][:5]
    straight = [armctl.check_clearance(arm, armctl.move_j(arm, start, goal)).ok for goal in goals]
    sim = armctl.Simulation(arm)
    reached = 0
    for goal in goals:
        sim.reset(start)
        result = sim.move_to(arm.fk(goal))
        if result.log is not None:
            assert [str(contact) for contact in result.log.contacts] == []
        reached += result.ok
    assert reached >= 3
    assert not all(straight)


def test_a_motion_keeps_half_of_the_clearance(tmp_path):
    """A ball of 2 cm on two slides, and a box 1.5 cm beside its straight way."""
    path = tmp_path / "slides.xml"
    path.write_text(
        '<mujoco><worldbody><geom name="box" type="box" size="0.1 0.1 0.1" pos="0 0.135 0"/>'
        '<body><joint name="x" type="slide" axis="1 0 0" range="-1 1"/><inertial pos="0 0 0" mass="0.001" diaginertia="1 1 1"/>'
        '<body><joint name="y" type="slide" axis="0 1 0" range="-1 1"/><geom size="0.02" mass="1"/><site name="tip"/></body>'
        '</body></worldbody><actuator><motor joint="x" ctrlrange="-99 99"/><motor joint="y" ctrlrange="-99 99"/></actuator>'
        "</mujoco>"
    )
    arm = armctl.load(path)
    motion = armctl.move_free(arm, [-0.4, 0.0], [0.4, 0.0], clearance=0.05)
    q = motion.sample(np.linspace(0.0, motion.duration, 2000)).q
    beside = np.maximum(np.abs(q - [0.0, 0.135]) - 0.1, 0.0)
    assert np.linalg.norm(beside, axis=1).min() - 0.02 >= 0.025
    near = armctl.move_free(arm, [-0.4, 0.0], [0.4, 0.0], clearance=0.02)
    assert np.abs(near.sample(np.linspace(0.0, near.duration, 100)).q[:, 1]).max() == 0.0
