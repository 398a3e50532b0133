"""Pose is a group, and reads what people give it."""

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import polar
from scipy.spatial.transform import Rotation

from armctl import InputError, Pose
from armctl.core.pose import rotation_from_vector, rotation_vector

coordinates = st.lists(st.floats(-10, 10), min_size=3, max_size=3)
turns = st.lists(st.floats(-np.pi, np.pi), min_size=3, max_size=3)
poses = st.builds(lambda p, rpy: Pose(p, rpy=rpy), coordinates, turns)


def assert_same(a: Pose, b: Pose, tolerance: float = 1e-12):
    assert np.abs(a.matrix - b.matrix).max() <= tolerance


@given(poses, poses, poses)
def test_poses_are_a_group(a: Pose, b: Pose, c: Pose):
    assert_same((a @ b) @ c, a @ (b @ c))
    assert_same(a @ a.inverse(), Pose([0, 0, 0]))
    assert_same((a @ b).inverse(), b.inverse() @ a.inverse())
    assert_same(a @ Pose([0, 0, 0]), a)


@given(poses, coordinates)
def test_a_pose_acts_as_its_matrix(a: Pose, point: list[float]):
    assert np.allclose(a.transform(point), (a.matrix @ [*point, 1.0])[:3], atol=1e-12)


@given(poses)
def test_every_way_of_writing_an_orientation_agrees(a: Pose):
    assert_same(Pose(a.position, quat=a.quat), a)
    assert_same(Pose(a.position, quat=-a.quat), a)
    assert_same(Pose(a.position, rpy=a.rpy), a, 1e-9)
    assert_same(Pose.from_matrix(a.matrix), a)
    assert_same(pickle.loads(pickle.dumps(a)), a, 0.0)
    assert a.quat[0] >= 0
    assert np.linalg.norm(a.quat) == pytest.approx(1, abs=1e-12)


@given(turns)
def test_rotation_vector_and_its_matrix_are_inverse(w: list[float]):
    R = rotation_from_vector(np.array(w))
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-14)
    assert np.allclose(rotation_from_vector(rotation_vector(R)), R, atol=1e-12)
    assert np.linalg.norm(rotation_vector(R)) <= np.pi + 1e-12


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 1e-3, 1.0, np.pi - 1e-9, np.pi])
def test_the_angle_is_exact_at_zero_and_at_half_a_turn(angle: float):
    axis = np.array([2.0, -1.0, 0.5]) / np.linalg.norm([2.0, -1.0, 0.5])
    _, measured = Pose([0, 0, 0]).distance(Pose.from_rotation([0, 0, 0], rotation_from_vector(angle * axis)))
    assert measured == pytest.approx(angle, rel=1e-9, abs=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-15, 1e-9, 1e-3, 1.0, 3.0, np.pi - 1e-3, np.pi - 1e-9, np.pi])
def test_a_rotation_vector_is_found_again_up_to_its_sign_at_half_a_turn(angle: float):
    rng = np.random.default_rng(0)
    for axis in [*np.eye(3), *rng.normal(size=(100, 3))]:
        w = angle * axis / np.linalg.norm(axis)
        found = rotation_vector(rotation_from_vector(w))
        if angle == np.pi:
            found = found * np.sign(found @ w)
        assert np.abs(found - w).max() <= (2e-15 if angle < 2 else 1e-13)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1.0, 3.0, np.pi - 1e-9, np.pi])
def test_a_quaternion_has_half_the_angle_and_its_matrix_is_the_same_again(angle: float):
    for axis in [*np.eye(3), *np.random.default_rng(1).normal(size=(100, 3))]:
        R = rotation_from_vector(angle * axis / np.linalg.norm(axis))
        T = Pose.from_rotation([0, 0, 0], R)
        assert T.quat[0] == pytest.approx(np.cos(angle / 2), abs=1e-15)
        assert np.abs(Pose([0, 0, 0], T.quat).rotation - R).max() <= 2e-15


def test_roll_pitch_yaw_turn_about_fixed_axes():
    T = Pose([0, 0, 0], rpy=[0.0, 0.0, np.pi / 2])
    assert np.allclose(T.transform([1, 0, 0]), [0, 1, 0])
    assert np.allclose(Pose([0, 0, 0], rpy=[0.1, 0.2, 0.3]).rpy, [0.1, 0.2, 0.3])


def test_a_pose_is_frozen():
    T = Pose([1, 2, 3])
    with pytest.raises(AttributeError, match="frozen"):
        T.position = np.zeros(3)  # type: ignore[misc]
    with pytest.raises(ValueError, match="read-only"):
        T.position[0] = 0.0


