"""Laws as torques on a robot: are motions reached, ticks kept, bounds kept, and does the simulation tell the same?

    python benchmarks/torque_on_robot.py [--robots plant franky-sim] [--motions 30] [--out FILE]
    python benchmarks/torque_on_robot.py --robots plant --motions 3    # a minute

The robots are simulators in real time: a `PlantLink` to an arm with wrong masses and friction, whose maker limits the rate of
torques, and franky-sim, where it is installed. The first table: random motions of all joints under each law. "Lost" are ticks
of 10 000, "torque" and "rate" the greatest ones that were sent, as shares of the maker's bounds, and "tick" the time from a
reading until the torques are sent: 99 of 100 take less. The second table: `compare_on_robot` with one motion, whose RMS errors
are of the joints; "model" are the laws with the model that was loaded, "identified" with the arm that a run of the robot
tells. The simulation is that of the identified arm. A law that the robot cannot bear is tuned for a delay of two ticks; such
a one keeps the model that was loaded.

Times and lost ticks are those of a quiet machine only: the load is printed with the tables, and how many ticks a bare loop of
sleeps loses there, which computes nothing. On a busy machine `--no-real-time` lets the time of the PlantLink pass as fast as it
is computed: no tick is lost then.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from markdown_table import titled_table
from timed_links import TickTimes, TimedFranka, TimedPlantLink

import armctl

LAWS = ("pd-gravity", "pd-feedforward", "computed-torque", "computed-torque-observer", "impedance")
RESULTS = Path(__file__).parent / "results" / "torque_on_robot.md"
SERVER = Path(__file__).parents[1] / "tests" / "helpers" / "franky_server.py"
HAND = SERVER.parents[2] / "examples" / "franka_hand.xml"  # of franky-sim, which has one
ADDRESS = "127.0.9.3"
SPEED = 0.5
TIP_SPEED = 1.0  # m/s
REACH = 0.5  # rad, of random motions around home
SETTLE = (5e-3, 2e-2)  # m, and rad: laws without integral end so near, against friction
ENCODER_NOISE = 2e-6  # rad, of 20 bits
RATE_MAX = 1000.0  # N m/s, as of a Franka
SEED = 0
PER = 10_000  # ticks
PERCENTILE = 99
DT = 1e-3  # s, the tick of both robots
BARE_TICKS = 20_000
DELAY_MARGIN_S = 5e-3  # of a law that is tuned
TUNED_FOR = armctl.Plant(delay=2, continuous=True, timestep=DT)


@dataclass(frozen=True)
class Bench:
    """A simulated robot, and a link to it that writes the times of its ticks."""

    name: str
    arm: armctl.Arm
    torque: armctl.links.TorqueInterface
    path: Path  # of the times
    real_time: bool

    def link(self) -> TimedPlantLink | TimedFranka:
        times = TickTimes(self.path)
        if self.name == "plant":
            dry = 0.005 * self.arm.limits.tau_max
            plant = armctl.Plant(
                mass_scale=1.1, coulomb_friction=dry, viscous_friction=0.1, encoder_noise=ENCODER_NOISE, timestep=1e-3
            )
            return TimedPlantLink(self.arm, plant, self.torque, times, self.real_time)
        return TimedFranka(ADDRESS, self.torque, times)


@contextmanager
def bench(name: str, folder: Path, real_time: bool) -> Iterator[Bench]:
    """A robot by its name, as long as the block lasts."""
    path = folder / "times.npz"
    if name == "plant":
        arm = armctl.load("robot_arm_3dof")
        torque = armctl.links.TorqueInterface(arm.limits.tau_max, rate_max=RATE_MAX, settle=SETTLE)
        yield Bench(name, arm, torque, path, real_time)
        return
    maker = armctl.links.Franka(ADDRESS).torque
    assert maker is not None
    arm = armctl.load("fr3", tool=HAND)
    command = [sys.executable, str(SERVER), ADDRESS]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as server:
        try:
            assert server.stdout is not None
            if server.stdout.readline() != "ready\n":
                raise SystemExit("franky-sim did not start")
            yield Bench(name, arm, replace(maker, adds_friction=False, settle=SETTLE), path, True)
        finally:
            server.kill()


def borne(bench: Bench, law: str) -> armctl.Controller | str:
    """A law, or the same with gains that the robot can bear."""
    try:
        with armctl.Robot(bench.arm, bench.link(), controller=law):
            return law
    except armctl.LinkError as error:
        print(f"{bench.name}, {law}: {error}", file=sys.stderr)
    return armctl.tune(bench.arm, law, delay_margin=DELAY_MARGIN_S, plants=[TUNED_FOR]).controller


def lost_by_sleeping() -> float:
    """Ticks of 10 000 that a loop loses on this machine although it computes nothing."""
    lost = 0
    due = time.monotonic()
    for _ in range(BARE_TICKS):
        due += DT
        time.sleep(max(due - time.monotonic(), 0.0))
        missed = int((time.monotonic() - due) / DT)
        lost += missed
        due += missed * DT
    return lost * PER / BARE_TICKS


def motions(bench: Bench, law: str, controller: armctl.Controller | str, count: int) -> list[object]:
    """A row of the first table."""
    rng = np.random.default_rng(SEED)
    reached = 0
    failures: list[str] = []
    try:
        opened = armctl.Robot(bench.arm, bench.link(), controller=controller, speed=SPEED, tip_speed=TIP_SPEED)
    except armctl.LinkError as error:
        print(f"{bench.name}, {law}: {error}", file=sys.stderr)
        return [bench.name, law, "not run", *["-"] * 6]
    with opened as robot:
        limits = robot.arm.limits
        for _ in range(count):
            goal = limits.clamp(bench.arm.home + rng.uniform(-REACH, REACH, bench.arm.n))
            result = robot.move_j(goal)
            reached += result.ok
            if not result:
                failures.append(result.reason)
            if robot.fault:
                break
        lost = robot.lost_ticks
        delay = robot.delay
    for reason in dict.fromkeys(failures):
        print(f"{bench.name}, {law}: {reason}", file=sys.stderr)
    noted = np.load(bench.path)
    steps = np.diff(noted["sent"], axis=0)
    rate = np.nanmax(np.abs(steps) / robot.dt / bench.torque.rate_limits)
    torque = np.nanmax(np.abs(noted["sent"]) / bench.torque.torque_limits)
    ticks = len(noted["seconds"])
    return [
        bench.name,
        law if controller == law else f"{law}, tuned",
        f"{reached} of {count}",
        ticks,
        f"{lost * PER / max(ticks, 1):.1f}",
        f"{1e3 * delay:.0f} ms",
        f"{100 * torque:.0f} %",
        f"{100 * rate:.0f} %",
        f"{1e6 * np.percentile(noted['seconds'], PERCENTILE):.0f} us",
    ]


def compared(bench: Bench, laws: Sequence[armctl.Controller | str]) -> tuple[list[list[object]], list[str]]:
    """Rows of the second table, and what they say."""
    options = {"speed": SPEED, "tip_speed": TIP_SPEED, "configurations": 0}
    try:
        reports = armctl.compare_on_robot(bench.arm, bench.link(), laws, identified=True, recover=lambda _: True, **options)
    except armctl.LinkError as error:
        return [], [f"{bench.name}: {error}"]
    errors = np.full((4, len(LAWS)), np.nan)
    for k, group in enumerate(reports.plants().values()):
        errors[k] = [figure(group, law) for law in LAWS]
    rows: list[list[object]] = [
        [bench.name, law, *("-" if np.isnan(each) else f"{1e3 * each:.3f}" for each in errors[:, k])]
        for k, law in enumerate(LAWS)
    ]
    said = [f"{bench.name}: {each}" for each in reports.remarks()]
    for robot, simulation, what in ((errors[0], errors[1], "model"), (errors[2], errors[3], "identified")):
        known = np.isfinite(robot + simulation)
        if not known.any():
            continue
        same = bool((np.argsort(robot[known]) == np.argsort(simulation[known])).all())
        order = "the same order" if same else "another order"
        ratios = np.round(robot / simulation, 2).tolist()
        said.append(f"{bench.name}, {what}: {order}; errors of the robot over those of the simulation {ratios}")
    factor = errors[0, LAWS.index("computed-torque")] / errors[2, LAWS.index("computed-torque")]
    if np.isfinite(factor):
        said.append(f"{bench.name}: identification divides the error of computed-torque by {factor:.1f}")
    return rows, said


def figure(reports: list[armctl.Report], law: str) -> float:
    """rad, the RMS error of a law; NaN if it was not run."""
    return next((report.joint_rms_rad for report in reports if report.controller == law), np.nan)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    found = all(importlib.util.find_spec(name) for name in ("pylibfranka", "franky_sim"))
    parser.add_argument(
        "--robots", nargs="+", choices=["plant", "franky-sim"], default=["plant", *(["franky-sim"] if found else [])]
    )
    parser.add_argument("--motions", type=int, default=30, help="random motions under each law (default 30; 3 take a minute)")
    parser.add_argument("--no-real-time", action="store_true", help="of the PlantLink, on a busy machine")
    parser.add_argument("--out", type=Path, help=f"a file for the tables, such as {RESULTS.name}")
    arguments = parser.parse_args()
    load = f"{os.getloadavg()[0]:.1f}"
    bare = lost_by_sleeping()
    first: list[list[object]] = []
    second: list[list[object]] = []
    said: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        for name in arguments.robots:
            with bench(name, Path(folder), not arguments.no_real_time) as robot:
                laws = [borne(robot, law) for law in LAWS]
                first += [motions(robot, law, given, arguments.motions) for law, given in zip(LAWS, laws, strict=True)]
                rows, remarks = compared(robot, laws)
                second += rows
                said += remarks
    columns = ["robot", "law", "reached", "ticks", "lost", "delay", "torque", "rate", "tick"]
    errors = ["robot", "law", "model, robot, mrad", "model, simulation", "identified, robot", "identified, simulation"]
    tables = [titled_table("Motions", columns, first), titled_table("One motion, RMS", errors, second)]
    said.append(f"A loop that sleeps and computes nothing loses {bare:.1f} of {PER} ticks here.")
    said.append(f"Load before: {load}, after: {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors.")
    text = "\n\n".join([*tables, "\n".join(f"- {line}" for line in said)]) + "\n"
    print(text)
    if arguments.out is not None:
        arguments.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
