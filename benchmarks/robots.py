"""The makers' ratings of arms, loading times, and every chain of every installed robot with its limits and test results.

    python benchmarks/robots.py [--poses 1000] [--out docs/robots.md]

It writes the page `docs/robots.md`. A robot is installed if MENAGERIE_ROOT or the cache of `mujoco-menagerie` holds it.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import mujoco
import mujoco_menagerie as menagerie

import armctl
from armctl.analysis.chain_check import GOAL_DISTANCE, ChainCheck, arms_of, check_chain
from armctl.core.tables import Table
from armctl.loading.catalog import BUNDLED, installed_robots, locate
from armctl.loading.ratings import ratings_table

PAGE = Path(__file__).parent.parent / "docs" / "robots.md"
HEAD = """# Robots

## Ratings

What the makers publish about the arms of MuJoCo Menagerie, with the source. An arm without a data sheet in
armctl has the limits of its model and the default speed of 2 rad/s. `armctl info NAME` compares the rated payload
with what the torque limits of the model hold.

{ratings}

## Loading

CPU time of `armctl.load` and of MuJoCo's own compilation of the same file, the least of {runs} runs each in turn, with MuJoCo's
cache of meshes cleared before each run. armctl compiles twice and compares its model with MuJoCo's.

{loading}

## Chains

Every serial chain of the robots that were installed when this page was made, by `python benchmarks/robots.py`. The command
`armctl chains NAME` finds them; `load(NAME, base=..., tip=..., hold_base=True)` loads one.

- Parity: the largest difference between armctl's model and MuJoCo's in tip pose, mass matrix and bias, over 20 states.
- IK: of {poses} poses, each of some configuration inside the limits, the share that `solve_ik` solves within 1e-5 m.
- PD, computed torque: the joint errors on a motion of up to {step} rad from home, RMS for PD, the largest for computed torque.
- Joints in brackets follow the one before them: an equality ties them to it.

"""
LOADING_COLUMNS = ("robot", "load, s", "MuJoCo alone, s", "ratio")
LOADING_RUNS = 3
COLUMNS = ("base to tip", "joints", "torque limits", "speed limits", "parity", "IK", "PD, rad", "computed torque, rad", "")


def row(check: ChainCheck) -> list[str]:
    """The cells of a chain."""
    arm = check.arm
    return [
        f"{check.base} to {arm.tip}",
        joints_of(arm),
        arm.sources["tau_max"],
        arm.sources["v_max"],
        f"{check.parity:.0e}",
        f"{100 * check.ik_success:.1f} %",
        f"{check.pd_error:.1e}",
        f"{check.computed_torque_error:.0e}",
        check.tracking_note or check.reason,
    ]


def joints_of(arm: armctl.Arm) -> str:
    """The joints of an arm, each with those that follow it in brackets."""
    names = [arm.model.joint(joint).name for joint in arm.joint_map.joints]
    texts = []
    for i, leader in enumerate(arm.joint_names):
        ratios = arm.joint_map.ratio[:, i]
        others = [name for name, ratio in zip(names, ratios, strict=True) if ratio and name != leader]
        texts.append(f"{leader} ({', '.join(others)})" if others else leader)
    return ", ".join(texts)


def robot_entries() -> list[str]:
    """The bundled arm and the robots of Menagerie that need no download, each without its scene."""
    names = [name for name in installed_robots() if name != BUNDLED]
    return [BUNDLED, *(f"{name}/{menagerie.get(name).default_model}" for name in names)]


def loading(robots: list[str]) -> Table:
    """How long `load` takes, beside MuJoCo's own compilation, for the arms among some robots."""
    armctl.load(BUNDLED)  # imports
    rows = []
    for robot in robots:
        if not is_arm(robot):
            continue
        path = str(locate(robot).path)
        alone = []
        whole = []
        for _ in range(LOADING_RUNS):
            alone.append(cold_seconds(lambda path=path: mujoco.MjSpec.from_file(path).compile()))
            whole.append(cold_seconds(lambda robot=robot: armctl.load(robot)))
        rows.append([robot, f"{min(whole):.3f}", f"{min(alone):.3f}", f"{min(whole) / min(alone):.2f}"])
    return Table(LOADING_COLUMNS, rows)


def is_arm(robot: str) -> bool:
    """Whether `load` takes a robot without further arguments."""
    try:
        armctl.load(robot)
    except armctl.ArmctlError:
        return False
    return True


def cold_seconds(call: Callable[[], object]) -> float:
    """CPU time of a call without cached meshes."""
    mujoco.mj_clearCache(mujoco.mj_getCache())
    began = time.process_time()
    call()
    return time.process_time() - began


def page(poses: int) -> str:
    """The whole page."""
    tables = {"ratings": ratings_table().markdown(), "loading": loading(installed_robots()).markdown()}
    text = HEAD.format(poses=poses, step=GOAL_DISTANCE, runs=LOADING_RUNS, **tables)
    for robot in robot_entries():
        rows = [row(check_chain(arm, base, poses)) for base, arm in arms_of(robot)]
        refused = [chain for chain in armctl.chains(robot) if not chain.ok]
        text += f"### {robot}\n\n"
        if rows:
            text += Table(COLUMNS, rows).markdown() + "\n\n"
        if refused:
            text += "Refused, with the reason:\n\n"
            text += "".join(f"- {chain.reason}\n" for chain in refused) + "\n"
        print(f"{robot}: {len(rows)} chains, {len(refused)} refused", flush=True)
    return text.rstrip() + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--poses", type=int, default=1000)
    parser.add_argument("--out", type=Path, default=PAGE)
    args = parser.parse_args()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", armctl.ArmctlWarning)
        args.out.write_text(page(args.poses), encoding="utf-8")
    print(f"written: {args.out}")
