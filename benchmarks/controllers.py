"""Controllers on different plants: tracking, ISO 9283, identification, and the time of a tick.

    python benchmarks/controllers.py [--out benchmarks/results/controllers.md]

All at 1 ms. Each joint moves 0.6 rad (less if the path is blocked) and back in 2 s each, on quintics.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
from markdown_table import titled_table

import armctl
from armctl import JointTrajectory
from armctl.control import CONTROLLERS, controller_by_name

ROBOTS = ("panda", "ur5e", "iiwa14", "xarm7")
TICK_S = 0.001
LEG_S = 2.0
FRICTION_SHARE = 0.02  # Coulomb friction as a share of the torque limit; half as much viscous friction per rad/s
ENCODER_NOISE_RAD = 1e-5
PLANTS = ("nominal", "near-continuous", "1 kg unknown", "everything at once")
EXACT = ("nominal", "near-continuous")  # computed torque needs no observer there
TARGETS = {  # joint RMS, rad, of computed torque with an observer
    ("1 kg unknown", "panda"): "4.5e-5",
    ("1 kg unknown", "iiwa14"): "1e-3",
    ("1 kg unknown", ""): "1e-4",
    ("everything at once", "iiwa14"): "5e-3",
    ("everything at once", ""): "2e-4",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "controllers.md")
    args = parser.parse_args()
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    arms = {name: armctl.load(name) for name in ROBOTS}
    sections = [tracking(arms), robustness(arms), observed(arms), iso(arms["panda"]), identification(arms), speed(arms)]
    text = "\n\n".join(sections) + "\n"
    args.out.parent.mkdir(exist_ok=True)
    args.out.write_text(text, encoding="utf-8")
    print(text)


def quintic(arm: armctl.Arm) -> JointTrajectory:
    """Out and back on the path of `armctl compare`, each leg a rest-to-rest quintic."""
    way = armctl.out_and_back(arm)
    there = way(0.5 * way.duration).q - arm.home
    leg = np.zeros((6, arm.n))
    leg[3] = 10 * there / LEG_S**3
    leg[4] = -15 * there / LEG_S**4
    leg[5] = 6 * there / LEG_S**5
    out = leg.copy()
    out[0] = arm.home
    back = -leg
    back[0] = arm.home + there
    return JointTrajectory(LEG_S * np.arange(3), np.stack([out, back]), arm.joint_names, arm.limits)


def with_friction(plant: armctl.Plant, arm: armctl.Arm) -> armctl.Plant:
    """The plant with dry and viscous friction at the joints."""
    dry = FRICTION_SHARE * arm.limits.tau_max
    return replace(plant, coulomb_friction=dry, viscous_friction=0.5 * dry)


def plants(arm: armctl.Arm) -> dict[str, armctl.Plant]:
    """The plants of the tables; the last one is `all` of the command line."""
    nominal = armctl.Plant(timestep=TICK_S)
    everything = replace(nominal, payload=1.0, mass_scale=1.2, delay=2, encoder_noise=ENCODER_NOISE_RAD)
    variants = (
        nominal,
        replace(nominal, continuous=True),
        replace(nominal, payload=1.0),
        with_friction(everything, arm),
    )
    return dict(zip(PLANTS, variants, strict=True))


def tracking(arms: dict[str, armctl.Arm]) -> str:
    rows = []
    for plant in PLANTS:
        reports = {
            robot: armctl.compare(arm, list(CONTROLLERS), quintic(arm), [plants(arm)[plant]], configurations=0)
            for robot, arm in arms.items()
        }
        for i, name in enumerate(CONTROLLERS):
            rows.append([plant, name, *(shown(reports[robot][i]) for robot in arms)])
    return titled_table("Joint error RMS, rad, while the reference moves", ["plant", "controller", *arms], rows)


def shown(report: armctl.Report) -> str:
    if report.log.failure:
        return "diverged"
    return "<1e-15" if report.joint_rms_rad < 1e-15 else f"{report.joint_rms_rad:.1e}"


def robustness(arms: dict[str, armctl.Arm]) -> str:
    plant = armctl.Plant(timestep=TICK_S)
    rows = []
    for name in CONTROLLERS:
        cells = []
        for arm in arms.values():
            found = armctl.margins(arm, name, 10, [plant])
            cells.append(f"{1e3 * found.delay.value:.1f} / {found.peak_sensitivity.value:.2f}")
        rows.append([name, *cells])
    return titled_table("Delay margin, ms / peak sensitivity Ms, worst of 10 configurations", ["controller", *arms], rows)


def observed(arms: dict[str, armctl.Arm]) -> str:
    """The error of computed torque on each plant, beside its target."""
    rows = []
    for robot, arm in arms.items():
        for plant in PLANTS:
            name = "computed-torque" if plant in EXACT else "computed-torque-observer"
            report = armctl.compare(arm, [name], quintic(arm), [plants(arm)[plant]], configurations=0)[0]
            target = TARGETS.get((plant, robot), TARGETS.get((plant, ""), ""))
            if plant in EXACT:
                target = "max 1e-9" if plant == "nominal" else "max 5e-7"
            figures = shown(report), f"{report.joint_max_rad:.1e}", target, f"{report.chatter_nm:.1g}"
            rows.append([robot, plant, name, *figures])
    columns = ["robot", "plant", "controller", "joint RMS, rad", "joint max, rad", "target (RMS unless stated)", "chatter, N m"]
    return titled_table("Computed torque", columns, rows)


def iso(panda: armctl.Arm) -> str:
    nominal = armctl.Plant(encoder_noise=1e-5, timestep=TICK_S)
    loaded = replace(nominal, payload=1.0)
    log = armctl.simulate(panda, "computed-torque-observer", armctl.excitation(panda), loaded)
    known = armctl.identify_payload(panda, log).applied_to(panda)
    rows = []
    for what, arm, plant, target in (
        ("nothing unknown", panda, nominal, ("", "", "")),
        ("1 kg unknown", panda, loaded, ("10", "0.1", "0.35")),
        ("1 kg, identified", known, loaded, ("", "", "0.05")),
    ):
        f = armctl.iso9283_cycles(panda, controller_by_name("computed-torque-observer", arm), plant)
        values = f"{1e6 * f.pose_accuracy_m:.1f}", f"{f.stabilisation_time_s:.3f}", f"{1e3 * f.path_accuracy_m:.3f}"
        pairs = [f"{value} ({bound})" if bound else value for value, bound in zip(values, target, strict=True)]
        rows.append([what, pairs[0], f"{1e6 * f.pose_repeatability_m:.1f}", pairs[1], f"{1e6 * f.overshoot_m:.0f}", pairs[2]])
    columns = ["Panda, encoder noise 1e-5 rad", "AP, um (target)", "RP, um", "stable after, s (target)", "overshoot, um"]
    title = f"ISO 9283: 30 cycles, full speed, cube of {1e3 * f.cube_m:.0f} mm, stable within 0.1 mm"
    return titled_table(title, [*columns, "AT, mm (target)"], rows)


def identification(arms: dict[str, armctl.Arm]) -> str:
    rows = []
    rng = np.random.default_rng(0)
    for robot, arm in arms.items():
        motion = armctl.excitation(arm, payload=2.0)
        row = [robot, f"{motion.duration:.1f}"]
        loaded = armctl.Plant(payload_center=[0.02, 0.01, 0.05], timestep=TICK_S)
        for unloaded in (loaded, replace(with_friction(loaded, arm), encoder_noise=ENCODER_NOISE_RAD)):
            errors = []
            for mass in (0.5, 1.0, 2.0):
                plant = replace(unloaded, payload=mass)
                log = armctl.simulate(arm, "computed-torque-observer", motion, plant)
                q = log.q + plant.encoder_noise * rng.standard_normal(log.q.shape)
                v = np.gradient(q, log.dt, axis=0)
                found = armctl.identify_payload(arm, replace(log, q=q, v=v))
                errors.append(abs(found.mass / mass - 1) if found.ok else np.nan)
            row.append(f"{100 * max(errors):.2f}")
        rows.append(row)
    columns = ["robot", "motion, s", "worst error, % (target 1)", "with friction and noise, % (target 3)"]
    return titled_table("Payloads of 0.5, 1 and 2 kg identified from one run", columns, rows)


def speed(arms: dict[str, armctl.Arm]) -> str:
    bundled = armctl.load("robot_arm_3dof")
    rows = [speed_of(name, arm) for name, arm in {**arms, "robot_arm_3dof": bundled}.items()]
    columns = ["robot", "rnea, us", "tick of computed torque, us", "ratio (target 8)"]
    columns += ["bare mj_step loop, us", "simulate, computed torque, us", "ratio (target 2.0)", "simulate, PD, us", "ratio"]
    return titled_table("What a tick costs: the best of interleaved rounds", columns, rows)


def speed_of(name: str, arm: armctl.Arm) -> list:
    controller = armctl.ComputedTorque(arm)
    pd = armctl.PD(arm)
    motion = quintic(arm)
    plant = armctl.Plant(timestep=TICK_S)
    ticks = len(armctl.simulate(arm, controller, motion, plant))
    model = plant.model(arm)
    data = mujoco.MjData(model)
    step = mujoco.mj_step
    setpoint = motion(0.5)
    state = armctl.State(setpoint.q, setpoint.v, 0.5, TICK_S)
    pin_model = arm.pinocchio_model.pin_model
    pin_data = pin_model.createData()

    def bare() -> None:
        mujoco.mj_resetData(model, data)
        data.qpos[:] = arm.home_qpos
        data.ctrl[:] = arm.home_ctrl
        for _ in range(ticks):
            step(model, data)

    def simulated() -> None:
        armctl.simulate(arm, controller, motion, plant)

    def simulated_pd() -> None:
        armctl.simulate(arm, pd, motion, plant)

    def rnea() -> None:
        for _ in range(1000):
            pin.rnea(pin_model, pin_data, setpoint.q, setpoint.v, setpoint.a)

    def tick() -> None:
        for _ in range(1000):
            controller.torque(state, setpoint)

    best = dict.fromkeys((bare, simulated, simulated_pd, rnea, tick), np.inf)
    for _ in range(15):
        for what in best:
            best[what] = min(best[what], seconds(what))
    rnea_us = 1e3 * best[rnea]
    tick_us = 1e3 * best[tick]
    bare_us = 1e6 * best[bare] / ticks
    simulated_us = 1e6 * best[simulated] / ticks
    pd_us = 1e6 * best[simulated_pd] / ticks
    figures = [rnea_us, tick_us, tick_us / rnea_us, bare_us, simulated_us, simulated_us / bare_us, pd_us, pd_us / bare_us]
    return [name, *(f"{x:.2f}" for x in figures)]


def seconds(what: Callable[[], None]) -> float:
    began = time.perf_counter()
    what()
    return time.perf_counter() - began


if __name__ == "__main__":
    main()
