"""PlantLink: a simulated robot behind the Link protocol, with a lag, lost ticks and faults, for tests and rehearsals."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Mapping
from typing import BinaryIO

import numpy as np
from numpy.typing import ArrayLike

from armctl.control.computed_torque import ComputedTorque
from armctl.control.interface import Controller
from armctl.core.atomic import file_path
from armctl.core.errors import LinkError
from armctl.core.trajectory import TickReference
from armctl.core.validation import Array, flag, instance, integer, vector
from armctl.model.arm.arm import Arm, check_arm
from armctl.run.links.envelope import Envelope
from armctl.run.links.link import HandReading, Link, Reading
from armctl.run.links.link_check import base_pose
from armctl.run.links.simulated_motors import SimulatedMotors
from armctl.run.links.torque_interface import TorqueInterface, TorqueLink
from armctl.run.sim.gripper.gripper import Gripper
from armctl.run.sim.plant import Plant, read_plant
from armctl.run.sim.stepper import Stepper

_MAX_CONTINUED_TICKS = 20  # without a row, that the servo goes on as before


class PlantLink(Link, TorqueLink):
    """A simulated robot with its own servo, computed torque, which knows the positions that it was sent and nothing else.

    It takes torques, too. It then adds what its interface says, and refuses what its interface does not allow.

    Attributes:
        sent: How many rows it was sent.
        q_start: (n,) rad, where it stands when the link is opened.
        dt: s, the tick.
        name, address, envelope, rest_speed, settle, payload, passes_time, torque: As of every link.
    """

    address = ""
    rest_speed = 1e-3
    settle = (1e-4, 1e-3)

    def __init__(
        self,
        arm: Arm,
        plant: Plant | None = None,
        *,
        q_start: ArrayLike | None = None,
        lag: int = 0,
        lost: Mapping[int, int] | None = None,
        faults: Mapping[int, str] | None = None,
        envelope: Envelope | None = None,
        payload: float | None = None,
        torque: TorqueInterface | None = None,
        real_time: bool = False,
        record: str | os.PathLike[str] | None = None,
    ):
        """A simulated robot that is not connected yet.

        Args:
            arm: The robot; that of the program may differ from it.
            plant: How the robot differs from this arm.
            q_start: (n,) rad, where it stands; home by default.
            lag: Ticks until its servo gets a row, or its motors torques.
            lost: How many ticks are lost, by the number of the row before which they are.
            faults: What the robot reports, by the number of the row at which it does; it then stops until `recover`.
            envelope: What its maker would publish; by default the limits of the program's arm count.
            payload: kg that it is set to; None if it has no such setting.
            torque: What it does with torques; by default it passes them to its motors, and allows those of the arm.
            real_time: Whether its time is the clock's, in a process of its own; otherwise it runs as fast as it can.
            record: A file for the rows that it is sent, in binary float64: the time of its tick, s, and n positions or torques.

        Raises:
            InputError: An argument of another type, or a negative number.
            LimitError: A start outside the limits.
        """
        check_arm(arm)
        self.plant = read_plant(plant)
        self.q_start = arm.home if q_start is None else arm.checked("q_start", q_start)
        self.name = f"simulated {arm.name}"
        self.dt = arm.dt if self.plant.timestep is None else self.plant.timestep
        self.envelope = envelope
        self.payload = payload
        if torque is not None:
            instance("torque", torque, TorqueInterface, "armctl.links.TorqueInterface(tau_max=arm.limits.tau_max) is one")
            vector("torque.tau_max", torque.tau_max, arm.n, finite=False)
        self.torque: TorqueInterface | None = TorqueInterface(arm.limits.tau_max) if torque is None else torque
        self.passes_time = not flag("real_time", real_time)
        self.sent = 0
        self._arm = arm
        self._lag = integer("lag", lag, 0)
        for what, table, kind in (("lost", lost, int), ("faults", faults, str)):
            if table is not None:
                instance(what, table, Mapping, "give {row: what happens}")
                for tick, event in table.items():
                    instance(what, tick, int, "give {row: what happens}")
                    instance(what, event, kind, "give {row: what happens}")
        self._lost = dict(lost or {})
        self._faults = dict(faults or {})
        self._record_path = None if record is None else file_path("record", record)
        self._record: BinaryIO | None = None
        self._robot: _SimulatedRobot | None = None
        self._fault = ""
        self._due = 0.0  # s of the clock, the next tick
        self._pending = 0  # ticks that began, and are simulated when the next one does

    def open(self) -> None:
        self._robot = _SimulatedRobot(self._arm, self.plant, self.q_start, self._lag, self.torque)
        self._pending = 0
        if self._record_path is not None:
            self._record = self._record_path.open("ab", buffering=0)

    def read(self) -> Reading:
        """The robot now; between two streams of a robot in real time, its time goes on."""
        if not self.passes_time:
            self._pass(1)
        return self._reading()

    def tip(self) -> Array | None:
        return base_pose(self._arm).inverse().matrix @ self._opened().stepper.tip_pose(self._arm).matrix

    def start(self) -> None:
        if self._fault:
            raise LinkError(self._fault)
        self._due = time.monotonic()
        self._pending = 0
        self._opened().streaming = True

    def start_torques(self) -> None:
        self.start()
        self._opened().begin_torques()

    def wait(self) -> tuple[int, Reading]:
        ticks = 1 + self._lost.pop(self.sent, 0)
        if not self.passes_time:
            self._due += self.dt
            now = time.monotonic()
            if now < self._due:
                time.sleep(self._due - now)
            else:
                missed = int((now - self._due) / self.dt)
                self._due += missed * self.dt
                ticks += missed
        self._pass(self._pending + ticks - 1)
        self._pending = 1
        if self.sent in self._faults:
            self._fault = self._faults.pop(self.sent)
        return ticks, self._reading()

    def send(self, q: Array, last: bool) -> None:
        if self._fault:
            raise LinkError(self._fault)
        q = vector("q", q, self._arm.n)
        last = flag("last", last)
        self._note(q)
        self._opened().send(q)
        if last:
            self._end_stream()

    def send_torques(self, tau: Array, last: bool) -> None:
        if self._fault:
            raise LinkError(self._fault)
        tau = vector("tau", tau, self._arm.n)
        last = flag("last", last)
        robot = self._opened()
        self._note(tau)
        self._fault = robot.send_torques(tau)
        if self._fault:
            raise LinkError(self._fault)
        if last:
            self._end_stream()
            robot.hold(robot.stepper.state.q)

    def _note(self, row: Array) -> None:
        """Counts and records a row."""
        self.sent += 1
        if self._record is not None:
            self._record.write(np.append(self.dt * (self._opened().tick + 1), row).tobytes())

    def _end_stream(self) -> None:
        self._opened().streaming = False
        self._pass(1)
        self._pending = 0

    def recover(self) -> None:
        self._fault = ""
        robot = self._opened()
        robot.stepper.failure = ""
        robot.hold(robot.stepper.state.q)

    def read_hand(self) -> HandReading:
        gripper = self._gripper()
        return HandReading(gripper.width, gripper.width_max, bool(gripper.held))

    def move_hand(self, width: float) -> bool:
        return bool(self._gripper().move(width))

    def close_hand(self, force: float) -> bool:
        return bool(self._gripper().grasp(force))

    def close(self) -> None:
        if self._record is not None:
            self._record.close()
        self._robot = None

    def _reading(self) -> Reading:
        robot = self._opened()
        state = robot.stepper.measured_state
        fault = self._fault or robot.stepper.failure
        return Reading(state.t, np.array(state.q), np.array(state.v), robot.motor_torque, robot.commanded, fault)

    def _gripper(self) -> Gripper:
        robot = self._opened()
        if robot.gripper is None:
            robot.gripper = Gripper(self._arm, robot.stepper, lambda seconds: self._pass(max(1, round(seconds / self.dt))))
        return robot.gripper

    def _pass(self, ticks: int) -> None:
        self._opened().simulate(ticks, bool(self._fault))

    def _opened(self) -> _SimulatedRobot:
        if self._robot is None:
            raise LinkError(f"{self.name}: the link is not open; give it to an armctl.Robot")
        return self._robot


class _SimulatedRobot:
    """A simulated arm with the servo that follows the rows on their way to it, or motors that give torques."""

    def __init__(self, arm: Arm, plant: Plant, q_start: Array, lag: int, torque: TorqueInterface | None):
        self.stepper = Stepper(arm, plant)
        self.stepper.reset(q_start)
        self.gripper: Gripper | None = None
        self.streaming = False
        self.tick = 0
        self.commanded = np.array(q_start)  # (n,) rad, the row that was sent last
        self._dt = self.stepper.dt
        self._arm = arm
        self._lag = lag
        self._servo = ComputedTorque(arm)
        self._motors = None if torque is None else SimulatedMotors(arm, torque, self._dt)
        self._takes_torques = False
        self._rows = deque([np.array(q_start)] * 3, maxlen=3)
        self._waiting: deque[tuple[int, Array]] = deque()  # rows on their way, with the tick at which they arrive
        self._arrived = 0  # the tick at which the last row did

    @property
    def motor_torque(self) -> Array:
        """(n,) N m, of the motors in the last tick; before the first one, that which holds the arm."""
        return self.stepper.motor_torque if self.tick else self._arm.gravity(self.stepper.q)

    def begin_torques(self) -> None:
        """Gives the motors what they gave in the last tick, until torques arrive."""
        if self._motors is None:
            raise LinkError("the robot takes no torques")
        self._motors.begin(self.motor_torque, self.stepper.state)
        self._waiting.clear()
        self._arrived = self.tick
        self._takes_torques = True

    def send(self, q: Array) -> None:
        self.commanded = q
        self._waiting.append((self.tick + 1 + self._lag, q))

    def send_torques(self, tau: Array) -> str:
        """Why the robot refuses torques, and stops; empty if it does not."""
        assert self._motors is not None
        if not self._takes_torques:
            return f"no torques came for {_MAX_CONTINUED_TICKS} ticks; the robot holds the arm itself"
        refusal = self._motors.refusal(tau)
        if refusal:
            self.hold(self.stepper.state.q)
        else:
            self._waiting.append((self.tick + 1 + self._lag, tau))
        return refusal

    def hold(self, q: Array) -> None:
        """Forgets all rows, and stands at q."""
        self.commanded = np.array(q)
        self._rows.extend([self.commanded] * 3)
        self._waiting.clear()
        self._takes_torques = False

    def simulate(self, ticks: int, has_fault: bool) -> None:
        """Simulates ticks. Where a row is lost, the servo goes on as before; it works one row behind, to know a difference."""
        stepper = self.stepper
        for _ in range(ticks):
            if has_fault and (self._takes_torques or np.ptp(np.array(self._rows), axis=0).max() > 0.0):
                self.hold(stepper.state.q)
            self.tick += 1
            if self._takes_torques and self.tick - self._arrived > self._lag + _MAX_CONTINUED_TICKS:
                self.hold(stepper.state.q)  # its own brake: no torques come
            controller: Controller = self._servo
            row = self._next_row()
            if self._takes_torques and self._motors is not None:
                controller = self._motors
            recorder = stepper.recorder()
            if not stepper.failure:
                stepper.run(controller, row, recorder)

    def _next_row(self) -> TickReference:
        """What the servo follows in this tick; the torques that arrive in it go to the motors."""
        expected = self._rows[-1]
        if self.streaming and self.tick - self._arrived < _MAX_CONTINUED_TICKS:
            expected = 2.0 * expected - self._rows[-2]
        if self._takes_torques and self._motors is not None:
            expected = self.stepper.state.q
            while self._waiting and self._waiting[0][0] <= self.tick:
                self._motors.arrived = self._waiting.popleft()[1]
                self._arrived = self.tick
        self._rows.append(expected)
        while self._waiting and self._waiting[0][0] <= self.tick:
            self._rows[-1] = self._waiting.popleft()[1]
            self._arrived = self.tick
        before, now, after = self._rows
        v = (now - before) / self._dt
        a = (after - 2.0 * now + before) / self._dt**2
        return TickReference(*(column[None] for column in (now, v, a, v, a)))
