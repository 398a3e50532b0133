"""An arm is a value: threads may share it, and what they compute is what one thread computes."""

import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from arms import arm_of

import armctl

SEEDS = range(40)


@pytest.fixture(autouse=True)
def _hasty():
    """Threads change places a thousand times as often as usual."""
    usual = sys.getswitchinterval()
    sys.setswitchinterval(5e-6)
    yield
    sys.setswitchinterval(usual)


def position(arm: armctl.Arm, seed: int) -> np.ndarray:
    return arm.limits.random(arm.home, 1, np.random.default_rng(seed))[0]


def solved(arm: armctl.Arm, seed: int) -> list[float]:
    results = [armctl.solve_ik(arm, arm.fk(position(arm, 40 * seed + k))) for k in range(40)]
    return [x for result in results for x in (*result.q, result.position_error, result.orientation_error)]


def solved_without_contact(arm: armctl.Arm, seed: int) -> list[float]:
    result = armctl.solve_ik(arm, arm.fk(position(arm, seed)), avoid=True)
    return [*result.q, result.position_error, float(result.ok)]


def planned(arm: armctl.Arm, seed: int) -> list[float]:
    below = arm.fk(arm.home).position - [0.0, 0.0, 1e-3 * (seed + 1)]
    return armctl.move_l(arm, arm.home, below)(0.1).q.tolist()


def driven(arm: armctl.Arm, seed: int) -> list[float]:
    motion = armctl.move_j(arm, arm.home, 0.9 * arm.home + 0.1 * position(arm, seed))
    return armctl.simulate(arm, armctl.ComputedTorque(arm), motion, dwell=0.0).q[-1].tolist()


@pytest.mark.parametrize("work", [solved, solved_without_contact, planned, driven], ids=lambda work: work.__name__)
def test_threads_share_an_arm(work: Callable[[armctl.Arm, int], list[float]]):
    arm = arm_of("robot_arm_3dof")
    alone = [work(arm, seed) for seed in SEEDS]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(work, [arm] * len(SEEDS), SEEDS))
    assert together == alone
