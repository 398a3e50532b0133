"""A peg of 20 mm goes into a hole of 20.1 mm from 1 mm beside it and tilted by 0.5 degrees: how often, how fast, how hard.

    python benchmarks/insertion.py [--arms desk_arm ur5e ...] [--seeds 20] [--out benchmarks/results/insertion.md]

The peg leans by 1.4 degrees, so that its lower edge dips into the hole although the hole is 1 mm from where it is expected. It
slides with this edge ahead until it drops, stands up, and sinks; after Bruyninckx, Dutre, De Schutter, "Peg-on-hole: a model
based solution to peg and hole alignment" (1995). If it wedges, or a step lasts too long, the peg is twisted off and tries
again from another side. All of this is hybrid force control with a flange sensor that has noise and a
delay of 4 ms. The direction of the offset, the direction of the tilt and the noise differ from seed to seed. Depth, forces and
penetration are MuJoCo's own.
"""

from __future__ import annotations

import argparse
import itertools
import warnings
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import pinocchio as pin
from markdown_table import titled_table

import armctl

RADIUS_M = 0.01  # of the peg
GAP_M = 5e-5  # on each side
DEPTH_M = 0.02  # of the hole
SIDES = 12  # flat faces around the hole
OFFSET_M = 1e-3
TILT_RAD = np.deg2rad(0.5)
FRICTION = 0.2  # as of oiled steel
# Where a leaning peg touches both walls above a depth of FRICTION times its diameter, it wedges: friction then holds any force
# (Whitney, "Quasi-static assembly of compliantly supported rigid parts", 1982). So it stands up as soon as it drops.
LEAN_RAD = 0.08
AIM_M = -0.004  # along the direction of sliding, the lower edge ahead
DIRECTIONS = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))  # x and y, in which the peg slides: one for each attempt
SIDE_RATIO = 0.35  # of the pressing force, to the side: friction, the slope of the edge, and a little more
START_HEIGHT_M = 0.002
# The pressing force accelerates the free tip at this rate, so a light arm and a heavy one drop into the hole equally fast.
PRESSING_ACCELERATION_M_S2 = 2.0
APPROACH_SPEED_M_S = 0.015
SINKING_RATIO = 0.5  # of the pressing force
CONTACT_RATIO = 0.15  # of the pressing force, that counts as a contact
DROP_M = 1e-3  # below the height at which the peg touched: it is in the hole
SETTLING_S = 0.15
LANDING_LIMIT_S = 2.0
PATIENCE = 5  # times as long as at the speed of the approach: then the attempt has failed
SLIDING_LIMIT_S = PATIENCE * (OFFSET_M - AIM_M) / APPROACH_SPEED_M_S
SINKING_LIMIT_S = PATIENCE * DEPTH_M / APPROACH_SPEED_M_S
WEDGED_RAD = LEAN_RAD / 2  # that the peg still leans after it was to stand up
LIFT_M = 0.01  # after an attempt that failed: enough to move over the next start before the peg lands
TWISTS_RAD = 0.1 * np.array([1.0, -1.0] * 6)  # while it lifts: 1 mm at the edge, much more than contacts yield
INSERTED_M = 0.0199  # from this depth on
PENETRATION_BOUND_M = GAP_M
TICK_S = 0.001
# In one tick of 1 ms a light wrist moves the peg by more than the gap before a contact is found. So the plant makes steps of at
# most 0.2 ms. The contacts are about as hard as these steps permit, and an impedance of 0.999 makes them sink in by less than
# 1 um at rest.
SOLREF_S = 0.0005
SENSORS = {"encoder_noise": 1e-5, "force_noise": 0.2, "moment_noise": 0.005, "wrench_delay": 4}
ARMS = ["desk_arm", "ur5e", "panda/panda_nohand", "xarm7/xarm7_nohand", "iiwa14", "gen3"]
HOLES = {"desk_arm": [0.35, 0.0, 0.1]}
ELSEWHERE = [0.45, 0.0, 0.2]
FILES = {"desk_arm": Path(__file__).parents[1] / "examples" / "models" / "desk_arm.urdf"}
PEG = f"""
<mujoco model="peg"><option cone="elliptic"/><worldbody><body name="peg">
  <geom name="peg" type="cylinder" size="{RADIUS_M} 0.03" pos="0 0 0.03" mass="0.1" priority="1"
        friction="{FRICTION} 0.005 0.0001" solref="{SOLREF_S} 1" solimp="0.999 0.999 0.001"/>
  <site name="tip" pos="0 0 0.06"/>
</body></worldbody></mujoco>"""


