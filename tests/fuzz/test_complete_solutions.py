"""What `solve_ik_all` calls complete, is: thousands of random restarts find no solution that it does not list."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

import armctl
from armctl._core import Constraint
from armctl.plan.ik import lm
from armctl.plan.ik.problem import read_problem

CASES_IN_SUITE = 6
RESTARTS = 2000
NEW_RAD = 1e-3  # a solution farther than this from all that are listed is another one
LINK = """<body pos="{pos}"><joint name="j{i}" axis="{axis}" range="{range}"/>
<geom type="capsule" fromto="0 0 0 0.01 0.01 0.02" size="0.01" mass="1" contype="0" conaffinity="0"/>"""


def words(numbers) -> str:
    return " ".join(repr(float(x)) for x in numbers)


def random_arm(rng: np.random.Generator, path: Path) -> armctl.Arm:
    """Six hinges: three consecutive axes meet in a point or are parallel, and so do two of the others; random limits."""
    axes = rng.normal(size=(6, 3))
    offsets = rng.uniform(-0.4, 0.4, (6, 3))
    first = int(rng.integers(4))
    neighbors = [k for k in range(5) if k + 1 < first or k > first + 2]
    for begin, end in ((first, first + 3), (k := int(rng.choice(neighbors)), k + 2)):
        if rng.random() < 0.5:
            offsets[begin + 1 : end] = 0.0
        else:
            axes[begin + 1 : end] = axes[begin]
    bounds = np.where(rng.random(6) < 0.5, 3.14, rng.uniform(1.0, 3.0, 6))
    links = "".join(
        LINK.format(pos=words(offsets[i]), i=i, axis=words(axes[i]), range=words([-bounds[i], bounds[i]])) for i in range(6)
    )
    motors = "".join(f'<motor joint="j{i}" ctrlrange="-200 200"/>' for i in range(6))
    path.write_text(
        f'<mujoco><compiler angle="radian"/><worldbody>{links}<site name="tip" pos="{words(rng.uniform(-0.2, 0.2, 3))}"/>'
        f"{'</body>' * 6}</worldbody><actuator>{motors}</actuator></mujoco>"
    )
    return armctl.load(path)


def found_by_restarts(arm: armctl.Arm, target: armctl.Pose, rng: np.random.Generator) -> np.ndarray:
    """(k, n) the solutions to which descents from random configurations lead."""
    starts = arm.limits.random(arm.home, RESTARTS, rng)
    rows = np.tile(target.rows.reshape(1, 12), (RESTARTS, 1))
    search = lm.search(read_problem(arm, Constraint.POSE, rows, starts, 1e-9, 1e-9, 0), 0, 1, starts)
    return search.q[search.solved]


def is_listed(q: np.ndarray, listed: np.ndarray) -> bool:
    """Whether a configuration is one of those listed, up to whole turns."""
    difference = np.abs((listed - q + np.pi) % (2 * np.pi) - np.pi)
    return bool((difference.max(axis=1) < NEW_RAD).any())


@pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")
def test_restarts_find_nothing_beside_a_complete_list(tmp_path, fuzz_cases):
    tally: Counter[str] = Counter()
    for case, rng in enumerate(fuzz_cases(CASES_IN_SUITE)):
        arm = random_arm(rng, tmp_path / "arm.xml")
        target = arm.fk(arm.limits.random(arm.home, 1, rng)[0])
        listed = armctl.solve_ik_all(arm, target)
        assert listed, f"case {case}: {listed.reason[0]}"
        found = found_by_restarts(arm, target, rng)
        missing = [q for q in found if not is_listed(q, listed.q)]
        tally["restarts that ended at a solution"] += len(found)
        tally["complete" if listed.is_complete else "not called complete"] += 1
        assert not (listed.is_complete and missing), f"case {case}: {len(listed)} listed, but also {missing[0].tolist()}"
    assert tally["complete"] > tally["not called complete"], tally
    assert tally["restarts that ended at a solution"] > tally["complete"], tally
    print(dict(tally))
