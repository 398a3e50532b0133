"""`armctl warmup`: compiles everything that armctl compiles, before a program needs it."""

from __future__ import annotations

import argparse
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from armctl.cli.common import DONE, Commands, add_command
from armctl.core.errors import InputError

_SPEED = 0.5  # a cap on the tip that the move reaches
_LONG_DWELL_S = 30.0  # of a run that is so long that it skips collision detection


class Compiled(NamedTuple):
    """What compiling one part took.

    Attributes:
        functions: How many functions were compiled; the others were in the cache.
        seconds: s, loading the part included.
    """

    functions: int
    seconds: float


def add(commands: Commands) -> None:
    """Adds the command to the parser."""
    parser = add_command(commands, "warmup", run, "compile all kernels in advance")
    parser.add_argument("--workers", type=int, metavar="N", help="processes that compile at the same time (default: all cores)")
    parser.add_argument(
        "--only",
        nargs="+",
        choices=list(PARTS),
        default=list(PARTS),
        metavar="PART",
        help=f"of {', '.join(PARTS)} (default all)",
    )


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    from armctl.core.python_kernel import COMPILE_AT_ONCE

    os.environ[COMPILE_AT_ONCE] = "1"  # of the workers, too
    workers = (os.cpu_count() or 1) if args.workers is None else args.workers
    if workers < 1:
        raise InputError(f"--workers: expected at least 1, got {workers}")
    began = time.perf_counter()
    for count, (part, compiled) in enumerate(_compiled(args.only, workers), start=1):
        done = f"{compiled.functions} functions compiled" if compiled.functions else "everything was in the cache"
        print(f"[{count}/{len(args.only)}] {part}: {done}, {compiled.seconds:.1f} s", flush=True)
    print(f"ready after {time.perf_counter() - began:.1f} s; the cache is kept until armctl or its environment changes")
    return DONE


def _compiled(parts: list[str], workers: int):
    """Yields each part when it is compiled; in this process if one worker is to do it."""
    from concurrent.futures import ProcessPoolExecutor, as_completed
    from multiprocessing import active_children, get_context

    if workers == 1:
        for part in parts:
            yield part, compile_part(part)
        return
    with ProcessPoolExecutor(min(workers, len(parts)), get_context("spawn")) as pool:
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # processes that begin now ignore Ctrl-C: this one ends them
        try:
            waiting = {pool.submit(compile_part, part): part for part in parts}
        finally:
            signal.signal(signal.SIGINT, before)
        try:
            for future in as_completed(waiting):
                yield waiting[future], future.result()
        except BaseException:
            for process in active_children():
                process.terminate()
            raise


def compile_part(part: str) -> Compiled:
    """Compiles what is not in the cache.

    Args:
        part: One of `PARTS`.

    Returns:
        What it took.
    """
    from numba.core import event

    began = time.perf_counter()
    with event.install_recorder("numba:compile") as recorder:
        PARTS[part]()
    return Compiled(sum(each.is_start for _, each in recorder.buffer), time.perf_counter() - began)


def _arm():
    import armctl

    scene = armctl.Scene().add_box("wall", [0.02, 0.02, 0.5], [0.3, 0.0, 0.25])
    return armctl.load("robot_arm_3dof", scene=scene)


def _arm_with_closed_form():
    """Six joints of which the last three meet in a point."""
    import tempfile

    import armctl

    heights = (0.3, 0.0, 0.4, 0.4, 0.0, 0.0)
    axes = ("0 0 1", "0 1 0", "0 1 0", "0 0 1", "0 1 0", "0 0 1")
    bodies = "".join(
        f'<body pos="0 0 {height}"><joint name="j{k}" axis="{axis}" range="-3 3"/>'
        '<geom type="sphere" size="0.01" mass="1" contype="0"/>'
        for k, (height, axis) in enumerate(zip(heights, axes, strict=True))
    )
    motors = "".join(f'<motor joint="j{k}" ctrlrange="-100 100"/>' for k in range(len(axes)))
    tip = '<site name="tip" pos="0 0 0.1"/>'
    ends = "</body>" * len(axes)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.xml"
        path.write_text(
            f'<mujoco><compiler angle="radian"/><worldbody>{bodies}{tip}{ends}</worldbody>'
            f"<actuator>{motors}</actuator></mujoco>",
            encoding="utf-8",
        )
        return armctl.load(path)


def _inverse_kinematics() -> None:
    import numpy as np

    import armctl

    arm = _arm()
    target = arm.fk(arm.home)
    for goal in (target, target.position):
        armctl.solve_ik(arm, goal)
        armctl.solve_ik_all(arm, goal, limit=4)
    armctl.solve_ik_batch(arm, [target])
    armctl.solve_ik_batch(arm, np.array([target.position]))
    armctl.reachability(arm, spacing=1.0)
    special = _arm_with_closed_form()
    goal = special.fk(np.full(special.n, 0.5))
    armctl.solve_ik_all(special, goal)
    armctl.solve_ik(special, goal, nearest=True)
    armctl.reachability(special, spacing=1.0, orientations=1)


def _motion() -> None:
    import numpy as np

    import armctl

    arm = _arm()
    armctl.move_through(arm, [arm.home, arm.home + 0.2, arm.home - 0.1])
    target = arm.fk(arm.home).position + np.array([0.0, 0.05, 0.0])
    armctl.move_l(arm, arm.home, target, tip_speed=_SPEED)


def _planning() -> None:
    import numpy as np

    import armctl

    start = np.array([-0.8, 0.9, -1.2])
    goal = np.array([0.8, 0.9, -1.2])
    armctl.check_clearance(_arm(), armctl.move_free(_arm(), start, goal))
    armctl.DifferentialIk(_arm(), avoid_collisions=True)


def _simulation() -> None:
    import armctl
    from armctl.control import CONTROLLERS

    arm = _arm()
    motion = armctl.move_j(arm, arm.home, arm.home + 0.02)
    for name in CONTROLLERS:
        armctl.simulate(arm, name, motion)
    free = armctl.load("robot_arm_3dof")
    for with_wrench in (armctl.HybridForce(free, {"z": -1.0}), armctl.TorqueRateLimit(free, armctl.Admittance(free), 1e3)):
        armctl.simulate(free, with_wrench, motion)
    armctl.simulate(arm, "pd", motion, armctl.Plant(free_space=True))
    armctl.simulate(arm, "pd", motion, dwell=_LONG_DWELL_S)


def _environments() -> None:
    from importlib.util import find_spec

    if find_spec("gymnasium") is None:
        return
    from armctl.envs import ArmEnv

    env = ArmEnv("robot_arm_3dof", action="joint_delta")
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()


PARTS: dict[str, Callable[[], None]] = {
    "inverse-kinematics": _inverse_kinematics,
    "motion": _motion,
    "planning": _planning,
    "simulation": _simulation,
    "environments": _environments,
}
