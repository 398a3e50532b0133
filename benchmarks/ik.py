"""Inverse kinematics beside its peers: TRAC-IK and the Robotics Toolbox's `ik_LM`, taking turns on the same poses.

Hot: each solver answers 250 poses in a row. Cold: an array of 2.4 MB is written before each call, or the solvers take turns
call by call; behind TRAC-IK, which starts two threads a call, all others are slower.
All solutions (`--all`): EAIK (`pip install eaik`) beside `solve_ik_all`. It does not regard limits, so its answers are turned
into them before they are counted. Seven joints: 64 solutions are asked for.
Every answer is checked with MuJoCo's own kinematics and the joint limits. Prints the tables and writes them to
`benchmarks/results/ik.md`, which the docs include. The peers are an extra, `pip install -e .[benchmark]`; one that is not
installed is left out. `python benchmarks/ik.py --poses 200` is quick.
"""

import argparse
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np
from markdown_table import markdown_table

import armctl
from armctl import Arm, DifferentialIk, Pose, solve_ik, solve_ik_all, solve_ik_batch

ARMS = ["panda", "ur5e", "iiwa14", "xarm7", "gen3"]
POSITION_TOLERANCE, ORIENTATION_TOLERANCE = 1e-5, 1e-4
TRAC_IK_BUDGET = 0.05
TRAC_IK_EPSILON = POSITION_TOLERANCE / 3**0.5  # m, of each coordinate
ROUNDS = 6  # of what another process on the machine may disturb for a while
RACES = 3  # whose medians count: what disturbs one of them does not decide
HOT_TURN = 250  # calls of a solver in a row: few are the first after another solver emptied the caches
COLD_SIZE = 300_000  # float64: 2.4 MB, more than the inner caches of a core
COLD_TURN = 1  # call by call: each call is the first after the other solvers, as in most programs
SWEPT_SOLUTIONS = 64  # asked for with seven joints
ALL_COLUMNS = ["arm", "all solutions by", "hot median us", "cold median us", "right solutions, mean", "most"]
RESULTS = Path(__file__).parent / "results" / "ik.md"
ALL_RESULTS = RESULTS.with_name("ik_all_solutions.md")

Solver = Callable[[Pose], np.ndarray | None]


@dataclass
class Score:
    """What one solver did on one arm in one race."""

    solved: int = 0
    times: list[float] = field(default_factory=list)


def row(scores: list[Score]) -> list[str]:
    """The least share of solved targets in any race, and the median over the races of the median and the 99th percentile."""
    ms, count = 1e3 * np.array([score.times for score in scores]), len(scores[0].times)
    share = 100 * min(score.solved for score in scores) / count
    median, rare = (np.median(np.percentile(ms, q, axis=1)) for q in (50, 99))
    return [f"{share:.2f} % of {count}", f"{median:.3f}", f"{rare:.3f}"]


def armctl_solver(arm: Arm) -> Solver:
    return lambda T: solve_ik(arm, T).q


def toolbox_solver(arm: Arm) -> Solver | None:
    try:
        import roboticstoolbox as rtb
    except ImportError:
        return None
    ets = rtb.ETS()
    for k, X in enumerate(arm.pinocchio_model.placements):
        bounds = [max(arm.limits.q_min[k], -np.pi), min(arm.limits.q_max[k], np.pi)]
        ets *= rtb.ETS(rtb.ET.SE3(X)) * rtb.ETS(rtb.ET.Rz(jindex=k, qlim=bounds))
    ets *= rtb.ETS(rtb.ET.SE3(arm.pinocchio_model.T_last_tip))
    return lambda T: ets.ik_LM(T.matrix, tol=0.5 * POSITION_TOLERANCE**2).q


def trac_ik_solver(arm: Arm) -> Solver | None:
    try:
        import pytracik
    except ImportError:
        return None
    solver = pytracik.TRAC_IK("base", "tip", urdf(arm), TRAC_IK_BUDGET, TRAC_IK_EPSILON, pytracik.SolveType.Speed)

    def solve(T: Pose) -> np.ndarray | None:
        w, x, y, z = T.quat
        code, *q = pytracik.ik(solver, arm.home, *T.position, x, y, z, w)
        return np.array(q) if code >= 0 else None

    return solve


