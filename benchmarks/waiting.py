"""What a user waits for: each task in a new process, with an empty home folder and no cache.

    python benchmarks/waiting.py [--quick] [--only solve_ik move_to] [--out benchmarks/results/waiting.md]

CPU seconds are those of all threads of the process and include the interpreter, the imports and whatever is compiled. The
answers are verified after the measurement: with MuJoCo's kinematics, dynamics and collision detection, and with the limits of
the arm.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TypeVar

import mujoco
import mujoco_menagerie
import numpy as np
from markdown_table import titled_table

import armctl

Array = np.ndarray
T = TypeVar("T")

LONGEST = 3  # calls that are listed
POSITION_TOLERANCE_M = 1e-5  # of solve_ik and solve_ik_all
ORIENTATION_TOLERANCE_RAD = 1e-4
MOVE_TOLERANCE_M = 1e-3  # of move_to
FOLLOW_TOLERANCE_M = 5e-3  # the target is read 50 times per second, and the arm is always behind it
SAMPLING_S = 1e-3  # of motions that are verified
WAYPOINT_TOLERANCE_RAD = 5e-3  # samples 1 ms apart pass a waypoint at this distance
ROUNDING = 1e-6  # relative, of differences of positions


class Clock:
    """CPU and wall time of each call of a task, and the time from the start of the process to its end."""

    def __init__(self, process_start: float) -> None:
        self.cpu: list[float] = []
        self.wall: list[float] = []
        self.first_cpu = 0.0
        self.first_wall = 0.0
        self._process_start = process_start

    def call(self, function: Callable[[], T]) -> T:
        """Calls a function and records its time."""
        wall = time.perf_counter()
        cpu = time.process_time()
        result = function()
        self.record(time.process_time() - cpu, time.perf_counter() - wall)
        return result

    def record(self, cpu: float, wall: float) -> None:
        """Adds the times of one call, s."""
        if not self.cpu:
            self.first_cpu = time.process_time()
            self.first_wall = time.monotonic() - self._process_start
        self.cpu.append(cpu)
        self.wall.append(wall)


class Task(NamedTuple):
    """What a user does: `run` gets the clock and the number of calls, and returns a function that verifies the answers."""

    name: str
    calls: int
    quick_calls: int
    run: Callable[[Clock, int], Callable[[], None]]


class Judge:
    """MuJoCo's kinematics, dynamics and collision detection of an arm."""

    def __init__(self, arm: armctl.Arm):
        self.arm = arm
        self.data = mujoco.MjData(arm.model)

    def tip(self, q: Array) -> armctl.Pose:
        """T_world_tip."""
        self.data.qpos[:] = self.arm.qpos(q)
        mujoco.mj_kinematics(self.arm.model, self.data)
        body = self.arm.tip_body
        return armctl.Pose.from_rotation(self.data.xpos[body], self.data.xmat[body].reshape(3, 3)) @ self.arm.T_body_tip

    def check_pose(self, q: Array, target: armctl.Pose) -> None:
        """A solution is inside the limits and at its target."""
        assert self.arm.limits.contains(q, 1e-5), "a solution is outside the limits"
        off, turned = self.tip(q).distance(target)
        assert off <= POSITION_TOLERANCE_M * (1 + ROUNDING), f"a solution is {off:g} m off"
        assert turned <= ORIENTATION_TOLERANCE_RAD * (1 + ROUNDING), f"a solution is {turned:g} rad off"

    def check_motion(self, motion: armctl.Trajectory) -> Array:
        """Positions, speeds, accelerations and jerks are inside the limits: differences of samples 1 ms apart.

        Returns:
            The positions (T, n).
        """
        times = np.arange(0.0, motion.duration, SAMPLING_S)
        q = motion.sample(times).q
        limits = self.arm.limits
        assert np.all((q >= limits.q_min - 1e-9) & (q <= limits.q_max + 1e-9)), "a motion leaves the joint limits"
        for order, bound in enumerate((limits.v_max, limits.a_max, limits.j_max), 1):
            differences = np.abs(np.diff(q, order, axis=0)) / SAMPLING_S**order
            assert np.all(differences <= bound * (1 + ROUNDING) + 1e-15 / SAMPLING_S**order), f"derivative {order} is too large"
        return q

    def check_torques(self, motion: armctl.Trajectory) -> None:
        """MuJoCo's inverse dynamics needs no more torque than the motors have."""
        model = self.arm.model
        samples = motion.sample(np.arange(0.0, motion.duration, 10 * SAMPLING_S))
        for q, v, a in zip(samples.q, samples.v, samples.a, strict=True):
            self.data.qpos[:] = self.arm.qpos(q)
            self.data.qvel[:] = self.arm.qvel(v)
            self.data.qacc[:] = self.arm.qvel(a)
            mujoco.mj_inverse(model, self.data)
            torque = (self.data.qfrc_inverse + self.data.qfrc_constraint)[self.arm.dof_adr]  # contacts do not help
            assert np.all(np.abs(torque) <= self.arm.limits.tau_max * (1 + ROUNDING)), "a motion needs too much torque"

    def touches(self, q: Array, body: int) -> bool:
        """Whether anything touches a body."""
        self.data.qpos[:] = self.arm.qpos(q)
        mujoco.mj_kinematics(self.arm.model, self.data)
        mujoco.mj_collision(self.arm.model, self.data)
        bodies = self.arm.model.geom_bodyid[self.data.contact.geom]
        return bool(np.any((bodies == body).any(axis=1) & (self.data.contact.dist < 0)))


