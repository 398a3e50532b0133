"""solve_ik_all: every branch is found and is a solution by MuJoCo's kinematics; `is_complete` is claimed only with a proof."""

import copy
import itertools
import pickle

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from arms import some_of

import armctl
from armctl import Arm, InputError, LimitError, Pose, solve_ik, solve_ik_all
from armctl.model.collision.checkers import collision_checker
from armctl.plan.ik.problem import ik_chain
from armctl.plan.ik.solve_batch import solve_ik_batch

LINK = """<body pos="{x:g} {y:g} {z:g}"><joint name="j{i}" axis="{axis}" range="{range}"/>
<geom type="capsule" fromto="0 0 0 0.01 0.01 0.02" size="0.01" mass="1" contype="0" conaffinity="0"/>"""
# Of each joint the position in the frame of the joint before, m, and its axis.
CHAINS = {
    "three parallel axes": [  # as a UR
        ((0, 0, 0.089), "0 0 1"),
        ((0, 0.136, 0), "0 1 0"),
        ((0.425, -0.12, 0), "0 1 0"),
        ((0.392, 0, 0), "0 1 0"),
        ((0, 0.093, 0), "0 0 1"),
        ((0, 0, -0.095), "0 1 0"),
    ],
    "a spherical wrist": [  # as a PUMA 560
        ((0, 0, 0.67), "0 0 1"),
        ((0, 0.244, 0), "0 1 0"),
        ((0.432, -0.093, 0), "0 1 0"),
        ((0.02, 0, 0.433), "0 0 1"),
        ((0, 0, 0), "0 1 0"),
        ((0, 0, 0), "0 0 1"),
    ],
    "no special axes": [
        ((0, 0, 0.3), "0 0 1"),
        ((0.1, 0.05, 0), "0 1 0.2"),
        ((0.4, -0.1, 0), "0.1 1 0"),
        ((0.1, 0, 0.3), "0 0.2 1"),
        ((0.05, 0, 0.1), "0.1 1 0.3"),
        ((0, 0.06, 0.05), "1 0 0.2"),
    ],
    "a spherical wrist behind axes that are not special": [
        ((0, 0, 0.67), "0 0 1"),
        ((0.1, 0.244, 0), "0 1 0.3"),
        ((0.432, -0.093, 0), "0.2 1 0"),
        ((0.02, 0, 0.433), "0 0 1"),
        ((0, 0, 0), "0 1 0"),
        ((0, 0, 0), "0 0 1"),
    ],
    "seven joints": [
        ((0, 0, 0.3), "0 0 1"),
        ((0, 0, 0), "0 1 0"),
        ((0, 0, 0.3), "0 0 1"),
        ((0.08, 0, 0), "0 1 0"),
        ((-0.08, 0, 0.38), "0 0 1"),
        ((0, 0, 0), "0 1 0"),
        ((0.08, 0, 0), "0 0 1"),
    ],
}
SIX_JOINTS = [name for name in CHAINS if name != "seven joints"]
GENERIC = np.array([0.4, -0.9, 1.1, 0.5, 0.8, -0.3, 0.6])


def arm_of(folder, name: str | list, bounds: str = "-3.1 3.1") -> Arm:
    chain = CHAINS[name] if isinstance(name, str) else name
    links = "".join(LINK.format(x=x, y=y, z=z, i=i, axis=axis, range=bounds) for i, ((x, y, z), axis) in enumerate(chain))
    count = len(chain)
    motors = "".join(f'<motor joint="j{i}" ctrlrange="-200 200"/>' for i in range(count))
    path = folder / "chain.xml"
    path.write_text(
        f"""<mujoco><compiler angle="radian"/><worldbody>{links}<site name="tip" pos="0.02 0.01 0.08"/>
        {"</body>" * count}</worldbody><actuator>{motors}</actuator></mujoco>"""
    )
    return armctl.load(path)


def arm_of_lines(folder, axes: np.ndarray, points: np.ndarray, tip: np.ndarray) -> Arm:
    """An arm of hinges about these lines, in the frame of the world, with the tip's frame parallel to it."""
    words = lambda numbers: " ".join(repr(float(x)) for x in numbers)  # noqa: E731
    links = "".join(
        f'<body><joint name="j{i}" axis="{words(axis)}" pos="{words(point)}" range="-3.15 3.15"/>'
        '<geom type="sphere" size="0.01" mass="1" contype="0" conaffinity="0"/>'
        for i, (axis, point) in enumerate(zip(axes, points, strict=True))
    )
    motors = "".join(f'<motor joint="j{i}" ctrlrange="-200 200"/>' for i in range(len(axes)))
    path = folder / "lines.xml"
    path.write_text(
        f"""<mujoco><compiler angle="radian"/><worldbody>{links}<site name="tip" pos="{words(tip)}"/>
        {"</body>" * len(axes)}</worldbody><actuator>{motors}</actuator></mujoco>"""
    )
    return armctl.load(path)


