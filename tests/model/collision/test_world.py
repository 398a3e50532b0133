"""A world that changes: clouds and bodies around an arm, at the arm's tip, and what may touch."""

import gc
import pickle
import weakref
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from collidable import arm_among, mjcf

import armctl
from armctl import Ball, Box, Cylinder, InputError, Mesh, Points, Pose, UnknownNameError, World
from armctl.core.validation import Array
from armctl.model.collision.checkers import collision_checker

pytestmark = pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")

ROCK = np.random.default_rng(8).uniform(-0.12, 0.12, (40, 3))
SHAPES = {
    "box": Box([0.2, 0.15, 0.3]),
    "ball": Ball(0.12),
    "cylinder": Cylinder(0.1, 0.3),
    "mesh": Mesh(ROCK),
}
AT = {
    "box": Pose([0.35, 0.2, 0.4], rpy=[0.3, 0.2, 0.1]),
    "ball": Pose([-0.3, 0.3, 0.5]),
    "cylinder": Pose([0.1, -0.45, 0.4], rpy=[0.5, 0.0, 0.3]),
    "mesh": Pose([-0.3, -0.3, 0.3], rpy=[0.0, 1.0, 0.0]),
}


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> armctl.Arm:
    return arm_among(tmp_path_factory.mktemp("alone"), "")


@pytest.fixture(scope="module")
def configurations(arm) -> Array:
    return arm.limits.random(arm.home, 200, np.random.default_rng(4))


def cloud_around(rng: np.random.Generator, count: int) -> Array:
    """Points on balls, and some in the space around the arm."""
    directions = rng.normal(size=(count, 3))
    directions *= 0.15 / np.linalg.norm(directions, axis=1, keepdims=True)
    centers = np.array([[0.4, 0.2, 0.4], [-0.4, 0.2, 0.5], [0.0, -0.5, 0.3]])
    return centers[rng.integers(3, size=count)] + directions


def least_distance(arm: armctl.Arm, points: Array, radius: float, q: Array) -> float:
    """The least distance of the arm's links, which are capsules, from points: from the axis, less the radii."""
    data = mujoco.MjData(arm.model)
    data.qpos[:] = arm.qpos(q)
    mujoco.mj_kinematics(arm.model, data)
    least = np.inf
    for geom in range(arm.model.ngeom):
        if arm.model.body_weldid[arm.model.geom_bodyid[geom]] == 0:
            continue
        center = data.geom_xpos[geom]
        axis = data.geom_xmat[geom].reshape(3, 3)[:, 2]
        half = arm.model.geom_size[geom, 1]
        along = np.clip((points - center) @ axis, -half, half)
        between = points - center - along[:, None] * axis
        least = min(least, float(np.linalg.norm(between, axis=1).min() - arm.model.geom_size[geom, 0] - radius))
    return least


def distance_of(arm: armctl.Arm, world: World, q: Array) -> float:
    return collision_checker(arm, world=world).nearest(q)[1]


@pytest.mark.parametrize("count", [1, 7, 3000])
def test_the_distance_of_a_cloud_is_that_of_its_nearest_point(arm, configurations, count):
    rng = np.random.default_rng(count)
    points = cloud_around(rng, count)
    world = World().add("cloud", Points(points, 0.01))
    checker = collision_checker(arm, world=world)
    alone = collision_checker(arm)
    free = 0
    for q in configurations:
        expected = least_distance(arm, points, 0.01, q)
        pair, distance = checker.nearest(q)
        own = alone.nearest(q)[1]
        if min(expected, own) > 1e-4:
            free += 1
            assert distance == pytest.approx(min(expected, own), abs=1e-6)
            assert (checker.names(pair)[0] == "cloud") == (expected < own)
        else:
            assert distance <= 1e-4
        for clearance in (0.0, 0.03):
            assert (checker.hit(q, clearance) >= 0) == (min(expected, own) <= clearance)
    assert free > 50


