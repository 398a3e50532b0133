"""IK on each arm: solutions are solutions, failures are honest, limits hold, the same call gives the same bits."""

import dataclasses
import gc
import os
import subprocess
import sys
import warnings
import weakref
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from arms import ARMS, ARMS_WITH_SHAPES, arm_of, some_of
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from synthetic import BENT, limb, motors, serial_arm

import armctl
from armctl import Arm, InputError, LimitError, Pose, solve_ik
from armctl._core import Constraint
from armctl.core.target import Target
from armctl.model.collision.checkers import collision_checker
from armctl.plan.ik import lm
from armctl.plan.ik.problem import ik_chain, read_problem
from armctl.plan.ik.solve_batch import solve_ik_batch

every_arm = pytest.mark.parametrize("name", some_of(ARMS))


def positions(arm: Arm, count: int, seed: int = 0) -> np.ndarray:
    return arm.limits.random(arm.home, count, np.random.default_rng(seed))


def target_of(arm: Arm, q: np.ndarray) -> Pose | np.ndarray:
    """A pose that is generic for the arm: with fewer than five joints a point."""
    T = arm.fk(q)
    return T if arm.n >= 5 else T.position


def mujoco_error(arm: Arm, q: np.ndarray, target: Pose | np.ndarray) -> tuple[float, float]:
    """What MuJoCo's own kinematics say of an answer."""
    data = mujoco.MjData(arm.model)
    data.qpos[:] = arm.qpos(q)
    mujoco.mj_kinematics(arm.model, data)
    T = Pose.from_rotation(data.xpos[arm.tip_body], data.xmat[arm.tip_body].reshape(3, 3)) @ arm.T_body_tip
    if isinstance(target, Pose):
        return T.distance(target)
    return float(np.linalg.norm(T.position - target)), 0.0


@every_arm
def test_reaches_what_can_be_reached_also_at_the_joint_limits(name: str):
    arm = arm_of(name)
    rng = np.random.default_rng(1)
    for k, q in enumerate(positions(arm, 40)):
        if k % 4 == 3:
            at_limit = np.where(rng.random(arm.n) < 0.5, arm.limits.q_min, arm.limits.q_max)
            q = np.where(np.isfinite(at_limit) & (rng.random(arm.n) < 0.5), at_limit, q)
        target = target_of(arm, q)
        result = solve_ik(arm, target)
        assert result.ok, f"{q}: {result}"
        off, turned = mujoco_error(arm, result.q, target)
        assert off <= 1e-5 + 1e-9
        assert turned <= 1e-4 + 1e-9
        assert (off, turned) == pytest.approx((result.position_error, result.orientation_error), abs=1e-8)
        assert arm.limits.contains(result.q)
        assert result.reason == ""


@every_arm
def test_a_point_out_of_reach_is_approached_as_near_as_any_position_comes(name: str):
    arm, rng = arm_of(name), np.random.default_rng(4)
    middle, reach = arm.pinocchio_model.placements[0, :3, 3], ik_chain(arm).reach
    points = middle + 1.3 * reach * rng.uniform(-1, 1, (60, 3))
    found = solve_ik_batch(arm, points)
    tips = arm.fk_many(arm.limits.random(arm.home, 20_000, rng))[0]
    for point, error in zip(points, found.position_error, strict=True):
        assert error <= np.linalg.norm(tips - point, axis=1).min() + 1e-5


@every_arm
def test_refining_ends_finite_and_inside_the_limits_from_anywhere(name: str):
    arm, rng = arm_of(name), np.random.default_rng(5)
    targets = np.zeros((2000, 12))
    targets[:, 9:] = ik_chain(arm).reach * rng.uniform(-1.5, 1.5, (2000, 3))
    problem = read_problem(arm, Constraint.POSITION, targets, arm.limits.random(arm.home, 2000, rng), 1e-5, 1e-4, 0)
    q, sizes = lm.refine(problem, problem.q0)
    assert np.isfinite(q).all()
    assert np.isfinite(sizes).all()
    assert arm.limits.contains(q)


@every_arm
@pytest.mark.parametrize("far", [1e150, 1e300])
def test_a_target_whose_square_is_no_number_is_approached_in_its_direction(name: str, far: float):
    arm = arm_of(name)
    direction = np.array([0.6, 0.0, 0.8])
    result = solve_ik(arm, far * direction)
    assert not result.ok
    assert "out of reach" in result.reason
    assert arm.limits.contains(result.q)
    farthest = (arm.fk_many(positions(arm, 2000))[0] @ direction).max()
    assert arm.fk(result.q).position @ direction >= farthest - 1e-3