def mujoco_error(arm: Arm, q: np.ndarray, target: Pose) -> tuple[float, float]:
    data = mujoco.MjData(arm.model)
    data.qpos[:] = arm.qpos(q)
    mujoco.mj_kinematics(arm.model, data)
    T = Pose.from_rotation(data.xpos[arm.tip_body], data.xmat[arm.tip_body].reshape(3, 3)) @ arm.T_body_tip
    return T.distance(target)


def product_of_exponentials(axes: np.ndarray, points: np.ndarray, tip: np.ndarray, q: np.ndarray) -> np.ndarray:
    """The pose (12,) of a chain given by its axes in the zero configuration, with pin.exp6 as an independent source."""
    T = pin.SE3.Identity()
    for axis, point, angle in zip(axes, points, q, strict=True):
        T = T * pin.exp6(angle * np.concatenate([np.cross(point, axis), axis]))
    T = T * pin.SE3(tip[:9].reshape(3, 3), tip[9:])
    return np.concatenate([T.rotation.ravel(), T.translation])


def distance(q: np.ndarray, others: np.ndarray) -> float:
    """The largest joint difference to the nearest of the others, up to whole turns."""
    difference = np.abs(others - q)
    return float(np.minimum(difference, 2 * np.pi - difference).max(axis=1).min())


@pytest.mark.parametrize("name", ["three parallel axes", "a spherical wrist"])
def test_an_arm_with_a_special_geometry_has_eight_solutions_and_they_are_proved_to_be_all(tmp_path, name: str):
    arm = arm_of(tmp_path, name, "-6.2 6.2")
    target = arm.fk(GENERIC[: arm.n])
    found = solve_ik_all(arm, target)
    assert found
    assert len(found) == 8
    assert found.is_complete
    for k, q in enumerate(found.q):
        off, turned = mujoco_error(arm, q, target)
        assert off <= 1e-5
        assert turned <= 1e-4
        assert (off, turned) == pytest.approx((found.position_error[k], found.orientation_error[k]), abs=1e-7)
        assert arm.limits.contains(q)
        assert distance(q, np.delete(found.q, k, axis=0)) > 0.01
    assert distance(GENERIC[: arm.n], found.q) < 1e-6


@pytest.mark.parametrize("name", some_of(SIX_JOINTS, [*SIX_JOINTS][:2]))
def test_all_that_five_thousand_random_starts_find_is_found(tmp_path, name: str):
    arm = arm_of(tmp_path, name)
    rng = np.random.default_rng(1)
    for q in arm.limits.random(arm.home, 6, rng):
        target = arm.fk(q)
        starts = arm.limits.random(arm.home, 5000, rng)
        brute = solve_ik_batch(arm, [target] * len(starts), starts, position_tolerance=1e-9, orientation_tolerance=1e-9)
        found = solve_ik_all(arm, target)
        assert found
        assert max(distance(one, found.q) for one in brute.q[brute.ok]) < 1e-3
        assert distance(q, found.q) < 1e-3


