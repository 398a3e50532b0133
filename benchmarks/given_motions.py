"""What is given against its peers: goals with a velocity (ruckig), and paths whose time alone is chosen (toppra).

    python benchmarks/given_motions.py [--only goals paths] [--goals 1500] [--paths 100]

With `--only`, what else the file says stays as it is. toppra is in the extra, `pip install -e .[benchmark]`; without it its
columns are empty. Limits are judged by differences of the setpoints at 1 kHz, which no motion inside them exceeds.
"""

from __future__ import annotations

import argparse
import logging
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import ruckig
from markdown_table import titled_table
from scipy.interpolate import CubicSpline

import armctl

Array = np.ndarray
GRID = 2000  # points of toppra
SAMPLE_S = 1e-3
ROUNDING = 1e-6  # of a limit, of a third difference at 1 kHz


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", nargs="+", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--goals", type=int, default=1500)
    parser.add_argument("--paths", type=int, default=100)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "given_motions.md")
    args = parser.parse_args()
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    logging.getLogger("toppra").setLevel(logging.ERROR)
    fresh = {name: PARTS[name](args) for name in args.only}
    written = args.out.read_text(encoding="utf-8").strip().split("\n\n**") if args.out.exists() else []
    tables = {name: "**" + text.removeprefix("**") for name, text in zip(PARTS, written, strict=False)} | fresh
    args.out.write_text("\n\n".join(tables[name] for name in PARTS if name in tables) + "\n", encoding="utf-8")
    print("\n\n".join(fresh.values()))


class Excess(NamedTuple):
    """Shares of the limits that differences at 1 kHz use, and rad by which positions leave their ranges."""

    share: float
    position: float

    @classmethod
    def of(cls, motion: armctl.JointTrajectory, limits: armctl.Limits) -> Excess:
        q = motion.sample(np.arange(0.0, motion.duration, SAMPLE_S)).q
        bounds = (limits.v_max, limits.a_max, limits.j_max)
        shares = [0.0]
        for order, bound in enumerate(bounds, start=1):
            difference = np.abs(np.diff(q, order, axis=0)) / SAMPLE_S**order
            shares.append(float((difference / bound).max()) if len(difference) else 0.0)
        outside = np.maximum(q - limits.q_max, limits.q_min - q).max() if len(q) else 0.0
        return cls(max(shares), max(0.0, float(outside)))


# Goals


def goals(args: argparse.Namespace) -> str:
    """Random starts and goals in motion, with the limits of a Panda and without torque limits."""
    panda = untiring(armctl.load("panda"))
    rows = []
    for kind in ("wide ranges", "own ranges"):
        arm = panda if kind == "own ranges" else wide(panda)
        rng = np.random.default_rng(1)
        solved = by_ruckig = refused = 0
        apart, missed, left, share = [0.0], [0.0], [0.0], [0.0]
        seconds = []
        for _ in range(args.goals):
            start, goal = random_state(arm, rng), random_state(arm, rng)
            alone = ruckig_duration(arm.limits, start, goal)
            by_ruckig += np.isfinite(alone)
            began = time.process_time()
            try:
                motion = armctl.move_j(arm, start, goal, straight=False)
            except (armctl.LimitError, armctl.PlanError):
                refused += 1
                continue
            seconds.append(time.process_time() - began)
            solved += 1
            excess = Excess.of(motion, arm.limits)
            share.append(excess.share)
            left.append(excess.position)
            missed.append(float(np.abs(motion(motion.duration).q - goal.q).max()))
            if kind == "wide ranges" and np.isfinite(alone):
                apart.append(abs(motion.duration / alone - 1))
        compared = f"{max(apart):.1e}" if kind == "wide ranges" else ""
        kept = f"{max(share) - 1:.0e}" if max(share) > 1 else "0"
        numbers = (compared, kept, f"{max(left):.0e}", f"{max(missed):.0e}", f"{1e6 * np.median(seconds):.0f}")
        rows.append((kind, args.goals, by_ruckig, solved, refused, *numbers))
    columns = [
        "joint ranges",
        "problems",
        "ruckig solves",
        "armctl solves",
        "refused",
        "durations differ by at most (target 1e-9)",
        "beyond a limit",
        "outside a range, rad",
        "off the goal, rad",
        "median, us of CPU",
    ]
    return titled_table(
        f"{args.goals} random starts and goals in motion, limits of a Panda: armctl and ruckig. In its own ranges armctl "
        "refuses what would leave them, before, between or after both states; ruckig does not see them",
        columns,
        rows,
    )


