"""The gate: does it let pass what is free, and stop what is not? `python benchmarks/gate.py`.

    python benchmarks/gate.py [--arms panda ur5e xarm7] [--motions 334] [--errors 334] [--only TABLE ...] [--processes 2]

Motions of an expert, `move_free` among a wall, a ball and a post, are emitted as a policy does, chunks of ten targets at 30 Hz
every 0.2 s, from where the arm is on its way; with a gate, and without one by a `Stream`. A motion was stopped if the gate
refused one of its chunks, which is false. The errors are injected in the middle of such motions: a chunk into a body of the
scene, into the arm itself, with a stick of 30 cm at the tip into a body, beyond a limit of the joints, with a NaN, a jump of up
to 1 rad in a joint, and a velocity of the tip of 1 m/s in a random direction. MuJoCo judges the motions that the gate lets pass
every millisecond, `check_limits` and `check_torque` their limits. The nearest safe configuration is compared with the nearest
free one of 20 000 random ones around what was asked for. In the last table a ball of 6 cm appears on the way of the tip during
a motion of 2 s, or beside it. A stop was free if going on, the stop on the path or the fastest stop touches nothing.
"""

from __future__ import annotations

import argparse
import copy
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import mujoco
import numpy as np
from markdown_table import titled_table

import armctl
from armctl.model.collision.checker import CollisionChecker
from armctl.model.collision.checkers import collision_checker
from armctl.plan.motion.trajectory.path_stop import remaining

ROWS = 10
FRAME_S = 1 / 30
CHUNK_EVERY_S = 0.2
JUDGED_EVERY_S = 1e-3
PATIENCE = 1.6  # times its duration, and a second, in which a motion must be over
REACHED = 1e-3  # rad (m)
BALL_M = 0.06
STICK = armctl.Box([0.02, 0.02, 0.3])
T_TIP_STICK = armctl.Pose([0.0, 0.0, 0.17])
FAR_AWAY = [0.0, 0.0, 20.0]
RESULTS = Path(__file__).parent / "results" / "gate.md"
ERRORS = ("a body", "itself", "a body with a stick", "a limit", "NaN", "a jump", "a twist")


def scene() -> armctl.World:
    """A wall, a ball and a post, and the ball that appears, far away."""
    return (
        armctl.World()
        .add("wall", armctl.Box([0.04, 0.8, 0.6]), [0.7, 0.0, 0.3])
        .add("ball", armctl.Ball(0.1), [0.1, 0.5, 0.5])
        .add("post", armctl.Cylinder(0.05, 0.8), [-0.4, -0.35, 0.4])
        .add("sudden", armctl.Ball(BALL_M), FAR_AWAY)
        .add("judged stick", armctl.Box(STICK.size), [0.0, 5.0, 20.0], mass=0.1)
    )


class Judge:
    """MuJoCo's contacts, without those that armctl leaves out by design."""

    def __init__(self, arm: armctl.Arm, carries: bool = False):
        self.arm = arm
        self.carries = carries
        self.data = mujoco.MjData(arm.model)
        self.stick = int(arm.model.body("judged stick").jntadr[0])
        self.by_design = {frozenset(pair) for pair in collision_checker(arm).left_out}

    def touches(self, motion: armctl.JointTrajectory, until: float = np.inf) -> bool:
        """Whether the arm touches something during a motion, up to a time, s."""
        times = np.arange(0.0, min(motion.duration, until) + JUDGED_EVERY_S, JUDGED_EVERY_S)
        return any(self.touches_at(q) for q in motion.sample(times).q)

    def touches_at(self, q: np.ndarray) -> bool:
        model = self.arm.model
        self.data.qpos[:] = self.arm.qpos(q)
        if self.carries:
            pose = self.arm.fk(q) @ T_TIP_STICK
            at = int(model.jnt_qposadr[self.stick])
            self.data.qpos[at : at + 7] = [*pose.position, *pose.quat]
        mujoco.mj_kinematics(model, self.data)
        mujoco.mj_collision(model, self.data)
        for contact in self.data.contact:
            pair = frozenset(model.body(model.geom_bodyid[geom]).name for geom in contact.geom)
            if contact.exclude == 0 and contact.dist < 0.0 and pair not in self.by_design:
                return True
        return False


