"""Goals that are regions: 18 grasps around three cans, and a list of 18 poses. `python benchmarks/regions.py`

    python benchmarks/regions.py [--starts 100] [--peer PYTHON] [--out FILE]

On a table with three cans, a Panda goes from random free configurations to the nearest of 18 grasp regions; each motion is
judged by MuJoCo every millisecond. With `--peer`, the Python of an environment with `sscbirrt[demo]`, the scene, the regions
and the limits are those of its own example, a UR5e with a gripper among five boxes, and both plan from the same start with 100
seeds. Times are CPU times of whole calls.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
import time
import warnings
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
from markdown_table import titled_table
from planning import stopping_at

import armctl

CAN = armctl.Cylinder(0.03, 0.12)
CANS = {"left": [0.5, 0.25, 0.26], "middle": [0.6, 0.0, 0.26], "right": [0.5, -0.25, 0.26]}
STAND_OFF_M = 0.015
HEIGHTS_M = ((-0.02, -0.007), (-0.007, 0.007), (0.007, 0.02))
ROLLS = (0.0, np.pi)
JUDGED_EVERY_S = 1e-3
IN_REGION = 1e-4  # m and rad
COLUMNS = ["planner", "solved", "touching", "in a region", "median ms", "95 % ms", "motion, median s"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--starts", type=int, default=100)
    parser.add_argument("--peer", type=Path, help="the Python of an environment with sscbirrt")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "regions.md")
    args = parser.parse_args()
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    tables = on_cans(args.starts)
    if args.peer:
        tables.append(beside_peer(args.peer, args.starts))
    tables.append(
        f"CPU times of whole calls, without the first one, which loads what is needed; load average {os.getloadavg()[1]:.1f}."
    )
    text = "\n\n".join(tables) + "\n"
    args.out.parent.mkdir(exist_ok=True)
    args.out.write_text(text, encoding="utf-8")
    print(text)


def on_cans(count: int) -> list[str]:
    """A Panda from random configurations to 18 grasps, and the IK of 18 poses."""
    scene = armctl.World().add("table", armctl.Box([0.6, 1.0, 0.04]), [0.55, 0, 0.18])
    for name, place in CANS.items():
        scene.add(name, CAN, place, mass=0.1)
    arm = armctl.load("panda", scene=scene)
    regions = armctl.Region.union(
        armctl.Region(place, [[0, 0], [0, 0], height, [0, 0], [0, 0], [-np.pi, np.pi]], tip=_from_the_side(roll))
        for place in CANS.values()
        for height in HEIGHTS_M
        for roll in ROLLS
    )
    starts = free_starts(arm, count)
    motions, times = timed([lambda q=q, k=k: armctl.move_free(arm, q, regions, seed=k) for k, q in enumerate(starts)])
    table = titled_table("18 grasp regions around three cans, Panda", COLUMNS, [row("armctl", arm, regions, motions, times)])
    poses = armctl.Region.union(armctl.Region(regions[k].sample(1)[0]) for k in range(len(regions)))
    found, ik_times = timed([lambda q=q: armctl.solve_ik(arm, poses, q, avoid=True) for q in starts])
    solved = sum(each is not None and each.ok for each in found)
    ik = ["armctl", f"{solved} of {count}", *(f"{1e3 * np.percentile(ik_times, p):.1f}" for p in (50, 95))]
    return [
        table,
        titled_table("IK of the nearest of 18 poses that is free, Panda", ["solver", "solved", "median ms", "95 % ms"], [ik]),
    ]


def _from_the_side(roll: float) -> armctl.Pose:
    """T_can_tip: the gripper points and closes across the can's axis; a roll of half a turn swaps its fingers."""
    across = armctl.Pose([-STAND_OFF_M, 0.0, 0.0], rpy=[0.0, 0.5 * np.pi, 0.0])
    return across @ armctl.Pose([0.0, 0.0, 0.0], rpy=[0.0, 0.0, roll])


def free_starts(arm: armctl.Arm, count: int) -> list[np.ndarray]:
    """Random configurations at which nothing is nearer than 1 cm."""
    rng = np.random.default_rng(0)
    found: list[np.ndarray] = []
    while len(found) < count:
        q = arm.limits.random(arm.home, 1, rng)[0]
        if armctl.check_clearance(arm, armctl.move_j(arm, q, q), 0.01).ok:
            found.append(q)
    return found


