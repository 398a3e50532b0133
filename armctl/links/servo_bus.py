"""The bus of Feetech's servos: packets of numbered registers on a serial line. Feetech's client has no wheels."""

from __future__ import annotations

import time
from importlib import import_module
from typing import Any

from armctl.core.errors import LinkError, NotInstalledError

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


class ServoBus:
    """An open serial port with servos on it. LinkError if it cannot be opened or is gone, or a servo does not answer."""

    def __init__(self, port: str):
        try:
            serial: Any = import_module("serial")
        except ImportError:
            raise NotInstalledError.of_extra("links to an SO-101 need pyserial", "so101") from None
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
