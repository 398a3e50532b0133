"""Doors and cranks: an arm grasps a handle that has a joint, and moves it on its arc, with MuJoCo's contacts.

    python benchmarks/doors.py [--arms panda] [--cases 100] [--first 0] [--tip-speed 0.06] [--out FILE]

Hinge, radius, friction and angle of each case are random, drawn again while the arm cannot reach each pose of the arc, or
stands in the door at home; a crank turns once around. The arc is planned first, which tells how the hand must come. A case is
done if the hinge is where it was asked to be, and the tip stays as far from its axis as it was when the hand closed, to 1 mm. A
fast tip cannot follow the handle so well: `--tip-speed 0.15`.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from markdown_table import titled_table

import armctl

ON_ARC_M = 1e-3
HINGE_RAD = 0.02
GRIP_N = 60.0
BEFORE = armctl.Pose([0.0, 0.0, -0.08])  # of the handle, where the hand comes from
STEPS = 100  # poses of an arc
FORWARD = [0.0, 0.5 * np.pi, 0.0]  # roll, pitch, yaw of a hand that points away from the robot
COMPILER = '<compiler angle="radian"/>'
KINDS = ("door", "crank")


class Case(NamedTuple):
    text: str  # MJCF of what turns
    handle: armctl.Pose  # of the tip that holds it
    axis: list[float]
    angle: float  # rad
    play: list[float]  # rad, by which the hand may roll, pitch and yaw in the handle
    hinge: armctl.Pose

    def arc(self, tip: armctl.Pose, steps: int) -> list[armctl.Region]:
        """The regions through which a tip goes that holds the handle."""
        bounds = np.outer([0.0, 0.0, 0.0, *self.play], [-1.0, 1.0])
        turns = np.linspace(0.0, self.angle, steps)
        return [armctl.Region(tip.turned_about(self.hinge.position, self.axis, turn), bounds) for turn in turns]


class Outcome(NamedTuple):
    is_done: bool
    off_arc: float  # m; NaN if the hand did not move
    off_angle: float  # rad
    reason: str
    seconds: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", nargs="+", default=["panda"])
    parser.add_argument("--cases", type=int, default=100, help="doors, and as many cranks, of each arm")
    parser.add_argument("--first", type=int, default=0, help="the number of the first case")
    parser.add_argument("--tip-speed", type=float, default=0.06, help="m/s (default %(default)s)")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "doors.md")
    args = parser.parse_args()
    rows, reasons = [], []
    for robot in args.arms:
        alone = armctl.load(robot)
        for kind in KINDS:
            outcomes = []
            for number in range(args.first, args.first + args.cases):
                outcome = _run(*_possible(robot, alone, kind, number), args.tip_speed)
                outcomes.append(outcome)
                print(f"{robot} {kind} {number}: {outcome}", flush=True)
                if not outcome.is_done:
                    reasons.append(f"- {robot}, {kind} {number}: {outcome.reason}")
            rows.append(
                [
                    robot,
                    f"{kind}s",
                    str(len(outcomes)),
                    str(sum(outcome.is_done for outcome in outcomes)),
                    f"{1e3 * np.nanmax([outcome.off_arc for outcome in outcomes]):.2f}",
                    f"{np.median([outcome.seconds for outcome in outcomes]):.1f}",
                ]
            )
    columns = ["arm", "kind", "cases", "done", "off the arc at most, mm", "median s"]
    table = titled_table("Doors and cranks that a hand turns", columns, rows)
    load = f"The tip at {args.tip_speed:g} m/s. Wall time with the simulation; load average {os.getloadavg()[1]:.1f}."
    text = "\n\n".join([table, load, "\n".join(reasons)]).rstrip() + "\n"
    args.out.parent.mkdir(exist_ok=True)
    args.out.write_text(text, encoding="utf-8")
    print(text)


def _possible(robot: str, alone: armctl.Arm, kind: str, number: int) -> tuple[armctl.Arm, Case]:
    """The first random case whose arc an arm can reach, and which leaves it room at home; the arm in it, and the case."""
    rng = np.random.default_rng([KINDS.index(kind), number])
    while True:
        case = _case(kind, rng)
        ways = [case.handle, case.handle @ BEFORE, *case.arc(case.handle, STEPS)]
        if not all(armctl.solve_ik(alone, target) for target in ways):
            continue
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "scene.xml"
            file.write_text(case.text, encoding="utf-8")
            arm = armctl.load(robot, scene=file)
        with contextlib.suppress(armctl.PlanError):
            armctl.move_free(arm, arm.home, arm.home)
            return arm, case


def _case(kind: str, rng: np.random.Generator) -> Case:
    damping, friction = rng.uniform([0.5, 0.1], [3.0, 0.8]) if kind == "door" else rng.uniform([0.05, 0.02], [0.3, 0.15])
    joint = f'damping="{damping}" frictionloss="{friction}"'
    if kind == "door":
        radius = rng.uniform(0.25, 0.38)
        hinge = rng.uniform([0.7, 0.22, 0.35], [0.78, 0.34, 0.6])
        out = -0.075  # m, from the leaf to the handle
        mounts = "".join(
            f'<geom type="capsule" fromto="{out} {-radius} {z} 0 {-radius} {z}" size="0.008" mass="0.05"/>'
            for z in (-0.05, 0.05)
        )
        text = f"""<mujoco>{COMPILER}<worldbody><body name="door" pos="{hinge[0]} {hinge[1]} {hinge[2]}">
        <joint name="hinge" axis="0 0 1" range="-1.9 0.1" {joint}/>
        <geom type="box" size="0.015 {0.5 * radius + 0.02} 0.2" pos="0 {-0.5 * radius - 0.02} 0" mass="{rng.uniform(1, 6)}"/>
        <geom name="handle" type="capsule" size="0.012" fromto="{out} {-radius} -0.05 {out} {-radius} 0.05" mass="0.1"/>{mounts}
        </body></worldbody></mujoco>"""
        handle = armctl.Pose(hinge + np.array([out, -radius, 0.0]), rpy=FORWARD)
        return Case(text, handle, [0.0, 0.0, 1.0], -rng.uniform(0.5, 1.1), [0.5, 0.0, 0.0], armctl.Pose(hinge))
    radius = rng.uniform(0.06, 0.14)
    hinge = rng.uniform([0.6, -0.15, 0.45], [0.72, 0.15, 0.65])
    text = f"""<mujoco>{COMPILER}<worldbody><body name="crank" pos="{hinge[0]} {hinge[1]} {hinge[2]}">
    <joint name="hinge" axis="1 0 0" {joint}/>
    <geom type="capsule" size="0.01" fromto="0 0 0 0 0 {-radius}" mass="0.3"/>
    <geom name="handle" type="capsule" size="0.012" fromto="0 0 {-radius} -0.08 0 {-radius}" mass="0.1"/>
    </body></worldbody></mujoco>"""
    handle = armctl.Pose(hinge + np.array([-0.065, 0.0, -radius]), rpy=FORWARD)
    return Case(text, handle, [1.0, 0.0, 0.0], rng.choice([-1.0, 1.0]) * 2.0 * np.pi, [0.0, 0.0, np.inf], armctl.Pose(hinge))


def _run(arm: armctl.Arm, case: Case, tip_speed: float) -> Outcome:
    begin = time.perf_counter()
    sim = armctl.Simulation(arm, "computed-torque-observer")
    reason, log = _turned(sim, case, tip_speed)
    off_angle = abs(float(sim.data.joint("hinge").qpos[0]) - case.angle)
    off_arc = np.nan
    if log is not None:
        away = log.tip - sim.data.joint("hinge").xanchor
        off_arc = float(np.ptp(np.linalg.norm(away - np.outer(away @ case.axis, case.axis), axis=1)))
        if not reason and (off_arc > ON_ARC_M or off_angle > HINGE_RAD):
            reason = f"{1e3 * off_arc:.2f} mm off the arc, {off_angle:.3f} rad off the angle"
    return Outcome(not reason, off_arc, off_angle, reason, time.perf_counter() - begin)


def _start(arm: armctl.Arm, case: Case, touching: list[tuple[str, str]]) -> np.ndarray | None:
    """How the arm grasps the handle: as is next to its home, or any way, from which it can go through the whole arc."""
    arc = armctl.Region.union(case.arc(case.handle, STEPS))
    for q in (armctl.solve_ik(arm, case.handle).q, None):
        with contextlib.suppress(armctl.PlanError):
            turn = armctl.move_path(arm, q, arc)
            if armctl.check_clearance(arm, turn, allow=touching):
                return turn(0.0).q
    return None


def _turned(sim: armctl.Simulation, case: Case, tip_speed: float) -> tuple[str, armctl.Log | None]:
    """Why the hand has not turned the handle, empty if it has, and the log of the turn."""
    bodies = {sim.model.body(k).name for k in range(1, sim.model.nbody)}
    turning = bodies.intersection(KINDS).pop()
    touching = [(body, "handle") for body in bodies - {turning}]
    sim.gripper.open()
    q = _start(sim.arm, case, [*touching, *((body, turning) for body in bodies - {turning})])
    if q is None:
        return "no motion through the whole arc was found", None
    handle = sim.arm.fk(q)
    before = armctl.solve_ik(sim.arm, handle @ BEFORE, q)
    if not before:
        return before.reason, None
    for move in (
        lambda: sim.move_j(before.q),
        lambda: sim.move_l(handle, allow=touching),
    ):
        if not (reached := move()):
            return reached.reason, None
    grip = sim.gripper.grasp(min(GRIP_N, sim.gripper.model.force_max))
    if not grip.grasped:
        return f"not grasped: {grip}", None
    held = armctl.Pose(sim.tip.position, case.handle.quat)
    turned = sim.move_path(armctl.Region.union(case.arc(held, STEPS)), tip_speed=tip_speed, avoid=False)
    return turned.reason, turned.log


if __name__ == "__main__":
    main()
