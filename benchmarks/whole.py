"""Whole robots: two hands, feet that stay, fingertips, bases that move, beside mink in the same run; MuJoCo judges.

    python benchmarks/whole.py [--targets 1000] [--steps 40000] [--motions 100] [--runs 40] [--out benchmarks/results/whole.md]
    python benchmarks/whole.py --only steps --without-mink --steps 1000000

The first table: targets for all tips of a robot at once, each of a random configuration inside the joint limits, from a random
start; poses where each chain has six joints or more of its own, else points. Solved: each tip within 1e-5 m and 1e-4 rad by
MuJoCo's kinematics.

The second: steps of 5 ms of differential inverse kinematics on a humanoid whose base is free: both hands follow points, both
feet stay. mink has the feet as tasks with the weights of its own example for this robot, and once as equalities. Times are
medians of the public calls. The targets jump every two seconds, a third of them far out of reach. Steps that exceed a limit
count from 1e-9 on, relative; mink has no limit of acceleration. Where its program has no solution, the robot stands still.
After all steps the targets are where the hands were at first, for ten seconds: what is left then is drift.

The third: what `posture_weight` brings and costs in many short runs; it keeps joints near home while targets are out of reach.

The fourth: motions between random configurations of arms with closed loops, each setpoint judged by MuJoCo's constraints.

The last: ticks of computed torque with MuJoCo's step, of one arm and of two arms as one, in turns; the least of each.
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
LOOPS = (
    ("parallel link arm", Path(__file__).parents[1] / "examples/models/parallel_link_arm.xml", None),
    ("gripper of the xArm 7", "ufactory_xarm7/hand", "left_finger"),
)
SLIP = 1e-6  # m: a foot that is farther off has left its place
RETURNING = 2000  # steps after all others, with the targets where the hands were at first
WEIGHTS = (0.0, 0.1)  # of the posture
JUMPS = 6  # of the targets before each return
TABLES = ("targets", "steps", "returns", "loops", "ticks")
TICKS = 2000
TURNS = 20  # of the runs whose ticks are compared


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


class Steps:
    """What a way to follow does: times, limits, feet."""

    def __init__(self, limits: armctl.Limits, feet: dict[str, np.ndarray], driven: slice):
        self._limits = limits
        self._feet = feet
        self._driven = driven
        self._v = np.zeros(len(limits.q_min))[driven]
        self.times: list[float] = []
        self.exceeded = np.zeros(3, int)
        self.slips: list[float] = []
        self.unsolved = 0
        self.drift = ""

    def add(self, seconds: float, q: np.ndarray, v: np.ndarray, feet: dict[str, np.ndarray]) -> None:
        """One step: the joints after it (k,), their speeds, and the places of the feet."""
        own = self._driven
        limits = self._limits
        rounding = 1 + 1e-9
        self.times.append(seconds)
        self.exceeded += (
            bool(((q < limits.q_min[own] - 1e-9) | (q > limits.q_max[own] + 1e-9)).any()),
            bool((np.abs(v) > limits.v_max[own] * rounding).any()),
            bool((np.abs(v - self._v) > limits.a_max[own] * DT * rounding).any()),
        )
        self._v = v
        self.slips.append(max(float(np.linalg.norm(feet[foot] - place)) for foot, place in self._feet.items()))

    def row(self, name: str) -> list[str]:
        slips = np.array(self.slips)
        feet = f"{1e6 * slips.max():.2g} um, {int((slips > SLIP).sum())}"
        return [name, f"{1e6 * np.median(self.times):.0f} us", feet, *map(str, self.exceeded), str(self.unsolved), self.drift]

    def come_back(self, hands: dict[str, np.ndarray], places: dict[str, np.ndarray], turned: np.ndarray) -> None:
        """Where the hands are after all steps, and how far the joints are from where they were at first."""
        off = max(float(np.linalg.norm(hands[hand] - places[hand])) for hand in HANDS)
        self.drift = f"{1e6 * off:.2g} um, {np.abs(turned).max():.1g} rad"


def follow_with_armctl(steps: int, posture_weight: float) -> list[str]:
    arm = armctl.load(HUMANOID, base="free")
    judge = Judge(arm)
    rng = np.random.default_rng(0)
    start = judge.tips(arm.home)
    hands = {hand: start[hand].position for hand in HANDS}
    ik = armctl.DifferentialIk(arm, posture_weight=posture_weight)
    q = arm.home.copy()
    seen = Steps(arm.limits, {foot: start[foot].position for foot in FEET}, slice(0, None))
    targets: dict[str, object] = {}
    for k in range(steps + RETURNING):
        if k == steps:
            targets = hands | dict.fromkeys(FEET, armctl.STAY)
        elif k % 400 == 0 and k < steps:
            targets = hand_targets(hands, rng) | dict.fromkeys(FEET, armctl.STAY)
        begin = time.perf_counter()
        v = ik.step(q, targets, DT)
        seconds = time.perf_counter() - begin
        q = q + DT * v
        seen.add(seconds, q, v, {foot: pose.position for foot, pose in judge.tips(q).items()})
    seen.come_back({hand: pose.position for hand, pose in judge.tips(q).items()}, hands, q - arm.home)
    return seen.row(f"armctl, posture_weight={posture_weight:g}" if posture_weight else "armctl")


def return_row(weight: float, runs: int) -> list[str]:
    """How often hands come back to where they were, and how far they are from targets out of reach after two seconds."""
    arm = armctl.load(HUMANOID, base="free")
    judge = Judge(arm)
    start = judge.tips(arm.home)
    hands = {hand: start[hand].position for hand in HANDS}
    stay = dict.fromkeys(FEET, armctl.STAY)
    left = []
    farther = []
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        ik = armctl.DifferentialIk(arm, posture_weight=weight)
        q = arm.home.copy()
        for jump in range(JUMPS + 1):
            targets = hands if jump == JUMPS else hand_targets(hands, rng)
            for _ in range(RETURNING if jump == JUMPS else 400):
                q = q + DT * ik.step(q, targets | stay, DT)
            off = missed(judge, q, targets)
            nearest = armctl.solve_ik(arm, targets | stay, q)
            if jump < JUMPS and not nearest.ok:
                farther.append(max(0.0, float(np.linalg.norm(off) - np.linalg.norm(missed(judge, nearest.q, targets)))))
        left.append(max(off))
    back = sum(each < 1e-3 for each in left)
    median, most = 1e3 * np.median(farther), 1e3 * np.quantile(farther, 0.9)
    return [f"{weight:g}", f"{back} of {runs}", f"{1e3 * max(left):.3g} mm", f"{median:.0f} mm", f"{most:.0f} mm"]


def missed(judge: Judge, q: np.ndarray, targets: dict[str, np.ndarray]) -> list[float]:
    """How far tips are from their targets, m."""
    tips = judge.tips(q)
    return [float(np.linalg.norm(tips[tip].position - target)) for tip, target in targets.items()]


def follow_with_mink(steps: int, *, exactly: bool) -> list[str]:
    arm = armctl.load(HUMANOID, base="free")  # for its limits
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
    own = slice(6, None)  # mink limits no speed of the free base
    names = arm.joint_names[own]
    dofs = [model.joint(name).dofadr[0] for name in names]
    addresses = [model.joint(name).qposadr[0] for name in names]
    limits = [mink.ConfigurationLimit(model), mink.VelocityLimit(model, dict(zip(names, arm.limits.v_max[own], strict=True)))]
    tasks = [posture, *hands.values(), *([] if exactly else feet.values())]
    exact = list(feet.values()) if exactly else []
    rng = np.random.default_rng(0)
    seen = Steps(arm.limits, {foot: places[foot] for foot in FEET}, own)
    at_first = configuration.q[addresses].copy()
    for k in range(steps + RETURNING):
        if k == steps or (k % 400 == 0 and k < steps):
            around = {hand: places[hand] for hand in HANDS}
            for hand, point in (around if k == steps else hand_targets(around, rng)).items():
                hands[hand].set_target(mink.SE3.from_translation(point))
        begin = time.perf_counter()
        try:
            v = mink.solve_ik(configuration, tasks, DT, "daqp", damping=1e-1, limits=limits, constraints=exact)
        except mink.NoSolutionFound:
            v = np.zeros(model.nv)
            seen.unsolved += 1
        configuration.integrate_inplace(v, DT)
        seconds = time.perf_counter() - begin
        found = {foot: configuration.data.body(foot).xpos for foot in FEET}
        seen.add(seconds, configuration.q[addresses], v[dofs], found)
    ends = {hand: configuration.data.body(hand).xpos for hand in HANDS}
    seen.come_back(ends, places, configuration.q[addresses] - at_first)
    return seen.row(f"mink {version('mink')}, feet as {'equalities' if exactly else 'tasks'}")


def loop_row(name: str, path: Path | str, tip: str | None, count: int) -> list[str]:
    """Motions of an arm with closed loops: how far these are open at the setpoints of 100 Hz, by MuJoCo's constraints."""
    arm = armctl.load(path, tip=tip)
    rng = np.random.default_rng(0)
    data = mujoco.MjData(arm.model)
    times, gaps = [], []
    start, done = arm.home, 0
    while done < count:
        goal = arm.limits.random(arm.home, 1, rng)[0]
        try:
            begin = time.perf_counter()
            motion = armctl.move_j(arm, start, goal)
            times.append(time.perf_counter() - begin)
        except (armctl.LimitError, armctl.PlanError):  # a passive joint would leave its limits
            continue
        for q in motion.sample(np.arange(0.0, motion.duration, 0.01)).q:
            data.qpos[:] = arm.qpos(q)
            mujoco.mj_fwdPosition(arm.model, data)
            gaps.append(np.abs(data.efc_pos[data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY]).max())
        start, done = goal, done + 1
    targets = [arm.fk(q) for q in arm.joint_map.closure.inward(arm.home, arm.limits.random(arm.home, count, rng))]
    solved = sum(bool(armctl.solve_ik(arm, target)) for target in targets)
    joints = f"{arm.n} driven, {len(arm.joint_map.closure.passive)} passive"
    return [
        name,
        joints,
        str(count),
        str(len(gaps)),
        f"{max(gaps):.1g} m",
        f"{1e3 * np.median(times):.1f} ms",
        f"{solved} of {count}",
    ]


