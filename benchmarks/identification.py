"""Identification: tracking before and after with models that are 20 % wrong, friction, consistency, and a real recording."""

import argparse
import copy
import tempfile
import time
import warnings
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
from controllers import quintic
from markdown_table import markdown_table

import armctl

ROBOTS = ("panda", "ur5e", "iiwa14", "xarm7")
SYNTHETIC = "six joints"
SHARE = 0.2
COULOMB_SHARE = 0.02  # of the torque limits
ENCODER_NOISE = 1e-5  # rad
TORQUE_NOISE_SHARE = 2e-3  # of the torque limits
TICK_S = 0.001
LENGTHS_M = (0.3, 0.25, 0.2, 0.12, 0.1, 0.08)
AXES = ("0 0 1", "0 1 0", "0 1 0", "0 0 1", "0 1 0", "0 0 1")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--recording", type=Path, help="a CSV file of a real Panda without hand")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "identification.md")
    args = parser.parse_args()
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    with tempfile.TemporaryDirectory() as folder:
        arms = {name: armctl.load(name) for name in ROBOTS} | {SYNTHETIC: synthetic(Path(folder))}
    parts = [simulated(arms, args.seeds)]
    if args.recording:
        parts.append(recorded(args.recording))
    text = "\n\n".join(parts) + "\n"
    args.out.write_text(text, encoding="utf-8")
    print(text)


def synthetic(folder: Path) -> armctl.Arm:
    """An arm of boxes that is in no collection of models."""
    body = ""
    for i, (length, axis) in enumerate(zip(LENGTHS_M, AXES, strict=True)):
        offset = 0.15 if i == 0 else LENGTHS_M[i - 1]
        body += f'<body pos="0 0 {offset}"><joint name="j{i}" axis="{axis}" range="-2.8 2.8" damping="0.5" armature="0.05"/>'
        body += f'<geom type="box" size="0.03 0.04 {length / 2 - 0.03}" pos="0.01 0 {length / 2}" density="3000"/>'
    body += '<site name="tip"/>' + "</body>" * len(LENGTHS_M)
    limits = (80, 80, 60, 30, 20, 15)
    motors = "".join(f'<motor joint="j{i}" ctrlrange="-{limit} {limit}"/>' for i, limit in enumerate(limits))
    key = '<keyframe><key name="home" qpos="0 0.4 0.9 0 0.6 0"/></keyframe>'
    path = folder / "arm.xml"
    path.write_text(f"<mujoco><worldbody>{body}</worldbody><actuator>{motors}</actuator>{key}</mujoco>", encoding="utf-8")
    return armctl.load(path)


def changed(arm: armctl.Arm, seed: int, coulomb: float) -> armctl.Arm:
    """The arm with masses, centres, inertias, rotor inertias and damping up to 20 % wrong, and with dry friction added."""
    rng = np.random.default_rng(seed)
    model = copy.copy(arm.model)
    for body in range(1, model.nbody):
        model.body_mass[body] *= 1 + SHARE * rng.uniform(-1, 1)
        model.body_ipos[body] *= 1 + SHARE * rng.uniform(-1, 1, 3)
        moments = model.body_inertia[body] * (1 + SHARE * rng.uniform(-1, 1, 3))
        largest = int(moments.argmax())
        moments[largest] = min(moments[largest], 0.999 * (moments.sum() - moments[largest]))  # what a rigid body can have
        model.body_inertia[body] = moments
        model.body_simple[body] = 0
        model.body_sameframe[body] = 0
    model.dof_simplenum[:] = 0
    model.geom_sameframe[:] = 0
    model.site_sameframe[:] = 0
    model.dof_armature[arm.dof_adr] *= 1 + SHARE * rng.uniform(-1, 1, arm.n)
    model.dof_damping[arm.dof_adr] *= 1 + SHARE * rng.uniform(-1, 1, arm.n)
    model.dof_frictionloss[arm.dof_adr] += coulomb * arm.limits.tau_max
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return replace(arm, model=model)


