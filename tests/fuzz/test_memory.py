"""What was made and dropped leaves no memory behind: 60 objects of each kind in the suite, up to 10 000 with --fuzz-minutes."""

import ctypes
import gc
import resource
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="pip install -e '.[envs]'")

import gymnasium

import armctl
from armctl.control import CONTROLLERS

OBJECTS = 60
MAX_OBJECTS = 10_000
MAX_GROWTH_MB = 3.0  # of a heap that is cut in pieces; all of the objects together have far more

pytestmark = [
    pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="the memory of a process is read as on Linux"),
    pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning"),
]


def follow(case: SimpleNamespace) -> None:
    online = armctl.OnlineMotion(case.arm, case.arm.home)
    online.go_to(case.goal)
    online.step(0.01)


def episode(case: SimpleNamespace) -> None:
    env = gymnasium.make("armctl.envs:armctl/Reach-v0", robot=case.arm)
    env.reset(seed=1)
    env.step(env.action_space.sample())
    env.close()


def save_and_load(case: SimpleNamespace) -> None:
    case.log.save(case.folder / "log.npz")
    armctl.Log.load(case.folder / "log.npz")


MAKERS: dict[str, Callable[[SimpleNamespace], object]] = {
    "Arm": lambda case: armctl.load("robot_arm_3dof"),
    "Arm with other limits": lambda case: case.arm.with_limits(case.arm.limits).fk(case.goal),
    "Plant": lambda case: armctl.Plant(payload=1.0, coulomb_friction=0.1).model(case.arm),
    "controllers": lambda case: [make(case.arm) for make in CONTROLLERS.values()],
    "Simulation": lambda case: armctl.Simulation(case.arm).run(case.motion),
    "Log": lambda case: armctl.simulate(case.arm, "pd", case.motion),
    "file of a Log": save_and_load,
    "Report": lambda case: str(armctl.Report.from_log(case.log)),
    "IkResult": lambda case: armctl.solve_ik(case.arm, case.point),
    "IkSolutions": lambda case: armctl.solve_ik_all(case.arm, case.point),
    "Reachability": lambda case: armctl.reachability(case.arm, 0.5),
    "move_j": lambda case: armctl.move_j(case.arm, case.arm.home, case.goal),
    "move_through": lambda case: armctl.move_through(case.arm, [case.arm.home, case.goal, case.arm.home]),
    "move_l": lambda case: armctl.move_l(case.arm, case.goal, case.point + np.array([0.0, 0.01, 0.01])),
    "move_free": lambda case: armctl.move_free(case.arm, case.arm.home, case.goal),
    "OnlineMotion": follow,
    "Clearance": lambda case: armctl.check_clearance(case.arm.with_limits(case.arm.limits), case.motion),
    "environment": episode,
    "Pose": lambda case: armctl.Pose(case.point) @ case.arm.fk(case.goal),
}


def resident_mb() -> float:
    """Memory that this process holds, without what the allocator could return."""
    gc.collect()
    if hasattr(libc := ctypes.CDLL(None), "malloc_trim"):
        libc.malloc_trim(0)
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6


@pytest.mark.parametrize("kind", MAKERS)
def test_dropped_objects_leave_no_memory_behind(bundled, tmp_path, fuzz_seconds: float, kind: str):
    goal = bundled.home + 0.1
    motion = armctl.move_j(bundled, bundled.home, goal)
    log = armctl.simulate(bundled, "pd", motion)
    case = SimpleNamespace(arm=bundled, goal=goal, motion=motion, log=log, point=bundled.fk(goal).position, folder=tmp_path)
    make = MAKERS[kind]
    for _ in range(OBJECTS // 3):  # caches fill
        make(case)
    before = resident_mb()
    end = time.monotonic() + fuzz_seconds
    made = 0
    while made < OBJECTS or (made < MAX_OBJECTS and time.monotonic() < end):
        make(case)
        made += 1
    growth = resident_mb() - before
    print(f"{made} of {kind}: {growth:+.1f} MB")
    assert growth < MAX_GROWTH_MB
