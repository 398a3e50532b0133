"""Collision-free motion: motions and their proofs, on given problems and on scenes of its own, beside roboplan and OMPL.

    python benchmarks/planning.py [--problems FILE.json] [--every K] [--only problems peers scenes moves] [--out FILE]

A problem file is a list of `{scene, index, start, goal, rest, objects}` for the Panda, as the MotionBenchMaker problems are
written: joints in rad, `objects` with name, type (box, cylinder, sphere), dimensions in full lengths, position and rotation.
Fingers stay as the arm has them at home.

Every motion is verified at 1 kHz with MuJoCo's own collision detection, and, where links are capsules, by brute force. Times
are CPU times of one thread, of `armctl.move_free` and `armctl.check_clearance` as a user calls them.
"""

from __future__ import annotations

import argparse
import json
import os
import time
import warnings
from collections.abc import Iterator
from functools import reduce
from itertools import islice, pairwise
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from markdown_table import titled_table
from planning_peers import ompl_planner, roboplan_planner

import armctl

CLEARANCE_M = 2e-3  # the default of move_free

VERIFY_STEP_S = 1e-3
LENGTH_SAMPLES = 2000
PAIRS = 20
MOVES = 8  # of the pairs of each arm and scene
GRASPS = {"cage": "Cube1", "table_pick": "Can1", "table_under_pick": "Can1"}  # the goal is a grasp: fingers may touch this
CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
BOX = int(mujoco.mjtGeom.mjGEOM_BOX)
PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)


class Problem(NamedTuple):
    name: str
    arm: armctl.Arm
    allow: tuple[tuple[str, str], ...]
    start: np.ndarray
    goal: np.ndarray
    index: int = 0  # within its scene


class Solved(NamedTuple):
    name: str
    first_s: float
    total_s: float
    proof_s: float
    is_proved: bool
    touches: int
    duration: float
    direct: float
    length: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--problems", type=Path, help="a file of problems for the Panda")
    parser.add_argument("--every", type=int, default=1, help="take every K-th problem")
    parts = ["problems", "peers", "scenes", "moves"]
    parser.add_argument("--only", nargs="+", choices=parts, default=parts)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "planning.md")
    args = parser.parse_args()
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    parts = []
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


def planned(title: str, all_problems: list[Problem]) -> str:
    """Every problem solved, timed and verified."""
    solved: list[Solved] = []
    refused: list[str] = []
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
        "first motion, ms",
        "motion, ms",
        "proof, ms",
        "length, rad",
        "duration",
    ]
    notes = "\n".join(f"- not solved: {reason}" for reason in refused)
    legend = (
        "Times: median / 95 %. Motion: `armctl.move_free`, which is the path, its timing, the torque limits and the proof, "
        f"with a clearance of {1e3 * CLEARANCE_M:g} mm. First motion: the same call before it, for which the collision model "
        "is made where the arm or its scene is new. Proof: `armctl.check_clearance` of the finished motion, with its closest "
        "approach. Duration: median multiple of that of the straight motion, which touches something or is the same."
    )
    return (
        f"{titled_table(f'{title}: {len(solved)} of {len(all_problems)} solved', header, rows)}\n\n{legend}\n{notes}".rstrip()
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
        times([one.first_s for one in solved]),
        times([one.total_s for one in solved]),
        times([one.proof_s for one in solved]),
        f"{np.median([one.length for one in solved]):.2f}",
        f"{np.median([one.duration / one.direct for one in solved]):.2f}",
    ]


def solve(problem: Problem) -> Solved:
    motions: list[armctl.JointTrajectory] = []
    verdicts: list[armctl.ClearanceCheck] = []
    first_s = cpu_time(lambda: motions.append(planned_by_armctl(problem)))
    total_s = cpu_time(lambda: motions.append(planned_by_armctl(problem)))
    motion = motions[-1]
    proof_s = cpu_time(lambda: verdicts.append(armctl.check_clearance(problem.arm, motion, allow=problem.allow)))
    data = mujoco.MjData(problem.arm.model)
    times = np.arange(0.0, motion.duration, VERIFY_STEP_S)
    touches = sum(bool(contacts(problem, data, q)) or capsules_in_boxes(problem.arm, data, q) for q in motion.sample(times).q)
    if not motion.check_limits().ok or not armctl.check_torque(problem.arm, motion).ok:
        raise armctl.PlanError("the motion breaks a limit")
    direct = armctl.move_j(problem.arm, problem.start, problem.goal).duration
    return Solved(
        name=problem.name,
        first_s=first_s,
        total_s=total_s,
        proof_s=proof_s,
        is_proved=verdicts[0].ok,
        touches=touches,
        duration=motion.duration,
        direct=direct,
        length=length_of(motion),
    )


def planned_by_armctl(problem: Problem) -> armctl.JointTrajectory:
    return armctl.move_free(problem.arm, problem.start, problem.goal, allow=problem.allow)


