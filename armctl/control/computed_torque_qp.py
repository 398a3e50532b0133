"""Computed torque within the limits of torque, velocity and position, by a quadratic program."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple, Self

import daqp
import numpy as np

from armctl.control import feedforward
from armctl.control.computed_torque import ComputedTorque
from armctl.control.gains import DEFAULT_BANDWIDTH
from armctl.control.interface import State, explains_wrong_arguments
from armctl.control.task_space import arm_length
from armctl.core.errors import NotInstalledError
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, choice
from armctl.robot.arm import Arm

SOLVERS = ("daqp", "osqp", "proxqp")
# First-order solvers stop at 1e-3 by default: that exceeds the torque limits of a Panda by 0.1 N m.
_SOLVER_OPTIONS: dict[str, dict[str, Any]] = {
    "osqp": {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 20_000},
    "proxqp": {"eps_abs": 1e-9},
}
_UNBOUNDED = 1e30  # infinite for all solvers
_VIOLATION_WEIGHT = 1e4  # of limits that cannot be respected, relative to the deviation of the tip


class ComputedTorqueQP(ComputedTorque):
    """Computed torque that respects the limits of torque, velocity and position with the least error of the tip.

    While the desired acceleration respects all limits, it is applied unchanged. Otherwise a minimizes the square of
    J (a - a_desired), subject to

        -tau_max <= M a + h <= tau_max,    -v_max <= v + dt a <= v_max,    and the viability of q,

    in which rotations weigh less than translations, and the joints decide what the tip leaves open. Speeds are viable if the
    joint stops before the end of its range with its greatest acceleration, or with the torque that is left (Del Prete, "Joint
    position and velocity bounds in discrete-time acceleration/torque control of robot manipulators", 2018). If the limits
    contradict each other, the torque limits hold and the violation of the others is minimal.

    The joints then recover on a curve of the tip. The missing acceleration for a straight return is therefore added to
    a_desired; it is of second order in the errors.

    Clipping each torque, in contrast, moves the arm off its path in all directions. The limits hold for an arm like the model;
    add a known payload to it (`Arm.with_payload`).

    Attributes:
        bandwidth: rad/s.
        damping_ratio: 1 is critically damped.
        solver: "daqp", "osqp" or "proxqp".
    """

    def __init__(
        self,
        arm: Arm,
        *,
        bandwidth: float = DEFAULT_BANDWIDTH,
        damping_ratio: float = 1.0,
        solver: str = "daqp",
    ):
        """A computed torque controller with limits for an arm.

        Args:
            arm: The arm whose model and limits it uses.
            bandwidth: rad/s, the natural frequency of the error.
            damping_ratio: 1 is critically damped.
            solver: "daqp" (an active-set method, exact and fastest), "osqp" or "proxqp".

        Raises:
            InputError: A gain is negative or not finite, or there is no such solver.
            NotInstalledError: The solver is not installed.
        """
        super().__init__(arm, bandwidth=bandwidth, damping_ratio=damping_ratio)
        self.solver = choice("solver", solver, SOLVERS)
        self.name = "qp"
        _check_installed(self.solver)
        self._allocate()

    def _allocate(self) -> None:
        n = self.n
        self._scratch = np.zeros(self._arm.packed_dynamics.work_size())
        shapes = [(6, n), (n, n), (n, n), (n, n), (18,), (2 * n,), (2 * n,)]
        self._program = _Program(*map(np.zeros, shapes))
        self._limits = np.zeros(0)
        self._limits_of = self._limits  # the parameters of the law that the limits belong to

    def fresh(self) -> Self:
        """The same law with a memory of its own, for a run at the same time."""
        other = super().fresh()
        other._allocate()
        return other

    @explains_wrong_arguments
    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque for the coming control period.

        Args:
            state: The measured state.
            setpoint: Where the arm should be.

        Returns:
            (n,) N m, within the limits.

        Raises:
            InputError: An argument is no `State` or no `Setpoint`, or a vector has a wrong length.
        """
        from armctl.control import computed_torque_kernel as law
        from armctl.control.qp_kernel import limit_program

        n = self.n
        tau = super().torque(state, setpoint)
        if self._limits_of is not self._parameters:
            self._limits = self._limit_parameters(state.dt, state.continuous)
            self._limits_of = self._parameters
        v_ref, a_ref = feedforward.sampled(setpoint)
        vectors = self.memory[: law.VECTORS * n].reshape(law.VECTORS, n)
        rows = np.array([state.q, state.v, setpoint.q, v_ref, a_ref, vectors[law.CORRECTION], vectors[law.ADDED]])
        program = self._program
        if not limit_program(self._limits, rows, tau, self._scratch, *program):
            return tau
        tau_max = self._arm.limits.tau_max
        return np.clip(tau + program.M @ self._deviation(program), -tau_max, tau_max)

    def _limit_parameters(self, dt: float, continuous: bool) -> Array:
        from armctl.robot.dynamics_kernel import HALF_STEP

        limits = self._arm.limits
        stiffness = self.bandwidth**2
        damping = 2 * self.damping_ratio * self.bandwidth
        header = [dt, 0.5 * continuous, arm_length(self._arm), stiffness, damping]
        bounds = [limits.q_min, limits.q_max, limits.v_max, limits.a_max, limits.tau_max]
        model = self._arm.packed_dynamics.vector(dt, continuous)
        model[HALF_STEP] = 0.0  # the program is that of the start of the period
        return np.concatenate([header, *bounds, model])

    def _deviation(self, program: _Program) -> Array:
        """The solution (n,), rad/s^2. Where limits exclude each other, those of velocity and position become costs."""
        n = self.n
        lower = program.lower
        upper = program.upper
        found = _solved(self.solver, program.H, np.zeros(n), program.M, lower, upper)
        if found is not None:
            return found
        nearest = np.clip(0.0, lower[:n], upper[:n])
        weights = np.where(nearest != 0.0, _VIOLATION_WEIGHT * np.trace(program.H), 0.0)
        lower[:n] = np.where(nearest != 0.0, -_UNBOUNDED, np.minimum(lower[:n], 0.0))
        upper[:n] = np.where(nearest != 0.0, _UNBOUNDED, np.maximum(upper[:n], 0.0))
        found = _solved(self.solver, program.H + np.diag(weights), -weights * nearest, program.M, lower, upper)
        return np.zeros(n) if found is None else found


class _Program(NamedTuple):
    """The arrays that `limit_program` fills; J, factor and motion are scratch."""

    J: Array
    H: Array
    M: Array
    factor: Array
    motion: Array
    lower: Array
    upper: Array


def _check_installed(solver: str) -> None:
    import qpsolvers

    if solver not in qpsolvers.available_solvers:
        raise NotInstalledError(f"solver: {solver} is not installed; install it with: pip install 'mujoco-armctl[proxqp]'")


def _solved(solver: str, H: Array, f: Array, M: Array, lower: Array, upper: Array) -> Array | None:
    """The minimum of x H x / 2 + f x with x and M x within their bounds (2n,), or None if there is no such x."""
    if solver == "daqp":
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