@dataclass
class Setup:
    """An arm in the scene, with a gate."""

    arm: armctl.Arm
    gate: armctl.Gate
    judge: Judge
    rng: np.random.Generator
    world: armctl.World

    @property
    def checker(self) -> CollisionChecker:
        return collision_checker(self.arm, world=self.world)

    def free(self) -> np.ndarray:
        """A random configuration at which nothing is nearer than 2 cm."""
        checker = self.checker
        while True:
            q = self.arm.limits.random(self.arm.home, 1, self.rng)[0]
            if checker.hit(q, 0.02) < 0:
                return q

    def blocked(self, what: str) -> np.ndarray:
        """A random configuration at which the arm touches a body of the scene, or itself."""
        checker = self.checker
        own = {self.arm.model.body(i).name for i in range(1, self.arm.model.nbody)} - {
            "wall",
            "ball",
            "post",
            "sudden",
            "judged stick",
        }
        while True:
            q = self.arm.limits.random(self.arm.home, 1, self.rng)[0]
            pair = checker.hit(q)
            if pair < 0:
                continue
            names = set(checker.names(pair))
            kind = "a body with a stick" if "stick" in names else "itself" if names <= own else "a body"
            if kind == what:
                return q

    def expert(self) -> armctl.JointTrajectory:
        """A motion around what is in the way."""
        while True:
            try:
                seed = int(self.rng.integers(1000))
                return armctl.move_free(self.arm, self.free(), self.free(), clearance=0.01, seed=seed, world=self.world)
            except armctl.PlanError:
                continue

    def blocked_by_anything(self) -> np.ndarray:
        """A random configuration at which something is too near."""
        checker = self.checker
        while True:
            q = self.arm.limits.random(self.arm.home, 1, self.rng)[0]
            if checker.hit(q, self.gate.clearance) >= 0:
                return q


def setup(name: str, seed: int, carries: bool = False) -> Setup:
    arm = armctl.load(name, scene=scene())
    world = armctl.World()
    if carries:
        world.add("stick", STICK).attach("stick", T_TIP_STICK)
    return Setup(
        arm=arm,
        gate=armctl.Gate(arm, world),
        judge=Judge(arm, carries),
        rng=np.random.default_rng(seed),
        world=world,
    )


class Progress:
    """How far the arm is on an expert's motion, and what the expert says from there."""

    def __init__(self, motion: armctl.JointTrajectory):
        self.motion = motion
        self.time = 0.0

    def chunk(self, q: np.ndarray) -> np.ndarray:
        times = np.linspace(self.time, self.time + 2 * CHUNK_EVERY_S, 81)
        errors = np.linalg.norm(self.motion.sample(times).q - q, axis=1)
        self.time = float(times[errors.argmin()])
        return self.motion.sample(self.time + FRAME_S * np.arange(1, ROWS + 1)).q


TIMES = FRAME_S * np.arange(1, ROWS + 1)


@dataclass
class Followed:
    """What became of an expert's motion."""

    reached: bool
    stopped: bool
    touched: bool
    broke: bool
    running: armctl.JointTrajectory


def follow(setup: Setup, motion: armctl.JointTrajectory, seconds: float) -> Followed:
    """An expert's motion through the gate, for so many seconds."""
    progress = Progress(motion)
    running = setup.gate.admit(motion(0.0).q, q=motion(0.0).q).motion
    result = Followed(False, False, False, False, running)
    for _ in range(round(seconds / CHUNK_EVERY_S)):
        at = min(CHUNK_EVERY_S, running.duration)
        answer = setup.gate.admit(running, at=at, q=progress.chunk(running(at).q), times=TIMES)
        running = answer.motion
        result.stopped |= not answer.ok
        result.broke |= not running.check_limits().ok
        result.touched |= not answer.proved or setup.judge.touches(running, CHUNK_EVERY_S)
        if np.abs(running(running.duration).q - motion(motion.duration).q).max() < REACHED and running.duration < CHUNK_EVERY_S:
            result.reached = True
            break
    result.running = running
    return result


