"""DifferentialIk: joint velocities that follow a moving target under limits, by mink's quadratic program."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import UnknownNameError
from armctl.core.validation import Array, frozen, number, vector
from armctl.ik.problem import PoseOrPoint, read_target
from armctl.robot.arm import Arm, check_arm

if TYPE_CHECKING:
    import mink
    import qpsolvers
    from mink.tasks import BaseTask

    from armctl.ik.tasks import Clearance

DAMPING = 1e-9
CUTS, HALVINGS = 4, 4
PRECISION: dict[str, dict[str, Any]] = {"osqp": {"eps_abs": 1e-7, "eps_rel": 1e-7}, "proxqp": {"eps_abs": 1e-9}}


class DifferentialIk:
    """Follows a target with joint velocities. Position and velocity limits hold whatever the solver answers.

    Attributes:
        arm: The arm.
        configuration: mink's, where the last step was.
        tip: The mink task that brings the tip to the target.
        status: How the last step ended: "solved", "held back" (shortened, for it would have come too near something), or
            "no solution" (then the velocity is zero).
    """

    def __init__(
        self,
        arm: Arm,
        *,
        posture: ArrayLike | None = None,
        posture_gain: float = 4.0,
        avoid_collisions: bool = False,
        clearance: float = 0.01,
        tasks: Sequence[BaseTask] = (),
        limits: Sequence[mink.Limit] = (),
        constraints: Sequence[mink.Task] = (),
        solver: str = "daqp",
    ):
        """The follower of an arm.

        Args:
            arm: The arm.
            posture: (n,) rad, where the joints go as far as the tip lets them. Left out, the arm's home.
            posture_gain: 1/s, how fast; 0 for not at all.
            avoid_collisions: Whether to keep the arm clear of itself and of the scene.
            clearance: m to keep.
            tasks: Further mink tasks, on `arm.model`.
            limits: Further mink limits, on `arm.model`.
            constraints: mink tasks that must hold exactly.
            solver: The QP solver, such as "daqp", "osqp" or "proxqp".

        Raises:
            InputError: An argument of the wrong shape, kind or value.
            LimitError: The posture is outside the joint limits.
            UnknownNameError: That solver is not installed.
        """
        import mink
        import qpsolvers

        from armctl.ik.tasks import Clearance, TipTask

        check_arm(arm)
        if solver not in qpsolvers.available_solvers:
            raise UnknownNameError.of("QP solver", str(solver), qpsolvers.available_solvers)
        rest = arm.home if posture is None else arm.checked("posture", posture)
        self.arm, self.status, self._solver = arm, "solved", solver
        self.configuration = mink.Configuration(arm.model, arm.home_qpos.copy())
        self._posture_gain = number("posture_gain", posture_gain, 0.0)
        self.tip = TipTask(arm, rest)
        self._tasks, self._constraints = [self.tip, *tasks], list(constraints)
        self._limits = list(limits)
        self._clearance = Clearance(arm, number("clearance", clearance, 0.0)) if avoid_collisions else None
        self._is_alone = not tasks
        self._needs_kinematics = bool(tasks or limits or constraints or avoid_collisions)

    def step(self, q: ArrayLike, target: PoseOrPoint, dt: float, *, free_axis: str | None = None) -> Array:
        """The joint velocity that brings the tip nearer to the target.

        Args:
            q: (n,) rad, where the joints are; outside their limits they move back in.
            target: A Pose, or (3,) m for position only.
            dt: s, for how long the velocity will be held.
            free_axis: "x", "y" or "z": the tip's axis about which the target may be turned freely.

        Returns:
            (n,) rad/s.

        Raises:
            InputError: An argument of the wrong shape, kind or value.
        """
        asked, numbers = read_target(target, free_axis)
        return frozen(self.toward(vector("q", q, self.arm.n), asked, numbers, number("dt", dt, 1e-9)))

    def toward(self, q: Array, asked: int, numbers: Array, dt: float) -> Array:
        """`step` on a target that `armctl.ik.problem.read_target` has read, without checks.

        Args:
            q: (n,) rad.
            asked: What of the tip is asked for.
            numbers: (12,) rotation row by row, position.
            dt: s.

        Returns:
            (n,) rad/s.
        """
        self.tip.asked, self.tip.target = asked, numbers
        self.tip.posture_share = min(1.0, self._posture_gain * dt)
        low, high = self.tip.bounds = self._bounds(q, dt)
        joint_map = self.arm.joint_map
        self.configuration.data.qpos[joint_map.qpos_adr] = joint_map.positions(q)
        if self._needs_kinematics:
            self.configuration.update()
        return self._solve(q, low, high, dt) / dt

    def _bounds(self, q: Array, dt: float) -> tuple[Array, Array]:
        """What each joint may move in one step; outside its limits it must move back, as fast as it can."""
        limits, reserve = self.arm.limits, 4 * np.finfo(float).eps * (1 + np.abs(q))
        most = limits.v_max * dt * (1 - 1e-12)
        low, high = limits.q_min - q, limits.q_max - q
        low = np.minimum(low + reserve, np.maximum(0.0, low))
        high = np.maximum(high - reserve, np.minimum(0.0, high))
        return np.minimum(np.maximum(low, -most), most), np.minimum(np.maximum(high, -most), most)

    def _solve(self, q: Array, low: Array, high: Array, dt: float) -> Array:
        import mink

        limits = [*self._limits, self._clearance] if self._clearance is not None else self._limits
        problem = mink.build_ik(self.configuration, self._tasks, dt, DAMPING, limits, self._constraints)
        reduced = self.arm.joint_map.reduced  # all other joints stand still
        problem.P, problem.q = self.arm.joint_map.reduced_matrix(np.asarray(problem.P)), reduced(problem.q)
        problem.G = reduced(np.asarray(problem.G)) if problem.G is not None else None
        problem.A = reduced(np.asarray(problem.A)) if problem.A is not None else None
        problem.lb, problem.ub = low, high
        dq, self.status = _solution(problem, self._solver), "solved"
        if dq is None and self._clearance is not None and problem.h is not None:
            problem.h = np.maximum(problem.h, 0.0)  # too near something: do not ask to move apart
            dq = _solution(problem, self._solver)
        if dq is None:
            self.status = "no solution"
            return np.zeros(self.arm.n)
        dq = np.clip(dq, low, high)
        if self._is_alone and self.tip.is_idle(dq) and _may_rest(problem, low, high):
            return np.zeros(self.arm.n)
        return dq if self._clearance is None else self._cleared(self._clearance, problem, q, dq)

    def _cleared(self, clearance: Clearance, problem: qpsolvers.Problem, q: Array, dq: Array) -> Array:
        """The step, held to what the linear limits miss: where two bodies are nearest may change within a step."""
        for _ in range(CUTS):
            cut = clearance.cuts(self.configuration, q, dq)
            if cut.inactive:
                return dq
            problem.G = cut.G if problem.G is None else np.vstack([problem.G, cut.G])  # pyright: ignore[reportArgumentType, reportCallIssue]
            problem.h = cut.h if problem.h is None else np.hstack([problem.h, cut.h])  # pyright: ignore[reportArgumentType, reportCallIssue]
            better = _solution(problem, self._solver)
            if better is None:
                break
            dq = np.clip(better, problem.lb, problem.ub)  # pyright: ignore[reportCallIssue, reportArgumentType]
        self.status = "held back"
        for _ in range(HALVINGS):
            dq = 0.5 * dq
            if clearance.cuts(self.configuration, q, dq).inactive:
                return dq
        return np.zeros_like(dq)


def _may_rest(problem: qpsolvers.Problem, low: Array, high: Array) -> bool:
    """Whether a step of nothing keeps the limits: not where joints or bodies have to move back."""
    free = problem.A is None and (problem.h is None or bool((problem.h >= 0).all()))
    return free and bool((low <= 0).all() and (high >= 0).all())


def _solution(problem: qpsolvers.Problem, solver: str) -> Array | None:
    """What a QP solver answers, or None: solvers disagree on how they say that there is no solution."""
    import qpsolvers

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of solvers: what they have to say is in the solution
            solution = qpsolvers.solve_problem(problem, solver=solver, **PRECISION.get(solver, {}))
    except (qpsolvers.QPError, ValueError, ArithmeticError, RuntimeError):
        return None
    return solution.x if solution.found and solution.x is not None and np.isfinite(solution.x).all() else None