class Insertion(NamedTuple):
    """How an insertion went: N, s, m, m, rad, N, N, m and 1; the squeeze is the sum of the magnitudes of all contact forces."""

    pressing_force: float
    time: float
    depth: float
    beside: float
    tilt: float
    peak_force: float
    peak_squeeze: float
    peak_penetration: float
    attempts: int

    @property
    def ok(self) -> bool:
        return self.depth > INSERTED_M and self.beside < 2 * GAP_M


def hole(center: np.ndarray) -> armctl.World:
    """A blind hole that opens upwards, of flat faces at a distance of RADIUS_M + GAP_M from its axis."""
    scene = armctl.World().add("bottom", armctl.Box([0.06, 0.06, 0.02]), center - [0.0, 0.0, DEPTH_M + 0.01])
    for k, angle in enumerate(2 * np.pi * np.arange(SIDES) / SIDES):
        outward = np.array([np.cos(angle), np.sin(angle), 0.0])
        at = center + (RADIUS_M + GAP_M + 0.01) * outward - [0.0, 0.0, 0.5 * DEPTH_M]
        scene.add(
            f"side {k}", armctl.Box([0.02, 0.06 * np.tan(np.pi / SIDES), DEPTH_M]), armctl.Pose(at, rpy=[0.0, 0.0, angle])
        )
    return scene


def arm_with_peg(robot: str | Path, center: np.ndarray) -> armctl.Arm:
    """An arm that holds a peg, and a hole."""
    arm = armctl.load(robot, tool=mujoco.MjSpec.from_string(PEG), scene=hole(center))
    arm.model.opt.ccd_tolerance = 1e-9  # m. At the default of 1e-6, a cylinder that just touches gets depths of 0.1 mm.
    return arm