def urdf(arm: Arm) -> str:
    """The chain as a URDF, for solvers that read nothing else."""

    def origin(X: np.ndarray) -> str:
        T = Pose.from_rotation(X[:3, 3], X[:3, :3])
        return f'<origin xyz="{words(T.position)}" rpy="{words(T.rpy)}"/>'

    def words(numbers: np.ndarray) -> str:
        return " ".join(f"{x:.17g}" for x in numbers)

    names = ["base", *(f"link{k}" for k in range(arm.n)), "tip"]
    parts = [f'<link name="{name}"/>' for name in names]
    for k, X in enumerate([*arm.pinocchio_model.placements, arm.pinocchio_model.T_last_tip]):
        ends = f'<parent link="{names[k]}"/><child link="{names[k + 1]}"/>{origin(X)}'
        if k == arm.n:
            parts.append(f'<joint name="joint{k}" type="fixed">{ends}</joint>')
            break
        low, high = max(arm.limits.q_min[k], -np.pi), min(arm.limits.q_max[k], np.pi)
        limit = f'<limit lower="{low:.17g}" upper="{high:.17g}" effort="1" velocity="1"/>'
        parts.append(f'<joint name="joint{k}" type="revolute">{ends}<axis xyz="0 0 1"/>{limit}</joint>')
    return f'<robot name="{arm.name}">{"".join(parts)}</robot>'


class Judge:
    """MuJoCo's own kinematics."""

    def __init__(self, arm: Arm):
        self.arm, self.data = arm, mujoco.MjData(arm.model)

    def solves(self, q: np.ndarray | None, target: Pose) -> bool:
        if q is None or not self.arm.limits.contains(q, 1e-5):
            return False
        self.data.qpos[:] = self.arm.qpos(q)
        mujoco.mj_kinematics(self.arm.model, self.data)
        R = self.data.xmat[self.arm.tip_body].reshape(3, 3)
        T = Pose.from_rotation(self.data.xpos[self.arm.tip_body], R) @ self.arm.T_body_tip
        off, turned = T.distance(target)
        return off <= POSITION_TOLERANCE * (1 + 1e-6) and turned <= ORIENTATION_TOLERANCE * (1 + 1e-6)


def poses(arm: Arm, count: int, at_limits: bool, rng: np.random.Generator) -> list[Pose]:
    """Poses of random positions; at limits, about half of the joints are at one."""
    Q = arm.limits.random(np.zeros(arm.n), count, rng)
    if at_limits:
        bounds = np.where(rng.random(Q.shape) < 0.5, arm.limits.q_min, arm.limits.q_max)
        Q = np.where(np.isfinite(bounds) & (rng.random(Q.shape) < 0.5), bounds, Q)
    return [arm.fk(q) for q in Q]


def race(
    solvers: dict[str, Solver],
    judge: Judge,
    targets: list[Pose],
    turn_length: int = HOT_TURN,
    written: np.ndarray | None = None,
) -> dict[str, Score]:
    """Every solver on every target, in turns of `turn_length` targets; an array given is written before each call."""
    scores = {name: Score() for name in solvers}
    for first in range(0, len(targets), turn_length):
        turn = targets[first : first + turn_length]
        for name, solver in solvers.items():
            answers = []
            for target in turn:
                if written is not None:
                    written += 1.0
                start = time.perf_counter()
                answers.append(solver(target))
                scores[name].times.append(time.perf_counter() - start)
            scores[name].solved += sum(map(judge.solves, answers, turn))
    return scores


def eaik_solver(arm: Arm) -> Callable[[Pose], np.ndarray] | None:
    """All solutions by EAIK for six joints, without regard to the limits; None if it is not installed or has no solution."""
    try:
        from eaik.IK_HP import HPRobot
    except ImportError:
        return None
    T = np.eye(4)
    axes = []
    points = [np.zeros(3)]
    for X in arm.pinocchio_model.placements:
        T = T @ X
        axes.append(T[:3, 2])
        points.append(T[:3, 3])
    tip = T @ arm.pinocchio_model.T_last_tip
    robot = HPRobot(np.array(axes), np.diff([*points, tip[:3, 3]], axis=0))
    if not robot.hasKnownDecomposition():
        return None
    turn = np.eye(4)
    turn[:3, :3] = tip[:3, :3].T  # EAIK's tip has the orientation of the base in the zero configuration
    return lambda T: robot.IK(T.matrix @ turn).Q


def inside_limits(arm: Arm, q: np.ndarray) -> np.ndarray:
    """A configuration turned by whole turns into the limits, as far as they permit."""
    q = q + 2 * np.pi * np.round((arm.home - q) / (2 * np.pi))
    q = q - 2 * np.pi * np.ceil(np.maximum(0.0, q - arm.limits.q_max) / (2 * np.pi))
    return q + 2 * np.pi * np.ceil(np.maximum(0.0, arm.limits.q_min - q) / (2 * np.pi))


