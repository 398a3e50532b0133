"""Motions against their peers: waypoints (ruckig stopping, toppra), lines (toppra, Drake, roboplan), limits, new goals online.

    python benchmarks/motion.py [--only waypoints lines online limits torques peers dense]
                                [--moves 10000] [--sets 500] [--lines 20]

With `--only`, what else the file says stays as it is.
The peers are an extra, `pip install -e .[benchmark]`; without them their columns are empty and their rows are left out. Speed,
acceleration and jerk limits are the Panda's; torque limits are lifted except in `torques`.
"""

from __future__ import annotations

import argparse
import logging
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from markdown_table import titled_table
from motion_peers import TIMERS, Timed
from scipy.interpolate import make_interp_spline

import armctl
from armctl import JointTrajectory, move_path

Array = np.ndarray


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", nargs="+", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--moves", type=int, default=10_000)
    parser.add_argument("--sets", type=int, default=500)
    parser.add_argument("--torque-sets", type=int, default=30)
    parser.add_argument("--lines", type=int, default=20)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "motion.md")
    args = parser.parse_args()
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    logging.getLogger("toppra").setLevel(logging.ERROR)
    panda = untiring(armctl.load("panda"))
    armctl.move_l(panda, panda.home, panda.fk(panda.home).position + np.array([0.0, 0.0, 0.05]))  # compiles, once
    fresh = {name: PARTS[name](panda, args) for name in args.only}
    args.out.parent.mkdir(exist_ok=True)
    written = args.out.read_text(encoding="utf-8").strip().split("\n\n**") if args.out.exists() else []
    tables = {name: "**" + text.removeprefix("**") for name, text in zip(PARTS, written, strict=False)} | fresh
    args.out.write_text("\n\n".join(tables[name] for name in PARTS if name in tables) + "\n", encoding="utf-8")
    print("\n\n".join(fresh.values()))


def untiring(arm: armctl.Arm, jerk: float = 1.0) -> armctl.Arm:
    """The arm without torque limits, and with a share of its jerk."""
    limits = replace(arm.limits, tau_max=np.full(arm.n, np.inf), j_max=jerk * arm.limits.j_max)
    return arm.with_limits(limits)


# Waypoints


def uniform(arm: armctl.Arm, rng: np.random.Generator) -> Array:
    """Ten positions anywhere inside the limits."""
    return rng.uniform(arm.limits.q_min, arm.limits.q_max, (10, arm.n))


def walk(arm: armctl.Arm, rng: np.random.Generator, memory: float = 0.6, step: float = 0.1) -> Array:
    """Ten positions of a random walk of small steps; a step keeps a part of the one before it."""
    low, high = arm.limits.q_min, arm.limits.q_max
    while True:
        steps = rng.normal(0.0, step, (9, arm.n))
        for k in range(1, 9):
            steps[k] = memory * steps[k - 1] + np.sqrt(1 - memory**2) * steps[k]
        q = rng.uniform(low, high) + np.vstack([np.zeros(arm.n), np.cumsum(steps, axis=0)])
        if arm.limits.contains(q):
            return q


def jumpy(arm: armctl.Arm, rng: np.random.Generator) -> Array:
    """A random walk of independent steps: half of the joints turn round at each waypoint."""
    return walk(arm, rng, memory=0.0)


