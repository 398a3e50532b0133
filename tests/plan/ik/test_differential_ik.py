"""DifferentialIk: limits hold whatever happens, targets out of reach end still, nothing is run into."""

import shutil
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import mink
import mujoco
import numpy as np
import pytest
import qpsolvers
import scipy.linalg
import scipy.optimize
from arms import ARMS, arm_of, some_of
from collidable import arm_among, capsule_gaps, placed

import armctl
from armctl import Arm, DifferentialIk, InputError, LimitError, ModelError, Pose
from armctl.core.pose import rotation_from_vector
from armctl.model.collision.checkers import collision_checker
from armctl.model.loading.catalog import BUNDLED
from armctl.plan.ik.target_program import add_inequalities, allows_zero, solved
from armctl.plan.ik.tasks import ClearanceLimit, null_step

every_arm = pytest.mark.parametrize("name", some_of(ARMS))
DT = 0.01


def positions(arm: Arm, count: int, seed: int = 0) -> np.ndarray:
    return arm.limits.random(arm.home, count, np.random.default_rng(seed))


def follow(ik: DifferentialIk, q: np.ndarray, target, steps: int, dt: float = DT) -> tuple[np.ndarray, np.ndarray]:
    """The position and velocity after so many steps."""
    v = np.zeros_like(q)
    for _ in range(steps):
        v = ik.step(q, target, dt)
        q = q + dt * v
    return q, v


def beside(arm: Arm, q: np.ndarray, offset: list[float]) -> np.ndarray:
    return arm.fk(q).position + np.array(offset)


def reachable(arm: Arm, q: np.ndarray) -> Pose | np.ndarray:
    return arm.fk(q) if arm.n >= 5 else arm.fk(q).position


@every_arm
def test_arrives_at_a_near_target_and_stays(name: str):
    arm, rng = arm_of(name), np.random.default_rng(1)
    ik = DifferentialIk(arm)
    scale = np.where(arm.pinocchio_model.is_slide, 0.05, 0.2)
    for q in positions(arm, 3):
        goal = arm.limits.clamp(q + scale * rng.uniform(-1, 1, arm.n))
        target = reachable(arm, goal)
        end, _ = follow(ik, arm.limits.clamp(q), target, 600)
        T = arm.fk(end)
        assert np.linalg.norm(T.position - getattr(target, "position", target)) < 1e-5
        if isinstance(target, Pose):
            assert T.distance(target)[1] < 1e-4
        assert ik.status == "solved"