def all_solutions(arm: Arm, judge: Judge, targets: list[Pose]) -> list[list[str]]:
    """Rows of the table of all solutions: solvers in turns of HOT_TURN targets, and call by call."""
    limit = 256 if arm.n == 6 else SWEPT_SOLUTIONS
    solvers: dict[str, Callable[[Pose], np.ndarray]] = {"armctl": lambda T: solve_ik_all(arm, T, limit).q}
    eaik = eaik_solver(arm) if arm.n == 6 else None
    if eaik is not None:
        solvers["EAIK"] = eaik
    times: dict[tuple[str, int], list[float]] = {(name, turn): [] for name in solvers for turn in (HOT_TURN, COLD_TURN)}
    found: dict[str, list[np.ndarray]] = {name: [] for name in solvers}
    for turn in (HOT_TURN, COLD_TURN):
        for first in range(0, len(targets), turn):
            for name, solver in solvers.items():
                for target in targets[first : first + turn]:
                    start = time.perf_counter()
                    answer = solver(target)
                    times[name, turn].append(time.perf_counter() - start)
                    if turn == HOT_TURN:
                        found[name].append(answer)
    rows = []
    for name in solvers:
        right = [
            sum(judge.solves(inside_limits(arm, q), target) for q in answers)
            for answers, target in zip(found[name], targets, strict=True)
        ]
        hot = 1e6 * np.median(times[name, HOT_TURN])
        cold = 1e6 * np.median(times[name, COLD_TURN])
        rows.append([arm.name, name, f"{hot:.1f}", f"{cold:.1f}", f"{np.mean(right):.2f}", f"{np.max(right)}"])
    return rows


def seconds(function: Callable[..., object], *args: object, **options: object) -> float:
    """How long a call takes."""
    start = time.perf_counter()
    function(*args, **options)
    return time.perf_counter() - start


