"""DifferentialIk: joint velocities that follow a moving target under limits, by a quadratic program with mink's tasks."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.target import TargetLike
from armctl.core.validation import Array, choice, flag, frozen, number, shown, vector
from armctl.model.arm.arm import Arm, check_one_tip
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


class DifferentialIk:
    """Follows a target with joint velocities. Position and velocity limits hold even if the solver fails.

    Attributes:
        configuration: mink's configuration, at the last step.
        tip: The mink task that brings the tip to the target.
        status: How the last step ended: "solved", "held back" (shortened, because it would have ended too near a body), or
            "no solution" (the velocity is zero).
    """

    def __init__(
        self,
        arm: Arm,
        *,
        posture: ArrayLike | None = None,
        posture_gain: float = 4.0,
        avoid: bool = False,
        clearance: float = 0.01,
        tasks: Sequence[BaseTask] = (),
        limits: Sequence[mink.Limit] = (),
        constraints: Sequence[mink.Task] = (),
        solver: str = "daqp",
    ):
        """Prepares the program of an arm.

        Args:
            posture: (n,) rad (m for a slide joint), which the joints approach as far as the tip leaves them free. By default
                the arm's home.
            posture_gain: 1/s, the gain of the posture; 0 disables it.
            avoid: Whether to keep the arm clear of itself and of the scene.
            clearance: m, the distance to keep.
            tasks: Further mink tasks, made for `arm.model`.
            limits: Further mink limits, made for `arm.model`.
            constraints: mink tasks that must hold exactly.
            solver: The QP solver, "daqp" (an active set, the faster one) or "osqp".

        Raises:
            InputError: An argument has a wrong shape, type or value.
            LimitError: The posture is outside the joint limits.
            ModelError: The arm could touch a height field or signed distance field, which `avoid` cannot avoid.
        """
        import mink
        from mink.tasks import BaseTask

        from armctl.plan.ik.tasks import ClearanceLimit, TipTask

        check_one_tip(arm)
        self._solver = choice("solver", solver, QP_SOLVERS)
        rest = arm.home if posture is None else arm.checked("posture", posture)
        self.arm = arm
        self.status = "solved"
        self.configuration = mink.Configuration(arm.model, arm.home_qpos.copy())
        self.tip = TipTask(arm, rest)
        self._posture_gain = number("posture_gain", posture_gain, 0.0)
        self._tasks = [self.tip, *_checked_list("tasks", tasks, BaseTask)]
        self._limits = _checked_list("limits", limits, mink.Limit)
        self._constraints = _checked_list("constraints", constraints, mink.Task)
        self._is_alone = len(self._tasks) == 1
        clearance = number("clearance", clearance, 0.0)
        self._clearance = ClearanceLimit(arm, clearance) if flag("avoid", avoid) else None
        self._all_limits = [*self._limits, self._clearance] if self._clearance is not None else self._limits
        self._needs_kinematics = bool(self._limits or self._constraints or not self._is_alone)

    def step(self, q: ArrayLike, target: TargetLike, dt: float, *, free_axis: str | None = None) -> Array:
        """The joint velocity that brings the tip nearer to the target.

        Args:
            q: (n,) rad (m for a slide joint), the current configuration; joints outside their limits move back in.
            target: A Pose, (3,) m for position only, or a Target.
            dt: s, for how long the velocity will be held.
            free_axis: "x", "y" or "z": the tip's axis about which the target may be turned freely.

        Returns:
            (n,) rad/s (m/s for a slide joint).

        Raises:
            InputError: An argument has a wrong shape, type or value.
            LimitError: A joint is half a turn (1 m) or more outside its limits, as degrees are.
        """
        constraint, numbers = read_target(target, free_axis)
        start = vector("q", q, self.arm.n)
        self.arm.check_units("q", start)
        dt = number("dt", dt, 1e-9)
        low, high = self._bounds(start, dt)
        self.tip.constraint = constraint
        self.tip.target = numbers
        self.tip.posture_share = min(1.0, self._posture_gain * dt)
        self.tip.low = low
        self.tip.high = high
        self.tip.longest = self.arm.limits.v_max * dt
        joint_map = self.arm.joint_map
        self.configuration.data.qpos[joint_map.qpos_adr] = joint_map.positions(start)
        if self._needs_kinematics:
            self.configuration.update()
        return frozen(self._solve(start, low, high, dt) / dt)

    def _bounds(self, q: Array, dt: float) -> tuple[Array, Array]:
        """The least and the greatest move of each joint in one step; outside its limits it must move back as fast as it can."""
        # Not mink's ConfigurationLimit and VelocityLimit: from outside the joint limits their program has no solution.
        limits = self.arm.limits
        rounding = POSITION_ROUNDING * (1 + np.abs(q))
        longest = limits.v_max * dt * (1 - VELOCITY_ROUNDING)
        low = limits.q_min - q
        high = limits.q_max - q
        low = np.minimum(low + rounding, np.maximum(0.0, low))
        high = np.maximum(high - rounding, np.minimum(0.0, high))
        return np.minimum(np.maximum(low, -longest), longest), np.minimum(np.maximum(high, -longest), longest)

    def _solve(self, q: Array, low: Array, high: Array, dt: float) -> Array:
        program = self._program(low, high, dt)
        dq = solved(program, self._solver)
        if dq is None and self._clearance is not None and program.h is not None:
            # a body that is too near may not be able to move away as fast as demanded: only forbid that it comes nearer
            program.h = np.maximum(program.h, 0.0)
            dq = solved(program, self._solver)
        if dq is None:
            self.status = "no solution"
            return np.zeros(self.arm.n)
        self.status = "solved"
        dq = np.clip(dq, low, high)
        if self._is_alone and self.tip.is_idle(dq) and allows_zero(program):
            return np.zeros(self.arm.n)
        return dq if self._clearance is None else self._kept_clear(program, q, dq)

    def _program(self, low: Array, high: Array, dt: float) -> qpsolvers.Problem:
        """mink's program, reduced from the joints of the model to those of the arm; all other joints stand still."""
        import mink
        import qpsolvers

        full = mink.build_ik(self.configuration, self._tasks, dt, DAMPING, self._all_limits, self._constraints)
        joint_map = self.arm.joint_map
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
