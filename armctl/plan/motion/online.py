"""OnlineMotion: setpoints tick by tick towards a goal that may change at any tick, within every limit."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import LimitError, PlanError
from armctl.core.limits import Limits
from armctl.core.other_names import with_hints
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, number, vector
from armctl.model.arm.arm import Arm
from armctl.plan.motion.checks import goal_state, limits_from, planning_arm, start_state
from armctl.plan.motion.timing.end_limits import gentle_limits, room_to_stop
from armctl.plan.motion.timing.otg import JointState, Profile, ProfileSolver
from armctl.plan.motion.trajectory.limit_check import POSITION_TOLERANCE, RATIO_TOLERANCE, is_inside
from armctl.plan.motion.trajectory.path_stop import remaining
from armctl.plan.motion.trajectory.piecewise import Pieces, joined, standing

# Shares of the acceleration limits that are tried where a motion is faster than an end of a joint's range allows.
_GENTLER = (1.0, 0.5, 0.25, 0.1)
_STANDING = 1e-9  # of the velocity limit: a joint that is asked for less stands still
_FAR_S = 3600.0  # a joint without position limits stops after an hour at its velocity


class OnlineMotion:
    """A jerk-limited motion that is planned while it runs, with a new goal at any tick.

    Each new goal is planned from the current position, velocity and acceleration; all joints arrive at the same time.
    If a joint would then leave its position limits, each joint moves independently as fast as possible instead. A goal may
    be in motion; after it the arm stops, unless another goal comes.

    ```python
    motion = OnlineMotion(arm, arm.home)
    motion.go_to(q)
    setpoint = motion.step(0.001)
    ```
    """

    if not TYPE_CHECKING:
        __getattr__ = with_hints(
            {
                "target_position": "motion.go_to(q)",
                "target_velocity": "motion.go_to(armctl.Setpoint(q, v, a))",
                "target_acceleration": "motion.go_to(armctl.Setpoint(q, v, a))",
                "current_position": "motion.setpoint.q",
                "control_interface": "motion.go_at(v) for velocity control",
                "update": "motion.step(dt)",
            }
        )

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
        self._shrinks = limits.depends_on_position
        self._solver = ProfileSolver.from_limits(limits)
        start = start_state(arm, q_start)
        self._t = 0.0
        self._start = JointState(start.q.tolist(), start.v.tolist(), start.a.tolist())
        self._goal: Setpoint | None = None
        self._velocity: Array | None = None  # of velocity control
        profile = self._solver.stop(self._start)
        if profile is None or not self._is_inside(profile, self._start):
            raise LimitError("q_start: the arm cannot stop inside its position limits from this start; start slower")
        self._profile = profile
        self._afterwards: Profile | None = None  # the stop behind a goal in motion

    @property
    def goal(self) -> Array | None:
        """(n,) rad, the position of the goal; None while it only stops."""
        return None if self._goal is None else self._goal.q

    def go_to(self, q: ArrayLike | Setpoint) -> None:
        """Sets a new goal, which is reached at rest or, if it is a setpoint, with its velocity and acceleration.

        A goal in motion is a state, not a function of time: the arm has it when it arrives, as soon as it can. From there it
        stops, as soon as the limits allow, if no other goal has come.

        Args:
            q: (n,) rad, inside the limits; or a setpoint inside the limits, from which the arm can stop inside them.

        Raises:
            InputError: A wrong length or a number that is not finite; the motion does not change.
            LimitError: A goal outside the limits, or so fast that no stop inside them is possible; the motion does not change.
            PlanError: No motion inside the limits leads to the goal from the current state; the motion stops instead.
        """
        if isinstance(q, Setpoint):
            self._go_to_moving(goal_state(self._arm, "q", q))
            return
        goal = self._checked(q)
        start = self._state(self._t)
        profile = self._solver.to_rest(start, goal.tolist(), self._q_min_loose, self._q_max_loose)
        if self._shrinks and (profile is None or not self._keeps_ends(profile, start)):
            profile = self._gentle(start, goal)
        self._start = start
        self._take(profile, _resting_at(goal), None)

    def _gentle(self, start: JointState, goal: Array) -> Profile | None:
        """A profile to rest at a goal with less acceleration, within the velocity limits near the ends; None if none is found.

        The caps on the deceleration are those of the goal and of the start, whichever is nearer to an end.
        """
        limits = self._arm.limits
        low = np.minimum(goal, start.q)
        high = np.maximum(goal, start.q)
        up = goal > np.asarray(start.q)
        down = goal < np.asarray(start.q)
        for share in _GENTLER:
            gentle = gentle_limits(replace(limits, a_max=share * limits.a_max, a_min=share * limits.a_low), low, high, up, down)
            profile = ProfileSolver.from_limits(gentle).to_rest(start, goal.tolist(), self._q_min_loose, self._q_max_loose)
            if profile is not None and self._keeps_ends(profile, start):
                return profile
        return None

    def _keeps_ends(self, profile: Profile, start: JointState) -> bool:
        """Whether a profile from a state keeps the limits, also those of velocities near the ends of the ranges."""
        setpoint = Setpoint(*(np.asarray(x) for x in start))
        return not self._shrinks or is_inside(profile.pieces(start), limits_from(self._arm.limits, setpoint))

    def _go_to_moving(self, goal: Setpoint) -> None:
        """Sets a goal in motion."""
        wanted = JointState(goal.q.tolist(), goal.v.tolist(), goal.a.tolist())
        stop = self._solver.stop(wanted)
        if stop is None or not self._is_inside(stop, wanted):
            raise LimitError("q: the arm cannot stop inside its position limits after this goal; end slower")
        start = self._state(self._t)
        profile = self._solver.to_moving(start, wanted, self._q_min_loose, self._q_max_loose)
        if profile is not None and not self._keeps_ends(profile, start):
            profile = None
        self._start = start
        self._take(profile, goal, stop)

    def _take(self, profile: Profile | None, goal: Setpoint, afterwards: Profile | None) -> None:
        """Replaces the profile by one from `_start` to a goal, and what follows; without one it stops, and raises PlanError."""
        if profile is not None:
            self._profile = profile
            self._afterwards = afterwards
            self._t = 0.0
            self._goal = goal
            self._velocity = None
            return
        self._goal = None
        self._velocity = None
        self._brake()
        raise PlanError(
            "go_to: no motion inside the limits leads to the goal from this state; the arm stops, call go_to again at rest"
        )

    def go_at(self, v: ArrayLike) -> None:
        """Moves at a velocity, which all joints reach at the same time, as soon as the limits allow: velocity control.

        A joint goes on at its velocity up to its position limit, where it comes to rest. Where a joint is so near to its
        limit that it cannot reach its velocity, each joint comes to its own as soon as it can. A `Stream` has the same for the
        tip, `push_twist`, and stops if nobody renews it.

        Args:
            v: (n,) rad/s, inside the limits.

        Raises:
            InputError: A wrong length or a number that is not finite; the motion does not change.
            LimitError: A velocity beyond its limit; the motion does not change.
            PlanError: No such motion was found; the motion stops instead.
        """
        wanted = vector("v", v, self._arm.n)
        limits = self._arm.limits
        bounds = np.where(wanted < 0.0, -limits.v_low, limits.v_max)
        i = int((np.abs(wanted) / bounds).argmax())
        if abs(wanted[i]) > bounds[i] * (1 + RATIO_TOLERANCE):
            raise LimitError(
                f"v: {self._arm.joint_names[i]}: {wanted[i]:g} {self._arm.units[i]}/s is beyond its limit, "
                f"{bounds[i]:g} {self._arm.units[i]}/s; give less"
            )
        start = self._state(self._t)
        reached = self._solver.to_velocity(start, wanted.tolist())
        self._start = start
        self._goal = None
        self._velocity = wanted
        if reached is not None and self._is_inside(reached, start):
            # Without rounding, which would let ruckig brake for a velocity above what it is asked for.
            then = JointState(reached.at(reached.duration)[0], wanted.tolist(), [0.0] * len(wanted))
            cruising = self._cruise(then, wanted)
            if cruising is not None and self._is_inside(cruising, then):
                self._profile = reached
                self._afterwards = cruising
                self._t = 0.0
                return
        cruising = self._cruise(start, wanted)
        if cruising is None or not self._is_inside(cruising, start):
            self._brake()
            raise PlanError(
                "go_at: no motion at this velocity inside the limits was found; the arm stops, call go_at again at rest"
            )
        self._profile = cruising
        self._afterwards = None
        self._t = 0.0

    def _cruise(self, start: JointState, v: Array) -> Profile | None:
        """The profile of each joint at its velocity to its position limit, or where it stops if its velocity is zero."""
        limits = room_to_stop(self._arm.limits)
        q = np.array(start.q)
        stop = self._solver.stop(start)
        if stop is None:
            return None
        is_still = np.abs(v) <= _STANDING * limits.v_max
        ends = np.where(v > 0.0, np.minimum(limits.q_max, q + v * _FAR_S), np.maximum(limits.q_min, q + v * _FAR_S))
        if self._shrinks:  # from beyond the places in which it can come to rest, a joint does not turn back
            ends = np.where(v > 0.0, np.maximum(ends, q), np.minimum(ends, q))
        goal = np.where(is_still, stop.at(stop.duration)[0], ends)
        speeds = np.where(is_still, limits.v_max, np.minimum(np.abs(v), limits.v_max))
        solver = self._solver
        if self._shrinks:
            solver = ProfileSolver.from_limits(gentle_limits(self._arm.limits, goal, goal, goal > q, goal < q))
        return solver.cruise(start, goal.tolist(), speeds.tolist())

    def _is_inside(self, profile: Profile, start: JointState) -> bool:
        return profile.stays_inside(self._q_min_loose, self._q_max_loose) and self._keeps_ends(profile, start)

    def with_limits(self, limits: Limits) -> OnlineMotion:
        """The motion that goes on from here within other limits, to the same goal or at the same velocity as far as they allow.

        Where they are lower than the present velocity or acceleration, the arm first brakes into them, as fast as the other
        limits allow, such as when a person comes near:

        ```python
        motion = motion.with_limits(arm.limits.at_speed(0.2))
        ```

        Args:
            limits: Of the n joints.

        Raises:
            InputError: It is no Limits, of another number of joints, or without a limit of velocity, acceleration or jerk.
            LimitError: The arm or its goal is outside the new range, or the arm cannot stop inside it.
            PlanError: No motion inside the new limits leads to the goal from this state.
        """
        motion = OnlineMotion(self._arm.with_limits(limits), self.setpoint)
        if self._velocity is not None:
            motion.go_at(np.clip(self._velocity, limits.v_low, limits.v_max))
        elif self._goal is not None and self.time_to_goal > 0.0:
            motion.go_to(self._goal if self._goal.v.any() or self._goal.a.any() else self._goal.q)
        return motion

    def stop(self) -> None:
        """Stops as soon as the limits allow."""
        self._start = self._state(self._t)
        self._goal = None
        self._velocity = None
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
        stopping = 0.0 if self._afterwards is None else self._afterwards.duration
        return max(0.0, self._profile.duration + stopping - self._t)

    @property
    def time_to_goal(self) -> float:
        """The time until it is at the goal, s; 0 after it, and without one."""
        return 0.0 if self._goal is None else max(0.0, self._profile.duration - self._t)

    @property
    def pieces(self) -> Pieces:
        """The motion from now on, up to rest, as polynomials."""
        if self.time_left == 0.0:
            return standing(self.setpoint.q)
        whole = self._profile.pieces(self._start)
        if self._afterwards is not None:
            whole = joined([whole, self._afterwards.pieces(JointState(*self._profile.at(self._profile.duration)))])
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
        if profile is not None and self._shrinks and not self._keeps_ends(profile, self._start):
            profile = self._gentle_stop(self._start) or profile
        if profile is None:
            raise PlanError("no stop inside the limits was found from the present state")
        self._profile = profile
        self._afterwards = None
        self._t = 0.0

    def _gentle_stop(self, start: JointState) -> Profile | None:
        """A stop with less deceleration, which keeps velocity limits near the ends; None if none is found."""
        limits = self._arm.limits
        for share in _GENTLER:
            gentle = replace(limits, a_max=share * limits.a_max, a_min=share * limits.a_low)
            profile = ProfileSolver.from_limits(gentle).stop(start)
            if profile is not None and self._is_inside(profile, start):
                return profile
        return None

    def _state(self, t: float) -> JointState:
        if self._afterwards is not None and t > self._profile.duration:
            return JointState(*self._afterwards.at(min(t - self._profile.duration, self._afterwards.duration)))
        return JointState(*self._profile.at(min(t, self._profile.duration)))


def _resting_at(q: Array) -> Setpoint:
    zero = np.zeros(len(q))
    return Setpoint(q, zero, zero)
