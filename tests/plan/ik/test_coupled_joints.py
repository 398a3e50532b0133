"""All configurations of an arm whose second joint follows its first at half the speed, beside a search along that joint."""

from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import brentq
from synthetic import mjcf, motors, ties

import armctl

HEIGHT = 0.1  # m, of the first joint
UPPER = 0.3
FORE = 0.25
HAND = 0.2
LEAD = 7.0  # rad: the leader turns more than once, and a turn of it is half a turn of its follower
WRIST = 3.0


@pytest.fixture(scope="module")
def folding(tmp_path_factory: pytest.TempPathFactory) -> armctl.Arm:
    """An arm in the plane of x and z with the joints b, c = b / 2 and d."""
    inside = f'<site name="tip" pos="0 0 {HAND}"/>'
    for name, below, length, bound in (("d", FORE, HAND, WRIST), ("c", UPPER, FORE, 4.0), ("b", HEIGHT, UPPER, LEAD)):
        inside = (
            f'<body pos="0 0 {below}"><joint name="{name}" axis="0 1 0" range="{-bound} {bound}"/>'
            f'<geom type="capsule" fromto="0 0 0 0 0 {length}" size="0.02" mass="0.5" contype="0" conaffinity="0"/>'
            f"{inside}</body>"
        )
    path = Path(tmp_path_factory.mktemp("folding")) / "folding.xml"
    path.write_text(mjcf(inside, ties("c b 0 0.5") + motors("b d")))
    return armctl.load(path)


def wrist_at(b):
    """(..., 2) m, x and z of the last joint."""
    return np.stack([UPPER * np.sin(b) + FORE * np.sin(1.5 * b), HEIGHT + UPPER * np.cos(b) + FORE * np.cos(1.5 * b)], axis=-1)


def searched(point: np.ndarray) -> np.ndarray:
    """Every (b, d) inside the limits with the tip at a point, from the changes of sign of what the hand is too long."""

    def too_far(b):
        return np.linalg.norm(wrist_at(b) - point, axis=-1) - HAND

    grid = np.linspace(-LEAD, LEAD, 4001)
    signs = np.sign(too_far(grid))
    found = []
    for k in np.flatnonzero(np.diff(signs)):
        b = brentq(too_far, grid[k], grid[k + 1], xtol=1e-13)
        hand = point - wrist_at(b)
        d = np.angle(np.exp(1j * (np.arctan2(hand[0], hand[1]) - 1.5 * b)))
        if abs(d) <= WRIST:
            found.append((b, d))
    return np.array(found)


@pytest.mark.parametrize("start", [0.0, -0.9, 0.9])
def test_every_configuration_is_found_also_those_a_turn_of_the_leader_apart(folding: armctl.Arm, start: float):
    turned = 0
    for q in folding.limits.random(folding.home, 20, np.random.default_rng(0)):
        target = folding.fk(q).position
        expected = searched(target[[0, 2]])
        found = armctl.solve_ik_all(folding, target, q0=start * folding.limits.q_max)
        assert found.ok.all()
        assert len(found) == len(expected)
        assert max(np.abs(found.q - each).max(axis=1).min() for each in expected) < 1e-3
        turned += np.ptp(expected[:, 0]) > 2 * np.pi
    assert turned > 5
