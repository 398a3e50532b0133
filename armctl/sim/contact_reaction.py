"""ContactReaction: what a simulation does when the arm feels a contact during a motion."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from armctl.control import Controller, State, controller_name
from armctl.control.external_force import ExternalForce
from armctl.control.hand_guiding import HandGuiding
from armctl.core.errors import InputError, PlanError
from armctl.core.trajectory import Setpoint, TickReference, Trajectory
from armctl.core.validation import Array, choice, instance, number
from armctl.motion.move_j import move_j
from armctl.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.robot.arm import Arm
from armctl.sim.recorder import Recorder

REACTIONS = ("stop", "retreat", "float")
_CHECK_INTERVAL_S = 0.004
_SHORTEST_RETREAT = 1e-4  # rad (m)

_Run = Callable[[Controller, TickReference, Recorder], None]


class ContactReaction:
    """Stops a motion on its path where a contact is felt; the arm then stays, goes back along the path, or floats.

    Assign it to `Simulation.reaction`. All motions keep the limits of the arm. The ticks are run in Python.

    Attributes:
        force: The observer.
        reaction: "stop", "retreat" or "float".
        seconds: s, how far back along the path a retreat goes, or how long the arm floats.
        contact: What was felt in the last motion; empty if nothing was.
        time: s of simulated time, when it was felt; NaN if nothing was.
    """

    def __init__(self, arm: Arm, force: ExternalForce | None = None, reaction: str = "stop", seconds: float = 0.3):
        """A reaction to contacts.

        Args:
            force: An observer; one with default thresholds if left out.
            reaction: "stop", "retreat" or "float".
            seconds: As the attribute.
        """
        self.force = ExternalForce(arm) if force is None else force
        instance("force", self.force, ExternalForce, "armctl.ExternalForce(arm) is one")
        self.reaction = choice("reaction", reaction, REACTIONS)
        self.seconds = number("seconds", seconds, 0.0, 3600.0)
        self.contact = ""
        self.time = float("nan")
        self._arm = arm

    def run(
        self,
        controller: Controller,
        trajectory: Trajectory,
        reference: TickReference,
        recorder: Recorder,
        run: _Run,
        motor_torque: Callable[[], Array],
        state: State,
    ) -> str:
        """Runs a motion until it ends or a contact is felt, and then the reaction.

        Args:
            reference: The motion on the ticks.
            run: Runs a reference.
            motor_torque: The torque of the motors in the last tick.
            state: Before the motion.

        Returns:
            What was felt; empty if nothing was.

        Raises:
            InputError: The motion is no JointTrajectory, which can be stopped on its path.
        """
        if not isinstance(trajectory, JointTrajectory):
            raise InputError("reaction: only a JointTrajectory can be stopped on its path; set sim.reaction to None")
        feeling = _Feeling(controller, self.force, motor_torque)
        self.contact = ""
        self.time = float("nan")
        dt = state.dt
        step = max(1, round(_CHECK_INTERVAL_S / dt))
        row = 0
        while row < len(reference.q) and not feeling.contact:
            run(feeling, _rows(reference, row, row + step), recorder)
            row += step
        if not feeling.contact:
            return ""
        self.contact = feeling.contact
        self.time = feeling.time
        reached = min(row * dt, trajectory.duration)
        try:
            stop = trajectory.stopped_at(reached)
        except PlanError:
            stop = trajectory
        ticks = int(np.ceil(stop.duration / dt)) + 1
        rest = TickReference.of(stop, dt, ticks, state.continuous)
        if ticks > row:
            run(controller, _rows(rest, row, ticks), recorder)
        if self.reaction == "retreat":  # to where the motion was some time before the contact
            begin = stop(stop.duration).q
            goal = trajectory(max(reached - self.seconds, 0.0)).q
            if np.abs(goal - begin).max() >= _SHORTEST_RETREAT:
                back = move_j(self._arm, self._arm.limits.clamp(begin), goal)
                ticks = int(np.ceil(back.duration / dt)) + 1
                run(controller, TickReference.of(back, dt, ticks, state.continuous), recorder)
        elif self.reaction == "float" and self.seconds > 0.0:
            nothing = np.full((max(1, round(self.seconds / dt)), self._arm.n), np.nan)
            run(HandGuiding(self._arm), TickReference(nothing, nothing, nothing, nothing, nothing), recorder)
        return f"contact at {self.time:.3f} s: {self.contact}"


class _Feeling:
    """A controller beside which an observer runs, with the first alarm, empty before it, and its time, s."""

    def __init__(self, controller: Controller, force: ExternalForce, motor_torque: Callable[[], Array]):
        self.name = controller_name(controller)
        self.needs_wrench = getattr(controller, "needs_wrench", False)
        self.needs_deflection = getattr(controller, "needs_deflection", False)
        self.contact = ""
        self.time = float("nan")
        self._controller = controller
        self._force = force
        self._motor_torque = motor_torque
        force.reset()

    def torque(self, state: State, setpoint: Setpoint) -> Array:
        self._force.update(state.q, state.v, self._motor_torque(), state.dt)
        if not self.contact and (alarm := self._force.alarm):
            self.contact = alarm
            self.time = state.t
        return self._controller.torque(state, setpoint)


def _rows(reference: TickReference, first: int, end: int) -> TickReference:
    return TickReference(*(column[first:end] for column in reference))