@every_arm
def test_out_of_reach_is_a_best_effort_with_a_reason(name: str):
    arm = arm_of(name)
    reach, base = ik_chain(arm).reach, arm.pinocchio_model.placements[0, :3, 3]
    for far in (1.5, 10.0, 1e6):
        target = base + far * reach * np.array([0.6, 0.0, 0.8])
        result = solve_ik(arm, target)
        assert not result.ok
        assert "out of reach" in result.reason
        assert arm.limits.contains(result.q)
        least = np.linalg.norm(arm.fk_many(positions(arm, 2000))[0] - target, axis=1).min()
        assert result.position_error <= least + 1e-9 * far
        assert result.position_error == pytest.approx(mujoco_error(arm, result.q, target)[0], rel=1e-9)
        assert result.reason.startswith("out of reach by ")
        assert result.reason.endswith("; positions are in metres") == (result.position_error > 10.0)


def test_an_orientation_that_five_joints_cannot_take_is_a_best_effort():
    arm = arm_of("so_arm100")
    twisted = arm.fk(arm.home) @ Pose([0.0, 0.0, 0.0], rpy=[0.3, 0.4, 0.8])
    result = solve_ik(arm, twisted)
    assert not result.ok
    assert result.reason.startswith("the point is reachable, but not with this orientation: ")
    assert f"{result.orientation_error:.3g} rad off" in result.reason
    assert result.position_error < 0.1
    assert result.orientation_error > 1e-3


def test_an_arm_reaches_poses_as_exactly_as_asked():
    arm = arm_of("robot_arm_3dof")
    for q in positions(arm, 40):
        assert solve_ik(arm, arm.fk(q), position_tolerance=1e-12, orientation_tolerance=1e-12)


def test_tolerances_below_rounding_are_named_as_the_reason(load):
    with pytest.warns(armctl.ArmctlWarning, match="are these millimetres"):  # 200 km, which rounding knows to 3e-11 m
        arm = load(limb("a b c", '<site name="tip" pos="2e5 0 0"/>'), motors("a b c"))
    tight = {"position_tolerance": 1e-12, "orientation_tolerance": 1e-12}
    targets = [arm.fk(q) for q in positions(arm, 80)]
    refused = [result for target in targets if not (result := solve_ik(arm, target, **tight))]
    assert len(refused) >= 10
    for result in refused:
        errors = f"{result.position_error:.2g} m and {result.orientation_error:.2g} rad"
        assert result.reason == f"reached up to {errors}, which is near rounding; give larger tolerances"
        assert max(result.position_error, result.orientation_error) < 1e-8
    reasons = [reason for reason in armctl.solve_ik_batch(arm, targets, **tight).reason if reason]
    assert len(reasons) >= 10
    assert all(reason.endswith(", which is near rounding; give larger tolerances") for reason in reasons)


def test_a_target_missed_by_more_than_rounding_is_out_of_reach_for_any_tolerance():
    arm = arm_of("robot_arm_3dof")
    turned = arm.fk(arm.home) @ Pose([0.0, 0.0, 0.0], rpy=[1e-4, 0.0, 0.0])
    for tolerance in (1e-12, 1e-9, 1e-6):
        far = solve_ik(arm, [1e3, 0.0, 0.0], position_tolerance=tolerance)
        assert far.reason.startswith("out of reach by ")
        other = solve_ik(arm, turned, position_tolerance=tolerance, orientation_tolerance=tolerance)
        assert not other.reason.startswith("reached up to")
        assert not other.ok


@every_arm
def test_the_base_itself_is_a_target_like_any_other(name: str):
    arm = arm_of(name)
    result = solve_ik(arm, arm.pinocchio_model.placements[0, :3, 3])
    assert np.isfinite(result.q).all()
    assert arm.limits.contains(result.q)
    assert result.ok == (result.position_error <= 1e-5)


