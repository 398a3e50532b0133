"""Motions that need more torque than the motors have: clipped computed torque, its quadratic program, LQR and MPC.

    python benchmarks/predictive_control.py [--motions 200] [--offline 10]
    python benchmarks/predictive_control.py --robots panda kinova_gen3 --motions 12

Random motions of a bundled arm and of two synthetic ones, or of robots that are named, with torque limits between what
keeps the speed and what the motion needs. A motion counts if the arm touches nothing during it, which is proved before
any law follows it.

The motions run at the speed limits for about half of their time. Nothing within these limits makes up for a delay then,
and clipped computed torque does so beyond them. The first table compares it with laws that keep them. The second one
compares it with MPC under equal limits: of the torque alone, with speed limits that nothing reaches, and of torque and
speed for both. Its last columns are offline optima, with the whole motion known in advance, of the first motions and of
those with the largest errors, which decide the RMS.
"""

import argparse
import sys
import tempfile
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from markdown_table import titled_table
from offline_tracking import JOINT_INTERVAL_S, TORQUE_TOLERANCE, offline_error

import armctl

sys.path.append(str(Path(__file__).parent.parent / "tests" / "helpers"))
from synthetic import BENT, serial_arm

SHARES = (0.9, 0.7, 0.5)  # of the torque that accelerates the arm, besides that which keeps its speed


class Clipped:
    """A law whose torques are clipped at the limits of an arm."""

    def __init__(self, arm: armctl.Arm, law: armctl.Controller):
        self.law = law
        self.tau_max = arm.limits.tau_max

    def torque(self, state: armctl.State, setpoint: armctl.Setpoint) -> np.ndarray:
        return np.clip(self.law.torque(state, setpoint), -self.tau_max, self.tau_max)


class ClippedInSpeed(Clipped):
    """Clipped computed torque that lets no joint exceed its speed limit in the coming tick, as far as the torque is there."""

    def __init__(self, arm: armctl.Arm):
        super().__init__(arm, armctl.ComputedTorque(arm))
        self.arm = arm

    def torque(self, state: armctl.State, setpoint: armctl.Setpoint) -> np.ndarray:
        tau = super().torque(state, setpoint)
        v_max = self.arm.limits.v_max
        M = self.arm.mass_matrix(state.q)
        for _ in range(2):  # clipping one joint accelerates others
            a = np.linalg.solve(M, tau - self.arm.inverse_dynamics(state.q, state.v, np.zeros(self.arm.n)))
            a_allowed = np.clip(a, (-v_max - state.v) / state.dt, (v_max - state.v) / state.dt)
            tau = np.clip(tau + M @ (a_allowed - a), -self.tau_max, self.tau_max)
        return tau


LAWS = {
    "clipped": lambda arm: Clipped(arm, armctl.ComputedTorque(arm)),
    "qp": armctl.ComputedTorqueQP,
    "lqr, clipped": lambda arm: Clipped(arm, armctl.LQR(arm)),
    "mpc": armctl.MPC,
}
TIMED_TICKS = 2000
UNREACHED_SPEED = 10.0  # relative to the speed limits: clipped computed torque reaches 1.6


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--motions", type=int, default=200)
    parser.add_argument("--offline", type=int, default=10)
    parser.add_argument("--robots", nargs="+", default=[], help="only the first table, of these, and no file")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "predictive_control.md")
    args = parser.parse_args()
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    if args.robots:
        cases = {name: random_cases(armctl.load(name), args.motions) for name in args.robots}
        print(table_of_laws([row for name, each in cases.items() for row in against_clipped(name, each)[1]], args.motions))
        return
    with tempfile.TemporaryDirectory() as folder:
        arms = {name: serial_arm(Path(folder), BENT[name], shapes="capsules") for name in ("six joints", "redundant")}
        arms = {"robot_arm_3dof": armctl.load("robot_arm_3dof"), **arms}
        text = "\n\n".join([*study(arms, args.motions, args.offline), cost(arms)]) + "\n"
    args.out.write_text(text, encoding="utf-8")
    print(text)