def test_a_cloud_that_is_moved_is_the_cloud_of_moved_points(arm, configurations):
    points = cloud_around(np.random.default_rng(2), 500)
    pose = Pose([0.1, -0.2, 0.1], rpy=[0.3, -0.5, 1.0])
    moved = World().add("cloud", Points(points, 0.01)).move("cloud", pose)
    there = World().add("cloud", Points(points @ pose.rotation.T + pose.position, 0.01))
    for q in configurations[:60]:
        assert distance_of(arm, moved, q) == pytest.approx(distance_of(arm, there, q), abs=1e-7)


def test_the_gradient_of_a_cloud_is_that_of_the_distance(arm, configurations):
    checker = collision_checker(arm, world=World().add("cloud", Points(cloud_around(np.random.default_rng(5), 800), 0.01)))
    everything = np.full(len(checker.geometry.pairs), np.inf)
    still = np.zeros(arm.n)
    compared = 0
    for q in configurations[:40]:
        direction = np.random.default_rng(compared).normal(size=arm.n)
        ahead, behind = (checker.near(q + s * 1e-6 * direction, still, 1.0, everything).distances for s in (1.0, -1.0))
        near = checker.near(q, still, 1.0, everything)
        for row, pair in enumerate(near.pairs.tolist()):
            if checker.names(pair)[0] == "cloud" and near.distances[row] > 0.005:
                slope = (ahead[row] - behind[row]) / 2e-6
                assert slope == pytest.approx(near.gradients[row] @ direction, abs=2e-3)
                compared += 1
    assert compared > 100


def test_a_proof_among_points_finds_what_a_dense_path_finds(arm, configurations):
    points = cloud_around(np.random.default_rng(6), 2000)
    world = World().add("cloud", Points(points, 0.004))
    checker = collision_checker(arm, world=world)
    verdicts = []
    for q in configurations[:80]:
        motion = armctl.move_j(arm, arm.home, q)
        check = armctl.check_clearance(arm, motion, 0.0, world=world)
        dense = min(checker.nearest(each)[1] for each in motion.sample(np.linspace(0.0, motion.duration, 300)).q)
        verdicts.append(check.ok)
        if check.ok:
            assert dense >= check.distance - 1e-6
        else:
            assert dense < 1e-3
    assert 5 < sum(verdicts) < 75


@pytest.mark.parametrize("name", SHAPES)
def test_a_body_of_a_world_is_as_far_away_as_the_same_geom_of_a_model(tmp_path, arm, configurations, name):
    pose = AT[name]
    where = f'pos="{" ".join(map(repr, pose.position.tolist()))}" quat="{" ".join(map(repr, pose.quat.tolist()))}"'
    geom = {
        "box": f'<geom name="box" type="box" size="0.1 0.075 0.15" {where}/>',
        "ball": f'<geom name="ball" type="sphere" size="0.12" {where}/>',
        "cylinder": f'<geom name="cylinder" type="cylinder" size="0.1 0.15" {where}/>',
        "mesh": f'<body {where}><geom name="mesh" type="mesh" mesh="stone"/></body>',
    }[name]
    # MuJoCo centres a mesh, and turns it into its principal axes, unless it is told where it was.
    stone = f'<mesh name="stone" vertex="{" ".join(map(str, ROCK.ravel()))}"/>'
    among = collision_checker(arm_among(tmp_path, geom, stone if name == "mesh" else ""))
    checker = collision_checker(arm, world=World().add(name, SHAPES[name], pose))
    for q in configurations[:80]:
        assert checker.nearest(q)[1] == pytest.approx(among.nearest(q)[1], abs=1e-5)
        assert bool(checker.at(q)) == bool(among.at(q))