def follow_without(setup: Setup, motion: armctl.JointTrajectory, seconds: float) -> bool:
    """Whether an expert's motion is over in time without a gate."""
    stream = armctl.Stream(setup.arm, motion(0.0).q)
    progress = Progress(motion)
    for _ in range(round(seconds / CHUNK_EVERY_S)):
        stream.push_chunk(stream.t + TIMES, progress.chunk(stream.setpoint.q))
        stream.step(CHUNK_EVERY_S)
        if np.abs(stream.setpoint.q - motion(motion.duration).q).max() < REACHED:
            return True
    return False


def experts(name: str, count: int) -> list[object]:
    this = setup(name, 1)
    counts: Counter[str] = Counter()
    for _ in range(count):
        motion = this.expert()
        seconds = PATIENCE * motion.duration + 1.0
        with_gate = follow(this, motion, seconds)
        counts["reached"] += with_gate.reached
        counts["without"] += follow_without(this, motion, seconds)
        counts["stopped"] += with_gate.stopped
        counts["touched"] += with_gate.touched
        counts["broke"] += with_gate.broke
    return [name, count, counts["without"], counts["reached"], counts["stopped"], counts["touched"], counts["broke"]]


def errors(name: str, count: int) -> list[list[object]]:
    setups = {carries: setup(name, 2, carries) for carries in (False, True)}
    rows = {kind: Counter[str]() for kind in ERRORS}
    for k in range(count):
        kind = ERRORS[k % len(ERRORS)]
        this = setups[kind == "a body with a stick"]
        motion = this.expert()
        running = follow(this, motion, this.rng.uniform(0.1, 0.9) * motion.duration).running
        at = this.rng.uniform() * min(CHUNK_EVERY_S, running.duration)
        state = running(at)
        found = rows[kind]
        found["count"] += 1
        try:
            answer = this.gate.admit(running, at=at, **wrong(this, kind, state))
        except armctl.InputError:
            found["refused"] += 1
            continue
        found["refused"] += not answer.ok
        found["shown"] += not answer.ok and not this.judge.touches_at(answer.nearest)
        found["touched"] += not answer.proved or this.judge.touches(answer.motion)
        found["broke"] += not answer.motion.check_limits().ok or not armctl.check_torque(this.arm, answer.motion).ok
    return [[name, kind, *(found[key] for key in ("count", "refused", "touched", "broke"))] for kind, found in rows.items()]


