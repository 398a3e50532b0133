"""Collision-free motion: paths, motions and their proofs, on given problems and on scenes of its own, beside roboplan and OMPL.

    python benchmarks/planning.py [--problems FILE.json] [--every K] [--only checks problems peers scenes moves] [--out FILE]

A problem file is a list of `{scene, index, start, goal, rest, objects}` for the Panda, as the MotionBenchMaker problems are
written: joints in rad, `objects` with name, type (box, cylinder, sphere), dimensions in full lengths, position and rotation.
Every motion is verified at 1 kHz with MuJoCo's own collision detection, and, where links are capsules, by brute force. Times
are CPU times of one thread.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import time
import warnings
from collections.abc import Iterator
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from planning_peers import ompl_planner, roboplan_planner

import armctl
from armctl.collision.checker import CollisionChecker
from armctl.collision.clearance import clearance_of
from armctl.core.tables import Table
from armctl.planning.move_free import move_free_with
from armctl.planning.path import find_path, sampling_bounds, shorten

CLEARANCE_M = 2e-3
VERIFY_STEP_S = 1e-3
CHECKS = 3000
PAIRS = 20
MOVES = 8  # of the pairs of each arm and scene
GRASPS = {"cage": "Cube1", "table_pick": "Can1", "table_under_pick": "Can1"}  # the goal is a grasp: fingers may touch this
CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
BOX = int(mujoco.mjtGeom.mjGEOM_BOX)
PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)


class Problem(NamedTuple):
    name: str
    arm: armctl.Arm
    checker: CollisionChecker
    start: np.ndarray
    goal: np.ndarray
    index: int = 0  # within its scene


class Solved(NamedTuple):
    name: str
    path_s: float
    total_s: float
    proof_s: float
    is_proved: bool
    touches: int
    duration: float
    stopping: float
    length: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--problems", type=Path, help="a file of problems for the Panda")
    parser.add_argument("--every", type=int, default=1, help="take every K-th problem")
    parts = ["checks", "problems", "peers", "scenes", "moves"]
    parser.add_argument("--only", nargs="+", choices=parts, default=parts)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "planning.md")
    args = parser.parse_args()
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    parts = []
    if "checks" in args.only:
        parts.append(checks())
    if "problems" in args.only and args.problems:
        parts.append(planned("MotionBenchMaker, Panda", list(problems(args.problems, args.every))))
    if "peers" in args.only and args.problems:
        parts.append(beside_peers(list(problems(args.problems, args.every))))
    if "scenes" in args.only:
        parts.append(planned("Own scenes", list(own_problems())))
    if "moves" in args.only:
        parts.append(moves())
    parts.append(f"CPU times of one thread; load average while they were measured: {os.getloadavg()[1]:.1f}.")
    text = "\n\n".join(parts) + "\n"
    args.out.parent.mkdir(exist_ok=True)
    args.out.write_text(text, encoding="utf-8")
    print(text)


def checks() -> str:
    """One check at random configurations, beside MuJoCo's collision detection, and how often they disagree."""
    rows = []
    for name in ("panda", "ur5e", "xarm7"):
        arm = arm_in(name, "table")
        if arm is None:
            continue
        checker = CollisionChecker(arm)
        points = arm.limits.random(arm.home, CHECKS, np.random.default_rng(0))
        checker.hit(points[0])
        ours = 1e6 * cpu_time(lambda checker=checker, points=points: [checker.hit(q) for q in points]) / CHECKS
        data = mujoco.MjData(arm.model)

        def theirs(arm=arm, points=points, data=data) -> None:
            for q in points:
                place(arm, data, q)

        mujocos = 1e6 * cpu_time(theirs) / CHECKS
        differ = [q for q in points if (checker.hit(q) >= 0) != bool(contacts(arm, checker, data, q))]
        missed = sum(checker.hit(q) >= 0 and capsules_in_boxes(arm, data, q) for q in differ)
        rows.append([name, len(checker.geometry.pairs), f"{ours:.1f}", f"{mujocos:.1f}", len(differ), missed])
    header = [
        "arm",
        "pairs",
        "one check, us",
        "mj_kinematics + mj_collision, us",
        "disagree",
        "of these, a capsule is in a box",
    ]
    return f"**One check at {CHECKS} random configurations among table, crate, can and monitor**\n\n" + as_markdown(
        header, rows
    )


