"""Measuring a real arm: geometry from measured poses, and position servos from positions; MuJoCo moves the real arms."""

import argparse
import copy
import sys
import tempfile
import warnings
from pathlib import Path

import mujoco
import numpy as np
from markdown_table import titled_table
from scipy.spatial.transform import Rotation

import armctl
from armctl.lab.iso9283_figures import accuracy

sys.path.append(str(Path(__file__).parent.parent / "tests" / "helpers"))
from synthetic import BENT, serial_arm

RUNS = 200
POSES = 30
NOISE_M = 1e-4
OFFSET_RAD = 5e-3  # standard deviations of the true errors
LENGTH_M = 1e-3
SECONDS = 30.0
TICK_S = 0.02
STRIBECK_SPEED = 0.1  # rad/s
GAINS = ("armature", "stiffness", "damping", "coulomb_friction")
DESK_AXES = ("0 0 1", "0 1 0", "0 1 0", "0 1 0", "0 0 1")
DESK_RANGES = (1.9, 1.7, 1.7, 1.6, 2.7)
DESK_LENGTHS_M = np.array([0.06, 0.115, 0.135, 0.06, 0.1])
DESK_MASSES_KG = np.array([0.15, 0.13, 0.11, 0.08, 0.12])
UNKNOWNS = {
    "panda": [f"joint{i} offset" for i in range(1, 7)] + [f"{frame} {axis}" for frame in ("base", "tool") for axis in "xyz"],
    "ur5e": [f"{joint}_joint offset" for joint in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2")]
    + ["base x", "base y", "base z", "tool x", "tool y", "shoulder_lift_joint y", "elbow_joint z"],
    "six joints": [f"j{i} offset" for i in range(5)] + ["base x", "base y", "base z", "tool x", "tool z", "j1 x", "j3 y"],
    "redundant": [f"j{i} offset" for i in range(6)] + ["base x", "base y", "base z", "tool x", "tool y", "tool z"],
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--runs", type=int, default=RUNS)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "calibration.md")
    args = parser.parse_args()
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    text = "\n\n".join([geometry(args.seed, args.runs), servos(args.seed)]) + "\n"
    args.out.write_text(text, encoding="utf-8")
    print(text)


def geometry(seed: int, runs: int) -> str:
    """Twelve unknowns from positions of the tip, on two robots and two synthetic arms."""
    rows = []
    for name, unknowns in UNKNOWNS.items():
        with tempfile.TemporaryDirectory() as folder:
            arm = serial_arm(Path(folder), BENT[name]) if name in BENT else armctl.load(name)
        poses = armctl.calibration_poses(arm, POSES, parameters=unknowns, seed=seed)
        rng = np.random.default_rng([seed, len(rows)])
        inside = np.zeros(len(unknowns))
        errors = []
        before = []
        after = []
        for _ in range(runs):
            true = np.array([rng.normal(0.0, OFFSET_RAD if each.endswith("offset") else LENGTH_M) for each in unknowns])
            real = RealArm(arm, dict(zip(unknowns, true, strict=True)))
            measured = real.tips(poses.q) + rng.normal(0.0, NOISE_M, (POSES, 3))
            found = armctl.calibrate_geometry(arm, poses.q, measured, parameters=unknowns)
            value = dict(zip(found.names, found.intervals, strict=True))
            inside += [value[each][0] <= x <= value[each][1] for each, x in zip(unknowns, true, strict=True)]
            fresh = rng.uniform(0.9 * arm.limits.q_min, 0.9 * arm.limits.q_max, (100, arm.n))
            corrected = found.applied_to(arm)
            errors.append(np.sqrt(np.mean(np.sum((corrected.fk_many(fresh)[0] - real.tips(fresh)) ** 2, axis=1))))
            cycles = real.tips(fresh[:5]) + rng.normal(0.0, NOISE_M, (30, 5, 3))
            before.append(accuracy(cycles - arm.fk_many(fresh[:5])[0]).accuracy)
            after.append(accuracy(cycles - corrected.fk_many(fresh[:5])[0]).accuracy)
        share = 100 * inside / runs
        rows.append(
            [
                name,
                poses.condition_number.__format__(".1f"),
                f"{1e3 * np.sqrt(np.mean(np.square(errors))):.3f} ({1e3 * max(errors):.3f})",
                f"{share.mean():.1f} ({share.min():.1f} to {share.max():.1f})",
                f"{1e3 * np.median(before):.2f}",
                f"{1e3 * np.median(after):.3f}",
            ]
        )
    columns = [
        "arm",
        "condition number",
        "tip error at 100 unseen poses, mm RMS (worst run)",
        "inside the 95 % interval, % of all (of each unknown)",
        "ISO 9283 AP before, mm",
        "after, mm",
    ]
    return titled_table(f"Geometry: 12 unknowns, {POSES} poses, noise {1e3 * NOISE_M:g} mm, {runs} runs", columns, rows)


def servos(seed: int) -> str:
    """Desk arms of five joints whose lengths, masses and servos are drawn at random; the file has other servos."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for case, (backlash, stick) in enumerate(((0.0, 0.0), (0.15, 0.3), (0.15, 0.3), (0.5, 0.3))):
            desk = DeskArm(np.random.default_rng([seed, case]), np.deg2rad(backlash), stick)
            path = Path(folder) / f"desk{case}.xml"
            path.write_text(desk.file(), encoding="utf-8")
            arm = armctl.load(path)
            recordings = [desk.recording(arm, seed=100 * seed + 10 * case + k) for k in range(2)]
            logs = [armctl.Log.from_positions(TICK_S, q, command, joint_names=arm.joint_names) for command, q, _ in recordings]
            found = armctl.identify_servo(arm, logs[0], judge=logs[1], source=path)
            _, q, exact = recordings[1]
            error = np.linalg.norm(found.positions(logs[1])[15:] - q[15:])
            off = [100 * np.abs(getattr(found.parameters, name) / desk.true[name] - 1) for name in GAINS]
            hidden = [name for name in found.unseen if name.endswith("armature")]
            shown = np.array([f"{joint} armature" not in found.unseen for joint in arm.joint_names])
            rows.append(
                [
                    f"{backlash:g} deg, {100 * stick:.0f} %",
                    f"{1e3 * found.judge_file_rms.max():.1f}",
                    f"{1e3 * found.judge_rms.max():.2f}",
                    f"{error / np.linalg.norm((q - exact)[15:]):.2f}",
                    *(f"{each[shown].max():.1f}" for each in off),
                    f"{100 * abs(found.parameters.delay / desk.delay - 1):.1f}",
                    ", ".join(hidden) or "none",
                ]
            )
    columns = [
        "backlash, stick friction above Coulomb friction",
        "unseen motion, file: mrad RMS",
        "identified",
        "over encoder noise",
        *(f"{name.split('_')[0]}, % off" for name in GAINS),
        "delay, % off",
        "not shown",
    ]
    return titled_table("Servos: 30 s at 50 Hz, encoders of 12 bits; the worst joint", columns, rows)


class DeskArm:
    """An arm like an SO-101 whose servos, delay and gears are known to this class only."""

    def __init__(self, rng: np.random.Generator, backlash: float, stick: float):
        self.lengths = DESK_LENGTHS_M * rng.uniform(0.8, 1.2, 5)
        self.masses = DESK_MASSES_KG * rng.uniform(0.8, 1.2, 5)
        self.backlash = backlash
        self.stick = stick
        self.delay = rng.uniform(0.01, 0.06)
        self.true = {
            "armature": 0.028 * rng.uniform(0.7, 1.4, 5),
            "stiffness": 18.0 * rng.uniform(0.8, 1.25, 5),
            "damping": 0.6 * rng.uniform(0.7, 1.3, 5),
            "coulomb_friction": 0.05 * rng.uniform(0.5, 1.5, 5),
        }
        self.offset = rng.normal(0.0, 0.01, 5)

    def file(self) -> str:
        """The file of its maker: other servos, no gears."""
        return self._text(np.full(5, 0.02), np.full(5, 25.0), np.full(5, 1.0), np.full(5, 0.03), 0.0)

    def recording(self, arm: armctl.Arm, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Commands, what the encoders read, and what encoders without steps would read, (T, 5) rad each."""
        motion = armctl.excitation(arm, for_="arm", duration=SECONDS, seed=seed)
        command = motion.sample(np.arange(0.0, SECONDS, TICK_S)).q
        model = mujoco.MjModel.from_xml_string(self._text(*self.true.values(), self.backlash))
        model.opt.timestep = 0.0005
        steps = round(TICK_S / model.opt.timestep)
        lag = self.delay / model.opt.timestep
        data = mujoco.MjData(model)
        servo = [model.joint(f"j{i}").qposadr[0] for i in range(5)]
        dof = [model.joint(f"j{i}").dofadr[0] for i in range(5)]
        data.qpos[servo] = command[0]
        exact = []
        for tick in range(-100, len(command)):
            if tick >= 0:
                exact.append(data.qpos[servo] + self.offset)
            for step in range(steps):
                data.ctrl[:] = command[max(0, int((tick * steps + step - lag) // steps))]
                v = data.qvel[dof]
                stuck = np.exp(-((v / STRIBECK_SPEED) ** 2)) * np.tanh(v / (0.1 * STRIBECK_SPEED))
                data.qfrc_applied[dof] = -self.stick * self.true["coulomb_friction"] * stuck
                mujoco.mj_step(model, data)
        count = 2 * np.pi / 4096
        return command, np.round(np.array(exact) / count) * count, np.array(exact)

    def _text(self, armature, stiffness, damping, friction, backlash: float) -> str:
        bodies = ""
        ends = ""
        motors = ""
        below = 0.05
        for i, (axis, limit) in enumerate(zip(DESK_AXES, DESK_RANGES, strict=True)):
            servo = f'axis="{axis}" range="-{limit} {limit}" armature="{armature[i]}" frictionloss="{friction[i]}"'
            bodies += f'<body name="l{i}" pos="0 0 {below}"><joint name="j{i}" {servo}/>'
            ends += "</body>"
            if backlash:
                gap = f'axis="{axis}" range="{-backlash / 2} {backlash / 2}" damping="0.001" armature="1e-4"'
                bodies += (
                    f'<geom size="0.01" mass="0.001" contype="0"/><body><joint name="gap{i}" {gap} solreflimit="0.004 1"/>'
                )
                ends += "</body>"
            side = 0.03 if i == 4 else 0.0  # the gripper is beside the axis of the wrist
            below = self.lengths[i]
            shape = f'type="capsule" fromto="{side} 0 0 {side} 0 {below}" size="0.02" mass="{self.masses[i]}"'
            bodies += f'<geom {shape} contype="0" conaffinity="0"/>'
            gains = f'kp="{stiffness[i]}" kv="{damping[i]}" forcerange="-3 3" ctrlrange="-{limit} {limit}"'
            motors += f'<position joint="j{i}" {gains}/>'
        return (
            '<mujoco><compiler angle="radian" autolimits="true"/><option timestep="0.002" integrator="implicitfast"/>'
            f'<worldbody>{bodies}<site name="tip"/>{ends}</worldbody><actuator>{motors}</actuator></mujoco>'
        )


class RealArm:
    """An arm whose model file is wrong, moved by MuJoCo."""

    def __init__(self, arm: armctl.Arm, errors: dict[str, float]):
        self.arm = arm
        self.model = copy.copy(arm.model)
        self.data = mujoco.MjData(self.model)
        self.tip = arm.T_body_tip.position.copy()
        bodies = dict(zip(arm.joint_names, arm.model.jnt_bodyid[list(arm.joint_map.joints)], strict=True))
        base = int(arm.model.body_parentid[bodies[arm.joint_names[0]]]) or bodies[arm.joint_names[0]]
        for name, value in errors.items():
            where, what = name.split()
            if what == "offset":
                body = bodies[where]
                turn = Rotation.from_rotvec(value * arm.model.jnt_axis[arm.model.body_jntadr[body]])
                own = Rotation.from_quat(self.model.body_quat[body], scalar_first=True)
                self.model.body_quat[body] = (own * turn).as_quat(scalar_first=True)
            elif where == "tool":
                self.tip["xyz".index(what)] += value
            else:
                self.model.body_pos[base if where == "base" else bodies[where]]["xyz".index(what)] += value

    def tips(self, q: np.ndarray) -> np.ndarray:
        """(K, 3) m, where the tip is."""
        found = []
        for row in q:
            self.data.qpos[:] = self.arm.qpos(row)
            mujoco.mj_kinematics(self.model, self.data)
            body = self.arm.tip_body
            found.append(self.data.xpos[body] + self.data.xmat[body].reshape(3, 3) @ self.tip)
        return np.array(found)


if __name__ == "__main__":
    main()
