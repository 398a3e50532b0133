"""Contacts and distances: MuJoCo's where MuJoCo is right, brute force where it is not."""

from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
import pytest
from collidable import arm_among, capsule_gaps, placed
from hypothesis import given
from hypothesis import strategies as st
from synthetic import limb, mjcf, motors

import armctl
from armctl.model.collision.checker import CollisionChecker
from armctl.model.collision.checkers import collision_checker
from armctl.model.collision.collision_geometry import colliding_pairs

BOX = int(mujoco.mjtGeom.mjGEOM_BOX)
CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)

pytestmark = [pytest.mark.core, pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")]


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
    for q in configurations(arm, 150):
        touching = {tuple(sorted(contact.geom.tolist())) for contact in placed(arm, q).contact if contact.dist < 0.0} & counted
        found = {checker.geometry.pair_geoms(p) for p in np.flatnonzero(checker._all_hits(q))}
        found = {tuple(sorted(geoms)) for geoms in found}
        missed_by_mujoco = {geoms for geoms in found - touching if is_capsule_in_box(arm, geoms)}
        assert found - missed_by_mujoco == touching
        hits += len(found)
    assert hits > 100


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


def test_no_capsule_in_a_plate_is_missed(tmp_path):
    """MuJoCo's own test misses capsules whose axis runs inside a thin box."""
    plate = '<geom name="plate" type="box" size="0.3 0.3 0.025" pos="0.3 0.1 0.4"/>'
    arm = arm_among(tmp_path, plate)
    box = arm.model.geom("plate").id
    checker = CollisionChecker(arm)
    touching = 0
    missed_by_mujoco = 0
    for q in configurations(arm, 400, seed=2):
        data = placed(arm, q)
        found = {tuple(sorted(checker.geometry.pair_geoms(p))) for p in np.flatnonzero(checker._all_hits(q))}
        contacts = {tuple(sorted(contact.geom.tolist())) for contact in data.contact if contact.dist < 0.0}
        for geom, gap in capsule_gaps(arm.model, data, box).items():
            pair = tuple(sorted((geom, box)))
            if abs(gap) > 1e-6:
                assert (pair in found) == (gap < 0.0)
            touching += gap < 0.0
            missed_by_mujoco += gap < 0.0 and pair not in contacts
    assert touching > 100
    assert missed_by_mujoco > 3  # if MuJoCo repairs its test, this comparison has lost its point


def near_all(checker: CollisionChecker, q: np.ndarray, within: float) -> dict[int, tuple[float, np.ndarray]]:
    """The distance of each pair that is nearer than this, and its derivative."""
    near = checker.near(q, np.zeros(len(q)), 1.0, np.full(len(checker.geometry.pairs), within))
    return dict(zip(near.pairs.tolist(), zip(near.distances.tolist(), near.gradients, strict=True), strict=True))


def test_distances_of_near_pairs_are_mujocos_and_their_derivatives_those_of_differences(arm):
    checker = CollisionChecker(arm)
    step = 1e-6
    apart = 0
    overlapping = 0
    for q in configurations(arm, 25, seed=4):
        data = placed(arm, q)
        moved = [[near_all(checker, q + sign * step * row, 0.1) for sign in (1, -1)] for row in np.eye(arm.n)]
        for pair, (distance, gradient) in near_all(checker, q, 0.05).items():
            if distance > 0.0:
                geoms = checker.geometry.pair_geoms(pair)
                assert distance == pytest.approx(mujoco.mj_geomDistance(arm.model, data, *geoms, 1.0, None), abs=1e-8)
            differences = [(above[pair][0] - below[pair][0]) / (2 * step) for above, below in moved]
            assert np.allclose(gradient, differences, atol=2e-3)
            apart += distance > 0.0
            overlapping += distance < 0.0
    assert apart > 15
    assert overlapping > 15


def test_the_depth_of_a_pair_is_its_own_among_others_that_overlap(arm):
    checker = CollisionChecker(arm)
    overlapping = 0
    for q in configurations(arm, 40, seed=7):
        depths = {pair: -distance for pair, (distance, _) in near_all(checker, q, 0.0).items() if distance < 0.0}
        if len(depths) > 1:
            assert {pair: checker.depth(q, pair) for pair in depths} == pytest.approx(depths)
            overlapping += np.ptp(list(depths.values())) > 1e-3
    assert overlapping > 5


def test_the_depth_of_a_capsule_in_a_plate_is_at_most_a_tenth_above_the_least(tmp_path):
    """A plate and a segment part soonest along a normal of the plate or across an edge of it and the segment."""
    arm = arm_among(tmp_path, '<geom name="plate" type="box" size="0.3 0.2 0.05" pos="0.2 0.1 0.4"/>')
    checker = CollisionChecker(arm)
    model = arm.model
    half = model.geom_size[model.geom("plate").id]
    overlaps = 0
    exact = 0
    for q in configurations(arm, 60, seed=5):
        data = placed(arm, q)
        for pair, (distance, _) in near_all(checker, q, 0.0).items():
            box, capsule = sorted(checker.geometry.pair_geoms(pair), key=lambda geom: model.geom_type[geom] != BOX)
            if model.geom_type[box] != BOX:
                continue
            axis = data.geom_xmat[capsule].reshape(3, 3)[:, 2]
            normals = np.vstack([np.eye(3), np.cross(np.eye(3), axis)])
            normals /= np.linalg.norm(normals, axis=1)[:, None]
            extent = np.abs(normals) @ half + np.abs(normals @ axis) * model.geom_size[capsule, 1] + model.geom_size[capsule, 0]
            depth = (extent - np.abs(normals @ (data.geom_xpos[capsule] - data.geom_xpos[box]))).min()
            gap = capsule_gaps(model, data, box)[capsule]
            is_axis_inside = gap < 1e-9 - model.geom_size[capsule, 0]
            if is_axis_inside:
                assert depth - 1e-9 < -distance < 1.1 * depth
                exact += -distance < depth + 1e-6
            else:
                assert distance == pytest.approx(gap, abs=1e-6)
            overlaps += is_axis_inside
    assert exact > 0.8 * overlaps > 15


def test_links_that_neighbor_each_other_are_proved_once_and_left_out(arm):
    checker = CollisionChecker(arm)
    bodies = {
        tuple(sorted(arm.model.geom_bodyid[list(checker.geometry.pair_geoms(p))])) for p in range(len(checker.geometry.pairs))
    }
    links = [arm.model.body(f"link{i}").id for i in range(6)]
    assert (links[0], links[1]) not in bodies
    assert (links[0], links[3]) in bodies


@pytest.mark.parametrize("seed", range(12))
def test_the_pairs_that_can_collide_are_those_in_which_mujoco_finds_contacts(seed: int):
    """Random trees of bodies, some of them welded to their parent or to the world, of which all geoms are at one place."""
    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec()
    spec.option.disableflags = int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT) * int(rng.integers(4) == 0)
    bodies = [spec.worldbody]
    for k in range(10):
        parent = bodies[rng.integers(len(bodies))]
        body = parent.add_body(name=f"body{k}", pos=1e-3 * rng.normal(size=3), mass=1.0, inertia=[1.0, 1.0, 1.0])
        if rng.integers(3):
            body.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0.0, 0.0, 1.0])
        bodies.append(body)
    for k, body in enumerate(bodies):
        bits = {"contype": int(rng.integers(4)), "conaffinity": int(rng.integers(4))} if rng.integers(2) else {}
        body.add_geom(name=f"geom{k}", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1.0, 0.0, 0.0], **bits)
    for _ in range(2):
        one, other = rng.choice(10, 2, replace=False)
        spec.add_exclude(bodyname1=f"body{one}", bodyname2=f"body{other}")
        one, other = rng.choice(11, 2, replace=False)
        spec.add_pair(geomname1=f"geom{one}", geomname2=f"geom{other}")
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    contacts = {tuple(sorted(pair)) for pair in data.contact.geom.tolist()}
    assert contacts
    assert {tuple(pair) for pair in colliding_pairs(model).tolist()} == contacts


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


