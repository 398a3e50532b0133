"""Control laws and the dynamics of arms as pure functions of JAX, for `jit`, `vmap`, `grad` and `scan`, on CPUs and GPUs.

The arm and the gains are pytrees. The functions compute what the controllers of armctl and Pinocchio compute: in float64 on a
CPU, the difference is one of rounding. JAX computes in float32 unless `jax.config.update("jax_enable_x64", True)` is called
first. The names are those of this package and not of `armctl`, which works without JAX.
"""

from importlib.util import find_spec

from armctl.core.errors import NotInstalledError

if find_spec("jax") is None:
    raise NotInstalledError.from_extra("armctl.envs.jax needs JAX", "jax")

from armctl.envs.jax.arm_model import ArmModel, arm_model
from armctl.envs.jax.control import (
    ComputedTorqueGains,
    OperationalSpaceGains,
    PDGains,
    Reference,
    computed_torque,
    operational_space,
    pd,
    tick_reference,
)
from armctl.envs.jax.equations_of_motion import forward_dynamics, gravity, inverse_dynamics, mass_matrix, tip_jacobian, tip_pose

__all__ = [
    "ArmModel",
    "ComputedTorqueGains",
    "OperationalSpaceGains",
    "PDGains",
    "Reference",
    "arm_model",
    "computed_torque",
    "forward_dynamics",
    "gravity",
    "inverse_dynamics",
    "mass_matrix",
    "operational_space",
    "pd",
    "tick_reference",
    "tip_jacobian",
    "tip_pose",
]
