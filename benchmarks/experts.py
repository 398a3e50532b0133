"""Experts: how many episodes of each task the scripted policies solve. `python benchmarks/experts.py`.

An episode is solved if the policy is at the goal in its last step, in Track during all of its second half, and if it did not
touch the obstacle. Seeds are 0, 1, 2, ...; each has a start, a goal and a scene of its own.
"""

import argparse
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from markdown_table import markdown_table

import armctl
import armctl.envs

ROBOTS = ("panda", "ur5e+robotiq_2f85", "xarm7", "gen3+robotiq_2f85", "so_arm100", "robot_arm_3dof")
ROBOT_OF_ALL_ACTIONS = "panda"
TASKS = ("Reach", "ReachPast", "Track", "Push", "PickPlace")
ACTIONS = ("joint_target", "joint_delta", "cartesian_delta")
RESULTS = Path(__file__).parent / "results" / "experts.md"


def solved(robot: str, task: str, action: str, episodes: int) -> list[str]:
    """A row of the table: solved episodes, time to the goal, and error at the end; or why there is none."""
    name, _, tool = robot.partition("+")
    try:
        options = {"tool": tool} if tool else None
        env = armctl.envs.ArmVectorEnv(name, task, action, num_envs=episodes, load_options=options)
    except armctl.InputError as error:
        return [robot, task, action, "does not fit", str(error).partition(": ")[2].partition(";")[0], ""]
    start = time.process_time()
    policy = armctl.envs.ExpertPolicy(env)
    env.reset(seed=0)
    horizon = env.batch.horizon
    success = np.zeros((horizon, episodes), bool)
    distance = np.zeros((horizon, episodes))
    for step in range(horizon):
        information = env.step(policy())[4]
        success[step] = information["is_success"]
        distance[step] = information["distance"]
    seconds = time.process_time() - start
    env.close()
    held = max(1, int(env.batch.task.held_fraction * horizon))
    good = success[-held:].all(axis=0)
    time_to_goal = env.batch.step_time * (1 + np.median(success[:, good].argmax(axis=0)))
    error = 1e3 * np.median(distance[-1])
    return [robot, task, action, f"{good.sum()} of {episodes}", f"{time_to_goal:.2f} s, {error:.1f} mm", f"{seconds:.0f} s"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--robots", nargs="+", default=ROBOTS)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS)
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    cases = [(robot, task, ACTIONS[0]) for robot in arguments.robots for task in arguments.tasks]
    if ROBOT_OF_ALL_ACTIONS in arguments.robots:
        cases += [(ROBOT_OF_ALL_ACTIONS, task, action) for task in arguments.tasks for action in ACTIONS[1:]]
    headers = ["robot", "task", "action", "solved", "median time to the goal, error at the end", "CPU"]
    rows = []
    with ProcessPoolExecutor(arguments.processes, mp_context=get_context("spawn")) as pool:
        for row in pool.map(partial(solved, episodes=arguments.episodes), *zip(*cases, strict=True)):
            rows.append(row)
            print(*row, sep=" | ", flush=True)
    RESULTS.write_text(markdown_table(headers, rows) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
