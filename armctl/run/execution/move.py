"""ControlledArms: plan, run, settle and report. The one implementation of a move, for one arm and for several."""

import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import accumulate

import numpy as np

from armctl.control import controller_by_name
from armctl.control.failure import ControllerFailure, checked_torque
from armctl.control.interface import WRENCH_SIZE, Controller, ControllerWrapper, State, Traits, has_torque, traits
from armctl.core.defaults import AT_REST_SPEED, RESTING_S, SETTLE_TIMEOUT_S
from armctl.core.errors import InputError, ModelError, PlanError
from armctl.core.log import Log, SimulationError
from armctl.core.pose import Pose
from armctl.core.result import MoveResult
from armctl.core.target import Target
from armctl.core.tip_targets import LookAt, RelativeTo, Stay, TipTargets, targets_by_tip
from armctl.core.trajectory import Setpoint, TickReference, Trajectory, check_motion
from armctl.core.units import above_text, length_text
from armctl.core.validation import Array, shown
from armctl.model.arm.arm import Arm
from armctl.model.collision.checker import CollisionChecker
from armctl.model.collision.clearance import clearance_of
from armctl.plan.ik.resting_joints import resting_joints
from armctl.plan.ik.solve import solve_ik
from armctl.plan.motion.given_duration import lasting
from armctl.plan.motion.move_j import move_j
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.planner.move_free import FreeSpace, move_free_with
from armctl.run.execution.drive import Drive, hold_reference
from armctl.run.execution.recorder import Recorder, RunInfo, ticks_for

SETTLE_CHECK_INTERVAL_S = 0.02
NO_TARGET = np.full(7, np.nan)
_MAX_CONTACTS_IN_REASON = 3


@dataclass(frozen=True, eq=False)
class PlannedMove:
    """The move of one arm: its target, and the motion there or the reason why there is none."""

    target: Target  # of the first tip
    trajectory: Trajectory | None = None
    refusal: str = ""
    clearance: float = math.nan  # m, that the motion is proved to keep; NaN if there is no proof
    left_out: tuple[tuple[str, str], ...] = ()  # bodies that touch by design, which the proof leaves out
    tip_targets: Mapping[str, Target] = field(default_factory=dict)  # by tip, of an arm with several; else empty


def plan_move(
    arm: Arm,
    target: Target,
    planner: Callable[[], JointTrajectory],
    *,
    ends_at_target: bool = True,
    checker: CollisionChecker | None = None,
) -> PlannedMove:
    """A move by a planner; a PlanError becomes a refusal, and so does a motion that the checker does not prove free.

    An arc of a given angle does not end at the target that defines it: then the target is where the motion ends.
    """
    move = PlannedMove(target)
    try:
        trajectory = planner()
        if checker is not None:
            checker.require_provable()
            check = clearance_of(checker, trajectory, 0.0)
            if not check.ok:
                return replace(move, refusal=check.reason)
            move = replace(move, clearance=check.distance, left_out=check.left_out)
    except (PlanError, ModelError) as error:
        return replace(move, refusal=str(error))
    if not ends_at_target:
        target = Target.read(arm.fk(trajectory(trajectory.duration).q))
    return replace(move, target=target, trajectory=trajectory)


def plan_lasting(arm: Arm, plan: Callable[[], PlannedMove], duration: float | None) -> PlannedMove:
    """A planned move that takes a given duration, s, on the same path; one that is too short becomes a refusal."""
    move = plan()
    if duration is None or not isinstance(move.trajectory, JointTrajectory):
        return move
    try:
        return replace(move, trajectory=lasting(arm, move.trajectory, duration))
    except PlanError as error:
        return replace(move, trajectory=None, refusal=str(error))


