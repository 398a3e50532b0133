"""Instructions of the processor for the calls that run most often: a figure that does not depend on the machine.

    python benchmarks/instructions.py [--robots panda ur5e robot_arm_3dof] [--out benchmarks/results/instructions.md]

A process makes a call few times and another one many times; valgrind counts the instructions of both, and their difference is
that of the calls alone. The calls are public ones, as a user makes them, with NumPy, MuJoCo and Python in them. Each count is
exact to about 1 %: caches of Python and of the memory allocator differ from run to run. It needs valgrind, and takes some
minutes for a robot.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
from markdown_table import markdown_table

import armctl

FEW = 3
Call = Callable[[int], object]


def solve_ik(arm: armctl.Arm) -> Call:
    """Targets of random configurations, from home."""
    rng = np.random.default_rng(5)
    share = 0.1 + 0.8 * rng.random((64, arm.n))
    q = arm.limits.q_min + share * (arm.limits.q_max - arm.limits.q_min)
    targets = [arm.fk(each) if arm.n > 5 else arm.fk(each).position for each in np.clip(q, -3.0, 3.0)]
    return lambda k: armctl.solve_ik(arm, targets[k % len(targets)], arm.home)


def tick(arm: armctl.Arm) -> Call:
    """One tick of a run with computed torque: the run has as many as there are calls."""
    motion = armctl.out_and_back(arm)
    simulation = armctl.Simulation(arm, armctl.ComputedTorque(arm))
    simulation.run(motion, dwell=0.0)  # what a first run prepares
    return lambda ticks: simulation.run(motion, dwell=ticks * arm.dt)


class InPython:
    """Computed torque as a controller in Python, which does nothing else."""

    def __init__(self, arm: armctl.Arm):
        self._law = armctl.ComputedTorque(arm)

    def torque(self, state: armctl.State, setpoint: armctl.Setpoint) -> np.ndarray:
        return self._law.torque(state, setpoint)


def python_tick(arm: armctl.Arm) -> Call:
    """One tick of a run whose controller is called in Python."""
    motion = armctl.out_and_back(arm)
    simulation = armctl.Simulation(arm, InPython(arm))
    simulation.run(motion, dwell=0.0)
    return lambda ticks: simulation.run(motion, dwell=ticks * arm.dt)


def step(arm: armctl.Arm) -> Call:
    """One call of `sim.step`, which holds the arm with a controller in Python."""
    simulation = armctl.Simulation(arm, InPython(arm))
    simulation.step()
    return lambda k: simulation.step()


def run_of_many(arm: armctl.Arm) -> Call:
    """One run of `simulate_many`, each with another payload."""
    motion = armctl.out_and_back(arm)
    controller = armctl.ComputedTorque(arm)
    armctl.simulate_many(arm, controller, motion, armctl.Plant(payload=2.0), threads=1)
    return lambda runs: armctl.simulate_many(arm, controller, motion, payloads(runs), threads=1)


def bare_run(arm: armctl.Arm) -> Call:
    """The torques of such a run once more, in a loop that calls `mj_step`; its model is made before."""
    plant = payloads(1)[0]
    log = armctl.simulate(arm, armctl.ComputedTorque(arm), armctl.out_and_back(arm), plant)
    model = plant.model(arm)

    def replay(k: int) -> None:
        data = mujoco.MjData(model)
        data.qpos[:] = log.qpos[0]
        data.ctrl[:] = arm.home_ctrl
        mujoco.mj_forward(model, data)
        for controls in log.tau_cmd / arm.gear:
            data.ctrl[arm.ctrl_adr] = controls
            mujoco.mj_step(model, data)
        assert np.allclose(data.qpos[arm.qpos_adr], log.q[-1], atol=1e-3)

    return replay


def payloads(count: int) -> list[armctl.Plant]:
    return [armctl.Plant(payload=float(mass)) for mass in np.linspace(0.1, 1.0, count)]


def check_clearance(arm: armctl.Arm) -> Call:
    """The proof of a motion out and back."""
    motion = armctl.out_and_back(arm)
    return lambda k: armctl.check_clearance(arm, motion)


def push(arm: armctl.Arm) -> Call:
    """A target of a stream in each period of 20 ms."""
    stream = armctl.Stream(arm, arm.home)

    def pushed(k: int) -> None:
        stream.push(stream.t + 0.02, arm.home + 0.05 * np.sin(0.1 * k))
        stream.step(0.02)

    return pushed


# What is counted, how many of it, and whether one call does all of them.
CALLS: dict[str, tuple[Callable[[armctl.Arm], Call], int, bool]] = {
    "solve_ik": (solve_ik, 200, False),
    "tick": (tick, 2000, True),
    "tick in Python": (python_tick, 2000, True),
    "step": (step, 500, False),
    "run of many": (run_of_many, 30, True),
    "bare run": (bare_run, 15, False),
    "check_clearance": (check_clearance, 20, False),
    "push": (push, 100, False),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).split("\n")[0])
    parser.add_argument("--robots", nargs="+", default=["panda", "ur5e", "robot_arm_3dof"])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "instructions.md")
    parser.add_argument("--make", nargs=3, metavar=("ROBOT", "CALL", "COUNT"), help=argparse.SUPPRESS)  # what is counted
    args = parser.parse_args()
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    if args.make:
        make(*args.make[:2], int(args.make[2]))
        return
    if shutil.which("valgrind") is None:
        sys.exit("valgrind counts the instructions, and is not installed; apt-get install valgrind")
    columns = ["robot", *(f"{name}, thousand" for name in CALLS)]
    rows = [[robot, *(f"{instructions(robot, name) / 1e3:.3g}" for name in CALLS)] for robot in args.robots]
    table = markdown_table(columns, rows)
    args.out.parent.mkdir(exist_ok=True)
    args.out.write_text(table + "\n", encoding="utf-8")
    print(table)


def make(robot: str, name: str, count: int) -> None:
    """Makes a call so many times, after one that prepares it."""
    prepare, _, is_one_call = CALLS[name]
    call = prepare(armctl.load(robot))
    if is_one_call:
        call(count)
        return
    for k in range(count):
        call(k)


def instructions(robot: str, name: str) -> float:
    """The instructions of one call."""
    many = CALLS[name][1]
    return (counted(robot, name, many) - counted(robot, name, FEW)) / (many - FEW)


def counted(robot: str, name: str, count: int) -> int:
    """The instructions of a process that makes so many calls."""
    environment = os.environ | {"PYTHONHASHSEED": "0", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    command = ["valgrind", "--tool=cachegrind", "--cache-sim=no", "--cachegrind-out-file=/dev/null"]
    command += [sys.executable, __file__, "--make", robot, name, str(count)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    found = re.search(r"I\s+refs:\s+([\d,]+)", done.stderr)
    if done.returncode or found is None:
        sys.exit(f"{name} of {robot}: {done.stderr[-500:]}")
    return int(found[1].replace(",", ""))


if __name__ == "__main__":
    main()