def test_many_bodies_give_the_same_distances_as_few_of_them_at_a_time(arm, configurations):
    rng = np.random.default_rng(7)
    world = World()
    parts = [World() for _ in range(10)]
    for i in range(300):
        shape = (Ball(0.03), Box([0.05, 0.04, 0.06]), Cylinder(0.02, 0.08))[i % 3]
        at = Pose(rng.uniform(-0.8, 0.8, 3), rpy=rng.uniform(-1.0, 1.0, 3))
        world.add(f"body{i}", shape, at)
        parts[i % 10].add(f"body{i}", shape, at)
    checker = collision_checker(arm, world=world)
    few = [collision_checker(arm, world=part) for part in parts]
    for q in configurations[:60]:
        least = min(part.nearest(q)[1] for part in few)
        distance = checker.nearest(q)[1]
        assert distance == pytest.approx(least, abs=1e-6) if least > 0.0 else distance <= 0.0
        assert (checker.hit(q, 0.02) >= 0) == any(part.hit(q, 0.02) >= 0 for part in few)
        goal = arm.limits.clamp(q + 0.3)
        assert (checker.line_hit(q, goal, 0.01) is None) == all(part.line_hit(q, goal, 0.01) is None for part in few)
        clearances = np.full(len(checker.geometry.pairs), 0.02)
        found = checker.near(q, np.full(arm.n, 0.05), 0.5, clearances)
        counts = [len(p.near(q, np.full(arm.n, 0.05), 0.5, np.full(len(p.geometry.pairs), 0.02)).pairs) for p in few]
        own = len(
            collision_checker(arm)
            .near(q, np.full(arm.n, 0.05), 0.5, np.full(len(collision_checker(arm).geometry.pairs), 0.02))
            .pairs
        )
        assert len(found.pairs) == sum(counts) - 9 * own


def test_an_attached_body_moves_with_the_tip_and_meets_the_robot_and_the_world(arm, configurations):
    stick = Cylinder(0.01, 0.3)
    T_tip_stick = Pose([0.0, 0.0, 0.16])
    world = World().add("wall", Box([0.02, 1.0, 1.0]), [0.7, 0.0, 0.5]).add("stick", stick).attach("stick", T_tip_stick)
    cloud = World().add("cloud", Points([[0.7, 0.0, 0.5]], 0.05)).add("stick", stick).attach("stick", T_tip_stick)
    checker = collision_checker(arm, world=world)
    with_cloud = collision_checker(arm, world=cloud)
    names = set()
    for q in configurations:
        there = World().add("stick", stick, arm.fk(q) @ T_tip_stick)
        standing = collision_checker(arm, world=there)
        of_wall = collision_checker(arm, world=World().add("wall", Box([0.02, 1.0, 1.0]), [0.7, 0.0, 0.5]))
        expected = min(standing_distance(standing, q, moved_with="link5"), of_wall.nearest(q)[1])
        touching = checker.at(q)
        names.update(touching.split(" touches "))
        if expected <= 0.0:
            assert touching
        assert with_cloud.nearest(q)[1] <= distance_to_point(arm.fk(q) @ T_tip_stick, np.array([0.7, 0.0, 0.5])) - 0.05 + 1e-6
    assert {"stick", "wall"} <= names


def standing_distance(checker, q: Array, moved_with: str) -> float:
    """The least distance of a checker, without the pairs of the link that carries the body."""
    clearances = np.full(len(checker.geometry.pairs), np.inf)
    near = checker.near(q, np.zeros(len(q)), 1.0, clearances)
    kept = [d for pair, d in zip(near.pairs, near.distances, strict=True) if moved_with not in checker.names(int(pair))]
    return min(kept, default=np.inf)


def distance_to_point(T_world_stick: Pose, point: Array) -> float:
    """From the axis of a stick of 0.3 m."""
    axis = T_world_stick.rotation[:, 2]
    along = np.clip((point - T_world_stick.position) @ axis, -0.15, 0.15)
    return float(np.linalg.norm(point - T_world_stick.position - along * axis))


