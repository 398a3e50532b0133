"""Proofs of clearance where nothing approaches to first order: balls on two hinges on one axis, on the far side of it.

In the middle of each motion the balls are farthest from each other and move across the line between them. How near they come
follows from the law of cosines, and half of it from the product of the turns of the two hinges.
"""

from pathlib import Path

import numpy as np
import pytest

import armctl
from armctl.collision.checker import CollisionChecker

RADIUS = 0.002  # m, of a ball
LEVER = 0.3  # m, from the axis
APART = 0.5  # m, from axis to axis, or to a ball that stands still
HAIR_M = 1e-5
LITTLE_M = 1e-2


def swing(names: str, at: float, lever: float) -> str:
    """Two hinges on the axis z and a ball."""
    outer, inner = names
    ball = f'<geom size="{RADIUS}" pos="{lever} 0 0" mass="0.1"/><site name="tip_{inner}" pos="{lever} 0 0"/>'
    hinge = '<joint name="{}" axis="0 0 1" range="-3 3" armature="0.1"/>'
    inside = f"<body>{hinge.format(inner)}{ball}</body>"
    return f'<body pos="{at} 0 0">{hinge.format(outer)}<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>{inside}</body>'


@pytest.fixture(params=["a ball that stands still", "a ball on the base of the hinges", "a ball that swings as well"])
def pair(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[armctl.Arm, int]:
    """The arm, and how many balls swing in its only pair."""
    still = f'<geom size="{RADIUS}" pos="{-APART} 0 0" mass="0.1"/>'
    both = request.param == "a ball that swings as well"
    inside = swing("ab", 0.0, LEVER) + (swing("cd", -APART, -LEVER) if both else "")
    around = ""
    if request.param == "a ball that stands still":
        around = still
    else:
        mass = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
        base = f'<joint name="base" axis="0 1 0" range="-3 3" armature="0.1"/>{mass}'
        inside = f"<body>{base}{'' if both else still}{inside}</body>"
    names = ["base", "a", "b"] if "base" in inside else ["a", "b"]
    tie = '<equality><joint joint1="c" joint2="a" polycoef="0 -1"/><joint joint1="d" joint2="b" polycoef="0 -1"/></equality>'
    motors = "".join(f'<motor joint="{name}" ctrlrange="-9 9"/>' for name in names)
    path = tmp_path / "swing.xml"
    path.write_text(
        f'<mujoco><compiler angle="radian"/><worldbody>{around}{inside}</worldbody>{tie if both else ""}'
        f"<actuator>{motors}</actuator></mujoco>"
    )
    return armctl.load(path, tip="tip_b"), 2 if both else 1


@pytest.mark.parametrize("turn", [0.05, 0.3, 1.0, 1.6])
@pytest.mark.parametrize("share", [0.5, 0.8])
def test_what_two_hinges_bring_nearer_together_is_proved(pair: tuple[armctl.Arm, int], turn: float, share: float):
    """Straight from one side to the other: they are nearest at both ends."""
    arm, swinging = pair
    checker = CollisionChecker(arm)
    assert len(checker.geometry.pairs) == 1
    end = np.append(np.zeros(arm.n - 2), [share * turn, (1 - share) * turn])
    apart = APART + swinging * LEVER * np.cos(turn)
    across = LEVER * np.sin(turn) if swinging == 1 else 0.0
    least = np.hypot(apart, across) - 2 * RADIUS
    assert checker.line_hit(-end, end, least + HAIR_M) is not None
    assert checker.line_hit(-end, end, least - LITTLE_M) is None
