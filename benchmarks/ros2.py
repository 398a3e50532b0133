"""Motions and stops of three arms through the topic of a trajectory controller of ROS 2, with real nodes.

    python benchmarks/ros2.py [--arms robot_arm_3dof panda ur5e] [--motions 34] [--stops 10] [--out FILE]
    python benchmarks/ros2.py --arms robot_arm_3dof --motions 3 --stops 1    # a minute

Each arm is served by `armctl ros2 serve` in a process of its own, and commanded through `armctl.links.ROS2`, on this computer
only. Motions lead to random configurations that can be reached without contact; "end" is the largest distance of a joint from
its goal afterwards, as the served arm publishes it. A stop is asked for at a random share of a slower motion: "off the path"
is the largest distance of the joints from the planned path where the arm came to rest, "moves" the greatest speed of a joint
then.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from markdown_table import markdown_table

import armctl

RESULTS = Path(__file__).parent / "results" / "ros2.md"
SEED = 0
RANGE = 0.3  # of the range around home
SPEED = 0.5
STOP_SPEED = 0.2
TIP_SPEED = 2.0  # m/s
REST_S = 1.0  # after a stop, until the arm is looked at
PATH_SAMPLES = 2000
COLUMNS = ["arm", "motions", "reached", "end, mrad", "stops", "in the middle", "off the path, mrad", "moves, mrad/s"]


class Motions:
    """The motions of one arm, and what came of them."""

    def __init__(self, name: str, robot: armctl.Robot):
        self.name = name
        self.robot = robot
        self.rng = np.random.default_rng(SEED)

    def goal(self) -> np.ndarray:
        """A random configuration to which a path leads."""
        arm = self.robot.arm
        while True:
            q = arm.home + RANGE * (arm.limits.random(arm.home, 1, self.rng)[0] - arm.home)
            with contextlib.suppress(armctl.PlanError):
                armctl.move_free(arm, self.robot.state.q, q)
                return q

    def all(self, count: int) -> tuple[int, float]:
        """How many are reached, and the largest distance from a goal, rad."""
        reached = 0
        end = 0.0
        for _ in range(count):
            goal = self.goal()
            result = self.robot.move_j(goal)
            if result:
                reached += 1
                end = max(end, float(np.abs(self.robot.state.q - goal).max()))
            else:
                print(f"{self.name}: {result.reason}", file=sys.stderr)
        return reached, end

    def stops(self, count: int) -> tuple[int, float, float]:
        """How many end before the goal, and the largest distance from a path, rad, and speed, rad/s, afterwards."""
        middle = 0
        off = 0.0
        speed = 0.0
        for _ in range(count):
            start = self.robot.state.q
            motion = armctl.move_free(self.robot.arm, start, self.goal(), speed=STOP_SPEED)
            end = motion(motion.duration).q
            share = self.rng.uniform(0.2, 0.7)
            way = float(np.linalg.norm(end - start))

            def why(start: np.ndarray = start, bound: float = share * way) -> str:
                return "enough" if np.linalg.norm(self.robot.state.q - start) > bound else ""

            self.robot.interlock = why
            log = self.robot.run(self.robot.slowed(motion))
            self.robot.interlock = None
            time.sleep(REST_S)
            state = self.robot.state
            path = motion.sample(np.linspace(0.0, motion.duration, PATH_SAMPLES)).q
            middle += "enough" in log.failure
            off = max(off, float(np.abs(path - state.q).max(axis=1).min()))
            speed = max(speed, float(np.abs(state.v).max()))
        return middle, off, speed


def row(name: str, count: int, stops: int) -> list[object]:
    """A row of the table."""
    command = [sys.executable, "-m", "armctl", "ros2", "serve", name, "--namespace", name]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as server:
        try:
            arm = armctl.load(name)
            link = armctl.links.ROS2(arm, namespace=name)
            with armctl.Robot(arm, link, speed=SPEED, tip_speed=TIP_SPEED) as robot:
                motions = Motions(name, robot)
                reached, end = motions.all(count)
                middle, off, speed = motions.stops(stops)
        finally:
            server.terminate()
    return [name, count, reached, f"{1e3 * end:.2f}", stops, middle, f"{1e3 * off:.2f}", f"{1e3 * speed:.2f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", nargs="+", default=["robot_arm_3dof", "panda", "ur5e"])
    parser.add_argument("--motions", type=int, default=34, help="of each arm (default 34)")
    parser.add_argument("--stops", type=int, default=10, help="of each arm (default 10)")
    parser.add_argument("--out", type=Path, help=f"a file for the table, such as {RESULTS.name}")
    arguments = parser.parse_args()
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ.setdefault("ROS_DOMAIN_ID", str(random.randint(1, 100)))
    text = markdown_table(COLUMNS, [row(name, arguments.motions, arguments.stops) for name in arguments.arms]) + "\n"
    print(text)
    if arguments.out is not None:
        arguments.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