# Tasks


def circle(start: armctl.Pose, radius: float = 0.1, period: float = 5.0) -> Callable[[float], armctl.Pose]:
    """A target that begins at the start and moves on a vertical circle with the orientation of the start."""

    def target(t: float) -> armctl.Pose:
        angle = 2 * np.pi * t / period
        return armctl.Pose(start.position + radius * np.array([0.0, np.sin(angle), np.cos(angle) - 1.0]), quat=start.quat)

    return target


def differential_ik(clock: Clock, calls: int) -> Callable[[], None]:
    """Ticks of 10 ms: the tip follows a circle."""
    dt = 0.01
    arm = armctl.load("panda")
    target = circle(arm.fk(arm.home))
    solver = armctl.DifferentialIk(arm)
    q = arm.home
    positions = [q]
    for k in range(calls):
        v = clock.call(lambda q=q, k=k: solver.step(q, target(dt * (k + 1)), dt))
        q = q + dt * v
        positions.append(q)

    def verify() -> None:
        judge = Judge(arm)
        path = np.array(positions)
        assert np.all((path >= arm.limits.q_min) & (path <= arm.limits.q_max)), "a position is outside the limits"
        assert np.all(np.abs(np.diff(path, axis=0)) <= dt * arm.limits.v_max * (1 + 1e-9)), "a joint is too fast"
        off = [judge.tip(path[k]).distance(target(dt * k))[0] for k in range(100, calls + 1)]
        assert max(off) <= 1e-3, f"the tip is {max(off):g} m off"

    return verify


def follow(clock: Clock, calls: int) -> Callable[[], None]:
    """A call is the time between two readings of the target, 20 ms of the simulation; the first begins with `follow`."""
    sim = armctl.Simulation("panda")
    target = circle(sim.tip)
    last = [time.process_time(), time.perf_counter()]

    def read(t: float) -> armctl.Pose:
        now = [time.process_time(), time.perf_counter()]
        clock.record(now[0] - last[0], now[1] - last[1])
        last[:] = now
        return target(t)

    log = sim.follow(read, duration=calls / 50)

    def verify() -> None:
        judge = Judge(sim.arm)
        limits = sim.arm.limits
        assert np.all((log.q >= limits.q_min) & (log.q <= limits.q_max)), "a position is outside the limits"
        assert np.all(np.abs(log.v) <= limits.v_max * (1 + 1e-3)), "a joint is too fast"
        assert np.all(np.abs(log.tau) <= limits.tau_max * (1 + 1e-9)), "a motor has too much torque"
        moving = np.flatnonzero(log.t >= 1.0)[::20]
        off = [judge.tip(log.q[k]).distance(target(log.t[k]))[0] for k in moving]
        assert max(off) <= FOLLOW_TOLERANCE_M, f"the tip is {max(off):g} m off"

    return verify


