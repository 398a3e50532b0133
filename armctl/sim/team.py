"""Team: several arms of one model in one simulation, each with its own target, controller and verdict."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from armctl.collision.checker import collision_checker
from armctl.control import ComputedTorque, Controller, State, controller_by_name, controller_name
from armctl.core.errors import InputError, UnknownNameError
from armctl.core.log import Log
from armctl.core.pose import Pose
from armctl.core.result import MoveResult
from armctl.core.target import Target
from armctl.core.trajectory import Setpoint, TickReference, Trajectory
from armctl.core.validation import Array, number
from armctl.ik import solve_ik
from armctl.motion import move_j
from armctl.robot.actuation import Actuation
from armctl.robot.arm import Arm
from armctl.sim.gripper import Gripper
from armctl.sim.plant import Plant
from armctl.sim.recorder import Recorder
from armctl.sim.stepper import Stepper

_SETTLED_SPEED = 1e-3  # rad/s
_SETTLE_CHUNK = 0.02  # s


class Team:
    """Several arms in one simulation. Each is known by the name of its tip; those that are not told to move hold their place.

    Attributes:
        arms: The arms by the names of their tips.
        controllers: What makes each one's torques.
        model: The MuJoCo model of all.
        data: Its MjData; read it freely.
    """

    def __init__(
        self,
        arms: Sequence[Arm],
        controllers: Mapping[str, Controller | str] | None = None,
        plant: Plant | None = None,
    ):
        """A simulation with all arms at home, at rest.

        Args:
            arms: Arms of one model, as `armctl.load_arms` gives them.
            controllers: A controller or the name of one by tip; computed torque where one is left out.
            plant: How reality differs from the model, but for a payload; in nothing if left out.

        Raises:
            InputError: No arms, arms of different models, or a plant with a payload or pushes.
            UnknownNameError: There is no such tip or controller.
        """
        known = isinstance(arms, Sequence) and all(isinstance(arm, Arm) and arm.model is arms[0].model for arm in arms)
        if not known or not arms:
            raise InputError("arms: arms of one model wanted; armctl.load_arms gives them")
        if plant is not None and (plant.payload or plant.pushes):
            raise InputError("plant: a team has no single tip for a payload or pushes; leave them out")
        self.arms = {arm.tip: arm for arm in arms}
        self.controllers = {tip: self._controller(tip, (controllers or {}).get(tip)) for tip in self.arms}
        self._known(controllers or {})
        ends = np.cumsum([0, *(arm.n for arm in arms)]).tolist()
        self._slices = {arm.tip: slice(*ends[i : i + 2]) for i, arm in enumerate(arms)}
        self._stepper = Stepper(_joined(arms), Plant() if plant is None else plant)
        self.model, self.data = self._stepper.model, self._stepper.data
        self._grippers: dict[str, Gripper] = {}

    def tip(self, name: str) -> Pose:
        """Where a simulated tip is now.

        Args:
            name: The tip.

        Returns:
            T_world_tip.

        Raises:
            UnknownNameError: There is no such tip.
        """
        self._known([name])
        return self.arms[name].fk(self._stepper.state.q[self._slices[name]])

    def gripper(self, name: str) -> Gripper:
        """The gripper behind a tip.

        Args:
            name: The tip.

        Returns:
            The gripper.

        Raises:
            UnknownNameError: There is no such tip.
            ModelError: There is no gripper behind it.
        """
        self._known([name])
        if name not in self._grippers:
            self._grippers[name] = Gripper(self._stepper, self._hold, self.arms[name])
        return self._grippers[name]

    def reset(self) -> None:
        """Starts afresh at t = 0, all arms at home, at rest."""
        for gripper in self._grippers.values():
            gripper.reset()
        self._stepper.reset(self._stepper.arm.home, np.zeros(self._stepper.arm.n))

    def run(self, trajectories: Mapping[str, Trajectory], settle: float = 0.0) -> dict[str, Log]:
        """Follows a trajectory for each tip, all starting now.

        Args:
            trajectories: The motions by tip.
            settle: s to go on holding their ends.

        Returns:
            A log for each arm, also of those that held their place.

        Raises:
            InputError: The settling time is negative.
            UnknownNameError: There is no such tip.
            SimulationError: A controller failed.
        """
        self._known(trajectories)
        recorder, started = Recorder(self._stepper.arm), time.perf_counter()
        duration = max((trajectory.duration for trajectory in trajectories.values()), default=0.0)
        self._follow(trajectories, duration + number("settle", settle, 0.0), recorder)
        return self._logs(recorder, trajectories, {}, time.perf_counter() - started)

    def move_to(self, targets: Mapping[str, Pose | ArrayLike], *, settle: float = 1.0) -> dict[str, MoveResult]:
        """Brings each tip to a target of its own, all at once.

        Args:
            targets: T_world_tip, or (3,) m where the orientation does not matter, by tip.
            settle: s that the arms may take to come to rest after the last of them has arrived.

        Returns:
            How it ended for each; an arm whose target is out of reach holds its place, and says so.

        Raises:
            InputError: A target has a wrong length or a number that is not finite.
            UnknownNameError: There is no such tip.
            SimulationError: A controller failed.
        """
        self._known(targets)
        number("settle", settle, 0.0)
        goals = {tip: Target.read(target) for tip, target in targets.items()}
        refused, trajectories = {}, {}
        for tip, target in targets.items():
            arm, q_ref = self.arms[tip], self._stepper.q_ref[self._slices[tip]]
            ik = solve_ik(arm, target, arm.limits.clamp(q_ref))
            if ik.ok:
                trajectories[tip] = move_j(arm, arm.limits.clamp(q_ref), ik.q)
            else:
                short = 1e3 * ik.position_error
                refused[tip] = f"out of reach by {short:.1f} mm" if short >= 0.1 else ik.reason
        recorder, started, begin = Recorder(self._stepper.arm), time.perf_counter(), self.data.time
        self._follow(trajectories, max((t.duration for t in trajectories.values()), default=0.0), recorder)
        deadline = self.data.time + settle
        while (
            not self._stepper.failure
            and self.data.time < deadline
            and not all(self._arrived(t, goals[t]) for t in trajectories)
        ):
            self._follow({}, _SETTLE_CHUNK, recorder)
        logs = self._logs(recorder, trajectories, goals, time.perf_counter() - started)
        took = float(self.data.time - begin)
        return {tip: self._result(tip, goal, refused.get(tip, ""), took, logs[tip]) for tip, goal in goals.items()}

    def _result(self, tip: str, goal: Target, refusal: str, took: float, log: Log) -> MoveResult:
        position_error, orientation_error = goal.distance(self.tip(tip))
        reason = refusal or self._stepper.failure
        if not reason and not self._arrived(tip, goal):
            reason = f"the tip is {1e3 * position_error:.3g} mm and {orientation_error:.3g} rad from the target, or not at rest"
            if touching := collision_checker(self.arms[tip]).at(self._stepper.state.q[self._slices[tip]]):
                reason += f"; {touching}"
        return MoveResult(not reason, position_error, orientation_error, took, reason, log)

    def _arrived(self, tip: str, goal: Target) -> bool:
        still = np.abs(self._stepper.state.v[self._slices[tip]]).max() < _SETTLED_SPEED
        return bool(still and goal.is_reached(self.tip(tip)))

    def _follow(self, trajectories: Mapping[str, Trajectory], seconds: float, recorder: Recorder) -> None:
        """Runs all arms for a time: those with a trajectory along it, the others where they were last told to be."""
        stepper = self._stepper
        ticks = max(1, math.ceil(seconds / stepper.dt - 1e-9) + 1)
        rows = [np.zeros((ticks, stepper.arm.n)) for _ in TickReference._fields]
        rows[0] += stepper.q_ref
        for tip, trajectory in trajectories.items():
            for row, column in zip(rows, stepper.reference(trajectory, ticks), strict=True):
                row[:, self._slices[tip]] = column
        stepper.follow(_Together(self.controllers, self._slices), TickReference(*rows), recorder)

    def _hold(self, seconds: float) -> None:
        self._stepper.hold(_Together(self.controllers, self._slices), seconds)

    def _logs(
        self, recorder: Recorder, trajectories: Mapping[str, Trajectory], goals: Mapping[str, Target], wall: float
    ) -> dict[str, Log]:
        return {
            tip: recorder.log(
                arm,
                joints=self._slices[tip],
                controller=controller_name(self.controllers[tip]),
                plant=str(self._stepper.plant),
                dt=self._stepper.dt,
                motion_duration=trajectories[tip].duration if tip in trajectories else 0.0,
                target=goals[tip].numbers if tip in goals else np.full(7, np.nan),
                real_time_factor=recorder.size * self._stepper.dt / max(wall, 1e-9),
                failure=self._stepper.failure,
            )
            for tip, arm in self.arms.items()
        }

    def _controller(self, tip: str, given: Controller | str | None) -> Controller:
        if given is None:
            return ComputedTorque(self.arms[tip])
        return controller_by_name(given, self.arms[tip]) if isinstance(given, str) else given

    def _known(self, tips) -> None:
        for tip in tips:
            if tip not in self.arms:
                raise UnknownNameError.of("tip", str(tip), self.arms)


@dataclass(frozen=True)
class _Together:
    """The controllers of a team as one: each sees its own arm only."""

    controllers: Mapping[str, Controller]
    slices: Mapping[str, slice]

    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torques of all."""
        parts = []
        for tip, own in self.slices.items():
            ticks = (None if column is None else column[own] for column in setpoint[3:])
            wanted = Setpoint(setpoint.q[own], setpoint.v[own], setpoint.a[own], *ticks)
            parts.append(self.controllers[tip].torque(state._replace(q=state.q[own], v=state.v[own]), wanted))
        return np.concatenate(parts)


def _joined(arms: Sequence[Arm]) -> Arm:
    """All joints of several arms as if they were one's, for the stepper; its tip is the first one's."""
    actuation = Actuation.concatenated([arm.actuation for arm in arms])
    return replace(arms[0], actuation=actuation, home=np.concatenate([arm.home for arm in arms]))
