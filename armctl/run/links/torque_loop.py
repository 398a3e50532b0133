"""TorqueLoop: the controller of a robot, tick by tick, in the process of its link."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armctl.control.external_force import ExternalForce
from armctl.control.interface import Controller, State, traits
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.run.links.envelope import Envelope
from armctl.run.links.link import Reading
from armctl.run.links.torque_interface import TorqueInterface
from armctl.run.links.torque_limiter import TorqueLimiter

_START_FADE_S = 0.2  # in which the torque that held the arm before gives way to that of the law
_DAMPING_TIME_S = 0.03  # with which the speed decays after a failure
_DELAYS_PER_DAMPING_TIME = 4.0  # at least: a damper is stable up to pi / 2 of them
_LONGEST_DAMPING_S = 0.5  # until the maker's brakes end a motion that the damper does not
_REST_TICKS = 10  # below the speed of rest, until the brakes are set
_LONGEST_GAP_TICKS = 15  # that are lost at once, after which a law does not go on


@dataclass(frozen=True, eq=False)
class LinkLaw:
    """A controller for a robot, with what its process must know of it.

    Attributes:
        arm: The model.
        controller: The law.
        interface: What the robot does with torques.
        envelope: The maker's limits of positions and speeds.
        error_max: rad, by which a joint may be away from its reference; infinite for a law that yields.
        rest_speed: rad/s, as of the link.
    """

    arm: Arm
    controller: Controller
    interface: TorqueInterface
    envelope: Envelope
    error_max: float
    rest_speed: float


class _SeenTick(NamedTuple):
    """What a law sees in a tick."""

    q: Array  # (n,) rad
    v: Array  # (n,) rad/s
    setpoint: Setpoint

    def towards(self, other: _SeenTick, share: float) -> _SeenTick:
        """The tick between this one and another, in place of one that was lost."""
        reference = (
            None if a is None or b is None else a + share * (b - a) for a, b in zip(self.setpoint, other.setpoint, strict=True)
        )
        return _SeenTick(
            q=self.q + share * (other.q - self.q),
            v=self.v + share * (other.v - self.v),
            setpoint=Setpoint(*reference),  # type: ignore[arg-type]
        )


class TorqueLoop:
    """Computes the torques of a stream. A law that fails is replaced by damping and gravity until the arm rests."""

    def __init__(self, law: LinkLaw, dt: float):
        """The loop of a law with a tick of dt s; no call of it takes longer than the others."""
        self.fault = ""  # why the law was ended; empty while it goes on
        self.is_over = False  # whether the arm rests after a fault, or its brakes must end the motion
        self._arm = law.arm
        self._law = law
        self._torque = law.controller.torque
        self._name = traits(law.controller).name
        self._applied = traits(law.controller).applied
        self._needs_wrench = traits(law.controller).needs_wrench
        self._force = ExternalForce(law.arm)
        self._dt = dt
        self._bounds = TorqueLimiter(law.arm, law.interface, dt)
        self._fade_ticks = max(1, round(_START_FADE_S / dt))
        self._is_first = True  # whether the stream has not begun
        self._last: _SeenTick | None = None  # that the law has seen
        self._wanted: ArrayLike = ()  # (n,) N m, that the law gave in its last call
        self._ticks = 0  # of the law in the stream
        self._calls = 0  # of the law, whose clock knows no lost ticks, nor streams
        self._offset = np.zeros(law.arm.n)  # N m, the torque before the stream minus that of the law
        self._damped = 0  # ticks since the fault
        self._resting = 0  # ticks of these at rest
        self._damping_time = _DAMPING_TIME_S
        self._rehearse()

    @property
    def total(self) -> Array:
        """(n,) N m, the torque of the last tick with what the maker adds to it."""
        return self._bounds.total

    def expect_delay(self, delay: float) -> None:
        """Takes the delay of the link, s, which the damping after a failure must bear."""
        self._damping_time = max(_DAMPING_TIME_S, _DELAYS_PER_DAMPING_TIME * delay)

    def start(self) -> None:
        """Begins a stream: the arm is held by the torques of its first reading, and then by those of the law."""
        self.fault = ""
        self.is_over = False
        self._ticks = 0
        self._damped = 0
        self._resting = 0
        self._calls += 2  # a gap in the time of the law, which begins anew
        self._force.reset()
        self._is_first = True

    def next(self, reading: Reading, setpoint: Setpoint, ticks: int) -> Array:
        """The torques to send, (n,) N m, `ticks` ticks after the last ones."""
        if self._is_first:
            self._bounds.start(reading)
            self._is_first = False
        if not self.fault:
            total = self._of_law(reading, setpoint, ticks)
            if not self.fault:
                sent = self._bounds.to_send(total, reading)
                self._tell_applied()
                return sent
        return self._of_damper(reading)

    def _of_law(self, reading: Reading, setpoint: Setpoint, ticks: int) -> Array:
        self.fault = self._why_not(reading, setpoint, ticks)
        if self.fault:
            return np.zeros(0)
        wrench = self._wrench(reading, ticks) if self._needs_wrench else None
        now = _SeenTick(reading.q, reading.v, setpoint)
        try:
            if self._last is not None and self._ticks:
                # A law that sees two ticks as one takes the arm for twice as fast.
                for lost in range(1, ticks):
                    self._called(self._last.towards(now, lost / ticks), wrench)
                    self._tell_applied()
            total = np.asarray(self._called(now, wrench), dtype=np.float64)
        except Exception as error:  # a law may be a user's
            self.fault = f"the controller {self._name:.80} failed: {type(error).__name__}: {error}"
            return np.zeros(0)
        if total.shape != reading.q.shape or not _is_finite(total):
            self.fault = f"the controller {self._name:.80} gave no finite torque for each joint"
            return total
        self._last = now
        if self._ticks == 0:
            self._offset = self._bounds.total - total
        if self._ticks < self._fade_ticks:
            total = total + 0.5 * (1.0 + np.cos(np.pi * self._ticks / self._fade_ticks)) * self._offset
        self._ticks += 1
        return total

    def _called(self, tick: _SeenTick, wrench: Array | None) -> ArrayLike:
        """What the law gives for a tick."""
        state = State(tick.q, tick.v, self._calls * self._dt, self._dt, True, wrench)
        self._calls += 1
        self._wanted = self._torque(state, tick.setpoint)
        return self._wanted

    def _tell_applied(self) -> None:
        """Tells the law what torques the motors get, if they are not its own."""
        if self._applied is None or np.array_equal(self._bounds.total, self._wanted):
            return
        try:
            self._applied(self._bounds.total)
        except Exception as error:  # a law may be a user's
            self.fault = f"the controller {self._name:.80} failed: {type(error).__name__}: {error}"

    def _wrench(self, reading: Reading, ticks: int) -> Array:
        """(6,) N and N m, that of the environment on the tip by the torque sensors."""
        self._force.update(reading.q, reading.v, reading.tau, ticks * self._dt)
        return self._force.wrench(reading.q)

    def _why_not(self, reading: Reading, setpoint: Setpoint, ticks: int) -> str:
        """Why the law must end; empty if it may go on."""
        q = reading.q
        v = reading.v
        if not (_is_finite(q) and _is_finite(v)):
            return "the robot measured no finite positions and speeds"
        if ticks - 1 > _LONGEST_GAP_TICKS and self._ticks:
            return f"{ticks - 1} ticks were lost at once, too many for a controller of torques"
        if self._needs_wrench and not _is_finite(reading.tau):
            return f"{self._name:.80} needs the force on the tip, but the robot measured no finite torques"
        error = np.abs(q - setpoint.q)
        joint = int(error.argmax())
        if error[joint] > self._law.error_max:
            return (
                f"{self._arm.joint_names[joint]} is {error[joint]:.3g} rad from its reference under {self._name:.80}, at most "
                f"{self._law.error_max:.3g} rad; error_max= of the Robot is this bound"
            )
        return self._bounds.why_outside(q, v, self._law.envelope)

    def _of_damper(self, reading: Reading) -> Array:
        """The torques after a failure: they take the speed away, until the arm rests or a time is over."""
        self._damped += 1
        q = reading.q
        v = reading.v
        if not (_is_finite(q) and _is_finite(v)):
            self.is_over = True
            return self._bounds.sent
        self._resting = self._resting + 1 if np.abs(v).max() < self._law.rest_speed else 0
        self.is_over = self._resting >= _REST_TICKS or self._damped * self._dt >= _LONGEST_DAMPING_S
        braking = self._arm.mass_matrix(q) @ v / self._damping_time
        return self._bounds.to_send(self._arm.gravity(q) - braking, reading)

    def _rehearse(self) -> None:
        """Calls once what is called in a tick, so that nothing is prepared in the first one."""
        n = self._arm.n
        q = self._arm.home
        zero = np.zeros(n)
        reading = Reading(0.0, q, zero, zero, q)
        self._force.update(q, zero, zero, self._dt)
        steps: list[Callable[[], object]] = [
            lambda: self.next(reading, Setpoint(q, zero, zero, zero, zero), 1),
            lambda: self._of_damper(reading),
        ]
        for step in steps:
            step()
        self.start()


def _is_finite(values: Array) -> bool:
    """Whether all values are finite, without the checks that take most of NumPy's time for a few joints."""
    return all(map(math.isfinite, values))
