"""Laws on arms whose motors, gears and encoders are as they are: error, chatter, and delay margins, predicted and simulated.

    python benchmarks/actuators.py [--robots robot_arm_3dof panda ur5e] [--pictures docs/pictures]

The springs have a locked-rotor resonance of 8 Hz. The simulated margin is the least further delay of the commands with which a
small deviation from rest grows, in control periods of 1 ms; the predicted one follows from the linear loop, rounded up to them.
Steps of an encoder, dry friction and gaps are not linear: with them, a small deviation neither grows nor decays, and the
column is empty. Chatter is that in motion, with its prediction by `Loop.chatter`, and at rest, where steps of an encoder are no
noise. A law with a least damping ratio below 0.1 vibrates: `margins` says so. Tuned gains are those of `armctl.tune` for the
plant, with a delay margin of 3 ms and a peak sensitivity of 1.7. Then errors of a repeated motion that `IterativeLearning`
learns, on a plant with a payload and friction that no law knows.
"""

from __future__ import annotations

import argparse
import math
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from markdown_table import titled_table

import armctl
from armctl import Controller

TICK_S = 0.001
RESONANCE_HZ = 8.0
KICK_RAD = 1e-6  # the deviation that shows whether a loop is stable
MAX_RATIO = 0.9  # of a vibration to that of a second before
LIMIT_CYCLE_RAD = 30 * KICK_RAD  # a vibration from such a kick grew to it, and is bounded by the torque limits only
HELD_S = 4.0
MAX_TICKS = 60
TUNED = ("pd-gravity", "computed-torque-observer")
TUNED_MARGIN_S = 0.003
TUNED_CONFIGURATIONS = 5
LEARNT = ("pd", "pd-gravity", "computed-torque", "computed-torque-observer")
REPETITIONS = 10


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--robots", nargs="+", default=["robot_arm_3dof", "panda", "ur5e"])
    parser.add_argument("--pictures", type=Path, help="folder for the pictures of docs/why-not.md")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "actuators.md")
    args = parser.parse_args()
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    tables = []
    for robot in args.robots:
        arm = armctl.load(robot)
        rows = [row for name, plant in plants(arm).items() for row in measured(arm, name, plant)]
        head = ["plant", "law", "joint RMS, mrad", "chatter predicted, N m", "moving", "at rest", "least damping", "Ms"]
        head += ["margin predicted, ms", "simulated, ms"]
        tables.append(titled_table(f"{robot}, control period {1e3 * TICK_S:g} ms", head, rows))
        print(tables[-1], flush=True)
    learnt = [learnt_row(robot, law) for robot in args.robots for law in LEARNT]
    head = [
        "arm",
        "law",
        "first joint RMS, mrad",
        f"after {REPETITIONS} repetitions",
        "largest of them after the first",
        "ratio",
    ]
    tables.append(titled_table(f"Learning over {REPETITIONS} repetitions", head, learnt))
    print(tables[-1], flush=True)
    args.out.write_text("\n\n".join(tables) + "\n")
    if args.pictures is not None:
        draw(args.pictures)


def springs(arm: armctl.Arm) -> dict[str, Any]:
    """Springs at which each link has the resonance, and rotors: the model's armature, or half of what they move."""
    total = arm.mass_matrix(arm.home).diagonal()
    armature = arm.model.dof_armature[arm.dof_adr]
    link = np.maximum(total - armature, 0.1 * total)
    rotor = np.where(armature > 0.0, armature, 0.5 * link)
    return {"elasticity": link * (2 * np.pi * RESONANCE_HZ) ** 2, "rotor_inertia": rotor}


def plants(arm: armctl.Arm) -> dict[str, armctl.Plant]:
    """Plants with one imperfection each."""
    ideal = armctl.Plant(timestep=TICK_S)
    return {
        "ideal": ideal,
        "motor lag 3 ms": replace(ideal, motor=0.003),
        "commands 3 ticks late": replace(ideal, delay=3),
        "jitter up to 2 ticks": replace(ideal, jitter=2),
        "sensors 2 ticks late": replace(ideal, sensor_delay=2),
        "encoder of 14 bits": replace(ideal, encoder_bits=14),
        "LuGre friction, 2 % of the torque": replace(ideal, friction="lugre", coulomb_friction=0.02 * arm.limits.tau_max),
        "backlash 1 mrad": replace(ideal, backlash=1e-3, rotor_inertia=springs(arm)["rotor_inertia"]),
        "elastic joints": replace(ideal, **springs(arm)),
    }


