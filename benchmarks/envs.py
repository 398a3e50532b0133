"""Environments: steps per CPU second of Reach, 25 control periods each. `python benchmarks/envs.py [--peers FOLDER]`.

With --peers, the environments of other libraries are installed into virtual environments below FOLDER, since they do not run
on MuJoCo 4, and measured in the same run: with contacts, one at a time, as they are made.
The time includes observations, rewards and the starts of episodes. Each batch is compared, bit by bit, with a single
environment.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from envs_peers import PEERS, steps_per_cpu_second
from markdown_table import markdown_table

import armctl
import armctl.envs

ROBOT = "panda"
COUNT = 256
OTHER_ACTIONS = ("joint_delta_smooth", "torque", "joint_target", "cartesian_pose")
SEED = 5
CHECKED = 7
PAYLOAD = {"payload": armctl.Range(0.0, 0.5)}
RESULTS = Path(__file__).parent / "results" / "envs.md"


def random_actions(steps: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(SEED).uniform(-1.0, 1.0, (steps, *shape)).astype(np.float32)


def batch(arm: armctl.Arm, action: str, steps: int, **options) -> tuple[float, np.ndarray]:
    """Steps per CPU second, and the observations (steps, COUNT, k)."""
    env = armctl.envs.ArmVectorEnv(arm, action=action, num_envs=COUNT, **options)
    env.reset(seed=SEED)
    actions = random_actions(steps, *env.action_space.shape)
    start = time.process_time()
    observations = [env.step(action)[0] for action in actions]
    rate = COUNT * steps / (time.process_time() - start)
    return rate, np.array(observations)


def single(arm: armctl.Arm, action: str, steps: int, observed: np.ndarray) -> float:
    """Steps per CPU second, which must repeat what a row of a batch observed."""
    env = armctl.envs.ArmEnv(arm, action=action)
    env.reset(seed=SEED + CHECKED)
    actions = random_actions(len(observed), COUNT, *env.action_space.shape)[:, CHECKED]
    for k in range(min(len(observed), env.batch.horizon - 1)):
        assert np.array_equal(env.step(actions[k])[0], observed[k, CHECKED]), "a batch differs from a single environment"
    actions = random_actions(steps, *env.action_space.shape)
    start = time.process_time()
    for action in actions:
        if env.step(action)[3]:
            env.reset()
    return steps / (time.process_time() - start)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--peers", type=Path, metavar="FOLDER")
    args = parser.parse_args()
    arm = armctl.load(ROBOT)
    rows = []
    for action in ("joint_delta", "cartesian_delta"):
        rate, observed = batch(arm, action, 100)
        rows.append([f"armctl, {action}", "no contacts", str(COUNT), "25", f"{rate:.0f}"])
        rows.append([f"armctl, {action}", "no contacts", "1", "25", f"{single(arm, action, 5000, observed):.0f}"])
        rate, _ = batch(arm, action, 100, randomize=PAYLOAD)
        rows.append([f"armctl, {action}", "no contacts, payload varies", str(COUNT), "25", f"{rate:.0f}"])
        rate, _ = batch(arm, action, 20, contacts=True)
        rows.append([f"armctl, {action}", "contacts", str(COUNT), "25", f"{rate:.0f}"])
    for action in OTHER_ACTIONS:
        rows.append([f"armctl, {action}", "no contacts", str(COUNT), "25", f"{batch(arm, action, 100)[0]:.0f}"])
    for peer in PEERS if args.peers else ():
        rate = steps_per_cpu_second(peer, args.peers)
        rows.append([peer.name, "contacts", "1", str(peer.ticks), f"{rate:.0f}"])
    table = markdown_table(["environment", "plant", "at once", "ticks per step", "steps / CPU s"], rows)
    RESULTS.write_text(table + "\n", encoding="utf-8")
    print(table)


if __name__ == "__main__":
    main()