def waypoints(panda: armctl.Arm, sets: int) -> str:
    rows = []
    for kind, targets in ((uniform, (0.935, 0.926)), (walk, (0.590, 0.565)), (jumpy, ("", ""))):
        for jerk, target in zip((1.0, 0.1), targets, strict=True):
            arm, rng = untiring(panda, jerk), np.random.default_rng(1)
            shares, peers, times, inside = [], [], [], True
            for k in range(sets):
                q = kind(arm, rng)
                stopping = np.array([armctl.move_j(arm, a, b).duration for a, b in pairwise(q)])
                began = time.perf_counter()
                motion = armctl.move_through(arm, q)
                times.append(time.perf_counter() - began)
                shares.append(motion.duration / stopping.sum())
                if k % 10 == 0:
                    peers.append(toppra_time(arm, q, np.concatenate([[0.0], np.cumsum(stopping)]), 400) / stopping.sum())
                inside &= motion.check_limits().ok
            error = np.std(shares) / np.sqrt(sets)
            figures = f"{np.mean(shares):.4f} +- {error:.4f}", target, f"{np.mean(peers):.3f}", f"{1e3 * np.median(times):.0f}"
            rows.append((kind.__name__, jerk, *figures, "yes" if inside else "NO"))
    columns = ["10 waypoints", "jerk", "armctl / stopping", "target", "toppra / stopping", "median, ms", "all limits kept"]
    return titled_table(
        f"{sets} sets of waypoints: duration as a share of stopping at each, mean and standard error (toppra, on every tenth "
        "set: without jerk or position limits)",
        columns,
        rows,
    )


def toppra_time(arm: armctl.Arm, q: Array, at: Array, points: int) -> float:
    """The time-optimal duration along the cubic spline through positions, without jerk limits; NaN without toppra."""
    try:
        import toppra
        from toppra.algorithm import TOPPRA
        from toppra.constraint import DiscretizationType, JointAccelerationConstraint, JointVelocityConstraint
    except ImportError:
        return float("nan")
    v, a = arm.limits.v_max, arm.limits.a_max
    constraints = [
        JointVelocityConstraint(np.column_stack([-v, v])),
        JointAccelerationConstraint(np.column_stack([-a, a]), discretization_scheme=DiscretizationType.Interpolation),
    ]
    path = toppra.SplineInterpolator(at, q)
    grid = np.linspace(at[0], at[-1], points)
    found = TOPPRA(constraints, path, gridpoints=grid, solver_wrapper="seidel").compute_trajectory(0, 0)
    return float(found.duration)


# Dense waypoints


def on_line(arm: armctl.Arm, count: int, rng: np.random.Generator) -> Array:
    """Waypoints evenly on a line of 0.2 rad."""
    return middle(arm) + np.linspace(-0.1, 0.1, count)[:, None] * rng.uniform(-1.0, 1.0, arm.n)


def on_curve(arm: armctl.Arm, count: int, rng: np.random.Generator) -> Array:
    """Waypoints on a smooth curve through the middle of the joint ranges."""
    u = np.linspace(0.0, 1.0, count)[:, None]
    waves = np.sin(2 * u + rng.uniform(0.0, 2 * np.pi, arm.n)) + 0.3 * np.sin(5 * u + rng.uniform(0.0, 2 * np.pi, arm.n))
    return middle(arm) + 0.3 * rng.uniform(0.2, 1.0, arm.n) * (arm.limits.q_max - arm.limits.q_min) * waves / 2.6


def middle(arm: armctl.Arm) -> Array:
    return 0.5 * (arm.limits.q_min + arm.limits.q_max)


def dense(panda: armctl.Arm, sets: int) -> str:
    """What an arm needs for waypoints that leave it no choice of its path."""
    rows = []
    for jerk in (1.0, 0.1):
        arm = untiring(panda, jerk)
        for count in (5, 10, 30, 100, 300):
            rng = np.random.default_rng(count)
            lines, curves, times, inside = [], [], [], True
            for _ in range(max(2, sets // 50)):
                for make, shares in ((on_line, lines), (on_curve, curves)):
                    q = make(arm, count, rng)
                    began = time.perf_counter()
                    motion = armctl.move_through(arm, q)
                    times.append(time.perf_counter() - began)
                    inside &= motion.check_limits().ok
                    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(q, axis=0), axis=1))])
                    best = armctl.move_j(arm, q[0], q[-1]).duration if shares is lines else toppra_time(arm, q, at, 2000)
                    shares.append(motion.duration / best)
            ratios = [f"{np.median(shares):.3f} ({np.max(shares):.3f})" for shares in (lines, curves)]
            rows.append(
                (count, jerk, ratios[0], 1.02, ratios[1], 1.15, f"{1e3 * np.median(times):.0f}", "yes" if inside else "NO")
            )
    columns = ["waypoints", "jerk", "line / move_j", "target", "curve / toppra", "target", "median, ms", "all limits kept"]
    return titled_table(
        "Dense waypoints on lines and smooth curves: duration over that of `move_j`, and over toppra's without jerk limits, "
        "median (worst)",
        columns,
        rows,
    )


