"""Ruckig behind a checked door: what goes in is inside the limits, what comes out is pieces of constant jerk."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import ruckig

from armctl.arrays import Array
from armctl.errors import PlanError
from armctl.motion.joint_trajectory import DEGREE
from armctl.trajectory import Limits

_WORKING = {ruckig.Result.Working, ruckig.Result.Finished}
_SAME_TIME = 1e-12


class Moving(NamedTuple):
    """A state of joints in motion.

    Attributes:
        q: (n,) rad.
        v: (n,) rad/s.
        a: (n,) rad/s^2.
    """

    q: Array
    v: Array
    a: Array


class Pieces(NamedTuple):
    """Polynomials over time.

    Attributes:
        knots: (m + 1,) s, from 0.
        coefficients: (m, 6, n).
    """

    knots: Array
    coefficients: Array


def at_rest(q: Array) -> Moving:
    """The state of standing still.

    Args:
        q: (n,) rad.

    Returns:
        The state.
    """
    zero = np.zeros_like(q)
    return Moving(q, zero, zero)


class Profiles:
    """Time-optimal, jerk-limited profiles of n joints that start and arrive together; state to state."""

    def __init__(self, v_max: Array, a_max: Array, j_max: Array):
        """The profiles of joints with these limits.

        Args:
            v_max: (n,) rad/s.
            a_max: (n,) rad/s^2.
            j_max: (n,) rad/s^3.
        """
        n = len(v_max)
        self._otg, self._input, self._result = ruckig.Ruckig(n), ruckig.InputParameter(n), ruckig.Trajectory(n)
        self._input.max_velocity = v_max.tolist()
        self._input.max_acceleration = a_max.tolist()
        self._input.max_jerk = j_max.tolist()

    @classmethod
    def of(cls, limits: Limits) -> Profiles:
        """The profiles of an arm.

        Args:
            limits: Its limits.

        Returns:
            The profiles.
        """
        return cls(limits.v_max, limits.a_max, limits.j_max)

    def solve(self, start: Moving, goal: Moving) -> Pieces:
        """The fastest move from one state to another.

        Args:
            start: Where it starts.
            goal: Where it ends.

        Returns:
            Its pieces.

        Raises:
            PlanError: Ruckig finds none.
        """
        inp = self._input
        inp.current_position, inp.current_velocity, inp.current_acceleration = (x.tolist() for x in start)
        inp.target_position, inp.target_velocity, inp.target_acceleration = (x.tolist() for x in goal)
        try:
            status = self._otg.calculate(inp, self._result)
        except ruckig.RuckigError as error:
            raise PlanError(f"no jerk-limited move joins the two states: {error}") from None
        if status not in _WORKING:
            raise PlanError(f"no jerk-limited move joins the two states: {status}")
        return _pieces(self._result.profiles[0], start)


def _pieces(profiles: list[ruckig.Profile], start: Moving) -> Pieces:
    """Cubic pieces from ruckig's phases, cut wherever the jerk of any joint changes."""
    steps = np.array([(*p.brake.t, *p.t) for p in profiles]).T
    jerks = np.array([(*p.brake.j, *p.j) for p in profiles]).T
    ends = np.cumsum(steps, axis=0)
    starts = np.vstack([np.zeros_like(ends[:1]), ends])
    nodes = [start]
    for h, j in zip(steps, jerks, strict=True):
        q, v, a = nodes[-1]
        nodes.append(Moving(q + h * (v + h * (a / 2 + h * j / 6)), v + h * (a + h * j / 2), a + h * j))
    q, v, a = (np.array(x) for x in zip(*nodes, strict=True))

    knots = np.unique(starts)
    knots = np.append(knots[:-1][np.diff(knots) > _SAME_TIME], knots[-1])
    if len(knots) == 1:
        knots = np.zeros(2)
    coefficients = np.zeros((len(knots) - 1, DEGREE + 1, len(profiles)))
    middle = 0.5 * (knots[1:] + knots[:-1])
    for i in range(len(profiles)):
        phase = np.clip(np.searchsorted(starts[:, i], middle, side="right") - 1, 0, len(steps) - 1)
        u, j = knots[:-1] - starts[phase, i], jerks[phase, i]
        q0, v0, a0 = q[phase, i], v[phase, i], a[phase, i]
        coefficients[:, 0, i] = q0 + u * (v0 + u * (a0 / 2 + u * j / 6))
        coefficients[:, 1, i] = v0 + u * (a0 + u * j / 2)
        coefficients[:, 2, i] = (a0 + u * j) / 2
        coefficients[:, 3, i] = j / 6
    return Pieces(knots, coefficients)