def run(real: armctl.Arm, model: armctl.Arm, motion: armctl.JointTrajectory) -> armctl.Log:
    """The real arm on the motion, by a controller that has the wrong model; no noise."""
    return armctl.simulate(real, armctl.ComputedTorqueObserver(model), motion, armctl.Plant(timestep=TICK_S), dwell=0.0)


def measured(log: armctl.Log, model: armctl.Arm, seed: int) -> armctl.Log:
    """A recording with noise and without velocities."""
    rng = np.random.default_rng(seed)
    q = log.q + ENCODER_NOISE * rng.standard_normal(log.q.shape)
    tau = log.tau + TORQUE_NOISE_SHARE * model.limits.tau_max * rng.standard_normal(log.tau.shape)
    return replace(log, q=q, tau=tau, v=np.full_like(q, np.nan))


def error(real: armctl.Arm, model: armctl.Arm, observer: bool) -> float:
    """rad, RMS of computed torque on the motion of the controllers' benchmark."""
    controller = armctl.ComputedTorqueObserver(model) if observer else armctl.ComputedTorque(model)
    log = armctl.simulate(real, controller, quintic(model), armctl.Plant(timestep=TICK_S))
    return armctl.Report.from_log(log).joint_rms_rad


def possible_links(inertia: np.ndarray) -> int:
    """Links whose pseudo-inertia is positive definite, from its leading minors."""
    count = 0
    for m, hx, hy, hz, xx, xy, yy, xz, yz, zz in inertia:
        moments = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        h = np.array([[hx], [hy], [hz]])
        matrix = np.block([[np.trace(moments) / 2 * np.eye(3) - moments, h], [h.T, np.array([[m]])]])
        count += all(np.linalg.det(matrix[:k, :k]) > 0 for k in range(1, 5))
    return count


def simulated(arms: dict[str, armctl.Arm], seeds: int) -> str:
    rows = []
    for name, arm in arms.items():
        motion = armctl.excitation(arm, duration=5.0, for_="arm")
        for coulomb in (0.0, COULOMB_SHARE):
            for seed in range(seeds):
                real = changed(arm, seed, coulomb)
                log = measured(run(real, arm, motion), arm, seed)
                began = time.process_time()
                found = armctl.identify(arm, log)
                seconds = time.process_time() - began
                row = [
                    name,
                    f"{100 * coulomb:g} %",
                    str(seed),
                    f"{error(real, arm, False):.1e}",
                    f"{error(real, arm, True):.1e}",
                ]
                after = [found.reason[:60], "-"]
                if found:
                    known = found.applied_to(arm)
                    after = [f"{error(real, known, False):.1e}", f"{error(real, known, True):.1e}"]
                row += after
                off = 100 * np.abs(found.coulomb_friction / real.model.dof_frictionloss[arm.dof_adr] - 1) if coulomb else []
                row.append(f"{max(off):.1f}" if coulomb else "-")
                row += [f"{possible_links(found.inertia)}/{arm.n}", f"{seconds:.1f}"]
                rows.append(row)
                print(*row, sep=" | ", flush=True)
    head = [
        "arm",
        "Coulomb",
        "seed",
        "CT before",
        "observer before",
        "CT after",
        "observer after",
    ]
    head += ["Coulomb error, %", "possible links", "fit, s CPU"]
    return "RMS in rad; models up to 20 % wrong, 5 s of data.\n\n" + markdown_table(head, rows)


def recorded(path: Path) -> str:
    arm = armctl.load("franka_emika_panda/panda_nohand")
    rows = []
    for friction in ("coulomb+viscous", "stribeck"):
        for holdout in (0.2, 0.35, 0.5):
            found = armctl.identify(arm, path, friction, holdout=holdout)
            check = found.validation
            rows.append([friction, f"{holdout:g}", "identified", " ".join(f"{x:.2f}" for x in check.rms)])
            if friction == "coulomb+viscous":
                rows.append([friction, f"{holdout:g}", "model", " ".join(f"{x:.2f}" for x in check.model_rms)])
    head = ("friction", "held out", "torques by", "residual RMS of the joints, N m")
    return "A recorded Panda without hand; torques that the fit has not seen.\n\n" + markdown_table(head, rows)


if __name__ == "__main__":
    main()