@pytest.mark.parametrize("name", some_of(arm for arm in ARMS if arm in ("panda", "ur5e", "so_arm100", "endless")))
def test_a_free_axis_leaves_the_turn_about_it_open(name: str):
    arm = arm_of(name)
    for k, q in enumerate(positions(arm, 8)):
        target = arm.fk(q) @ Pose([0.0, 0.0, 0.0], rpy=[0.0, 0.0, 1.0 + 0.7 * k])
        result = solve_ik(arm, target, free_axis="z")
        assert result.ok, result
        T = arm.fk(result.q)
        assert np.linalg.norm(T.position - target.position) <= 1e-5
        assert T.rotation[:, 2] @ target.rotation[:, 2] > np.cos(1.01e-4)
        assert result.orientation_error == pytest.approx(
            np.linalg.norm(np.cross(T.rotation[:, 2], target.rotation[:, 2])), abs=1e-9
        )


def test_a_result_is_equal_to_itself_alone_and_its_configuration_is_read_only():
    first, second = (solve_ik(arm_of("robot_arm_3dof"), [0.3, 0.2, 0.3]) for _ in range(2))
    assert first == first
    assert first != second
    assert len({first, second}) == 2
    with pytest.raises(ValueError, match="read-only"):
        first.q[0] = 0.0


@pytest.mark.parametrize("solve", [solve_ik, armctl.solve_ik_all])
def test_a_result_cannot_be_changed(solve):
    result = solve(arm_of("robot_arm_3dof"), [0.3, 0.2, 0.3])
    with pytest.raises(dataclasses.FrozenInstanceError):
        result.reason = ""


def test_a_result_is_true_if_it_is_a_solution():
    arm = arm_of("robot_arm_3dof")
    assert solve_ik(arm, [0.3, 0.2, 0.3])
    assert not solve_ik(arm, [3.0, 0.2, 0.3])
    assert solve_ik_batch(arm, [[0.3, 0.2, 0.3], [0.3, 0.1, 0.3]])
    assert not solve_ik_batch(arm, [[0.3, 0.2, 0.3], [3.0, 0.2, 0.3]])


def test_a_target_that_was_read_gives_the_same_answer():
    arm = arm_of("panda") if "panda" in ARMS else arm_of("endless")
    pose = arm.fk(positions(arm, 1)[0])
    for target in (pose, pose.position):
        plain = solve_ik(arm, target)
        read = solve_ik(arm, Target.read(target, 0.1, 0.1))
        assert read.ok
        assert read.q.tobytes() == plain.q.tobytes()


def test_the_same_call_gives_the_same_bits():
    arm = arm_of("robot_arm_3dof")
    for target in ([0.3, 0.2, 0.3], [2.0, 0.0, 0.0]):
        first, second = (solve_ik(arm, target, seed=3) for _ in range(2))
        assert first.q.tobytes() == second.q.tobytes()
        assert (first.position_error, first.iterations, first.starts) == (
            second.position_error,
            second.iterations,
            second.starts,
        )


@every_arm
def test_a_near_target_is_reached_nearby(name: str):
    arm, rng = arm_of(name), np.random.default_rng(2)
    for q0 in positions(arm, 150, seed=3):
        q = arm.limits.clamp(q0 + rng.uniform(-0.05, 0.05, arm.n) * np.where(arm.pinocchio_model.is_slide, 0.2, 1.0))
        result = solve_ik(arm, target_of(arm, q), q0)
        assert result.ok
        assert np.abs(result.q - q0).max() < 0.5


@every_arm
def test_a_joint_turns_no_further_than_it_must(name: str):
    arm = arm_of(name)
    endless = ~np.isfinite(arm.limits.q_max - arm.limits.q_min) & ~arm.pinocchio_model.is_slide
    q0 = np.where(endless, 40.0, arm.home)
    result = solve_ik(arm, target_of(arm, positions(arm, 1)[0]), q0)
    assert result.ok
    assert (np.abs(result.q - q0)[endless] <= np.pi + 1e-9).all()


@pytest.mark.parametrize("name", some_of(arm for arm in ARMS if arm in ("panda", "ur5e", "robot_arm_3dof")))
def test_nearest_is_at_least_as_near(name: str):
    arm = arm_of(name)
    for q, q0 in zip(positions(arm, 3), positions(arm, 3, seed=1), strict=True):
        target = target_of(arm, q)
        near, plain = (solve_ik(arm, target, q0, nearest=nearest) for nearest in (True, False))
        assert near.ok
        assert np.linalg.norm(near.q - q0) <= np.linalg.norm(plain.q - q0) + 1e-4
        assert np.linalg.norm(near.q - q0) <= np.linalg.norm(q - q0) + 1e-4