def length_of(motion: armctl.JointTrajectory) -> float:
    """rad, of the way in joint space."""
    q = motion.sample(np.linspace(0.0, motion.duration, LENGTH_SAMPLES)).q
    return float(np.linalg.norm(np.diff(q, axis=0), axis=1).sum())


def beside_peers(all_problems: list[Problem]) -> str:
    """Paths by armctl, roboplan and OMPL, by turns: time, length, and how many of them armctl can prove free."""
    results: dict[str, list[tuple[float, float, bool]]] = {}
    missing: set[str] = set()
    for i, problem in enumerate(all_problems):
        if not problem.arm.limits.contains(problem.goal):
            continue
        planners = {
            "armctl": lambda start, goal, problem=problem: planned_by_armctl(problem),
            "roboplan": roboplan_planner(problem.arm, allowed_pairs(problem)),
            "OMPL": ompl_planner(problem.arm, lambda q, problem=problem: not touches_at(problem, q[None])),
        }
        missing |= {name for name, plan in planners.items() if plan is None}
        for name, plan in planners.items():
            if plan is None:
                continue
            if i == 0:
                plan(problem.start, problem.goal)  # loads what is needed, once
            found: list = []
            seconds = cpu_time(lambda plan=plan, problem=problem, found=found: found.append(plan(problem.start, problem.goal)))
            if found[0] is None or (name != "armctl" and len(found[0]) == 0):
                results.setdefault(name, []).append((seconds, np.nan, False))
                continue
            motion = found[0] if name == "armctl" else stopping_at(problem.arm, found[0])
            is_free = armctl.check_clearance(problem.arm, motion, allow=problem.allow).ok
            results.setdefault(name, []).append((seconds, length_of(motion), is_free))
    rows = []
    own = np.array([length for _, length, _ in results["armctl"]])
    for name, found in results.items():
        seconds, length, is_free = (np.array(column) for column in zip(*found, strict=True))
        median, high = np.percentile(1e3 * seconds, [50, 95])
        solved = int(np.isfinite(length).sum())
        ratio = np.nanmedian(own / length)
        rows.append([name, f"{solved} of {len(found)}", int(is_free.sum()), f"{median:.1f} / {high:.1f}", f"{ratio:.3f}"])
    header = ["planner", "solved", "proved free", "ms, median / 95 %", "armctl's length over its length, median"]
    notes = (
        "RRT-Connect and shortcuts each, with the same geoms. armctl's times are those of a motion: it proves every "
        "line and the smooth motion, and times it within the limits. The others' are those of a path: roboplan checks every "
        "0.05 rad; OMPL every 0.5 %, with MuJoCo's contacts called through Python, so its times are not its best."
    )
    absent = f" Not installed: {', '.join(sorted(missing))}." if missing else ""
    return f"{titled_table('Paths beside peers, MotionBenchMaker, Panda', header, rows)}\n\n{notes}{absent}"


def stopping_at(arm: armctl.Arm, points: np.ndarray) -> armctl.JointTrajectory:
    """The motion that stops at each point of a path."""
    return reduce(armctl.JointTrajectory.then, [armctl.move_j(arm, a, b) for a, b in pairwise(points)])


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
    return titled_table("Moves from home to poses in the own scenes, simulated; contacts at every tick", header, rows)


def touches_at(problem: Problem, configurations: np.ndarray) -> bool:
    """Whether the arm touches anything, by MuJoCo, or by brute force for capsules and boxes."""
    data = mujoco.MjData(problem.arm.model)
    return any(contacts(problem, data, q) or capsules_in_boxes(problem.arm, data, q) for q in configurations)


def cpu_time(action) -> float:
    started = time.process_time()
    action()
    return time.process_time() - started


def place(arm: armctl.Arm, data: mujoco.MjData, q: np.ndarray) -> None:
    data.qpos[:] = arm.qpos(q)
    mujoco.mj_kinematics(arm.model, data)
    mujoco.mj_collision(arm.model, data)


def contacts(problem: Problem, data: mujoco.MjData, q: np.ndarray) -> set[tuple[int, int]]:
    """The pairs of geoms that MuJoCo finds touching, without those that may touch."""
    return touching(problem.arm, data, q) - allowed_pairs(problem)


def touching(arm: armctl.Arm, data: mujoco.MjData, q: np.ndarray) -> set[tuple[int, int]]:
    """The pairs of geoms that MuJoCo finds touching."""
    place(arm, data, q)
    return {tuple(sorted(contact.geom.tolist())) for contact in data.contact if contact.dist < 0.0}


