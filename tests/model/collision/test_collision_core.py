"""Bindings of distances, proofs and paths: wrong arrays are refused, and what is kept of earlier queries changes nothing."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from collidable import arm_among

import armctl
from armctl import _core
from armctl.model.collision.checker import CollisionChecker
from armctl.model.collision.checkers import collision_checker

pytestmark = [pytest.mark.core, pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")]


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> armctl.Arm:
    return arm_among(tmp_path_factory.mktemp("arm"))


@pytest.fixture
def scene(arm) -> _core.CollisionScene:
    return _core.CollisionScene(CollisionChecker(arm).geometry.core)


def tetrahedron_model(**changes: np.ndarray) -> _core.CollisionModel:
    """A tetrahedron with edges on one hinge over a plane, some of its arrays changed."""
    unit = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    arrays = {
        "axes": np.array([[0.0, 1.0, 0.0]]),
        "anchors": np.zeros((1, 3)),
        "slides": np.zeros(1, np.int64),
        "references": np.zeros(1),
        "parents": np.zeros(1, np.int64),
        "joints": np.zeros(1, np.int64),
        "n": 1,
        "ratio": np.eye(1),
        "joint_offset": np.zeros(1),
        "kinds": np.array([int(_core.ShapeKind.PLANE), int(_core.ShapeKind.HULL)]),
        "frames": np.array([0, 1]),
        "inflations": np.array([0.0, 0.25]),
        "positions": np.array([[0.0, 0.0, -2.0], [0.0, 0.0, 0.0]]),
        "rotations": np.array([np.eye(3), np.eye(3)]),
        "sizes": np.zeros((2, 3)),
        "centers": np.zeros((2, 3)),
        "radii": np.array([np.inf, 1.5]),
        "first_vertex": np.array([0, 0, 4]),
        "vertices": unit,
        "first_neighbor": np.array([0, 3, 6, 9, 12]),
        "neighbors": np.array([1, 2, 3, 0, 2, 3, 0, 1, 3, 0, 1, 2]),
        "directions": np.eye(3),
        "first_geoms": np.zeros(1, np.int64),
        "second_geoms": np.ones(1, np.int64),
        "margins": np.zeros(1),
    }
    return _core.CollisionModel(**(arrays | changes))


def test_the_distance_to_a_plane_is_that_of_the_lowest_vertex():
    scene = _core.CollisionScene(tetrahedron_model())
    for q in np.linspace(-3.0, 3.0, 25):
        heights = [2.0, 2.0 - np.sin(q), 2.0, 2.0 + np.cos(q)]  # of the vertices, turned about y
        nearest = scene.nearest_pair(np.array([q]))
        assert nearest.pair == 0
        assert nearest.distance == pytest.approx(min(heights) - 0.25, abs=1e-12)


@pytest.mark.parametrize(
    ("name", "array", "message"),
    [
        ("axes", np.zeros((1, 2)), "axes: "),
        ("ratio", np.zeros((2, 1)), "ratio: "),
        ("parents", np.array([1]), "parents: 1 is not one of 1"),
        ("joints", np.array([1]), "joints: 1 is not one of 1"),
        ("kinds", np.array([4, 9]), "kinds: 9 is not one of 5"),
        ("frames", np.array([0, 2]), "frames: 2 is not one of 2"),
        ("first_vertex", np.array([0, 4, 4]), "first_vertex: a hull without vertices"),
        ("first_vertex", np.array([0, 5, 4]), "first_vertex: 5 is not one of 5"),
        ("first_neighbor", np.array([0, 3, 6, 9, 13]), "first_neighbor: 13 is not one of 13"),
        ("neighbors", np.array([1, 2, 3, 0, 2, 3, 0, 1, 3, 0, 1, 4]), "neighbors: 4 is not one of 4"),
        ("second_geoms", np.array([2]), "second_geoms: 2 is not one of 2"),
        ("first_geoms", np.array([-1]), "first_geoms: -1 is not one of 2"),
        ("first_neighbor", np.array([0, 6, 3, 9, 12]), "first_neighbor: not in order"),
        ("radii", np.ones(1), "radii: "),
    ],
)
def test_a_model_with_rows_that_do_not_exist_is_refused(name, array, message):
    with pytest.raises(armctl.InputError, match=message):
        tetrahedron_model(**{name: array})


def test_queries_with_arrays_of_a_wrong_length_are_refused(arm, scene):
    with pytest.raises(armctl.InputError, match=r"q: .*\(6,\)"):
        scene.nearest_pair(np.zeros(5))
    with pytest.raises(armctl.InputError, match="pair: 10000 is not one of "):
        _core.ClearanceProof(scene).hit(0.0, 10_000)
    with pytest.raises(armctl.InputError, match="clearances"):
        scene.near_pairs(arm.home, np.zeros(arm.n), 0.5, np.zeros(1))
    proof = _core.ClearanceProof(scene)
    with pytest.raises(armctl.InputError, match="knots: need at least two"):
        proof.set_motion(np.zeros(1), np.zeros((0, 2, arm.n)))
    with pytest.raises(armctl.InputError, match="degree 1 to 5"):
        proof.set_motion(np.array([0.0, 1.0]), np.zeros((1, 7, arm.n)))
    with pytest.raises(armctl.InputError, match="samples"):
        _core.RrtConnect(proof, 0.0, arm.home, arm.home[None], arm.home, arm.home, 10).grow(np.zeros((2, 5)))


def test_a_region_of_a_frame_that_does_not_exist_is_refused():
    proof = _core.ClearanceProof(_core.CollisionScene(tetrahedron_model()))
    with pytest.raises(armctl.InputError, match="frame: 2 is not one of 2"):
        proof.keep_region(np.zeros(1), 2, np.zeros(12), armctl.Region([0.0, 0.0, 0.0]).parts[0].numbers)


def test_a_proof_before_a_motion_is_set_is_that_of_the_arm_at_zero():
    proof = _core.ClearanceProof(_core.CollisionScene(tetrahedron_model()))
    assert proof.hit(1.7) is None
    assert proof.hit(1.8).pair == 0


def test_the_model_with_the_same_exceptions_is_kept_with_the_arm(arm):
    allowed = collision_checker(arm, allow=[("link5", "plate")])
    assert collision_checker(arm, allow=[["plate", "link5"]]) is allowed
    assert collision_checker(arm) is not allowed
    assert collision_checker(arm, allow=[("link4", "plate")]) is not allowed


def test_only_the_models_that_were_used_last_are_kept(arm):
    first = collision_checker(arm, allow=[("link5", "plate")])
    for link in range(6):
        for thing in ("plate", "post"):
            collision_checker(arm, allow=[(f"link{link}", thing), ("link5", "plate")])
    assert collision_checker(arm, allow=[("link5", "plate")]) is not first


def test_a_proof_has_the_same_bits_whatever_was_asked_before(arm):
    motion = armctl.move_j(arm, arm.home, arm.home + 0.05)
    first = armctl.check_clearance(arm, motion)
    for q in arm.limits.random(arm.home, 20, np.random.default_rng(3)):
        armctl.check_clearance(arm, armctl.move_j(arm, arm.home, q))
    assert armctl.check_clearance(arm, motion) == first


def test_threads_that_share_a_checker_find_what_one_thread_finds(arm):
    checker = CollisionChecker(arm)
    ends = arm.limits.random(arm.home, 200, np.random.default_rng(5))

    def proof(q: np.ndarray) -> tuple[float, ...]:
        hit = checker.line_hit(arm.home, q, 1e-3)
        return (checker.nearest(q)[1], -1.0 if hit is None else hit.time)

    alone = [proof(q) for q in ends]
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(proof, ends)) == alone
