"""Contacts and distances: MuJoCo's where MuJoCo is right, brute force where it is not."""

from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
import pytest
from collidable import arm_among, placed
from hypothesis import given
from hypothesis import strategies as st
from synthetic import limb, mjcf, motors

import armctl
from armctl.collision.checker import CollisionChecker
from armctl.collision.checkers import collision_checker

BOX = int(mujoco.mjtGeom.mjGEOM_BOX)
CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)

pytestmark = pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> armctl.Arm:
    return arm_among(tmp_path_factory.mktemp("arm"))


def configurations(arm: armctl.Arm, count: int, seed: int = 0) -> np.ndarray:
    return arm.limits.random(arm.home, count, np.random.default_rng(seed))


def is_capsule_in_box(arm: armctl.Arm, geoms: tuple[int, int]) -> bool:
    return sorted(arm.model.geom_type[list(geoms)]) == [CAPSULE, BOX]


def test_every_pair_touches_where_mujoco_says_so(arm):
    checker = CollisionChecker(arm)
    counted = {tuple(sorted(checker.geometry.pair_geoms(p))) for p in range(len(checker.geometry.pairs))}
    hits = 0
    for q in configurations(arm, 400):
        touching = {tuple(sorted(contact.geom.tolist())) for contact in placed(arm, q).contact if contact.dist < 0.0} & counted
        found = {checker.geometry.pair_geoms(p) for p in np.flatnonzero(checker._all_hits(q))}
        found = {tuple(sorted(geoms)) for geoms in found}
        missed_by_mujoco = {geoms for geoms in found - touching if is_capsule_in_box(arm, geoms)}
        assert found - missed_by_mujoco == touching
        hits += len(found)
    assert hits > 200


def test_distances_are_mujocos(arm):
    checker = CollisionChecker(arm)
    apart = 0
    for q in configurations(arm, 300, seed=1):
        pair, distance = checker.nearest(q)
        if distance > 0.0:
            geoms = checker.geometry.pair_geoms(pair)
            assert distance == pytest.approx(mujoco.mj_geomDistance(arm.model, placed(arm, q), *geoms, 10.0, None), abs=1e-6)
            apart += 1
    assert apart > 30


def segment_box_distance(ends: np.ndarray, half: np.ndarray) -> float:
    """From a segment to a box at the origin: convex along the segment, so golden section finds it."""
    low, high = 0.0, 1.0
    ratio = 0.5 * (np.sqrt(5.0) - 1.0)

    def distance(share: float) -> float:
        point = ends[0] + share * (ends[1] - ends[0])
        return float(np.linalg.norm(np.maximum(np.abs(point) - half, 0.0)))

    for _ in range(80):
        first = high - ratio * (high - low)
        second = low + ratio * (high - low)
        if distance(first) < distance(second):
            high = second
        else:
            low = first
    return distance(0.5 * (low + high))


def test_no_capsule_in_a_plate_is_missed(tmp_path):
    """MuJoCo's own test misses capsules whose axis runs inside a thin box."""
    plate = '<geom name="plate" type="box" size="0.3 0.3 0.025" pos="0.3 0.1 0.4"/>'
    arm = arm_among(tmp_path, plate)
    model = arm.model
    box = model.geom("plate").id
    checker = CollisionChecker(arm)
    touching = 0
    missed_by_mujoco = 0
    for q in configurations(arm, 1500, seed=2):
        data = placed(arm, q)
        found = {tuple(sorted(checker.geometry.pair_geoms(p))) for p in np.flatnonzero(checker._all_hits(q))}
        contacts = {tuple(sorted(contact.geom.tolist())) for contact in data.contact if contact.dist < 0.0}
        for geom in range(model.ngeom):
            if model.geom_type[geom] != CAPSULE:
                continue
            axis = data.geom_xmat[geom].reshape(3, 3)[:, 2] * model.geom_size[geom, 1]
            ends = np.array([data.geom_xpos[geom] - axis, data.geom_xpos[geom] + axis]) - data.geom_xpos[box]
            gap = segment_box_distance(ends, model.geom_size[box]) - model.geom_size[geom, 0]
            pair = tuple(sorted((geom, box)))
            if abs(gap) > 1e-6:
                assert (pair in found) == (gap < 0.0)
            touching += gap < 0.0
            missed_by_mujoco += gap < 0.0 and pair not in contacts
    assert touching > 300
    assert missed_by_mujoco > 10  # if MuJoCo repairs its test, this comparison has lost its point


