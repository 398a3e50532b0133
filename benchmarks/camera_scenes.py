"""From pictures to motions: an arm finds a green ball with three depth cameras and goes there around what it sees.

    python benchmarks/camera_scenes.py [--scenes 102] [--arms panda ur5e xarm7] [--out FILE]

Each scene has a ball at a random place in reach, three random obstacles, and a light of random direction and strength. The arm
that plans knows the pictures only; their depth has no noise. Contacts are those of the simulation. A refusal is true if no plan
keeps two spacings of the points from the obstacles themselves, or if the ball is hidden from every camera, by MuJoCo's rays.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import tempfile
import warnings
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from markdown_table import titled_table

import armctl

ARMS = ("panda", "ur5e", "xarm7")
BALL_M = 0.025
NEAR_BALL_M = 0.05  # what is nearer to it is the ball
REACHED_M = 0.01
GRID_M = 0.01
PLANS = 20
FLOOR_M = -0.03
ROOM_M = 0.02  # around the arm at home, and between the ball and the obstacles
CAMERAS = {"above": (0.5, 0.0, 1.9), "right": (0.5, -1.5, 0.9), "left": (0.5, 1.5, 0.9)}
LOOKED_AT = np.array([0.45, 0.0, 0.3])


class Obstacle(NamedTuple):
    kind: str
    size: np.ndarray  # MuJoCo's
    place: np.ndarray


class Scene(NamedTuple):
    ball: np.ndarray
    obstacles: list[Obstacle]
    light: str


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scenes", type=int, default=102)
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=list(ARMS))
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "camera_scenes.md")
    args = parser.parse_args()
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    rows = []
    each_arm = args.scenes // len(args.arms)
    for number, name in enumerate(args.arms):
        counts: Counter[str] = Counter()
        errors = []
        for seed in range(number * each_arm, (number + 1) * each_arm):
            outcome, error = run(name, seed)
            counts[outcome] += 1
            errors += [error] if outcome == "reached" else []
            print(name, seed, outcome, f"{1e3 * error:.1f} mm", flush=True)
        total = sum(counts.values())
        counted = [counts[each] for each in ("reached", "refused truly", "refused", "missed", "touched")]
        rows.append([name, total, *counted, f"{1e3 * max(errors, default=np.nan):.1f}"])
    header = [
        "arm",
        "scenes",
        "reached",
        "refused truly",
        "refused though a way keeps 20 mm",
        "missed",
        "touched",
        "largest error, mm",
    ]
    text = titled_table("A green ball, three obstacles and three cameras", header, rows)
    text += f"\n\nReached: within {1e3 * REACHED_M:g} mm of the ball's middle. Load average {os.getloadavg()[1]:.1f}.\n"
    args.out.parent.mkdir(exist_ok=True)
    args.out.write_text(text, encoding="utf-8")
    print(text)


def run(name: str, seed: int) -> tuple[str, float]:
    """What becomes of a scene, and how far from the ball the tip ends, m."""
    arm = armctl.load(name)
    scene = drawn(arm, np.random.default_rng(seed))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "seen.xml"
        file.write_text(mjcf(scene), encoding="utf-8")
        sim = armctl.Simulation(armctl.load(name, scene=file))
    green = []
    seen = []
    for camera in CAMERAS:
        image = sim.camera(f"seen/{camera}")
        red, green_part, blue = image.colour[image.is_seen].astype(float).T
        is_green = green_part > 3.0 * np.maximum(red, blue)
        green.append(image.points[is_green])
        seen.append(image.points[~is_green])
    surface = np.concatenate(green)
    if not len(surface):
        return "refused truly" if is_hidden(sim, scene.ball) else "refused", np.nan
    goal = 0.5 * (surface.min(axis=0) + surface.max(axis=0))
    points = armctl.robot_filter(arm, sim.state.q, np.concatenate(seen))
    points = points[(points[:, 2] > FLOOR_M) & (np.linalg.norm(points - goal, axis=1) > NEAR_BALL_M)]
    world = armctl.World().add("seen", armctl.Points.on_grid(points, GRID_M))
    try:
        motion = armctl.move_free(arm, sim.state.q, armctl.Target.read(goal), world=world)
    except armctl.PlanError as refusal:
        print(name, seed, refusal)
        return "refused" if has_a_way(sim, scene.ball) else "refused truly", np.nan
    log = sim.run(motion)
    error = float(np.linalg.norm(sim.tip.position - scene.ball))
    if log.contacts:
        return "touched", error
    return "reached" if error < REACHED_M else "missed", error


def drawn(arm: armctl.Arm, rng: np.random.Generator) -> Scene:
    """A ball that the arm alone can reach, and obstacles that are neither at the arm nor at the ball."""
    while True:
        turn = rng.uniform(-0.9, 0.9)
        radius = rng.uniform(0.4, 0.65)
        ball = np.array([radius * np.cos(turn), radius * np.sin(turn), rng.uniform(0.1, 0.6)])
        if armctl.solve_ik(arm, ball, avoid=True).ok:
            break
    obstacles: list[Obstacle] = []
    while len(obstacles) < 3:
        kind = str(rng.choice(["box", "sphere", "cylinder"]))
        size = rng.uniform(0.04, 0.1, 3)
        turn = rng.uniform(-1.2, 1.2)
        radius = rng.uniform(0.3, 0.8)
        place = np.array([radius * np.cos(turn), radius * np.sin(turn), rng.uniform(0.05, 0.7)])
        reach = np.linalg.norm(size) if kind == "box" else size[0] if kind == "sphere" else np.linalg.norm(size[:2])
        beside = armctl.World().add("obstacle", armctl.Ball(float(reach)), place)
        at_home = armctl.check_clearance(arm, armctl.move_j(arm, arm.home, arm.home), ROOM_M, world=beside)
        if at_home.ok and np.linalg.norm(place - ball) > reach + NEAR_BALL_M + ROOM_M:
            obstacles.append(Obstacle(kind, size, place))
    strength = rng.uniform(0.3, 1.0)
    direction = np.array([*rng.uniform(-0.7, 0.7, 2), -1.0])
    light = f'<light directional="true" dir="{numbers(direction)}" diffuse="{numbers(np.full(3, strength))}"/>'
    return Scene(ball, obstacles, light)


def mjcf(scene: Scene) -> str:
    geoms = "".join(
        f'<body name="obstacle{k}" pos="{numbers(each.place)}">'
        f'<geom type="{each.kind}" size="{numbers(each.size)}" rgba="0.7 0.3 0.3 1"/></body>'
        for k, each in enumerate(scene.obstacles)
    )
    cameras = "".join(camera(name, np.array(place)) for name, place in CAMERAS.items())
    ball = (
        f'<body name="green" pos="{numbers(scene.ball)}"><geom name="green" type="sphere" size="{BALL_M}" rgba="0.1 0.8 0.1 1" '
        'contype="0" conaffinity="0" group="0"/></body>'
    )
    return f'<mujoco model="seen"><worldbody>{scene.light}{geoms}{ball}{cameras}</worldbody></mujoco>'


def camera(name: str, place: np.ndarray) -> str:
    """A camera that looks at the middle of the scene."""
    back = place - LOOKED_AT
    back /= np.linalg.norm(back)
    across = np.cross([0.0, 0.0, 1.0], back) if abs(back[2]) < 0.95 else np.array([0.0, -1.0, 0.0])
    across /= np.linalg.norm(across)
    return (
        f'<camera name="{name}" pos="{numbers(place)}" xyaxes="{numbers(across)} {numbers(np.cross(back, across))}" fovy="55"/>'
    )


def numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def is_hidden(sim: armctl.Simulation, ball: np.ndarray) -> bool:
    """Whether something is before the middle of the ball for each camera."""
    geom = np.zeros(1, np.int32)
    own = sim.model.geom("seen/green").id
    for place in CAMERAS.values():
        way = ball - np.array(place)
        mujoco.mj_ray(sim.model, sim.data, np.array(place), way / np.linalg.norm(way), None, 1, -1, geom, None)
        if geom[0] == own:
            return False
    return True


def has_a_way(sim: armctl.Simulation, ball: np.ndarray) -> bool:
    """Whether one of some plans among the obstacles themselves keeps two spacings of the points from them, its end included."""
    for seed in range(PLANS):
        with contextlib.suppress(armctl.PlanError):
            motion = armctl.move_free(sim.arm, sim.state.q, armctl.Target.read(ball), clearance=2.0 * GRID_M, seed=seed)
            if armctl.check_clearance(sim.arm, motion, 2.0 * GRID_M).ok:
                return True
    return False


if __name__ == "__main__":
    main()