def test_an_arm_that_nobody_needs_any_more_is_forgotten():
    arm = armctl.load("robot_arm_3dof")
    solve_ik(arm, arm.fk(arm.home), avoid=True)
    armctl.DifferentialIk(arm, avoid=True).step(arm.home, arm.fk(arm.home), 0.01)
    alive = weakref.ref(arm)
    del arm
    gc.collect()
    assert alive() is None


@pytest.mark.parametrize("name", some_of(ARMS_WITH_SHAPES))
def test_avoiding_collisions_is_what_mujoco_says(name: str):
    arm = arm_of(name)
    contacts = collision_checker(arm)
    free = [q for q in positions(arm, 24) if not contacts.at(q)][:12]
    results = [solve_ik(arm, target_of(arm, q), avoid=True) for q in free]
    assert len(free) >= 4
    assert sum(result.ok for result in results) >= 0.75 * len(free)
    assert [bool(contacts.at(result.q)) for result in results] == [not result.ok for result in results]


def test_contacts_between_links_that_always_touch_do_not_count(tmp_path):
    model = tmp_path / "stub.xml"
    model.write_text(
        """<mujoco><worldbody><geom name="floor" type="plane" size="2 2 0.1"/>
        <body name="base"><geom type="box" size=".1 .1 .1" pos="0 0 .1"/>
        <body name="upper" pos="0 0 .2"><joint name="a" axis="0 1 0" range="-180 180"/>
        <geom type="capsule" fromto="0 0 0 0 0 .3" size=".05"/>
        <body name="fore" pos="0 0 .3"><joint name="b" axis="0 1 0" range="-150 150"/>
        <geom type="capsule" fromto="0 0 0 0 0 .3" size=".05"/><site name="tip" pos="0 0 .35"/></body></body></body></worldbody>
        <actuator><motor joint="a" ctrlrange="-9 9"/><motor joint="b" ctrlrange="-9 9"/></actuator></mujoco>"""
    )
    arm = armctl.load(model)
    contacts = collision_checker(arm)
    assert contacts.at(np.zeros(2)) == ""
    assert contacts.at(np.array([2.5, 0.0])) == "upper touches floor"
    below = arm.fk(np.array([2.5, 0.0])).position
    assert solve_ik(arm, below).ok
    blocked = solve_ik(arm, below, avoid=True)
    assert not blocked.ok
    assert "touches floor" in blocked.reason


def test_one_start_of_a_batch_is_that_of_all_its_targets():
    arm = arm_of("robot_arm_3dof")
    points = arm.fk_many(positions(arm, 20))[0]
    start = arm.limits.clamp(arm.home + 0.4)
    batch = solve_ik_batch(arm, points, q0=start)
    assert batch.q.tobytes() == solve_ik_batch(arm, points, q0=np.tile(start, (20, 1))).q.tobytes()
    assert batch.q.tobytes() != solve_ik_batch(arm, points).q.tobytes()
    assert all(np.array_equal(solve_ik(arm, point, start).q, q) for point, q in zip(points, batch.q, strict=True))


@pytest.mark.parametrize(("turned", "ok"), [(0.9e-4, True), (1.1e-4, False)])
def test_the_default_tolerance_of_the_orientation_is_a_tenth_of_a_milliradian(turned: float, ok: bool):
    arm = arm_of("robot_arm_3dof")  # its tip cannot turn about its own axis at a point
    target = arm.fk(arm.home) @ Pose([0.0, 0.0, 0.0], rpy=[0.0, 0.0, turned])
    for result in (solve_ik(arm, target), solve_ik_batch(arm, [target])[0], armctl.solve_ik_all(arm, target)[0]):
        assert result.ok == ok
        assert result.orientation_error == pytest.approx(turned, rel=0.05)


@pytest.mark.parametrize(("away", "ok"), [(0.9e-5, True), (1.1e-5, False)])
def test_the_default_tolerance_of_the_position_is_a_hundredth_of_a_millimetre(away: float, ok: bool):
    arm = arm_of("planar")
    target = arm.fk(arm.home).position + away * out_of_plane(arm)
    for result in (solve_ik(arm, target), solve_ik_batch(arm, target[None])[0], armctl.solve_ik_all(arm, target)[0]):
        assert result.ok == ok
        assert result.position_error == pytest.approx(away, rel=0.05)


