"""A peg of 20 mm goes into a hole of 20.1 mm from 1 mm beside it and tilted by 0.5 degrees: how often, how fast, how hard.

    python benchmarks/insertion.py [--arms desk_arm ur5e ...] [--seeds 20] [--out benchmarks/results/insertion.md]

The strategy needs no force sensor. The arm presses with a soft spring, searches along a spiral of half circles whose pitch is
less than the gap on both sides, and lowers the stiffness when the tip drops; after Chhatpar, Branicky, "Search strategies for
peg-in-hole assemblies with position uncertainty" (2001), and Whitney, "Quasi-static assembly of compliantly supported rigid
parts" (1982). The direction of the offset, the direction of the tilt and the encoder noise differ from seed to seed. Depth,
forces and penetration are MuJoCo's own.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import pinocchio as pin

import armctl
from armctl.core.tables import Table
from armctl.core.trajectory import Setpoint

RADIUS_M = 0.01  # of the peg
GAP_M = 5e-5  # on each side
DEPTH_M = 0.02  # of the hole
SIDES = 12  # flat faces around the hole
OFFSET_M = 1e-3
TILT_RAD = np.deg2rad(0.5)
START_HEIGHT_M = 2e-4
SEARCH_MARGIN_M = 2e-4  # of the spiral's radius over the offset
PITCH_M = 8e-5  # between two turns of the spiral; the hole is found within 2 GAP_M
SEARCH_SPEED_M_S = 0.012
SEARCH_FORCE_N = 12.0
INSERTION_FORCE_N = 15.0
DROP_M = 5e-4  # below the height at which the peg touched: it is in the hole
INSERTED_M = 0.0199  # from this depth on
FORCE_BOUND_N = 200.0  # that no contact exceeds, impacts included
TICK_S = 0.001
SEARCH_STIFFNESS = [8000.0, 8000.0, 2000.0, 8.0, 8.0, 30.0]  # N/m and N m/rad
INSERTION_STIFFNESS = [100.0, 100.0, 10000.0, 5.0, 5.0, 30.0]
HOLES = {"desk_arm": [0.35, 0.0, 0.1]}
ELSEWHERE = [0.45, 0.0, 0.2]
FILES = {"desk_arm": Path(__file__).parents[1] / "examples" / "models" / "desk_arm.urdf"}
# An impedance of 0.999 makes the contact hard: at rest it sinks in by less than 1 um. Friction is 0.2, as of oiled steel.
PEG = f"""
<mujoco model="peg"><worldbody><body name="peg">
  <geom name="peg" type="cylinder" size="{RADIUS_M} 0.03" pos="0 0 0.03" mass="0.1" priority="1"
        friction="0.2 0.005 0.0001" solref="0.005 1" solimp="0.999 0.999 0.001"/>
  <site name="tip" pos="0 0 0.06"/>
