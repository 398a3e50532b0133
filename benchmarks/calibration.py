"""Measuring a real arm: geometry from measured poses, with errors that only MuJoCo's kinematics knows."""

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
from armctl.analysis.iso9283_figures import accuracy

sys.path.append(str(Path(__file__).parent.parent / "tests"))
from synthetic import BENT, serial_arm

RUNS = 200
POSES = 30
NOISE_M = 1e-4
OFFSET_RAD = 5e-3  # standard deviations of the true errors
LENGTH_M = 1e-3
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
    text = "\n\n".join([geometry(args.seed, args.runs)]) + "\n"
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
