"""Robot: the commands of a Simulation, on a robot behind a link."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from armctl.control.interface import Controller
from armctl.core import hooks
from armctl.core.errors import InputError, LinkError, ModelError
from armctl.core.faces import named_after_itself
from armctl.core.log import Log
from armctl.core.pose import Pose
from armctl.core.result import MoveResult
from armctl.core.target import Target
from armctl.core.trajectory import Trajectory, check_motion
from armctl.core.validation import flag, instance, number, shown
from armctl.model.arm.arm import Arm
from armctl.model.collision.checker import CollisionChecker, why_not_checkable
from armctl.model.gripper.gripper_model import GripperModel, find_gripper_model
from armctl.model.loading.load import load
from armctl.model.mjmodel.target_marker import TARGET
from armctl.plan.grasp.handling_scene import HandledBody
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.piecewise import Pieces, sample
from armctl.plan.stream.refusal import contact_refusal
from armctl.run.execution.contact_reaction import ContactReaction, check_reaction
from armctl.run.execution.follow import MovingTarget
from armctl.run.execution.hand_commands import GripperAtHand, HandCommands
from armctl.run.execution.move import PlannedMove
from armctl.run.links.dry_run import DryRun, rehearsal_of
from armctl.run.links.envelope import envelope_of
from armctl.run.links.hand import Hand
from armctl.run.links.host import LinkHost
from armctl.run.links.link import Link, check_link
from armctl.run.links.link_check import LinkCheck, link_check_of, model_refusal, tip_difference
from armctl.run.links.link_drive import LinkDrive
from armctl.run.links.motion_run import MotionRun
from armctl.run.links.process import RemoteHost
from armctl.run.links.robot_arm import RobotArm
from armctl.run.links.robot_law import check_that_link_bears, link_law
from armctl.run.links.sole_program import hold_alone

LEASE_S = 0.5  # without a request of the planner, until the arm brakes
_SLOWEST = 0.02  # of a motion's speed; one that must be slower is refused
_SAMPLES = 400


@named_after_itself
class Robot(HandCommands):
    """A robot, commanded as a `Simulation` is: the same moves, the same results, the same refusals.

    It is no safety function: an emergency stop, the maker's safety configuration and a fence are the user's.

    Before anything is sent, a motion is proved free of contacts with the model's scene, and its samples are checked against
    what the maker publishes. They are sent by a process of its own; where the program stops, fails or hangs, the arm brakes on
    its path. A fault of the robot stays until `recover`. With `controller=` that process computes the torques of a controller,
    which follows the same motions.

    Attributes:
        arm: The model, with the limits of the robot's motions.
        link: The link, as it was given.
        lost_ticks: Ticks that the stream lost until now.
        late_ticks: Ticks by which motions of `follow` came too late until now.
        delay: s, from a command of the controller to the torque, with its jitter; NaN without `controller=`.

    Example:
        >>> with armctl.Robot("fr3", armctl.links.Franka("172.16.0.2")) as robot:
        ...     result = robot.move_to([0.5, 0.2, 0.4])
    """

    def __init__(
        self,
        robot: Arm | str,
        link: Link,
        *,
        speed: float = 0.2,
        tip_speed: float = 0.25,
        payload: float = 0.0,
        allow_contact: bool = False,
        controller: Controller | str | None = None,
        error_max: float | None = None,
    ):
        """Connects to a robot, and checks that it is the model's. Nothing moves.

        Args:
            robot: An arm with its tool and its scene, or a name for `armctl.load`.
            link: Such as `armctl.links.Franka(host)`; a `DryRun` of it sends nothing.
            speed: Share of the full speed, acceleration and jerk, in (0, 1].
            tip_speed: m/s, the greatest speed of the tip.
            payload: kg at the tip; the robot must be set to the same.
            allow_contact: Whether motions may be asked for with `avoid=False`, and the arm may have links without a shape.
            controller: A controller or its name, whose torques are sent instead of positions, if the link takes torques. By
                default the robot's own servo follows the motions. It is refused if it leaves less than one tick of delay
                margin, or a peak sensitivity above 2, at the delay of the link, which is measured: the arm is held meanwhile.
            error_max: rad, by which a joint may leave its reference before the controller is ended, 0.1 by default; no bound
                for controllers that yield by design, such as impedance.

        Raises:
            InputError: An argument of another type, or a number out of its bounds.
            UnknownNameError: There is no such robot.
            ModelError: The robot's model is no arm, or a link of it has no collision shape and `allow_contact` is False.
            LinkError: The connection failed, another program has it, or the robot is not the model's.
        """
        model = robot if isinstance(robot, Arm) else load(robot)
        check_link(link)
        tip_speed = number("tip_speed", tip_speed, 1e-3)
        payload = number("payload", payload, 0.0)
        self._allows_contact = flag("allow_contact", allow_contact)
        if model.unchecked_links and not self._allows_contact:
            raise ModelError(f"{why_not_checkable(model)}, which a Robot does with allow_contact=True")
        envelope = link.envelope or envelope_of(model.limits, f"limits of the model {model.name}")
        if len(envelope.limits.q_min) != model.n:
            raise LinkError(f"the robot has {len(envelope.limits.q_min)} joints, the model {model.name:.60} has {model.n}")
        self.link = link
        arm = model.with_limits(envelope.planning_limits(model.limits, speed))
        self._lock = hold_alone(link.address, f"{link.address}: another program commands this robot; end it first")
        with contextlib.ExitStack() as failed:
            failed.callback(self._unlock)
            law = link_law(arm, link, controller, envelope, error_max)
            self._host = LinkHost(link, law) if link.passes_time else RemoteHost(link, LEASE_S, law)
            failed.callback(self._host.close)
            self._host.open()
            refusal = model_refusal(model, self._host.read(), self._host.tip(), link.payload, payload)
            if refusal:
                raise LinkError(refusal)
            self.delay: float = np.nan if law is None else check_that_link_bears(law, self._host, link.dt)
            self._drive = LinkDrive(arm, self._host, link, envelope, tip_speed, has_law=law is not None)
            failed.pop_all()
        self._controlled: RobotArm = RobotArm(arm, self._drive, self._provable, None if law is None else law.controller)
        super().__init__(self._controlled)
        self._settle = link.settle if law is None else law.interface.settle or link.settle
        self._closed = False
        self._hands: list[GripperModel] = []  # of the model, once it is needed

    @property
    def gripper(self) -> Hand:
        """The robot's hand.

        Raises:
            LinkError: The robot has none.
        """
        hand = Hand(self._host)
        hand.width  # noqa: B018  # LinkError if there is none
        return hand

    @property
    def reaction(self) -> ContactReaction | None:
        """The reaction to contacts during moves and `run`, "stop" or "retreat"; None for none.

        It is detected in the program, so that the arm brakes about 25 ms later; the robot's own reaction is faster.
        """
        return self._controlled.reaction

    @reaction.setter
    def reaction(self, reaction: ContactReaction | None) -> None:
        if reaction is not None:
            check_reaction(reaction, self.arm)
            if reaction.reaction == "float":
                raise InputError("reaction: a robot takes positions only and cannot float; 'stop' and 'retreat' are possible")
            reading = self._host.read()
            if not (np.isfinite(reading.v).all() and np.isfinite(reading.tau).all()):
                raise InputError(f"reaction: {self.link.name} measures no speeds and torques, so that it feels no contact")
        self._controlled.reaction = reaction

    @property
    def lost_ticks(self) -> int:
        """Ticks that the stream lost until now."""
        return self._drive.lost

    @property
    def late_ticks(self) -> int:
        """Ticks by which motions of `follow` came too late until now; after each the arm comes to rest and goes on."""
        return self._drive.late

    @property
    def fault(self) -> str:
        """Why the robot takes no motion until `recover`; empty if it does."""
        return self._drive.fault

    @property
    def interlock(self) -> Callable[[], str] | None:
        """A function that returns why the arm must not move now, or an empty text if it may; None for none.

        It is asked before every motion, and on it every few milliseconds: the arm brakes on its path as soon as there is a
        reason, with which the command ends. It must not wait. A function that fails is a reason. It is no safety function.
        """
        return self._drive.interlock

    @interlock.setter
    def interlock(self, interlock: Callable[[], str] | None) -> None:
        if interlock is not None and not callable(interlock):
            raise InputError(f"interlock: expected a function without arguments that returns a text, got {shown(interlock)}")
        self._drive.interlock = interlock

    def recover(self) -> None:
        """Clears a fault, once you have reading that the robot may move again. Nothing does that by itself.

        Raises:
            LinkError: The robot cannot be recovered by a program, and what to do.
        """
        self._drive.recover()

    def view(self) -> Any:
        """Opens a page that shows every move: the robot as it measures itself, and a ghost where it was commanded to be.

        The page commands nothing, and the robot does not wait for it. Call it before the first move: it takes seconds.

        Returns:
            The page, as `Simulation.viewer`: it has `url`, `wait` and `close`.

        Raises:
            NotInstalledError: viser or mjviser is missing.
        """
        assert hooks.open_viewer is not None
        viewer = hooks.open_viewer(self.arm)
        self._drive.observer = viewer.drawing_of_robot(self.link.name).show
        return viewer

    def check(self, duration: float = 10.0) -> LinkCheck:
        """Holds the position for a while, and measures how regularly positions are sent.

        Args:
            duration: s, how long the link is watched.

        Returns:
            The check: ok if no more than one tick in a hundred was lost.

        Raises:
            InputError: The time is less than a tick or more than an hour.
            LinkError: The robot reported a fault before.
        """
        duration = number("duration", duration, self.dt, 3600.0)
        T_base_tip = self._host.tip()
        difference = np.nan if T_base_tip is None else tip_difference(self.arm, self._host.read().q, T_base_tip)
        lost = self._drive.lost
        times = self._drive.hold(duration)
        return link_check_of(self._drive, difference, times, self._drive.lost - lost)

    def close(self) -> None:
        """Brakes if something moves, and disconnects. Leaving a `with` block does the same."""
        if self._closed:
            return
        self._closed = True
        try:
            self._drive.come_to_rest(stop=True)
        finally:
            self._host.close()
            self._unlock()

    def __enter__(self) -> Robot:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def run(self, trajectory: Trajectory, dwell: float = 0.0) -> Log:
        """Follows a trajectory that starts at the robot's last command, and ends at rest.

        Args:
            trajectory: The motion. It is not slowed down: where it exceeds a limit, it is not sent.
            dwell: s to hold its end.

        Returns:
            What was sent and measured. `log.failure` gives the reason if the motion was not sent or ended early.

        Raises:
            InputError: It is no motion or a motion of other joints, it touches something and `allow_contact` is False, or the
                dwell time is negative or too long for a log.
            LinkError: The robot reported a fault before.
        """
        if not self._allows_contact and isinstance(trajectory, JointTrajectory) and trajectory.n == self.arm.n:
            reason = self._contact(trajectory.pieces)
            if reason:
                raise InputError(f"trajectory: {reason}; give allow_contact=True to the Robot if it may")
        elif not self._allows_contact and not isinstance(trajectory, JointTrajectory):
            raise InputError(
                "trajectory: only a JointTrajectory can be proved free of contact; "
                "give allow_contact=True to the Robot for another one"
            )
        return self._rehearsed(super().run(trajectory, dwell))

    def slowed(self, trajectory: JointTrajectory) -> JointTrajectory:
        """A motion on the same path, as slow as the robot demands: moves are slowed down so, but `run` sends a motion as it is.

        Args:
            trajectory: The motion.

        Returns:
            The motion itself if it is slow enough; otherwise one at which the tip keeps `tip_speed`, and the joints the speeds
            that the maker allows where they are.

        Raises:
            InputError: It is no JointTrajectory, it is of other joints, or it would take more than fifty times as long.
        """
        instance("trajectory", trajectory, JointTrajectory, "armctl.move_j returns one")
        check_motion(trajectory, self.arm.joint_names)
        share, joint = self._speed_share(trajectory.pieces)
        if share < _SLOWEST:
            raise InputError(f"trajectory: {_too_slow(joint)}; choose another motion")
        return trajectory if share >= 1.0 else trajectory.scaled(share)

    def follow(self, target: MovingTarget = TARGET, *, duration: float = 10.0) -> Log:
        """Follows a moving target, as that of a Simulation; every motion to a goal is proved and checked before it is sent.

        Where no such motion leads to a goal, the arm goes as far towards it as one does. If the targets stop coming, the arm
        comes to rest at the last goal. Where a motion comes too late, because the computer is busy, the arm comes to rest on
        the one before, and goes on from there; `late_ticks` counts by how much.

        Args:
            target: A function of the time since the start, s, that returns T_world_tip or (3,) m; or the name of a body, which
                stays where the model has it.
            duration: How long, s. The arm then comes to rest at the last goal.

        Returns:
            What was sent and measured. `log.failure` gives the reason if it ended early.

        Raises:
            InputError: A negative time, or a function that raises, or returns neither a pose nor three finite numbers.
            UnknownNameError: The model has no such body.
            LinkError: The robot reported a fault before.
        """
        return self._rehearsed(super().follow(target, duration=duration))

    def playing(self) -> MotionRun:
        """Opens a run of whole motions, each of which may replace what is left of the one before, for a `with`.

        Example::

            with robot.playing() as run:
                reason = run.play(motion)
                while run.moves and not reason:
                    reason = run.advance(0.1)

        Returns:
            The run: its `play` takes motions, and its `advance` lets time pass.
        """
        return MotionRun(self._controlled, self._drive, self._refusal, self._provable)

    def _gripper_at_hand(self) -> GripperAtHand:
        gripper = self.gripper
        if not self._hands:
            self._hands.append(find_gripper_model(self.arm))
        return GripperAtHand(gripper, self._hands[0])

    def _held_body(self) -> str:
        carried = self._carried
        return carried.name if carried is not None and self._host.read_hand().grasps else ""

    def _carry(self, body: HandledBody, T_tip_body: Pose) -> None:
        self._drive.mirror.carry(body.number, self.arm.tip_frames[0], T_tip_body)

    def _set_down(self, body: HandledBody, pose: Pose) -> None:
        self._drive.mirror.put_down(body.number, pose)

    @property
    def _held(self) -> dict[str, int]:
        carried = self._carried
        return {carried.name: self.arm.tip_body} if carried is not None and carried.is_of_model else {}

    def _refusal(self, pieces: Pieces) -> str:
        """Why a motion of `follow` may not be sent; empty if it may."""
        return self._drive.refusal(pieces) or ("" if self._allows_contact else self._contact(pieces))

    def _contact(self, pieces: Pieces) -> str:
        """What a motion touches; empty if it is proved free."""
        checker = self._obstacles.checker((), self._held)
        checker.require_provable()
        refused = contact_refusal(checker, pieces, 0.0)
        return "" if refused is None else refused.reason

    def _checker(self, avoid: bool, allow: Iterable[tuple[str, str]]) -> CollisionChecker | None:
        if not flag("avoid", avoid) and not self._allows_contact:
            raise InputError("avoid: a robot makes a motion that is not proved only if the Robot has allow_contact=True")
        return super()._checker(avoid, allow)

    def _move(self, goal: Target, plan: Callable[[], PlannedMove]) -> MoveResult:
        def slowed() -> PlannedMove:
            move = plan()
            position, angle = self._settle
            target = replace(
                move.target,
                tolerance=max(move.target.tolerance, position),
                angle_tolerance=max(move.target.angle_tolerance, angle),
            )
            return self._slowed(replace(move, target=target))

        result = super()._move(goal, slowed)
        if result.log is not None:
            self._rehearsed(result.log)
        return result

    def _rehearsed(self, log: Log) -> Log:
        if isinstance(self.link, DryRun):
            rehearsal = rehearsal_of(log, self._obstacles.checker())
            self.link.rehearsals.append(rehearsal)
            print(rehearsal)
        return log

    def _provable(self, trajectory: JointTrajectory) -> JointTrajectory | None:
        """A motion at the speed that is allowed; None if it may not be sent."""
        share, _ = self._speed_share(trajectory.pieces)
        slow = trajectory if share >= 1.0 else trajectory.scaled(max(share, _SLOWEST))
        return None if self._refusal(slow.pieces) else slow

    def _slowed(self, move: PlannedMove) -> PlannedMove:
        """A move at the speed that the tip and the maker's limits near the ends of the joints allow; a refusal if near zero."""
        trajectory = move.trajectory
        if not isinstance(trajectory, JointTrajectory):
            return move
        share, joint = self._speed_share(trajectory.pieces)
        if share >= 1.0:
            return move
        if share < _SLOWEST:
            return replace(move, trajectory=None, refusal=f"{_too_slow(joint)}; choose another target")
        return replace(move, trajectory=trajectory.scaled(share))

    def _speed_share(self, pieces: Pieces) -> tuple[float, str]:
        """The share of its speed at which a motion may be made, and the joint whose range allows the least."""
        samples = sample(pieces, np.linspace(0.0, pieces.knots[-1], _SAMPLES))
        low, high = self._drive.check.envelope.speed_limits(samples.q)
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = np.where(samples.v > 0.0, high / samples.v, np.where(samples.v < 0.0, low / samples.v, np.inf))
        tip_share = self._drive.check.tip_speed / max(self._drive.check.tip_speed_of(pieces), 1e-9)
        return 0.99 * min(float(shares.min()), tip_share), self.arm.joint_names[int(shares.min(axis=0).argmin())]

    def _unlock(self) -> None:
        if self._lock is not None:
            self._lock.close()


def _too_slow(joint: str) -> str:
    """Why a motion may not be sent at any speed."""
    return f"{joint} would be so near to the end of its range that the robot allows it no speed"
