"""OnlineMotion: setpoints tick by tick towards a goal that may change at any tick, within every limit."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import LimitError, PlanError
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, number
from armctl.model.arm.arm import Arm
from armctl.plan.motion.checks import planning_arm, start_state
from armctl.plan.motion.timing.otg import JointState, ProfileSolver
from armctl.plan.motion.trajectory.limit_check import POSITION_TOLERANCE
from armctl.plan.motion.trajectory.path_stop import remaining
from armctl.plan.motion.trajectory.piecewise import Pieces, standing


class OnlineMotion:
    """A jerk-limited motion that is planned while it runs, with a new goal at any tick.

    Each new goal is planned from the current position, velocity and acceleration; all joints arrive at the same time.
    If a joint would then leave its position limits, each joint moves independently as fast as possible instead.

    ```python
    motion = OnlineMotion(arm, arm.home)
    motion.go_to(q)
    setpoint = motion.step(0.001)
    ```
    """

    def __init__(self, arm: Arm, q_start: ArrayLike | Setpoint):
        """A motion that starts at the state of the arm; without a goal it decelerates to rest.

        Args:
            q_start: (n,) rad, inside the limits; or a setpoint, whose motion it continues. A velocity or acceleration beyond
                its limit is first reduced to the limit as fast as the others allow.

        Raises:
            InputError: A wrong length or a number that is not finite.
            LimitError: A start outside the position limits, or so fast that no stop inside them is possible.
        """
        planning_arm(arm, 1.0)
        limits = arm.limits
        self._arm = arm
        self._q_min = limits.q_min.tolist()
        self._q_max = limits.q_max.tolist()
        self._q_min_loose = (limits.q_min - POSITION_TOLERANCE).tolist()
        self._q_max_loose = (limits.q_max + POSITION_TOLERANCE).tolist()
        self._solver = ProfileSolver.from_limits(limits)
        start = start_state(arm, q_start)
        self._t = 0.0
        self._start = JointState(start.q.tolist(), start.v.tolist(), start.a.tolist())
        self._goal: Array | None = None
        profile = self._solver.stop(self._start)
        if profile is None or not profile.stays_inside(self._q_min_loose, self._q_max_loose):
            raise LimitError("q_start: the arm cannot stop inside its position limits from this start; start slower")
        self._profile = profile

    @property
    def goal(self) -> Array | None:
        """(n,) rad, the goal; None while it only stops."""
        return self._goal

    def go_to(self, q: ArrayLike) -> None:
        """Sets a new goal, which is reached at rest.

        Args:
            q: (n,) rad, inside the limits.

        Raises:
            InputError: A wrong length or a number that is not finite; the motion does not change.
            LimitError: A position outside the limits; the motion does not change.
            PlanError: No motion inside the limits leads to the goal from the current state; the motion stops instead.
        """
        goal = self._checked(q)
        start = self._state(self._t)
        profile = self._solver.to_rest(start, goal.tolist(), self._q_min_loose, self._q_max_loose)
        self._start = start
        if profile is not None:
            self._profile = profile
            self._t = 0.0
            self._goal = goal
            return
        self._brake()
        raise PlanError(
            "go_to: no motion inside the limits leads to the goal from this state; the arm stops, call go_to again at rest"
        )

    def stop(self) -> None:
        """Stops as soon as the limits allow."""
        self._start = self._state(self._t)
        self._goal = None
        self._brake()

    def step(self, dt: float) -> Setpoint:
        """Advances by one tick, to the setpoint at its end: q, v, a, each (n,).

        Args:
            dt: s, the tick, at least 0.
        """
        self._t += number("dt", dt, 0.0)
        return self.setpoint

    @property
    def setpoint(self) -> Setpoint:
        """The current setpoint: q, v, a, each (n,)."""
        return Setpoint(*(np.array(x) for x in self._state(self._t)))

    @property
    def time_left(self) -> float:
        """The time until it is at rest, s, if nothing changes."""
        return max(0.0, self._profile.duration - self._t)

    @property
    def pieces(self) -> Pieces:
        """The motion from now on, up to rest, as polynomials."""
        if self.time_left == 0.0:
            return standing(self.setpoint.q)
        whole = self._profile.pieces(self._start)
        return whole if self._t == 0.0 else remaining(whole, self._t)

    def _checked(self, q: ArrayLike) -> Array:
        """A caller's goal, checked. A correct array takes a short path, because `go_to` is called in real time."""
        if isinstance(q, np.ndarray) and q.shape == (self._arm.n,) and q.dtype == np.float64:
            inside = [low <= x <= high for low, x, high in zip(self._q_min, q.tolist(), self._q_max, strict=True)]
            if all(inside):
                return q.copy()
        return self._arm.checked("q", q)

    def _brake(self) -> None:
        """Replaces the profile by the fastest stop from `_start`."""
        profile = self._solver.stop(self._start)
        if profile is None:
            raise PlanError("no stop inside the limits was found from the present state")
        self._profile = profile
        self._t = 0.0

    def _state(self, t: float) -> JointState:
        return JointState(*self._profile.at(min(t, self._profile.duration)))