@every_arm
def test_position_and_velocity_limits_hold_at_random_states_inside_and_at_the_limits(name: str):
    arm, rng, limits = arm_of(name), np.random.default_rng(2), arm_of(name).limits
    ik = DifferentialIk(arm)
    for k, q in enumerate(positions(arm, 10_000 // len(ARMS))):
        if k % 3 == 0:
            corner = np.where(rng.random(arm.n) < 0.5, limits.q_min, limits.q_max)
            q = np.where(np.isfinite(corner) & (rng.random(arm.n) < 0.5), corner, q)
        dt = float(10 ** rng.uniform(-4, 0))
        v = ik.step(q, arm.fk(q) @ Pose(rng.normal(size=3), rng.normal(size=4)), dt)
        assert (np.abs(v) <= limits.v_max).all()
        assert limits.contains(q + dt * v)


@every_arm
def test_from_outside_the_limits_it_moves_back_in(name: str):
    arm, rng, limits = arm_of(name), np.random.default_rng(3), arm_of(name).limits
    ik = DifferentialIk(arm)
    for q in positions(arm, 40):
        q = np.clip(q + rng.normal(size=arm.n) * 2.0, limits.q_min - 0.9, limits.q_max + 0.9)  # half a turn or 1 m is refused
        outside = np.maximum(0.0, np.maximum(limits.q_min - q, q - limits.q_max))
        v = ik.step(q, reachable(arm, arm.home), DT)
        after = q + DT * v
        still = np.maximum(0.0, np.maximum(limits.q_min - after, after - limits.q_max))
        assert (np.abs(v) <= limits.v_max).all()
        assert still == pytest.approx(np.maximum(0.0, outside - DT * limits.v_max), abs=1e-9)


@every_arm
def test_a_target_out_of_reach_ends_still_at_the_nearest_reach(name: str):
    arm = arm_of(name)
    ik = DifferentialIk(arm)
    for point in (np.array([4.0, 1.0, 1.0]), np.array([-30.0, 20.0, 5.0])):
        target = arm.fk(arm.home).position + point
        q = arm.limits.clamp(arm.home + 0.05)
        q, _ = follow(ik, q, target, 1000)
        before = q
        for _ in range(100):
            v = ik.step(q, target, DT)
            q = q + DT * v
            assert np.abs(v).max() < 1e-3
        best = np.linalg.norm(arm.fk_many(positions(arm, 3000))[0] - target, axis=1).min()
        around = arm.limits.clamp(q + 0.02 * np.random.default_rng(0).normal(size=(500, arm.n)))
        local = np.linalg.norm(arm.fk_many(around)[0] - target, axis=1)
        distance = np.linalg.norm(arm.fk(before).position - target)
        assert distance <= local.min() + 1e-5
        assert distance <= best + 0.25 * (np.linalg.norm(point))


@pytest.mark.parametrize("constraint", ["pose", "position"])
def test_the_null_space_goes_to_the_posture_at_its_gain_and_the_tip_stays(constraint: str):
    arm = arm_of("redundant")
    start = arm.home
    target = arm.fk(start) if constraint == "pose" else arm.fk(start).position
    rows = 6 if constraint == "pose" else 3
    rng = np.random.default_rng(4)
    for gain in (0.5, 4.0):
        posture = start + rng.uniform(-0.05, 0.05, arm.n)
        ik = DifferentialIk(arm, posture=posture, posture_gain=gain)
        free = scipy.linalg.null_space(arm.jacobian(start)[:rows])
        assert ik.step(start, target, DT) == pytest.approx(gain * free @ (free.T @ (posture - start)), abs=1e-4)
        q, v = follow(ik, start, target, 1500)
        assert np.linalg.norm(arm.fk(q).position - arm.fk(start).position) < 1e-7
        free = scipy.linalg.null_space(arm.jacobian(q)[:rows])
        assert np.abs(free.T @ (q - posture)).max() < 1e-3
        assert np.abs(v).max() < 1e-3
    assert np.abs(follow(DifferentialIk(arm, posture=posture, posture_gain=0.0), start, target, 50)[0] - start).max() < 1e-9


def test_damping_rises_near_a_singularity():
    arm = arm_of("ur5e")
    ik = DifferentialIk(arm)
    speeds = []
    for wrist in (1.0, 0.3, 0.1, 0.03, 0.01):  # at wrist_2 = 0 two axes are parallel
        q = np.array([0.3, -1.2, 1.4, -1.0, wrist, 0.2])
        J = arm.jacobian(q)
        lost = np.linalg.svd(J)[0][:, -1]
        T = arm.fk(q)
        turn = 1e-4 * lost[3:]
        target = Pose.from_rotation(T.position + 1e-4 * lost[:3], (np.eye(3) + np.cross(np.eye(3), -turn)) @ T.rotation)
        speeds.append(np.abs(ik.step(q, target, 1.0)).max() * np.linalg.svd(J)[1][-1] / 1e-4)
    assert speeds[0] > 0.5
    assert all(a >= b - 1e-3 for a, b in pairwise(speeds))
    assert speeds[-1] < 0.2 * speeds[0]


@pytest.mark.parametrize("far", [1e-4, 0.02, 0.2])  # m
def test_the_orientation_counts_fully_at_targets_in_reach(far: float):
    """One radian counts like a third of a reach."""
    arm = arm_of("six joints")
    q = positions(arm, 1)[0]
    T = arm.fk(q)
    J = arm.jacobian(q)
    ik = DifferentialIk(arm, posture_gain=0.0)

    def gradient(offset: np.ndarray, turn: np.ndarray) -> np.ndarray:
        ik.step(q, Pose.from_rotation(T.position + offset, rotation_from_vector(turn) @ T.rotation), 1e6)  # no limit on speed
        return ik.tip.compute_qp_objective(ik.configuration).c[arm.dof_adr]

    turn = np.array([0.006, -0.008, 0.005])
    offset = far * np.array([0.0, 0.6, 0.8])
    of_turn = gradient(offset, turn) - gradient(offset, np.zeros(3))
    np.testing.assert_allclose(of_turn, -J[3:].T @ turn / 9, atol=0.05 * np.linalg.norm(J[3:].T @ turn) / 9)


@pytest.mark.parametrize("name", ["six joints", "redundant"])
def test_a_pose_out_of_reach_is_approached_almost_as_near_as_its_point(name: str):
    arm = arm_of(name)
    point = arm.fk(arm.home).position + np.array([3.0, 2.0, 1.0])
    ik = DifferentialIk(arm)
    q = arm.limits.clamp(arm.home + 0.05)
    distances = []
    for target in (Pose(point, [0.4, -0.7, 0.2, 0.5]), point):
        end, v = follow(ik, q, target, 600)
        assert np.abs(v).max() < 1e-3
        distances.append(np.linalg.norm(arm.fk(end).position - point))
    assert distances[0] < distances[1] + 0.01


def turn_of_mink(arm: Arm, start: np.ndarray, target: Pose, dt: float) -> float:
    """rad, the largest rotation error on the way to a target by mink's own program with the same limits."""
    model = arm.model
    configuration = mink.Configuration(model, arm.qpos(start))
    is_site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, arm.tip) >= 0
    task = mink.FrameTask(arm.tip, "site" if is_site else "body", position_cost=1.0, orientation_cost=1.0)
    rotation = mink.SO3.from_matrix(target.rotation)
    task.set_target(mink.SE3.from_rotation_and_translation(rotation, target.position))
    speeds = dict(zip(arm.joint_names, arm.limits.v_max.tolist(), strict=True))
    limits = [mink.ConfigurationLimit(model), mink.VelocityLimit(model, speeds)]
    most = 0.0
    for _ in range(int(0.6 / dt)):
        v = mink.solve_ik(configuration, [task], dt, "daqp", limits=limits, damping=1e-12)
        configuration.integrate_inplace(v, dt)
        most = max(most, arm.fk(configuration.q[arm.qpos_adr]).distance(target)[1])
    return most


@pytest.mark.parametrize("name", some_of(["six joints", "redundant", "ur5e", "panda", "iiwa14"], ["six joints", "redundant"]))
@pytest.mark.parametrize("dt", [0.0027, 0.01])
def test_a_translation_under_speed_limits_turns_the_tip_less_than_cutting_off_single_joints(name: str, dt: float):
    arm = arm_of(name)
    rng = np.random.default_rng(7)
    starts = arm.limits.clamp(arm.home + rng.uniform(-0.4, 0.4, (12, arm.n)))
    inside = [q for q in starts if np.linalg.svd(arm.jacobian(q))[1][-1] > 0.1][:3]
    assert inside
    ours = []
    mink_turns = []
    for start in inside:
        q = start
        T = arm.fk(start)
        offset = rng.normal(size=3)
        target = Pose.from_rotation(T.position + 0.07 * offset / np.linalg.norm(offset), T.rotation)
        if not armctl.solve_ik(arm, target, start).ok:
            continue
        ik = DifferentialIk(arm, posture_gain=0.0)
        turned = [0.0]
        limited = False
        for _ in range(int(0.6 / dt)):
            v = ik.step(q, target, dt)
            limited |= bool((np.abs(v) > 0.999 * arm.limits.v_max).any())
            q = q + dt * v
            turned.append(arm.fk(q).distance(target)[1])
        assert limited
        ours.append(max(turned))
        mink_turns.append(turn_of_mink(arm, start, target, dt))
        assert turned[-1] < 1e-4
    assert ours
    assert (np.array(ours) <= 1.05 * np.array(mink_turns) + 1e-5).all(), (ours, mink_turns)
    assert max(ours) < 0.01


def test_further_tasks_limits_and_constraints_pass_through():
    arm = arm_of("iiwa14")
    name = arm.joint_names[0]
    slow = DifferentialIk(arm, limits=[mink.VelocityLimit(arm.model, {name: 0.01})])
    v = slow.step(arm.home, beside(arm, arm.home, [0.0, 0.3, 0.0]), DT)
    assert abs(v[0]) <= 0.01 + 1e-9
    frozen = DifferentialIk(arm, constraints=[mink.DofFreezingTask(arm.model, dof_indices=[int(arm.dof_adr[0])])])
    v = frozen.step(arm.home, beside(arm, arm.home, [0.0, 0.3, 0.0]), DT)
    assert abs(v[0]) < 1e-9
    assert np.abs(v).max() > 0.01
    posture = mink.PostureTask(arm.model, cost=10.0)
    posture.set_target(arm.qpos(arm.home))
    held = DifferentialIk(arm, tasks=[posture])
    free = np.abs(DifferentialIk(arm).step(arm.home, beside(arm, arm.home, [0.0, 0.01, 0.0]), 1.0)).max()
    assert np.abs(held.step(arm.home, beside(arm, arm.home, [0.0, 0.01, 0.0]), 1.0)).max() < 0.1 * free


@every_arm
def test_a_target_by_tip_keeps_the_acceleration_limits_of_an_arm_with_one_tip(name: str):
    arm = arm_of(name)
    target = arm.fk(arm.limits.clamp(arm.home + np.where(arm.pinocchio_model.is_slide, 0.05, 0.2)))
    target = target if arm.n >= 5 else target.position
    ik = DifferentialIk(arm)
    q, before = arm.home, np.zeros(arm.n)
    for _ in range(800):
        v = ik.step(q, {arm.tip: target}, DT)
        assert (np.abs(v - before) <= arm.limits.a_max * DT * (1 + 1e-9)).all()
        q, before = q + DT * v, v
    assert np.linalg.norm(arm.fk(q).position - getattr(target, "position", target)) < 1e-4


def test_a_damping_task_of_mink_slows_the_joints_down():
    arm = arm_of("iiwa14")
    target = beside(arm, arm.home, [0.0, 0.01, 0.0])
    speeds = []
    for cost in (0.0, 0.1, 1.0):
        ik = DifferentialIk(arm, tasks=[mink.DampingTask(arm.model, cost=cost)])
        speeds.append(np.linalg.norm(ik.step(arm.home, target, 0.1)))
    assert speeds[0] > speeds[1] > speeds[2] > 0.0


class Impossible(mink.Limit):
    """Asks that all joints move both ways at once."""

    def compute_qp_inequalities(self, configuration, dt):
        G = np.eye(configuration.nv)
        return mink.Constraint(np.vstack([G, -G]), -np.ones(2 * configuration.nv))


@pytest.mark.parametrize("solver", ["daqp", "osqp"])
def test_a_program_without_a_solution_is_a_status(solver: str):
    arm = arm_of("robot_arm_3dof")
    ik = DifferentialIk(arm, limits=[Impossible()], solver=solver)
    assert (ik.step(arm.home, [0.3, 0.2, 0.3], DT) == 0).all()
    assert ik.status == "no solution"


@pytest.mark.parametrize("solver", ["daqp", "osqp"])
def test_every_solver_arrives(solver: str):
    arm = arm_of("robot_arm_3dof")
    q, _ = follow(DifferentialIk(arm, solver=solver), arm.home, [0.3, 0.2, 0.3], 400)
    assert np.abs(arm.fk(q).position - [0.3, 0.2, 0.3]).max() < 1e-4


def deepest(arm: Arm, q: np.ndarray) -> float:
    """How deep geoms that the checker tells apart are in each other, m: MuJoCo's contacts, and capsules by brute force."""
    data = placed(arm, q)
    geometry = collision_checker(arm).geometry
    pairs = {tuple(sorted(geometry.pair_geoms(p))) for p in range(len(geometry.pairs))}
    depths = [-contact.dist for contact in data.contact if tuple(sorted(contact.geom.tolist())) in pairs]
    for box in np.flatnonzero(arm.model.geom_type == int(mujoco.mjtGeom.mjGEOM_BOX)).tolist():
        if np.allclose(data.geom_xmat[box], np.eye(3).ravel()):
            gaps = capsule_gaps(arm.model, data, box).items()
            depths += [-gap for capsule, gap in gaps if tuple(sorted((capsule, box))) in pairs]
    return max(depths, default=0.0)


def with_wall(arm: Arm, name: str, folder: Path) -> Arm:
    """The same arm before a wall half its reach away."""
    spec = mujoco.MjSpec.from_file(str(armctl.model.loading.catalog.locate(name).path))
    where = 0.5 * float(np.linalg.norm(arm.fk(arm.home).position)) + 0.1
    spec.worldbody.add_geom(name="wall", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.02, 1.0, 1.0], pos=[where, 0.0, 0.5])
    source = armctl.model.loading.catalog.locate(name).path
    shutil.copytree(source.parent, folder, dirs_exist_ok=True)
    (folder / "walled.xml").write_text(spec.to_xml())
    return armctl.load(folder / "walled.xml")