def untiring(arm: armctl.Arm, jerk: float = 1.0) -> armctl.Arm:
    """The arm without torque limits, and with a multiple of its jerk."""
    return arm.with_limits(replace(arm.limits, tau_max=np.full(arm.n, np.inf), j_max=jerk * arm.limits.j_max))


def wide(arm: armctl.Arm) -> armctl.Arm:
    """The arm with ranges that nothing leaves."""
    far = np.full(arm.n, 1e3)
    return arm.with_limits(replace(arm.limits, q_min=-far, q_max=far))


def random_state(arm: armctl.Arm, rng: np.random.Generator) -> armctl.Setpoint:
    """A state that ruckig accepts as a target: |v| + a^2 / 2 J is inside the limit of the speed."""
    limits = arm.limits
    low, high = np.maximum(limits.q_min, -3.0), np.minimum(limits.q_max, 3.0)
    a = rng.uniform(-1, 1, arm.n) * np.minimum(limits.a_max, np.sqrt(2 * limits.j_max * limits.v_max))
    v = rng.uniform(-1, 1, arm.n) * (limits.v_max - a**2 / (2 * limits.j_max))
    return armctl.Setpoint(rng.uniform(low, high), v, a)


def ruckig_duration(limits: armctl.Limits, start: armctl.Setpoint, goal: armctl.Setpoint) -> float:
    """s, of ruckig's own motion; NaN if it finds none."""
    problem = ruckig.InputParameter(len(limits.v_max))
    problem.current_position, problem.current_velocity, problem.current_acceleration = (x.tolist() for x in start[:3])
    problem.target_position, problem.target_velocity, problem.target_acceleration = (x.tolist() for x in goal[:3])
    problem.max_velocity = limits.v_max.tolist()
    problem.max_acceleration = limits.a_max.tolist()
    problem.max_jerk = limits.j_max.tolist()
    motion = ruckig.Trajectory(len(limits.v_max))
    try:
        result = ruckig.Ruckig(len(limits.v_max)).calculate(problem, motion)
    except (ruckig.RuckigError, ValueError):
        return float("nan")
    return motion.duration if result in (ruckig.Result.Working, ruckig.Result.Finished) else float("nan")


# Paths


class Case(NamedTuple):
    """A path, and how it is given to armctl."""

    spline: CubicSpline
    timed: Callable[[armctl.Arm], armctl.JointTrajectory]


def splines(arm: armctl.Arm, rng: np.random.Generator) -> Case:
    """A cubic spline through 5 to 9 random points."""
    count = int(rng.integers(5, 10))
    spline = inside(arm, np.linspace(0.0, 1.0, count), rng.uniform(-1, 1, (count, arm.n)))
    return Case(spline, lambda each: armctl.time_path(each, spline))


def functions(arm: armctl.Arm, rng: np.random.Generator) -> Case:
    """A Lissajous curve, given as a function with its derivatives; toppra gets a fine spline of it."""
    amplitude = 0.2 * (arm.limits.q_max - arm.limits.q_min).clip(max=2.0)
    rate = rng.integers(1, 4, arm.n)
    phase = rng.uniform(0.0, 2 * np.pi, arm.n)
    middle = centre(arm)

    def curve(s: Array, order: int) -> Array:
        value = amplitude * rate**order * np.sin(rate * s[:, None] + phase + 0.5 * np.pi * order)
        return value + middle if order == 0 else value

    s = np.linspace(0.0, 2 * np.pi, 400)
    return Case(CubicSpline(s, curve(s, 0)), lambda each: armctl.time_path(each, curve, (0.0, 2 * np.pi)))


def points(arm: armctl.Arm, rng: np.random.Generator) -> Case:
    """A hundred points of a smooth curve with their parameters, as of a recording."""
    s = np.linspace(0.0, 1.0, 100)
    q = inside(arm, np.linspace(0.0, 1.0, 6), rng.uniform(-1, 1, (6, arm.n)))(s)
    return Case(CubicSpline(s, q), lambda each: armctl.time_path(each, q, parameters=s))