def study(arms: dict[str, armctl.Arm], motions: int, offline: int) -> list[str]:
    rows = []
    equal_rows = []
    for name, arm in arms.items():
        cases = random_cases(arm, motions)
        clipped, of_laws = against_clipped(name, cases)
        rows += of_laws
        equal_rows += equal_limits(name, cases, clipped, offline)
    equal_columns = ["arm", "limits", "RMS", "median", "90 %", "largest", "at most 1/3, %", "outside, mrad", "speed, %"]
    offline_columns = ["arm", "limits", "motions", "optimized", "clipped, mm", "mpc, mm", "optimum, mm", "mpc", "optimum"]
    return [
        table_of_laws(rows, motions),
        titled_table(
            "Error of the tip of MPC relative to clipped computed torque with the same limits, of the same motions",
            equal_columns,
            [row for each, _ in equal_rows for row in each],
        ),
        titled_table(
            "RMS error of the tip beside the offline optimum that knows the whole motion, for accelerations that are constant "
            f"over {1e3 * JOINT_INTERVAL_S:g} ms per joint and torques up to {100 * TORQUE_TOLERANCE:g} % beyond their limits; "
            "the last columns relative to computed torque clipped in torque alone",
            offline_columns,
            [row for _, each in equal_rows for row in each],
        ),
    ]


def against_clipped(name: str, cases: list) -> tuple[np.ndarray, list[list[str]]]:
    """The errors of clipped computed torque, and the rows of all laws."""
    rows = []
    clipped = np.empty(0)
    for law, make in LAWS.items():
        error, outside, speed = np.array([tracked(make, *case) for case in cases]).T
        if law == "clipped":
            clipped = error
        for group, chosen in (("all", clipped >= 0.0), ("clipped >= 1 mm", clipped >= 1e-3)):
            if not chosen.any():
                continue
            share = np.mean(error[chosen] <= clipped[chosen] / 3)
            outside_mrad = f"{1e3 * max(outside[chosen].max(), 0.0):.1g}"
            numbers = [*compared(error, clipped, chosen), f"{100 * share:.0f}", outside_mrad]
            numbers.append(f"{100 * speed[chosen].max():.0f}")
            rows.append([name, law, group, str(chosen.sum()), *numbers])
    return clipped, rows


def table_of_laws(rows: list[list[str]], motions: int) -> str:
    columns = ["arm", "law", "motions", "number", "RMS", "median", "90 %", "largest"]
    columns += ["at most 1/3, %", "outside, mrad", "speed, %"]
    return titled_table(
        f"Error of the tip relative to clipped computed torque, {motions} motions of each arm: of all (RMS) and of "
        "each; the farthest outside of a joint limit, and the highest speed of a joint relative to its limit. Clipped "
        "computed torque and LQR keep no speed limit",
        columns,
        rows,
    )


def equal_limits(name: str, cases: list, clipped: np.ndarray, offline: int) -> list:
    """Rows of both tables of equal limits: of the torque alone, and of torque and speed."""
    largest = np.argsort(-clipped)[:offline]
    rows = []
    optima = []
    for limits, factor in (("torque", UNREACHED_SPEED), ("torque and speed", 1.0)):
        arms = [arm.with_limits(replace(arm.limits, v_max=factor * arm.limits.v_max)) for arm, _ in cases]
        error, outside, speed = np.array([tracked(armctl.MPC, arm, case[1]) for arm, case in zip(arms, cases, strict=True)]).T
        other = clipped if factor > 1.0 else np.array([tracked(ClippedInSpeed, *case)[0] for case in cases])
        numbers = [*compared(error, other, other >= 0.0), f"{100 * np.mean(error <= other / 3):.0f}"]
        rows.append([name, limits, *numbers, f"{1e3 * max(outside.max(), 0.0):.1g}", f"{100 * factor * speed.max():.0f}"])
        for group, chosen in ((f"first {offline}", np.arange(min(offline, len(cases)))), (f"largest {len(largest)}", largest)):
            best = np.array([offline_error(arms[k], cases[k][1], run(armctl.MPC, arms[k], cases[k][1])) for k in chosen])
            found = np.isfinite(best)
            rms = (
                [np.sqrt(np.mean(each[found] ** 2)) for each in (clipped[chosen], error[chosen], best)]
                if found.any()
                else 3 * [np.nan]
            )
            row = [name, limits, group, f"{found.sum()} of {len(chosen)}", *(f"{1e3 * each:.2f}" for each in rms)]
            optima.append([*row, f"{rms[1] / rms[0]:.2f}", f"{rms[2] / rms[0]:.2f}"])
    return [(rows, optima)]