def runs_into_nothing(arm: Arm, toward: Callable[[np.ndarray], np.ndarray], count: int, steps: int) -> int:
    """Follows a target behind things from free configurations; returns how many of them came near something."""
    ik = DifferentialIk(arm, avoid=True)
    contacts = collision_checker(arm)
    starts = [q for q in positions(arm, 20 * count) if not contacts.at(q)][:count]
    assert len(starts) == count
    near = 0
    for q in starts:
        target = toward(q)
        least = np.inf
        for _ in range(steps):
            q = q + 2 * DT * ik.step(q, target, 2 * DT)
            assert deepest(arm, q) < 1e-6
            least = min(least, contacts.nearest(q)[1])
        near += least < 0.02
    return near


@pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")
def test_runs_into_nothing_of_any_shape_and_not_into_itself(tmp_path: Path):
    arm = arm_among(tmp_path)
    things = [arm.model.geom(name).pos for name in ("plate", "post", "egg", "ball", "rod", "rock")]
    targets = iter([*things, np.array([0.0, 0.0, 0.1])] * 4)
    assert runs_into_nothing(arm, lambda q: next(targets), 21, 20) > 10


@pytest.mark.parametrize("name", [BUNDLED, "panda"])
@pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")
def test_stops_before_a_wall(name: str, tmp_path: Path):
    arm = with_wall(arm_of(name), name, tmp_path)
    assert runs_into_nothing(arm, lambda q: beside(arm, q, [1.0, 0.0, 0.0]), 4, 20) > 1


@pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")
def test_from_inside_a_plate_it_moves_out(tmp_path: Path):
    arm = arm_among(tmp_path, '<geom name="plate" type="box" size="0.3 0.3 0.02" pos="0.45 0 0.3"/>')
    contacts = collision_checker(arm)
    ik = DifferentialIk(arm, avoid=True)
    inside = [q for q in positions(arm, 200) if "plate" in contacts.at(q) and deepest(arm, q) < 0.04][:5]
    ends = [follow(ik, q, arm.fk(q).position, 60, 2 * DT)[0] for q in inside]
    assert [contacts.at(q) for q in ends] == [""] * 5


def test_steps_that_avoid_collisions_do_not_depend_on_earlier_ones(tmp_path: Path):
    arm = arm_among(tmp_path)
    q = positions(arm, 1)[0]
    target = beside(arm, q, [0.3, 0.0, -0.3])
    first = DifferentialIk(arm, avoid=True).step(q, target, DT)
    collision_checker(arm).nearest(arm.home)
    used = DifferentialIk(arm, avoid=True)
    follow(used, arm.home, target, 5)
    assert np.array_equal(used.step(q, target, DT), first)


def test_a_height_field_cannot_be_avoided(tmp_path: Path):
    hills = '<hfield name="hills" nrow="3" ncol="3" elevation="0 0 0 0 1 0 0 0 0" size="1 1 0.3 0.1"/>'
    arm = arm_among(tmp_path, '<geom name="hills" type="hfield" hfield="hills"/>', hills)
    with pytest.raises(ModelError, match=r"^hills: a height field or signed distance field, for which no"):
        DifferentialIk(arm, avoid=True)