# Torque limits


def torques(sets: int) -> str:
    """Ten waypoints with the Panda's torque limits: what they cost, and what they cost toppra along the same path."""
    arm, rng = armctl.load("panda"), np.random.default_rng(1)
    rows = []
    for kind in (uniform, walk):
        costs, bounds, stops, times, bind, inside = [], [], [], [], 0, True
        for _ in range(sets):
            q = kind(arm, rng)
            free = armctl.move_through(untiring(arm), q)
            began = time.process_time()
            motion = armctl.move_through(arm, q)
            spent = time.process_time() - began
            stops.append(motion.duration / sum(armctl.move_j(arm, a, b).duration for a, b in pairwise(q)))
            inside &= motion.check_limits().ok and armctl.check_torque(arm, motion).ok
            if motion.slowed is None:
                continue
            bind += 1
            times.append(spent)
            costs.append(motion.duration / free.duration - 1)
            if kind is uniform:  # the others take 1.4 s: samples of 8 ms are too coarse for a bound
                bounds.append(toppra_torque_time(arm, free) / free.duration - 1)
        cost = [f"{100 * np.mean(each):.2f} ({100 * np.max(each):.2f})" if each else "" for each in (costs, bounds)]
        rest = f"{np.max(stops):.3f}", f"{1e3 * np.median(times):.0f}", "yes" if inside else "NO"
        rows.append((kind.__name__, bind, *cost, *rest))
    columns = [
        "10 waypoints",
        "sets that need more torque",
        "armctl longer by, % (worst)",
        "toppra longer by, % (worst)",
        "worst / stopping at each",
        "median, ms of CPU",
        "all limits kept",
    ]
    return titled_table(
        f"{sets} sets of waypoints with torque limits: how much longer than without them (toppra: along armctl's path without "
        "them, no jerk limits, torques at samples 8 ms apart, so it is about a bound and no plan)",
        columns,
        rows,
    )


def toppra_torque_time(arm: armctl.Arm, motion: JointTrajectory) -> float:
    """toppra's time with torque limits along the path of a motion; NaN without toppra. The ends keep their own time."""
    try:
        import toppra
        from toppra.algorithm import TOPPRA
        from toppra.constraint import (
            DiscretizationType,
            JointAccelerationConstraint,
            JointTorqueConstraint,
            JointVelocityConstraint,
        )
    except ImportError:
        return float("nan")
    v, a, tau = arm.limits.v_max, arm.limits.a_max, arm.limits.tau_max
    ends = 0.03  # s: at rest the path has no direction
    times = np.linspace(ends, motion.duration - ends, int(motion.duration / 0.004))
    path = toppra.SplineInterpolator(times, motion.sample(times).q)
    constraints = [
        JointVelocityConstraint(np.column_stack([-v, v])),
        JointAccelerationConstraint(np.column_stack([-a, a]), discretization_scheme=DiscretizationType.Interpolation),
        JointTorqueConstraint(
            arm.inverse_dynamics,
            np.column_stack([-tau, tau]),
            np.zeros(arm.n),
            discretization_scheme=DiscretizationType.Collocation,
        ),
    ]
    grid = np.linspace(times[0], times[-1], int(motion.duration / 0.008))
    planner = TOPPRA(constraints, path, gridpoints=grid, solver_wrapper="seidel")
    found = planner.compute_trajectory(1.0, 1.0)
    if found is None:  # at full speed the ends need too much torque
        found = planner.compute_trajectory(0.9, 0.9)
    return float("nan") if found is None else float(found.duration) + 2 * ends


