"""Every chain of every robot at hand: the model is MuJoCo's, reachable poses are found, computed torque is exact."""

import sys
from pathlib import Path

import pytest

from armctl.robot.parity import PARITY_TOLERANCE

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
from robots import chains_of, measure, robots_at_hand  # pyright: ignore[reportMissingImports]  # the table of docs/robots.md

POSES = 100  # at each chain
TRACKING = 1e-6  # rad


@pytest.mark.filterwarnings("ignore::armctl.ArmctlWarning")
@pytest.mark.parametrize("robot", robots_at_hand())
def test_every_chain_keeps_its_promises(robot: str):
    for base, arm in chains_of(robot):
        row = measure(arm, base, POSES)
        assert row.parity <= PARITY_TOLERANCE, arm
        assert row.solved >= 0.999, arm
        assert row.computed_torque <= TRACKING or row.reason, arm
