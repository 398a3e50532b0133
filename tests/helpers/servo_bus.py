"""Simulated Feetech STS3215 servos on a pseudo-terminal, in a process: registers, packets, motion. No test by itself.

`python servo_bus.py POSITION ...` prints the name of the port, then obeys lines: "block JOINT COUNTS", "garble COUNT" (of
answers), "mute", "show".
"""

import json
import math
import os
import pty
import select
import sys
import time
import tty

READ, WRITE, SYNC_READ, SYNC_WRITE = 2, 3, 0x82, 0x83
MODEL, OFFSET, TORQUE, GOAL, PRESENT, STATUS = 3, 31, 40, 42, 56, 65
LAG_S = 0.05
MAX_STEP_S = 0.02
SPEED = 3400.0  # counts/s
OLD_GOAL = 2048  # left in the register by an earlier program


class Servo:
    """One servo: first-order motion to its goal while its torque is on."""

    def __init__(self, position: float):
        self.registers = bytearray(256)
        self.position = position
        self.fastest = 0.0
        self.barrier = 1e9
        self.put(MODEL, 777)
        self.put(OFFSET, 100)
        self.put(GOAL, OLD_GOAL)

    def put(self, address: int, value: int) -> None:
        self.registers[address : address + 2] = value.to_bytes(2, "little")

    def shown(self) -> list[float]:
        goal = int.from_bytes(self.registers[GOAL : GOAL + 2], "little")
        return [self.position, self.fastest, self.registers[TORQUE], goal]

    def advance(self, dt: float) -> None:
        v = 0.0
        if self.registers[TORQUE]:
            goal = int.from_bytes(self.registers[GOAL : GOAL + 2], "little")
            v = max(-SPEED, min(SPEED, (goal - self.position) / LAG_S))
            self.fastest = max(self.fastest, abs(v))
            self.position = min(self.position + v * dt, self.barrier)
        self.put(PRESENT, round(self.position))
        self.put(PRESENT + 2, abs(round(v)) | (0x8000 if v < 0 else 0))


garbled = 0  # answers yet to be sent with a wrong byte


def answer(master: int, number: int, servo: Servo, data: bytes) -> None:
    global garbled
    body = bytes([number, len(data) + 2, servo.registers[STATUS]]) + data
    packet = bytearray(b"\xff\xff" + body + bytes([~sum(body) & 0xFF]))
    if garbled:
        garbled -= 1
        packet[-2] ^= 0x40
    os.write(master, packet)


def handle(master: int, servos: dict[int, Servo], number: int, instruction: int, p: bytes) -> None:
    if instruction == SYNC_WRITE:
        address = p[0]
        size = p[1]
        for i in range(2, len(p), size + 1):
            servos[p[i]].registers[address : address + size] = p[i + 1 : i + 1 + size]
    elif instruction == SYNC_READ:
        for each in p[2:]:
            answer(master, each, servos[each], bytes(servos[each].registers[p[0] : p[0] + p[1]]))
    elif number in servos:
        servo = servos[number]
        if instruction == WRITE:
            servo.registers[p[0] : p[0] + len(p) - 1] = p[1:]
        answer(master, number, servo, bytes(servo.registers[p[0] : p[0] + p[1]]) if instruction == READ else b"")


def main() -> None:
    global garbled
    servos = {i + 1: Servo(float(word)) for i, word in enumerate(sys.argv[1:])}
    master, slave = pty.openpty()
    tty.setraw(master)
    tty.setraw(slave)
    print(os.ttyname(slave), flush=True)
    received = bytearray()
    now = time.monotonic()
    muted = False
    while True:
        ready, _, _ = select.select([master, sys.stdin], [], [], 0.002)
        before = now
        now = time.monotonic()
        steps = math.ceil((now - before) / MAX_STEP_S)  # many, where the computer is busy
        for servo in servos.values():
            for _ in range(steps):
                servo.advance((now - before) / steps)
        if sys.stdin in ready:
            words = sys.stdin.readline().split()
            if not words:
                return
            if words[0] == "block":
                servo = servos[int(words[1])]
                servo.barrier = servo.position + float(words[2])
            elif words[0] == "garble":
                garbled = int(words[1])
            elif words[0] == "mute":
                muted = True
            else:
                shown = [
                    (s.position, s.fastest, s.registers[TORQUE], s.registers[GOAL] + 256 * s.registers[GOAL + 1])
                    for s in servos.values()
                ]
                print(json.dumps(shown), flush=True)
        if master in ready:
            received += os.read(master, 512)
            while (
                (i := received.find(b"\xff\xff")) >= 0 and len(received) >= i + 4 and len(received) >= i + 4 + received[i + 3]
            ):
                packet = bytes(received[i + 2 : i + 4 + received[i + 3]])
                del received[: i + 4 + packet[1]]
                if (~sum(packet[:-1]) & 0xFF) == packet[-1] and not muted:
                    handle(master, servos, packet[0], packet[2], packet[3:-1])


if __name__ == "__main__":
    main()
