"""Worlds that are seen: clouds of points instead of bodies, their cost, bodies that are carried, and many bodies.

    python benchmarks/world.py [--problems FILE.json] [--every K] [--only PART ...] [--out FILE]

A problem file is that of benchmarks/planning.py. Each body is replaced by points on its surface, on a grid; their radius leaves
no hole. Motions are judged by MuJoCo with the bodies themselves, at 10 kHz, and carried bodies by points along them.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import resource
import time
import warnings
from functools import partial
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from markdown_table import titled_table
from planning import stopping_at, touching
from planning_peers import ompl_planner, roboplan_planner

import armctl
from armctl.model.collision.checkers import collision_checker

JUDGE_STEP_S = 1e-4
SPACINGS_M = (0.005, 0.010, 0.025)
GRASPS = {"cage": "Cube1", "table_pick": "Can1", "table_under_pick": "Can1"}  # the goal is a grasp: fingers may touch this
MANY_POINTS = 10_000
CHUNK_S = 1.0
CHUNKS = 300
SWAPPED_POINTS = 100_000
CHANGES = 10_000
STICK_MOVES = 200
PLANS = 100
PEER_PLANS = 40
STICK = armctl.Cylinder(0.01, 0.3)
T_TIP_STICK = armctl.Pose([0.0, 0.0, 0.16])


def main() -> None:
    parts = {"problems": on_problems, "planning": on_planning, "chunks": on_chunks, "changes": on_changes}
    parts |= {"peers": beside_peers, "many": on_many_bodies, "stick": on_stick}
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--problems", type=Path, help="a file of problems for the Panda")
    parser.add_argument("--every", type=int, default=1, help="take every K-th problem")
    parser.add_argument("--only", nargs="+", choices=parts, default=list(parts))
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "world.md")
    args = parser.parse_args()
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    tables = [parts[name](args) for name in args.only if name != "problems" or args.problems]
    tables.append(f"CPU times of one thread; load average while they were measured: {os.getloadavg()[1]:.1f}.")
    text = "\n\n".join(tables) + "\n"
    args.out.parent.mkdir(exist_ok=True)
    args.out.write_text(text, encoding="utf-8")
    print(text)


class Problem(NamedTuple):
    scene: str
    bodies: armctl.World  # the bodies themselves
    allow: tuple[tuple[str, str], ...]
    start: np.ndarray
    goal: np.ndarray


class Outcome(NamedTuple):
    planning_s: float
    points: int
    touches: bool
    is_solved: bool
    distance: float  # m, of the bodies at start and goal, where it was refused


def on_problems(args: argparse.Namespace) -> str:
    """Every problem with its bodies, and with points instead of them."""
    arm = without_floor(armctl.load("panda"))
    read = [problem for problem in problems_of(args.problems, args.every) if arm.limits.contains(problem.goal)]
    rows = []
    solved_with_bodies = None
    for spacing in (None, *SPACINGS_M):
        outcomes = [solve(arm, problem, spacing) for problem in read]
        solved = [one for one in outcomes if one.is_solved]
        refused = [one for one in outcomes if not one.is_solved]
        solved_with_bodies = solved_with_bodies or outcomes
        both = [(a, b) for a, b in zip(outcomes, solved_with_bodies, strict=True) if a.is_solved and b.is_solved]
        near = sum(one.distance <= 2.0 * (spacing or 0.0) for one in refused)
        times = 1e3 * np.array([one.planning_s for one in solved])
        rows.append(
            [
                "bodies" if spacing is None else f"points, {1e3 * spacing:g} mm",
                f"{np.median([one.points for one in outcomes]):.0f}",
                f"{len(solved)} of {len(read)}",
                sum(one.touches for one in solved),
                f"{near} of {len(refused)}",
                f"{np.percentile(times, 50):.1f} / {np.percentile(times, 95):.1f}",
                f"{sum(a.planning_s for a, _ in both) / sum(b.planning_s for _, b in both):.2f}",
            ]
        )
    header = [
        "world",
        "points, median",
        "solved",
        "touching at 10 kHz",
        "refused within two spacings of a contact",
        "motion, ms",
        "time, relative to bodies",
    ]
    legend = "Times: median / 95 % of the second call. The relative time is that of all problems which both solve, together."
    return f"{titled_table('MotionBenchMaker, Panda', header, rows)}\n\n{legend}"


def solve(arm: armctl.Arm, problem: Problem, spacing: float | None) -> Outcome:
    """A problem with its bodies, or with points at a spacing instead of them."""
    world = problem.bodies if spacing is None else seen(problem.bodies, spacing)
    points = sum(len(world[name].shape) for name in world if isinstance(world[name].shape, armctl.Points))
    motions: list[armctl.JointTrajectory] = []

    def plan() -> None:
        motions.append(armctl.move_free(arm, problem.start, problem.goal, allow=problem.allow, world=world))

    try:
        plan()
        seconds = cpu_time(plan)
    except armctl.PlanError:
        distance = min(distance_of_bodies(problem, q) for q in (problem.start, problem.goal))
        return Outcome(planning_s=math.nan, points=points, touches=False, is_solved=False, distance=distance)
    return Outcome(planning_s=seconds, points=points, touches=touches(problem, motions[-1]), is_solved=True, distance=math.nan)


def seen(bodies: armctl.World, spacing: float) -> armctl.World:
    """Points on the surfaces of bodies instead of them: each place of a surface is in the ball of a point."""
    world = armctl.World()
    for name in bodies:
        body = bodies[name]
        points = surface(body.shape, spacing) @ body.pose.rotation.T + body.pose.position
        world.add(name, armctl.Points(points, spacing / math.sqrt(2.0)))
    return world


def surface(shape: armctl.Box | armctl.Ball | armctl.Cylinder, spacing: float) -> np.ndarray:
    """(N, 3) m, points on the surface of a shape, at most a spacing apart along two directions."""
    if isinstance(shape, armctl.Box):
        faces = []
        for axis in range(3):
            u, v = (each for each in range(3) if each != axis)
            grid = np.stack(np.meshgrid(steps(shape.size[u], spacing), steps(shape.size[v], spacing)), axis=-1).reshape(-1, 2)
            for side in (-0.5, 0.5):
                face = np.empty((len(grid), 3))
                face[:, axis] = side * shape.size[axis]
                face[:, [u, v]] = grid
                faces.append(face)
        return np.unique(np.round(np.concatenate(faces), 9), axis=0)
    if isinstance(shape, armctl.Cylinder):
        rings = [(shape.radius, z) for z in steps(shape.length, spacing)]
        rings += [(r, z) for r in np.abs(steps(2.0 * shape.radius, spacing)) for z in (-0.5 * shape.length, 0.5 * shape.length)]
    else:
        angles = np.linspace(0.0, np.pi, 2 + int(np.pi * shape.radius / spacing))
        rings = [(shape.radius * math.sin(angle), shape.radius * math.cos(angle)) for angle in angles]
    points = []
    for radius, z in rings:
        turn = np.linspace(0.0, 2.0 * np.pi, 1 + math.ceil(2.0 * np.pi * radius / spacing), endpoint=False)
        points.append(np.column_stack([radius * np.cos(turn), radius * np.sin(turn), np.full(len(turn), z)]))
    return np.concatenate(points)


def steps(length: float, spacing: float) -> np.ndarray:
    """Places along a length, around its middle, at most a spacing apart."""
    return np.linspace(-0.5 * length, 0.5 * length, 1 + math.ceil(length / spacing))


def touches(problem: Problem, motion: armctl.JointTrajectory) -> bool:
    """Whether the arm touches the bodies themselves, by MuJoCo at 10 kHz."""
    arm = without_floor(armctl.load("panda", scene=problem.bodies))
    names = set(problem.bodies)
    allowed = {frozenset(pair) for pair in problem.allow}
    data = mujoco.MjData(arm.model)
    owners = [arm.model.body(int(body)).name for body in arm.model.geom_bodyid]
    for q in motion.sample(np.arange(0.0, motion.duration, JUDGE_STEP_S)).q:
        data.qpos[:] = arm.qpos(q)
        mujoco.mj_kinematics(arm.model, data)
        mujoco.mj_collision(arm.model, data)
        for contact in data.contact:
            pair = frozenset(owners[geom] for geom in contact.geom.tolist())
            if contact.dist < 0.0 and pair & names and pair not in allowed:
                return True
    return False


def distance_of_bodies(problem: Problem, q: np.ndarray) -> float:
    """m, how near the arm is to the bodies at q, by MuJoCo; zero where they touch."""
    arm = without_floor(armctl.load("panda", scene=problem.bodies))
    model = arm.model
    data = mujoco.MjData(model)
    data.qpos[:] = arm.qpos(q)
    mujoco.mj_kinematics(model, data)
    collides = (model.geom_contype | model.geom_conaffinity) != 0
    moving = np.flatnonzero(collides & (model.body_weldid[model.geom_bodyid] != 0))
    bodies = [model.geom(name).id for name in problem.bodies]
    return max(0.0, min(mujoco.mj_geomDistance(model, data, int(a), int(b), 1.0, None) for a in moving for b in bodies))


def problems_of(file: Path, every: int) -> list[Problem]:
    """The problems of a file."""
    found = []
    for row in json.loads(file.read_text(encoding="utf-8"))[::every]:
        bodies = armctl.World()
        for thing in row["objects"]:
            pose = armctl.Pose.from_rotation(np.array(thing["position"]), np.array(thing["rotation"]))
            size = thing["dimensions"]
            if thing["type"] == "box":
                bodies.add(thing["name"], armctl.Box(size), pose)
            elif thing["type"] == "cylinder":
                bodies.add(thing["name"], armctl.Cylinder(size[1], size[0]), pose)
            else:
                bodies.add(thing["name"], armctl.Ball(size[0]), pose)
        grasped = GRASPS.get(row["scene"])
        allow = tuple((finger, grasped) for finger in ("left_finger", "right_finger")) if grasped else ()
        found.append(Problem(row["scene"], bodies, allow, np.array(row["start"]), np.array(row["goal"])))
    return found


def without_floor(arm: armctl.Arm) -> armctl.Arm:
    """The arm, whose model has no plane that counts: things may be below it."""
    planes = arm.model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)
    arm.model.geom_contype[planes] = 0
    arm.model.geom_conaffinity[planes] = 0
    return arm


def furniture() -> armctl.World:
    """A shelf, a post and a ball beside the Panda."""
    return (
        armctl.World()
        .add("board", armctl.Box([0.5, 0.03, 0.6]), [0.5, 0.45, 0.4])
        .add("top", armctl.Box([0.5, 0.6, 0.03]), [0.55, 0.0, 0.9])
        .add("post", armctl.Cylinder(0.04, 0.8), [0.5, -0.35, 0.4])
        .add("ball", armctl.Ball(0.12), [-0.4, 0.4, 0.5])
    )


def cloud_of(count: int) -> armctl.World:
    """The furniture as about a number of points, under one name."""
    low, high = 0.001, 0.2
    for _ in range(30):
        middle = math.sqrt(low * high)
        bodies = seen(furniture(), middle)
        total = sum(len(bodies[name].shape) for name in bodies)
        low, high = (middle, high) if total > count else (low, middle)
    points = np.concatenate([bodies[name].shape.points for name in bodies])
    return armctl.World().add("cloud", armctl.Points(points, high / math.sqrt(2.0)))


def on_chunks(args: argparse.Namespace) -> str:
    """Proofs of motions of a second."""
    arm = armctl.load("panda")
    rows = []
    for name, world in (("bodies", furniture()), ("points", cloud_of(MANY_POINTS))):
        rng = np.random.default_rng(2)
        times = []
        free = 0
        while len(times) < CHUNKS:
            first = arm.limits.random(arm.home, 1, rng)[0]
            second = arm.limits.clamp(first + rng.uniform(-0.5, 0.5, arm.n))
            try:
                chunk = armctl.move_j(arm, first, second, duration=CHUNK_S)
            except armctl.PlanError:
                continue
            checks: list[armctl.ClearanceCheck] = []
            times.append(
                1e3 * cpu_time(lambda chunk=chunk, c=checks, w=world: c.append(armctl.check_clearance(arm, chunk, world=w)))
            )
            free += checks[0].ok
        size = sum(len(world[body].shape) if isinstance(world[body].shape, armctl.Points) else 1 for body in world)
        rows.append([name, size, f"{free} of {CHUNKS}", *(f"{np.percentile(times, p):.2f}" for p in (50, 95, 99))])
    header = ["world", "size", "free", "median, ms", "95 %, ms", "99 %, ms"]
    return titled_table("Proof of a motion of 1 s with its closest approach, Panda", header, rows)


def on_planning(args: argparse.Namespace) -> str:
    """Motions around bodies, and around as many points as a camera gives of them."""
    arm = armctl.load("panda")
    worlds = {"bodies": furniture(), "points": cloud_of(MANY_POINTS)}
    solved: dict[tuple[str, int], float] = {}
    for k, (first, second) in enumerate(free_pairs(arm, worlds["points"], PLANS)):
        for name, world in worlds.items():
            plan = partial(armctl.move_free, arm, first, second, world=world)
            with contextlib.suppress(armctl.PlanError):
                plan()
                solved[name, k] = 1e3 * cpu_time(plan)
    both = [k for k in range(PLANS) if all((name, k) in solved for name in worlds)]
    of_bodies = sum(solved["bodies", k] for k in both)
    rows = []
    for name in worlds:
        times = [time for (world, _), time in solved.items() if world == name]
        share = sum(solved[name, k] for k in both) / of_bodies
        rows.append([name, f"{len(times)} of {PLANS}", *(f"{np.percentile(times, p):.1f}" for p in (50, 95)), f"{share:.2f}"])
    header = ["world", "solved", "median, ms", "95 %, ms", "time, relative to bodies"]
    return titled_table(f"Motions around the same furniture as bodies and as {MANY_POINTS:,} points, Panda", header, rows)


def beside_peers(args: argparse.Namespace) -> str:
    """Paths among the same points by armctl, roboplan and OMPL, by turns, and how many of them armctl can prove free."""
    arm = without_floor(armctl.load("panda"))
    world = cloud_of(MANY_POINTS)
    cloud = world["cloud"].shape
    checker = collision_checker(arm, world=world)
    left_out = touching(arm, mujoco.MjData(arm.model), arm.home)
    planners = {
        "armctl": partial(armctl.move_free, arm, world=world),
        "roboplan": roboplan_planner(arm, left_out, (cloud.points, math.sqrt(2.0) * cloud.radius)),
        "OMPL": ompl_planner(arm, lambda q: checker.hit(q) < 0),
    }
    pairs = free_pairs(arm, world, PEER_PLANS)
    rows = []
    for name, plan in planners.items():
        if plan is None:
            rows.append([name, "not installed", *[""] * 3])
            continue
        plan(*pairs[0])  # loads what is needed, once
        times = []
        free = 0
        for start, goal in pairs:
            found: list[armctl.JointTrajectory | np.ndarray | None] = []
            with contextlib.suppress(armctl.PlanError):
                seconds = cpu_time(lambda plan=plan, ends=(start, goal), found=found: found.append(plan(*ends)))
            if not found or found[0] is None:
                continue
            times.append(1e3 * seconds)
            motion = stopping_at(arm, found[0]) if isinstance(found[0], np.ndarray) else found[0]
            free += armctl.check_clearance(arm, motion, world=world).ok
        rows.append([name, f"{len(times)} of {len(pairs)}", free, *(f"{np.percentile(times, p):.1f}" for p in (50, 95))])
    header = ["planner", "solved", "proved free", "median, ms", "95 %, ms"]
    legend = (
        "armctl's times are those of a motion, timed and proved; the others' those of a path. roboplan has the points as cubes "
        "of an octree, whose edge is the spacing, and checks every 0.05 rad; OMPL checks every 0.5 % with armctl's distances, "
        "called through Python, so its times are not its best."
    )
    return f"{titled_table(f'Paths among {len(cloud):,} points beside peers, Panda', header, rows)}\n\n{legend}"


def on_changes(args: argparse.Namespace) -> str:
    """Large clouds that replace each other, and memory."""
    arm = armctl.load("panda")
    motion = armctl.move_j(arm, arm.home, arm.home + 0.05)
    rng = np.random.default_rng(0)
    clouds = [rng.uniform([-1.0, -1.0, 1.2], [1.0, 1.0, 2.2], (SWAPPED_POINTS, 3)) for _ in range(20)]
    world = armctl.World()
    armctl.check_clearance(arm, motion)

    def swap(points: np.ndarray) -> None:
        world.add("cloud", armctl.Points(points, 0.005))
        armctl.check_clearance(arm, motion, world=world)

    swaps = [1e3 * cpu_time(lambda points=points: swap(points)) for points in clouds]
    world.remove("cloud")
    memory = []
    changes = [points[:1000] for points in clouds]
    for i in range(CHANGES):
        world.add("cloud", armctl.Points(changes[i % len(changes)], 0.005))
        armctl.check_clearance(arm, motion, world=world)
        if i in (CHANGES // 10, CHANGES - 1):
            memory.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0)
    rows = [
        [
            f"{SWAPPED_POINTS:,} points replaced, and a motion proved among them, ms",
            f"{np.median(swaps):.1f}",
            f"{max(swaps):.1f}",
        ],
        [f"memory after {CHANGES // 10:,} and {CHANGES:,} changes, MB", f"{memory[0]:.0f}", f"{memory[1]:.0f}"],
    ]
    return titled_table("Changes of a world, Panda", ["", "median, or first", "most, or last"], rows)


def on_many_bodies(args: argparse.Namespace) -> str:
    """Thousands of bodies, in the scene and in a world."""
    rows = []
    for kind, shape in (("boxes", armctl.Box([0.05, 0.05, 0.05])), ("balls", armctl.Ball(0.03))):
        for count in (0, 1000, 10_000):
            rng = np.random.default_rng(0)
            world = furniture()
            for i in range(count):
                place = rng.uniform([1.2, -3.0, 0.0], [4.0, 3.0, 2.0])
                world.add(f"body{i}", shape, place)
            arms: list[armctl.Arm] = []
            load_s = cpu_time(lambda world=world, arms=arms: arms.append(armctl.load("panda", scene=world)))
            alone = armctl.load("panda")
            goal = [0.5, 0.3, 0.4]
            times = []
            for arm, given in ((arms[0], None), (alone, world)):
                plan = partial(armctl.move_free, arm, arm.home, goal, world=given)
                times += [cpu_time(plan), cpu_time(plan)]
            rows.append([f"{count:,} {kind}", f"{load_s:.2f}", *(f"{1e3 * t:.0f}" for t in times)])
    header = [
        "bodies out of reach",
        "load, s",
        "scene: first motion, ms",
        "motion, ms",
        "world: first motion, ms",
        "motion, ms",
    ]
    return titled_table("Many bodies around a Panda", header, rows)


def on_stick(args: argparse.Namespace) -> str:
    """Moves with a stick of 30 cm at the tip."""
    arm = armctl.load("panda")
    rows = []
    starts = free_pairs(arm, furniture().add("stick", STICK).attach("stick", T_TIP_STICK), STICK_MOVES)
    for attached in (True, False):
        world = furniture()
        if attached:
            world.add("stick", STICK).attach("stick", T_TIP_STICK)
        moved = refused = touching = 0
        for first, second in starts:
            try:
                motion = armctl.move_free(arm, first, second, world=world)
            except armctl.PlanError:
                refused += 1
                continue
            moved += 1
            touching += any(stick_touches(arm, q) for q in motion.sample(np.arange(0.0, motion.duration, 1e-3)).q)
        rows.append(["attached" if attached else "not attached", moved, refused, touching])
    header = ["stick", "moves", "refused", "the stick touches something, at 1 kHz"]
    return titled_table("A stick of 30 cm carried around furniture, Panda", header, rows)


def free_pairs(arm: armctl.Arm, world: armctl.World, count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Pairs of random configurations at which the arm, and what it carries, is free."""
    rng = np.random.default_rng(5)
    free: list[np.ndarray] = []
    while len(free) < 2 * count:
        q = arm.limits.random(arm.home, 1, rng)[0]
        standing = armctl.move_j(arm, q, q)
        if armctl.check_clearance(arm, standing, 0.01, world=world).ok:
            free.append(q)
    return list(zip(free[::2], free[1::2], strict=True))


