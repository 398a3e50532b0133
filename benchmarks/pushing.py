"""A box is pushed to poses by sampling MPC, on a six-joint arm with a stick and a five-joint one with its fingers.

    python benchmarks/pushing.py [--seeds 10]

Goals are 8 to 15 cm to the left or right, up to 4 cm nearer or 8 cm farther, and turned by up to 0.4 rad. A push counts if the
box is within 1 cm and 0.1 rad in 30 s.
"""

import argparse
import os
import sys
import tempfile
import time
import warnings
from pathlib import Path

import mujoco
import numpy as np
from markdown_table import titled_table

import armctl

sys.path.append(str(Path(__file__).parent.parent / "tests" / "helpers"))
from synthetic import arm_with_gripper

ROOT = Path(__file__).parent.parent
STICK = """<mujoco model="stick"><option cone="elliptic"/><worldbody><body name="stick">
<geom type="capsule" fromto="0 0 0 0 0 0.09" size="0.01" mass="0.1" friction="0.2" priority="1"/>
<site name="tip" pos="0 0 0.09"/></body></worldbody></mujoco>"""
SIZE = np.array([0.08, 0.06, 0.05])  # m, of the box


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "pushing.md")
    args = parser.parse_args()
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    with tempfile.TemporaryDirectory() as folder:
        stick = mujoco.MjSpec.from_string(STICK)
        desk = armctl.load(ROOT / "examples" / "models" / "desk_arm.urdf", tool=stick, scene=scene(0.35, 0.0))
        fingers = armctl.load(arm_with_gripper(Path(folder)), scene=scene(0.45, 0.1))
    rows = [row(desk, 0.35, 0.0, args.seeds), row(fingers, 0.45, 0.1, args.seeds)]
    columns = ["arm", "joints", "at the goal", "median, s", "longest, s", "largest error, mm", "rad", "real time, CPU", "wall"]
    title = f"A box is pushed to a pose, {args.seeds} seeds; real time is simulated time over that of planning and simulation"
    text = titled_table(f"{title}, with {os.cpu_count()} threads", columns, rows) + "\n"
    args.out.write_text(text, encoding="utf-8")
    print(text)


def scene(x: float, height: float) -> armctl.World:
    """A box on a table."""
    table = armctl.World().add("table", armctl.Box([0.6, 0.8, 0.02]), [x, 0.0, height - 0.01])
    return table.add("box", armctl.Box(SIZE), [x, 0.0, height + 0.5 * SIZE[2] + 1e-4], mass=0.2)


def row(arm: armctl.Arm, x: float, height: float, seeds: int) -> list[str]:
    results = []
    times = np.zeros(2)
    for seed in range(seeds):
        result, elapsed = pushed(arm, np.array([x, 0.0, height + 0.5 * SIZE[2]]), seed)
        print(arm.name, seed, result, flush=True)
        results.append(result)
        times += elapsed
    simulated = sum(result.duration for result in results)
    there = [result for result in results if result]
    seconds = [result.duration for result in there] or [np.nan]
    errors = [[1e3 * result.position_error, result.angle_error] for result in there] or [[np.nan, np.nan]]
    millimetres, radians = np.max(errors, axis=0)
    return [
        arm.name,
        str(arm.n),
        f"{len(there)} of {seeds}",
        f"{np.median(seconds):.1f}",
        f"{max(seconds):.1f}",
        f"{millimetres:.1f}",
        f"{radians:.2f}",
        *(f"{simulated / each:.2f}" for each in times),
    ]


def pushed(arm: armctl.Arm, box: np.ndarray, seed: int) -> tuple[armctl.PushResult, np.ndarray]:
    """One push, and its CPU and wall time, s."""
    rng = np.random.default_rng(1000 + seed)
    way = np.array([rng.uniform(-0.04, 0.08), rng.choice([-1, 1]) * rng.uniform(0.08, 0.15), 0.0])
    goal = armctl.Pose(box + way, rpy=[0.0, 0.0, rng.uniform(-0.4, 0.4)])
    simulation = armctl.Simulation(arm, "computed-torque-observer")
    behind = armctl.Pose(box - 0.1 * way / np.linalg.norm(way), rpy=[np.pi, 0.0, 0.0])
    start = armctl.solve_ik(arm, behind, arm.limits.clamp(np.zeros(arm.n)), free_axis="z")
    if not start:
        raise RuntimeError(start.reason)
    simulation.reset(start.q)
    began = np.array([time.process_time(), time.perf_counter()])
    result = armctl.push(simulation, "box", goal, timeout=30.0, seed=seed)
    return result, np.array([time.process_time(), time.perf_counter()]) - began


if __name__ == "__main__":
    main()