@pytest.mark.parametrize(
    ("arguments", "error", "sentence"),
    [
        (
            {"posture": [0.0, 9.0, 0.0]},
            LimitError,
            "posture: shoulder_pitch: 9 rad is outside [-1.570, 1.570] rad; degrees? np.radians converts them",
        ),
        ({"solver": "dacp"}, InputError, "solver: expected one of daqp, osqp, got 'dacp'"),
        ({"clearance": -1.0}, InputError, "clearance: expected a number at least 0, got -1"),
        ({"limits": 1.0}, InputError, "limits: expected a list of mink Limit objects, got 1.0"),
        ({"tasks": ["tip"]}, InputError, "tasks: expected a list of mink BaseTask objects, got ['tip']"),
    ],
)
def test_a_wrong_follower_is_one_sentence(arguments, error, sentence):
    with pytest.raises(error) as caught:
        DifferentialIk(arm_of("robot_arm_3dof"), **{"avoid": True, **arguments})
    assert str(caught.value) == sentence


def test_a_wrong_step_is_one_sentence():
    ik = DifferentialIk(arm_of("robot_arm_3dof"))
    with pytest.raises(InputError, match=r"^dt: expected a number at least 1e-09, got 0$"):
        ik.step([0.0, 0.0, 0.0], [0.3, 0.2, 0.3], 0.0)
    with pytest.raises(InputError, match=r"^q: element \[1\] is nan, expected a finite number$"):
        ik.step([0.0, float("nan"), 0.0], [0.3, 0.2, 0.3], DT)


