"""Unknown payloads and torque limits: an observer, a learnt payload, and a quadratic program, beside what they replace."""

import argparse
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from markdown_table import titled_table

import armctl
from armctl.control import controller_by_name

ROBOTS = {"panda": 1.0, "ur5e": 1.0, "iiwa14": 1.0, "xarm7": 0.5, "kinova_gen3": 0.5}  # kg
TICKS_S = (0.001, 0.002, 0.004)
CENTER_M = (0.03, 0.02, 0.05)
DISTURBED = {"encoder_noise": 1e-5, "velocity_noise": 1e-3, "delay": 1}
REACH_M = ((0.0, 0.4, 0.0), (0.0, 0.3, 0.0), (-0.1, 0.3, 0.1), (0.0, 0.2, 0.1))


class Repeated:
    """The same way out and back, three times."""

    def __init__(self, arm: armctl.Arm):
        goal = arm.limits.clamp(arm.home + 0.5 * np.random.default_rng(3).choice([-1, 1], arm.n))
        self.joint_names = arm.joint_names
        self.out = armctl.move_j(arm, arm.home, goal)
        self.back = armctl.move_j(arm, goal, arm.home)
        self.period = self.out.duration + self.back.duration + 0.4
        self.duration = 3 * self.period

    def __call__(self, t: float) -> armctl.Setpoint:
        return armctl.Setpoint(*(column[0] for column in self.sample(np.array([t]))[:3]))

    def sample(self, times: np.ndarray) -> armctl.Setpoint:
        phase = np.clip(times, 0.0, self.duration - 1e-9) % self.period
        out = self.out.sample(phase)
        back = self.back.sample(np.maximum(phase - self.out.duration - 0.2, 0.0))
        first = (phase < self.out.duration + 0.2)[:, None]
        return armctl.Setpoint(*(np.where(first, a, b) for a, b in zip(out[:3], back[:3], strict=True)))


class Clipped:
    """Computed torque, clipped at the limits of an arm."""

    name = "clipped"

    def __init__(self, arm: armctl.Arm):
        self.law = armctl.ComputedTorque(arm)
        self.tau_max = arm.limits.tau_max

    def torque(self, state: armctl.State, setpoint: armctl.Setpoint) -> np.ndarray:
        return np.clip(self.law.torque(state, setpoint), -self.tau_max, self.tau_max)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "payload_and_saturation.md")
    args = parser.parse_args()
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    arms = {name: armctl.load(name) for name in ROBOTS}
    text = "\n\n".join([learning(arms), saturation(arms), cost(arms["panda"])]) + "\n"
    args.out.write_text(text, encoding="utf-8")
    print(text)


def learning(arms: dict[str, armctl.Arm]) -> str:
    rows = []
    for name, arm in arms.items():
        motion = Repeated(arm)
        for dt in TICKS_S:
            row = [name, f"{1e3 * dt:g}"]
            for disturbances in ({}, DISTURBED):
                plant = armctl.Plant(timestep=dt, payload=ROBOTS[name], payload_center=CENTER_M, **disturbances)
                for law in ("computed-torque-observer", "computed-torque-learning"):
                    controller = controller_by_name(law, arm)
                    log = armctl.simulate(arm, controller, motion, plant)
                    third = log.t > 2 * motion.period
                    row.append(f"{np.sqrt(np.mean((log.q - log.q_ref)[third] ** 2)):.1e}")
                row.append(f"{100 * abs(controller.payload[0] / ROBOTS[name] - 1):.1f}")
            rows.append(row)
    laws = ["observer", "learning", "mass error, %"]
    columns = ["robot", "tick, ms", *laws, *(f"{law}, disturbed" for law in laws)]
    title = "Joint RMS, rad, of the third motion with an unknown payload; disturbed: sensor noise and a tick of delay"
    return titled_table(title, columns, rows)


def saturation(arms: dict[str, armctl.Arm]) -> str:
    """A straight line with a known payload, torque limits cut to between what holds the arm and what moves it."""
    rows = []
    for name in ("panda", "ur5e", "iiwa14"):
        arm = arms[name].with_payload(3 * ROBOTS[name] if name != "panda" else 2.0, (0.0, 0.0, 0.05))
        line = straight_line(arm)
        setpoints = line.sample(np.arange(0.0, line.duration, 0.002))
        tau_max = arm.limits.tau_max
        holding = max(np.abs(arm.gravity(q) / tau_max).max() for q in setpoints.q)
        moving = max(np.abs(arm.inverse_dynamics(*each) / tau_max).max() for each in zip(*setpoints[:3], strict=True))
        for share in (0.9, 0.7, 0.4):
            weak = arm.with_limits(replace(arm.limits, tau_max=(holding + share * (moving - holding)) * tau_max))
            row = [name, f"{share:g}"]
            for law in (Clipped(weak), armctl.ComputedTorqueQP(weak)):
                log = armctl.simulate(weak, law, line, armctl.Plant(timestep=0.001), dwell=1.0)
                row += [f"{1e3 * path_deviation(log):.3f}", f"{np.abs(log.tau_cmd / weak.limits.tau_max).max():.6f}"]
            rows.append(row)
    columns = ["robot", "share of the moving torque", "clipped: off the line, mm", "torque / limit", "qp: off the line, mm"]
    return titled_table("A straight line with too little torque", [*columns, "torque / limit, qp"], rows)


def straight_line(arm: armctl.Arm):
    start = arm.fk(arm.home)
    for offset in REACH_M:
        try:
            return armctl.move_l(arm, arm.home, armctl.Pose(start.position + np.array(offset), start.quat))
        except armctl.ArmctlError:
            continue
    raise SystemExit(f"{arm.name}: no straight line found")


def path_deviation(log: armctl.Log) -> float:
    along = log.tip_ref[-1] - log.tip_ref[0]
    along = along / np.linalg.norm(along)
    offset = log.tip - log.tip_ref[0]
    return float(np.linalg.norm(offset - np.outer(offset @ along, along), axis=1).max())


def cost(arm: armctl.Arm) -> str:
    still = np.zeros(arm.n)
    setpoint = armctl.Setpoint(arm.home, still + 0.1, still, still + 0.1, still)
    rows = []
    for name, offset in (
        ("computed-torque", 0.01),
        ("computed-torque-observer", 0.01),
        ("computed-torque-learning", 0.01),
        ("qp", 0.01),
        ("qp", 0.8),
    ):
        controller = controller_by_name(name, arm)
        q = arm.limits.clamp(arm.home + offset)
        best = np.inf
        for chunk in range(6):
            states = [armctl.State(q, still, 0.001 * (1000 * chunk + k), 0.001) for k in range(1000)]
            began = time.process_time()
            for state in states:
                controller.torque(state, setpoint)
            best = min(best, 1e3 * (time.process_time() - began))
        rows.append([name, "active" if offset > 0.1 else "", f"{best:.1f}"])
    return titled_table("One call of torque, Panda", ["controller", "limits", "CPU time, us"], rows)


if __name__ == "__main__":
    main()
