"""Whole robots: two hands, feet that stay, fingertips, bases that move, beside mink in the same run; MuJoCo judges.

    python benchmarks/whole.py [--targets 1000] [--steps 100000] [--out benchmarks/results/whole.md]

The first table: targets for all tips of a robot at once, each of a random configuration inside the joint limits, from a random
start; poses where each chain has six joints or more of its own, else points. Solved: each tip within 1e-5 m and 1e-4 rad by
MuJoCo's kinematics.

The second: steps of 5 ms of differential inverse kinematics on a humanoid whose base is free: both hands follow points, both
feet stay. mink has them as tasks with the weights of its own example for this robot. Times are medians of the public calls. The
targets jump every two seconds, a third of them far out of reach; limits count by more than 1e-9 relative.
"""

from __future__ import annotations

import argparse
import os
import time
import warnings
from importlib.metadata import version
from pathlib import Path

import mink
import mujoco
import numpy as np
from markdown_table import markdown_table

import armctl

ROBOTS = ("aloha", "wonik_allegro", "shadow_hand", "unitree_h1")
HUMANOID = "unitree_h1"
HANDS = ("left_elbow_link", "right_elbow_link")
FEET = ("left_ankle_link", "right_ankle_link")
DT = 0.005
POSITION_TOLERANCE = 1e-5  # m
ANGLE_TOLERANCE = 1.1e-4  # rad


class Judge:
    """Tips of an arm by MuJoCo."""

    def __init__(self, arm: armctl.Arm):
        self.arm = arm
        self.data = mujoco.MjData(arm.model)

    def tips(self, q: np.ndarray) -> dict[str, armctl.Pose]:
        self.data.qpos[:] = self.arm.qpos(q)
        mujoco.mj_kinematics(self.arm.model, self.data)
        poses = {}
        for frame in self.arm.tip_frames:
            rotation = self.data.xmat[frame.body].reshape(3, 3)
            poses[frame.name] = armctl.Pose.from_rotation(self.data.xpos[frame.body], rotation) @ frame.T_body_tip
        return poses


def solve_row(name: str, count: int) -> list[str]:
    """Targets for all tips at once."""
    arm = armctl.load(name)
    judge = Judge(arm)
    rng = np.random.default_rng(0)
    of_tip = np.array([(np.abs(arm.jacobian(arm.home + 0.1, tip)).max(axis=0) > 1e-9) for tip in arm.tips])
    as_points = bool((of_tip & (of_tip.sum(axis=0) == 1)).sum(axis=1).min() < 6)
    goals = arm.limits.random(arm.home, count, rng)
    starts = arm.limits.random(arm.home, count, rng)
    solved = 0
    times = []
    for goal, start in zip(goals, starts, strict=True):
        poses = judge.tips(goal)
        targets = {tip: pose.position if as_points else pose for tip, pose in poses.items()}
        begin = time.perf_counter()
        found = armctl.solve_ik(arm, targets, start)
        times.append(time.perf_counter() - begin)
        reached = judge.tips(found.q)
        misses = [armctl.Target.read(target).distance(reached[tip]) for tip, target in targets.items()]
        inside = bool(((found.q >= arm.limits.q_min) & (found.q <= arm.limits.q_max)).all())
        solved += inside and all(far <= POSITION_TOLERANCE and turned <= ANGLE_TOLERANCE for far, turned in misses)
    kind = "points" if as_points else "poses"
    median, slowest = 1e3 * np.median(times), 1e3 * np.quantile(times, 0.99)
    return [name, str(arm.n), f"{len(arm.tips)} {kind}", f"{solved} of {count}", f"{median:.2f} ms", f"{slowest:.1f} ms"]


def hand_targets(around: dict[str, np.ndarray], rng: np.random.Generator) -> dict[str, np.ndarray]:
    scale = rng.choice([0.1, 0.3, 2.0])
    return {hand: around[hand] + scale * rng.normal(size=3) for hand in HANDS}


