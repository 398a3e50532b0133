"""SO-100 and SO-101: goal positions of Feetech STS3215 servos on a serial bus, 50 times a second.

Packets carry numbered registers. Feetech's client has no wheels.
"""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from armctl.core.errors import InputError, LinkError, import_extra
from armctl.core.file_reading import read_bytes, reading, shown_path
from armctl.core.validation import Array, IntArray, vector
from armctl.model.arm.arm import Arm, check_arm
from armctl.run.links.envelope import Envelope, envelope_of
from armctl.run.links.link import Link, Reading, WithoutHand

# The bus.
_BAUD = 1_000_000
_READ = 0x02
_WRITE = 0x03
_SYNC_READ = 0x82
_SYNC_WRITE = 0x83
_EVERYBODY = 0xFE
_HEADER = b"\xff\xff"
_OVERHEAD = 6  # bytes of an answer beside its data: header, servo, length, error, checksum
_ANSWER_S = 0.02  # a USB adapter waits for up to 16 ms
_TRIES = 3  # of a request: the bus of a busy computer loses an answer now and then
# Feetech's memory table of the STS3215.
_MODEL = 3
_STS3215 = 777
_HOMING_OFFSET = 31
_TORQUE = 40
_GOAL = 42
_PRESENT = 56  # position and speed: two bytes each
_PRESENT_SIZE = 4
_STATUS = 65
_COUNTS = 4096  # per turn
_STATUS_BITS = ("voltage", "angle sensor", "overheated", "overcurrent", "", "overload")

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")  # as LeRobot names them, from the base
_MAX_CALIBRATION_BYTES = 1_000_000
_TRAVEL_TOLERANCE = 0.25  # of the model's range, by which the calibrated travel may differ
_FULL_TURN_COUNTS = 4000  # a recorded travel of more is that of a joint without stops
_BLOCKED_RAD = 0.25  # behind its goal for so long: a joint that is blocked
_BLOCKED_S = 0.3


class _Servo(NamedTuple):
    id: int
    offset: int
    middle: float
    travel: int