@pytest.mark.core
@pytest.mark.parametrize("special", ["meet", "parallel"])
def test_the_closed_form_finds_every_configuration_wherever_the_special_axes_are(tmp_path, special: str):
    rng = np.random.default_rng(5)
    structures = set()
    doubts = 0
    for first, pair_first, pair in itertools.product(range(4), range(2), ["meet", "parallel"]):
        axes = rng.normal(size=(6, 3))
        points = rng.uniform(-0.4, 0.4, (6, 3))
        rows = [first, first + 1, first + 2]
        if special == "meet":
            points[rows] = points[first] + axes[rows]
        else:
            axes[rows] = axes[first]
        one, other = [(first + 3 + pair_first + k) % 6 for k in range(2)]
        if other != one + 1:
            continue
        if pair == "meet":
            points[other] = points[one] + axes[one] - axes[other]
        else:
            axes[other] = axes[one]
        axes /= np.linalg.norm(axes, axis=1)[:, None]
        tip = np.concatenate([np.eye(3).ravel(), rng.uniform(-0.5, 0.5, 3)])
        arm = arm_of_lines(tmp_path, axes, points, tip[9:])
        form = ik_chain(arm).closed_form
        assert form is not None
        assert form.is_exact
        structures.add((form.special[0], form.kind, form.pair_kind, form.pair_first))
        for q in rng.uniform(-3, 3, (5, 6)):
            goal = product_of_exponentials(axes, points, tip, q)
            target = Pose.from_rotation(goal[9:], goal[:9].reshape(3, 3))
            found = solve_ik_all(arm, target, position_tolerance=1e-9, orientation_tolerance=1e-9)
            assert 2 <= len(found) <= 8
            assert found.iterations[0] <= 2 * len(found)  # the closed form is exact: only rounding is refined
            doubts += not found.is_complete
            assert distance(q, found.q) < 1e-7
            for one in found.q:
                assert np.abs(product_of_exponentials(axes, points, tip, one) - goal).max() < 1e-9
    assert len(structures) == 12
    assert doubts <= 2


def test_almost_special_axes_are_a_beginning_and_prove_nothing(tmp_path):
    exact = arm_of(tmp_path, "a spherical wrist")
    target = exact.fk(GENERIC[:6])
    rounded = [*CHAINS["a spherical wrist"]]
    rounded[5] = ((0, 1e-4, 0), "0.0002 0 1")
    arm = arm_of(tmp_path, rounded)
    found = solve_ik_all(arm, target)
    assert len(found) == len(solve_ik_all(exact, target))
    assert not found.is_complete
    assert max(mujoco_error(arm, q, target)[0] for q in found.q) <= 1e-5


def test_at_a_singularity_nothing_is_proved(tmp_path):
    arm = arm_of(tmp_path, "a spherical wrist")
    q = np.array([0.4, -0.9, 1.1, 0.5, 0.0, -0.3])
    found = solve_ik_all(arm, arm.fk(q), q0=q)
    assert found
    assert not found.is_complete
    assert np.abs(found.q[0] - q).max() < 1e-6
    assert "wrist0" in found.branch[0]


def test_without_special_axes_fewer_than_sixteen_solutions_are_not_proved_to_be_all(tmp_path):
    arm = arm_of(tmp_path, "no special axes")
    found = [solve_ik_all(arm, arm.fk(q)) for q in arm.limits.random(arm.home, 10, np.random.default_rng(2))]
    assert all(found)
    assert any(len(each) < 16 for each in found)
    assert not any(each.is_complete for each in found if len(each) < 16)


def test_the_branches_of_the_solutions_of_six_joints_differ_and_tell_them_apart(tmp_path):
    arm = arm_of(tmp_path, "three parallel axes", "-6.2 6.2")
    found = solve_ik_all(arm, arm.fk(GENERIC[:6]))
    signs = {f"shoulder{s} elbow{e} wrist{w}" for s in "+-" for e in "+-" for w in "+-"}
    assert set(found.branch) == signs
    for k, q in enumerate(found.q):
        assert solve_ik(arm, arm.fk(q), q).branch == found.branch[k] == found[k].branch


def test_limits_remove_solutions_and_whole_turns_are_no_solutions_of_their_own(tmp_path):
    target = arm_of(tmp_path, "three parallel axes", "-6.2 6.2").fk(GENERIC[:6])
    wide = solve_ik_all(arm_of(tmp_path, "three parallel axes", "-59.7 59.7"), target)
    narrow_arm = arm_of(tmp_path, "three parallel axes", "-1.5 1.5")
    narrow = solve_ik_all(narrow_arm, target)
    assert len(wide) == 8
    assert 1 <= len(narrow) < 8
    assert narrow_arm.limits.contains(narrow.q)
    inside = [q for q in wide.q if (np.abs(np.remainder(q + np.pi, 2 * np.pi) - np.pi) <= 1.5).all()]
    assert len(narrow) == len(inside)


