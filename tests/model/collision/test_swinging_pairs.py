"""Proofs of clearance where one part of the bound of a motion is all there is, beside closed formulas.

Of balls on two hinges on one axis, on the far side of it, nothing approaches to first order: in the middle of each motion they
are farthest from each other and move across the line between them. How near they come follows from the law of cosines, and
half of it from the product of the turns of the two hinges. The middle of a rod on its hinge does not move at all. A ball on a
slide moves by a polynomial of time.
"""

from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import armctl
from armctl.model.collision.checker import CollisionChecker

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


MASS = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'


def beside_a_ball(tmp_path: Path, inside: str, names: str) -> armctl.Arm:
    """An arm with a tip that has one pair: with a ball that stands still on the axis x."""
    joints = names.split()
    motors = "".join(f'<motor joint="{name}" ctrlrange="-9 9"/>' for name in joints)
    path = tmp_path / "beside.xml"
    path.write_text(
        f'<mujoco><compiler angle="radian"/><worldbody><geom size="{RADIUS}" pos="{APART} 0 0"/>{inside}</worldbody>'
        f"<actuator>{motors}</actuator></mujoco>"
    )
    arm = armctl.load(path, tip="tip")
    assert len(CollisionChecker(arm).geometry.pairs) == 1
    return arm


# Their sizes in m, and the point of each that is farthest from its middle.
SHAPES = {
    "long capsule": ("capsule", (0.002, 0.298), (0.0, 0.0, 0.3)),
    "short capsule": ("capsule", (0.2, 0.05), (0.0, 0.0, 0.25)),
    "long box": ("box", (0.3, 0.01, 0.02), (0.3, 0.01, -0.02)),
    "flat box": ("box", (0.01, 0.2, 0.15), (-0.01, 0.2, 0.15)),
    "long cylinder": ("cylinder", (0.01, 0.3), (0.01, 0.0, 0.3)),
    "flat cylinder": ("cylinder", (0.25, 0.03), (0.0, 0.25, -0.03)),
    "needle": ("ellipsoid", (0.01, 0.3, 0.02), (0.0, 0.3, 0.0)),
    "disc": ("ellipsoid", (0.3, 0.299, 0.02), (0.3, 0.0, 0.0)),
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("begin", [0.0, -0.013, -1.1])
@pytest.mark.parametrize("end", [0.05, 1.4])
def test_the_end_of_a_shape_that_turns_about_its_middle_is_proved(tmp_path: Path, shape: str, begin: float, end: float):
    """It points at the ball at the angle 0, which no bisection meets but at the begin of the motion."""
    kind, sizes, farthest = SHAPES[shape]
    reach = np.linalg.norm(farthest)
    turned = Rotation.align_vectors([[1.0, 0.0, 0.0]], [np.array(farthest) / reach])[0].as_quat(scalar_first=True)
    numbers = " ".join(map(str, sizes))
    geom = f'<geom type="{kind}" size="{numbers}" quat="{" ".join(map(str, turned))}"/><site name="tip"/>'
    hinge = f'<body><joint name="b" axis="0 0 1" range="-3 3"/>{MASS}{geom}</body>'
    # What one joint alone keeps apart is proved in advance.
    arm = beside_a_ball(tmp_path, f'<body><joint name="a" axis="0 1 0" range="-3 3"/>{MASS}{hinge}</body>', "a b")
    checker = CollisionChecker(arm)
    least = APART - reach - RADIUS
    for motion in ([begin, end], [end, begin], [-begin, -end]):
        ends = np.outer(motion, [0.0, 1.0])
        assert checker.line_hit(*ends, least + HAIR_M) is not None
        assert checker.line_hit(*ends, least - LITTLE_M) is None


@pytest.mark.parametrize("turn", [0.3, 0.7, 1.5])
def test_what_a_hinge_and_the_slide_on_it_bring_nearer_together_is_proved(tmp_path: Path, turn: float):
    """The slide starts across the line to the other ball, and the hinge turns it towards that ball."""
    ball = f'<geom size="{RADIUS}"/><site name="tip"/>'
    slide = f'<body><joint name="b" type="slide" axis="0 1 0" range="-1 1"/>{MASS}{ball}</body>'
    arm = beside_a_ball(tmp_path, f'<body><joint name="a" axis="0 0 1" range="-3 3"/>{MASS}{slide}</body>', "a b")
    checker = CollisionChecker(arm)
    way = 0.15
    end = np.array([turn, -way])  # at x = way sin(turn), as the begin, which is its opposite
    least = np.hypot(APART - way * np.sin(turn), way * np.cos(turn)) - 2 * RADIUS
    assert least < APART - 2 * RADIUS - LITTLE_M
    assert checker.line_hit(-end, end, least + HAIR_M) is not None
    assert checker.line_hit(-end, end, least - LITTLE_M) is None


@pytest.fixture
def sliding(tmp_path: Path) -> CollisionChecker:
    """A ball on a slide along x, APART from another one at the position 0."""
    ball = f'<geom size="{RADIUS}"/><site name="tip"/>'
    return CollisionChecker(
        beside_a_ball(tmp_path, f'<body><joint name="a" type="slide" axis="1 0 0" range="-1 1"/>{MASS}{ball}</body>', "a")
    )


def assert_farthest_is_proved(checker: CollisionChecker, knots: np.ndarray, coefficients: np.ndarray, farthest: float):
    """The ball goes that far and no farther, by polynomials (pieces, degree + 1)."""
    least = APART - 2 * RADIUS - farthest
    numbers = np.ascontiguousarray(coefficients[..., None])
    assert checker.motion_hit(knots, numbers, least + HAIR_M) is not None
    assert checker.motion_hit(knots, numbers, least - LITTLE_M) is None


@pytest.mark.parametrize(("power", "degree"), list(combinations_with_replacement([1, 2, 3, 4, 5], 2)))
@pytest.mark.parametrize("duration", [0.25, 1.0, 7.0])
def test_each_power_of_the_time_from_the_middle_is_proved(sliding: CollisionChecker, power: int, degree: int, duration: float):
    """The ball leaves the middle of its motion by that power alone, so no other one makes up for it."""
    unit = np.polynomial.Polynomial([-1.0, 2.0 / duration]) ** power
    coefficients = np.append(0.3 * unit.coef, np.zeros(degree - power))
    assert_farthest_is_proved(sliding, np.array([2.0, 2.0 + duration]), coefficients[None], 0.3)


@pytest.mark.parametrize("pieces", [1, 2, 5])
@pytest.mark.parametrize("degree", [2, 3, 4, 5])
def test_the_farthest_point_of_random_polynomials_is_proved(sliding: CollisionChecker, degree: int, pieces: int):
    rng = np.random.default_rng(degree)
    for _ in range(20):
        durations = rng.uniform(0.2, 2.0, pieces)
        knots = np.append(0.0, durations.cumsum())
        coefficients = []
        farthest = -np.inf
        for duration in durations:
            random = np.polynomial.Polynomial(rng.normal(size=degree + 1), domain=[0.0, duration])
            part = random.convert(domain=[-1, 1])
            turns = part.deriv().roots()
            turns = turns[np.isreal(turns)].real
            times = np.concatenate([[0.0, duration], turns[(turns > 0.0) & (turns < duration)]])
            scale = 0.3 / np.abs(part(times)).max()
            coefficients.append(scale * part.coef)
            farthest = max(farthest, scale * part(times).max())
        assert_farthest_is_proved(sliding, knots, np.array(coefficients), farthest)