def move_to(clock: Clock, calls: int) -> Callable[[], None]:
    """Points that the tip reaches within half a radian of home, above the table."""
    sim = armctl.Simulation("panda")
    arm = sim.arm
    rng = np.random.default_rng(0)
    points: list[Array] = []
    while len(points) < calls:
        position = arm.fk(arm.limits.clamp(arm.home + rng.uniform(-0.5, 0.5, arm.n))).position
        if position[2] > 0.2:
            points.append(position)
    results = []
    ends = []
    for point in points:
        results.append(clock.call(lambda point=point: sim.move_to(point)))
        ends.append(sim.state.q)

    def verify() -> None:
        judge = Judge(arm)
        for point, result, q in zip(points, results, ends, strict=True):
            assert result.ok, result.reason
            off = float(np.linalg.norm(judge.tip(q).position - point))
            assert off <= MOVE_TOLERANCE_M, f"the tip is {off:g} m off"

    return verify


def poses(arm: armctl.Arm, count: int) -> list[armctl.Pose]:
    """Poses of random configurations."""
    return [arm.fk(q) for q in arm.limits.random(arm.home, count, np.random.default_rng(0))]


def solve_ik(clock: Clock, calls: int) -> Callable[[], None]:
    """One solution of random poses."""
    arm = armctl.load("panda")
    targets = poses(arm, calls)
    results = [clock.call(lambda target=target: armctl.solve_ik(arm, target)) for target in targets]

    def verify() -> None:
        judge = Judge(arm)
        for target, result in zip(targets, results, strict=True):
            assert result.ok, result.reason
            judge.check_pose(result.q, target)

    return verify


def solve_ik_all(robot: str) -> Callable[[Clock, int], Callable[[], None]]:
    """All solutions of random poses."""

    def run(clock: Clock, calls: int) -> Callable[[], None]:
        arm = armctl.load(robot)
        targets = poses(arm, calls)
        results = [clock.call(lambda target=target: armctl.solve_ik_all(arm, target)) for target in targets]

        def verify() -> None:
            judge = Judge(arm)
            for target, result in zip(targets, results, strict=True):
                assert len(result.q), "a pose that the arm reaches has no solution"
                for q in result.q[:8]:
                    judge.check_pose(q, target)

        return verify

    return run


def move_through(clock: Clock, calls: int) -> Callable[[], None]:
    """Ten waypoints anywhere within the limits."""
    arm = armctl.load("panda")
    rng = np.random.default_rng(0)
    waypoints = [rng.uniform(arm.limits.q_min, arm.limits.q_max, (10, arm.n)) for _ in range(calls)]
    motions = [clock.call(lambda q=q: armctl.move_through(arm, q)) for q in waypoints]

    def verify() -> None:
        judge = Judge(arm)
        for points, motion in zip(waypoints, motions, strict=True):
            q = judge.check_motion(motion)
            judge.check_torques(motion)
            for point in points:
                assert np.abs(q - point).max(axis=1).min() <= WAYPOINT_TOLERANCE_RAD, "a motion misses a waypoint"

    return verify