def follow_with_armctl(steps: int) -> list[str]:
    arm = armctl.load(HUMANOID, base="free")
    judge = Judge(arm)
    limits = arm.limits
    rng = np.random.default_rng(0)
    start = judge.tips(arm.home)
    hands = {hand: start[hand].position for hand in HANDS}
    ik = armctl.DifferentialIk(arm)
    q = arm.home.copy()
    v = np.zeros(arm.n)
    times = []
    violations = 0
    slip = 0.0
    targets: dict[str, object] = {}
    for k in range(steps):
        if k % 400 == 0:
            targets = hand_targets(hands, rng) | dict.fromkeys(FEET, armctl.STAY)
        begin = time.perf_counter()
        following = ik.step(q, targets, DT)
        times.append(time.perf_counter() - begin)
        violations += bool((np.abs(following) > limits.v_max).any())
        violations += bool((np.abs(following - v) > limits.a_max * DT * (1 + 1e-9)).any())
        v = following
        q = q + DT * v
        violations += bool(((q < limits.q_min) | (q > limits.q_max)).any())
        tips = judge.tips(q)
        slip = max(slip, *(np.linalg.norm(tips[foot].position - start[foot].position) for foot in FEET))
    return ["armctl", f"{1e6 * np.median(times):.0f} us", f"{1e6 * slip:.2g} um", str(violations)]


def follow_with_mink(steps: int) -> list[str]:
    arm = armctl.load(HUMANOID, base="free")  # for its limits of speed and acceleration
    model = mujoco.MjModel.from_xml_path(f"{os.environ['MENAGERIE_ROOT']}/{HUMANOID}/scene.xml")
    configuration = mink.Configuration(model)
    configuration.update_from_keyframe("home")
    posture = mink.PostureTask(model, cost=1e-1)
    posture.set_target_from_configuration(configuration)
    feet = {foot: mink.FrameTask(foot, "body", position_cost=200.0, orientation_cost=10.0, lm_damping=1.0) for foot in FEET}
    hands = {hand: mink.FrameTask(hand, "body", position_cost=200.0, orientation_cost=0.0, lm_damping=1.0) for hand in HANDS}
    places = {}
    for name, task in {**feet, **hands}.items():
        T = configuration.get_transform_frame_to_world(name, "body")
        places[name] = T.translation().copy()
        task.set_target(T)
    driven = [model.joint(name) for name in arm.joint_names[6:]]
    dofs = [joint.dofadr[0] for joint in driven]
    addresses = [joint.qposadr[0] for joint in driven]
    limits = [
        mink.ConfigurationLimit(model),
        mink.VelocityLimit(model, dict(zip(arm.joint_names[6:], arm.limits.v_max[6:], strict=True))),
    ]
    rng = np.random.default_rng(0)
    times = []
    violations = 0
    slip = 0.0
    before = np.zeros(len(dofs))
    rounding = 1 + 1e-9
    for k in range(steps):
        if k % 400 == 0:
            for hand, point in hand_targets({hand: places[hand] for hand in HANDS}, rng).items():
                hands[hand].set_target(mink.SE3.from_translation(point))
        begin = time.perf_counter()
        v = mink.solve_ik(configuration, [posture, *feet.values(), *hands.values()], DT, "daqp", damping=1e-1, limits=limits)
        configuration.integrate_inplace(v, DT)
        times.append(time.perf_counter() - begin)
        own = v[dofs]
        q = configuration.q[addresses]
        violations += bool((np.abs(own) > arm.limits.v_max[6:] * rounding).any())
        violations += bool((np.abs(own - before) > arm.limits.a_max[6:] * DT * rounding).any())
        violations += bool(((q < arm.limits.q_min[6:] - 1e-9) | (q > arm.limits.q_max[6:] + 1e-9)).any())
        before = own
        for foot in FEET:
            slip = max(slip, np.linalg.norm(configuration.data.body(foot).xpos - places[foot]))
    return [f"mink {version('mink')}", f"{1e6 * np.median(times):.0f} us", f"{1e6 * slip:.2g} um", str(violations)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--targets", type=int, default=1000, help="of each robot")
    parser.add_argument("--steps", type=int, default=100_000, help="of differential inverse kinematics")
    parser.add_argument("--out", type=Path, help="a Markdown file for the tables")
    args = parser.parse_args()
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    rows = [solve_row(name, args.targets) for name in ROBOTS]
    solved = markdown_table(["robot", "joints", "targets", "solved", "median", "99 %"], rows)
    rows = [follow_with_armctl(args.steps), follow_with_mink(args.steps)]
    columns = ["", "a step", "feet moved by at most", "limits exceeded"]
    followed = markdown_table(columns, rows)
    text = f"{solved}\n\n{args.steps} steps of a humanoid with 25 joints:\n\n{followed}\n"
    print(text)
    if args.out is not None:
        args.out.write_text(text)


if __name__ == "__main__":
    main()
