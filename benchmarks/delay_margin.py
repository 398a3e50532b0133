"""The predicted delay margin beside the delay at which the simulation becomes unstable, for every controller.

    python benchmarks/delay_margin.py [--robots robot_arm_3dof,panda] [--timestep 0.004]

Each cell is the predicted delay margin, in control periods, at home. "ok": a small deviation decays in a simulation with the
next smaller whole number of periods of delay, and grows with the next larger one.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from pathlib import Path

from markdown_table import titled_table

import armctl
from armctl.control import CONTROLLERS

sys.path.append(str(Path(__file__).parent.parent / "tests" / "helpers"))
from instability import grows  # the test of the same statement uses it, too

ROBOTS = "robot_arm_3dof,panda,iiwa14,kinova_gen3"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--robots", default=ROBOTS)
    parser.add_argument("--timestep", type=float, default=0.004)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "delay_margin.md")
    args = parser.parse_args()
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    plant = armctl.Plant(timestep=args.timestep)
    arms = [armctl.load(name) for name in args.robots.split(",")]
    rows = [[name, *(cell(arm, name, plant) for arm in arms)] for name in CONTROLLERS]
    title = f"Delay margin in control periods of {1e3 * args.timestep:g} ms, predicted; ok if the simulation agrees"
    text = titled_table(title, ["controller", *(arm.name for arm in arms)], rows) + "\n"
    args.out.write_text(text, encoding="utf-8")
    print(text)


def cell(arm: armctl.Arm, name: str, plant: armctl.Plant) -> str:
    """The predicted delay margin of a controller at home, and whether the simulation agrees to the tick."""
    loop = armctl.linearize(arm, name, arm.limits.clamp(arm.home), plant)
    margin = loop.margins().delay_margin / loop.dt
    ticks = int(margin)
    agrees = not grows(arm, name, loop, ticks) and grows(arm, name, loop, ticks + 1)
    return f"{margin:.2f} {'ok' if agrees else 'differs'}"


if __name__ == "__main__":
    main()