def out_of_plane(arm: Arm) -> np.ndarray:
    """(3,) the direction in which the tip cannot move."""
    axes, stretch, _ = np.linalg.svd(arm.jacobian(arm.home)[:3])
    assert stretch[-1] < 1e-9
    return axes[:, -1]


def test_a_batch_is_many_single_calls():
    arm = arm_of("robot_arm_3dof")
    points = np.concatenate([arm.fk_many(positions(arm, 600))[0], [[3.0, 0.0, 0.0]]])
    one, two = (solve_ik_batch(arm, points, threads=threads) for threads in (1, 2))
    assert len(one) == 601
    assert one.ok.sum() == 600
    assert str(one) == "600 of 601 solved"
    assert one.q.tobytes() == two.q.tobytes()
    for i in (0, 300, 600):
        single = solve_ik(arm, points[i])
        assert np.array_equal(single.q, one.q[i])
        assert (one[i].ok, one[i].reason, one[i].starts) == (single.ok, single.reason, single.starts)
        assert one[i].position_error == pytest.approx(single.position_error, abs=1e-15)
    assert "out of reach" in one.reason[600]


def test_a_batch_takes_poses_and_transforms_and_starts():
    arm = arm_of("endless")
    Q = positions(arm, 20)
    poses = [arm.fk(q) for q in Q]
    assert solve_ik_batch(arm, poses).ok.all()
    warm = solve_ik_batch(arm, np.array([T.matrix for T in poses]), Q)
    assert warm.ok.all()
    assert np.abs(warm.q - Q).max() < 1e-3
    assert len(solve_ik_batch(arm, np.empty((0, 3)))) == 0


def test_a_batch_shows_its_progress_to_a_person_only(monkeypatch, capsys):
    arm = arm_of("robot_arm_3dof")
    points = arm.fk_many(positions(arm, 600))[0]
    monkeypatch.setattr("armctl.core.progress.DELAY_S", 0.0)
    solve_ik_batch(arm, points)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    solve_ik_batch(arm, points)
    assert "600/600" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "error", "sentence"),
    [
        ({"target": [0.1, 0.2]}, InputError, "target: expected 3 numbers, got 2"),
        ({"target": [0.1, 0.2, float("nan")]}, InputError, "target: element [2] is nan, expected a finite number"),
        ({"target": "there"}, InputError, "target: 'there' is not an array of numbers"),
        ({"q0": [0.0, 0.0]}, InputError, "q0: expected 3 numbers, got 2"),
        (
            {"q0": [0.0, 9.0, 0.0]},
            LimitError,
            "q0: shoulder_pitch: 9 rad is outside [-1.570, 1.570] rad; degrees? np.radians converts them",
        ),
        ({"position_tolerance": 0.0}, InputError, "position_tolerance: expected a number at least 1e-12, got 0"),
        ({"free_axis": "w"}, InputError, "free_axis: expected one of x, y, z, got 'w'"),
        (
            {"free_axis": "z"},
            InputError,
            "free_axis: a point leaves every axis free; give a Pose as the target",
        ),
        ({"free_axis": ["x"]}, InputError, "free_axis: expected one of x, y, z, got ['x']"),
        ({"seed": 1.5}, InputError, "seed: expected a whole number at least 0, got 1.5"),
        ({"seed": -1}, InputError, "seed: expected a number at least 0, got -1"),
        ({"q0": [[0.0], [0.0, 1.0]]}, InputError, "q0: [[0.0], [0.0, 1.0]] is not an array of numbers"),
        ({"orientation_tolerance": float("nan")}, InputError, "orientation_tolerance: expected a finite number, got nan"),
        ({"nearest": np.zeros(2)}, InputError, "nearest: expected True or False, got array([0., 0.])"),
    ],
)
def test_a_wrong_call_is_one_sentence(arguments, error, sentence):
    with pytest.raises(error) as caught:
        solve_ik(arm_of("robot_arm_3dof"), **{"target": [0.3, 0.2, 0.3], **arguments})
    assert str(caught.value) == sentence


def test_a_name_is_not_an_arm():
    for call in (solve_ik, solve_ik_batch):
        with pytest.raises(InputError, match=r"^arm: expected Arm, got 'panda'; armctl.load\('panda'\) returns one$"):
            call("panda", [[0.3, 0.2, 0.3]] if call is solve_ik_batch else [0.3, 0.2, 0.3])


