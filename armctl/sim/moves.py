"""What an arm in a simulation can be told: to a target, on lines and arcs, after something that moves."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from armctl.collision.checker import collision_checker
from armctl.control import Controller, State
from armctl.core.errors import InputError, PlanError, UnknownNameError
from armctl.core.log import Log
from armctl.core.pose import Pose
from armctl.core.result import MoveResult
from armctl.core.target import ANGLE_TOLERANCE, TOLERANCE, Target
from armctl.core.trajectory import TickReference, Trajectory
from armctl.core.validation import Array, number
from armctl.ik import solve_ik
from armctl.mjmodel.target_marker import TARGET
from armctl.motion import Arc, JointTrajectory, Line, OnlineMotion, move_c, move_j, move_l, move_path
from armctl.robot.arm import Arm
from armctl.sim.recorder import Recorder, ticks_for
from armctl.sim.stepper import Stepper

_SETTLED_SPEED = 1e-3  # rad/s
_SETTLE_CHUNK = 0.02  # s
_FOLLOW_PERIOD = 0.02  # s


class Moves:
    """The commands of a `Simulation`."""

    arm: Arm
    controller: Controller
    model: mujoco.MjModel
    data: mujoco.MjData
    log: Log | None
    _stepper: Stepper

    if TYPE_CHECKING:

        @property
        def dt(self) -> float: ...

        @property
        def tip(self) -> Pose: ...

        @property
        def state(self) -> State: ...

    def move_to(
        self,
        target: Pose | ArrayLike,
        *,
        tolerance: float = TOLERANCE,
        angle_tolerance: float = ANGLE_TOLERANCE,
        settle: float = 1.0,
    ) -> MoveResult:
        """Brings the tip to a target by inverse kinematics and a jerk-limited motion of the joints.

        Args:
            target: T_world_tip, or (3,) m where the orientation does not matter.
            tolerance: m within which the target counts as reached.
            angle_tolerance: rad, likewise.
            settle: s that the arm may take to come to rest after the motion.

        Returns:
            How it ended; what the world refuses (out of reach, not settled, diverged) is in its `reason`.

        Raises:
            InputError: The target has a wrong length or a number that is not finite, or a tolerance is negative.
            SimulationError: The controller failed; `error.log` holds what there was until then.
        """
        goal = Target.read(target, tolerance, angle_tolerance)
        number("settle", settle, 0.0)
        self._show(goal)
        if self._stepper.failure:
            return self._refused(goal, f"{self._stepper.failure}; reset() starts afresh")
        start = self.arm.limits.clamp(self._stepper.q_ref)
        ik = solve_ik(self.arm, target, start, avoid_collisions=True)
        if not ik.ok:  # a target that cannot be had without touching something may be meant to be touched
            ik = solve_ik(self.arm, target, start)
        if not ik.ok:
            short = 1e3 * ik.position_error
            return self._refused(goal, f"out of reach by {short:.1f} mm" if short >= 0.1 else ik.reason)
        return self._planned(lambda: move_j(self.arm, start, ik.q), goal, settle)

    def move_j(self, q: ArrayLike, *, settle: float = 1.0) -> MoveResult:
        """Brings the joints to a position, straight in joint space.

        Args:
            q: (n,) rad, inside the limits.
            settle: s that the arm may take to come to rest after the motion.

        Returns:
            How it ended, measured at the tip.

        Raises:
            InputError: A wrong length or a number that is not finite.
            LimitError: A position outside the limits.
            SimulationError: The controller failed; `error.log` holds what there was until then.
        """
        goal = Target.read(self.arm.fk(self.arm.checked("q", q)))
        return self._planned(lambda: move_j(self.arm, self._start, q), goal, settle)

    def move_l(self, target: Pose | ArrayLike, *, settle: float = 1.0, **caps: float) -> MoveResult:
        """Brings the tip to a target on a straight line.

        Args:
            target: T_world_tip, or (3,) m with the orientation left free.
            settle: s that the arm may take to come to rest after the motion.
            **caps: tip_speed, m/s, and tip_angular_speed, rad/s, as for `armctl.move_l`.

        Returns:
            How it ended; a line that leaves the reach or the limits is refused before anything moves, and `reason` says where.

        Raises:
            InputError: The target has a wrong length or a number that is not finite.
            SimulationError: The controller failed; `error.log` holds what there was until then.
        """
        return self._planned(lambda: move_l(self.arm, self._start, target, **caps), Target.read(target), settle)

    def move_c(
        self,
        via: Pose | ArrayLike,
        target: Pose | ArrayLike,
        *,
        angle: float | None = None,
        settle: float = 1.0,
        **caps: float,
    ) -> MoveResult:
        """Brings the tip on an arc through one point to another.

        Args:
            via: T_world_tip or (3,) m, a point on the way.
            target: T_world_tip, or (3,) m with the orientation left free.
            angle: rad, how far to go on the circle; None stops at the target. 2 pi is the full circle.
            settle: s that the arm may take to come to rest after the motion.
            **caps: tip_speed, m/s, and tip_angular_speed, rad/s, as for `armctl.move_c`.

        Returns:
            How it ended; an arc that leaves the reach or the limits is refused before anything moves, and `reason` says where.

        Raises:
            InputError: An argument has a wrong length or a number that is not finite, or the points are on one line.
            SimulationError: The controller failed; `error.log` holds what there was until then.
        """
        goal = Target.read(target)
        return self._planned(
            lambda: move_c(self.arm, self._start, via, target, angle=angle, **caps), goal, settle, angle is not None
        )

    def move_path(
        self, path: Sequence[Line | Arc | Pose | ArrayLike], *, blend: float = 0.0, settle: float = 1.0, **caps: float
    ) -> MoveResult:
        """Brings the tip along lines and arcs, the corners between them rounded.

        Args:
            path: Its lines and arcs; a pose or a point alone is a line to it.
            blend: m, the radius around each corner in which it is rounded.
            settle: s that the arm may take to come to rest after the motion.
            **caps: tip_speed, m/s, and tip_angular_speed, rad/s, as for `armctl.move_path`.

        Returns:
            How it ended; a path that leaves the reach or the limits is refused before anything moves, and `reason` says where.

        Raises:
            InputError: The path is empty, or an argument has a wrong length or a number that is not finite.
            SimulationError: The controller failed; `error.log` holds what there was until then.
        """
        if len(path) == 0:
            raise InputError("path: it is empty; give at least one line or arc")
        last = path[-1]
        target = last.target if isinstance(last, (Line, Arc)) else last
        turned = isinstance(last, Arc) and last.angle is not None
        plan = lambda: move_path(self.arm, self._start, path, blend=blend, **caps)  # noqa: E731
        return self._planned(plan, Target.read(target), settle, turned)

    def follow(self, target: str | Callable[[float], Pose | ArrayLike] = TARGET, *, seconds: float = 10.0) -> Log:
        """Follows something that moves: fifty times a second a new goal, every limit kept on the way to it.

        Where the target is out of reach the tip stays as near to it as it can.

        Args:
            target: The name of a body of the model, whose point is followed; or a function of the time since the start, s,
                that gives T_world_tip or (3,) m.
            seconds: How long, s.

        Returns:
            Every tick of it.

        Raises:
            InputError: A negative time, or a function that gives neither a pose nor three finite numbers.
            UnknownNameError: The model has no such body.
            SimulationError: The controller failed; `error.log` holds what there was until then.
        """
        where = _body_position(self.model, self.data, target) if isinstance(target, str) else target
        recorder, started, begin = Recorder(self.arm), time.perf_counter(), self.data.time
        motion, before = OnlineMotion(self.arm, self._start), self._start
        ticks = ticks_for(_FOLLOW_PERIOD, self.dt) - 1
        while not self._stepper.failure and self.data.time - begin < number("seconds", seconds, 0.0) - 1e-9:
            wanted = solve_ik(self.arm, where(self.data.time - begin), motion.setpoint.q)
            motion.go_to(wanted.q)
            rows = [motion.setpoint[:3], *(motion.step(self.dt)[:3] for _ in range(ticks))]
            q, v, a = (np.array(row) for row in zip(*rows, strict=True))
            v_tick = v if self._stepper.continuous else np.diff(np.vstack([before, q]), axis=0) / self.dt
            rates = np.diff(v_tick, axis=0) / self.dt
            self._stepper.follow(self.controller, TickReference(q[:-1], v[:-1], a[:-1], v_tick[:-1], rates), recorder)
            before = q[-2]
        return self._logged(recorder, seconds, np.full(7, np.nan), started)

    @property
    def _start(self) -> Array:
        """Where the next motion starts: where the last one ended."""
        return self.arm.limits.clamp(self._stepper.q_ref)

    def _planned(self, plan: Callable[[], JointTrajectory], goal: Target, settle: float, elsewhere: bool = False) -> MoveResult:
        """Plans, and moves if there is a plan; `elsewhere` is a motion that does not end at the goal's point."""
        number("settle", settle, 0.0)
        self._show(goal)
        if self._stepper.failure:
            return self._refused(goal, f"{self._stepper.failure}; reset() starts afresh")
        try:
            trajectory = plan()
        except PlanError as error:
            return self._refused(goal, str(error))
        if elsewhere:
            goal = Target.read(self.arm.fk(trajectory(trajectory.duration).q))
        return self._move(trajectory, goal, settle)

    def _move(self, trajectory: Trajectory, goal: Target, settle: float) -> MoveResult:
        """Follows a motion, then holds its end until the tip has come to rest, at most `settle` seconds."""
        stepper, recorder, started, begin = self._stepper, Recorder(self.arm), time.perf_counter(), self.data.time
        ticks = ticks_for(trajectory.duration, self.dt)
        stepper.follow(self.controller, stepper.reference(trajectory, ticks), recorder)
        still = np.zeros((ticks_for(_SETTLE_CHUNK, self.dt), self.arm.n))
        hold = TickReference(trajectory(trajectory.duration).q + still, still, still, still, still)
        deadline = self.data.time + settle
        while not stepper.failure and self.data.time < deadline and not (self._is_still() and goal.is_reached(self.tip)):
            stepper.follow(self.controller, hold, recorder)
        log = self._logged(recorder, trajectory.duration, goal.numbers, started)
        position_error, orientation_error = goal.distance(self.tip)
        reason = stepper.failure
        if not reason and not goal.is_reached(self.tip):
            reason = f"the tip is {1e3 * position_error:.3g} mm and {orientation_error:.3g} rad from the target"
            if touching := collision_checker(self.arm).at(self.state.q):
                reason += f"; {touching}"
        elif not reason and not self._is_still():
            reason = f"the arm has not come to rest within {settle:g} s"
        return MoveResult(not reason, position_error, orientation_error, float(self.data.time - begin), reason, log)

    def _logged(
        self, recorder: Recorder, motion_duration: float, goal: Array, started: float, controller: Controller | None = None
    ) -> Log:
        wall = time.perf_counter() - started
        self.log = self._stepper.log(controller or self.controller, recorder, motion_duration, goal, wall)
        return self.log

    def _refused(self, goal: Target, reason: str) -> MoveResult:
        return MoveResult(False, *goal.distance(self.tip), 0.0, reason, None)

    def _is_still(self) -> bool:
        return bool(np.abs(self.state.v).max() < _SETTLED_SPEED)

    def _show(self, goal: Target) -> None:
        """Puts the green target at a goal."""
        mocap = self.model.body_mocapid[mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, TARGET)]
        if mocap >= 0:
            self.data.mocap_pos[mocap] = goal.position
            if goal.pose is not None:
                self.data.mocap_quat[mocap] = goal.pose.quat


def _body_position(model: mujoco.MjModel, data: mujoco.MjData, name: str) -> Callable[[float], Array]:
    """Where a body is, as a function of the time, which it does not need."""
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    if body < 0:
        raise UnknownNameError.of("body", name, [model.body(i).name for i in range(1, model.nbody)])

    def position(_: float) -> Array:
        mujoco.mj_kinematics(model, data)
        return data.xpos[body].copy()

    return position