@pytest.mark.parametrize(
    "wall", ['size="1 0.01 1" pos="0 -0.07 0"', 'size="0.01 1 1" pos="0.15 0 0"'], ids=["aside", "touched at home"]
)
def test_one_link_of_two_shapes_touches_one_obstacle(load, wall: str):
    ball = '<geom name="ball" size="0.02" pos="0.05 0 0.05"/>'
    hand = '<geom name="hand" type="box" size="0.02 0.02 0.02" pos="0.1 0 0.1"/>'
    arm = load(limb("a", inside=ball + hand) + f'<geom name="wall" type="box" {wall}/>', motors("a"))
    checker = collision_checker(arm)
    touched = set()
    for q in configurations(arm, 200):
        names = {arm.model.geom(geom).name for contact in placed(arm, q).contact if contact.dist < 0.0 for geom in contact.geom}
        assert (checker.hit(q) >= 0) == bool(names)
        touched |= names or {"nothing"}
    assert touched == {"ball", "hand", "wall", "nothing"}


def test_what_touches_the_base_at_home_is_left_out_up_to_one_joint_from_it(load, tmp_path):
    """Both links meet the base at home and leave it on the way; a joint lies between the base and the first one only."""
    box = '<geom name="{}" type="box" size="0.02 0.02 0.02" pos="0.09 0 -0.03"/>'
    inner = f'<body name="second"><joint name="b" axis="0 0 1" range="-3 3"/>{box.format("outer")}</body>'
    first = f'<body name="first" pos="0 0 0.12"><joint name="a" axis="0 0 1" range="-3 3"/>{box.format("inner")}{inner}</body>'
    base = '<geom name="base" type="box" size="0.03 0.03 0.1" pos="0.09 0 0"/>'
    arm = load(f'<body name="base">{base}{first}</body>', motors("a b"))
    checker = collision_checker(arm)
    data = mujoco.MjData(mujoco.MjModel.from_xml_path(str(tmp_path / "trap.xml")))  # before armctl leaves contacts out
    contacts = set()
    for data.qpos[:] in [arm.home, *configurations(arm, 200)]:
        mujoco.mj_fwdPosition(data.model, data)
        touching = {data.model.geom(geom).name for contact in data.contact for geom in contact.geom}
        assert (checker.hit(data.qpos) >= 0) == ("outer" in touching)
        contacts.add(frozenset(touching - {"base"}))
    assert contacts == {frozenset(names) for names in ([], ["inner"], ["outer"], ["inner", "outer"])}


