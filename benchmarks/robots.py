"""The makers' ratings of arms, loading times, and every chain of every installed robot with its limits and test results.

    python benchmarks/robots.py [--poses 1000]

It writes the tables of `docs/robots.md`. A robot is installed if MENAGERIE_ROOT or the cache of `mujoco-menagerie` holds it.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import mujoco
import mujoco_menagerie as menagerie
import numpy as np
from markdown_table import markdown_table

import armctl

BUNDLED = "robot_arm_3dof"
STEP = 0.2  # rad, m: how far the joints move from home in the tracking runs
POSITION_TOLERANCE_M = 1e-5  # of solve_ik
RESULTS = Path(__file__).parent / "results"
LOADING_COLUMNS = ("robot", "load, s", "MuJoCo alone, s", "ratio")
LOADING_RUNS = 3
RATINGS_COLUMNS = ("robot", "payload, kg", "reach, m", "joint speeds, deg/s", "source")
COLUMNS = ("base to tip", "joints", "torque limits", "speed limits", "IK", "PD, rad", "computed torque, rad", "")


def row(chain: armctl.SerialChain, arm: armctl.Arm, poses: int) -> list[str]:
    """The cells of a chain."""
    motion, note = motion_near_home(arm)
    pd = armctl.simulate(arm, "pd", motion, dwell=0.0)
    computed_torque = armctl.simulate(arm, "computed-torque", motion, dwell=0.0)
    return [
        f"{chain.base} to {arm.tip}",
        joints_of(arm),
        arm.sources["tau_max"],
        arm.sources["v_max"],
        f"{100 * solved_share(arm, poses):.1f} %",
        f"{np.sqrt(np.mean((pd.q - pd.q_ref) ** 2)):.1e}",
        f"{np.abs(computed_torque.q - computed_torque.q_ref).max():.0e}",
        note,
    ]


def motion_near_home(arm: armctl.Arm) -> tuple[armctl.JointTrajectory, str]:
    """A motion from home that touches nothing, and no words; if there is none, any motion, and the reason."""
    reason = ""
    for step in (STEP, -STEP, 0.1 * STEP, -0.1 * STEP):
        motion = armctl.move_j(arm, arm.home, arm.limits.clamp(arm.home + step))
        if motion.duration == 0.0:
            continue
        check = armctl.check_clearance(arm, motion)
        if check.ok:
            return motion, ""
        reason = check.reason
    return armctl.move_j(arm, arm.home, arm.limits.clamp(arm.home + STEP)), reason


def solved_share(arm: armctl.Arm, poses: int) -> float:
    """The share of the poses of random configurations that `solve_ik_batch` solves, by the kinematics of the arm."""
    targets = [arm.fk(q) for q in arm.limits.random(arm.home, poses, np.random.default_rng(0))]
    found = armctl.solve_ik_batch(arm, targets)
    positions = arm.fk_many(found.q)[0]
    off = np.linalg.norm(positions - np.array([target.position for target in targets]), axis=1)
    return float(np.mean(found.ok & (off <= POSITION_TOLERANCE_M * (1 + 1e-6))))


def joints_of(arm: armctl.Arm) -> str:
    """The joints of an arm, each with those that follow it in brackets."""
    names = [arm.model.joint(joint).name for joint in arm.joint_map.joints]
    texts = []
    for i, leader in enumerate(arm.joint_names):
        ratios = arm.joint_map.ratio[:, i]
        others = [name for name, ratio in zip(names, ratios, strict=True) if ratio and name != leader]
        texts.append(f"{leader} ({', '.join(others)})" if others else leader)
    return ", ".join(texts)


def installed_robots() -> list[menagerie.Robot]:
    """The robots of Menagerie that need no download."""
    cache = menagerie.Cache()
    if cache.root is not None:
        return [robot for robot in menagerie.robots() if (cache.root / robot.name).is_dir()]
    return [robot for robot in menagerie.robots() if cache.is_cached(robot)]


def ratings() -> str:
    """The table of `armctl robots --ratings`."""
    command = [sys.executable, "-m", "armctl", "robots", "--ratings", "--json"]
    printed = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout
    rows = []
    for rated in json.loads(printed)["result"]:
        figures = ["" if rated[name] is None else f"{rated[name]:g}" for name in ("payload_kg", "reach_m")]
        speeds = " ".join(f"{np.degrees(speed):.0f}" for speed in rated["v_max"] or ())
        rows.append([rated["robot"], *figures, speeds, rated["source"] or "no data sheet"])
    return markdown_table(RATINGS_COLUMNS, rows)


def loading(robots: list[menagerie.Robot]) -> str:
    """How long `load` takes, beside MuJoCo's own compilation, for the arms among some robots."""
    armctl.load(BUNDLED)  # imports
    rows = []
    for robot in robots:
        if not is_arm(robot.name):
            continue
        path = str(menagerie.Cache().resolve(robot) / f"{robot.default_model}.xml")
        alone = []
        whole = []
        for _ in range(LOADING_RUNS):
            alone.append(cold_seconds(lambda path=path: mujoco.MjSpec.from_file(path).compile()))
            whole.append(cold_seconds(lambda robot=robot: armctl.load(robot.name)))
        rows.append([robot.name, f"{min(whole):.3f}", f"{min(alone):.3f}", f"{min(whole) / min(alone):.2f}"])
    return markdown_table(LOADING_COLUMNS, rows)


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


def tested(installed: list[menagerie.Robot], poses: int) -> str:
    """A table for each robot, with a row for each chain, and the chains that are refused."""
    text = ""
    for robot in (BUNDLED, *(f"{each.name}/{each.default_model}" for each in installed)):
        chains = armctl.chains(robot)
        rows = []
        for chain in chains:
            if chain.ok:
                base = None if chain.base == "world" else chain.base
                rows.append(row(chain, armctl.load(robot, tip=chain.tip, base=base), poses))
        refused = [chain for chain in chains if not chain.ok]
        text += f"### {robot}\n\n"
        if rows:
            text += markdown_table(COLUMNS, rows) + "\n\n"
        if refused:
            text += "Refused, with the reason:\n\n"
            text += "".join(f"- {chain.reason}\n" for chain in refused) + "\n"
        print(f"{robot}: {len(rows)} chains, {len(refused)} refused", flush=True)
    return text.rstrip() + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--poses", type=int, default=1000)
    args = parser.parse_args()
    robots = installed_robots()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", armctl.ArmctlWarning)
        for name, text in {"ratings": ratings(), "loading": loading(robots), "chains": tested(robots, args.poses)}.items():
            (RESULTS / f"robots_{name}.md").write_text(text.rstrip() + "\n", encoding="utf-8")
