"""What a collision checker takes and returns."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import mujoco

from armctl.core.limits import Limits
from armctl.core.validation import Array, IntArray
from armctl.robot.joint_map import JointMap


class MovingJoints(Protocol):
    """What a checker needs of an arm, or of several: the joints that move, their limits, and where everything is at home."""

    @property
    def model(self) -> mujoco.MjModel:
        """The compiled model."""
        ...

    @property
    def joint_map(self) -> JointMap:
        """The joints that move."""
        ...

    @property
    def limits(self) -> Limits:
        """Their limits."""
        ...

    @property
    def home(self) -> Array:
        """(n,) rad."""
        ...

    @property
    def home_qpos(self) -> Array:
        """(nq,)."""
        ...


class KeptAxis(NamedTuple):
    """An axis of the tip that keeps its direction.

    Attributes:
        name: "x", "y" or "z".
        q: (n,) rad, where it has the direction that it keeps.
        direction: (3,) of the world.
        within: rad that it may tilt.
    """

    name: str
    body: int
    q: Array
    direction: Array
    within: float


class NearPairs(NamedTuple):
    """Pairs that are close.

    Attributes:
        pairs: (k,) their rows in the checker's geometry.
        distances: m, (k,) negative where a pair overlaps.
        gradients: m/rad, (k, n) the derivatives of the distances by the joints.
    """

    pairs: IntArray
    distances: Array
    gradients: Array
