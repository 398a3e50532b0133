"""Joint velocities towards one target by a quadratic program with mink's tasks."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from armctl.core.errors import InputError
from armctl.core.target import TargetLike
from armctl.core.validation import Array, flag, number, shown
from armctl.model.arm.arm import Arm
from armctl.plan.ik.problem import read_target

if TYPE_CHECKING:
    import mink
    import qpsolvers
    from mink.tasks import BaseTask

DAMPING = 1e-9  # of all joints of the model; those outside the arm have no other term
MAX_CUTS = 4  # of a step whose end is too near something
MAX_HALVINGS = 4  # of that step, if cutting it does not help
VELOCITY_ROUNDING = 1e-12  # relative: dq / dt must not round to more than v_max
POSITION_ROUNDING = 4 * np.finfo(float).eps  # relative: q + dt * v must not round to a position outside the limits
# A first-order solver stops at 1e-3 by default, which is visible in a joint velocity.
QP_SOLVERS: dict[str, dict[str, Any]] = {"daqp": {}, "osqp": {"eps_abs": 1e-7, "eps_rel": 1e-7}}


class TargetProgram:
    """The program of one arm: position and velocity limits hold even if the solver fails. Arguments as for `DifferentialIk`."""

    def __init__(
        self,
        arm: Arm,
        posture: Array,
        posture_gain: float,
        avoid: bool,
        clearance: float,
        tasks: Sequence[BaseTask],
        limits: Sequence[mink.Limit],
        constraints: Sequence[mink.Task],
        solver: str,
    ):
        import mink
        from mink.tasks import BaseTask

        from armctl.plan.ik.tasks import ClearanceLimit, TipTask

        self._solver = solver
        self._arm = arm
        self.status = "solved"
        self.configuration = mink.Configuration(arm.model, arm.home_qpos.copy())
        self.tip = TipTask(arm, posture)
        self._posture_gain = posture_gain
        self._tasks = [self.tip, *_checked_list("tasks", tasks, BaseTask)]
        self._limits = _checked_list("limits", limits, mink.Limit)
        self._constraints = _checked_list("constraints", constraints, mink.Task)
        self._is_alone = len(self._tasks) == 1
        clearance = number("clearance", clearance, 0.0)
        self._clearance = ClearanceLimit(arm, clearance) if flag("avoid", avoid) else None
        self._all_limits = [*self._limits, self._clearance] if self._clearance is not None else self._limits
        self._needs_kinematics = bool(self._limits or self._constraints or not self._is_alone)

    @property
    def has_additions(self) -> bool:
        """Whether it has more than the target: clearances, or tasks, limits and constraints of mink."""
        return bool(self._all_limits or self._constraints or not self._is_alone)

    def step(self, q: Array, target: TargetLike, dt: float, free_axis: str | None) -> tuple[Array, str]:
        """The joint velocity (n,) from q (n,) for the next dt, and how the step ended: `DifferentialIk.status`."""
        constraint, numbers = read_target(target, free_axis)
        low, high = self._bounds(q, dt)
        self.tip.constraint = constraint
        self.tip.target = numbers
        self.tip.posture_share = min(1.0, self._posture_gain * dt)
        self.tip.low = low
        self.tip.high = high
        self.tip.longest = self._arm.limits.v_max * dt
        joint_map = self._arm.joint_map
        self.configuration.data.qpos[joint_map.qpos_adr] = joint_map.positions(q)
        if self._needs_kinematics:
            self.configuration.update()
        return self._solve(q, low, high, dt) / dt, self.status

    def _bounds(self, q: Array, dt: float) -> tuple[Array, Array]:
        """The least and the greatest move of each joint in one step; outside its limits it must move back as fast as it can."""
        # Not mink's ConfigurationLimit and VelocityLimit: from outside the joint limits their program has no solution.
        limits = self._arm.limits
        rounding = POSITION_ROUNDING * (1 + np.abs(q))
        slowest, fastest = limits.velocity_bounds(q, dt)
        back = slowest * dt * (1 - VELOCITY_ROUNDING)
        ahead = fastest * dt * (1 - VELOCITY_ROUNDING)
        low = limits.q_min - q
        high = limits.q_max - q
        low = np.minimum(low + rounding, np.maximum(0.0, low))
        high = np.maximum(high - rounding, np.minimum(0.0, high))
        return np.minimum(np.maximum(low, back), ahead), np.minimum(np.maximum(high, back), ahead)

    def _solve(self, q: Array, low: Array, high: Array, dt: float) -> Array:
        program = self._program(low, high, dt)
        dq = solved(program, self._solver)
        if dq is None and self._clearance is not None and program.h is not None:
            # a body that is too near may not be able to move away as fast as demanded: only forbid that it comes nearer
            program.h = np.maximum(program.h, 0.0)
            dq = solved(program, self._solver)
        if dq is None:
            self.status = "no solution"
            return np.zeros(self._arm.n)
        self.status = "solved"
        dq = np.clip(dq, low, high)
        if self._is_alone and self.tip.is_idle(dq) and allows_zero(program):
            return np.zeros(self._arm.n)
        return dq if self._clearance is None else self._kept_clear(program, q, dq)

    def _program(self, low: Array, high: Array, dt: float) -> qpsolvers.Problem:
        """mink's program, reduced from the joints of the model to those of the arm; all other joints stand still."""
        import mink
        import qpsolvers

        full = mink.build_ik(self.configuration, self._tasks, dt, DAMPING, self._all_limits, self._constraints)
        joint_map = self._arm.joint_map
        return qpsolvers.Problem(
            P=joint_map.reduced_matrix(np.asarray(full.P)),
            q=joint_map.reduced(full.q),
            G=None if full.G is None else joint_map.reduced(np.asarray(full.G)),
            h=full.h,
            A=None if full.A is None else joint_map.reduced(np.asarray(full.A)),
            b=full.b,
            lb=low,
            ub=high,
        )

    def _kept_clear(self, program: qpsolvers.Problem, q: Array, dq: Array) -> Array:
        """The step, shortened if the linear limits miss something: the nearest points of two bodies may change within it."""
        assert self._clearance is not None
        for _ in range(MAX_CUTS):
            cut = self._clearance.violations(q, dq)
            if cut.G is None or cut.h is None:
                return dq
            add_inequalities(program, cut.G, cut.h)
            shorter = solved(program, self._solver)
            if shorter is None:
                break
            dq = np.clip(shorter, program.lb, program.ub)
        self.status = "held back"
        for _ in range(MAX_HALVINGS):
            dq = 0.5 * dq
            if self._clearance.violations(q, dq).inactive:
                return dq
        return np.zeros_like(dq)