def plan_to(arm: Arm, target: Target, q_start: Array, speed: float, space: FreeSpace | None = None) -> PlannedMove:
    """A move to a target by inverse kinematics and a joint motion, around obstacles if there is a space to keep to.

    Otherwise a solution without contact is preferred. If there is none, any solution is accepted.
    """
    arm.limits.at_speed(speed)  # a wrong speed is an error even if the target is out of reach
    if space is not None:
        return plan_free(arm, target, q_start, target, speed, space)
    solution = solve_ik(arm, target, q_start, avoid=not arm.unchecked_links)
    if not solution.ok and not arm.unchecked_links:
        solution = solve_ik(arm, target, q_start)
    if not solution.ok:
        return PlannedMove(target, refusal=solution.reason)
    return plan_move(arm, target, lambda: move_j(arm, q_start, solution.q, speed=speed))


def plan_by_tip(arm: Arm, targets: TipTargets, q_start: Array, speed: float, space: FreeSpace | None) -> PlannedMove:
    """A move of several tips to their targets, as `plan_to`. Tips that are relative or look end as planned."""
    arm.limits.at_speed(speed)
    goals = targets_by_tip(targets, {tip: arm.fk(q_start, tip) for tip in arm.tips})
    move = PlannedMove(Target.read(arm.fk(q_start)))
    clearance = math.nan
    try:
        if space is not None:
            motion = move_free_with(space, arm, q_start, targets, speed=speed)
            clearance = space.least_distance(motion)
        else:
            solution = solve_ik(arm, goals, q_start, avoid=not arm.unchecked_links)
            if not solution.ok and not arm.unchecked_links:
                solution = solve_ik(arm, goals, q_start)
            if not solution.ok:
                return replace(move, refusal=solution.reason)
            rests = np.logical_or(*resting_joints(arm, targets))
            motion = move_j(arm, q_start, np.where(rests, q_start, solution.q), speed=speed)
    except (PlanError, ModelError) as error:
        return replace(move, refusal=str(error))
    end = motion(motion.duration).q
    planned = {tip: Target.read(arm.fk(end, tip)) for tip in (arm.tip, *goals)}
    given = {tip: Target.read(target) for tip, target in goals.items() if not isinstance(target, (RelativeTo, LookAt, Stay))}
    tips = planned | given
    left_out = () if space is None else space.checker.left_out
    return PlannedMove(tips[arm.tip], motion, clearance=clearance, left_out=left_out, tip_targets=tips)


def plan_free(arm: Arm, target: Target, q_start: Array, goal: Target | Array, speed: float, space: FreeSpace) -> PlannedMove:
    """A move around obstacles to a target or a configuration."""
    try:
        motion = move_free_with(space, arm, q_start, goal, speed=speed)
    except (PlanError, ModelError) as error:
        return PlannedMove(target, refusal=str(error))
    return PlannedMove(target, motion, clearance=space.least_distance(motion), left_out=space.checker.left_out)


def read_controller(given: Controller | str, arm: Arm) -> Controller:
    """A controller from what a caller gave: a controller, or the name of one."""
    if isinstance(given, str):
        return controller_by_name(given, arm)
    if not has_torque(given):
        raise InputError(f"controller: {shown(given)} has no method torque(state, setpoint); armctl.PD(arm) has")
    return given