def laws(arm: armctl.Arm, plant: armctl.Plant) -> Iterator[tuple[str, Controller]]:
    yield "pd-gravity", armctl.PDGravity(arm)
    yield "computed-torque", armctl.ComputedTorque(arm)
    yield "computed-torque-observer", armctl.ComputedTorqueObserver(arm)
    yield "computed-torque, low-pass 500 rad/s", armctl.TorqueFilter(arm, armctl.ComputedTorque(arm), armctl.LowPass(500.0))
    if np.any(plant.elasticity):
        yield "elastic-feedforward", armctl.ElasticFeedforward(arm, **springs(arm))
        yield "elastic-feedback", armctl.ElasticFeedback(arm, **springs(arm))
    if plant.jitter or plant.sensor_delay or plant.encoder_bits or plant.friction == "lugre" or np.any(plant.backlash):
        return  # gains are tuned for linear plants
    for law in TUNED:
        tuned = armctl.tune(arm, law, TUNED_MARGIN_S, configurations=TUNED_CONFIGURATIONS, plants=[plant])
        yield f"{law}, tuned" + ("" if tuned else " (bounds not met)"), tuned.controller


def measured(arm: armctl.Arm, name: str, plant: armctl.Plant) -> list[list[str]]:
    """A row for each law."""
    motion = armctl.move_j(arm, arm.home, arm.limits.clamp(arm.home + 0.3), speed=0.5)
    rows = []
    for law_name, law in laws(arm, plant):
        log = armctl.simulate(arm, law, motion, plant, dwell=0.5)
        report = armctl.Report.from_log(log)
        loop = armctl.linearize(arm, law, motion(motion.duration).q, plant)
        margins = loop.margins()
        predicted = "-" if margins else "unstable"
        if margins and margins.delay_margin < 1.0:
            predicted = f"{math.ceil(1e3 * margins.delay_margin):d}"
        error = "diverges" if log.failure else f"{1e3 * report.joint_rms_rad:.2g}"
        tau = log.tau[log.t < motion.duration]
        chatter = [loop.chatter(), tau[1:-1] - 0.5 * (tau[:-2] + tau[2:])]
        noise = [f"{np.sqrt(np.mean(each**2)):.2g}" if plant.encoder_bits else "-" for each in chatter]
        damping = loop.least_damped().damping_ratio
        rows.append([name, law_name, error, *noise, f"{report.chatter_nm:.2g}", f"{damping:.2g}" if margins else "-"])
        rows[-1] += [f"{margins.peak_sensitivity:.2f}", predicted]
        rows[-1].append(simulated_margin(arm, law, motion(motion.duration).q, plant))
    return rows


def learnt_row(robot: str, law: str) -> list[str]:
    """The errors of a motion of all joints, with a payload and dry friction of 2 % of the weakest joint's torque."""
    arm = armctl.load(robot)
    motion = armctl.move_j(arm, arm.home, arm.limits.clamp(arm.home + 0.4))
    plant = armctl.Plant(timestep=TICK_S, payload=0.3, coulomb_friction=0.02 * arm.limits.tau_max.min())
    learning = armctl.IterativeLearning(arm, motion)
    for _ in range(REPETITIONS + 1):
        learning.update(armctl.simulate(arm, law, learning.reference, plant))
    first, *others = learning.errors
    return [
        robot,
        law,
        f"{1e3 * first:.3g}",
        f"{1e3 * others[-1]:.2g}",
        f"{1e3 * max(others):.2g}",
        f"{first / others[-1]:.0f}",
    ]


def simulated_margin(arm: armctl.Arm, law: Controller, q: np.ndarray, plant: armctl.Plant) -> str:
    """The least further delay, ms, with which a small deviation grows."""
    if plant.encoder_bits or plant.friction == "lugre" or np.any(plant.backlash):
        return "-"
    if is_growing(arm, law, q, plant, 0):
        return "unstable"
    low = 0
    high = MAX_TICKS
    if not is_growing(arm, law, q, plant, high):
        return "-"
    while high - low > 1:
        middle = (low + high) // 2
        if is_growing(arm, law, q, plant, middle):
            high = middle
        else:
            low = middle
    return f"{1e3 * high * TICK_S:.0f}"