class SO101(WithoutHand, Link):
    """An SO-100 or SO-101 arm on a serial port. Needs the extra `so101`, and a calibration by LeRobot.

    It was tried with a simulated bus only, never with a robot. The servos protect nothing: they run to any goal at once. The
    torque is switched on when the link opens, at the positions where the joints are, and stays on when it closes.

    The middle of each joint's calibrated travel is taken for the middle of its range in the model: compare the model with the
    arm by eye before the first motion. The servos measure no torque, so `log.tau` is NaN, and `identify` refuses the log.

    Attributes:
        port: The serial port.
        dt: s, the tick.
        name, address, envelope, rest_speed, settle, payload, passes_time: As of every link.
    """

    no_hand = "gripper: the gripper of an SO-101 is not supported"
    dt = 0.02
    rest_speed = 0.05
    settle = (5e-3, 2e-2)
    payload: float | None = None
    passes_time = False

    def __init__(self, arm: Arm, port: str, calibration: str | os.PathLike[str]):
        """An arm that is not connected yet.

        Args:
            arm: Its model with five joints, from `armctl.load("so101")` or `armctl.load("so_arm100")`.
            port: Such as /dev/ttyACM0.
            calibration: The file that `lerobot-calibrate` wrote, such as
                ~/.cache/huggingface/lerobot/calibration/robots/so101_follower/NAME.json.

        Raises:
            InputError: The arm has no five joints, or the file is missing, is no calibration, or does not fit the arm.
        """
        check_arm(arm)
        if arm.n != len(JOINTS):
            raise InputError(f"arm: {arm.name:.60} has {arm.n} joints, an SO-101 has {len(JOINTS)} without its gripper")
        self.port = str(port)
        self.name = f"SO-101 at {port}"
        self.address = self.port
        self.envelope: Envelope | None = envelope_of(arm.limits, f"limits of the model {arm.name}: the maker publishes none")
        servos = _read_calibration(Path(calibration), arm)
        self._ids = [servo.id for servo in servos]
        self._offsets = [servo.offset for servo in servos]
        self._middle = np.array([servo.middle for servo in servos])
        self._q_middle = 0.5 * (arm.limits.q_min + arm.limits.q_max)
        self._names = arm.joint_names
        self._bus: ServoBus | None = None
        self._began = 0.0  # s of the clock, when the link was opened
        self._due = 0.0  # s of the clock, the next tick
        self._commanded = np.array(arm.home)  # (n,) rad, the last goal
        self._behind_since = np.full(len(self._ids), np.inf)  # s of the clock, since when each joint is far behind its goal
        self._checked = 0  # how often a servo was asked for its fault

    def open(self) -> None:
        """Opens the port, checks servos and calibration, and switches the torque on where the joints are."""
        bus = ServoBus(self.port)
        self._bus = bus
        self._began = time.monotonic()
        self._behind_since = np.full(len(self._ids), np.inf)
        self._checked = 0
        for servo, offset in zip(self._ids, self._offsets, strict=True):
            if bus.read(servo, _MODEL, 2) != _STS3215:
                raise LinkError(f"{self.port}: servo {servo} is no STS3215")
            found = _signed(bus.read(servo, _HOMING_OFFSET, 2), 11)
            if found != offset:
                raise LinkError(
                    f"{self.port}: servo {servo} has the homing offset {found}, the calibration file {offset}: it is that of "
                    "another arm, or this one was calibrated again"
                )
        counts = self._counts()
        self._write(counts)  # first: when its torque is switched on, a servo runs to its goal
        for servo in self._ids:
            bus.write(servo, _TORQUE, 1)
        self._commanded = self._angles(counts)

    def read(self) -> Reading:
        rows = self._present()
        speeds = [_signed(int(speed), 15) for speed in rows[:, 1]]
        v = np.array(speeds) * (2.0 * np.pi / _COUNTS)
        return Reading(
            t=time.monotonic() - self._began,
            q=self._angles(rows[:, 0]),
            v=v,
            tau=np.full(len(v), np.nan),
            q_ref=self._commanded,
            fault=self._fault(),
        )

    def tip(self) -> Array | None:
        return None

    def start(self) -> None:
        self._open_bus()
        self._due = time.monotonic()
        self._behind_since[:] = np.inf

    def wait(self) -> tuple[int, Reading]:
        self._open_bus()
        ticks = 1
        self._due += self.dt
        late = time.monotonic() - self._due
        if late < 0.0:
            time.sleep(-late)
        else:
            ticks += int(late / self.dt)
            self._due += (ticks - 1) * self.dt
        reading = self.read()
        self._hold_blocked(reading)
        return ticks, reading

    def send(self, q: Array, last: bool) -> None:
        q = vector("q", q, len(JOINTS))
        self._write(np.rint((q - self._q_middle) * (_COUNTS / (2.0 * np.pi)) + self._middle).astype(np.int64))
        self._commanded = q

    def recover(self) -> None:
        """Takes the present positions as goals. A servo that has switched itself off keeps its fault until the power is cut."""
        counts = self._counts()
        self._write(counts)
        self._commanded = self._angles(counts)
        fault = "".join(self._fault() for _ in self._ids)
        if fault:
            raise LinkError(f"recover: {fault}; switch the power of the servos off and on")

    def close(self) -> None:
        """Closes the port; the servos hold."""
        if self._bus is not None:
            self._bus.close()
            self._bus = None

    def _angles(self, counts: IntArray) -> Array:
        return self._q_middle + (counts - self._middle) * (2.0 * np.pi / _COUNTS)

    def _open_bus(self) -> ServoBus:
        if self._bus is None:
            raise LinkError(f"{self.port}: the link is not open; give it to an armctl.Robot")
        return self._bus

    def _present(self) -> IntArray:
        """Position and speed of each servo as its registers hold them, shape (n, 2)."""
        data = self._open_bus().read_all(self._ids, _PRESENT, _PRESENT_SIZE)
        return np.frombuffer(b"".join(data), "<u2").reshape(len(self._ids), -1).astype(np.int64)

    def _counts(self) -> IntArray:
        return self._present()[:, 0]

    def _write(self, counts: IntArray) -> None:
        outside = (counts < 0) | (counts >= _COUNTS)
        if outside.any():
            joint = self._names[int(outside.argmax())]
            raise LinkError(f"{joint}: its servo would have to turn over its zero; calibrate it with its middle at half a turn")
        self._open_bus().write_all(_GOAL, dict(zip(self._ids, counts.tolist(), strict=True)))

    def _hold_blocked(self, reading: Reading) -> None:
        """Holds the arm where it is if a joint stays far behind its goal: a servo that presses on burns out."""
        now = time.monotonic()
        behind = np.abs(reading.q - self._commanded) > _BLOCKED_RAD
        self._behind_since = np.where(behind, np.minimum(self._behind_since, now), np.inf)
        blocked = now - self._behind_since > _BLOCKED_S
        if blocked.any():
            counts = self._counts()
            self._write(counts)
            self._commanded = self._angles(counts)
            raise LinkError(f"{self._names[int(blocked.argmax())]} is blocked; the arm holds where it is")

    def _fault(self) -> str:
        """What one servo reports; the next one at the next call, because a common reading does not tell."""
        servo = self._ids[self._checked % len(self._ids)]
        self._checked += 1
        status = self._open_bus().read(servo, _STATUS, 1)
        named = [name for bit, name in enumerate(_STATUS_BITS) if name and status >> bit & 1]
        return f"servo {servo}: {', '.join(named)}" if named else ""


