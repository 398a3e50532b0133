"""ContactReaction: what an arm does when it feels a contact during a motion."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from armctl.control.external_force import ExternalForce
from armctl.control.hand_guiding import HandGuiding
from armctl.control.interface import Controller, ControllerWrapper, State, traits
from armctl.core.errors import InputError, PlanError
from armctl.core.trajectory import Setpoint, TickReference, Trajectory
from armctl.core.validation import Array, choice, instance, number
from armctl.model.arm.arm import Arm
from armctl.plan.motion.move_j import move_j
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.run.execution.recorder import Recorder

REACTIONS = ("stop", "retreat", "float")
_CHECK_INTERVAL_S = 0.004
_SHORTEST_RETREAT = 1e-4  # rad (m)

_Run = Callable[[Controller, TickReference, Recorder], None]


class ContactReaction:
    """Stops a motion on its path where a contact is detected; the arm then stays, goes back along the path, or floats.

    Assign it to `Simulation.reaction`, whose ticks are then run in Python, or to `Robot.reaction`. All motions keep the limits
    of the arm.

    Attributes:
        force: The observer.
        reaction: "stop", "retreat" or "float".
        duration: s, how far back along the path a retreat goes, or how long the arm floats.
        contact: What was detected in the last motion; empty if nothing was.
        time: s of simulated time, or since the robot was connected, when it was detected; NaN if nothing was.
    """

    def __init__(self, arm: Arm, force: ExternalForce | None = None, reaction: str = "stop", duration: float = 0.3):
        """A reaction to contacts.

        Args:
            force: An observer; one with default thresholds if left out.
            reaction: "stop", "retreat" or "float".
            duration: s, how far back along the path a retreat goes, or how long the arm floats.
        """
        self.force = ExternalForce(arm) if force is None else force
        instance("force", self.force, ExternalForce, "armctl.ExternalForce(arm) is one")
        self.reaction = choice("reaction", reaction, REACTIONS)
        self.duration = number("duration", duration, 0.0, 3600.0)
        self._arm = arm
        self.reset()

    def reset(self) -> None:
        """Forgets the last motion."""
        self.contact = ""
        self.time = float("nan")
        self.force.reset()

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The joints of its arm."""
        return self._arm.joint_names

    @property
    def reason(self) -> str:
        """The contact that was detected, and when; empty if nothing was."""
        return f"contact at {self.time:.3f} s: {self.contact}" if self.contact else ""

    def update(self, t: float, q: Array, v: Array, torque: Array, dt: float) -> None:
        """Takes the measurements of a tick, as `ExternalForce.update`; the first alarm is the contact that counts.

        Args:
            t: s, what `time` becomes if a contact is detected.
            torque: (n,) N m, of the motors.
            dt: s since the last measurements.
        """
        self.force.update(q, v, torque, dt)
        if not self.contact and (alarm := self.force.alarm):
            self.contact = alarm
            self.time = t

    def way_back(self, arm: Arm, trajectory: Trajectory, passed: float, start: Array) -> JointTrajectory | None:
        """The motion of a retreat, from where the arm stopped to where it was before the contact; None if there is none.

        Args:
            arm: The arm, with the limits of the motion.
            trajectory: The motion that was stopped.
            passed: s of it, until it was.
            start: (n,) rad, where it stopped.
        """
        goal = trajectory(max(passed - self.duration, 0.0)).q
        if self.reaction != "retreat" or np.abs(goal - start).max() < _SHORTEST_RETREAT:
            return None
        return move_j(arm, arm.limits.clamp(start), goal)

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
        """Runs a motion until it ends or a contact is detected, and then the reaction.

        Args:
            reference: The motion on the ticks.
            run: Runs a reference.
            motor_torque: The torque of the motors in the last tick.
            state: Before the motion.

        Returns:
            The contact that was detected; empty if there was none.

        Raises:
            InputError: The motion is no JointTrajectory, which can be stopped on its path.
        """
        if not isinstance(trajectory, JointTrajectory):
            raise InputError("reaction: only a JointTrajectory can be stopped on its path; set sim.reaction to None")
        self.reset()
        monitored = _MonitoredController(controller, self, motor_torque)
        dt = state.dt
        step = max(1, round(_CHECK_INTERVAL_S / dt))
        tick = 0
        while tick < len(reference.q) and not self.contact:
            run(monitored, _section(reference, tick, tick + step), recorder)
            tick += step
        if not self.contact:
            return ""
        reached = min(tick * dt, trajectory.duration)
        try:
            stop = trajectory.stopped_at(reached)
        except PlanError:
            stop = trajectory
        ticks = int(np.ceil(stop.duration / dt)) + 1
        rest = TickReference.from_trajectory(stop, dt, ticks, state.continuous)
        if ticks > tick:
            run(controller, _section(rest, tick, ticks), recorder)
        back = self.way_back(self._arm, trajectory, reached, stop(stop.duration).q)
        if back is not None:
            ticks = int(np.ceil(back.duration / dt)) + 1
            run(controller, TickReference.from_trajectory(back, dt, ticks, state.continuous), recorder)
        if self.reaction == "float" and self.duration > 0.0:
            nothing = np.full((max(1, round(self.duration / dt)), self._arm.n), np.nan)
            run(HandGuiding(self._arm), TickReference(nothing, nothing, nothing, nothing, nothing), recorder)
        return self.reason


def check_reaction(reaction: ContactReaction, arm: Arm) -> None:
    """Raises InputError if an argument `reaction` is none, or one of another arm."""
    instance("reaction", reaction, ContactReaction, "armctl.ContactReaction(arm) is one")
    if reaction.joint_names != arm.joint_names:
        own = ", ".join(arm.joint_names)
        raise InputError(f"reaction: it is of an arm with {', '.join(reaction.joint_names):.100}; this one has {own:.100}")


class _MonitoredController(ControllerWrapper):
    """A controller, at each tick of which a reaction looks for contacts."""

    def __init__(self, controller: Controller, reaction: ContactReaction, motor_torque: Callable[[], Array]):
        self.traits = traits(controller)
        self._controller = controller
        self._reaction = reaction
        self._motor_torque = motor_torque

    def torque(self, state: State, setpoint: Setpoint) -> Array:
        self._reaction.update(state.t, state.q, state.v, self._motor_torque(), state.dt)
        return self._controller.torque(state, setpoint)


def _section(reference: TickReference, first: int, end: int) -> TickReference:
    return TickReference(*(column[first:end] for column in reference))
