"""Tasks: pick and place of ten shapes by arms with grippers, among obstacles.

    python benchmarks/tasks.py [--arms panda xarm7 ur5e] [--cases 34] [--first 0] [--out FILE]

Each case is a table with a body and three boxes at random places; the arm picks the body and puts it down at another place. The
boxes are loose: one that has moved was touched, by the arm or by the body. Contacts of the arm are those of the logs of all
moves, and at the end of each call. Every row of the table can be run alone, and so can every case with `--first K --cases 1`.
"""

from __future__ import annotations

import argparse
import os
import time
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
from markdown_table import titled_table

import armctl

ARMS = {"panda": {}, "xarm7": {}, "ur5e": {"tool": "robotiq_2f85"}}
TOP_M = 0.2
TABLE = (armctl.Box([0.5, 1.0, TOP_M]), [0.6, 0.0, 0.5 * TOP_M])
PLACES = ([0.42, -0.35], [0.65, 0.35])  # m, the corners of where things stand
BOXES = 3
ROOM_M = 0.13  # between the middles of things
MOVED_M = 1e-3  # a box that has moved by more was touched
ROLLS_M = 0.05  # how far a ball may roll from its place
TOLERANCE_M = 5e-3


def _prism(corners: int, radius: float, half: float) -> armctl.Mesh:
    angles = 2.0 * np.pi / corners * np.arange(corners)
    ring = radius * np.column_stack([np.cos(angles), np.sin(angles)])
    return armctl.Mesh([[*point, z] for point in ring for z in (-half, half)])


def _frustum(below: float, above: float, half: float) -> armctl.Mesh:
    levels = ((-half, below), (half, above))
    return armctl.Mesh([[x, y, z] for z, r in levels for x in (-r, r) for y in (-r, r)])


class Thing(NamedTuple):
    shape: armctl.Box | armctl.Ball | armctl.Cylinder | armctl.Mesh
    half: float  # m, half its height


THINGS = {
    "cube": Thing(armctl.Box([0.04, 0.04, 0.04]), 0.02),
    "brick": Thing(armctl.Box([0.11, 0.05, 0.06]), 0.03),
    "plate": Thing(armctl.Box([0.1, 0.065, 0.02]), 0.01),
    "tower": Thing(armctl.Box([0.05, 0.05, 0.16]), 0.08),
    "can": Thing(armctl.Cylinder(0.033, 0.115), 0.0575),
    "tin": Thing(armctl.Cylinder(0.03, 0.04), 0.02),
    "ball": Thing(armctl.Ball(0.025), 0.025),
    "hexagon": Thing(_prism(6, 0.03, 0.025), 0.025),
    "frustum": Thing(_frustum(0.025, 0.015, 0.03), 0.03),
    "wedge": Thing(_frustum(0.03, 0.026, 0.05), 0.05),
}


class Case(NamedTuple):
    name: str  # of the thing
    scene: armctl.World
    goal: armctl.Pose
    boxes: dict[str, np.ndarray]  # where each stands


