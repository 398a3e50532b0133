"""The speed of simulations: one run, and many runs on threads.

    python benchmarks/scale.py [--robots panda ur5e robot_arm_3dof] [--runs 40] [--out benchmarks/results/scale.md]

CPU time, the best of several rounds in turns. The motion is that of `armctl compare`. Every answer is verified: a bare loop of
`mj_step` that knows nothing of armctl replays the recorded controls and must reach the same positions to the bit.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
from markdown_table import titled_table

import armctl

ROUNDS = 5
LONG_MOVES = 30
CONTROLLERS: dict[str, Callable[[armctl.Arm], armctl.Controller]] = {
    "pd": armctl.PD,
    "computed-torque": armctl.ComputedTorque,
    "admittance": armctl.Admittance,  # which measures the wrench
}


class InPython:
    """A controller whose law is called tick by tick, as one without a kernel is."""

    def __init__(self, controller: armctl.Controller):
        self._controller = controller
        self.needs_wrench = getattr(controller, "needs_wrench", False)

    def torque(self, state: armctl.State, setpoint: armctl.Setpoint) -> np.ndarray:
        return self._controller.torque(state, setpoint)


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).split("\n")[0])
    parser.add_argument("--robots", nargs="+", default=["panda", "ur5e", "robot_arm_3dof"])
    parser.add_argument("--runs", type=int, default=40, help="runs of a Monte Carlo study")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "scale.md")
    args = parser.parse_args()
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    arms = {name: armctl.load(name) for name in args.robots}
    text = "\n\n".join([single(arms), rates(arms), many(arms, args.runs)]) + "\n"
    args.out.parent.mkdir(exist_ok=True)
    args.out.write_text(text, encoding="utf-8")
    print(text)


def single(arms: dict[str, armctl.Arm]) -> str:
    rows = []
    for robot, arm in arms.items():
        motion = armctl.out_and_back(arm)
        for name, make in CONTROLLERS.items():
            controller = make(arm)
            log = armctl.simulate(arm, controller, motion)
            verify(arm, log, armctl.simulate(arm, InPython(controller), motion))
            calls: list[Callable[[], object]] = [
                lambda arm=arm, log=log: replayed(arm, log),
                lambda arm=arm, c=controller, m=motion: armctl.simulate(arm, InPython(c), m),
                lambda arm=arm, c=controller, m=motion: armctl.simulate(arm, c, m),
            ]
            bare, python, compiled = [1e6 * seconds / len(log) for seconds in best(calls)]
            cells = [f"{bare:.1f}", f"{python:.1f}", f"{compiled:.1f}", f"{compiled / bare:.2f}"]
            rows.append([robot, name, *cells])
    columns = ["robot", "controller", "bare loop", "Python loop", "simulate", "to bare"]
    title = "us CPU for a tick, with reference, log and checks; the bare loop is Python that calls `mj_step`"
    return titled_table(title, columns, rows)


def rates(arms: dict[str, armctl.Arm]) -> str:
    """Ticks a second of a call of `simulate`, in a long run and in a short one.

    The rounds follow the same motion, as the runs of a study do: its reference is sampled once.
    """
    rows = []
    for robot, arm in arms.items():
        ends = [arm.home, *arm.limits.clamp(arm.home + np.random.default_rng(0).uniform(-0.3, 0.3, (LONG_MOVES - 1, arm.n)))]
        moves = [armctl.move_j(arm, ends[k - 1], ends[k]) for k in range(1, LONG_MOVES)]
        for motion in (armctl.move_sequence(arm, moves), armctl.out_and_back(arm)):
            log = armctl.simulate(arm, "computed-torque", motion)
            verify(arm, log, armctl.simulate(arm, InPython(armctl.ComputedTorque(arm)), motion))
            assert not log.contacts
            whole = []
            for _ in range(2 * ROUNDS):
                begin = time.process_time()
                log = armctl.simulate(arm, "computed-torque", motion)
                whole.append(time.process_time() - begin)
                assert not log.failure
            rows.append([robot, len(log), f"{1e-3 * len(log) / min(whole):.0f}"])
    columns = ["robot", "ticks", "simulate"]
    return titled_table("thousand ticks a second of CPU time, computed torque, a long motion and a short one", columns, rows)


def many(arms: dict[str, armctl.Arm], count: int) -> str:
    rows = []
    for robot, arm in arms.items():
        motion = armctl.out_and_back(arm)
        rng = np.random.default_rng(0)
        plants = [
            armctl.Plant(payload=float(rng.uniform(0, 1)), viscous_friction=float(rng.uniform(0, 1))) for _ in range(count)
        ]
        controller = armctl.ComputedTorque(arm)
        one = armctl.simulate_many(arm, controller, motion, plants, threads=1)
        two = armctl.simulate_many(arm, controller, motion, plants, threads=2)
        assert all(np.array_equal(a.q, b.q) and np.array_equal(a.tau, b.tau) for a, b in zip(one, two, strict=True))
        verify(arm, one[-1], armctl.Simulation(arm, InPython(controller), plants[-1]).run(motion))
        calls: list[Callable[[], object]] = [
            lambda arm=arm, c=controller, m=motion, p=plants, t=threads: armctl.simulate_many(arm, c, m, p, threads=t)
            for threads in (1, 2)
        ]
        calls += [
            lambda arm=arm, m=motion, p=plants, w=workers: armctl.compare(
                arm, ["computed-torque"], m, p, threads=w, configurations=0
            )
            for workers in (1, 2)
        ]
        milliseconds = [1e3 * seconds / count for seconds in best(calls)]
        rows.append(
            [robot, len(one[0]), *(f"{value:.1f}" for value in milliseconds), f"{milliseconds[1] / milliseconds[0]:.2f}"]
        )
    columns = ["robot", "ticks", "1 thread", "2 threads", "compare, 1", "compare, 2", "2 threads to 1"]
    return titled_table("ms CPU for one of many runs, each with a new payload and friction, computed torque", columns, rows)


def best(calls: list[Callable[[], object]]) -> list[float]:
    """The least CPU time of each call, s, of rounds in turns."""
    seconds = [np.inf] * len(calls)
    for _ in range(ROUNDS):
        for k, call in enumerate(calls):
            begin = time.process_time()
            call()
            seconds[k] = min(seconds[k], time.process_time() - begin)
    return seconds


def replayed(arm: armctl.Arm, log: armctl.Log, model: mujoco.MjModel | None = None) -> np.ndarray:
    """Positions (T, nq) that a bare loop of `mj_step` reaches with the recorded torques."""
    model = nominal(arm) if model is None else model
    data = mujoco.MjData(model)
    data.qpos[:] = log.qpos[0]
    data.qvel[arm.dof_adr] = log.v[0]
    data.ctrl[:] = arm.home_ctrl
    mujoco.mj_forward(model, data)
    controls = log.tau_cmd / arm.gear
    positions = np.empty_like(log.qpos)
    for k in range(len(log)):
        positions[k] = data.qpos
        data.ctrl[arm.ctrl_adr] = controls[k]
        mujoco.mj_step(model, data)
    return positions


_models: dict[str, mujoco.MjModel] = {}


def nominal(arm: armctl.Arm) -> mujoco.MjModel:
    if arm.name not in _models:
        _models[arm.name] = armctl.Plant().model(arm)
    return _models[arm.name]


def verify(arm: armctl.Arm, log: armctl.Log, in_python: armctl.Log) -> None:
    """The compiled loop, the Python loop and, on the nominal plant, a bare loop give the same bits."""
    shared = min(len(log), len(in_python))
    assert np.array_equal(log.qpos[:shared], in_python.qpos[:shared])
    assert np.array_equal(log.tau[:shared], in_python.tau[:shared])
    if log.plant == "nominal":
        assert np.array_equal(log.qpos, replayed(arm, log))


if __name__ == "__main__":
    main()