def allowed_pairs(problem: Problem) -> set[tuple[int, int]]:
    """The pairs that the caller allows to touch, and those that touch at home or at the start: neighboring links, by design."""
    arm = problem.arm
    data = mujoco.MjData(arm.model)
    pairs = touching(arm, data, arm.home) | touching(arm, data, problem.start)
    for names in problem.allow:
        first, second = ([g for g in range(arm.model.ngeom) if name in owners(arm.model, g)] for name in names)
        pairs |= {(min(a, b), max(a, b)) for a in first for b in second}
    return pairs


def owners(model: mujoco.MjModel, geom: int) -> set[str]:
    """The names of a geom and of its body."""
    return {model.geom(geom).name, model.body(int(model.geom_bodyid[geom])).name}


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
        scene = armctl.World()
        for thing in row["objects"]:
            pose = armctl.Pose.from_rotation(np.array(thing["position"]), np.array(thing["rotation"]))
            size = thing["dimensions"]
            if thing["type"] == "box":
                scene.add(thing["name"], armctl.Box(size), pose)
            elif thing["type"] == "cylinder":
                scene.add(thing["name"], armctl.Cylinder(size[1], size[0]), pose)
            else:
                scene.add(thing["name"], armctl.Ball(size[0]), pose)
        arm = armctl.load("panda", scene=scene)
        planes = arm.model.geom_type == PLANE
        arm.model.geom_contype[planes] = 0
        arm.model.geom_conaffinity[planes] = 0
        grasped = GRASPS.get(row["scene"])
        allow = tuple((finger, grasped) for finger in ("left_finger", "right_finger")) if grasped else ()
        yield Problem(row["scene"], arm, allow, np.array(row["start"]), np.array(row["goal"]))


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
            span = np.minimum(arm.limits.q_max - arm.home, np.pi)
            low = np.maximum(arm.limits.q_min - arm.home, -np.pi)
            points = arm.home + np.random.default_rng(0).uniform(low, span, (2000, arm.n))
            goals = islice((q for q in points if tip_is_above(arm, q) and stands_free(arm, q)), PAIRS)
            for index, goal in enumerate(goals):
                yield Problem(f"{name}, {scene}", arm, (), arm.home, goal, index)


def stands_free(arm: armctl.Arm, q: np.ndarray) -> bool:
    """Whether the arm keeps twice the clearance where it stands."""
    return armctl.check_clearance(arm, armctl.move_j(arm, q, q), 2 * CLEARANCE_M).ok


def tip_is_above(arm: armctl.Arm, q: np.ndarray) -> bool:
    """Configurations below a table are no place to go to from above."""
    return bool(arm.fk(q).position[2] > 0.3)


def _table(r: float) -> armctl.World:
    scene = armctl.World().add("table", armctl.Box([0.6 * r, 1.0 * r, 0.04]), [0.55 * r, 0, 0.15 * r])
    scene.add("crate", armctl.Box([0.15 * r, 0.2 * r, 0.2 * r]), [0.5 * r, 0.15 * r, 0.27 * r])
    scene.add("can", armctl.Cylinder(0.04 * r, 0.2 * r), [0.45 * r, -0.25 * r, 0.27 * r])
    return scene.add("monitor", armctl.Box([0.05 * r, 0.4 * r, 0.35 * r]), [0.7 * r, -0.1 * r, 0.345 * r])


def _shelf(r: float) -> armctl.World:
    scene = armctl.World()
    for level, z in enumerate((0.15, 0.45, 0.75)):
        scene.add(f"board{level}", armctl.Box([0.3 * r, 0.8 * r, 0.03]), [0.8 * r, 0, z * r])
    scene.add("back", armctl.Box([0.03, 0.8 * r, 0.9 * r]), [0.97 * r, 0, 0.45 * r])
    scene.add("left", armctl.Box([0.3 * r, 0.03, 0.9 * r]), [0.8 * r, 0.42 * r, 0.45 * r])
    scene.add("right", armctl.Box([0.3 * r, 0.03, 0.9 * r]), [0.8 * r, -0.42 * r, 0.45 * r])
    return scene.add("post", armctl.Cylinder(0.03 * r, 1.0 * r), [0.0, 0.5 * r, 0.5 * r])


def _box(r: float) -> armctl.World:
    scene = armctl.World().add("bottom", armctl.Box([0.5 * r, 0.5 * r, 0.03]), [0.55 * r, 0, 0.05 * r])
    for side, (dx, dy, a, b) in enumerate(
        ((0.25, 0, 0.03, 0.5), (-0.25, 0, 0.03, 0.5), (0, 0.25, 0.5, 0.03), (0, -0.25, 0.5, 0.03))
    ):
        scene.add(f"wall{side}", armctl.Box([a * r, b * r, 0.35 * r]), [(0.55 + dx) * r, dy * r, 0.22 * r])
    return scene.add("beam", armctl.Box([0.06 * r, 0.8 * r, 0.06 * r]), [0.38 * r, 0, 0.95 * r])


SCENES = {"table": _table, "shelf": _shelf, "box": _box}

if __name__ == "__main__":
    main()
