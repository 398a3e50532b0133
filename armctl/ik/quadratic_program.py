"""A quadratic program of a few unknowns, solved by daqp or osqp."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np

from armctl.core.validation import Array

# A first-order solver stops at 1e-3 by default, which is visible in a joint velocity.
QP_SOLVERS: dict[str, dict[str, Any]] = {"daqp": {}, "osqp": {"eps_abs": 1e-7, "eps_rel": 1e-7}}


class QuadraticProgram(NamedTuple):
    """Minimize x.Px / 2 + q.x subject to G x <= h, A x = b and low <= x <= high."""

    P: Array
    q: Array
    G: Array | None
    h: Array | None
    A: Array | None
    b: Array | None
    low: Array
    high: Array

    def with_inequalities(self, G: Array, h: Array) -> QuadraticProgram:
        """The same program with more rows of G and h."""
        if self.G is None or self.h is None:
            return self._replace(G=G, h=h)
        return self._replace(G=np.vstack([self.G, G]), h=np.hstack([self.h, h]))

    def allows_zero(self) -> bool:
        """Whether x = 0 fulfils the inequalities and bounds; False if there are equalities."""
        inequalities_hold = self.h is None or bool((self.h >= 0).all())
        return self.A is None and inequalities_hold and bool((self.low <= 0).all() and (self.high >= 0).all())

    def solve(self, solver: str) -> Array | None:
        """The solution, or None if there is none."""
        import qpsolvers

        problem = qpsolvers.Problem(self.P, self.q, self.G, self.h, self.A, self.b, self.low, self.high)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # what the solver warns of is visible in its solution
                solution = qpsolvers.solve_problem(problem, solver=solver, **QP_SOLVERS[solver])
        except (qpsolvers.QPError, ValueError, ArithmeticError, RuntimeError):
            return None
        if not solution.found or solution.x is None or not np.isfinite(solution.x).all():
            return None
        return solution.x