def two_pandas() -> armctl.Arm:
    """Two robots of one file, in the reach of each other."""
    path = f"{os.environ['MENAGERIE_ROOT']}/franka_emika_panda/panda.xml"
    both = mujoco.MjSpec()
    both.option = mujoco.MjSpec.from_file(path).option
    for side, y in (("left/", 0.4), ("right/", -0.4)):
        both.attach(mujoco.MjSpec.from_file(path), prefix=side, frame=both.worldbody.add_frame(pos=[0, y, 0]))
    return armctl.load(both)


def tick_row(name: str, *arms: armctl.Arm) -> list[str]:
    """A tick of one arm, and of two arms as one: the least of runs in turns."""
    runs = []
    for arm in arms:
        simulation = armctl.Simulation(arm, armctl.ComputedTorque(arm))
        motion = armctl.out_and_back(arm)
        ticks = len(simulation.run(motion, dwell=TICKS * arm.dt))
        runs.append((simulation, motion, ticks))
    least = [np.inf, np.inf]
    for _ in range(TURNS):
        for k, (simulation, motion, ticks) in enumerate(runs):
            begin = time.perf_counter()
            simulation.run(motion, dwell=TICKS * simulation.arm.dt)
            least[k] = min(least[k], (time.perf_counter() - begin) / ticks)
    cells = [f"{arm.n}: {1e6 * seconds:.1f} us" for arm, seconds in zip(arms, least, strict=True)]
    return [name, *cells, f"{least[1] / least[0]:.2f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--targets", type=int, default=1000, help="of each robot")
    parser.add_argument("--steps", type=int, default=40_000, help="of differential inverse kinematics")
    parser.add_argument("--motions", type=int, default=100, help="of each arm with closed loops")
    parser.add_argument("--runs", type=int, default=40, help="of targets out of reach that come back")
    parser.add_argument("--only", nargs="+", choices=TABLES, default=TABLES, help="some of the tables")
    parser.add_argument("--without-mink", action="store_true", help="steps of armctl only")
    parser.add_argument("--out", type=Path, help="a Markdown file for the tables")
    args = parser.parse_args()
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    tables = []
    if "targets" in args.only:
        rows = [solve_row(name, args.targets) for name in ROBOTS]
        tables.append(markdown_table(["robot", "joints", "targets", "solved", "median", "99 %"], rows))
    if "steps" in args.only:
        rows = [follow_with_armctl(args.steps, weight) for weight in WEIGHTS]
        rows += [] if args.without_mink else [follow_with_mink(args.steps, exactly=exactly) for exactly in (False, True)]
        columns = ["", "a step", "feet: at most, steps off by 1 um", "position", "speed", "acceleration", "no solution"]
        tables.append(f"{args.steps} steps of a humanoid with 25 joints; steps that exceed a limit:")
        tables.append(markdown_table([*columns, "drift: hands, joints"], rows))
    if "returns" in args.only:
        columns = ["posture_weight", "hands back within 1 mm", "off at most", "farther than the nearest: median", "90 %"]
        tables.append("Hands of the humanoid after targets out of reach, and how near they come to those:")
        tables.append(markdown_table(columns, [return_row(weight, args.runs) for weight in WEIGHTS]))
    if "loops" in args.only:
        rows = [loop_row(*each, args.motions) for each in LOOPS]
        columns = ["", "joints", "motions", "setpoints", "loops open by at most", "to plan a motion", "poses solved"]
        tables += ["Motions of arms with closed loops:", markdown_table(columns, rows)]
    if "ticks" in args.only:
        pandas = ("Panda", armctl.load("panda"), two_pandas())
        alohas = ("aloha", armctl.load("aloha", tip="left/gripper"), armctl.load("aloha"))
        tables.append("A tick of computed torque with MuJoCo's step:")
        columns = ["robot", "joints of one arm, a tick", "of two", "ratio"]
        tables.append(markdown_table(columns, [tick_row(*each) for each in (pandas, alohas)]))
    text = "\n\n".join(tables) + "\n"
    print(text)
    if args.out is not None:
        args.out.write_text(text)


if __name__ == "__main__":
    main()
