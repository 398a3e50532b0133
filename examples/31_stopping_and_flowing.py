"""Ten waypoints, with a stop at each and without stops, in one plot."""

import sys
import tempfile
from functools import reduce
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import armctl

folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
arm = armctl.load("panda")
steps = np.random.default_rng(4).normal(0.0, 0.15, (10, arm.n))
waypoints = arm.limits.clamp(arm.home + np.cumsum(steps, axis=0))

moves = [armctl.move_j(arm, a, b, straight=False) for a, b in pairwise(waypoints)]
stopping = reduce(lambda first, second: first.then(second), moves)
flowing = armctl.move_through(arm, waypoints)

figure = Figure(figsize=(8, 5), layout="constrained")
for axes, value in zip(figure.subplots(2, 1), ("q", "v"), strict=True):
    for motion, style in ((stopping, ":"), (flowing, "-")):
        times = np.linspace(0.0, motion.duration, 800)
        axes.plot(times, getattr(motion.sample(times), value)[:, 3], style, label=f"{motion.duration:.2f} s")
    axes.set_ylabel({"q": "joint4, rad", "v": "joint4, rad/s"}[value])
    axes.legend()
figure.savefig(folder / "stopping_and_flowing.png", dpi=120)
print(f"drawn: {folder / 'stopping_and_flowing.png'}")
print(f"inside all limits: {flowing.check_limits().ok}")
print(f"stopping takes {stopping.duration:.2f} s, flowing {flowing.duration:.2f} s: {flowing.duration / stopping.duration:.0%}")
