"""Link: what the file of one maker implements, and the readings that it gives."""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

from armctl.core.errors import LinkError
from armctl.core.validation import Array, instance
from armctl.plan.motion.trajectory.piecewise import JointSamples
from armctl.run.links.envelope import Envelope
from armctl.run.links.torque_interface import TorqueInterface


class Reading(NamedTuple):
    """One reading of a robot, in SI units and the order of the arm's joints.

    Attributes:
        t: s, the robot's clock.
        q: (n,) rad, measured.
        v: (n,) rad/s, measured; NaN where the robot does not tell.
        tau: (n,) N m, by torque sensors; NaN where the robot has none.
        q_ref: (n,) rad, the robot's last command, where a motion starts.
        fault: The maker's words for a reflex or a stop; empty while all is well.
        tau_ref: (n,) N m, the last torques that the robot was sent, as it reports; None where it does not tell.
    """

    t: float
    q: Array
    v: Array
    tau: Array
    q_ref: Array
    fault: str = ""
    tau_ref: Array | None = None


class HandReading(NamedTuple):
    """What a hand measures.

    Attributes:
        width: m, between the fingers.
        width_max: m, when they are open.
        grasps: Whether the hand reports a grasp.
    """

    width: float
    width_max: float
    grasps: bool


class HandLink(Protocol):
    """The way to the hand of a robot. Every method raises LinkError if there is none."""

    def read_hand(self) -> HandReading:
        """The hand now."""
        ...

    def move_hand(self, width: float) -> bool:
        """Moves the fingers to a distance, m. Returns whether the hand calls it a success."""
        ...

    def close_hand(self, force: float) -> bool:
        """Closes the fingers, which then hold with a force, N. Returns whether the hand calls it a success."""
        ...


class WithoutHand(HandLink):
    """The part of a link to a robot whose hand no program moves; `no_hand` says why, in one sentence."""

    no_hand: str

    def read_hand(self) -> HandReading:
        """Refused; LinkError says why."""
        raise LinkError(self.no_hand)

    def move_hand(self, width: float) -> bool:
        """Refused, as it is to read it."""
        raise LinkError(self.no_hand)

    def close_hand(self, force: float) -> bool:
        """Refused, as it is to read it."""
        raise LinkError(self.no_hand)


@runtime_checkable
class Link(HandLink, Protocol):
    """The way to one robot. It is made without a connection and pickled; `open` connects, in the process that streams.

    Every method raises LinkError if the connection fails or the robot reports a fault.

    Attributes:
        name: The robot in words, for logs.
        address: What identifies the robot for this computer, such as a host or a port; empty for a simulation.
        dt: s, the tick: one row of positions each.
        envelope: What the maker publishes; None for the limits of the arm's model.
        rest_speed: rad/s over 50 ms, below which a joint counts as at rest.
        settle: m, and rad, how near to a target the robot's own servo ends.
        payload: kg that the robot is set to; None if it has no such setting.
        passes_time: Whether `wait` makes the time pass, as in a simulation that runs as fast as it can: it needs no process.
        torque: What the robot does with torques, of a link that is a `TorqueLink`, too; None if it takes none.
    """

    name: str
    address: str
    dt: float
    envelope: Envelope | None
    rest_speed: float
    settle: tuple[float, float]
    payload: float | None
    passes_time: bool
    torque: TorqueInterface | None = None

    def open(self) -> None:
        """Connects; nothing moves."""
        ...

    def read(self) -> Reading:
        """The robot now, between two streams."""
        ...

    def tip(self) -> Array | None:
        """(4, 4) T_base_tip by the maker's own kinematics; None if the robot does not tell."""
        ...

    def start(self) -> None:
        """Begins a stream of positions."""
        ...

    def wait(self) -> tuple[int, Reading]:
        """Waits for the next tick of a stream: how many ticks passed, more than 1 if some were lost, and a reading."""
        ...

    def send(self, q: Array, last: bool) -> None:
        """Sends the row of this tick, (n,) rad. The last one ends the stream; it repeats the row before."""
        ...

    def recover(self) -> None:
        """Clears a fault, because the user asked for it."""
        ...

    def close(self) -> None:
        """Disconnects."""
        ...


@runtime_checkable
class MotionLink(Link, Protocol):
    """A link to a robot that takes whole motions, such as a trajectory controller, and plays them by itself.

    `send` is called at every tick, too: it says where the robot should be then.

    Attributes:
        lead: s, within which a message reaches the robot: a stop begins so much later.
    """

    lead: float

    def send_motion(self, first: int, changed: int, rows: JointSamples) -> bool:
        """Sends what the robot does from now on until it rests, in place of what was sent before.

        Args:
            first: The tick of the first row, which is that of the last `send`, or earlier than now.
            changed: The tick from which on the rows differ from those that were sent before.
            rows: Positions, velocities and accelerations, each (T, n), one row for each tick; the last one is at rest.

        Returns:
            Whether they were sent: not if the robot would get them after the tick at which they change.
        """
        ...


def check_link(link: Link) -> None:
    """Raises InputError if an argument `link` is none."""
    instance("link", link, Link, "armctl.links.Franka('172.16.0.2') is one")