def test_a_batch_of_rounded_transforms_is_solved_as_each_of_them_alone():
    arm = arm_of("universal_robots_ur5e")
    q = np.random.default_rng(3).uniform(-1.5, 1.5, (6, arm.n))
    T = np.round([arm.fk(row).matrix for row in q], 4)
    found = solve_ik_batch(arm, T)
    for k, matrix in enumerate(T):
        alone = solve_ik(arm, Pose.from_matrix(matrix))
        assert alone.ok
        assert np.array_equal(found.q[k], alone.q)


@pytest.mark.parametrize(
    ("targets", "more", "sentence"),
    [
        (Pose([0.0, 0.0, 0.0]), {}, "targets: expected a list of Poses, got one Pose; solve_ik takes one"),
        (
            np.zeros((2, 4, 4)),
            {},
            "targets: element 0: no rigid transform: its last row is [0.0, 0.0, 0.0, 0.0], expected 0, 0, 0, 1; "
            "the position is the last column",
        ),
        (
            np.stack([np.eye(4), np.diag([0.0, 0, 0, 1])]),
            {},
            "targets: element 1: no rotation: its rows have the lengths [0.0, 0.0, 0.0], expected 1; remove a scale before",
        ),
        (
            np.stack([np.eye(4), np.diag([1.0, 1, -1, 1])]),
            {},
            "targets: element 1: no rotation: it mirrors: its determinant is -1, expected 1; "
            "z must be the cross product of x and y",
        ),
        (
            np.stack([np.eye(4), np.eye(4) + np.diag([1e-2, 0.0, 0.0], 1)]),
            {},
            "targets: element 1: no rotation: its rows are not perpendicular: the cosine between two is 0.01, at most 0.0017",
        ),
        (
            np.stack([np.eye(4), np.eye(4) + np.eye(4, k=-3)]),
            {},
            "targets: element 1: no rigid transform: its last row is [1.0, 0.0, 0.0, 1.0], expected 0, 0, 0, 1; "
            "it is transposed",
        ),
        (np.zeros((2, 3)), {"threads": 0}, "threads: expected a number at least 1, got 0"),
        (np.zeros((2, 3)), {"q0": np.zeros((3, 3))}, "q0: 3 rows given for 2 targets"),
        (np.zeros((2, 5)), {}, "targets: expected rows of 3 numbers, got 5"),
    ],
)
def test_a_wrong_batch_is_one_sentence(targets, more, sentence):
    with pytest.raises(InputError) as caught:
        solve_ik_batch(arm_of("robot_arm_3dof"), targets, **more)
    assert str(caught.value) == sentence


@st.composite
def chains(draw) -> str:
    """MJCF of a random serial chain: three to nine joints, hinges and slides, odd axes and anchors, some without limits."""
    n = draw(st.integers(3, 9))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    words = lambda values: " ".join(f"{x:.6f}" for x in values)  # noqa: E731
    body = '<site name="tip" pos="0.05 0 0.1"/>'
    for k in reversed(range(n)):
        kind = "slide" if rng.random() < 0.25 else "hinge"
        limited = kind == "slide" or rng.random() < 0.7
        low = rng.uniform(-2.5, -0.5) * (0.2 if kind == "slide" else 1)
        bounds = f'range="{low:.6f} {low + rng.uniform(1.0, 3.0) * (0.2 if kind == "slide" else 1):.6f}"' if limited else ""
        body = (
            f'<body name="b{k}" pos="{words(rng.uniform(-0.2, 0.3, 3))}" quat="{words(rng.normal(size=4))}">'
            f'<joint name="j{k}" type="{kind}" axis="{words(rng.normal(size=3))}" pos="{words(rng.uniform(-0.05, 0.05, 3))}" '
            f'ref="{rng.uniform(-0.1, 0.1):.6f}" {bounds}/><geom type="sphere" size="0.02"/>{body}</body>'
        )
    motors = "".join(f'<motor joint="j{k}" ctrlrange="-50 50"/>' for k in range(n))
    return (
        '<mujoco><compiler angle="radian"/><default><geom contype="0" conaffinity="0"/></default>'
        f"<worldbody>{body}</worldbody><actuator>{motors}</actuator></mujoco>"
    )


