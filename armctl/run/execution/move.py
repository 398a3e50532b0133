"""ControlledArm: plan, run, settle and report. The one implementation of a move."""

import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from armctl.control import controller_by_name
from armctl.control.interface import Controller, has_torque, traits
from armctl.core.defaults import AT_REST_SPEED, RESTING_S, SETTLE_TIMEOUT_S
from armctl.core.errors import InputError, ModelError, PlanError
from armctl.core.log import Log, SimulationError
from armctl.core.pose import Pose
from armctl.core.region import Region
from armctl.core.result import MoveResult
from armctl.core.target import RegionMember, Target
from armctl.core.tip_targets import LookAt, RelativeTo, Stay, TipTargets, targets_by_tip
from armctl.core.trajectory import TickReference, Trajectory, check_motion
from armctl.core.units import above_text, length_text
from armctl.core.validation import Array, shown
from armctl.model.arm.arm import Arm
from armctl.model.collision.checker import CollisionChecker
from armctl.model.collision.clearance import clearance_of
from armctl.plan.ik.resting_joints import resting_joints
from armctl.plan.ik.solve import solve_ik
from armctl.plan.motion.given_duration import lasting
from armctl.plan.motion.loop_check import check_loops
from armctl.plan.motion.move_j import move_j
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.planner.free_space import FreeSpace
from armctl.plan.planner.move_free import move_free_with
from armctl.run.execution.drive import Drive, hold_reference
from armctl.run.execution.recorder import NO_TARGET, Recorder, RunInfo, ticks_for

SETTLE_CHECK_INTERVAL_S = 0.02
_MAX_CONTACTS_IN_REASON = 3


@dataclass(frozen=True, eq=False)
class PlannedMove:
    """A move: its target, and the motion there or the reason why there is none."""

    target: Target  # of the first tip
    trajectory: Trajectory | None = None
    refusal: str = ""
    clearance: float = math.nan  # m, that the motion is proved to keep; NaN if there is no proof
    left_out: tuple[tuple[str, str], ...] = ()  # bodies that touch by design, which the proof leaves out
    tip_targets: Mapping[str, Target] = field(default_factory=dict)  # by tip, of an arm with several; else empty
    member: RegionMember | None = None  # of a region as the target


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


def plan_into(arm: Arm, region: Region, q_start: Array, speed: float, space: FreeSpace | None = None) -> PlannedMove:
    """A move into a region, as `plan_to`; its target is the member that it ends at, or without a motion the nearest one."""
    arm.limits.at_speed(speed)
    nearest = PlannedMove(Target.read(region.nearest(arm.fk(q_start)).pose))
    if space is not None:
        move = plan_free(arm, nearest.target, q_start, region, speed, space)
    else:
        solution = solve_ik(arm, region, q_start, avoid=not arm.unchecked_links)
        if not solution.ok and not arm.unchecked_links:
            solution = solve_ik(arm, region, q_start)
        if not solution.ok:
            return replace(nearest, refusal=solution.reason)
        move = plan_move(arm, nearest.target, lambda: move_j(arm, q_start, solution.q, speed=speed))
    if move.trajectory is None:
        return move
    member = region.nearest(arm.fk(move.trajectory(move.trajectory.duration).q))
    return replace(move, target=Target.read(member.pose), member=member)


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
    left_out = () if space is None else space.checker.left_out
    return _to_tips(PlannedMove(move.target, motion, clearance=clearance, left_out=left_out), arm, goals, q_start)


def plan_lines_by_tip(
    arm: Arm, targets: TipTargets, q_start: Array, planner: Callable[[], JointTrajectory], checker: CollisionChecker | None
) -> PlannedMove:
    """A move of several tips on lines to their targets by a planner, as `plan_move`."""
    return _to_tips(plan_move(arm, Target.read(arm.fk(q_start)), planner, checker=checker), arm, targets, q_start)


def _to_tips(move: PlannedMove, arm: Arm, targets: TipTargets, q_start: Array) -> PlannedMove:
    """A move with targets by tip: those that were given, and where tips end that stay, are relative or look."""
    if move.trajectory is None:
        return move
    end = move.trajectory(move.trajectory.duration).q
    goals = targets_by_tip(targets, {tip: arm.fk(q_start, tip) for tip in arm.tips})
    planned = {tip: Target.read(arm.fk(end, tip)) for tip in (arm.tip, *goals)}
    given = {tip: Target.read(target) for tip, target in goals.items() if not isinstance(target, (RelativeTo, LookAt, Stay))}
    tips = planned | given
    return replace(move, target=tips[arm.tip], tip_targets=tips)