def test_equal_poses_are_equal_and_hash_alike():
    assert Pose([1, 2, 3]) == Pose([1.0, 2, 3])
    assert hash(Pose([1, 2, 3])) == hash(Pose([1.0, 2, 3]))
    assert Pose([1, 2, 3]) != Pose([1, 2, 4])


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: Pose([1, 2]), "position: expected 3 numbers, got 2"),
        (lambda: Pose([1, 2, np.nan]), r"position: element \[2\] is nan, expected a finite number"),
        (lambda: Pose("abc"), "position: 'abc' is not an array of numbers"),
        (lambda: Pose([1, 2, 3], quat=[0, 0, 0, 0]), "quat: its norm is zero"),
        (lambda: Pose([1, 2, 3], quat=[1, 0, 0]), "quat: expected 4 numbers, got 3"),
        (lambda: Pose([1, 2, 3], quat=[1, 0, 0, 0], rpy=[0, 0, 0]), "both quat and rpy given"),
        (lambda: Pose.from_matrix(np.eye(3)), r"matrix: expected shape \(4, 4\), got \(3, 3\)"),
        (lambda: Pose.from_matrix(2 * np.eye(4)), "matrix: no rigid transform: its last row is"),
        (lambda: Pose.from_matrix(np.diag([1.0, 1, -1, 1])), "matrix: no rotation: it mirrors: its determinant is -1"),
    ],
)
def test_a_wrong_pose_is_one_sentence(call, sentence: str):
    with pytest.raises(InputError, match=sentence):
        call()


@pytest.mark.parametrize("pitch", [-0.5 * np.pi, 0.5 * np.pi])
def test_pointing_straight_up_or_down_the_roll_is_zero_and_the_orientation_the_same(pitch: float):
    for roll, yaw in ((0.4, 0.0), (0.0, -1.1), (2.0, 0.7)):
        pose = Pose([0.0, 0.0, 0.0], rpy=[roll, pitch, yaw])
        assert pose.rpy[0] == 0.0
        assert pose.rpy[1] == pytest.approx(pitch)
        assert_same(Pose([0.0, 0.0, 0.0], rpy=pose.rpy), pose)


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    return Rotation.random(rng=rng).as_matrix()