NARROW = """<mujoco><compiler angle="radian" autolimits="true"/>
<default><geom contype="0" conaffinity="0"/></default><worldbody>
<body pos="0 0 0.072"><joint name="a" axis="0 0 1" range="-3.14158 3.14158"/><geom size="0.01"/>
<body pos="0 0 0.03865"><joint name="b" axis="0 1 0" range="-1.88496 1.98968"/><geom size="0.01"/>
<body pos="0.04975 0 0.25"><joint name="c" axis="0 1 0" range="-2.14675 1.6057"/><geom size="0.01"/>
<body pos="0.175 0 0"><joint name="d" axis="1 0 0" range="-1.4 1.2"/><geom size="0.01"/>
<body pos="0.075 0 0"><joint name="e" axis="0 1 0" range="-1.74533 2.14675"/><geom size="0.01"/>
<body pos="0.065 0 0"><joint name="f" axis="1 0 0" range="-1.3 1.5"/><geom size="0.01"/><site name="tip" pos="0.0936 0 0"/>
</body></body></body></body></body></body></worldbody><actuator><motor joint="a" ctrlrange="-9 9"/><motor joint="b"
ctrlrange="-9 9"/><motor joint="c" ctrlrange="-9 9"/><motor joint="d" ctrlrange="-9 9"/><motor joint="e" ctrlrange="-9 9"/>
<motor joint="f" ctrlrange="-9 9"/></actuator></mujoco>"""


@pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")
def test_no_pose_at_the_joint_limits_is_missed_on_two_parallel_axes_and_narrow_wrists(tmp_path):
    path = tmp_path / "narrow.xml"
    path.write_text(NARROW)
    arm = armctl.load(path)
    rng = np.random.default_rng(8)
    Q = arm.limits.random(arm.home, 3000, rng)
    limits = np.where(rng.random(Q.shape) < 0.5, arm.limits.q_min, arm.limits.q_max)
    Q = np.where(rng.random(Q.shape) < 0.5, limits, Q)
    found = solve_ik_batch(arm, [arm.fk(q) for q in Q])
    assert found.ok.all(), Q[~found.ok]


def test_a_pose_that_no_configuration_reaches_is_given_up_after_few_starts():
    arm = arm_of("endless")
    far = solve_ik(arm, Pose([50.0, 0.0, 0.0]))
    assert far.starts == 1
    base = arm.pinocchio_model.placements[0, :3, 3]
    near = solve_ik(arm, Pose(base + np.array([0.0, 0.0, 0.99 * ik_chain(arm).reach])))
    assert not near.ok
    assert near.starts <= 110  # as docs/ik.md says


@pytest.mark.parametrize("far", [1e150, 1e200, 1e307])
def test_a_point_at_an_absurd_distance_is_out_of_reach(far: float):
    result = solve_ik(arm_of("robot_arm_3dof"), [far, far, far])
    assert result.reason == f"out of reach by {np.sqrt(3) * far:.3g} m; positions are in metres"
    assert result.position_error == pytest.approx(np.sqrt(3) * far, rel=1e-12)


def test_a_pose_within_reach_but_not_with_its_orientation_leaves_the_tip_at_the_point(tmp_path):
    path = tmp_path / "narrow.xml"
    path.write_text(NARROW)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", armctl.ArmctlWarning)
        arm = armctl.load(path)
    rng = np.random.default_rng(3)
    Q = arm.limits.random(arm.home, 20, rng)
    refused = [solve_ik(arm, arm.fk(q) @ Pose([0.0, 0.0, 0.0], rng.normal(size=4))) for q in Q]
    refused = [result for result in refused if not result.ok]
    assert len(refused) >= 10
    for result in refused:
        assert result.reason.startswith("the point is reachable, but not with this orientation: ")
        assert result.position_error <= 1e-5
        assert result.orientation_error > 1e-4


def test_an_orientation_out_of_reach_is_approached_as_near_as_the_point_permits(tmp_path):
    """SciPy, started at the answer, finds no better orientation with the tip at the point and the joints inside the limits."""
    arm = serial_arm(tmp_path, replace(BENT["six joints"], range="-1.2 1.2", home=""))
    rng = np.random.default_rng(3)
    judged = 0
    for q in arm.limits.random(arm.home, 20, rng):
        target = arm.fk(q) @ Pose([0.0, 0.0, 0.0], rng.normal(size=4))
        result = solve_ik(arm, target)
        if result.ok or result.position_error > 1e-5:
            continue
        best = minimize(
            lambda x, target=target: -np.trace(arm.fk(x).rotation.T @ target.rotation),
            result.q,
            constraints={
                "type": "eq",
                "fun": lambda x, target=target: arm.fk(x).position - target.position,
                "jac": lambda x: arm.jacobian(x)[:3],
            },
            bounds=list(zip(arm.limits.q_min, arm.limits.q_max, strict=True)),
            method="SLSQP",
            options={"maxiter": 200, "ftol": 1e-12},
        )
        position_error, orientation_error = target.distance(arm.fk(best.x))
        if best.success and position_error < 1e-6:
            assert result.orientation_error < orientation_error + 1e-3
            judged += 1
    assert judged >= 10