def as_markdown(header: list[str], rows: list[list[object]]) -> str:
    return Table(tuple(header), tuple(tuple(map(str, row)) for row in rows)).markdown()


def planned(title: str, all_problems: list[Problem]) -> str:
    """Every problem solved, timed and verified."""
    solved: list[Solved] = []
    refused: list[str] = []
    for problem in all_problems:  # compiles what any of them needs
        with contextlib.suppress(armctl.ArmctlError):
            solve(problem)
    for problem in all_problems:
        try:
            solved.append(solve(problem))
        except armctl.ArmctlError as error:
            refused.append(f"{problem.name}: {error}")
    names = sorted({one.name for one in solved})
    rows = [summary(name, [one for one in solved if one.name == name]) for name in names] + [summary("all", solved)]
    header = [
        "scene",
        "solved",
        "proved",
        "touching at 1 kHz",
        "path, ms",
        "motion, ms",
        "proof, ms",
        "length, rad",
        "duration",
    ]
    notes = "\n".join(f"- not solved: {reason}" for reason in refused)
    legend = (
        "Times: median / 95 %. Motion: path, timing, torque limits and proof together, with a clearance of "
        f"{1e3 * CLEARANCE_M:g} mm. Proof: of the finished motion, with its closest approach. Duration: median share of the "
        "time that stopping at each point of the path takes."
    )
    return (
        f"**{title}: {len(solved)} of {len(all_problems)} solved**\n\n{as_markdown(header, rows)}\n\n{legend}\n{notes}".rstrip()
    )


def summary(name: str, solved: list[Solved]) -> list[object]:
    def times(values: list[float]) -> str:
        median, high = np.percentile(1e3 * np.array(values), [50, 95])
        return f"{median:.1f} / {high:.1f}"

    return [
        name,
        len(solved),
        sum(one.is_proved for one in solved),
        sum(one.touches > 0 for one in solved),
        times([one.path_s for one in solved]),
        times([one.total_s for one in solved]),
        times([one.proof_s for one in solved]),
        f"{np.median([one.length for one in solved]):.2f}",
        f"{np.median([one.duration / one.stopping for one in solved]):.2f}",
    ]


def solve(problem: Problem) -> Solved:
    name, arm, checker, start, goal, _ = problem
    path: list[np.ndarray] = []
    motions: list[armctl.JointTrajectory] = []
    path_s = cpu_time(lambda: path.extend(own_path(problem)))
    total_s = cpu_time(
        lambda: motions.append(move_free_with(checker, arm, start, goal, clearance=CLEARANCE_M, speed=1.0, seed=0))
    )
    motion = motions[0]
    verdicts: list[armctl.ClearanceCheck] = []
    proof_s = cpu_time(lambda: verdicts.append(clearance_of(checker, motion, 0.0)))
    data = mujoco.MjData(arm.model)
    times = np.arange(0.0, motion.duration, VERIFY_STEP_S)
    touches = sum(bool(contacts(arm, checker, data, q)) or capsules_in_boxes(arm, data, q) for q in motion.sample(times).q)
    if not motion.check_limits().ok or not armctl.check_torque(arm, motion).ok:
        raise armctl.PlanError("the motion breaks a limit")
    points = np.array(path)
    stopping = sum(armctl.move_j(arm, a, b).duration for a, b in pairwise(points))
    length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    return Solved(name, path_s, total_s, proof_s, verdicts[0].ok, touches, motion.duration, stopping, length)


