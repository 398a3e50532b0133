"""The same reaching problems for `optimize` and for crocoddyl: from rest to rest in a given time with the least torque,
where the straight motion is free.

    pip install crocoddyl
    python benchmarks/reaching.py [--problems 10]

The arm is a synthetic one of seven joints without damping. `optimize` minimizes the sum of relative duration and torque;
crocoddyl (BoxFDDP, intervals of 5 ms) gets the duration that it found, and minimizes the squared torques within their limits.
"""

import argparse
import sys
import tempfile
import time
import warnings
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from markdown_table import titled_table

import armctl

sys.path.append(str(Path(__file__).parent.parent / "tests" / "helpers"))
from synthetic import BENT, serial_arm

INTERVAL_S = 5e-3
GOAL_WEIGHT = 1e5  # of the squared error of the state at the end; the torque is relative to its limits
MAX_ITERATIONS = 300
CLEARANCE_M = 1e-3


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--problems", type=int, default=10)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "reaching.md")
    args = parser.parse_args()
    if find_spec("crocoddyl") is None:
        print("crocoddyl is not installed; pip install crocoddyl")
        return
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    with tempfile.TemporaryDirectory() as folder:
        arm = serial_arm(Path(folder), BENT["redundant"], shapes="capsules")
    arm = arm.with_limits(replace(arm.limits, tau_max=0.5 * arm.limits.tau_max))
    rng = np.random.default_rng(4)
    found: dict[str, list] = {"move_j, scaled": [], "optimize": [], "crocoddyl": []}
    while len(found["optimize"]) < args.problems:
        start, goal = arm.limits.random(arm.home, 2, rng)
        straight = armctl.move_j(arm, start, goal)
        if not armctl.check_clearance(arm, straight, clearance=CLEARANCE_M):
            continue
        began = time.process_time()
        better = armctl.optimize(arm, straight, torque=1.0, clearance=CLEARANCE_M).motion
        elapsed = time.process_time() - began
        found["optimize"].append([*sampled(arm, better), elapsed])
        # `scaled` makes a motion slower only, and crocoddyl has no limits but those of the torque.
        slower = straight.scaled(min(1.0, straight.duration / better.duration))
        found["move_j, scaled"].append([*sampled(arm, slower), 0.0])
        found["crocoddyl"].append(by_crocoddyl(arm, start, goal, better.duration))
    columns = ["planner", "squared torque", "end, rad", "torque", "velocity", "acceleration", "jerk", "CPU, s"]
    rows = [
        [name, *(f"{each:.3g}" for each in summary(np.array(runs), np.array(found["optimize"])))]
        for name, runs in found.items()
    ]
    title = (
        f"{args.problems} reaching problems in the time that optimize takes: the median of the squared torque relative to that "
        "of optimize, the largest error at the end, the largest shares of limits, and the median time"
    )
    text = titled_table(title, columns, rows) + "\n"
    args.out.write_text(text, encoding="utf-8")
    print(text)


def summary(runs: np.ndarray, of_optimize: np.ndarray) -> list[float]:
    return [np.median(runs[:, 0] / of_optimize[:, 0]), *runs[:, 1:6].max(axis=0), np.median(runs[:, 6])]


def sampled(arm: armctl.Arm, motion: armctl.JointTrajectory) -> list[float]:
    """As `measured`, of a motion."""
    times = np.arange(0.0, motion.duration, 1e-3)
    q, v, a = motion.sample(times)[:3]
    tau = np.array([arm.inverse_dynamics(*each) for each in zip(q, v, a, strict=True)])
    return measured(arm, tau, 1e-3, 0.0, v, a, motion.jerk(times))


def measured(arm: armctl.Arm, tau: np.ndarray, dt: float, end: float, v, a, j) -> list[float]:
    """The integral of squared torques relative to their limits, s, the error at the end, and the largest shares of limits."""
    limits = arm.limits
    bounds = ((tau, limits.tau_max), (v, limits.v_max), (a, limits.a_max), (j, limits.j_max))
    return [dt * np.sum((tau / limits.tau_max) ** 2), end, *(np.abs(values / bound).max() for values, bound in bounds)]


def by_crocoddyl(arm: armctl.Arm, start: np.ndarray, goal: np.ndarray, duration: float) -> list[float]:
    """As `measured`, and the CPU time, s."""
    import crocoddyl

    state = crocoddyl.StateMultibody(arm.pinocchio_model.pin_model)
    actuation = crocoddyl.ActuationModelFull(state)
    effort = crocoddyl.CostModelResidual(
        state, crocoddyl.ActivationModelWeightedQuad(arm.limits.tau_max**-2.0), crocoddyl.ResidualModelControl(state)
    )
    at_goal = crocoddyl.CostModelResidual(state, crocoddyl.ResidualModelState(state, np.concatenate([goal, np.zeros(arm.n)])))
    running = crocoddyl.CostModelSum(state)
    running.addCost("effort", effort, 1.0)
    last = crocoddyl.CostModelSum(state)
    last.addCost("goal", at_goal, GOAL_WEIGHT)
    count = round(duration / INTERVAL_S)
    dt = duration / count
    models = []
    for costs, step in ((running, dt), (last, 0.0)):
        dynamics = crocoddyl.DifferentialActionModelFreeFwdDynamics(state, actuation, costs)
        dynamics.u_lb = -arm.limits.tau_max
        dynamics.u_ub = arm.limits.tau_max
        models.append(crocoddyl.IntegratedActionModelEuler(dynamics, step))
    x0 = np.concatenate([start, np.zeros(arm.n)])
    problem = crocoddyl.ShootingProblem(x0, [models[0]] * count, models[1])
    problem.nthreads = 1
    solver = crocoddyl.SolverBoxFDDP(problem)
    began = time.process_time()
    solver.solve([x0] * (count + 1), [arm.gravity(start)] * count, MAX_ITERATIONS)
    elapsed = time.process_time() - began
    x = np.array(solver.xs)
    v = x[:, arm.n :]
    a = np.diff(v, axis=0) / dt
    end = np.abs(x[-1] - np.concatenate([goal, np.zeros(arm.n)])).max()
    rest = np.vstack([np.zeros(arm.n), a, np.zeros(arm.n)])  # the arm rests before and after
    return [*measured(arm, np.array(solver.us), dt, end, v, a, np.diff(rest, axis=0) / dt), elapsed]


if __name__ == "__main__":
    main()
