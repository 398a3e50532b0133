"""A peg of 20 mm finds a hole with 0.1 mm of clearance, and the clearance is what it is said to be."""

import runpy
import sys
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from armctl.model.loading.scene import SceneParts

BENCHMARKS = Path(__file__).parents[3] / "benchmarks"
sys.path.append(str(BENCHMARKS))  # a benchmark imports its neighbours
insertion = SimpleNamespace(**runpy.run_path(str(BENCHMARKS / "insertion.py")))
HOLE = np.array(insertion.HOLES["desk_arm"])
ACCURACY_M = 1e-7


@pytest.fixture(scope="module")
def arm():
    return insertion.arm_with_peg(insertion.FILES["desk_arm"], HOLE)


def test_the_gap_is_50_um_in_every_direction(arm):
    """By MuJoCo's contacts of the peg alone, moved away from the axis of the hole at half its depth."""
    spec = mujoco.MjSpec.from_string(insertion.PEG)
    spec.body("peg").add_freejoint()
    spec.option.ccd_tolerance = arm.model.opt.ccd_tolerance
    SceneParts(insertion.hole(np.zeros(3))).build(spec)
    model = spec.compile()
    data = mujoco.MjData(model)

    def touches(radius: float, angle: float) -> bool:
        data.qpos[:3] = [radius * np.cos(angle), radius * np.sin(angle), 0.06 - 0.5 * insertion.DEPTH_M]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        return data.ncon > 0

    data.qpos[4] = 1.0  # upside down, as the arm holds it
    data.qpos[3] = 0.0
    widest = insertion.GAP_M / np.cos(np.pi / insertion.SIDES)  # in the edges between two faces
    for angle in np.linspace(0.0, 2 * np.pi, 49):
        assert not touches(insertion.GAP_M - ACCURACY_M, angle)
        assert touches(widest + ACCURACY_M, angle)
    for angle in 2 * np.pi * np.arange(insertion.SIDES) / insertion.SIDES:
        assert touches(insertion.GAP_M + ACCURACY_M, angle)


@pytest.mark.full
def test_the_peg_is_found_and_inserted(arm):
    run = insertion.insert(arm, HOLE, seed=3)
    assert run.ok
    assert run.beside < 2 * insertion.GAP_M
    assert run.peak_penetration < insertion.PENETRATION_BOUND_M
    assert run.tilt < 2 * insertion.GAP_M / insertion.DEPTH_M + 1e-3


@pytest.mark.nightly
def test_a_peg_that_misses_the_hole_finds_it_from_another_side(arm):
    run = insertion.insert(arm, HOLE, seed=0, offset=6e-3, continuous=False)
    assert run.attempts > 1
    assert run.ok