def move_free(clock: Clock, calls: int) -> Callable[[], None]:
    """From one side of a wall to the other, between random configurations."""
    scene = armctl.World().add("wall", armctl.Box([0.5, 0.04, 0.7]), [0.6, 0.0, 0.35])
    arm = armctl.load("panda", scene=scene)
    wall = arm.model.body("wall").id
    judge = Judge(arm)
    rng = np.random.default_rng(0)
    ends: list[tuple[Array, Array]] = []
    while len(ends) < calls:
        start, goal = arm.home + rng.uniform(-0.15, 0.15, (2, arm.n))
        start[0] -= 0.7
        goal[0] += 0.7
        if not judge.touches(start, wall) and not judge.touches(goal, wall):
            ends.append((start, goal))
    motions = [clock.call(lambda start=start, goal=goal: armctl.move_free(arm, start, goal)) for start, goal in ends]

    def verify() -> None:
        for (start, goal), motion in zip(ends, motions, strict=True):
            line = start + np.linspace(0.0, 1.0, 200)[:, None] * (goal - start)
            assert any(judge.touches(q, wall) for q in line), "the wall is not between start and goal"
            path = judge.check_motion(motion)
            assert not any(judge.touches(q, wall) for q in path), "a motion touches the wall"
            assert np.abs(path[0] - start).max() <= 1e-9, "a motion starts elsewhere"
            assert np.abs(motion.sample([motion.duration]).q[0] - goal).max() <= 1e-9, "a motion ends elsewhere"

    return verify


def vector_environment(clock: Clock, calls: int) -> Callable[[], None]:
    """A call is a step of 64 environments of `Reach`, 25 control periods each."""
    from armctl.envs import ArmVectorEnv

    arm = armctl.load("panda")
    env = ArmVectorEnv(arm, num_envs=64)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1.0, 1.0, (calls, *env.action_space.shape)).astype(np.float32)
    observations = [clock.call(lambda action=action: env.step(action)[0]) for action in actions]

    def verify() -> None:
        judge = Judge(arm)
        columns = env.batch.observer.columns
        observed = np.array(observations, dtype=float)
        q = observed[..., columns["q"]]
        tips = observed[..., columns["tip"]]
        assert np.all((q >= arm.limits.q_min - 1e-3) & (q <= arm.limits.q_max + 1e-3)), "a position is outside the limits"
        for step in range(0, calls, 10):
            for row in range(0, 64, 9):
                off = np.linalg.norm(judge.tip(q[step, row]).position - tips[step, row])
                assert off <= 1e-5, f"an observed tip is {off:g} m off"

    return verify


def torque_loop(clock: Clock, calls: int) -> Callable[[], None]:
    """A loop of the user at 1 kHz: only `controller.torque` counts as the call, MuJoCo's step is in the seconds in all."""
    arm = armctl.load("panda")
    controller = armctl.ComputedTorque(arm)
    sim = armctl.Simulation(arm, controller, armctl.Plant(timestep=1e-3))
    goal = arm.limits.clamp(arm.home + 0.4)
    motion = armctl.move_j(arm, arm.home, goal)
    torques = []
    for _ in range(calls):
        state = sim.measured_state
        setpoint = motion(state.t)
        torque = clock.call(lambda state=state, setpoint=setpoint: controller.torque(state, setpoint))
        torques.append(torque)
        sim.step(torque)

    def verify() -> None:
        assert calls * 1e-3 > motion.duration, "the motion is not finished"
        judge = Judge(arm)
        off = judge.tip(sim.state.q).distance(judge.tip(goal))[0]
        assert off <= MOVE_TOLERANCE_M, f"the tip is {off:g} m off"
        assert np.all(np.abs(torques) <= arm.limits.tau_max), "a torque exceeds its limit"

    return verify


TASKS = [
    Task("solve_ik, Panda", 1000, 100, solve_ik),
    Task("solve_ik_all, UR5e", 1000, 100, solve_ik_all("ur5e")),
    Task("solve_ik_all, Panda", 1000, 20, solve_ik_all("panda")),
    Task("DifferentialIk, 100 Hz", 6000, 600, differential_ik),
    Task("move_to", 60, 5, move_to),
    Task("follow a circle, 20 ms", 1500, 150, follow),
    Task("move_through ten waypoints", 40, 4, move_through),
    Task("move_free round a wall", 20, 2, move_free),
    Task("step of 64 environments", 200, 20, vector_environment),
    Task("controller.torque, 1 kHz", 10_000, 2000, torque_loop),
]


# One process for each task


