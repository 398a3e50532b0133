"""Following a stream of targets at 30 Hz: lag, error, and by how much the limits are exceeded, for five ways to do it.

    python benchmarks/stream.py [--arms robot_arm_3dof panda ur5e] [--seconds 20] [--out benchmarks/results/stream.md]

The targets move on a sine of 0.3 rad and 0.3 Hz, with 5 mrad of noise; then the same 100 ms late; then as chunks of 16 rows at
30 Hz, which a random smooth policy emits every 100 ms, 100 ms late. Limits are compared with differences of the setpoints at
1 ms, so a jump counts with its speed. "linear" goes from each target to the next one within a frame, "filter" is an exponential
filter of 50 ms, "held" sends each target as it comes with steps of at most 0.2 rad, as LeRobot's `send_action` with
`max_relative_target` does, "stop to stop" is `OnlineMotion`, which plans each motion to rest with ruckig.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from markdown_table import markdown_table

import armctl

DT = 1e-3
RATE_HZ = 30.0
CHUNK_ROWS = 16
CHUNK_EVERY_S = 0.1
FILTER_S = 0.05
MAX_STEP = 0.2  # rad

Wanted = Callable[[float], np.ndarray]


class Linear:
    """From where it is to each target within one frame."""

    def __init__(self, arm: armctl.Arm, q: np.ndarray):
        self.q = self.start = self.goal = q
        self.left = 0.0

    def push(self, q: np.ndarray) -> None:
        self.start, self.goal, self.left = self.q, q, 1.0

    def step(self) -> np.ndarray:
        self.left = max(0.0, self.left - DT * RATE_HZ)
        self.q = self.goal + self.left * (self.start - self.goal)
        return self.q


class Filter:
    """An exponential filter."""

    def __init__(self, arm: armctl.Arm, q: np.ndarray):
        self.q = self.goal = q

    def push(self, q: np.ndarray) -> None:
        self.goal = q

    def step(self) -> np.ndarray:
        self.q = self.q + (DT / FILTER_S) * (self.goal - self.q)
        return self.q


class Held:
    """Each target as it comes, by a step of at most MAX_STEP."""

    def __init__(self, arm: armctl.Arm, q: np.ndarray):
        self.q = q

    def push(self, q: np.ndarray) -> None:
        self.q = self.q + np.clip(q - self.q, -MAX_STEP, MAX_STEP)

    def step(self) -> np.ndarray:
        return self.q


class StopToStop:
    """A motion to rest at each target."""

    def __init__(self, arm: armctl.Arm, q: np.ndarray):
        self.motion = armctl.OnlineMotion(arm, q)

    def push(self, q: np.ndarray) -> None:
        self.motion.go_to(q)

    def step(self) -> np.ndarray:
        return self.motion.step(DT).q


class Streamed:
    """armctl's stream."""

    def __init__(self, arm: armctl.Arm, q: np.ndarray):
        self.stream = armctl.Stream(arm, q)

    def push(self, q: np.ndarray, t: float | None = None) -> None:
        self.stream.push(self.stream.t if t is None else t, q)

    def step(self) -> np.ndarray:
        return self.stream.step(DT).q


WAYS = {"linear": Linear, "filter": Filter, "held": Held, "stop to stop": StopToStop, "Stream": Streamed}


def sine(arm: armctl.Arm) -> Wanted:
    middle = 0.5 * (arm.limits.q_min + arm.limits.q_max)
    amplitude = np.minimum(0.3, 0.4 * (arm.limits.q_max - arm.limits.q_min))
    return lambda t: middle + amplitude * np.sin(2 * np.pi * 0.3 * t + np.arange(arm.n))


def policy(arm: armctl.Arm, seed: int) -> Wanted:
    """A random smooth function of the time: a layer of sines below 0.6 Hz, as the outputs of a trained network look."""
    rng = np.random.default_rng(seed)
    frequencies = 2 * np.pi * rng.uniform(0.05, 0.6, 6)
    phases = rng.uniform(0, 2 * np.pi, (6, arm.n))
    weights = rng.standard_normal((6, arm.n)) * 0.25 / np.sqrt(6)
    middle = 0.5 * (arm.limits.q_min + arm.limits.q_max)
    room = np.minimum(1.0, 0.4 * (arm.limits.q_max - arm.limits.q_min))
    return lambda t: middle + room * (weights * np.sin(frequencies[:, None] * t + phases)).sum(axis=0)


def run(name: str, arm: armctl.Arm, wanted: Wanted, seconds: float, task: str, seed: int) -> list[str]:
    """Follows a function of the time, and measures it after the first second."""
    rng = np.random.default_rng(seed)
    way = WAYS[name](arm, wanted(0.0))
    latency = 0.0 if task == "sine" else 0.1
    every = CHUNK_EVERY_S if task == "chunks" else 1 / RATE_HZ
    rows = np.arange(CHUNK_ROWS) / RATE_HZ
    chunk: tuple[np.ndarray, np.ndarray] | None = None
    due = frame = 0.0
    q = [wanted(0.0)] * 4
    ticks = []
    for k in range(round(seconds / DT)):
        t = k * DT
        if t >= due - 1e-9:
            due += every
            if task == "chunks":  # computed from what was seen 100 ms ago: its first rows are past already
                times = t - latency + rows
                chunk = times, np.array([wanted(each) for each in times]) + 5e-3 * rng.standard_normal(arm.n)
                if isinstance(way, Streamed):
                    way.stream.push_chunk(*chunk)
            else:
                target = arm.limits.clamp(wanted(t - latency) + 5e-3 * rng.standard_normal(arm.n))
                if isinstance(way, Streamed):
                    way.push(target, way.stream.t - latency)
                else:
                    way.push(target)
        if chunk is not None and not isinstance(way, Streamed) and t >= frame - 1e-9:
            frame += 1 / RATE_HZ
            way.push(arm.limits.clamp(chunk[1][np.searchsorted(chunk[0], t)]))  # the row that is due, as policies' runners do
        started = time.process_time_ns()
        q.append(way.step())
        ticks.append(1e-3 * (time.process_time_ns() - started))
    path = np.array(q[4:])
    times = DT * np.arange(1, len(path) + 1)
    late = times > 1.0
    reference = np.array([wanted(t) for t in times])
    speed = np.gradient(reference, DT, axis=0)[late]
    error = (reference - path)[late]
    over = []
    for order, bound in enumerate((arm.limits.v_max, arm.limits.a_max, arm.limits.j_max), start=1):
        over.append((np.abs(np.diff(path, order, axis=0)) / DT**order / bound).max())
    return [
        arm.name,
        task,
        name,
        f"{1e3 * (speed * error).sum() / (speed**2).sum():.0f}",
        f"{1e3 * np.sqrt((error**2).mean()):.1f}",
        *(f"{each:.2f}" for each in over),
        f"{np.median(ticks):.0f}",
        f"{np.percentile(ticks, 99):.0f}",
    ]


def main() -> None:
    """Prints the table, and writes it if asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", nargs="+", default=["robot_arm_3dof", "panda", "ur5e"])
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    table = []
    for robot in options.arms:
        arm = armctl.load(robot)
        for task in ("sine", "sine 100 ms late", "chunks"):
            wanted = policy(arm, 11) if task == "chunks" else sine(arm)
            table += [run(name, arm, wanted, options.seconds, task, 5) for name in WAYS]
    header = ["arm", "targets", "way", "lag, ms", "RMS, mrad", "v / max", "a / max", "jerk / max", "tick, us", "99 %, us"]
    text = markdown_table(header, table)
    print(text)
    if options.out:
        options.out.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