# Lines


def random_line(arm: armctl.Arm, rng: np.random.Generator) -> tuple[Array, armctl.Pose]:
    """A start in the middle of the joint ranges and a pose 0.2 to 0.6 m and up to 0.8 rad away."""
    middle, half = 0.5 * (arm.limits.q_max + arm.limits.q_min), 0.5 * (arm.limits.q_max - arm.limits.q_min)
    half = np.where(np.isfinite(half), half, np.pi)
    q = np.where(np.isfinite(middle), middle, 0.0) + 0.7 * half * rng.uniform(-1, 1, arm.n)
    start = arm.fk(q)
    way, axis = rng.normal(size=3), rng.normal(size=3)
    way *= rng.uniform(0.2, 0.6) / np.linalg.norm(way)
    half_angle = 0.5 * rng.uniform(0.0, 0.8)
    turn = armctl.Pose([0, 0, 0], quat=[np.cos(half_angle), *(np.sin(half_angle) * axis / np.linalg.norm(axis))])
    return q, armctl.Pose(start.position + way, quat=(turn @ start).quat)


def lines(panda: armctl.Arm, count: int) -> str:
    rows = []
    for jerk, aim in ((1.0, 1.01), (0.1, 1.04)):
        arm, rng = untiring(panda, jerk), np.random.default_rng(0)
        ratios, times, off, inside = [], [], [], True
        while len(ratios) < count:
            q, target = random_line(arm, rng)
            try:
                began = time.perf_counter()
                motion = armctl.move_l(arm, q, target)
                times.append(time.perf_counter() - began)
            except armctl.PlanError:
                continue
            ratios.append(motion.duration / toppra_time(arm, *along(arm, motion), 1000))
            off.append(off_line(arm, motion))
            inside &= motion.check_limits().ok
        figures = (f"{figure(ratios):.4f}" for figure in (np.mean, np.median, np.max))
        rest = f"{1e6 * np.max(off):.3f}", f"{1e3 * np.median(times):.0f}", "yes" if inside else "NO"
        rows.append((jerk, *figures, aim, *rest))
    columns = ["jerk", "mean", "median", "worst", "target", "tip off the line, um (target 5)", "median, ms", "all limits kept"]
    return titled_table(
        f"{count} tip lines: duration over toppra's optimum, without jerk limits, for the same joint path", columns, rows
    )


def along(arm: armctl.Arm, motion: JointTrajectory) -> tuple[Array, Array]:
    """The joint path of a line, evenly along the tip's way, and where on it."""
    q = motion.sample(np.linspace(0.0, motion.duration, 4000)).q
    way = np.linalg.norm(arm.fk_many(q)[0] - arm.fk(q[0]).position, axis=1)
    way, first = np.unique(way, return_index=True)
    s = np.linspace(0.0, way[-1], 200)
    return make_interp_spline(way, q[first], k=3)(s), s


def off_line(arm: armctl.Arm, motion: JointTrajectory) -> float:
    """How far the tip comes from its straight line, m."""
    p = arm.fk_many(motion.sample(np.linspace(0.0, motion.duration, 2000)).q)[0]
    return off_straight(p, p[0], p[-1])


def off_straight(p: Array, start: Array, end: Array) -> float:
    """How far points come from the straight line between two others, m."""
    way = (end - start) / np.linalg.norm(end - start)
    return float(np.linalg.norm((p - start) - ((p - start) @ way)[:, None] * way, axis=1).max())


