"""What a collision checker takes and returns."""

from typing import NamedTuple, Protocol

import mujoco

from armctl.core.limits import Limits
from armctl.core.validation import Array, IntArray
from armctl.model.arm.joint_map import JointMap


class MovingJoints(Protocol):
    """What checks and planning need of an arm, or of several: the joints that move, and where everything is at home."""

    @property
    def model(self) -> mujoco.MjModel: ...

    @property
    def joint_names(self) -> tuple[str, ...]: ...  # the n joints

    @property
    def joint_map(self) -> JointMap: ...

    @property
    def limits(self) -> Limits: ...

    @property
    def units(self) -> tuple[str, ...]: ...  # what each joint is measured in

    @property
    def home(self) -> Array: ...  # (n,) rad

    @property
    def home_qpos(self) -> Array: ...  # (nq,)

    @property
    def unchecked_links(self) -> tuple[str, ...]: ...  # links without a collision shape that they need


class NearPairs(NamedTuple):
    """Pairs that are close."""

    pairs: IntArray  # (k,) their rows in the checker's geometry
    distances: Array  # m, (k,) negative where a pair overlaps
    gradients: Array  # m/rad, (k, n) the derivatives of the distances by the joints
