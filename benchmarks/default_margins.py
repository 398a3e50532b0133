"""Delay margin and peak sensitivity of default gains at many configurations that neither their design nor `margins` uses.

    python benchmarks/default_margins.py [--robots panda,fr3] [--configurations 150]

A cell has the least delay margin, ms, and the largest Ms. "declared": the controller is
among the exceptions of the arm, which `armctl info` prints.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
from markdown_table import titled_table

import armctl

ROBOTS = "robot_arm_3dof,panda,fr3,ur5e,iiwa14,kinova_gen3"
LAWS = ("pd-gravity", "computed-torque", "computed-torque-observer", "operational-space", "impedance")
SEED = 777


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--robots", default=ROBOTS)
    parser.add_argument("--configurations", type=int, default=150)
    parser.add_argument("--timestep", type=float, default=0.001)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "default_margins.md")
    args = parser.parse_args()
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    rows = []
    for robot in args.robots.split(","):
        arm = armctl.load(robot)
        q = arm.limits.random(arm.limits.clamp(arm.home), args.configurations, np.random.default_rng(SEED))
        plant = armctl.Plant(timestep=args.timestep)
        command = [sys.executable, "-m", "armctl", "info", robot, "--json"]
        facts = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)["result"]
        declared = {name for exception in facts["margin_exceptions"] for name in exception["controllers"]}
        rows.append([robot, *(cell(arm, plant, law, q) + (" declared" if law in declared else "") for law in LAWS)])
    title = f"Delay margin, ms / Ms, worst of {args.configurations} configurations, control period {1e3 * args.timestep:g} ms"
    text = titled_table(title, ["robot", *LAWS], rows) + "\n"
    args.out.write_text(text, encoding="utf-8")
    print(text)


def cell(arm: armctl.Arm, plant: armctl.Plant, law: str, configurations: np.ndarray) -> str:
    """The worst margins of a controller."""
    found = [armctl.linearize(arm, law, q, plant).margins() for q in configurations]
    delay = min(each.delay_margin for each in found)
    sensitivity = max(each.peak_sensitivity for each in found)
    return f"{1e3 * delay:.2f} / {sensitivity:.2f}"


if __name__ == "__main__":
    main()