def test_solutions_are_sorted_by_their_distance_from_q0_and_turned_towards_it(tmp_path):
    arm = arm_of(tmp_path, "three parallel axes", "-18.85 18.85")
    q0 = np.full(6, 7.0)
    found = solve_ik_all(arm, arm.fk(GENERIC[:6]), q0=q0)
    distances = np.linalg.norm(found.q - q0, axis=1)
    assert len(found) == 8
    assert (np.diff(distances) >= 0).all()
    assert (np.abs(found.q - q0) <= np.pi + 1e-9).all()
    assert len(solve_ik_all(arm, arm.fk(GENERIC[:6]), 3, q0)) == 3
    assert np.array_equal(solve_ik_all(arm, arm.fk(GENERIC[:6]), 3, q0).q, found.q[:3])


@pytest.mark.parametrize("name", ["no special axes", "seven joints"])
def test_solutions_of_a_search_are_turned_towards_q0(tmp_path, name: str):
    arm = arm_of(tmp_path, name, "-18.85 18.85")
    q0 = np.full(arm.n, 9.0)
    found = solve_ik_all(arm, arm.fk(GENERIC[: arm.n]), 8, q0)
    assert found.ok.all()
    assert (np.abs(found.q - q0) <= np.pi + 1e-9).all()


@pytest.mark.parametrize("name", SIX_JOINTS)
def test_nearest_is_the_first_of_all_solutions(tmp_path, name: str):
    arm = arm_of(tmp_path, name)
    rng = np.random.default_rng(12)
    for q, q0 in zip(arm.limits.random(arm.home, 25, rng), arm.limits.random(arm.home, 25, rng), strict=True):
        found = solve_ik_all(arm, arm.fk(q), q0=q0)
        nearest = solve_ik(arm, arm.fk(q), q0, nearest=True)
        assert nearest.ok
        assert np.abs(nearest.q - found.q[0]).max() < 1e-6


def test_an_arm_of_seven_joints_is_swept_over_its_self_motion(tmp_path):
    arm = arm_of(tmp_path, "seven joints", "-2.8 2.8")
    target = arm.fk(GENERIC)
    found = solve_ik_all(arm, target, 256, GENERIC)
    assert len(found) >= 64
    assert not found.is_complete
    assert max(mujoco_error(arm, q, target)[0] for q in found.q) <= 1e-5
    assert arm.limits.contains(found.q)
    assert np.abs(found.q[0] - GENERIC).max() < 1e-3
    assert min(distance(q, np.delete(found.q, k, axis=0)) for k, q in enumerate(found.q)) > 1e-4
    brute = solve_ik_batch(arm, [target] * 2000, arm.limits.random(arm.home, 2000, np.random.default_rng(0)))
    assert max(distance(q, found.q) for q in brute.q[brute.ok]) < 0.6


def test_a_point_is_reached_in_many_ways_by_six_joints(tmp_path):
    arm = arm_of(tmp_path, "three parallel axes")
    point = arm.fk(GENERIC[:6]).position
    found = solve_ik_all(arm, point, 100)
    assert 50 <= len(found) <= 100
    assert np.linalg.norm(arm.fk_many(found.q)[0] - point, axis=1).max() <= 1e-5


def test_without_a_solution_there_is_one_row_with_the_reason(tmp_path):
    arm = arm_of(tmp_path, "a spherical wrist")
    found = solve_ik_all(arm, Pose([3.0, 0.0, 0.0]))
    assert not found
    assert len(found) == 1
    assert not found.is_complete
    assert found.reason[0] == solve_ik(arm, Pose([3.0, 0.0, 0.0])).reason
    point = solve_ik_all(arm, [3.0, 0.0, 0.0])
    assert (len(point), point.is_complete) == (1, False)
    assert point.reason[0] == solve_ik(arm, [3.0, 0.0, 0.0]).reason


@pytest.mark.parametrize("name", ["a spherical wrist", "a spherical wrist behind axes that are not special"])
def test_a_pose_at_an_absurd_distance_is_out_of_reach(tmp_path, name: str):
    arm = arm_of(tmp_path, name)
    for far in (1e100, 1e150, 1e200, 1e300):
        assert solve_ik_all(arm, Pose([far, 0.0, 0.0])).reason[0] == f"out of reach by {far:.3g} m; positions are in metres"


def test_solutions_in_contact_are_left_out():
    arm = armctl.load("robot_arm_3dof")
    contacts = collision_checker(arm)
    touching = next(q for q in arm.limits.random(arm.home, 500, np.random.default_rng(0)) if contacts.at(q))
    point = arm.fk(touching).position
    anywhere = solve_ik_all(arm, point)
    free = solve_ik_all(arm, point, avoid=True)
    assert len([q for q in anywhere.q if not contacts.at(q)]) == (len(free) if free else 0)
    assert free or "no solution without contact" in free.reason[0]