def _checked_list(what: str, value: object, kind: type) -> list:
    """A caller's sequence of mink objects as a list."""
    if not isinstance(value, Sequence) or not all(isinstance(item, kind) for item in value):
        raise InputError(f"{what}: expected a list of mink {kind.__name__} objects, got {shown(value)}")
    return list(value)


def add_inequalities(program: qpsolvers.Problem, G: Array, h: Array) -> None:
    program.G = G if program.G is None else np.vstack([np.asarray(program.G), G])
    program.h = h if program.h is None else np.hstack([program.h, h])


def allows_zero(program: qpsolvers.Problem) -> bool:
    """Whether x = 0 fulfils the inequalities and bounds; False if there are equalities."""
    least = [x for x in (program.h, program.ub) if x is not None]
    return program.A is None and all((x >= 0).all() for x in least) and (program.lb is None or bool((program.lb <= 0).all()))


def solved(program: qpsolvers.Problem, solver: str) -> Array | None:
    """The solution, or None if there is none."""
    import qpsolvers

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what the solver warns of is visible in its solution
            solution = qpsolvers.solve_problem(program, solver=solver, **QP_SOLVERS[solver])
    except (qpsolvers.QPError, ValueError, ArithmeticError, RuntimeError):
        return None
    if not solution.found or solution.x is None or not np.isfinite(solution.x).all():
        return None
    return solution.x