def homogeneous(R: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = [0.4, 0.1, 0.5]
    return T


ENTRANCES = [lambda R: Pose.from_rotation([0.4, 0.1, 0.5], R), lambda R: Pose.from_matrix(homogeneous(R))]


@pytest.mark.parametrize("entrance", ENTRANCES)
@pytest.mark.parametrize("digits", [3, 4, 5, 6, 8, 12])
def test_a_rounded_rotation_becomes_the_nearest_one(entrance, digits: int):
    rng = np.random.default_rng(digits)
    for _ in range(200):
        exact = random_rotation(rng)
        rounded = np.round(exact, digits)
        T = entrance(rounded)
        nearest = polar(rounded)[0]  # the orthogonal factor is the nearest orthogonal matrix: Higham (1986)
        assert np.abs(T.rotation - nearest).max() <= 1e-12
        assert np.abs(T.rotation @ T.rotation.T - np.eye(3)).max() <= 2e-12
        assert np.linalg.norm(T.quat) == pytest.approx(1.0, abs=1e-12)
        assert Pose([0, 0, 0], T.quat).distance(Pose.from_rotation([0, 0, 0], exact))[1] <= 2.0 * 10.0**-digits


@pytest.mark.parametrize("entrance", ENTRANCES)
def test_a_matrix_that_is_no_rotation_is_refused_with_the_reason(entrance):
    rng = np.random.default_rng(7)
    for _ in range(50):
        R = random_rotation(rng)
        shear = np.eye(3)
        shear[0, 1] = 0.1
        wrong = {
            "it mirrors": [R @ np.diag([1.0, 1.0, -1.0]), -R, R[:, [1, 0, 2]], R[[0, 2, 1]]],
            "rows have the lengths": [1000.0 * R, 1.01 * R, 1.002 * R, 0.5 * R, np.zeros((3, 3)), R @ np.diag([1.0, 1.0, 1.1])],
            "no rotation: its rows": [R @ shear, rng.normal(size=(3, 3)), np.round(R, 1) + 0.2, np.ones((3, 3)), np.degrees(R)],
            "expected a finite number": [np.full((3, 3), np.nan), R * [1.0, np.inf, 1.0], R + np.diag([np.nan, 0.0, 0.0])],
        }
        for sentence, matrices in wrong.items():
            for matrix in matrices:
                with pytest.raises(InputError, match=sentence) as caught:
                    entrance(matrix)
                assert len(str(caught.value)) <= 400


@pytest.mark.parametrize(
    "rotation", [None, "eye", [1.0, 0.0, 0.0, 0.0], np.ones(9), np.eye(2), np.eye(4), np.eye(3, dtype=bool), 1j * np.eye(3)]
)
def test_a_rotation_of_another_kind_is_refused(rotation):
    with pytest.raises(InputError, match=r"^rotation: "):
        Pose.from_rotation([0, 0, 0], rotation)


@pytest.mark.parametrize("position", [[np.nan, 0, 0], [0, 0], [0, np.inf, 0], "abc"])
def test_a_wrong_position_beside_a_rotation_is_refused(position):
    with pytest.raises(InputError, match=r"^position: "):
        Pose.from_rotation(position, np.eye(3))


def test_a_transposed_transform_is_recognised():
    with pytest.raises(InputError, match=r"no rigid transform: its last row .* it is transposed"):
        Pose.from_matrix(homogeneous(np.eye(3)).T)


@pytest.mark.parametrize("scale", [1e-6, 0.999, 3.0, 1e200])
def test_a_quaternion_of_any_length_is_normalised(scale: float):
    wxyz = np.array([0.738, 0.145, -0.036, -0.658])
    R = Rotation.from_quat(wxyz, scalar_first=True).as_matrix()
    assert np.abs(Pose([0, 0, 0], quat=scale * wxyz).rotation - R).max() <= 1e-15


def test_a_rotation_that_was_computed_keeps_every_bit():
    T = Pose([0.1, 0.2, 0.3], rpy=[0.4, 0.5, 0.6])
    for _ in range(200):
        T = T @ Pose([0.0, 0.0, 0.0], rpy=[0.3, -0.2, 0.1])
    assert np.array_equal(Pose.from_rotation(T.position, T.rotation).rotation, T.rotation)
    assert pickle.loads(pickle.dumps(T)) == T


@pytest.mark.parametrize("seed", range(5))
def test_axes_angles_and_orders_of_euler_agree_with_scipy(seed):
    rng = np.random.default_rng(seed)
    axis = rng.standard_normal(3)
    angle = rng.uniform(0.1, 3.0)
    pose = Pose.from_axis_angle([1.0, 2.0, 3.0], 5.0 * axis, angle)
    expected = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
    assert pose.rotation == pytest.approx(expected.as_matrix(), abs=1e-14)
    found_axis, found_angle = pose.axis_angle
    assert found_angle == pytest.approx(angle)
    assert found_axis == pytest.approx(axis / np.linalg.norm(axis))
    for order in ("xyz", "ZYX", "zxz", "YZY"):
        assert pose.euler(order) == pytest.approx(expected.as_euler(order))
        assert Pose.from_euler(pose.position, order, pose.euler(order)).rotation == pytest.approx(pose.rotation, abs=1e-14)
    assert pose.euler("xyz") == pytest.approx(pose.rpy)


def test_the_logarithm_is_the_inverse_of_the_exponential():
    twist = np.array([0.1, -0.2, 0.3, 0.5, -1.0, 1.5])
    pose = Pose.exp(twist)
    assert pose.log() == pytest.approx(twist, abs=1e-12)
    small = np.eye(4) + 1e-4 * np.array([[0, -1.5, -1.0, 0.1], [1.5, 0, -0.5, -0.2], [1.0, 0.5, 0, 0.3], [0, 0, 0, 0]])
    assert Pose.exp(1e-4 * twist).matrix == pytest.approx(small, abs=1e-7)  # exp(x) = 1 + x + ...
    half = Pose.exp(0.5 * twist)
    assert (half @ half).matrix == pytest.approx(pose.matrix, abs=1e-12)


def test_the_way_between_two_poses_is_a_line_and_a_turn_about_one_axis():
    start = Pose([0.1, 0.0, 0.0], rpy=[0.3, 0.2, -0.1])
    end = start @ Pose.from_axis_angle([0.0, 0.4, 0.0], [1.0, 1.0, 0.0], 1.2)
    for share in (0.0, 0.25, 1.0):
        pose = start.interpolated(end, share)
        assert pose.position == pytest.approx((1 - share) * start.position + share * end.position)
        assert pose.distance(start)[1] == pytest.approx(1.2 * share, abs=1e-12)
        assert pose.distance(end)[1] == pytest.approx(1.2 * (1 - share), abs=1e-12)


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: Pose.from_axis_angle([0, 0, 0], [0, 0, 0], 1.0), r"axis: \[0.0, 0.0, 0.0\] has no direction"),
        (lambda: Pose.from_euler([0, 0, 0], "xxz", [0, 0, 0]), "order: 'xxz' are no three axes"),
        (lambda: Pose([0, 0, 0]).euler("xYz"), "order: 'xYz' are no three axes"),
        (lambda: Pose.exp([1.0, 2.0]), "twist: expected 6 numbers, got 2"),
        (lambda: Pose([0, 0, 0]).interpolated(Pose([1, 0, 0]), 1.5), "share: expected"),
        (lambda: Pose([0, 0, 0]).interpolated(3, 0.5), "other: expected Pose, got 3"),
    ],
)
def test_wrong_orientations_are_one_sentence(call, sentence):
    with pytest.raises(InputError, match=sentence):
        call()


@given(poses, coordinates, coordinates.filter(lambda axis: np.linalg.norm(axis) > 1e-3), st.floats(-3, 3))
def test_what_turns_about_a_line_is_moved_by_a_rigid_turn_that_leaves_the_line(pose, point, axis, angle):
    turned = pose.turned_about(point, axis, angle)
    there = Pose(point) @ Pose.from_axis_angle([0, 0, 0], axis, angle) @ Pose(-np.array(point))
    assert_same(turned, there @ pose, 1e-9)
    direction = np.array(axis) / np.linalg.norm(axis)
    heights = [(each.position - point) @ direction for each in (pose, turned)]
    assert heights[0] == pytest.approx(heights[1], abs=1e-9)