</body></worldbody></mujoco>"""


class Insertion(NamedTuple):
    """How an insertion went: s, m, rad, N and m; `search_time` is None if the peg did not drop."""

    search_time: float | None
    insertion_time: float
    depth: float
    tilt: float
    peak_force: float
    peak_penetration: float

    @property
    def ok(self) -> bool:
        return self.search_time is not None and self.depth > INSERTED_M


def hole(center: np.ndarray) -> armctl.Scene:
    """A blind hole that opens upwards, of flat faces at a distance of RADIUS_M + GAP_M from its axis."""
    scene = armctl.Scene().add_box("bottom", [0.06, 0.06, 0.02], center - [0.0, 0.0, DEPTH_M + 0.01])
    for k, angle in enumerate(2 * np.pi * np.arange(SIDES) / SIDES):
        outward = np.array([np.cos(angle), np.sin(angle), 0.0])
        at = center + (RADIUS_M + GAP_M + 0.01) * outward - [0.0, 0.0, 0.5 * DEPTH_M]
        scene.add_box(f"side {k}", [0.02, 0.06 * np.tan(np.pi / SIDES), DEPTH_M], armctl.Pose(at, rpy=[0.0, 0.0, angle]))
    return scene


def arm_with_peg(robot: str | Path, center: np.ndarray) -> armctl.Arm:
    """An arm that holds a peg, and a hole."""
    arm = armctl.load(robot, tool=mujoco.MjSpec.from_string(PEG), scene=hole(center))
    arm.model.opt.ccd_tolerance = (
        1e-9  # m. At the default of 1e-6, MuJoCo reports depths of 0.1 mm where a cylinder just touches.
    )
    return arm


def spiral(start: armctl.Pose, pitch: float, radius: float) -> list[armctl.Arc]:
    """Half circles that grow by half a pitch each."""
    arcs = []
    x = 0.0
    for k in range(1, int(np.ceil(2 * radius / pitch)) + 1):
        x_next = -0.5 * k * pitch * (-1) ** k
        via = start.position + np.array([0.5 * (x + x_next), 0.5 * (x - x_next), 0.0])
        end = start.position + np.array([x_next, 0.0, 0.0])
        arcs.append(armctl.Arc(*(armctl.Pose.from_rotation(point, start.rotation) for point in (via, end))))
        x = x_next
    return arcs


def insert(arm: armctl.Arm, center: np.ndarray, seed: int, offset: float = OFFSET_M) -> Insertion:
    """Presses, searches and inserts, from beside the hole."""
    offset_angle, tilt_angle = np.random.default_rng(seed).uniform(0.0, 2 * np.pi, 2)
    tilt = pin.exp3(TILT_RAD * np.array([np.cos(tilt_angle), np.sin(tilt_angle), 0.0]))
    rotation = tilt @ armctl.Pose(center, rpy=[0.0, np.pi, 0.0]).rotation
    beside = center + offset * np.array([np.cos(offset_angle), np.sin(offset_angle), 0.0])
    start = solved(arm, armctl.Pose.from_rotation(beside + np.array([0.0, 0.0, START_HEIGHT_M]), rotation), arm.home)
    below = armctl.Pose.from_rotation(beside - [0.0, 0.0, DEPTH_M + 0.005], rotation)
    search = armctl.move_path(
        arm, solved(arm, below, start), spiral(below, PITCH_M, offset + SEARCH_MARGIN_M), tip_speed=SEARCH_SPEED_M_S
    )
    press = armctl.Impedance(arm, stiffness=SEARCH_STIFFNESS, error_max=[1, 1, SEARCH_FORCE_N / SEARCH_STIFFNESS[2], 1, 1, 1])
    sink = armctl.Impedance(
        arm, stiffness=INSERTION_STIFFNESS, error_max=[1, 1, INSERTION_FORCE_N / INSERTION_STIFFNESS[2], 1, 1, 1]
    )
    simulation = armctl.Simulation(arm, press, armctl.Plant(timestep=TICK_S, encoder_noise=1e-5, seed=seed))
    simulation.reset(start)
    peaks = np.zeros(2)

    def step(controller: armctl.Impedance, setpoint: Setpoint) -> float:
        """One tick; the measured height of the tip, m."""
        state = simulation.step(controller.torque(simulation.measured_state, setpoint))
        np.maximum(peaks, contact_peaks(simulation), out=peaks)
        return float(arm.fk(state.q).position[2])

    for _ in range(300):
        height = step(press, search(0.0))
    touched = height
    found = None
    for k in range(int(search.duration / TICK_S)):
        if step(press, search(k * TICK_S)) < touched - DROP_M:
            found = k * TICK_S
            break
    here = search(found or search.duration).q
    hold = Setpoint(here, 0 * here, 0 * here)
    took = 0
    while took < 2500 and center[2] - simulation.tip.position[2] < INSERTED_M:
        step(sink, hold)
        took += 1
    for _ in range(200):
        step(sink, hold)
    tip = simulation.tip
    angle = float(np.arccos(np.clip(-tip.rotation[2, 2], -1.0, 1.0)))
    return Insertion(found, took * TICK_S, float(center[2] - tip.position[2]), angle, *peaks)


def solved(arm: armctl.Arm, pose: armctl.Pose, start: np.ndarray) -> np.ndarray:
    solution = armctl.solve_ik(arm, pose, start, position_tolerance=1e-8, orientation_tolerance=1e-8)
    if not solution.ok:
        raise SystemExit(f"{arm.name}: {solution.reason}")
    return solution.q


def contact_peaks(simulation: armctl.Simulation) -> np.ndarray:
    """N, the sum of the contact forces on the peg, and m, the deepest penetration, now."""
    data = simulation.data
    total = np.zeros(3)
    deepest = 0.0
    wrench = np.zeros(6)
    for i in range(data.ncon):
        contact = data.contact[i]
        mujoco.mj_contactForce(simulation.model, data, i, wrench)
        on_first = simulation.model.geom(contact.geom1).name.endswith("peg")
        total += (-1.0 if on_first else 1.0) * contact.frame.reshape(3, 3).T @ wrench[:3]
        deepest = max(deepest, -contact.dist)
    return np.array([np.linalg.norm(total), deepest])


def row(name: str, seeds: int) -> list[str]:
    center = np.array(HOLES.get(name, ELSEWHERE))
    arm = arm_with_peg(FILES.get(name, name), center)
    runs = [insert(arm, center, seed) for seed in range(seeds)]
    inside = [run for run in runs if run.ok]
    searches = [run.search_time for run in inside]
    return [
        name,
        f"{len(inside)} of {seeds}",
        f"{np.median(searches):.1f} ({np.max(searches):.1f})" if inside else "",
        f"{np.median([run.insertion_time for run in runs]):.2f} ({max(run.insertion_time for run in runs):.2f})",
        f"{1e3 * min(run.depth for run in runs):.2f}",
        f"{np.rad2deg(max(run.tilt for run in runs)):.2f}",
        f"{max(run.peak_force for run in runs):.0f}",
        f"{1e6 * max(run.peak_penetration for run in runs):.0f}",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--arms", nargs="+", default=["desk_arm", "ur5e", "panda/panda_nohand"])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "insertion.md")
    args = parser.parse_args()
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    columns = [
        "arm",
        "in the hole",
        "search, s: median (worst)",
        "insertion, s: median (worst)",
        "smallest depth, mm (19.9)",
        "largest tilt, deg",
        f"peak force, N ({FORCE_BOUND_N:.0f})",
        "deepest penetration, um",
    ]
    text = (
        "**A 20 mm peg into a hole of 20.1 mm x 20 mm, from 1 mm beside it, tilted by 0.5 degrees (bounds in brackets)**\n\n"
        f"{Table(columns, [row(name, args.seeds) for name in args.arms]).markdown()}\n"
    )
    args.out.parent.mkdir(exist_ok=True)
    args.out.write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