def plan_free(
    arm: Arm, target: Target, q_start: Array, goal: Target | Region | Array, speed: float, space: FreeSpace
) -> PlannedMove:
    """A move around obstacles to a target, into a region or to a configuration."""
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


@dataclass
class RunPurpose:
    """What a run is for, as its log says; changes until its end count."""

    duration: float = 0.0  # s, until the reference is at rest
    target: Array = field(default_factory=NO_TARGET.copy)  # (7,) position, m, and quaternion
    targets: Mapping[str, Array] = field(default_factory=dict)  # (7,) likewise by tip, of an arm with several


class ControlledArm:
    """An arm on a drive, with its controller."""

    def __init__(self, arm: Arm, controller: Controller, drive: Drive):
        self.arm = arm
        self.controller = controller
        self.drive = drive
        self._log: Log | None = None

    @property
    def log(self) -> Log | None:
        """The log of the last run; None before the first."""
        return self._log

    @property
    def start(self) -> Array:
        """(n,) rad, where the next motion starts: where the last reference ended."""
        return self.arm.limits.clamp(self.drive.q_ref)

    def run(self, trajectory: Trajectory, dwell: float, until_rest: bool = False) -> Log:
        """Runs a trajectory that starts now, and holds its end for `dwell` seconds, or only until the arm rests."""
        check_motion(trajectory, self.arm.joint_names)
        check_loops(self.arm, trajectory)
        moving = trajectory.duration
        held = min(dwell, SETTLE_CHECK_INTERVAL_S) if until_rest else dwell
        ticks = ticks_for(moving + held, self.drive.dt)
        reference = self.drive.reference(trajectory, ticks)
        with self.recording(RunPurpose(moving)) as recorder:
            self._run(trajectory, reference, recorder)
            if until_rest:
                self._wait_for_rest(ticks_for(moving + dwell, self.drive.dt) - ticks, recorder)
        assert self._log is not None  # the run is over
        return self._log

    def _wait_for_rest(self, ticks: int, recorder: Recorder) -> None:
        """Holds the arm, at most for so many ticks, until its joints have stayed where they are for a while.

        One look is not enough: a swing is still at its turning points.
        """
        drive = self.drive
        interval = ticks_for(SETTLE_CHECK_INTERVAL_S, drive.dt)
        passed: deque[Array] = deque(maxlen=1 + round(RESTING_S / SETTLE_CHECK_INTERVAL_S))
        for first in range(0, ticks, interval):
            passed.append(drive.state.q)
            moved = np.ptp(np.array(passed), axis=0)
            at_rest = len(passed) == passed.maxlen and bool((moved < AT_REST_SPEED * RESTING_S).all())
            if at_rest or drive.failure:
                return
            drive.run(self.controller, hold_reference(drive, min(interval, ticks - first) * drive.dt), recorder)

    def _run(self, trajectory: Trajectory, reference: TickReference, recorder: Recorder) -> None:
        """Runs a motion on the ticks."""
        self.drive.run(self.controller, reference, recorder)

    def planned(self, target: Target, plan: Callable[[], PlannedMove]) -> PlannedMove:
        """A plan; a refusal if no motion may start, such as from a state that diverged."""
        blocked = self.drive.blocked
        return PlannedMove(target, refusal=blocked) if blocked else plan()

    def move(self, move: PlannedMove) -> MoveResult:
        """Runs a planned move, then waits until the tips rest at their targets, at most one second."""
        drive = self.drive
        trajectory = move.trajectory
        if trajectory is None:
            return self._result(move, 0.0, move.refusal, None)
        begin = drive.data.time
        reference = drive.reference(trajectory, ticks_for(trajectory.duration, drive.dt))
        is_done = False
        targets = {tip: target.numbers for tip, target in move.tip_targets.items()}
        with self.recording(RunPurpose(trajectory.duration, move.target.numbers, targets)) as recorder:
            self._run(trajectory, reference, recorder)
            hold = hold_reference(drive, ticks_for(SETTLE_CHECK_INTERVAL_S, drive.dt) * drive.dt)
            deadline = drive.data.time + SETTLE_TIMEOUT_S
            while not drive.failure and drive.data.time < deadline:
                is_done = drive.is_still() and self._is_reached(move)
                if is_done:
                    break
                drive.run(self.controller, hold, recorder)
        duration = float(drive.data.time - begin)
        return self._result(move, duration, self._reason(move, is_done), self._log)

    def hold(self, seconds: float) -> None:
        """Holds the arm at its last reference, for at least one tick; not recorded unless it fails."""
        self.resume()
        recorder = self.drive.recorder()
        reference = hold_reference(self.drive, seconds)
        try:
            self.drive.run(self.controller, reference, recorder)
        except BaseException as error:
            self._keep_log(recorder, RunPurpose(), error)
            raise

    def resume(self) -> None:
        """Forgets why the last run ended early, unless no motion may start."""
        if not self.drive.blocked:
            self.drive.failure = ""

    @contextmanager
    def recording(self, purpose: RunPurpose, controller: Controller | None = None) -> Iterator[Recorder]:
        """A recorder whose ticks become the log, however the run ends; a SimulationError gets it.

        An open-loop run has a controller instead of the arm's own.
        """
        self.resume()
        recorder = self.drive.recorder()
        try:
            yield recorder
            self.drive.come_to_rest(stop=False)
        except BaseException as error:
            self.drive.come_to_rest(stop=True)
            self._keep_log(recorder, purpose, error, controller)
            raise
        self._keep_log(recorder, purpose, None, controller)

    def _keep_log(
        self, recorder: Recorder, purpose: RunPurpose, error: BaseException | None, controller: Controller | None = None
    ) -> None:
        if not recorder.has_begun:
            return
        name = traits(controller or self.controller).name
        self._log = recorder.log(self.arm, self._run_info(recorder, name, purpose, error))
        self._give_log(error)
        self._check_log(self._log)

    def _check_log(self, log: Log) -> None:
        """Called after a run has a new log."""

    def _run_info(self, recorder: Recorder, controller: str, purpose: RunPurpose, error: BaseException | None) -> RunInfo:
        drive = self.drive
        failure = drive.failure
        if error is not None and not failure:
            failure = f"interrupted at {drive.data.time:.3f} s by {type(error).__name__}"
        return RunInfo(
            controller=controller,
            plant=drive.description,
            source=drive.source,
            continuous=drive.continuous,
            torques=drive.torques,
            dt=drive.dt,
            motion_duration=float(purpose.duration),
            target=purpose.target,
            targets=purpose.targets,
            wall_time=time.perf_counter() - recorder.started,
            failure=failure,
        )

    def _give_log(self, error: BaseException | None) -> None:
        """Gives a SimulationError the log."""
        if isinstance(error, SimulationError):
            error.log = self._log

    def _ends(self, move: PlannedMove) -> Iterator[tuple[str, Target, Pose]]:
        """Where each tip should be, and is now."""
        for name, target in (move.tip_targets or {self.arm.tip: move.target}).items():
            yield name, target, self.drive.tip_pose(self.arm, name)

    def _is_reached(self, move: PlannedMove) -> bool:
        return all(target.is_reached(pose) for _, target, pose in self._ends(move))

    def _reason(self, move: PlannedMove, is_done: bool) -> str:
        """Why a move that ran is not ok; empty if it is. One that was found done is not judged again."""
        reason = self.drive.failure
        if not reason and not is_done:
            reason = self._shortfall(move)
        if reason:
            reason += self.drive.instability(self.arm, self.controller, self.drive.q_ref)
        return reason

    def _shortfall(self, move: PlannedMove) -> str:
        """How the tips miss their targets, or that the arm has not come to rest; empty if neither."""
        missed = []
        for name, target, pose in self._ends(move):
            if target.is_reached(pose):
                continue
            position_error, orientation_error = target.distance(pose)
            allowed = f"{length_text(target.tolerance)} and {target.angle_tolerance:g} rad are allowed"
            off = above_text(position_error, target.tolerance)
            which = name if move.tip_targets else "the tip"
            missed.append(f"{which} is {off} and {orientation_error:.3g} rad from the target, {allowed}")
        if missed:
            contacts = () if self._log is None else self._log.contacts
            return "; ".join([*missed, *map(str, contacts[:_MAX_CONTACTS_IN_REASON])])
        if not self.drive.is_still():
            return f"the arm has not come to rest within {SETTLE_TIMEOUT_S:g} s"
        return ""

    def _result(self, move: PlannedMove, duration: float, reason: str, log: Log | None) -> MoveResult:
        """The result with the largest errors of the arm's tips."""
        by_tip = {name: target.distance(pose) for name, target, pose in self._ends(move)}
        errors = by_tip.values()
        return MoveResult(
            ok=not reason,
            position_error=max(position_error for position_error, _ in errors),
            orientation_error=max(orientation_error for _, orientation_error in errors),
            duration=duration,
            reason=reason,
            log=log,
            unchecked_links=self.arm.unchecked_links,
            clearance=move.clearance,
            left_out=move.left_out,
            member=move.member,
            tip_errors=by_tip if move.tip_targets else {},
        )