def run_task(task: Task, calls: int, process_start: float) -> None:
    """Prints the times of a task as JSON; the process does nothing else."""
    warnings.simplefilter("ignore", armctl.ArmctlWarning)
    clock = Clock(process_start)
    verify = task.run(clock, calls)
    total_cpu = time.process_time() + sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2])
    total_wall = time.monotonic() - process_start
    memory = int(
        subprocess.run(["ps", "-o", "rss=", "-p", str(os.getpid())], capture_output=True, text=True, check=True).stdout
    )
    verify()
    measured = {"total_cpu": total_cpu, "total_wall": total_wall, "memory_mb": memory / 1024}
    times = {"cpu": clock.cpu, "wall": clock.wall, "first_cpu": clock.first_cpu, "first_wall": clock.first_wall}
    print(json.dumps(measured | times))


def measure(task: Task, calls: int) -> dict:
    """The times of a task in a new process with an empty home folder and no cache."""
    with tempfile.TemporaryDirectory() as empty:
        environment = {**os.environ, "HOME": empty}
        environment["XDG_CACHE_HOME"] = str(Path(empty) / "cache")
        environment["MENAGERIE_CACHE_DIR"] = str(mujoco_menagerie.Cache().dir)  # the robots are installed
        command = [sys.executable, __file__, "--task", task.name, "--calls", str(calls), "--started", str(time.monotonic())]
        child = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(child.stdout.strip().splitlines()[-1])


def milliseconds(seconds: float) -> str:
    return f"{1e3 * seconds:.3g}" if seconds < 1 else f"{1e3 * seconds:.0f}"


def longest(seconds: list[float]) -> str:
    """The longest calls, ms, each with its index from 0."""
    order = np.argsort(seconds)[::-1][:LONGEST]
    return ", ".join(f"{milliseconds(seconds[k])} ({k})" for k in order)


def row(task: Task, calls: int) -> list[str]:
    measured = measure(task, calls)
    return [
        task.name,
        str(len(measured["cpu"])),
        f"{measured['total_cpu']:.1f}",
        f"{measured['total_wall']:.1f}",
        f"{measured['first_cpu']:.2f}",
        f"{measured['first_wall']:.2f}",
        milliseconds(float(np.median(measured["cpu"]))),
        longest(measured["cpu"]),
        longest(measured["wall"]),
        f"{measured['memory_mb']:.0f}",
    ]


def main() -> None:
    by_name = {task.name: task for task in TASKS}
    parser = argparse.ArgumentParser(description=str(__doc__).split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="fewer calls; the file is written only with --out")
    parser.add_argument("--only", nargs="+", metavar="WORD", default=[""], help="tasks whose name contains one of these words")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--task", choices=list(by_name), help=argparse.SUPPRESS)
    parser.add_argument("--calls", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--started", type=float, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.task:
        run_task(by_name[args.task], args.calls, args.started)
        return
    chosen = [task for task in TASKS if any(word in task.name for word in args.only)]
    rows = []
    for task in chosen:
        rows.append(row(task, task.quick_calls if args.quick else task.calls))
        print(rows[-1], file=sys.stderr, flush=True)
    columns = [
        "task",
        "calls",
        "CPU s in all",
        "s in all",
        "CPU s to the first answer",
        "s to the first answer",
        "median of a call, ms of CPU",
        f"longest {LONGEST} calls, ms of CPU (index)",
        f"longest {LONGEST} calls, ms (index)",
        "memory, MB",
    ]
    title = "Each task in a new process without a cache; seconds count from the start of the process"
    text = titled_table(title, columns, rows)
    is_complete = len(chosen) == len(TASKS) and not args.quick
    out = Path(__file__).parent / "results" / "waiting.md" if args.out is None and is_complete else args.out
    if out is not None:
        out.parent.mkdir(exist_ok=True)
        load = f"Load average of the {os.cpu_count()} cores while they were measured: {os.getloadavg()[2]:.1f}."
        out.write_text(f"{text}\n\n{load}\n", encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
