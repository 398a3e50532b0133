"""RobotArm: the arm of a robot, with its reaction to contacts."""

from collections.abc import Callable

from armctl.control.interface import Controller, State
from armctl.core.errors import LinkError
from armctl.core.trajectory import Setpoint, TickReference, Trajectory
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.run.execution.contact_reaction import ContactReaction
from armctl.run.execution.move import ControlledArm
from armctl.run.execution.recorder import Recorder, ticks_for
from armctl.run.links.link_drive import LinkDrive


class RobotArm(ControlledArm):
    """One arm behind a link; where it feels a contact, it stops on its path, and goes back if its reaction says so."""

    reaction: ContactReaction | None = None

    def __init__(
        self,
        arm: Arm,
        drive: LinkDrive,
        provable: Callable[[JointTrajectory], JointTrajectory | None],
        controller: Controller | None,
    ):
        """An arm whose drive is given; `provable` slows a motion down as far as needed, or refuses it.

        Without a controller, which the link computes, the robot's own servo follows.
        """
        super().__init__(arm, controller or _OwnServo(drive.description.removeprefix("robot: ")), drive)
        self._link_drive = drive
        self._provable = provable

    def _run(self, trajectory: Trajectory, reference: TickReference, recorder: Recorder) -> None:
        reaction = self.reaction
        drive = self._link_drive
        if reaction is None:
            super()._run(trajectory, reference, recorder)
            return
        reaction.reset()
        drive.reaction = reaction
        try:
            super()._run(trajectory, reference, recorder)
            if reaction.contact:
                drive.come_to_rest(stop=True)
        finally:
            drive.reaction = None
        if reaction.contact and not drive.fault:
            self._go_back(reaction, trajectory, recorder)
            drive.failure = drive.fault or reaction.reason

    def _go_back(self, reaction: ContactReaction, trajectory: Trajectory, recorder: Recorder) -> None:
        drive = self._link_drive
        back = reaction.way_back(self.arm, trajectory, drive.time_at_contact, drive.q_ref)
        allowed = None if back is None else self._provable(back)
        if allowed is not None:
            drive.failure = ""
            drive.run(self.controller, drive.reference(allowed, ticks_for(allowed.duration, drive.dt)), recorder)
            drive.come_to_rest(stop=False)


class _OwnServo:
    """The robot's own servo, in the place of a controller."""

    def __init__(self, name: str):
        self.name = name

    def torque(self, state: State, setpoint: Setpoint) -> Array:
        raise LinkError("the robot's own servo computes its torques")