def own_path(problem: Problem) -> list[np.ndarray]:
    """The points of a path that is proved free."""
    _, arm, checker, start, goal, _ = problem
    rng = np.random.default_rng(0)
    low, high = sampling_bounds(arm.limits.q_min, arm.limits.q_max, np.array([start, goal]))
    found = find_path(checker, start, goal[None], low, high, clearance_for(problem), rng, 20_000)
    return [] if found is None else list(shorten(checker, found.points, clearance_for(problem), rng))


def clearance_for(problem: Problem) -> float:
    distances = (problem.checker.nearest(problem.start)[1], problem.checker.nearest(problem.goal)[1])
    return min(CLEARANCE_M, 0.5 * min(distances))


def beside_peers(all_problems: list[Problem]) -> str:
    """Paths by armctl, roboplan and OMPL, by turns: time, length, and how many of them armctl can prove free."""
    results: dict[str, list[tuple[float, float, bool]]] = {}
    missing: set[str] = set()
    for i, problem in enumerate(all_problems):
        if not problem.arm.limits.contains(problem.goal):
            continue
        planners = {
            "armctl": lambda start, goal, problem=problem: own_path(problem),
            "roboplan": roboplan_planner(problem.arm, problem.checker),
            "OMPL": ompl_planner(problem.arm, problem.checker, clearance_for(problem)),
        }
        missing |= {name for name, plan in planners.items() if plan is None}
        for name, plan in planners.items():
            if plan is None:
                continue
            if i == 0:
                plan(problem.start, problem.goal)  # compiles and loads, once
            found: list[np.ndarray | list | None] = []
            seconds = cpu_time(lambda plan=plan, problem=problem, found=found: found.append(plan(problem.start, problem.goal)))
            path = found[0]
            if path is None or len(path) == 0:
                results.setdefault(name, []).append((seconds, np.nan, False))
                continue
            lengths = np.linalg.norm(np.diff(np.array(path), axis=0), axis=1)
            is_free = all(problem.checker.line_hit(a, b) is None for a, b in pairwise(path))
            results.setdefault(name, []).append((seconds, float(lengths.sum()), is_free))
    rows = []
    own = np.array([length for _, length, _ in results["armctl"]])
    for name, found in results.items():
        seconds, length, is_free = (np.array(column) for column in zip(*found, strict=True))
        median, high = np.percentile(1e3 * seconds, [50, 95])
        solved = int(np.isfinite(length).sum())
        ratio = np.nanmedian(own / length)
        rows.append([name, f"{solved} of {len(found)}", int(is_free.sum()), f"{median:.1f} / {high:.1f}", f"{ratio:.3f}"])
    header = ["planner", "solved", "path proved free", "path, ms, median / 95 %", "armctl's length over its length, median"]
    notes = (
        "RRT-Connect and shortcuts each, with the same geoms and pairs. armctl proves every line; roboplan checks every 0.05 "
        "rad; OMPL every 0.5 %, with armctl's distances called through Python, so its times are not its best."
    )
    absent = f" Not installed: {', '.join(sorted(missing))}." if missing else ""
    return f"**Paths beside peers, MotionBenchMaker, Panda**\n\n{as_markdown(header, rows)}\n\n{notes}{absent}"


def moves() -> str:
    """`sim.move_to` from home to poses among furniture: how many touch something, and how many of those say "reached"."""
    rows = []
    for avoid in (False, True):
        reached = 0
        touching = 0
        reached_touching = 0
        total = 0
        for problem in own_problems():
            if problem.index >= MOVES:
                continue
            sim = armctl.Simulation(problem.arm)
            result = sim.move_to(problem.arm.fk(problem.goal), avoid=avoid)
            is_touching = result.log is not None and touches_at(problem, result.log.q)
            total += 1
            reached += result.ok
            touching += is_touching
            reached_touching += result.ok and is_touching
        rows.append([f"avoid={avoid}", total, reached, touching, reached_touching])
    header = ["`sim.move_to`", "moves", "reached", "touched something", "reached although touched"]
    return f"**Moves from home to poses in the own scenes, simulated; contacts at every tick**\n\n{as_markdown(header, rows)}"