def _read_calibration(path: Path, arm: Arm) -> list[_Servo]:
    """The servos of the five joints, by a calibration file of LeRobot, compared with the model."""
    if not path.exists():
        raise InputError(
            f"calibration: {shown_path(path)} does not exist, so the zero of the joints is unknown; run lerobot-calibrate"
        )
    with reading(path, "no JSON file; lerobot-calibrate writes one"):
        rows = json.loads(read_bytes(path, _MAX_CALIBRATION_BYTES))
    servos = []
    ranges = arm.limits.q_max - arm.limits.q_min
    for name, model_range in zip(JOINTS, ranges.tolist(), strict=True):
        try:
            row = rows[name]
            low = int(row["range_min"])
            high = int(row["range_max"])
            servo = _Servo(int(row["id"]), int(row["homing_offset"]), 0.5 * (low + high), high - low)
        except (KeyError, TypeError, ValueError, OverflowError):
            raise InputError(
                f"calibration: {shown_path(path)} has no row {name!r} with id, homing_offset, range_min and range_max"
            ) from None
        if not 0 <= servo.id < _EVERYBODY:
            raise InputError(f"calibration: {name} has the id {servo.id!s:.20}; ids of servos are from 0 to {_EVERYBODY - 1}")
        travel = servo.travel * 2.0 * np.pi / _COUNTS
        if servo.travel < _FULL_TURN_COUNTS and abs(travel - model_range) > _TRAVEL_TOLERANCE * model_range:
            raise InputError(
                f"calibration: {name} travels {travel:.2f} rad, the joint of the model {arm.name:.60} {model_range:.2f} rad; "
                "calibrate again, and move each joint through its whole range"
            )
        servos.append(servo)
    return servos


def _signed(value: int, sign_bit: int) -> int:
    return -(value & ~(1 << sign_bit)) if value >> sign_bit & 1 else value


class ServoBus:
    """An open serial port with servos on it. LinkError if it cannot be opened or is gone, or a servo does not answer."""

    def __init__(self, port: str):
        serial = import_extra("serial", "links to an SO-101 need pyserial", "so101")
        self.port = port
        try:
            self._line = serial.Serial(port, _BAUD, timeout=_ANSWER_S, write_timeout=_ANSWER_S)
        except OSError as error:
            raise LinkError(f"{port}: cannot be opened: {error.strerror or error}") from None

    def read(self, servo: int, address: int, size: int) -> int:
        answers = self._asked(servo, _READ, bytes([address, size]), [servo], size)
        return int.from_bytes(answers[0], "little")

    def read_all(self, servos: list[int], address: int, size: int) -> list[bytes]:
        """The same `size` bytes of several servos, by one request."""
        return self._asked(_EVERYBODY, _SYNC_READ, bytes([address, size, *servos]), servos, size)

    def write(self, servo: int, address: int, value: int) -> None:
        """Writes a register of one byte."""
        self._asked(servo, _WRITE, bytes([address, value]), [servo], 0)

    def write_all(self, address: int, values: dict[int, int]) -> None:
        """Writes a register of two bytes of several servos in one packet, which nobody answers."""
        rows = [bytes([servo]) + value.to_bytes(2, "little") for servo, value in values.items()]
        try:
            self._send(_EVERYBODY, _SYNC_WRITE, bytes([address, 2]) + b"".join(rows))
        except OSError as error:
            raise LinkError(f"{self.port}: {error.strerror or error}") from None

    def close(self) -> None:
        self._line.close()

    def _asked(self, to: int, instruction: int, parameters: bytes, servos: list[int], size: int) -> list[bytes]:
        """The data of the answers of `servos`. Answers carry no number: what came late is thrown away before the next try."""
        silent = servos[0]
        for attempt in range(_TRIES):
            try:
                if attempt:
                    time.sleep(0.5 * _ANSWER_S)
                self._line.reset_input_buffer()
                self._send(to, instruction, parameters)
                answers = [self._answer(servo, size) for servo in servos]
            except OSError as error:
                raise LinkError(f"{self.port}: {error.strerror or error}") from None
            if None not in answers:
                return [data for data in answers if data is not None]
            silent = servos[answers.index(None)]
        raise LinkError(f"{self.port}: servo {silent} does not answer")

    def _send(self, to: int, instruction: int, parameters: bytes) -> None:
        body = bytes([to, len(parameters) + 2, instruction]) + parameters
        self._line.write(_HEADER + body + bytes([_checksum(body)]))

    def _answer(self, servo: int, size: int) -> bytes | None:
        """The data of one answer; None if it did not come whole."""
        packet = self._line.read(size + _OVERHEAD)
        is_whole = len(packet) == size + _OVERHEAD and packet.startswith(_HEADER + bytes([servo, size + 2]))
        return packet[5:-1] if is_whole and packet[-1] == _checksum(packet[2:-1]) else None


def _checksum(body: bytes) -> int:
    return ~sum(body) & 0xFF
