"""Motions that need more torque than the motors have: clipped computed torque, its quadratic program, LQR and MPC.

    python benchmarks/predictive_control.py [--motions 200]

Random motions of a bundled arm and of two synthetic ones, with torque limits between what keeps the speed and what
the motion needs.
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

import armctl

sys.path.append(str(Path(__file__).parent.parent / "tests"))
from synthetic import BENT, serial_arm

SHARES = (0.9, 0.7, 0.5)  # of the torque that accelerates the arm, besides that which keeps its speed


class Clipped:
    """A law whose torques are clipped at the limits of an arm."""

    def __init__(self, arm: armctl.Arm, law: armctl.Controller):
        self.law = law
        self.tau_max = arm.limits.tau_max

    def torque(self, state: armctl.State, setpoint: armctl.Setpoint) -> np.ndarray:
        return np.clip(self.law.torque(state, setpoint), -self.tau_max, self.tau_max)


LAWS = {
    "qp": armctl.ComputedTorqueQP,
    "lqr, clipped": lambda arm: Clipped(arm, armctl.LQR(arm)),
    "mpc": armctl.MPC,
}
TIMED_TICKS = 2000


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--motions", type=int, default=200)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "predictive_control.md")
    args = parser.parse_args()
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    with tempfile.TemporaryDirectory() as folder:
        arms = {name: serial_arm(Path(folder), BENT[name]) for name in ("six joints", "redundant")}
        arms = {"robot_arm_3dof": armctl.load("robot_arm_3dof"), **arms}
        text = "\n\n".join([study(arms, args.motions), cost(arms)]) + "\n"
    args.out.write_text(text, encoding="utf-8")
    print(text)


def study(arms: dict[str, armctl.Arm], motions: int) -> str:
    rows = []
    for name, arm in arms.items():
        rng = np.random.default_rng(11)
        cases = [(SHARES[k % len(SHARES)], *arm.limits.random(arm.home, 2, rng)) for k in range(motions)]
        clipped = np.array(
            [tip_error(arm, lambda weak: Clipped(weak, armctl.ComputedTorque(weak)), *case)[0] for case in cases]
        )
        for law, make in LAWS.items():
            found = np.array([tip_error(arm, make, *case) for case in cases])
            ratio = found[:, 0] / clipped
            pooled = np.sqrt(np.sum(found[:, 0] ** 2) / np.sum(clipped**2))
            quantiles = [f"{np.quantile(ratio, p):.2f}" for p in (0.5, 0.9, 1.0)]
            rows.append([name, law, f"{pooled:.2f}", *quantiles, f"{max(found[:, 1].max(), 0.0):.1e}"])
    columns = ["arm", "law", "RMS / clipped", "median", "90 %", "largest", "outside of joint limits, rad"]
    title = f"RMS error of the tip relative to clipped computed torque, {motions} motions of each arm"
    return titled_table(title, columns, rows)


def tip_error(arm: armctl.Arm, make, share: float, start: np.ndarray, goal: np.ndarray) -> tuple[float, float]:
    """The RMS error of the tip, m, and the largest distance, rad, to the limits of the joints, positive outside."""
    motion = armctl.move_j(arm, start, goal)
    setpoints = motion.sample(np.arange(0.0, motion.duration, 0.002))
    rest = np.zeros(arm.n)
    steady = np.max([np.abs(arm.inverse_dynamics(q, v, rest)) for q, v in zip(setpoints.q, setpoints.v, strict=True)], axis=0)
    moving = np.max([np.abs(arm.inverse_dynamics(*each)) for each in zip(*setpoints[:3], strict=True)], axis=0)
    tau_max = np.minimum(arm.limits.tau_max, steady + share * (moving - steady))
    weak = arm.with_limits(replace(arm.limits, tau_max=tau_max))
    log = armctl.simulate(weak, make(weak), motion, armctl.Plant(timestep=0.001), dwell=0.5)
    outside = np.maximum(log.q - arm.limits.q_max, arm.limits.q_min - log.q).max()
    return float(np.sqrt(np.mean(np.sum((log.tip - log.tip_ref) ** 2, axis=1)))), float(outside)


def cost(arms: dict[str, armctl.Arm]) -> str:
    """The time of one call while the plan has active limits, by the clock of the process."""
    rows = []
    for name, arm in arms.items():
        holding = np.abs(arm.gravity(arm.home))
        law = armctl.MPC(arm.with_limits(replace(arm.limits, tau_max=0.6 * arm.limits.tau_max + 0.2 * holding)))
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