def stick_touches(arm: armctl.Arm, q: np.ndarray) -> bool:
    """Whether points along the stick's axis are nearer to the furniture than its radius; not by armctl's distances."""
    T_world_stick = arm.fk(q) @ T_TIP_STICK
    along = np.linspace(-0.5, 0.5, 121) * (STICK.length - 2.0 * STICK.radius)
    points = T_world_stick.position + along[:, None] * T_world_stick.rotation[:, 2]
    world = furniture()
    for name in world:
        body = world[name]
        inside = (points - body.pose.position) @ body.pose.rotation
        if isinstance(body.shape, armctl.Box):
            distances = np.linalg.norm(np.maximum(np.abs(inside) - 0.5 * body.shape.size, 0.0), axis=1)
        elif isinstance(body.shape, armctl.Ball):
            distances = np.linalg.norm(inside, axis=1) - body.shape.radius
        else:
            across = np.maximum(np.linalg.norm(inside[:, :2], axis=1) - body.shape.radius, 0.0)
            distances = np.hypot(across, np.maximum(np.abs(inside[:, 2]) - 0.5 * body.shape.length, 0.0))
        if distances.min() < STICK.radius:
            return True
    return False


def cpu_time(action) -> float:
    started = time.process_time()
    action()
    return time.process_time() - started


if __name__ == "__main__":
    main()