@pytest.mark.parametrize("flag", ["enable", "disable"])
def test_a_link_meets_the_next_one_only_where_mujoco_says_that_parents_collide(load, flag: str):
    box = '<geom name="{}" type="box" size="0.02 0.02 0.02" pos="{}"/>'
    outer = f'<body name="second"><joint name="b" axis="0 0 1" range="-3 3"/>{box.format("outer", "0 0.06 0")}</body>'
    first = f'<body name="first"><joint name="a" axis="0 0 1" range="-3 3"/>{box.format("inner", "0.06 0 0")}{outer}</body>'
    arm = load(first, motors("a b") + f'<option><flag filterparent="{flag}"/></option>')
    checker = collision_checker(arm)
    touches = [any(contact.dist < 0.0 for contact in placed(arm, q).contact) for q in configurations(arm, 100)]
    assert [checker.hit(q) >= 0 for q in configurations(arm, 100)] == touches
    assert (sum(touches) > 10) == (flag == "disable")


def test_allowed_pairs_are_left_out_by_the_names_of_bodies_or_geoms(arm):
    checker = CollisionChecker(arm, allow=[("link5", "plate"), ("post", "link4")])
    named = {frozenset(checker.names(p)) for p in range(len(checker.geometry.pairs))}
    assert frozenset(("link5", "plate")) not in named
    assert frozenset(("link4", "post")) not in named
    assert frozenset(("link3", "plate")) in named


@pytest.mark.parametrize("allow", [["ab"], [("a",)], [("link1", "link2", "link3")]])
def test_what_is_allowed_is_a_list_of_pairs(arm, allow):
    with pytest.raises(armctl.InputError, match="is not a pair of names"):
        CollisionChecker(arm, allow=allow)


def test_an_unknown_name_in_what_is_allowed_gets_a_suggestion(arm):
    with pytest.raises(armctl.UnknownNameError, match="did you mean 'plate'"):
        CollisionChecker(arm, allow=[("link1", "plato")])
    first = arm.model.body(1).name
    with pytest.raises(armctl.UnknownNameError, match=f"did you mean '{first}'"):
        CollisionChecker(arm, allow=[("link1", f"{first}x")])


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


def test_a_body_that_is_carried_goes_along_also_if_it_is_the_first_in_the_file():
    """A ball at the end of a link: carried, it meets the post that the link misses."""
    ball = '<body name="ball" pos="0.45 0 0.1"><freejoint/><geom type="sphere" size="0.05" mass="0.1"/></body>'
    turn = '<joint name="a" axis="0 0 1" range="-3 3"/><geom type="capsule" fromto="0 0 0 0.38 0 0" size="0.02"/>'
    link = f'<body name="A" pos="0 0 0.1">{turn}<site name="tip"/></body>'
    post = '<geom name="post" type="box" size="0.02 0.02 0.2" pos="0 0.45 0.1"/>'
    for bodies in (ball + link + post, link + ball + post):
        arm = armctl.load(mujoco.MjSpec.from_string(mjcf(bodies, motors("a"))))
        held = {arm.model.body("ball").id: arm.model.body("A").id}
        turned = armctl.move_j(arm, [0.0], [1.57])
        found = CollisionChecker(arm, None, [], held).closest_approach(turned.knots, turned.coefficients, 0.0, None)
        assert found.bound < 0.0
