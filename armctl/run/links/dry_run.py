"""DryRun: reads a robot, plans and checks every motion for it, and sends nothing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from armctl.core.errors import LinkError
from armctl.core.log import Log
from armctl.core.result import left_out_text
from armctl.core.validation import Array
from armctl.run.links.link import HandReading, Link, Reading, check_link
from armctl.run.links.torque_interface import TorqueInterface

if TYPE_CHECKING:
    from armctl.model.collision.checker import CollisionChecker

_CLEARANCE_SAMPLES = 200
_HAND_STAYS = "gripper: a dry run does not move the hand"


@dataclass(frozen=True)
class Rehearsal:
    """What one command would have sent.

    Attributes:
        samples: How many positions of the joints, one each tick.
        duration: s.
        speed: rad/s, the greatest of a joint.
        acceleration: rad/s^2, likewise.
        jerk: rad/s^3, likewise.
        tip_speed: m/s, the greatest.
        clearance: m, the smallest distance at 200 positions on the way; infinite if nothing can touch, NaN if links have no
            collision shape.
        left_out: Pairs of names of bodies that touch by design, and that the clearance leaves out though a simulation keeps
            their contact.
        refusal: Why nothing would be sent; empty if something would.
    """

    samples: int
    duration: float
    speed: float
    acceleration: float
    jerk: float
    tip_speed: float
    clearance: float
    refusal: str = ""
    left_out: tuple[tuple[str, str], ...] = ()

    def __str__(self) -> str:
        if self.refusal:
            return self.refusal
        if np.isnan(self.clearance):
            near = "contacts are not checkable"
        else:
            near = "nothing can touch" if np.isinf(self.clearance) else f"clearance {1e3 * self.clearance:.1f} mm"
        return (
            f"{self.samples} samples, {self.duration:.2f} s, joints {self.speed:.3g} rad/s, {self.acceleration:.3g} rad/s^2, "
            f"{self.jerk:.3g} rad/s^3, tip {self.tip_speed:.3g} m/s, {near}{left_out_text(self.left_out)}"
        )


def rehearsal_of(log: Log, checker: CollisionChecker | None) -> Rehearsal:
    v = np.diff(log.q_ref, axis=0) / log.dt
    a = np.diff(v, axis=0) / log.dt
    j = np.diff(a, axis=0) / log.dt
    tips = np.linalg.norm(np.diff(log.tip_ref, axis=0), axis=1) / log.dt
    clearance = np.inf
    if checker is not None and checker.not_checkable:
        clearance = np.nan
    elif checker is not None and len(log):
        some = np.unique(np.linspace(0, len(log) - 1, _CLEARANCE_SAMPLES).astype(int))
        clearance = min((d for pair, d in map(checker.nearest, log.q_ref[some]) if pair >= 0), default=np.inf)
    return Rehearsal(
        samples=len(log),
        duration=len(log) * log.dt,
        speed=_peak(v),
        acceleration=_peak(a),
        jerk=_peak(j),
        tip_speed=_peak(tips),
        clearance=float(clearance),
        refusal=log.failure,
        left_out=() if checker is None else checker.left_out,
    )


def _peak(values: Array) -> float:
    return float(np.abs(values).max(initial=0.0))


class DryRun:
    """A link that connects and reads, but sends nothing: each motion is thought to begin where the last one ended.

    Each command of the Robot prints a line of figures, which `rehearsals` keeps.

    Attributes:
        link: The link of the robot.
        rehearsals: What each command would have sent, in the order of time.
        dt: s, the tick.
        name, address, envelope, rest_speed, settle, payload, passes_time, torque: As of every link.
    """

    passes_time = True
    torque: TorqueInterface | None = None  # it computes none

    def __init__(self, link: Link):
        """A rehearsal of what a program would send over a link that is not open yet.

        Raises:
            InputError: It is no link.
        """
        check_link(link)
        self.link = link
        self.rehearsals: list[Rehearsal] = []
        self.name = f"dry run of {link.name}"
        self.address = link.address
        self.dt = link.dt
        self.envelope = link.envelope
        self.rest_speed = link.rest_speed
        self.settle = link.settle
        self.payload = link.payload
        self._reading: Reading | None = None

    def open(self) -> None:
        """Connects, and reads where the robot is."""
        self.link.open()
        reading = self.link.read()
        self._reading = reading._replace(v=np.zeros_like(reading.q))

    def read(self) -> Reading:
        """The robot as it was read, where the last motion would have ended."""
        assert self._reading is not None
        self._reading = self._reading._replace(t=self._reading.t + self.dt)
        return self._reading

    def tip(self) -> Array | None:
        """That of the robot."""
        return self.link.tip()

    def start(self) -> None:
        """A motion begins at the robot's last command."""

    def wait(self) -> tuple[int, Reading]:
        """The next tick, at once."""
        return 1, self.read()

    def send(self, q: Array, last: bool) -> None:
        """Nothing is sent: the robot is thought to be there.

        Args:
            q: (n,) rad.
            last: Whether the stream ends.
        """
        assert self._reading is not None
        self._reading = self._reading._replace(q=q, q_ref=q)

    def recover(self) -> None:
        """A dry run clears no fault.

        Raises:
            LinkError: Always.
        """
        raise LinkError("recover: a dry run clears no fault; make a Robot with the link itself")

    def read_hand(self) -> HandReading:
        """That of the robot."""
        return self.link.read_hand()

    def move_hand(self, width: float) -> bool:
        """A dry run does not move the hand.

        Args:
            width: m, between the fingers.

        Raises:
            LinkError: Always.
        """
        raise LinkError(_HAND_STAYS)

    def close_hand(self, force: float) -> bool:
        """A dry run does not close the hand.

        Args:
            force: N, with which the fingers hold.

        Raises:
            LinkError: Always.
        """
        raise LinkError(_HAND_STAYS)

    def close(self) -> None:
        """Disconnects."""
        self.link.close()
