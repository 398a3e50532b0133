"""Tool paths: 1 000 points on a sphere, a saddle and the edge where two pipes meet, passed with a tool that may turn and tilt.

    python benchmarks/tool_paths.py [--arms ur5e panda xarm7] [--cone 0.26] [--out FILE]

The surfaces stand where the arms reach them with every tool. The tip's z axis points into the surface. Saved is the time of
the motion with turns and tilts, against the fastest of 36 motions whose tool keeps one turn about the normal all the way.
A plan is timed on an arm that has planned before. The last column compares the joint path of turns only, at every
20th point, with the shortest one on a grid of one degree and all configurations of the arm, by dynamic programming: it is
computed for arms of six joints, which have finitely many. Cone and points are judged at 60 000 times of each motion.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from markdown_table import titled_table
from scipy.spatial import KDTree

import armctl

# m, where the lowest point of each surface is
PLACES = {"ur5e": (0.5, 0.1, 0.35), "panda": (0.45, 0.0, 0.35), "xarm7": (0.3, 0.0, 0.4)}
COUNT = 1000
FIXED_TURNS = 36
RUNGS = 51
GRID_TURNS = 360
MAX_RUNG_STEP = 0.7  # rad, of any joint between two rungs: more would be another branch
SAMPLES = 60_001


class Surface(NamedTuple):
    points: np.ndarray  # (N, 3) m
    normals: np.ndarray  # (N, 3)


def sphere() -> Surface:
    """A spiral on a ball."""
    share = np.linspace(0.0, 1.0, COUNT)
    polar = 0.35 * np.pi * (0.25 + 0.75 * share)
    turn = 6.0 * np.pi * share
    normals = np.column_stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)])
    return Surface(0.15 * normals, normals)


def saddle() -> Surface:
    """An ellipse on z = 2 (x^2 - y^2)."""
    turn = np.linspace(0.0, 2.0 * np.pi, COUNT)
    x = 0.12 * np.cos(turn)
    y = 0.2 * np.sin(turn)
    return Surface(np.column_stack([x, y, 2.0 * (x * x - y * y)]), _unit(np.column_stack([-4.0 * x, 4.0 * y, np.ones(COUNT)])))


def pipes() -> Surface:
    """The edge of an upright pipe of 80 mm on a lying one of 120 mm (radii), with the tool halfway between both."""
    large = 0.12
    small = 0.08
    turn = np.linspace(0.0, 2.0 * np.pi, COUNT)
    x = small * np.cos(turn)
    y = small * np.sin(turn)
    z = np.sqrt(large**2 - y**2)
    of_large = np.column_stack([np.zeros(COUNT), y, z]) / large
    of_small = np.column_stack([x, y, np.zeros(COUNT)]) / small
    return Surface(np.column_stack([x, y, z]), _unit(of_large + of_small))


SURFACES: dict[str, Callable[[], Surface]] = {"sphere": sphere, "saddle": saddle, "pipes": pipes}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", nargs="+", choices=PLACES, default=list(PLACES))
    parser.add_argument("--cone", type=float, default=0.26, help="rad (default %(default)s)")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "tool_paths.md")
    args = parser.parse_args()
    rows = []
    for robot in args.arms:
        arm = armctl.load(robot)
        armctl.move_path(arm, None, [arm.fk(arm.home)], free="z")  # what is prepared once for an arm is no part of a plan
        for name, make in SURFACES.items():
            shape = make()
            low = [0.0, 0.0, shape.points[:, 2].min()]
            rows.append([robot, name, *_row(arm, Surface(shape.points - low + PLACES[robot], shape.normals), args.cone)])
            print(*rows[-1], sep=" | ", flush=True)
    judged = ["violations", "off points, um", "cone left, urad"]
    columns = ["arm", "surface", "CPU s", *judged, "takes s", "fixed s", "saved", "of grid"]
    text = titled_table(f"Tool paths of {COUNT} points, with a cone of {args.cone:g} rad", columns, rows)
    text += f"\n\nCPU time of a whole plan; load average {os.getloadavg()[1]:.1f}.\n"
    args.out.parent.mkdir(exist_ok=True)
    args.out.write_text(text, encoding="utf-8")
    print(text)


def _row(arm: armctl.Arm, surface: Surface, cone: float) -> list[str]:
    begin = time.process_time()
    try:
        motion = armctl.move_path(arm, None, surface.points, normals=surface.normals, cone=cone)
    except armctl.PlanError as error:
        return [str(error), *[""] * 7]
    seconds = time.process_time() - begin
    off, left = _missed(arm, motion, surface, cone)
    violations = len(motion.check_limits().violations) + (not armctl.check_torque(arm, motion))
    fixed = _fixed_duration(arm, surface)
    row = [f"{seconds:.2f}", str(violations), f"{1e6 * off:.2f}", f"{1e6 * max(left, 0.0):.1f}", f"{motion.duration:.2f}"]
    row += [f"{fixed:.2f}", f"{100 * (1 - motion.duration / fixed):.0f} %"] if np.isfinite(fixed) else ["no way", ""]
    return [*row, f"{_length_of_grid(arm, surface):.3f}" if arm.n == 6 else ""]


def _missed(arm: armctl.Arm, motion: armctl.JointTrajectory, surface: Surface, cone: float) -> tuple[float, float]:
    """How far the tip is from the point that it passes worst, m, and how far the axis is out of its cone, rad."""
    points = surface.points
    at, rotations = arm.fk_many(motion.sample(np.linspace(0.0, motion.duration, SAMPLES)).q)
    _, nearest = KDTree(at).query(points)
    nearest = np.clip(nearest, 1, len(at) - 2)
    axes = rotations[:, :, 2]
    distances = []
    tilts = []
    for start in (nearest - 1, nearest):
        way = at[start + 1] - at[start]
        share = ((points - at[start]) * way).sum(axis=1) / np.maximum((way**2).sum(axis=1), 1e-30)
        share = np.clip(share, 0.0, 1.0)[:, None]
        distances.append(np.linalg.norm(points - at[start] - share * way, axis=1))
        against = -(_unit((1.0 - share) * axes[start] + share * axes[start + 1]) * surface.normals).sum(axis=1)
        tilts.append(np.arccos(np.clip(against, -1.0, 1.0)))
    tilt = np.where(distances[0] < distances[1], *tilts)
    return float(np.minimum(*distances).max()), float((tilt - cone).max())


def _turned(surface: Surface, turn: float) -> list[armctl.Pose]:
    """The poses of a tool along the normals, turned about them; from point to point it turns as little as possible else."""
    about = armctl.Pose([0.0, 0.0, 0.0], rpy=[0.0, 0.0, turn])
    return [part.frame @ about for part in armctl.Region.of(surface.points, surface.normals).parts]


def _fixed_duration(arm: armctl.Arm, surface: Surface) -> float:
    """s, of the fastest motion whose tool keeps one turn; infinite if there is none."""
    fastest = np.inf
    for turn in np.linspace(0.0, 2.0 * np.pi, FIXED_TURNS, endpoint=False):
        path = armctl.Region.union(armctl.Region(pose) for pose in _turned(surface, turn))
        try:
            fastest = min(fastest, armctl.move_path(arm, None, path).duration)
        except armctl.PlanError:
            continue
    return float(fastest)


def _length_of_grid(arm: armctl.Arm, surface: Surface) -> float:
    """The length of the joint path of turns only, of that of the shortest one on a grid."""
    rungs = np.linspace(0, COUNT - 1, RUNGS).astype(int)
    motion = armctl.move_path(arm, None, surface.points, normals=surface.normals)
    q = motion.sample(np.linspace(0.0, motion.duration, SAMPLES)).q
    way = _travel(arm.fk_many(q)[0])
    given = _travel(surface.points)
    passed = q[np.searchsorted(way / way[-1], given[rungs] / given[-1]).clip(0, len(q) - 1)]
    own = float(np.linalg.norm(np.diff(passed, axis=0), axis=1).sum())
    turns = np.linspace(0.0, 2.0 * np.pi, GRID_TURNS, endpoint=False)
    tried = [_turned(Surface(surface.points[rungs], surface.normals[rungs]), turn) for turn in turns]
    before = np.empty((0, arm.n))
    costs = np.empty(0)
    for step in range(RUNGS):
        found = [armctl.solve_ik_all(arm, poses[step]) for poses in tried]
        here = np.concatenate([each.q for each in found if each.ok.any()])
        costs = np.zeros(len(here)) if step == 0 else _cheapest(before, costs, here)
        before = here
    return own / float(costs.min())


def _cheapest(before: np.ndarray, costs: np.ndarray, here: np.ndarray) -> np.ndarray:
    """(H,) the least costs of configurations (H, n) after those before (B, n) with their costs (B,); whole turns are free."""
    squared = np.zeros((len(here), len(before)))
    largest = np.zeros_like(squared)
    for one, other in zip(here.T, before.T, strict=True):
        step = one[:, None] - other
        step -= 2.0 * np.pi * np.rint(step / (2.0 * np.pi))
        np.maximum(largest, np.abs(step), out=largest)
        squared += step**2
    return np.where(largest <= MAX_RUNG_STEP, np.sqrt(squared) + costs, np.inf).min(axis=1)


def _travel(points: np.ndarray) -> np.ndarray:
    """(N,) m, the way along points (N, 3) from the first one."""
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


if __name__ == "__main__":
    main()
