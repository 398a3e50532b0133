"""Steps per CPU second of other libraries' environments, each in a virtual environment of its own: they break on MuJoCo 4."""

from __future__ import annotations

import subprocess
import sys
import venv
from dataclasses import dataclass
from pathlib import Path

_LOOP = """
import time
import numpy as np
rng = np.random.default_rng(5)
actions = rng.uniform(low, high, (STEPS, len(low)))
reset()
for action in actions[:20]:
    step(action)
start = time.process_time()
for k, action in enumerate(actions):
    step(action)
    if k % EPISODE == EPISODE - 1:
        reset()
print("RATE", len(actions) / (time.process_time() - start))
"""
_FETCH = """
import gymnasium, gymnasium_robotics
gymnasium.register_envs(gymnasium_robotics)
env = gymnasium.make("FetchReach-v4", max_episode_steps=1000000)
low, high = env.action_space.low, env.action_space.high
reset, step = (lambda: env.reset(seed=5)), env.step
STEPS, EPISODE = 2000, 50
"""
_LIFT = """
import robosuite
env = robosuite.make("Lift", robots="Panda", has_renderer=False, has_offscreen_renderer=False, use_camera_obs=False,
                     control_freq=20, horizon=10**9)
low, high = env.action_spec
reset, step = env.reset, env.step
STEPS, EPISODE = 500, 250
"""


@dataclass(frozen=True)
class Peer:
    """An environment of another library: the packages that it takes, its simulation steps for each of its own, and its code."""

    name: str
    packages: tuple[str, ...]
    ticks: int
    code: str


PEERS = (
    Peer("gymnasium-robotics: FetchReach-v4", ("gymnasium-robotics", "mujoco<3.4"), 20, _FETCH),
    Peer("robosuite: Lift, Panda", ("robosuite", "mujoco<3.4"), 25, _LIFT),
)


def steps_per_cpu_second(peer: Peer, folder: Path) -> float:
    """Installs the peer in a virtual environment below `folder`, unless it is there, and measures it."""
    home = folder / peer.name.partition(":")[0]
    python = home / "bin" / "python"
    if not (home / "installed").exists():
        venv.create(home, with_pip=True)
        subprocess.run([python, "-m", "pip", "install", "--quiet", *peer.packages], check=True)
        (home / "installed").touch()
    done = subprocess.run([python, "-c", peer.code + _LOOP], capture_output=True, text=True, check=False)
    rates = [line.split()[1] for line in done.stdout.splitlines() if line.startswith("RATE ")]
    if not rates:
        sys.exit(f"{peer.name} failed: {done.stderr[-1000:]}")
    return float(rates[0])