def test_pairs_that_are_allowed_may_touch(arm):
    tip = arm.fk(arm.home).position
    world = World().add("lamp", Ball(0.05), tip)
    assert "lamp" in collision_checker(arm, world=world).at(arm.home)
    for link in ("link3", "link4", "link5"):
        world.allow(link, "lamp")
    assert collision_checker(arm, world=world).at(arm.home) == ""
    world.remove("lamp").add("lamp", Ball(0.05), tip)
    assert "lamp" in collision_checker(arm, world=world).at(arm.home)
    pairs = [("lamp", link) for link in ("link3", "link4", "link5")]
    assert collision_checker(arm, allow=pairs, world=world).at(arm.home) == ""
    with pytest.raises(UnknownNameError, match="body in allow"):
        collision_checker(arm, world=world.allow("lamp", "link33"))


def test_a_snapshot_does_not_change_and_the_newest_one_wins():
    world = World()
    assert world.snapshot().is_empty()
    first = world.add("a", Ball(0.1), [1.0, 0.0, 0.0]).snapshot()
    assert world.snapshot() is first
    second = world.move("a", [2.0, 0.0, 0.0]).add("b", Box([1.0, 1.0, 1.0])).snapshot()
    assert first.bodies["a"].pose.position.tolist() == [1.0, 0.0, 0.0]
    assert second.bodies["a"].pose.position.tolist() == [2.0, 0.0, 0.0]
    assert second.version > first.version
    assert (list(first.bodies), world.names, "b" in world, len(world)) == (["a"], ("a", "b"), True, 2)
    with pytest.raises(TypeError):
        first.bodies["c"] = first.bodies["a"]  # type: ignore[index]


def test_the_mass_of_an_attached_body_is_a_payload(arm):
    world = World().add("brick", Box([0.1, 0.2, 0.05]), mass=2.0).attach("brick", Pose([0.0, 0.0, 0.1]))
    loaded = world.snapshot().loaded_arm(arm)
    expected = arm.with_payload(2.0, [0.0, 0.0, 0.1], 2.0 / 12.0 * np.array([0.0425, 0.0125, 0.05]))
    q = arm.limits.random(arm.home, 1, np.random.default_rng(0))[0]
    assert loaded.gravity(q) == pytest.approx(expected.gravity(q), abs=1e-12)
    assert loaded.mass_matrix(q) == pytest.approx(expected.mass_matrix(q), abs=1e-12)
    assert world.detach("brick", [0.0, 0.0, 0.0]).snapshot().loaded_arm(arm) is arm