def _roots(count: int) -> None:
    numbers = np.full(16_384, 2.0)  # in the inner caches of a core; NumPy releases the GIL meanwhile
    for _ in range(count // numbers.size):
        np.sqrt(numbers, out=numbers)


def arithmetic(threads: int) -> None:
    """Plain arithmetic in the inner caches, shared by threads: what of a second core this machine gives."""
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(_roots, [20_000_000 // threads] * threads))


def mink_steps(arm: Arm, targets: list[Pose]) -> list[float]:
    """Microseconds of a step: on the way to far targets, and following one that moves near by. Medians, of the best round."""
    follower, dt, home = DifferentialIk(arm), 0.01, arm.fk(arm.home)
    circle = [home @ Pose([0.05 * np.cos(t) - 0.05, 0.05 * np.sin(t), 0.0]) for t in np.linspace(0, 4 * np.pi, 1000)]
    far = [target for target in targets[:20] for _ in range(50)]
    best = [np.inf, np.inf]
    for k in [0, 1] * ROUNDS:
        q, steps = np.array(arm.home), []
        for target in circle if k else far:
            start = time.perf_counter()
            v = follower.step(q, target, dt)
            steps.append(time.perf_counter() - start)
            q = q + dt * v
        best[k] = min(best[k], 1e6 * float(np.median(steps)))
    return best


def unreachable(arm: Arm, targets: list[Pose], rng: np.random.Generator) -> list[Pose]:
    """Poses with no solution whose point is about as far as the tip can come, or nearer."""
    middle = arm.pinocchio_model.placements[0, :3, 3]
    reach = max(float(np.linalg.norm(target.position - middle)) for target in targets)
    ways, turns = rng.normal(size=(200, 3)), rng.normal(size=(200, 4))
    far = rng.uniform(0.9, 1.1, (200, 1)) * reach / np.linalg.norm(ways, axis=1, keepdims=True)
    beside = map(Pose, middle + far * ways, turns)
    return [pose for pose in beside if not solve_ik(arm, pose).ok][:50]


def rates(arm: Arm, targets: list[Pose]) -> list[str]:
    """The batch's rate on one thread and on two, the mink step, poses out of reach, and the jumps of warm starts."""
    T = np.array([target.matrix for target in targets] * 10)
    rate, plain = {1: 0.0, 2: 0.0}, {1: np.inf, 2: np.inf}
    for threads in [1, 2] * ROUNDS:
        rate[threads] = max(rate[threads], len(T) / seconds(solve_ik_batch, arm, T, threads=threads))
        plain[threads] = min(plain[threads], seconds(arithmetic, threads))
    every = [seconds(solve_ik_all, arm, target) for target in targets[:50]]
    far = np.median([seconds(solve_ik, arm, Pose([3.0, 1.0, 1.0])) for _ in range(50)])
    edge = np.median([seconds(solve_ik, arm, pose) for pose in unreachable(arm, targets, np.random.default_rng(4))])
    rng, jumps = np.random.default_rng(5), 0
    for q in arm.limits.random(np.zeros(arm.n), 1000, rng):
        near = arm.limits.clamp(q + rng.uniform(-0.05, 0.05, arm.n))
        jumps += bool(np.abs(solve_ik(arm, arm.fk(near), q).q - q).max() > 0.5)
    return [
        f"{rate[1]:.0f}",
        f"{rate[2] / rate[1]:.2f}",
        f"{plain[1] / plain[2]:.2f}",
        f"{1e3 * np.median(every):.2f}",
        f"{1e3 * far:.2f}",
        f"{1e3 * edge:.2f}",
        f"{jumps} of 1000",
        *(f"{step:.0f}" for step in mink_steps(arm, targets)),
    ]


def misses(arm: Arm, count: int) -> str:
    """How many poses with joints at their limits `solve_ik_batch` misses, and how many starts the slowest takes."""
    targets = poses(arm, count, True, np.random.default_rng(9))
    found = solve_ik_batch(arm, targets if arm.n >= 6 else np.array([T.position for T in targets]))
    return f"{arm.name}: {int((~found.ok).sum())} of {count} missed; at most {found.starts.max()} starts"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--poses", type=int, default=2000, help="random poses an arm")
    parser.add_argument("--limit-poses", type=int, default=600, help="poses with joints at their limits")
    parser.add_argument("--arms", nargs="*", default=ARMS)
    parser.add_argument("--misses", type=int, metavar="N", help="only count the misses among N poses at joint limits per arm")
    parser.add_argument(
        "--all", action="store_true", help="only the table of all solutions, which is written to a file of its own"
    )
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    if options.misses:
        for name in options.arms:
            print(misses(armctl.load(name), options.misses), flush=True)
        return
    if options.all:
        arms = [armctl.load(name) for name in options.arms]
        rows = [
            cells
            for arm in arms
            for cells in all_solutions(arm, Judge(arm), poses(arm, options.poses, False, np.random.default_rng(2)))
        ]
        text = markdown_table(ALL_COLUMNS, rows) + "\n"
        print(text)
        ALL_RESULTS.write_text(text, encoding="utf-8")
        return
    solver_columns = ["arm", "solver", "solved", "median ms", "p99 ms", "after writing 2.4 MB", "after the other solvers"]
    solver_columns += ["solved at joint limits"]
    solver_rows = []
    rate_columns = [
        "arm",
        "batch, solves/s",
        "two threads, times",
        "plain arithmetic, times",
        "all solutions, ms",
        "far out of reach, ms",
        "just out, ms",
    ]
    rate_columns += ["jumps of warm starts", "mink step, us", "following, us"]
    rate_rows = []
    for name in options.arms:
        arm = armctl.load(name)
        judge, rng = Judge(arm), np.random.default_rng(2)
        makers = {"armctl": armctl_solver, "Robotics Toolbox `ik_LM`": toolbox_solver, "TRAC-IK (50 ms)": trac_ik_solver}
        solvers = {label: solver for label, make in makers.items() if (solver := make(arm)) is not None}
        race(solvers, judge, poses(arm, 20, False, rng))  # compiles, warms caches
        targets = poses(arm, options.poses, False, rng)
        anywhere = [race(solvers, judge, targets) for _ in range(RACES)]
        cold = [race(solvers, judge, targets, written=np.zeros(COLD_SIZE)), race(solvers, judge, targets, COLD_TURN)]
        at_limits = race(solvers, judge, poses(arm, options.limit_poses, True, rng))
        for label in solvers:
            limits = at_limits[label]
            figures = row([scores[label] for scores in anywhere])
            cold_figures = [f"{1e3 * np.median(scores[label].times):.3f}" for scores in cold]
            solver_rows.append([name, label, *figures, *cold_figures, f"{limits.solved} of {len(limits.times)}"])
        for label in makers.keys() - solvers.keys():
            solver_rows.append([name, label, "not installed", "", "", "", "", ""])
        rate_rows.append([name, *rates(arm, targets)])
    text = markdown_table(solver_columns, solver_rows) + "\n\n" + markdown_table(rate_columns, rate_rows) + "\n"
    print(text)
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