class ControlledArms:
    """Arms of one model on one drive, each with a controller, by the names of their tips."""

    def __init__(self, arms: Sequence[Arm], controllers: Mapping[str, Controller], drive: Drive):
        self.arms = {arm.tip: arm for arm in arms}
        self.controllers = dict(controllers)
        self.drive = drive
        ends = accumulate(arm.n for arm in arms)
        self._slices = {arm.tip: slice(end - arm.n, end) for arm, end in zip(arms, ends, strict=True)}
        self._wrenches = {arm.tip: slice(WRENCH_SIZE * i, WRENCH_SIZE * (i + 1)) for i, arm in enumerate(arms)}
        self._logs: dict[str, Log] = {}

    @property
    def logs(self) -> dict[str, Log]:
        """The log of each arm's last run; empty before the first."""
        return self._logs

    def start(self, tip: str) -> Array:
        """(n,) rad, where the next motion of an arm starts: where its last reference ended."""
        return self.arms[tip].limits.clamp(self.drive.q_ref[self._slices[tip]])

    def tip_pose(self, tip: str) -> Pose:
        """The pose of a tip now, T_world_tip."""
        return self.drive.tip_pose(self.arms[tip])

    def run(self, trajectories: Mapping[str, Trajectory], dwell: float, until_rest: bool = False) -> dict[str, Log]:
        """Runs trajectories that start now, and holds their ends for `dwell` seconds, or only until they rest."""
        for tip, trajectory in trajectories.items():
            check_motion(trajectory, self.arms[tip].joint_names)
        durations = {tip: trajectory.duration for tip, trajectory in trajectories.items()}
        moving = max(durations.values(), default=0.0)
        held = min(dwell, SETTLE_CHECK_INTERVAL_S) if until_rest else dwell
        ticks = ticks_for(moving + held, self.drive.dt)
        reference = self._reference(trajectories, ticks)
        with self.recording(durations) as recorder:
            self._run(trajectories, reference, recorder)
            if until_rest:
                left = ticks_for(moving + dwell, self.drive.dt) - ticks
                self._wait_for_rest([self._slices[tip] for tip in trajectories], left, recorder)
        return self._logs

    def _wait_for_rest(self, joints: Sequence[slice], ticks: int, recorder: Recorder) -> None:
        """Holds the arms, at most for so many ticks, until their joints have stayed where they are for a while.

        One look is not enough: a swing is still at its turning points.
        """
        drive = self.drive
        interval = ticks_for(SETTLE_CHECK_INTERVAL_S, drive.dt)
        passed: deque[Array] = deque(maxlen=1 + round(RESTING_S / SETTLE_CHECK_INTERVAL_S))
        for first in range(0, ticks, interval):
            passed.append(drive.state.q)
            moved = np.ptp(np.array(passed), axis=0)
            at_rest = len(passed) == passed.maxlen and all((moved[each] < AT_REST_SPEED * RESTING_S).all() for each in joints)
            if at_rest or drive.failure:
                return
            drive.run(self._controller, hold_reference(drive, min(interval, ticks - first) * drive.dt), recorder)

    def _run(self, trajectories: Mapping[str, Trajectory], reference: TickReference, recorder: Recorder) -> None:
        """Runs motions on the ticks."""
        self.drive.run(self._controller, reference, recorder)

    def planned(self, target: Target, plan: Callable[[], PlannedMove]) -> PlannedMove:
        """A plan; a refusal if no motion may start, such as from a state that diverged."""
        blocked = self.drive.blocked
        return PlannedMove(target, refusal=blocked) if blocked else plan()

    def move(self, moves: Mapping[str, PlannedMove]) -> dict[str, MoveResult]:
        """Runs planned moves at once, then waits until the tips rest at their targets, at most one second."""
        drive = self.drive
        trajectories = {tip: each.trajectory for tip, each in moves.items() if each.trajectory is not None}
        if not trajectories:
            return {tip: self._result(tip, each, 0.0, each.refusal, None) for tip, each in moves.items()}
        begin = drive.data.time
        durations = {tip: trajectory.duration for tip, trajectory in trajectories.items()}
        reference = self._reference(trajectories, ticks_for(max(durations.values()), drive.dt))
        targets = {tip: each.target.numbers for tip, each in moves.items()}
        is_done = False
        with self.recording(durations, targets) as recorder:
            self._run(trajectories, reference, recorder)
            hold = hold_reference(drive, ticks_for(SETTLE_CHECK_INTERVAL_S, drive.dt) * drive.dt)
            deadline = drive.data.time + SETTLE_TIMEOUT_S
            while not drive.failure and drive.data.time < deadline:
                still = all(drive.is_still(self._slices[tip]) for tip in trajectories)
                is_done = still and all(self._is_reached(tip, moves[tip]) for tip in trajectories)
                if is_done:
                    break
                drive.run(self._controller, hold, recorder)
        duration = float(drive.data.time - begin)
        reasons = {tip: self._reason(tip, each, is_done) for tip, each in moves.items()}
        return {tip: self._result(tip, each, duration, reasons[tip], self._logs[tip]) for tip, each in moves.items()}

    def hold(self, seconds: float) -> None:
        """Holds all arms at their last references, for at least one tick; not recorded unless it fails."""
        self.resume()
        recorder = self.drive.recorder()
        reference = hold_reference(self.drive, seconds)
        try:
            self.drive.run(self._controller, reference, recorder)
        except BaseException as error:
            self._keep_logs(recorder, {}, {}, error)
            raise

    def resume(self) -> None:
        """Forgets why the last run ended early, unless no motion may start."""
        if not self.drive.blocked:
            self.drive.failure = ""

    @contextmanager
    def recording(
        self, durations: Mapping[str, float], targets: Mapping[str, Array] | None = None, controller: Controller | None = None
    ) -> Iterator[Recorder]:
        """A recorder whose ticks become the logs, however the run ends; a SimulationError gets the log of its arm.

        The durations, s, are those until the reference of each arm is at rest; left-out arms do not move. Changes of the
        targets (7,) until the end of the run count. An open-loop run has a controller instead of the arms' own.
        """
        self.resume()
        recorder = self.drive.recorder()
        targets = {} if targets is None else targets
        try:
            yield recorder
            self.drive.come_to_rest(stop=False)
        except BaseException as error:
            self.drive.come_to_rest(stop=True)
            self._keep_logs(recorder, durations, targets, error, controller)
            raise
        self._keep_logs(recorder, durations, targets, None, controller)

    def _keep_logs(
        self,
        recorder: Recorder,
        durations: Mapping[str, float],
        targets: Mapping[str, Array],
        error: BaseException | None,
        controller: Controller | None = None,
    ) -> None:
        if not recorder.has_begun:
            return
        self._logs = {}
        for tip, arm in self.arms.items():
            name = traits(controller or self.controllers[tip]).name
            duration = float(durations.get(tip, 0.0))
            info = self._run_info(recorder, name, duration, targets.get(tip, NO_TARGET), error)
            self._logs[tip] = recorder.log(arm, info, self._slices[tip], self._wrenches[tip])
        self._give_log(error)
        self._check_logs()

    def _check_logs(self) -> None:
        """Called after a run has new logs."""

    def _run_info(
        self, recorder: Recorder, controller: str, duration: float, target: Array, error: BaseException | None
    ) -> RunInfo:
        failure = self.drive.failure
        if error is not None and not failure:
            failure = f"interrupted at {self.drive.data.time:.3f} s by {type(error).__name__}"
        wall_time = time.perf_counter() - recorder.started
        drive = self.drive
        return RunInfo(
            controller=controller,
            plant=drive.description,
            source=drive.source,
            continuous=drive.continuous,
            torques=drive.torques,
            dt=drive.dt,
            motion_duration=duration,
            target=target,
            wall_time=wall_time,
            failure=failure,
        )

    def _give_log(self, error: BaseException | None) -> None:
        """Gives a SimulationError the log of the arm whose controller failed."""
        if isinstance(error, SimulationError):
            failure = error.__cause__
            tip = failure.tip if isinstance(failure, ControllerFailure) else ""
            error.log = self._logs[tip or next(iter(self._logs))]

    @property
    def _controller(self) -> Controller:
        if len(self.arms) == 1:
            return next(iter(self.controllers.values()))
        return _JointController(self.controllers, self._slices, self._wrenches)

    def _reference(self, trajectories: Mapping[str, Trajectory], ticks: int) -> TickReference:
        """The trajectories of some arms on the ticks; the other arms stay at their last references."""
        drive = self.drive
        if len(self.arms) == 1 and trajectories:
            return drive.reference(next(iter(trajectories.values())), ticks)
        reference = TickReference(*(np.zeros((ticks, drive.actuation.n)) for _ in TickReference._fields))
        reference.q[:] = drive.q_ref
        for tip, trajectory in trajectories.items():
            for whole, own in zip(reference, drive.reference(trajectory, ticks), strict=True):
                whole[:, self._slices[tip]] = own
        return reference

    def _ends(self, tip: str, move: PlannedMove) -> Iterator[tuple[str, Target, Pose]]:
        """Where each tip of an arm should be, and is now."""
        arm = self.arms[tip]
        for name, target in (move.tip_targets or {arm.tip: move.target}).items():
            yield name, target, self.drive.tip_pose(arm, name)

    def _is_reached(self, tip: str, move: PlannedMove) -> bool:
        return all(target.is_reached(pose) for _, target, pose in self._ends(tip, move))

    def _reason(self, tip: str, move: PlannedMove, is_done: bool) -> str:
        """Why a move that ran is not ok; empty if it is. One that was found done is not judged again."""
        reason = move.refusal or self.drive.failure
        if not reason and not is_done:
            reason = self._shortfall(tip, move)
        if reason and not move.refusal:
            q = self.drive.q_ref[self._slices[tip]]
            reason += self.drive.instability(self.arms[tip], self.controllers[tip], q)
        return reason

    def _shortfall(self, tip: str, move: PlannedMove) -> str:
        """How the tips of an arm miss their targets, or that it has not come to rest; empty if neither."""
        missed = []
        for name, target, pose in self._ends(tip, move):
            if target.is_reached(pose):
                continue
            position_error, orientation_error = target.distance(pose)
            allowed = f"{length_text(target.tolerance)} and {target.angle_tolerance:g} rad are allowed"
            off = above_text(position_error, target.tolerance)
            which = name if move.tip_targets else "the tip"
            missed.append(f"{which} is {off} and {orientation_error:.3g} rad from the target, {allowed}")
        if missed:
            return "; ".join([*missed, *map(str, self._logs[tip].contacts[:_MAX_CONTACTS_IN_REASON])])
        if not self.drive.is_still(self._slices[tip]):
            return f"the arm has not come to rest within {SETTLE_TIMEOUT_S:g} s"
        return ""

    def _result(self, tip: str, move: PlannedMove, duration: float, reason: str, log: Log | None) -> MoveResult:
        """The result with the largest errors of the arm's tips."""
        errors = [target.distance(pose) for _, target, pose in self._ends(tip, move)]
        return MoveResult(
            ok=not reason,
            position_error=max(position_error for position_error, _ in errors),
            orientation_error=max(orientation_error for _, orientation_error in errors),
            duration=duration,
            reason=reason,
            log=log,
            unchecked_links=self.arms[tip].unchecked_links,
            clearance=move.clearance,
            left_out=move.left_out,
        )