def wrong(this: Setup, kind: str, state: armctl.Setpoint) -> dict[str, object]:
    """What a policy that fails asks for."""
    rng = this.rng
    if kind == "a twist":
        direction = rng.normal(size=3)
        return {"twist": (direction / np.linalg.norm(direction), np.zeros(3))}
    q = np.tile(state.q, (ROWS, 1))
    shares = np.linspace(0.0, 1.0, ROWS + 1)[1:, None]
    if kind in ("a body", "itself", "a body with a stick"):
        q += shares * (this.blocked(kind) - state.q)
    elif kind == "a limit":
        joint = int(rng.integers(this.arm.n))
        q[:, joint] += shares[:, 0] * (this.arm.limits.q_max[joint] + 0.2 - state.q[joint])
    elif kind == "NaN":
        q[int(rng.integers(ROWS)), int(rng.integers(this.arm.n))] = np.nan
    else:
        q[ROWS // 2 :] += rng.uniform(-1.0, 1.0, this.arm.n)
        q = this.arm.limits.clamp(q)
    return {"q": q, "times": TIMES}


def nearest(name: str, count: int) -> list[object]:
    this = setup(name, 3)
    checker = this.checker
    start = this.free()
    factors = []
    unsafe = 0
    for _ in range(count):
        asked = this.blocked_by_anything()
        found = this.gate.admit(start, q=asked).nearest
        unsafe += found is None or this.judge.touches_at(found)
        distance = float(np.linalg.norm(found - asked))
        best = distance
        for share in (0.9, 0.7, 0.5, 0.35):
            directions = this.rng.normal(size=(5000, this.arm.n))
            directions *= share * distance / np.linalg.norm(directions, axis=1)[:, None]
            free = [q for q in this.arm.limits.clamp(asked + directions) if checker.hit(q, this.gate.clearance) < 0]
            best = min([best, *(float(np.linalg.norm(q - asked)) for q in free)])
        factors.append(distance / best)
    return [name, count, unsafe, f"{np.median(factors):.2f}", f"{max(factors):.2f}"]


def appearances(name: str, count: int) -> list[object]:
    this = setup(name, 4)
    counts: Counter[str] = Counter()
    while counts["all"] < count:
        motion = this.expert()
        motion = motion.scaled(motion.duration / 2.0) if motion.duration < 2.0 else motion
        at = this.rng.uniform(0.2, 0.8) * motion.duration
        later = at + this.rng.uniform(0.05, 0.6)
        place = this.arm.fk(motion(later).q).position + this.rng.normal(size=3) * 0.08
        model = copy.copy(this.arm.model)
        model.body("sudden").pos[:] = place
        judge = Judge(replace(this.arm, model=model))
        if judge.touches_at(motion(at).q):
            continue
        counts["all"] += 1
        this.world.add("ball that appears", armctl.Ball(BALL_M), place)
        answer = this.gate.admit(motion, at=at)
        this.world.remove("ball that appears")
        if answer.ok:
            counts["goes on"] += 1
        touched = judge.touches(answer.motion)
        counts["touched"] += touched
        if touched:
            possible = [stop_on_path(motion, at), fastest_stop(this.arm, motion(at))]
            counts["avoidable"] += any(stop is not None and not judge.touches(stop) for stop in possible)
    return [name, count, counts["goes on"], counts["touched"], counts["avoidable"]]


def stop_on_path(motion: armctl.JointTrajectory, at: float) -> armctl.JointTrajectory | None:
    stop = motion.stopped_at(at)
    return (
        armctl.JointTrajectory(*remaining(stop.pieces, at), motion.joint_names, motion.limits) if at < stop.duration else None
    )


def fastest_stop(arm: armctl.Arm, state: armctl.Setpoint) -> armctl.JointTrajectory | None:
    stream = armctl.Stream(arm, state)
    return armctl.JointTrajectory(*stream.pieces, arm.joint_names, arm.limits)


TABLES: dict[str, tuple[Callable[[str, int], list], str, list[str]]] = {
    "motions": (
        experts,
        "Motions of the experts",
        ["arm", "motions", "over without a gate", "over with the gate", "stopped", "touched", "limits broken"],
    ),
    "errors": (errors, "Injected errors", ["arm", "error", "chunks", "refused", "touched", "limits broken"]),
    "nearest": (
        nearest,
        "The nearest safe configuration, and the nearest of 20 000 random ones",
        ["arm", "configurations", "unsafe", "median factor", "largest factor"],
    ),
    "appearances": (
        appearances,
        "A ball appears during a motion",
        ["arm", "motions", "went on", "touched", "touched though a stop was free"],
    ),
}


def _rows(of_arms: list[list]) -> list[list]:
    """The rows of a table, of which each arm has one or several."""
    return [row for each in of_arms for row in (each if isinstance(each[0], list) else [each])]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", nargs="+", default=["panda", "ur5e", "xarm7"])
    parser.add_argument("--motions", type=int, default=334)
    parser.add_argument("--errors", type=int, default=334)
    parser.add_argument("--appearances", type=int, default=67)
    parser.add_argument("--nearest", type=int, default=40)
    parser.add_argument("--only", nargs="+", choices=TABLES, default=list(TABLES))
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    with ProcessPoolExecutor(arguments.processes, get_context("spawn")) as pool:
        pending = {
            table: [pool.submit(measure, name, getattr(arguments, table)) for name in arguments.arms]
            for table, (measure, *_) in TABLES.items()
            if table in arguments.only
        }
        tables = [titled_table(*TABLES[table][1:], _rows([each.result() for each in rows])) for table, rows in pending.items()]
    text = "\n\n".join(tables) + "\n"
    print(text)
    arguments.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
