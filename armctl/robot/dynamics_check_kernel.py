"""All functions of `dynamics_kernel` that `PackedDynamics` checks, as one: numba compiles it in half the time of five."""

from __future__ import annotations

from armctl.core.jit import njit
from armctl.robot.dynamics_kernel import inverse_dynamics, locate, mass_matrix, tip_jacobian, tip_position


@njit
def evaluate(model, q, v, a, work, tau, M, J, position):
    """Inverse dynamics (n,), mass matrix (n, n), and the tip's Jacobian (6, n) and position (3,) at a state."""
    inverse_dynamics(model, q, v, a, work, tau)
    mass_matrix(model, work, M)
    locate(model, work)
    tip_jacobian(model, work, J)
    x, y, z = tip_position(model, work)
    position[0] = x
    position[1] = y
    position[2] = z