def motions(arm: armctl.Arm, rng: np.random.Generator) -> Case:
    """A slow motion through six points, which is given as it is; toppra gets a spline over its length."""
    q = centre(arm) + 0.3 * half(arm) * rng.uniform(-1, 1, (6, arm.n))
    motion = armctl.move_through(untiring(arm), q, speed=0.3)
    dense = np.linspace(0.0, motion.duration, 200_000)
    covered = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(motion.sample(dense).q, axis=0), axis=1)))
    times = np.interp(np.linspace(0.0, covered[-1], GRID), covered, dense)
    spline = CubicSpline(CubicSpline(dense, covered)(times), motion.sample(times).q)
    return Case(spline, lambda each: armctl.time_path(each, motion))


def centre(arm: armctl.Arm) -> Array:
    return 0.5 * (arm.limits.q_min + arm.limits.q_max)


def half(arm: armctl.Arm) -> Array:
    return 0.5 * (arm.limits.q_max - arm.limits.q_min).clip(max=4.0)


def inside(arm: armctl.Arm, s: Array, shares: Array) -> CubicSpline:
    """The spline through points at shares of half the ranges, made smaller until it is inside the limits."""
    for size in 0.6 * 0.7 ** np.arange(10):
        spline = CubicSpline(s, centre(arm) + size * half(arm) * shares)
        if arm.limits.contains(spline(np.linspace(s[0], s[-1], 1000))):
            return spline
    raise AssertionError("no spline inside the limits")


def paths(args: argparse.Namespace) -> str:
    """Given paths of two arms at three multiples of their jerk limits."""
    rows = []
    for jerk in (1000.0, 10.0, 1.0):
        for kind in (splines, functions, points, motions):
            ratios, seconds, share, left = [], [], [0.0], [0.0]
            for arm, rng in arms_of(kind.__name__, args.paths // 4):
                case = kind(arm, rng)
                hard = untiring(arm, jerk)
                began = time.process_time()
                motion = case.timed(hard)
                seconds.append(time.process_time() - began)
                excess = Excess.of(motion, hard.limits)
                share.append(excess.share)
                left.append(excess.position)
                ratios.append(motion.duration / toppra_duration(hard.limits, case.spline))
            kept = "yes" if max(share) <= 1 + ROUNDING and max(left) <= 1e-9 else "NO"
            target = "1.02" if jerk == 1000.0 else ""
            numbers = (f"{np.median(ratios):.4f}", f"{np.max(ratios):.4f}", target, f"{1e3 * np.median(seconds):.0f}", kept)
            rows.append((f"{jerk:g}", kind.__name__, len(ratios), *numbers))
    columns = [
        "jerk limit",
        "given as",
        "paths",
        "time / toppra's, median",
        "worst",
        "target",
        "median, ms of CPU",
        "limits kept",
    ]
    return titled_table(
        f"{args.paths} given paths of the Panda and the UR5e at three multiples of their jerk limits: time over toppra's on "
        f"{GRID} points, which does not limit the jerk",
        columns,
        rows,
    )


def arms_of(kind: str, count: int) -> Iterator[tuple[armctl.Arm, np.random.Generator]]:
    """So many arms in turns, with random numbers that do not depend on the jerk."""
    arms = [armctl.load("panda"), armctl.load("ur5e")]
    for k in range(count):
        yield arms[k % len(arms)], np.random.default_rng([k, len(kind)])


def toppra_duration(limits: armctl.Limits, spline: CubicSpline) -> float:
    """s, the time-optimal duration along a spline with limits of speed and acceleration; NaN without toppra."""
    try:
        import toppra
        from toppra.algorithm import TOPPRA
        from toppra.constraint import DiscretizationType, JointAccelerationConstraint, JointVelocityConstraint
    except ImportError:
        return float("nan")
    v, a = limits.v_max, limits.a_max
    constraints = [
        JointVelocityConstraint(np.column_stack([-v, v])),
        JointAccelerationConstraint(np.column_stack([-a, a]), discretization_scheme=DiscretizationType.Interpolation),
    ]
    path = toppra.SplineInterpolator(spline.x, spline(spline.x))
    grid = np.linspace(spline.x[0], spline.x[-1], GRID)
    found = TOPPRA(constraints, path, gridpoints=grid, solver_wrapper="seidel").compute_trajectory(0, 0)
    return float("nan") if found is None else float(found.duration)


PARTS: dict[str, Callable[[argparse.Namespace], str]] = {"goals": goals, "paths": paths}

if __name__ == "__main__":
    main()