class Outcome(NamedTuple):
    held: bool
    placed: bool
    foreign: list[str]  # contacts of anything but the fingers and the body, and boxes that have moved
    reason: str
    seconds: float  # wall time of both calls


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=list(ARMS))
    parser.add_argument("--cases", type=int, default=34, help="of each arm")
    parser.add_argument("--first", type=int, default=0, help="the number of the first case")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "tasks.md")
    args = parser.parse_args()
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    rows = []
    reasons = []
    for arm in args.arms:
        outcomes = []
        alone = armctl.load(arm, **ARMS[arm])
        tip = alone.fk(alone.home).position[:2]
        for number in range(args.first, args.first + args.cases):
            case = _case(number, tip)
            outcome = _run(arm, case)
            outcomes.append(outcome)
            if outcome.reason or outcome.foreign:
                reasons.append(f"- {arm}, case {number}, {case.name}: {outcome.reason or 'placed'}; {outcome.foreign}")
            print(arm, number, case.name, outcome, flush=True)
        rows.append(
            [
                arm,
                str(len(outcomes)),
                str(sum(each.held for each in outcomes)),
                str(sum(each.placed for each in outcomes)),
                str(sum(len(each.foreign) for each in outcomes)),
                f"{np.median([each.seconds for each in outcomes]):.1f}",
            ]
        )
    columns = ["arm", "cases", "held", "placed", "foreign contacts", "median s"]
    table = titled_table("Pick and place of ten shapes among obstacles", columns, rows)
    load = f"Wall time of both calls with the simulation; load average {os.getloadavg()[1]:.1f}."
    text = "\n\n".join([table, load, "\n".join(reasons)]).rstrip() + "\n"
    args.out.parent.mkdir(exist_ok=True)
    args.out.write_text(text, encoding="utf-8")
    print(text)


def _case(number: int, tip: np.ndarray) -> Case:
    """A table on which a thing, its goal and the boxes have room, also beside the tip (2,) m of the arm at home."""
    rng = np.random.default_rng(number)
    name = list(THINGS)[number % len(THINGS)]
    thing = THINGS[name]
    places: list[np.ndarray] = []
    while len(places) < BOXES + 2:
        place = rng.uniform(*PLACES)
        if all(np.linalg.norm(place - other) > ROOM_M for other in [tip, *places]):
            places.append(place)
    turns = rng.uniform(-np.pi, np.pi, len(places))
    height = TOP_M + thing.half
    start = armctl.Pose([*places[0], height], rpy=[0, 0, turns[0]])
    scene = armctl.World().add("table", *TABLE).add(name, thing.shape, start, mass=0.1)
    boxes = {}
    for k in range(BOXES):
        size = np.array([0.06, 0.06, rng.uniform(0.08, 0.2)])
        boxes[f"box{k}"] = np.array([*places[2 + k], TOP_M + 0.5 * size[2]])
        scene.add(f"box{k}", armctl.Box(size), armctl.Pose(boxes[f"box{k}"], rpy=[0, 0, turns[2 + k]]), mass=1.0)
    return Case(name, scene, armctl.Pose([*places[1], height], rpy=[0, 0, turns[1]]), boxes)


def _run(robot: str, case: Case) -> Outcome:
    sim = armctl.Simulation(armctl.load(robot, scene=case.scene, **ARMS[robot]))
    begin = time.perf_counter()
    tolerance = ROLLS_M if case.name == "ball" else TOLERANCE_M
    picked = sim.pick(case.name)
    foreign = _foreign(sim, case.name, picked)
    held = bool(picked) and sim.gripper.held == case.name
    placed = None
    if held:
        placed = sim.place(case.name, case.goal.position, tolerance=tolerance)
        foreign += _foreign(sim, case.name, placed)
    seconds = time.perf_counter() - begin
    moved = [name for name, at in case.boxes.items() if np.linalg.norm(sim.data.body(name).xpos - at) > MOVED_M]
    error = np.linalg.norm(sim.data.body(case.name).xpos - case.goal.position)
    reason = picked.reason or ("" if placed is None else placed.reason)
    return Outcome(held, bool(placed and error <= tolerance), [*foreign, *(f"{name} moved" for name in moved)], reason, seconds)


def _foreign(sim: armctl.Simulation, thing: str, result: armctl.PickResult | armctl.PlaceResult) -> list[str]:
    """Contacts of the arm with anything but the thing, and of the thing with anything of the arm but the fingers."""
    fingers = {sim.model.body(body).name for side in sim.gripper.model.jaws.sides for body in side}
    contacts = [(contact.body, contact.other) for move in result.moves for contact in move.contacts]
    return sorted({f"{body} - {other}" for body, other in contacts if other != thing or body not in fingers})


if __name__ == "__main__":
    main()