WRONG = {
    "no name": (lambda w: w.add("", Ball(0.1)), "name: '' is empty"),
    "a number for a name": (lambda w: w.add(3, Ball(0.1)), "name: expected str, got 3"),
    "no shape": (lambda w: w.add("a", [0.1, 0.1, 0.1]), "shape: expected Box or Ball or .*, got .*; armctl.Box"),
    "a place of two numbers": (lambda w: w.add("a", Ball(0.1), [1.0, 2.0]), "at: expected 3 numbers, got 2"),
    "a mass of points": (lambda w: w.add("a", Points([[1.0, 0.0, 0.0]]), mass=1.0), "mass: points are no body"),
    "no mass": (lambda w: w.add("a", Ball(0.1), mass=0.0), "mass: expected a number at least 1e-06, got 0"),
    "attached nowhere": (lambda w: w.attach("ball"), "at: where ball is in the frame of the tip is not known"),
    "attached points": (lambda w: w.attach("cloud", Pose([0, 0, 0])), "name: cloud is a cloud of points, which stands"),
    "detached twice": (lambda w: w.detach("ball"), "name: ball is not attached to a tip"),
    "detached to nowhere": (
        lambda w: w.attach("ball", [0, 0, 0]).detach("ball"),
        "at: where ball is in the world is not known",
    ),
    "moved though attached": (
        lambda w: w.attach("ball", [0, 0, 0]).move("ball", [0, 0, 0]),
        "name: ball is attached to the tip ''",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_change_is_one_clear_sentence(name):
    change, message = WRONG[name]
    world = World().add("ball", Ball(0.1), [5.0, 0.0, 0.0]).add("cloud", Points([[5.0, 0.0, 0.0]]))
    with pytest.raises(InputError, match=message) as caught:
        change(world)
    assert len(str(caught.value)) <= 400


def test_a_body_that_the_world_does_not_have_is_named():
    world = World().add("table", Box([1.0, 1.0, 0.1]))
    for change in (world.remove, world.detach, lambda name: world.move(name, [0, 0, 0]), world.__getitem__):
        with pytest.raises(UnknownNameError, match=r"tabel.*table"):
            change("tabel")


def test_what_is_no_world_is_refused(arm):
    motion = armctl.move_j(arm, arm.home, arm.home + 0.1)
    with pytest.raises(InputError, match="world: expected a World or a snapshot of one, got 'table'"):
        armctl.check_clearance(arm, motion, world="table")  # type: ignore[arg-type]
    with pytest.raises(UnknownNameError, match="tip"):
        collision_checker(arm, world=World().add("a", Ball(0.1)).attach("a", [0, 0, 0.2], "left"))


def test_ten_thousand_changes_keep_no_memory(arm):
    world = World()
    checker = collision_checker(arm)
    for i in range(50):
        world.add("a", Ball(0.05), [1.0, 0.0, 0.01 * i])
        last = collision_checker(arm, world=world)
    known = weakref.ref(last.geometry)
    del last
    world.add("a", Ball(0.05))
    gc.collect()
    assert known() is None
    assert collision_checker(arm) is checker


def test_planning_and_inverse_kinematics_take_the_world(arm):
    goal = arm.limits.clamp(arm.home + np.array([1.2, 0.8, 0.6, 0.0, 0.4, 0.0]))
    direct = armctl.move_j(arm, arm.home, goal)
    halfway = direct(0.5 * direct.duration).q
    world = World().add("lamp", Ball(0.06), arm.fk(halfway).position)
    assert not armctl.check_clearance(arm, direct, world=world).ok
    around = armctl.move_free(arm, arm.home, goal, world=world)
    assert armctl.check_clearance(arm, around, world=world).ok
    assert armctl.move_free(arm, arm.home, goal, world=World()).coefficients.tobytes() == direct.coefficients.tobytes()
    target = arm.fk(halfway)
    assert armctl.solve_ik(arm, target.position, arm.home, avoid=True).ok
    blocked = armctl.solve_ik(arm, target.position, arm.home, avoid=True, world=world)
    assert not blocked.ok
    assert "lamp" in blocked.reason
    assert not armctl.solve_ik_all(arm, target.position, 3, avoid=True, world=world)[0].ok
    with pytest.raises(InputError, match="world: it is only looked at with avoid=True"):
        armctl.solve_ik(arm, target, world=world)
    with pytest.raises(armctl.PlanError, match="lamp"):
        armctl.move_free(arm, halfway, arm.home, world=world)


def test_a_stream_proves_each_motion_in_the_newest_world(arm):
    world = World()
    goal = arm.limits.clamp(arm.home + np.array([0.6, 0.4, 0.3, 0.0, 0.0, 0.0]))
    stream = armctl.Stream(arm, arm.home, avoid=True, world=world)
    stream.push(0.5, goal)
    stream.step(0.01)
    assert stream.report.obstacle == ""
    world.add("lamp", Ball(0.06), arm.fk(goal).position)
    stream.push(0.6, goal)
    points = [stream.step(0.01) for _ in range(300)]
    assert "lamp" in stream.report.obstacle
    assert all(collision_checker(arm, world=world).at(point.q) == "" for point in points)
    assert np.abs(points[-1].v).max() < 1e-6


def test_points_on_the_robot_are_removed_and_the_others_stay(arm, configurations):
    rng = np.random.default_rng(9)
    points = rng.uniform(-0.9, 0.9, (3000, 3))
    removed = 0
    for q in configurations[:10]:
        kept = armctl.robot_filter(arm, q, points, margin=0.03)
        distances = np.array([least_distance(arm, point[None], 0.0, q) for point in points[:500]])
        is_kept = np.isin(points[:500], kept).all(axis=1)
        assert (is_kept == (distances > 0.03))[np.abs(distances - 0.03) > 1e-6].all()
        removed += len(points) - len(kept)
    assert removed > 100
    with pytest.raises(InputError, match="points: all 2 are on the robot, within 20 mm; are they in the frame of the world"):
        armctl.robot_filter(arm, arm.home, np.tile(arm.fk(arm.home).position, (2, 1)))
    with pytest.raises(InputError, match="points: 1 of 1 are NaN"):
        armctl.robot_filter(arm, arm.home, [[np.nan, 0.0, 0.0]])


def test_a_world_is_a_scene_of_a_simulation(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(mjcf(""))
    world = World().add("cup", Cylinder(0.04, 0.1), [0.6, 0.0, 0.3], mass=0.2)
    for name, shape in SHAPES.items():
        world.add(name, shape, AT[name])
    loaded = armctl.load(path, scene=world)
    data = mujoco.MjData(loaded.model)
    mujoco.mj_forward(loaded.model, data)
    for name in SHAPES:
        assert loaded.model.body(name).jntnum[0] == 0
    assert loaded.model.body("cup").jntnum[0] == 1
    assert loaded.model.body("cup").mass[0] == pytest.approx(0.2)
    alone = armctl.load(path)
    world.remove("cup")
    q = alone.limits.random(alone.home, 40, np.random.default_rng(1))
    seen = [collision_checker(alone, world=world).nearest(each)[1] for each in q]
    world.add("cup", Cylinder(0.04, 0.1), [0.6, 0.0, 0.3])
    in_mujoco = [collision_checker(loaded).nearest(each)[1] for each in q]
    with_cup = [collision_checker(alone, world=world).nearest(each)[1] for each in q]
    assert in_mujoco == pytest.approx(with_cup, abs=1e-5)
    assert (np.array(with_cup) <= np.array(seen) + 1e-9).all()
    with pytest.raises(InputError, match="scene: cloud is a cloud of points, which has no physics"):
        armctl.load(path, scene=World().add("cloud", Points([[1.0, 0.0, 0.0]])))
    with pytest.raises(InputError, match="scene: cup is attached to a tip"):
        armctl.load(path, scene=world.attach("cup", [0.0, 0.0, 0.1]))


def test_names_of_other_libraries_are_answered_with_a_hint():
    with pytest.warns(DeprecationWarning, match=r"armctl.Scene goes with version 0.2; use armctl.World\(\)"):
        former = armctl.Scene()
    former.add_box("a", [1.0, 1.0, 1.0], [0.0, 0.0, 0.5]).add_ball("b", 0.1, [0, 0, 0]).add_cylinder(
        "c", 0.1, 1.0, [0, 0, 1], 2
    )
    assert isinstance(former, World)
    assert former["a"].shape.size.tolist() == [1.0, 1.0, 1.0]
    assert (former["b"].shape.radius, former["c"].shape.length, former["c"].mass) == (0.1, 1.0, 2.0)
    with pytest.raises(AttributeError, match=r"World has no attribute 'add_box'; use world.add.name, armctl.Box.size., at"):
        World().add_box("a", [1.0, 1.0, 1.0], [0.0, 0.0, 0.0])


def test_a_body_with_the_name_of_another_body_of_the_model_is_refused():
    arm = armctl.load("robot_arm_3dof")
    motion = armctl.move_j(arm, arm.home, arm.home + 0.2)
    with pytest.raises(InputError, match="base is the name of a part of the robot"):
        armctl.check_clearance(arm, motion, world=World().add("base", Box([0.2] * 3), [0.4, 0.0, 0.4]))
    world = World().add("post", Box([0.1] * 3), [0.9, 0.9, 0.4])
    among = armctl.load("robot_arm_3dof", scene=world)
    motion = armctl.move_j(among, among.home, among.home + 0.2)
    alone = armctl.check_clearance(among, motion)
    assert armctl.check_clearance(among, motion, world=world).distance == alone.distance  # the same post, once
    world.move("post", [0.4, 0.0, 0.4])
    with pytest.raises(InputError, match="the model has a body post already, and elsewhere"):
        armctl.check_clearance(among, motion, world=world)


def test_an_arm_in_a_world_is_copied_to_another_process_and_later_changes_do_not_reach_it():
    world = World().add("post", Box([0.1] * 3), [0.9, 0.9, 0.4])
    arm = armctl.load("robot_arm_3dof", scene=world)
    world.move("post", [0.0, 0.0, 2.0]).add("wall", Ball(0.1), [0.0, 0.0, 3.0])
    for copied in (pickle.loads(pickle.dumps(arm)), arm):
        model = copied.recipe.model(lambda spec: None)
        assert model.body("post").pos == pytest.approx([0.9, 0.9, 0.4])
        assert mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "wall") < 0


def test_a_mesh_that_is_attached_weighs_as_the_box_with_its_corners_does(arm):
    corners = np.array([[x, y, z] for x in (0.0, 0.1) for y in (0.0, 0.2) for z in (0.0, 0.3)])
    middle = np.array([0.05, 0.1, 0.15])
    q = arm.home + 0.1
    loaded = []
    for shape, at in (
        (Mesh(corners), Pose([0.1, 0.0, 0.05])),
        (Box([0.1, 0.2, 0.3]), Pose(middle + np.array([0.1, 0.0, 0.05]))),
    ):
        world = World().add("load", shape, mass=1.5)
        loaded.append(world.attach("load", at).snapshot().loaded_arm(arm))
    assert loaded[0].gravity(q) == pytest.approx(loaded[1].gravity(q), abs=1e-5)
    assert loaded[0].mass_matrix(q) == pytest.approx(loaded[1].mass_matrix(q), abs=1e-5)


def test_a_region_is_searched_among_the_bodies_of_a_world(arm):
    target = arm.fk(arm.limits.clamp(arm.home + 0.3))
    region = armctl.Region(target)
    world = World().add("ball", Ball(0.05), target.position)
    assert armctl.solve_ik(arm, region)
    found = armctl.solve_ik(arm, region, avoid=True, world=world)
    assert not found
    assert "ball" in found.reason
    with pytest.raises(InputError, match="avoid=True"):
        armctl.solve_ik(arm, region, world=world)
    with pytest.raises(InputError, match="center_of_mass_within"):
        armctl.solve_ik(arm, region, center_of_mass_within=[[0, 0], [1, 0], [0, 1]])


def test_lines_are_planned_with_what_is_attached():
    strong = armctl.load("robot_arm_3dof")
    arm = strong.with_limits(replace(strong.limits, tau_max=0.1 * strong.limits.tau_max))
    sim = armctl.Simulation(arm)
    end = sim.tip.position + np.array([-0.05, 0.1, -0.1])
    mass = 5.0
    expected = armctl.move_l(arm.with_payload(mass), arm.home, end).duration
    assert expected > 1.1 * armctl.move_l(arm, arm.home, end).duration
    sim.world.add("load", Ball(1e-4), [0.0, 0.0, 5.0], mass=mass).attach("load", [0.0, 0.0, 0.0])
    assert sim.move_l(end).log.motion_duration == pytest.approx(expected, rel=1e-6)