def touches_at(problem: Problem, configurations: np.ndarray) -> bool:
    """Whether the arm touches anything, by MuJoCo, or by brute force for capsules and boxes."""
    data = mujoco.MjData(problem.arm.model)
    return any(
        contacts(problem.arm, problem.checker, data, q) or capsules_in_boxes(problem.arm, data, q) for q in configurations
    )


def cpu_time(action) -> float:
    started = time.process_time()
    action()
    return time.process_time() - started


def place(arm: armctl.Arm, data: mujoco.MjData, q: np.ndarray) -> None:
    data.qpos[:] = arm.qpos(q)
    mujoco.mj_kinematics(arm.model, data)
    mujoco.mj_collision(arm.model, data)


def contacts(arm: armctl.Arm, checker: CollisionChecker, data: mujoco.MjData, q: np.ndarray) -> set[tuple[int, int]]:
    """The pairs that MuJoCo finds touching, of those that the checker counts."""
    place(arm, data, q)
    return {tuple(sorted(contact.geom.tolist())) for contact in data.contact if contact.dist < 0.0} & counted_pairs(checker)


@lru_cache(maxsize=1)
def counted_pairs(checker: CollisionChecker) -> set[tuple[int, int]]:
    """The geoms of the pairs that the checker counts."""
    return {tuple(sorted(checker.geometry.pair_geoms(p))) for p in range(len(checker.geometry.pairs))}


def capsules_in_boxes(arm: armctl.Arm, data: mujoco.MjData, q: np.ndarray) -> bool:
    """Whether a capsule of the arm overlaps a box of the world, by points along its axis: independent of any solver."""
    model = arm.model
    data.qpos[:] = arm.qpos(q)
    mujoco.mj_kinematics(model, data)
    shares = np.linspace(-1.0, 1.0, 201)[:, None]
    stands = (model.body_weldid[model.geom_bodyid] == 0) & (model.geom_contype != 0)
    moves = (model.body_weldid[model.geom_bodyid] != 0) & (model.geom_contype != 0)
    for box in np.flatnonzero((model.geom_type == BOX) & stands):
        R = data.geom_xmat[box].reshape(3, 3)
        for capsule in np.flatnonzero((model.geom_type == CAPSULE) & moves):
            axis = data.geom_xmat[capsule].reshape(3, 3)[:, 2] * model.geom_size[capsule, 1]
            points = (data.geom_xpos[capsule] + shares * axis - data.geom_xpos[box]) @ R
            gaps = np.linalg.norm(np.maximum(np.abs(points) - model.geom_size[box], 0.0), axis=1)
            if gaps.min() < model.geom_size[capsule, 0]:
                return True
    return False


def problems(file: Path, every: int) -> Iterator[Problem]:
    """The problems of a file. Their world has no floor."""
    for row in json.loads(file.read_text(encoding="utf-8"))[::every]:
        scene = armctl.Scene()
        for thing in row["objects"]:
            pose = armctl.Pose.from_rotation(np.array(thing["position"]), np.array(thing["rotation"]))
            size = thing["dimensions"]
            if thing["type"] == "box":
                scene.add_box(thing["name"], size, pose)
            elif thing["type"] == "cylinder":
                scene.add_cylinder(thing["name"], size[1], size[0], pose)
            else:
                scene.add_ball(thing["name"], size[0], pose)
        arm = armctl.load("panda", scene=scene)
        planes = arm.model.geom_type == PLANE
        arm.model.geom_contype[planes] = 0
        arm.model.geom_conaffinity[planes] = 0
        qpos = arm.home_qpos.copy()
        for finger, width in zip(("finger_joint1", "finger_joint2"), row["rest"].values(), strict=True):
            joint = arm.model.joint(finger).id
            qpos[arm.model.jnt_qposadr[joint]] = min(width, arm.model.jnt_range[joint, 1])
        grasped = GRASPS.get(row["scene"])
        allow = [(finger, grasped) for finger in ("left_finger", "right_finger")] if grasped else []
        yield Problem(row["scene"], arm, CollisionChecker(arm, qpos, allow), np.array(row["start"]), np.array(row["goal"]))