class Penetration:
    """The deepest penetration, m, of all steps of MuJoCo while it is open: a tick has several."""

    def __init__(self) -> None:
        self.deepest = 0.0

    def __enter__(self) -> Penetration:
        mujoco.set_mjcb_control(self._look)
        return self

    def __exit__(self, *error: object) -> None:
        mujoco.set_mjcb_control(None)

    def _look(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        if data.ncon:
            self.deepest = max(self.deepest, -float(data.contact.dist.min()))


class Run:
    """A simulation, tick by tick, and the largest contact forces at its ticks, N: on the peg, and of all contacts."""

    def __init__(self, arm: armctl.Arm, controller: armctl.HybridForce, start: np.ndarray, plant: armctl.Plant):
        self.simulation = armctl.Simulation(arm, controller, plant)
        self.simulation.reset(start)
        self.controller = controller
        self.measured = self.simulation.measured_state
        self.reference = start
        self.peaks = np.zeros(2)

    @property
    def tip(self) -> armctl.Pose:
        """As the encoders measure it."""
        return self.simulation.arm.fk(self.measured.q)

    @property
    def lag(self) -> float:
        """rad, between the reference and the tip."""
        return float(np.linalg.norm(pin.log3(self.tip.rotation.T @ self.simulation.arm.fk(self.reference).rotation)))

    def follow(self, motion: armctl.Trajectory, limit: float, done: Callable[[], bool] = lambda: False) -> None:
        """Follows a motion and waits at its end, until it is done or the limit, s."""
        for k in range(round(limit / TICK_S)):
            if done():
                return
            setpoint = motion(min(k * TICK_S, motion.duration))
            self.reference = setpoint.q
            self.simulation.step(self.controller.torque(self.measured, setpoint))
            self.measured = self.simulation.measured_state
            np.maximum(self.peaks, contact_forces(self.simulation), out=self.peaks)


def insert(arm: armctl.Arm, center: np.ndarray, seed: int, offset: float = OFFSET_M, continuous: bool = True) -> Insertion:
    """Inserts the peg of an arm. Unless the plant is continuous, it makes one step a tick: faster, with deeper penetrations."""
    offset_angle, tilt_angle = np.random.default_rng(seed).uniform(0.0, 2 * np.pi, 2)
    tilt = pin.exp3(TILT_RAD * np.array([np.cos(tilt_angle), np.sin(tilt_angle), 0.0]))
    rotation = tilt @ armctl.Pose(center, rpy=[0.0, np.pi, 0.0]).rotation
    expected = center + offset * np.array([np.cos(offset_angle), np.sin(offset_angle), 0.0])
    start = solved(arm, leaning(expected, rotation, DIRECTIONS[0]), arm.home)

    J = arm.jacobian(start)[2]
    force = PRESSING_ACCELERATION_M_S2 / float(J @ np.linalg.solve(arm.mass_matrix(start), J))
    controller = armctl.HybridForce(arm, {"z": -force}, approach_speed=APPROACH_SPEED_M_S, contact_force=CONTACT_RATIO * force)
    run = Run(arm, controller, start, armctl.Plant(timestep=TICK_S, continuous=continuous, seed=seed, **SENSORS))
    with Penetration() as penetration:
        attempts = attempt_from_all_sides(run, center, rotation, expected, force)
        time = run.simulation.state.t
        stay = armctl.move_j(arm, run.reference, run.reference)
        run.follow(stay, SETTLING_S)
    tip = run.simulation.tip
    return Insertion(
        pressing_force=force,
        time=time,
        depth=float(center[2] - tip.position[2]),
        beside=float(np.linalg.norm((center - tip.position)[:2])),
        tilt=float(np.arccos(np.clip(-tip.rotation[2, 2], -1.0, 1.0))),
        peak_force=float(run.peaks[0]),
        peak_squeeze=float(run.peaks[1]),
        peak_penetration=penetration.deepest,
        attempts=attempts,
    )


def attempt_from_all_sides(run: Run, center: np.ndarray, rotation: np.ndarray, expected: np.ndarray, force: float) -> int:
    """Attempts it from one side after the other; the number of attempts."""
    arm = run.simulation.arm
    start = run.reference
    approach = armctl.move_j(arm, start, start)
    attempts = 1
    while not attempt(run, approach, center, rotation, force, DIRECTIONS[attempts - 1]) and attempts < len(DIRECTIONS):
        lift(run, center, force)
        # From the first start, so that the wrist stays on its branch.
        above = solved(arm, leaning(expected, rotation, DIRECTIONS[attempts]), start)
        approach = armctl.move_j(arm, run.measured.q, above)
        attempts += 1
    return attempts


def leaning(expected: np.ndarray, rotation: np.ndarray, ahead: tuple[float, float]) -> armctl.Pose:
    """Above the surface, with the lower edge ahead."""
    lean = pin.exp3(LEAN_RAD * np.array([-ahead[1], ahead[0], 0.0]))
    above = np.array([AIM_M * ahead[0], AIM_M * ahead[1], START_HEIGHT_M])
    return armctl.Pose.from_rotation(expected + above, lean @ rotation)


def attempt(
    run: Run, approach: armctl.Trajectory, center: np.ndarray, rotation: np.ndarray, force: float, ahead: tuple[float, float]
) -> bool:
    """Lands, slides until the peg drops, stands it up, and sinks it; whether it is at the bottom."""
    arm = run.simulation.arm
    controller = run.controller
    controller.force = {"z": -force}
    run.follow(approach, LANDING_LIMIT_S, lambda: controller.in_contact)
    stay = armctl.move_j(arm, run.reference, run.reference)
    run.follow(stay, SETTLING_S)
    touched = run.tip.position[2]
    controller.force = {"x": SIDE_RATIO * force * ahead[0], "y": SIDE_RATIO * force * ahead[1], "z": -force}
    run.follow(stay, SLIDING_LIMIT_S, lambda: run.tip.position[2] < touched - DROP_M)
    if run.tip.position[2] >= touched - DROP_M:
        return False
    upright = armctl.Pose.from_rotation(run.tip.position, rotation)
    stand = armctl.move_j(arm, run.measured.q, solved(arm, upright, run.measured.q)).scaled(0.2)
    controller.force = {"x": 0.0, "y": 0.0}
    run.follow(stand, stand.duration + SETTLING_S, lambda: run.tip.position[2] > touched)
    if run.tip.position[2] > touched or run.lag > WEDGED_RAD:
        return False
    controller.force = {"x": 0.0, "y": 0.0, "z": -SINKING_RATIO * force, "rx": 0.0, "ry": 0.0}
    run.follow(stand, SINKING_LIMIT_S, lambda: run.tip.position[2] < center[2] - INSERTED_M)
    return bool(run.tip.position[2] < center[2] - INSERTED_M)


def lift(run: Run, center: np.ndarray, force: float) -> None:
    """Pulls the peg off, yields to the walls, and turns it to and fro: a wall on which it slides around holds it no longer."""
    arm = run.simulation.arm
    tip = run.tip
    q = run.measured.q
    run.controller.force = {"x": 0.0, "y": 0.0, "z": force, "rx": 0.0, "ry": 0.0}
    for angle in TWISTS_RAD:
        turned = armctl.Pose.from_rotation(tip.position, tip.rotation @ pin.exp3(np.array([0.0, 0.0, angle])))
        turn = armctl.move_j(arm, q, solved(arm, turned, q))
        run.follow(turn, turn.duration + SETTLING_S, lambda: run.tip.position[2] > center[2] + LIFT_M)
        q = run.reference


def solved(arm: armctl.Arm, pose: armctl.Pose, start: np.ndarray) -> np.ndarray:
    solution = armctl.solve_ik(arm, pose, start, position_tolerance=1e-8, orientation_tolerance=1e-8)
    if not solution.ok:
        raise SystemExit(f"{arm.name}: {solution.reason}")
    return solution.q


def contact_forces(simulation: armctl.Simulation) -> np.ndarray:
    """N, now: the magnitude of the contact force on the peg, and the sum of the magnitudes at all points of contact."""
    data = simulation.data
    peg = simulation.model.geom("peg/peg").id
    net = np.zeros(3)
    total = 0.0
    wrench = np.zeros(6)
    for i, geoms in enumerate(data.contact.geom):
        mujoco.mj_contactForce(simulation.model, data, i, wrench)
        # From the first geom to the second.
        net += (1.0 if geoms[1] == peg else -1.0) * data.contact.frame[i].reshape(3, 3).T @ wrench[:3]
        total += float(np.linalg.norm(wrench[:3]))
    return np.array([np.linalg.norm(net), total])


def row(name: str, seeds: range) -> list[str]:
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    center = np.array(HOLES.get(name, ELSEWHERE))
    arm = arm_with_peg(FILES.get(name, name), center)
    runs = [insert(arm, center, seed) for seed in seeds]
    return [
        name,
        f"{sum(run.ok for run in runs)} of {len(runs)}",
        f"{max(run.attempts for run in runs)}",
        f"{np.median([run.pressing_force for run in runs]):.1f}",
        f"{np.median([run.time for run in runs]):.1f} ({max(run.time for run in runs):.1f})",
        f"{1e3 * min(run.depth for run in runs):.2f}",
        f"{np.rad2deg(max(run.tilt for run in runs)):.2f}",
        f"{max(run.peak_force for run in runs):.0f}",
        f"{max(run.peak_squeeze for run in runs):.0f}",
        f"{1e6 * max(run.peak_penetration for run in runs):.0f}",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--arms", nargs="+", default=ARMS)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=1000)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "insertion.md")
    args = parser.parse_args()
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    with ProcessPoolExecutor() as processes:
        rows = list(processes.map(row, args.arms, itertools.repeat(seeds)))
    columns = [
        "arm",
        "in the hole",
        "attempts, at most",
        "pressing force, N",
        "time, s: median (worst)",
        "smallest depth, mm (19.9)",
        "largest tilt, deg",
        "peak force on the peg, N",
        "sum of all contact forces, N",
        f"deepest penetration, um ({1e6 * PENETRATION_BOUND_M:.0f})",
    ]
    title = "A 20 mm peg into a hole of 20.1 mm x 20 mm, from 1 mm beside it, tilted by 0.5 degrees (bounds in brackets)"
    text = titled_table(title, columns, rows) + "\n"
    args.out.parent.mkdir(exist_ok=True)
    args.out.write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