def compared(error: np.ndarray, clipped: np.ndarray, chosen: np.ndarray) -> list[str]:
    """Errors relative to those of clipped computed torque: of all motions together, and quantiles."""
    if not chosen.any():
        return 4 * ["-"]
    ratio = error[chosen] / clipped[chosen]
    pooled = np.sqrt(np.sum(error[chosen] ** 2) / np.sum(clipped[chosen] ** 2))
    return [f"{each:.2f}" for each in (pooled, *np.quantile(ratio, [0.5, 0.9, 1.0]))]


def random_cases(arm: armctl.Arm, motions: int) -> list[tuple[armctl.Arm, armctl.JointTrajectory]]:
    """Free motions between random configurations, each with a weakened arm."""
    rng = np.random.default_rng(11)
    cases: list[tuple[armctl.Arm, armctl.JointTrajectory]] = []
    while len(cases) < motions:
        motion = armctl.move_j(arm, *arm.limits.random(arm.home, 2, rng))
        if not armctl.check_clearance(arm, motion):
            continue
        setpoints = motion.sample(np.arange(0.0, motion.duration, 0.002))
        steady = largest_torques(arm, setpoints.q, setpoints.v, np.zeros_like(setpoints.a))
        moving = largest_torques(arm, *setpoints[:3])
        tau_max = np.minimum(arm.limits.tau_max, steady + SHARES[len(cases) % len(SHARES)] * (moving - steady))
        cases.append((arm.with_limits(replace(arm.limits, tau_max=tau_max)), motion))
    return cases


def largest_torques(arm: armctl.Arm, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Of each joint along a motion, N m, with dry friction: a motor that is weaker than it moves nothing."""
    dry_friction = arm.model.dof_frictionloss[arm.dof_adr] * np.sign(v)
    inertial = [arm.inverse_dynamics(*each) for each in zip(q, v, a, strict=True)]
    return np.max(np.abs(inertial + dry_friction), axis=0)


def run(make, weak: armctl.Arm, motion: armctl.JointTrajectory) -> armctl.Log:
    return armctl.simulate(weak, make(weak), motion, armctl.Plant(timestep=0.001), dwell=0.5)


def tracked(make, weak: armctl.Arm, motion: armctl.JointTrajectory) -> tuple[float, float, float]:
    """The RMS error of the tip, m; the largest distance, rad, outside of a joint limit; the largest share of v_max."""
    log = run(make, weak, motion)
    outside = np.maximum(log.q - weak.limits.q_max, weak.limits.q_min - log.q).max()
    moving = log.t <= motion.duration
    error = float(np.sqrt(np.mean(np.sum((log.tip - log.tip_ref)[moving] ** 2, axis=1))))
    return error, float(outside), float(np.max(np.abs(log.v) / weak.limits.v_max))


def cost(arms: dict[str, armctl.Arm]) -> str:
    """The time of one call while the plan has active limits, by the clock of the process."""
    rows = []
    for name, arm in arms.items():
        holding = np.abs(arm.gravity(arm.home))
        law = armctl.MPC(arm.with_limits(replace(arm.limits, tau_max=1.2 * holding + 0.05 * arm.limits.tau_max)))
        rest = np.zeros(arm.n)
        rng = np.random.default_rng(5)
        times = []
        for k in range(TIMED_TICKS):
            q = arm.limits.clamp(arm.home + rng.uniform(-0.3, 0.3, arm.n))
            setpoint = armctl.Setpoint(arm.limits.clamp(q + rng.uniform(-0.06, 0.06, arm.n)), rest, rest)
            state = armctl.State(q, rest, 0.001 * k, 0.001)
            began = time.process_time()
            law.torque(state, setpoint)
            times.append(1e3 * (time.process_time() - began))
        planned = f"{100 * (law.counts.planned - law.counts.unplanned) / law.counts.ticks:.0f}"
        rows.append([name, str(arm.n), planned, *(f"{np.quantile(times, p):.2f}" for p in (0.5, 0.99))])
    columns = ["arm", "joints", "planned, %", "median, ms", "p99, ms"]
    return titled_table(
        "CPU time of one call of MPC, at random states and targets up to 0.06 rad away, with a period of 1 ms", columns, rows
    )


if __name__ == "__main__":
    main()
