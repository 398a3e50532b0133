"""Following a stream of targets at 30 Hz: lag, error, and by how much the limits are exceeded, for five ways to do it.

    python benchmarks/stream.py [--arms robot_arm_3dof panda ur5e] [--seconds 20] [--out benchmarks/results/stream.md]

The targets move on a sine of 0.3 rad and 0.3 Hz, with 5 mrad of noise; then the same 100 ms late; then as chunks of 16 rows at
at 30 Hz, which a policy emits every 100 ms, 100 ms late: the worst of three random smooth networks, which nothing was tuned on.
The noise of each row is its own. Limits are compared with differences of the setpoints at 1 ms, so a jump counts with its
speed. "linear" goes from each target to the next one within a frame, and interpolates the rows of a chunk at their own times;
"filter" is an exponential filter of 50 ms, "held" sends each target as it comes with steps of at most 0.2 rad, as LeRobot's
`send_action` with `max_relative_target` does, "stop to stop" is `OnlineMotion`, which plans each motion to rest with ruckig.

The second table: chunks every 100 ms lead into a wall; MuJoCo judges the setpoints.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
from markdown_table import markdown_table

import armctl

DT = 1e-3
RATE_HZ = 30.0
CHUNK_ROWS = 16
CHUNK_EVERY_S = 0.1
FILTER_S = 0.05
MAX_STEP = 0.2  # rad
HELD_OUT = (101, 102, 103)  # seeds of networks

Wanted = Callable[[float], np.ndarray]


class Linear:
    """From where it is to each target within one frame; along the rows of a chunk by their times."""

    def __init__(self, arm: armctl.Arm, q: np.ndarray):
        self.q = self.start = self.goal = q
        self.left = 0.0
        self.t = 0.0
        self.chunk: tuple[np.ndarray, np.ndarray] | None = None

    def push(self, q: np.ndarray) -> None:
        self.start, self.goal, self.left = self.q, q, 1.0

    def push_chunk(self, t: np.ndarray, rows: np.ndarray) -> None:
        self.chunk = (t, rows)

    def step(self) -> np.ndarray:
        self.t += DT
        if self.chunk is not None:
            times, rows = self.chunk
            return np.array([np.interp(self.t, times, joint) for joint in rows.T])
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

    def push_chunk(self, t: np.ndarray, rows: np.ndarray) -> None:
        self.stream.push_chunk(t, rows)

    def step(self) -> np.ndarray:
        return self.stream.step(DT).q


WAYS = {"linear": Linear, "filter": Filter, "held": Held, "stop to stop": StopToStop, "Stream": Streamed}


def sine(arm: armctl.Arm) -> Wanted:
    middle = 0.5 * (arm.limits.q_min + arm.limits.q_max)
    amplitude = np.minimum(0.3, 0.4 * (arm.limits.q_max - arm.limits.q_min))
    return lambda t: middle + amplitude * np.sin(2 * np.pi * 0.3 * t + np.arange(arm.n))


def policy(arm: armctl.Arm, seed: int) -> Wanted:
    """A random smooth network of the time: sines below 0.6 Hz, and two layers of tanh."""
    rng = np.random.default_rng(seed)
    frequencies = 2 * np.pi * rng.uniform(0.05, 0.6, 8)
    phases = rng.uniform(0, 2 * np.pi, 8)
    first = rng.standard_normal((8, 16)) / np.sqrt(8)
    second = rng.standard_normal((16, arm.n)) / np.sqrt(16)
    middle = 0.5 * (arm.limits.q_min + arm.limits.q_max)
    room = np.minimum(0.5, 0.3 * (arm.limits.q_max - arm.limits.q_min))
    return lambda t: middle + room * np.tanh(np.tanh(np.sin(frequencies * t + phases) @ first) @ second)


def run(name: str, arm: armctl.Arm, wanted: Wanted, seconds: float, task: str, seed: int) -> list[float]:
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
                chunk = (
                    times,
                    arm.limits.clamp(
                        np.array([wanted(each) for each in times]) + 5e-3 * rng.standard_normal((CHUNK_ROWS, arm.n))
                    ),
                )
                if isinstance(way, (Linear, Streamed)):
                    way.push_chunk(*chunk)
            else:
                target = arm.limits.clamp(wanted(t - latency) + 5e-3 * rng.standard_normal(arm.n))
                if isinstance(way, Streamed):
                    way.push(target, way.stream.t - latency)
                else:
                    way.push(target)
        if chunk is not None and not isinstance(way, (Linear, Streamed)) and t >= frame - 1e-9:
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
        1e3 * (speed * error).sum() / (speed**2).sum(),
        1e3 * np.sqrt((error**2).mean()),
        *over,
        np.median(ticks),
        np.percentile(ticks, 99),
    ]


def row(robot: str, task: str, name: str, seconds: float) -> list[str]:
    """A row of the table: the worst of some runs."""
    arm = armctl.load(robot)
    wanted = [policy(arm, seed) for seed in HELD_OUT] if task == "chunks" else [sine(arm)]
    runs = np.array([run(name, arm, each, seconds, task, 5) for each in wanted])
    lag = runs[np.abs(runs[:, 0]).argmax(), 0]
    figures = zip(runs.max(axis=0)[1:], [".1f", ".2f", ".2f", ".2f", ".0f", ".0f"], strict=True)
    return [robot, task, name, f"{lag:.0f}", *(f"{figure:{form}}" for figure, form in figures)]


def before_a_wall(robot: str) -> list[str]:
    """What becomes of chunks that lead through a wall."""
    arm = armctl.load(robot)
    turn = np.zeros(arm.n)
    turn[0] = 1.2
    center = arm.fk(arm.home + 2 / 3 * turn).position
    arm = armctl.load(robot, scene=armctl.World().add("wall", armctl.Box([0.05, 0.05, 0.6]), center))
    stream = armctl.Stream(arm, arm.home, avoid=True)
    data = mujoco.MjData(arm.model)
    times = []
    distance = np.inf
    for k in range(4000):
        if k % 100 == 0:
            t = stream.t - CHUNK_EVERY_S + np.arange(CHUNK_ROWS) / RATE_HZ
            rows = arm.home + np.clip(t / 2.0, 0.0, 1.0)[:, None] * turn
            started = time.process_time()
            stream.push_chunk(t, rows)
            times.append(time.process_time() - started)
        data.qpos[:] = arm.qpos(stream.step(DT).q)
        if k % 10 == 0:
            mujoco.mj_forward(arm.model, data)
            distance = min(distance, gap(arm, data))
    v = np.abs(stream.setpoint.v).max()
    median, most = 1e3 * np.percentile(times, [50, 99])
    return [robot, stream.report.obstacle, f"{1e3 * distance:.1f}", f"{v:.2g}", f"{median:.1f}", f"{most:.1f}"]


def gap(arm: armctl.Arm, data: mujoco.MjData) -> float:
    """m, the smallest distance of the robot's shapes from the wall, at most 1."""
    model = arm.model
    wall = model.geom("wall").id
    collides = (model.geom_contype | model.geom_conaffinity) > 0
    moved = np.flatnonzero(collides & (model.body_weldid[model.geom_bodyid] != 0))
    return min(mujoco.mj_geomDistance(model, data, int(geom), wall, 1.0, None) for geom in moved)


def main() -> None:
    """Prints the table, and writes it if asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", nargs="+", default=["robot_arm_3dof", "panda", "ur5e"])
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    tasks = ("sine", "sine 100 ms late", "chunks")
    table = [row(robot, task, name, options.seconds) for robot in options.arms for task in tasks for name in WAYS]
    header = ["arm", "targets", "way", "lag, ms", "RMS, mrad", "v / max", "a / max", "jerk / max", "tick, us", "99 %, us"]
    walls = ["arm", "report", "least distance, mm", "speed at the end, rad/s", "push, ms", "99 %, ms"]
    text = markdown_table(header, table) + "\n\n" + markdown_table(walls, map(before_a_wall, options.arms))
    print(text)
    if options.out:
        options.out.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