def peers(panda: armctl.Arm, count: int) -> str:
    """The same lines, timed by each TOPP-RA along armctl's joint path; every answer is sampled at 1 kHz."""
    rng = np.random.default_rng(0)
    timers = {name: timer for name, make in TIMERS.items() if (timer := make(panda)) is not None}
    results: dict[str, list[tuple[float, ...]]] = {name: [] for name in ("armctl", *timers)}
    bounds = (panda.limits.v_max, panda.limits.a_max, panda.limits.j_max)
    while len(results["armctl"]) < count:
        q, target = random_line(panda, rng)
        try:
            began = time.process_time()
            motion = armctl.move_l(panda, q, target)
            seconds = time.process_time() - began
        except armctl.PlanError:
            continue
        timed = {"armctl": Timed(motion.sample(np.arange(0.0, motion.duration, 1e-3)).q, motion.duration, seconds)}
        path = along(panda, motion)
        timed |= {name: timer(*path) for name, timer in timers.items()}
        shortest = timed["toppra"].duration if "toppra" in timed else float("nan")
        for name, each in timed.items():
            off = off_straight(panda.fk_many(each.q)[0], panda.fk(q).position, target.position)
            uses = [float(np.abs(np.diff(each.q, k, axis=0) / 1e-3**k / bound).max()) for k, bound in enumerate(bounds, 1)]
            results[name].append((each.duration / shortest, *uses, 1e6 * off, 1e3 * each.seconds))
    rows = []
    for name, values in results.items():
        ratio, v, a, j, off, ms = np.array(values).T
        figures = f"{np.median(ratio):.4f}", f"{ratio.max():.4f}", f"{v.max():.4f}", f"{a.max():.4f}", f"{j.max():.3g}"
        rows.append((name, *figures, f"{off.max():.2f}", f"{np.median(ms):.1f}"))
    columns = [
        "timing by",
        "time, median",
        "worst",
        "v / limit",
        "a / limit",
        "j / limit",
        "off the line, um",
        "median, ms of CPU",
    ]
    return titled_table(
        f"{count} tip lines timed along the same joint path: duration over toppra's, and the worst of 1 kHz differences (only "
        "armctl limits the jerk; its time contains the inverse kinematics of the line)",
        columns,
        rows,
    )


# Limits