class _JointController(ControllerWrapper):
    """The controllers of several arms as one; each sees only its own arm."""

    def __init__(self, controllers: Mapping[str, Controller], slices: Mapping[str, slice], wrenches: Mapping[str, slice]):
        self._controllers = controllers
        self._slices = slices
        self._wrenches = wrenches
        each = {tip: traits(controller) for tip, controller in controllers.items()}
        self._planning = {tip: own.foresee for tip, own in each.items() if own.foresee is not None}
        self.traits = Traits(
            name="team",
            needs_wrench=any(own.needs_wrench for own in each.values()),
            needs_deflection=any(own.needs_deflection for own in each.values()),
            foresee=self._foresee if self._planning else None,
        )

    def _foresee(self, ahead: TickReference) -> None:
        for tip, foresee in self._planning.items():
            foresee(TickReference(*(column[:, self._slices[tip]] for column in ahead)))

    def torque(self, state: State, setpoint: Setpoint) -> Array:
        torques = np.empty(len(state.q))
        for tip, own in self._slices.items():
            controller = self._controllers[tip]
            reference = Setpoint(*(None if column is None else column[own] for column in setpoint))  # type: ignore[arg-type]
            wrench = None if state.wrench is None else state.wrench[self._wrenches[tip]]
            try:
                deflection = None if state.deflection is None else state.deflection[:, own]
                seen = state._replace(q=state.q[own], v=state.v[own], wrench=wrench, deflection=deflection)
                torque = controller.torque(seen, reference)
                torques[own] = checked_torque(torque, own.stop - own.start)
            except Exception as error:
                raise ControllerFailure(controller, tip) from error
        return torques