def test_a_step_that_ends_too_near_is_shortened_to_half_the_clearance(tmp_path):
    """A ball on a slide before a wall: the distance is known."""
    path = tmp_path / "ball.xml"
    path.write_text(
        '<mujoco><worldbody><geom name="wall" type="box" size="0.02 0.2 0.2" pos="0.3 0 0"/><body><joint name="x" type="slide" '
        'axis="1 0 0" range="-1 1"/><geom size="0.02" mass="1"/><site name="tip"/></body></worldbody>'
        '<actuator><motor joint="x" ctrlrange="-9 9"/></actuator></mujoco>'
    )
    limit = ClearanceLimit(armctl.load(path), 0.1)
    for step in (0.15, 0.17):
        cut = limit.violations(np.array([0.1]), np.array([step]))
        assert cut.h / cut.G[:, 0] == pytest.approx([0.26 - 0.05 - 0.1], abs=1e-6)
    assert limit.violations(np.array([0.1]), np.array([0.1])).inactive


@pytest.mark.parametrize(("rows", "blocked"), [(6, []), (3, [2])])
def test_a_null_step_moves_joints_inside_their_bounds_and_not_the_tip(rows: int, blocked: list[int]):
    arm = arm_of("redundant")
    high = np.full(arm.n, 0.2)
    high[blocked] = 0.0
    for q in arm.limits.random(arm.home, 5, np.random.default_rng(0)):
        J = arm.jacobian(q)[:rows]
        step = null_step(J, arm.home - q, -high, high)
        assert np.abs(step).max() > 1e-3
        assert (np.abs(step) <= high + 1e-12).all()
        assert np.abs(J @ step).max() < 1e-6


@pytest.mark.parametrize("solver", ["daqp", "osqp"])
def test_rows_that_are_added_to_a_program_are_kept_beside_its_own(solver: str):
    """The least distance from a point to a polyhedron, by SciPy."""
    rng = np.random.default_rng(6)
    bounds = np.full(4, 2.0)
    for _ in range(5):
        G = rng.normal(size=(3, 4))
        h = rng.uniform(0.1, 0.5, 3)
        goal = rng.normal(size=4)
        program = qpsolvers.Problem(np.eye(4), -goal, lb=-bounds, ub=bounds)
        for k in (0, 1, 2):
            add_inequalities(program, G[[k]], h[[k]])
        nearest = scipy.optimize.minimize(
            lambda x, goal=goal: 0.5 * np.sum((x - goal) ** 2),
            np.zeros(4),
            jac=lambda x, goal=goal: x - goal,
            bounds=[(-2.0, 2.0)] * 4,
            constraints=[scipy.optimize.LinearConstraint(G, -np.inf, h)],
            options={"ftol": 1e-14},
        )
        assert solved(program, solver) == pytest.approx(nearest.x, abs=1e-5)
        assert allows_zero(program)
        add_inequalities(program, G[[0]], np.array([-0.1]))
        assert not allows_zero(program)