def test_links_that_neighbor_each_other_are_proved_once_and_left_out(arm):
    checker = CollisionChecker(arm)
    bodies = {
        tuple(sorted(arm.model.geom_bodyid[list(checker.geometry.pair_geoms(p))])) for p in range(len(checker.geometry.pairs))
    }
    links = [arm.model.body(f"link{i}").id for i in range(6)]
    assert (links[0], links[1]) not in bodies
    assert (links[0], links[3]) in bodies


def test_geoms_whose_bits_do_not_match_never_touch(tmp_path):
    ghost = '<geom name="ghost" type="box" size="1 1 1" contype="0" conaffinity="0"/>'
    checker = CollisionChecker(arm_among(tmp_path, ghost))
    assert all("ghost" not in checker.names(p) for p in range(len(checker.geometry.pairs)))


def test_a_joint_that_follows_another_moves_with_its_leader(load):
    tied = '<equality><joint joint1="b" joint2="a" polycoef="0.2 -1 0 0 0"/></equality>'
    solid = limb("a b", inside='<geom name="hand" type="box" size="0.02 0.02 0.02" pos="0.1 0 0.1"/>')
    arm = load(solid + '<geom name="wall" type="box" size="0.01 1 1" pos="0.34 0 0"/>', motors("a") + tied)
    checker = collision_checker(arm)
    answers = set()
    for q in configurations(arm, 200):
        touches = any(contact.dist < 0.0 for contact in placed(arm, q).contact)
        assert (checker.hit(q) >= 0) == touches
        answers.add(touches)
    assert answers == {True, False}


def test_allowed_pairs_are_left_out_by_the_names_of_bodies_or_geoms(arm):
    checker = CollisionChecker(arm, allow=[("link5", "plate"), ("post", "link4")])
    named = {frozenset(checker.names(p)) for p in range(len(checker.geometry.pairs))}
    assert frozenset(("link5", "plate")) not in named
    assert frozenset(("link4", "post")) not in named
    assert frozenset(("link3", "plate")) in named


@pytest.mark.parametrize("allow", [["ab"], [("a",)], [("link1", "link2", "link3")]])
def test_what_is_allowed_is_a_list_of_pairs(arm, allow):
    with pytest.raises(armctl.InputError, match="is no pair of names"):
        CollisionChecker(arm, allow=allow)


def test_an_unknown_name_in_what_is_allowed_gets_a_suggestion(arm):
    with pytest.raises(armctl.UnknownNameError, match="did you mean 'plate'"):
        CollisionChecker(arm, allow=[("link1", "plato")])


def test_threads_get_the_answers_of_one_thread(arm):
    checker = collision_checker(arm)
    points = configurations(arm, 400, seed=3)
    alone = [checker.hit(q) >= 0 for q in points]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda q: checker.hit(q) >= 0, points))
    assert alone == together


def test_a_height_field_is_checked_with_mujoco(tmp_path):
    heights = '<asset><hfield name="hills" nrow="3" ncol="3" elevation="0 0 0 0 1 0 0 0 0" size="1 1 0.3 0.1"/></asset>'
    bodies = limb("a b c", joint='armature="0.01"', inside='<geom name="hand" size="0.05" pos="0.1 0 0.1"/>')
    path = tmp_path / "hills.xml"
    path.write_text(mjcf('<geom name="hills" type="hfield" hfield="hills"/>' + bodies, motors("a b c") + heights))
    arm = armctl.load(path)
    checker = collision_checker(arm)
    answers = {bool(checker.at(q)) for q in configurations(arm, 100)}
    assert answers == {True, False}
    assert "hills" in next(filter(None, map(checker.at, configurations(arm, 100))))


@given(st.lists(st.floats(-1, 1), min_size=6, max_size=6), st.lists(st.floats(-1, 1), min_size=6, max_size=6))
def test_a_line_that_is_proved_free_touches_at_no_sample(arm_cell, start, end):
    arm, checker = arm_cell
    low = arm.limits.q_min
    span = arm.limits.q_max - low
    start = low + span * 0.5 * (1 + np.array(start))
    end = low + span * 0.5 * (1 + np.array(end))
    is_free = checker.line_hit(start, end) is None
    touches = any(checker.hit(start + share * (end - start)) >= 0 for share in np.linspace(0, 1, 60))
    assert not (is_free and touches)


@pytest.fixture(scope="module")
def arm_cell(arm) -> tuple[armctl.Arm, CollisionChecker]:
    return arm, collision_checker(arm)
