"""Continuous use for an hour: moves, following, loading, and a viewer whose clients connect and disconnect.

    python benchmarks/soak.py [--minutes 60] [--robot robot_arm_3dof]

Memory must stay constant. Prints one row every twentieth of the time. The exit status is 1 if anything failed, or if the memory
of either process grew by more than 5 % and by more than 10 MB between the first quarter, when caches fill, and
its end.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import http.cookiejar
import importlib.metadata
import os
import re
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from websockets.sync.client import connect

import armctl

ROWS = 20
CLIENTS_PER_ROUND = 5
VISIT_S = 0.5
FOLLOW_S = 2.0
ALLOWED_GROWTH = 0.05
ALLOWED_GROWTH_MB = 10.0
TIMEOUT_S = 60.0


@dataclass
class Soak:
    """What was done, and the memory of the two processes over time."""

    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(["moves", "ticks followed", "loads", "clients"], 0))
    memory_mb: list[tuple[float, float]] = field(default_factory=list)


def memory_mb(pid: int) -> float:
    """Resident memory of a process."""
    return int(subprocess.run(["ps", "-o", "rss=", "-p", str(pid)], capture_output=True, text=True, check=True).stdout) / 1024


@contextlib.contextmanager
def viewer(robot: str) -> Iterator[tuple[subprocess.Popen, str]]:
    """`armctl view` in a process of its own, and its address."""
    command = [sys.executable, "-m", "armctl", "view", robot, "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        address = re.search(r"http://\S+?(?=[;\s])", process.stdout.readline())
        assert address is not None
        yield process, address[0].rstrip("/")
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()


def visit(url: str) -> None:
    """Open the page, connect as its script does, read messages for a moment, and disconnect."""
    cookies = http.cookiejar.CookieJar()
    opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(cookies))
    opener.open(url, timeout=TIMEOUT_S).read()
    headers = {"Cookie": "; ".join(f"{cookie.name}={cookie.value}" for cookie in cookies)} if len(cookies) else {}
    protocol = f"viser-v{importlib.metadata.version('viser')}"
    with connect(
        url.replace("http", "ws", 1),
        origin=url,  # type: ignore[arg-type]
        subprotocols=[protocol],  # type: ignore[list-item]
        additional_headers=headers,
        max_size=None,
        open_timeout=TIMEOUT_S,
    ) as client:
        client.recv(timeout=TIMEOUT_S)
        end = time.monotonic() + VISIT_S
        while time.monotonic() < end:
            with contextlib.suppress(TimeoutError):
                client.recv(timeout=VISIT_S)


def work(soak: Soak, sim: armctl.Simulation, robot: str, url: str, rng: np.random.Generator) -> None:
    """One round of everything."""
    arm = sim.arm
    for _ in range(5):
        sim.move_to(arm.fk(rng.uniform(arm.limits.q_min, arm.limits.q_max)).position)
        soak.counts["moves"] += 1
    center = sim.tip.position
    radius = 0.05 * rng.random()
    log = sim.follow(lambda t: center + radius * np.array([np.cos(t) - 1.0, np.sin(t), 0.0]), duration=FOLLOW_S)
    soak.counts["ticks followed"] += len(log.t)
    sim.reset()
    loaded = armctl.load(robot)
    armctl.Simulation(loaded).move_to(loaded.fk(loaded.home))
    soak.counts["loads"] += 1
    for _ in range(CLIENTS_PER_ROUND):
        visit(url)
        soak.counts["clients"] += 1


def grown(first_mb: float, last_mb: float) -> bool:
    """Whether the memory grew by more than what is allowed."""
    return last_mb - first_mb > max(ALLOWED_GROWTH * first_mb, ALLOWED_GROWTH_MB)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--robot", default="robot_arm_3dof")
    args = parser.parse_args()
    soak = Soak()
    rng = np.random.default_rng(0)
    sim = armctl.Simulation(args.robot)
    seconds = 60.0 * args.minutes
    print(f"| minutes | {' | '.join(soak.counts)} | memory, MB | memory of the viewer, MB |")
    print("|---" * (3 + len(soak.counts)) + "|")
    with viewer(args.robot) as (process, url):
        start = time.monotonic()
        for row in range(1, ROWS + 1):
            while time.monotonic() - start < seconds * row / ROWS:
                work(soak, sim, args.robot, url, rng)
            gc.collect()
            soak.memory_mb.append((memory_mb(os.getpid()), memory_mb(process.pid)))
            own, viewers = soak.memory_mb[-1]
            minutes = (time.monotonic() - start) / 60.0
            print(f"| {minutes:.1f} | {' | '.join(map(str, soak.counts.values()))} | {own:.0f} | {viewers:.0f} |", flush=True)
        assert process.poll() is None, "the viewer ended"
    own, viewers = zip(*soak.memory_mb, strict=True)
    failed = False
    for what, values in (("memory", own), ("memory of the viewer", viewers)):
        first = max(values[: ROWS // 4])
        verdict = "grew" if grown(first, values[-1]) else "is constant"
        failed |= verdict == "grew"
        print(f"{what} {verdict}: {first:.0f} MB in the first quarter, {values[-1]:.0f} MB at the end")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