def test_the_same_call_gives_the_same_bits(tmp_path):
    arm = arm_of(tmp_path, "a spherical wrist")
    first, second = (solve_ik_all(arm, arm.fk(GENERIC[:6])) for _ in range(2))
    assert first.q.tobytes() == second.q.tobytes()
    assert not first.q.flags.writeable


def test_the_fields_that_are_made_when_they_are_read_are_those_of_each_solution(tmp_path):
    arm = arm_of(tmp_path, "three parallel axes")
    found = solve_ik_all(arm, arm.fk(GENERIC[:6]))
    count = len(found)
    dtypes = [bool, float, float, object, int, int]
    fields = [found.ok, found.position_error, found.orientation_error, found.reason, found.iterations, found.starts]
    assert [(field.shape, field.dtype) for field in fields] == [((count,), np.dtype(dtype)) for dtype in dtypes]
    assert not any(field.flags.writeable for field in fields)
    assert found.starts.tolist() == [1] * count
    assert [result.branch for result in found] == list(found.branch)
    for copied in (copy.deepcopy(found), pickle.loads(pickle.dumps(solve_ik_all(arm, arm.fk(GENERIC[:6]))))):
        assert copied.q.tobytes() == found.q.tobytes()
        assert copied.branch == found.branch
        assert copied.position_error.tolist() == found.position_error.tolist()
    with pytest.raises(AttributeError, match="'IkBatch' object has no attribute 'branches'"):
        _ = found.branches


def test_a_wrong_call_is_one_sentence():
    arm = armctl.load("robot_arm_3dof")
    with pytest.raises(InputError, match=r"^limit: expected a number at least 1, got 0$"):
        solve_ik_all(arm, [0.3, 0.2, 0.3], 0)
    with pytest.raises(InputError, match=r"^target: expected 3 numbers, got 2$"):
        solve_ik_all(arm, [0.3, 0.2])
    with pytest.raises(LimitError, match=r"^q0: "):
        solve_ik_all(arm, [0.3, 0.2, 0.3], q0=[9.0, 0.0, 0.0])


@pytest.mark.parametrize("name", ["no special axes", "a spherical wrist"])
def test_no_solution_is_lost_where_the_start_is_at_a_limit(tmp_path, name: str):
    """Solutions are turned towards q0: one beyond the limit there comes back from the other side."""
    arm = arm_of(tmp_path, name)
    for q in arm.limits.random(arm.home, 4, np.random.default_rng(1)):
        target = arm.fk(q)
        counts = [len(solve_ik_all(arm, target, q0=share * arm.limits.q_max)) for share in (-0.99, 0.0, 0.99)]
        assert counts == [counts[1]] * 3
        assert counts[1] > 1


def test_any_whole_number_of_at_least_zero_is_a_seed(tmp_path):
    arm = arm_of(tmp_path, "seven joints", "-2.8 2.8")
    target = arm.fk(GENERIC)
    for seed in (2**63 - 1, 2**63, 2**64 + 1):
        found = solve_ik_all(arm, target, 8, GENERIC, seed=seed)
        same = solve_ik_all(arm, target, 8, GENERIC, seed=seed % 2**63)
        assert len(found)
        assert np.array_equal([each.q for each in found], [each.q for each in same])


def test_an_arm_with_all_sixteen_solutions_is_complete(tmp_path):
    """Lengths and twists of Manseur and Doty, "A robot manipulator with 16 real inverse kinematic solution sets", 1989."""
    chain = []
    turn = np.eye(3)
    point = np.zeros(3)
    last = np.zeros(3)
    for length, offset, twist in zip((0.3, 1.0, 0.0, 1.5, 0.0, 0.0), (0, 0, 0.2, 0, 0, 0), (90, 1, 90, 1, 90, 1), strict=True):
        chain.append((tuple(point - last), " ".join(f"{x:.12f}" for x in turn[:, 2])))
        last = point
        point = point + turn @ [length, 0.0, offset]
        turn = turn @ Pose([0, 0, 0], rpy=[np.radians(twist), 0, 0]).rotation
    arm = arm_of(tmp_path, chain, "-3.14159 3.14159")
    found = solve_ik_all(arm, arm.fk([2.144, -2.798, 1.378, -1.946, 2.179, 0.249]))
    assert len(found) == 16
    assert found.is_complete
