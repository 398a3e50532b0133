"""Computed torque within the limits of torque, velocity and position, by a quadratic program."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from armctl.control.computed_torque import ComputedTorque
from armctl.control.gains import DEFAULT_BANDWIDTH
from armctl.control.task_space import arm_length
from armctl.core.errors import NotInstalledError
from armctl.core.validation import Array, choice
from armctl.robot.arm import Arm

if TYPE_CHECKING:
    from armctl.control.qp_kernel import Program

OWN_SOLVER = "compiled"
SOLVERS = (OWN_SOLVER, "daqp", "osqp", "proxqp")
# First-order solvers stop at 1e-3 by default: that exceeds the torque limits of a Panda by 0.1 N m.
_SOLVER_OPTIONS: dict[str, dict[str, Any]] = {
    "osqp": {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 20_000},
    "proxqp": {"eps_abs": 1e-9},
}


class ComputedTorqueQP(ComputedTorque):
    """Computed torque that respects the limits of torque, velocity and position with the least error of the tip.

    While the desired acceleration respects all limits, it is applied unchanged. Otherwise a minimizes the square of
    J (a - a_desired), subject to

        -tau_max <= M a + h <= tau_max,    -v_max <= v + dt a <= v_max,    and the viability of q,

    in which rotations weigh less than translations, and the joints decide what the tip leaves open. Speeds are viable if the
    joint stops before the end of its range with its greatest acceleration, or with the torque that is left (Del Prete, "Joint
    position and velocity bounds in discrete-time acceleration/torque control of robot manipulators", 2018). If the limits
    contradict each other, the torque limits hold and the violation of the others is minimal. If that is impossible too, because
    other limits, which a_desired respects, contradict the torque limits, the torque of a_desired is clipped.

    The joints then recover on a curve of the tip. The missing acceleration for a straight return is therefore added to
    a_desired; it is of second order in the errors.

    Clipping each torque, in contrast, moves the arm off its path in all directions. The limits hold for an arm like the model;
    add a known payload to it (`Arm.with_payload`).

    Attributes:
        bandwidth: rad/s.
        damping_ratio: 1 is critically damped.
        solver: "compiled", "daqp", "osqp" or "proxqp".
    """

    def __init__(
        self,
        arm: Arm,
        *,
        bandwidth: float = DEFAULT_BANDWIDTH,
        damping_ratio: float = 1.0,
        solver: str = OWN_SOLVER,
    ):
        """A computed torque controller with limits for an arm.

        Args:
            arm: The arm whose model and limits it uses.
            bandwidth: rad/s, the natural frequency of the error.
            damping_ratio: 1 is critically damped.
            solver: "compiled" (an exact active-set method, part of the kernel), or a library to compare it with: "daqp", "osqp"
                or "proxqp". With a library, simulations run in the Python loop.

        Raises:
            InputError: A gain is negative or not finite, or there is no such solver.
            NotInstalledError: The solver is not installed.
        """
        super().__init__(arm, bandwidth=bandwidth, damping_ratio=damping_ratio)
        self.solver = choice("solver", solver, SOLVERS)
        self.name = "qp"
        _check_installed(self.solver)

    @property
    def kernel(self) -> Callable[..., None]:
        """The law, as `KernelController` describes it; not compiled with the solver of a library."""
        from armctl.control.qp_kernel import computed_torque_qp

        return (
            computed_torque_qp
            if self.solver == OWN_SOLVER
            else partial(_law_with_library, self.solver, self._arm.limits.tau_max)
        )

    @property
    def is_compiled(self) -> bool:
        """Whether the kernel is the whole law: not with the solver of a library."""
        return super().is_compiled and self.solver == OWN_SOLVER

    def _constants(self, dt: float, continuous: bool) -> Sequence[Array | Sequence[float]]:
        from armctl.robot.dynamics_kernel import HALF_STEP

        limits = self._arm.limits
        stiffness = self.bandwidth**2
        damping = 2 * self.damping_ratio * self.bandwidth
        header = [dt, 0.5 * continuous, arm_length(self._arm), stiffness, damping]
        bounds = [limits.q_min, limits.q_max, limits.v_max, limits.a_max, limits.tau_max]
        model = self._arm.packed_dynamics.vector(dt, continuous)
        model[HALF_STEP] = 0.0  # the program is that of the start of the period
        return header, *bounds, model, *super()._constants(dt, continuous)

    def _own_memory_size(self) -> int:
        from armctl.control.qp_kernel import memory_size

        return memory_size(self.n)


def _check_installed(solver: str) -> None:
    if solver == OWN_SOLVER:
        return
    import qpsolvers

    if solver not in qpsolvers.available_solvers:
        raise NotInstalledError(f"solver: {solver} is not installed; install it with: pip install 'mujoco-armctl[proxqp]'")


def _law_with_library(
    solver: str, tau_max: Array, params: Array, q: Array, v: Array, reference: Array, memory: Array, tau: Array
) -> None:
    """The law of the kernel, with the solver of a library."""
    from armctl.control.qp_kernel import computed_torque_qp, last_program

    computed_torque_qp(params, q, v, reference, memory, tau)
    program = last_program(memory, len(tau))
    if program is not None:
        tau[:] = np.clip(program.torque + program.M @ _deviation(solver, program), -tau_max, tau_max)


def _deviation(solver: str, program: Program) -> Array:
    """The solution (n,), rad/s^2. Where limits contradict each other, those of velocity and position become costs."""
    from armctl.control.active_set_kernel import UNBOUNDED
    from armctl.control.qp_kernel import VIOLATION_WEIGHT

    H, M, lower, upper, _ = program
    n = len(H)
    found = _solved(solver, H, np.zeros(n), M, lower, upper)
    if found is not None:
        return found
    nearest = np.clip(0.0, lower[:n], upper[:n])
    weights = np.where(nearest != 0.0, VIOLATION_WEIGHT * np.trace(H), 0.0)
    is_free = np.concatenate([nearest != 0.0, np.zeros(n, bool)])
    lower = np.where(is_free, -UNBOUNDED, lower)
    upper = np.where(is_free, UNBOUNDED, upper)
    found = _solved(solver, H + np.diag(weights), -weights * nearest, M, lower, upper)
    return np.zeros(n) if found is None else found


def _solved(solver: str, H: Array, f: Array, M: Array, lower: Array, upper: Array) -> Array | None:
    """The minimum of x H x / 2 + f x with x and M x within their bounds (2n,), or None if there is no such x."""
    if solver == "daqp":
        import daqp

        x, _, status, _ = daqp.solve(H, f, M, upper, lower)
        return x if status == 1 else None
    import qpsolvers

    n = len(f)
    G = np.vstack([M, -M])
    h = np.concatenate([upper[n:], -lower[n:]])
    problem = qpsolvers.Problem(H, f, G, h, None, None, lower[:n], upper[:n])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # solvers warn of infeasible programs, for which there is a second one
        solution = qpsolvers.solve_problem(problem, solver=solver, **_SOLVER_OPTIONS[solver])
    return solution.x if solution.found else None