def limits_kept(moves: int) -> str:
    """Random moves of every kind on several arms; violations by true extremes and by 1 kHz differences."""
    kinds: list[tuple[str, int, Callable]] = [
        ("move_j", 50, lambda arm, rng: armctl.move_j(arm, anywhere(arm, rng), anywhere(arm, rng))),
        (
            "move_j, not straight",
            30,
            lambda arm, rng: armctl.move_j(arm, anywhere(arm, rng), anywhere(arm, rng), straight=False),
        ),
        ("move_through", 5, lambda arm, rng: armctl.move_through(arm, [anywhere(arm, rng) for _ in range(4)])),
        ("move_l", 7, lambda arm, rng: armctl.move_l(arm, *point_near(arm, rng))),
        ("move_c", 3, arc),
        ("move_path", 2, rounded),
        ("stopped_at", 3, stopped),
    ]
    arms = [armctl.load(name) for name in ("panda", "ur5e", "robot_arm_3dof")]
    rows = []
    for name, percent, plan in kinds:
        rng = np.random.default_rng(2)
        count = max(1, moves * percent // 100)
        done = refused = slowed = 0
        ratios, differences, torques = [0.0], [0.0], [0.0]
        while done < count:
            arm = arms[done % len(arms)]
            try:
                motion = plan(arm, rng)
            except armctl.PlanError:
                refused += 1
                continue
            done += 1
            slowed += motion.slowed is not None
            ratios.append(motion.check_limits().worst.ratio)
            differences.append(by_differences(motion))
            torques.append(armctl.check_torque(arm, motion).ratio)
        violations = sum(ratio > 1 + 1e-6 for ratio in ratios)
        rows.append(
            [
                name,
                done,
                violations,
                f"{max(ratios) - 1:.1e}",
                f"{max(differences):.5f}",
                f"{max(torques):.4f}",
                slowed,
                refused,
            ]
        )
    columns = [
        "kind",
        "moves",
        "violations",
        "worst ratio - 1",
        "worst by 1 kHz",
        "most torque / limit",
        "slowed for torque",
        "refused",
    ]
    return titled_table("Random moves on panda, ur5e and robot_arm_3dof: v, a, j and position limits", columns, rows)


def anywhere(arm: armctl.Arm, rng: np.random.Generator) -> Array:
    return arm.limits.random(arm.home, 1, rng)[0]


def point_near(arm: armctl.Arm, rng: np.random.Generator) -> tuple[Array, Array]:
    q = anywhere(arm, rng)
    way = rng.normal(size=3)
    return q, arm.fk(q).position + rng.uniform(0.02, 0.2) * way / np.linalg.norm(way)


def arc(arm: armctl.Arm, rng: np.random.Generator) -> JointTrajectory:
    q, via = point_near(arm, rng)
    return armctl.move_c(arm, q, via, via + rng.normal(0.0, 0.05, 3))


def rounded(arm: armctl.Arm, rng: np.random.Generator) -> JointTrajectory:
    q, first = point_near(arm, rng)
    return move_path(arm, q, [first, first + rng.normal(0.0, 0.05, 3), first + rng.normal(0.0, 0.05, 3)], blend=0.005)


def stopped(arm: armctl.Arm, rng: np.random.Generator) -> JointTrajectory:
    motion = armctl.move_j(arm, anywhere(arm, rng), anywhere(arm, rng))
    return motion.stopped_at(rng.uniform(0.0, motion.duration))


def by_differences(motion: JointTrajectory) -> float:
    """The most that differences of 1 kHz samples of q, v and a use of the limits on v, a and j."""
    times = np.arange(0.0, motion.duration, 1e-3)
    if len(times) < 2:
        return 0.0
    samples, limits = motion.sample(times), motion.limits
    bounds = (limits.v_max, limits.a_max, limits.j_max)
    return max(float((np.abs(np.diff(x, axis=0)) / 1e-3 / bound).max()) for x, bound in zip(samples[:3], bounds, strict=True))


# Online


def online(panda: armctl.Arm) -> str:
    """A new goal every 20 ms, in the middle of the motion to the last one."""
    rng, motion = np.random.default_rng(3), armctl.OnlineMotion(panda, panda.home)
    times, states = [], np.empty((100_000, 3, panda.n))
    for tick in range(len(states)):
        if tick % 20 == 0:
            goal = anywhere(panda, rng) if tick % 4000 else panda.home
            began = time.perf_counter()
            motion.go_to(goal)
            times.append(time.perf_counter() - began)
        states[tick] = motion.step(1e-3)[:3]
    q, v, a = np.moveaxis(states, 1, 0)
    limits = panda.limits
    ratio = max(float((np.abs(x) / bound).max()) for x, bound in ((v, limits.v_max), (a, limits.a_max)))
    jerk = float((np.abs(np.diff(a, axis=0)) / 1e-3 / limits.j_max).max())
    median, late = np.percentile(times, [50, 99]) * 1e6
    row = [
        len(times),
        f"{median:.0f}",
        f"{late:.0f}",
        50,
        f"{max(ratio, jerk):.6f}",
        "yes" if limits.contains(q, 1e-9) else "NO",
    ]
    columns = ["new goals", "median, us", "p99, us", "target", "worst v, a, j / limit", "position limits kept"]
    return titled_table("Online: a new goal in motion", columns, [row])


PARTS = {
    "waypoints": lambda panda, args: waypoints(panda, args.sets),
    "lines": lambda panda, args: lines(panda, args.lines),
    "online": lambda panda, args: online(panda),
    "limits": lambda panda, args: limits_kept(args.moves),
    "torques": lambda panda, args: torques(args.torque_sets),
    "peers": lambda panda, args: peers(panda, args.lines),
    "dense": lambda panda, args: dense(panda, args.sets),
}


if __name__ == "__main__":
    main()