def arm_in(name: str, scene: str) -> armctl.Arm | None:
    """An arm in one of the scenes; None where its model is not installed."""
    reach = {"panda": 1.0, "ur5e": 1.05, "xarm7": 0.85}[name]
    try:
        return armctl.load(name, scene=SCENES[scene](reach))
    except armctl.ModelError:
        return None


def own_problems() -> Iterator[Problem]:
    """From home to random configurations that are free, among furniture."""
    for name in ("panda", "ur5e", "xarm7"):
        for scene in SCENES:
            arm = arm_in(name, scene)
            if arm is None:
                continue
            checker = CollisionChecker(arm)
            span = np.minimum(arm.limits.q_max - arm.home, np.pi)
            low = np.maximum(arm.limits.q_min - arm.home, -np.pi)
            points = arm.home + np.random.default_rng(0).uniform(low, span, (2000, arm.n))
            goals = [q for q in points if checker.hit(q, 2 * CLEARANCE_M) < 0 and tip_is_above(arm, q)][:PAIRS]
            for index, goal in enumerate(goals):
                yield Problem(f"{name}, {scene}", arm, checker, arm.home, goal, index)


def tip_is_above(arm: armctl.Arm, q: np.ndarray) -> bool:
    """Configurations below a table are no place to go to from above."""
    return bool(arm.fk(q).position[2] > 0.3)


def _table(r: float) -> armctl.Scene:
    scene = armctl.Scene().add_box("table", [0.6 * r, 1.0 * r, 0.04], [0.55 * r, 0, 0.15 * r])
    scene.add_box("crate", [0.15 * r, 0.2 * r, 0.2 * r], [0.5 * r, 0.15 * r, 0.27 * r])
    scene.add_cylinder("can", 0.04 * r, 0.2 * r, [0.45 * r, -0.25 * r, 0.27 * r])
    return scene.add_box("monitor", [0.05 * r, 0.4 * r, 0.35 * r], [0.7 * r, -0.1 * r, 0.345 * r])


def _shelf(r: float) -> armctl.Scene:
    scene = armctl.Scene()
    for level, z in enumerate((0.15, 0.45, 0.75)):
        scene.add_box(f"board{level}", [0.3 * r, 0.8 * r, 0.03], [0.8 * r, 0, z * r])
    scene.add_box("back", [0.03, 0.8 * r, 0.9 * r], [0.97 * r, 0, 0.45 * r])
    scene.add_box("left", [0.3 * r, 0.03, 0.9 * r], [0.8 * r, 0.42 * r, 0.45 * r])
    scene.add_box("right", [0.3 * r, 0.03, 0.9 * r], [0.8 * r, -0.42 * r, 0.45 * r])
    return scene.add_cylinder("post", 0.03 * r, 1.0 * r, [0.0, 0.5 * r, 0.5 * r])


def _box(r: float) -> armctl.Scene:
    scene = armctl.Scene().add_box("bottom", [0.5 * r, 0.5 * r, 0.03], [0.55 * r, 0, 0.05 * r])
    for side, (dx, dy, a, b) in enumerate(
        ((0.25, 0, 0.03, 0.5), (-0.25, 0, 0.03, 0.5), (0, 0.25, 0.5, 0.03), (0, -0.25, 0.5, 0.03))
    ):
        scene.add_box(f"wall{side}", [a * r, b * r, 0.35 * r], [(0.55 + dx) * r, dy * r, 0.22 * r])
    return scene.add_box("beam", [0.06 * r, 0.8 * r, 0.06 * r], [0.38 * r, 0, 0.95 * r])


SCENES = {"table": _table, "shelf": _shelf, "box": _box}

if __name__ == "__main__":
    main()