@settings(max_examples=25, deadline=None)
@given(mjcf=chains(), seed=st.integers(0, 1000))
@pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")
def test_a_solution_on_any_chain_is_a_solution_by_mujoco(tmp_path_factory, mjcf: str, seed: int):
    path = tmp_path_factory.mktemp("chain") / "chain.xml"
    path.write_text(mjcf)
    arm = armctl.load(path)
    for q in positions(arm, 3, seed):
        result = solve_ik(arm, arm.fk(q), q)
        assert result.ok
        assert np.abs(result.q - q).max() < 1e-3
        point = solve_ik(arm, arm.fk(q).position)
        assert point.ok, point
        assert mujoco_error(arm, point.q, arm.fk(q).position)[0] <= 1.001e-5
        assert arm.limits.contains(point.q)


@settings(max_examples=40, deadline=None)
@given(
    point=st.lists(st.floats(-1e6, 1e6), min_size=3, max_size=3),
    quat=st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 1e-3),
    name=st.sampled_from(["robot_arm_3dof", "endless", "gantry"]),
)
def test_whatever_is_asked_the_answer_is_finite_inside_the_limits_and_honest(point, quat, name):
    arm = arm_of(name)
    result = solve_ik(arm, Pose(point, quat))
    assert np.isfinite(result.q).all()
    assert arm.limits.contains(result.q)
    off, turned = mujoco_error(arm, result.q, Pose(point, quat))
    assert off == pytest.approx(result.position_error, rel=1e-7, abs=1e-9)
    assert result.ok == (off <= 1e-5 and turned <= 1e-4)
    assert result.ok == (not result.reason)


def run(code: str, **environment: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, env={**os.environ, **environment}
    )


def test_importing_ik_loads_neither_numba_nor_mink():
    done = run("import armctl.plan.ik, sys; assert not {'numba', 'mink', 'qpsolvers'} & set(sys.modules)")
    assert done.returncode == 0, done.stderr


@every_arm
def test_the_compiled_call_measures_the_errors_that_the_arm_measures(name: str):
    arm = arm_of(name)
    for q in positions(arm, 20, seed=7):
        target = target_of(arm, q)
        result = solve_ik(arm, target)
        tip = arm.fk(result.q)
        errors = tip.distance(target) if isinstance(target, Pose) else (np.linalg.norm(tip.position - target), 0.0)
        assert (result.position_error, result.orientation_error) == pytest.approx(errors, abs=1e-7 * ik_chain(arm).reach)


@pytest.mark.core
@pytest.mark.parametrize("name", ["endless", "robot_arm_3dof"])
def test_threads_share_nothing(name: str):
    arm = arm_of(name)
    targets = [target_of(arm, q) for q in positions(arm, 400, seed=8)]
    alone = [solve_ik(arm, target) for target in targets]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda target: solve_ik(arm, target), targets))
    for one, other in zip(alone, together, strict=True):
        assert one.q.tobytes() == other.q.tobytes()
        assert (one.position_error, one.iterations, one.starts) == (other.position_error, other.iterations, other.starts)


def test_all_kinds_of_targets_and_starts_give_the_same_bits():
    arm = arm_of("endless")
    pose = arm.fk(arm.home)
    q0 = arm.home + 0.125  # exact in single precision, as home is
    for targets in ((pose, Target.read(pose)), (pose.position, list(pose.position), np.repeat(pose.position, 2)[::2])):
        expected = solve_ik(arm, targets[0], q0).q.tobytes()
        for start in (list(q0), q0[None], np.repeat(q0, 2)[::2], np.float32(q0)):
            for target in targets:
                found = solve_ik(arm, target, start, seed=True - 1, position_tolerance=np.float64(1e-5))
                assert found.q.tobytes() == expected