class Held:
    """A law with a constant torque added, so that the arm rests where it is."""

    name = "held"

    def __init__(self, law: Controller, holding_torque: np.ndarray):
        self.law = law
        self.holding_torque = holding_torque
        self.needs_deflection = getattr(law, "needs_deflection", False)
        self.offset: np.ndarray | None = None

    def torque(self, state: armctl.State, setpoint: armctl.Setpoint) -> np.ndarray:
        tau = np.asarray(self.law.torque(state, setpoint))
        if self.offset is None:
            self.offset = self.holding_torque - tau
        return tau + self.offset


def is_growing(arm: armctl.Arm, law: Controller, q: np.ndarray, plant: armctl.Plant, ticks: int) -> bool:
    """Whether a small deviation does not decay in some seconds. It is that of two runs, which begin with the same transient."""
    held = Held(law, armctl.linear_arm(arm, q, plant).holding_torque)
    sim = armctl.Simulation(arm, held, replace(plant, delay=plant.delay + ticks))
    sim.reset(q)
    at = q if held.needs_deflection else sim.measured_state.q  # where what the law controls rests: the links, or the motors
    runs = []
    for start in (q, q + KICK_RAD * np.random.default_rng(0).normal(size=arm.n)):
        sim.reset(start)
        held.offset = None
        log = sim.run(armctl.move_j(arm, at, at), dwell=HELD_S)
        if log.failure:
            return True
        runs.append(log.q)
    deviation = runs[1] - runs[0]
    quarter = len(deviation) // 4
    before, after = (np.ptp(part, axis=0).max() for part in (deviation[quarter : 2 * quarter], deviation[-quarter:]))
    return bool(after > LIMIT_CYCLE_RAD or (after > 0.01 * KICK_RAD and after > MAX_RATIO * before))


def draw(folder: Path) -> None:
    """One picture for each symptom of docs/why-not.md, each with its cause and its remedy on the bundled arm."""
    from matplotlib.figure import Figure

    arm = armctl.load("robot_arm_3dof")
    elastic = springs(arm)
    ideal = armctl.Plant(timestep=TICK_S)
    soft = replace(ideal, **elastic)
    sticky = replace(ideal, friction="lugre", coulomb_friction=0.5, stiction=4.0)
    coarse = replace(ideal, encoder_bits=10)
    late = replace(ideal, delay=12)
    weak = armctl.PDGravity(arm, bandwidth=12.0, damping_ratio=0.3)
    slow = armctl.move_j(arm, arm.home, arm.home + 0.2, speed=0.1)
    quick = armctl.move_j(arm, arm.home, arm.home + 0.4)
    stiff = armctl.ComputedTorqueObserver(arm)
    gravity = armctl.PDGravity(arm)
    feedforward = armctl.ElasticFeedforward(arm, **elastic)
    slower = armctl.PDGravity(arm, bandwidth=10.0)
    fine = replace(ideal, encoder_bits=18)
    cases = {
        "vibration": (quick, {"pd-gravity": (gravity, soft), "elastic-feedforward": (feedforward, soft)}),
        "offset": (quick, {"pd": (armctl.PD(arm), ideal), "pd-gravity": (gravity, ideal)}),
        "stick-slip": (slow, {"pd-gravity, bandwidth 12": (weak, sticky), "observer": (stiff, sticky)}),
        "limit-cycle": (slow, {"observer, 10 bits": (stiff, coarse), "observer, 18 bits": (stiff, fine)}),
        "instability": (quick, {"observer, 12 ms late": (stiff, late), "pd-gravity, bandwidth 10": (slower, late)}),
    }
    folder.mkdir(parents=True, exist_ok=True)
    for symptom, (motion, runs) in cases.items():
        figure = Figure(figsize=(6.4, 2.4), layout="constrained")
        axes = figure.subplots()
        for label, (law, plant) in runs.items():
            log = armctl.simulate(arm, law, motion, plant, dwell=1.0)
            axes.plot(log.t, 1e3 * (log.q - log.q_ref)[:, 1], label=label, linewidth=1.0)
        axes.set_xlabel("time, s")
        axes.set_ylabel("joint error, mrad")
        axes.legend(loc="upper right", fontsize=8)
        figure.savefig(folder / f"why_{symptom}.png", dpi=80)


if __name__ == "__main__":
    main()