def beside_peer(python: Path, count: int) -> str:
    """sscbirrt and armctl in the scene of sscbirrt."""
    with tempfile.TemporaryDirectory() as folder:
        script = Path(__file__).with_name("regions_peer.py")
        subprocess.run([python, script, folder, str(count)], check=True)
        given = json.loads((Path(folder) / "peer.json").read_text(encoding="utf-8"))
        arm = armctl.load(Path(folder) / "scene.xml", tip=given["site"])
    n = arm.n
    limits = replace(arm.limits, v_max=np.full(n, given["speed"]), a_max=np.full(n, given["acceleration"]))
    arm = arm.with_limits(limits)
    regions = armctl.Region.union(
        armctl.Region(pose_of(each["frame"]), each["bounds"], tip=pose_of(each["tip"])) for each in given["regions"]
    )
    start = np.array(given["start"])
    motions, times = timed([lambda k=k: armctl.move_free(arm, start, regions, seed=k) for k in range(count)])
    paths = [None if each["path"] is None else np.array(each["path"]) for each in given["rows"]]
    theirs = row(
        "sscbirrt",
        arm,
        regions,
        [None if path is None else stopping_at(arm, path) for path in paths],
        [each["seconds"] for each in given["rows"]],
    )
    theirs[-1] = f"{np.median([each['duration'] for each in given['rows'] if each['duration']]):.2f}"
    rows = [row("armctl", arm, regions, motions, times), theirs]
    legend = (
        "sscbirrt checks its path at samples and times it with limits of speed and acceleration; armctl proves the motion and "
        "keeps limits of jerk and torque, too. Touching: the motion of armctl, and sscbirrt's path with a stop at each point."
    )
    return f"{titled_table('The 18 grasp regions of an example of sscbirrt, UR5e', COLUMNS, rows)}\n\n{legend}"


def pose_of(matrix: list[list[float]]) -> armctl.Pose:
    T = np.array(matrix)
    return armctl.Pose.from_rotation(T[:3, 3], T[:3, :3])


def timed(calls: list) -> tuple[list, list[float]]:
    """What each of some calls returns, None where there is no plan, and its CPU time, s."""
    calls[0]()  # loads what is needed, once
    results = []
    seconds = []
    for call in calls:
        begin = time.process_time()
        try:
            results.append(call())
        except armctl.PlanError:
            results.append(None)
        seconds.append(time.process_time() - begin)
    return results, seconds


def row(name: str, arm: armctl.Arm, regions: armctl.Region, motions: list, seconds: list[float]) -> list[object]:
    made = [motion for motion in motions if motion is not None]
    ends = [arm.fk(motion(motion.duration).q) for motion in made]
    times = 1e3 * np.array([each for each, motion in zip(seconds, motions, strict=True) if motion is not None])
    return [
        name,
        f"{len(made)} of {len(motions)}",
        sum(touches(arm, motion) for motion in made),
        sum(regions.contains(end, position_tolerance=IN_REGION, orientation_tolerance=IN_REGION) for end in ends),
        *(f"{np.percentile(times, p):.1f}" for p in (50, 95)),
        f"{np.median([motion.duration for motion in made]):.2f}",
    ]


def touches(arm: armctl.Arm, motion: armctl.JointTrajectory) -> bool:
    """Whether MuJoCo finds a contact of the arm that it does not have where it starts."""
    data = mujoco.MjData(arm.model)
    first: set[tuple[int, int]] | None = None
    for q in motion.sample(np.arange(0.0, motion.duration, JUDGED_EVERY_S)).q:
        data.qpos[:] = arm.qpos(q)
        mujoco.mj_kinematics(arm.model, data)
        mujoco.mj_collision(arm.model, data)
        pairs = {
            tuple(sorted(contact.geom.tolist())) for contact in data.contact if contact.dist < 0.0 and contact.exclude == 0
        }
        first = pairs if first is None else first
        if pairs - first:
            return True
    return False


if __name__ == "__main__":
    main()
