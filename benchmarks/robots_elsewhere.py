"""Robots that others describe: which files load, as what, whether their kinematics are right, and why others do not.

    python benchmarks/robots_elsewhere.py [--folder FOLDER ...] [--leave-out NAME ...] [--poses 20] [--moves 3] [--limit 120]

Every MJCF, URDF and xacro with a joint in the folders is loaded as a whole; without --folder, in the packages of this Python.
--leave-out names folders without robots. At random configurations the poses of all tips are compared with those of MuJoCo, or
for a URDF of Pinocchio, which read the file themselves; joints that are held are where armctl holds them. `solve_ik` gets the
tips' poses of other configurations, `move_to` with computed torque, of arms with one tip, their points one after another. The
second table has the sentences with which files are refused, how many of these files MuJoCo or Pinocchio reads, and an example.
"""

from __future__ import annotations

import argparse
import signal
import sysconfig
import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

import mujoco
import numpy as np
import pinocchio
from markdown_table import markdown_table

import armctl

COLUMNS = ("folder", "file", "joints", "tips", "largest error of fk", "IK", "moves")
REFUSALS = ("refused because", "files", "read by others", "for example")
TOLERANCE = 1e-9  # m and of rotation matrices
_ENDINGS = (".urdf", ".xml", ".mjcf", ".xacro")
_HEAD_CHARACTERS = 200_000  # of a file, in which its first joint is expected
_SHOWN_TIPS = 5
_SHOWN_CHARACTERS = 200
_JUDGED_POSES = 10

# The matrices of tips by name, from the positions of joints by name.
Judge = Callable[[Mapping[str, float], list[str]], dict[str, np.ndarray]]


@dataclass(frozen=True)
class Loaded:
    """A file that loads: what it is, the largest difference of the poses of its tips to the judge's, and how it does."""

    path: Path
    arm: armctl.Arm
    error: float | None  # None if the judge cannot read the file, or it has no names
    solved: str
    moves: Counter[str]

    @property
    def is_right(self) -> bool:
        """Whether it stands within its limits, and its tips are where the judge has them."""
        limits = self.arm.limits
        is_inside = bool(np.all((self.arm.home >= limits.q_min) & (self.arm.home <= limits.q_max)))
        return is_inside and (self.error is None or self.error < TOLERANCE)


@dataclass(frozen=True)
class Refused:
    """A file that does not load, and the sentence without the file's name."""

    path: Path
    sentence: str


class TooSlowError(Exception):
    """A file took longer than the limit."""


def robot_files(folder: Path, left_out: list[str]) -> list[Path]:
    """The files below a folder that describe something with joints."""
    paths = [path for path in sorted(folder.rglob("*")) if path.suffix.lower() in _ENDINGS]
    return [path for path in paths if not set(path.relative_to(folder).parts) & set(left_out) and _has_joints(path)]


def _has_joints(path: Path) -> bool:
    try:
        head = path.read_text(errors="replace")[:_HEAD_CHARACTERS]
    except OSError:
        return False
    return "<joint" in head and ("<mujoco" in head or "<robot" in head)


def judge_of(path: Path) -> Judge | None:
    """MuJoCo, or for a URDF Pinocchio, with a model that it read from the file itself; None if it cannot read it."""
    try:
        if path.suffix.lower() == ".urdf":
            return _judge_by_pinocchio(pinocchio.buildModelFromUrdf(str(path)))
        return _judge_by_mujoco(mujoco.MjModel.from_xml_path(str(path)))
    except ValueError:
        return None


def _judge_by_pinocchio(model: pinocchio.Model) -> Judge:
    data = model.createData()

    def matrices(positions: Mapping[str, float], tips: list[str]) -> dict[str, np.ndarray]:
        q = pinocchio.neutral(model)
        for name, x in positions.items():
            joint = model.joints[model.getJointId(name)]
            q[joint.idx_q : joint.idx_q + joint.nq] = [x] if joint.nq == 1 else [np.cos(x), np.sin(x)]
        pinocchio.framesForwardKinematics(model, data, q)
        link = pinocchio.FrameType.BODY
        return {tip: data.oMf[model.getFrameId(tip, link)].homogeneous for tip in tips if model.existFrame(tip, link)}

    return matrices


def _judge_by_mujoco(model: mujoco.MjModel) -> Judge:
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, max(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home"), 0))

    def matrices(positions: Mapping[str, float], tips: list[str]) -> dict[str, np.ndarray]:
        for name, x in positions.items():
            data.joint(name).qpos[:] = x
        mujoco.mj_kinematics(model, data)
        found = {}
        for tip in tips:
            for kind, places, rotations in (
                (mujoco.mjtObj.mjOBJ_SITE, data.site_xpos, data.site_xmat),
                (mujoco.mjtObj.mjOBJ_BODY, data.xpos, data.xmat),
                (mujoco.mjtObj.mjOBJ_GEOM, data.geom_xpos, data.geom_xmat),
            ):
                number = mujoco.mj_name2id(model, kind, tip)
                if number >= 0:
                    found[tip] = np.eye(4)
                    found[tip][:3, :3] = rotations[number].reshape(3, 3)
                    found[tip][:3, 3] = places[number]
                    break
        return found

    return matrices


def error_of(arm: armctl.Arm, judge: Judge | None) -> float | None:
    """The largest difference of the poses of all tips to the judge's at random configurations; None without names."""
    if judge is None:
        return None
    model = arm.model
    scalar = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    joints = [model.joint(number) for number in range(model.njnt) if model.jnt_type[number] in scalar]
    if not joints or not all(joint.name for joint in joints):
        return None
    errors = []
    for q in arm.limits.random(arm.home, _JUDGED_POSES, np.random.default_rng(2)):
        qpos = arm.qpos(q)
        found = judge({joint.name: float(qpos[joint.qposadr[0]]) for joint in joints}, list(arm.tips))
        if len(found) < len(arm.tips):
            return None
        errors += [np.abs(arm.fk(q, tip).matrix - matrix).max() for tip, matrix in found.items()]
    return float(max(errors))


def solved_of(arm: armctl.Arm, count: int) -> str:
    """How many sets of poses of all tips `solve_ik` solves."""
    solved = 0
    for q in arm.limits.random(arm.home, count, np.random.default_rng(0)):
        target = {tip: arm.fk(q, tip) for tip in arm.tips}
        solved += armctl.solve_ik(arm, target if len(target) > 1 else target[arm.tip]).ok
    return f"{solved}/{count}"


def moves_of(arm: armctl.Arm, count: int) -> Counter[str]:
    """Outcomes of moves of an arm with one tip to the points of random configurations.

    A move is reached, refused (with a reason, before anything moves) or missed.
    """
    outcomes: Counter[str] = Counter()
    if len(arm.tips) > 1 or not count:
        return outcomes
    sim = armctl.Simulation(arm, "computed-torque")
    for q in arm.limits.random(arm.home, count, np.random.default_rng(1)):
        sim.reset()
        result = sim.move_to(arm.fk(q).position)
        outcomes["reached" if result else "missed" if result.duration else "refused"] += 1
    return outcomes


def checked(path: Path, poses: int, moves: int) -> Loaded | Refused:
    """Loads a file, which compares its models; judges its tips, solves poses and moves."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            arm = armctl.load(path)
        return Loaded(
            path=path,
            arm=arm,
            error=error_of(arm, judge_of(path)),
            solved=solved_of(arm, poses),
            moves=moves_of(arm, moves),
        )
    except (armctl.ArmctlError, TooSlowError) as error:
        sentence = str(error)
        for label in (path.name, path.stem):
            sentence = sentence.partition(f"{label}: ")[2] or sentence
        return Refused(path, sentence)


def is_read_elsewhere(path: Path) -> bool:
    """Whether MuJoCo itself compiles a file, or Pinocchio's parser reads it as a URDF."""
    for read in (mujoco.MjModel.from_xml_path, pinocchio.buildModelFromUrdf):
        try:
            read(str(path))
            return True
        except ValueError:
            continue
    return False


def loaded_table(loaded: list[Loaded], folders: list[Path]) -> str:
    """A row for each file that loads."""
    rows = []
    for each in loaded:
        tips = ", ".join(each.arm.tips[:_SHOWN_TIPS]) + (", ..." if len(each.arm.tips) > _SHOWN_TIPS else "")
        error = "not comparable" if each.error is None else f"{each.error:.0e}"
        count = str(len(each.arm.tips))
        outcomes = ", ".join(f"{number} {kind}" for kind, number in each.moves.items())
        rows.append([*_place(each.path, folders), each.arm.n, f"{count}: {tips}", error, each.solved, outcomes])
    return markdown_table(COLUMNS, rows)


def refused_table(refused: list[Refused], folders: list[Path]) -> str:
    """A row for each sentence with which files are refused."""
    rows = []
    for sentence, count in Counter(each.sentence for each in refused).most_common():
        paths = [each.path for each in refused if each.sentence == sentence]
        example = " ".join(_place(paths[0], folders))
        rows.append([sentence[:_SHOWN_CHARACTERS], count, sum(map(is_read_elsewhere, paths)), example])
    return markdown_table(REFUSALS, rows)


def _place(path: Path, folders: list[Path]) -> tuple[str, str]:
    """The folder that was searched, and the name of a file with that of its own folder."""
    folder = next(folder for folder in folders if path.is_relative_to(folder))
    return folder.name, "/".join(path.relative_to(folder).parts[-2:])


def _stop(_signal: int, _frame: FrameType | None) -> None:
    raise TooSlowError("longer than the limit of this benchmark")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--folder", type=Path, nargs="+", default=[Path(sysconfig.get_path("purelib"))])
    parser.add_argument("--leave-out", nargs="+", default=[], help="names of folders without robots")
    parser.add_argument("--poses", type=int, default=20)
    parser.add_argument("--moves", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "robots_elsewhere.md")
    parser.add_argument("--limit", type=float, default=120.0, help="seconds of CPU for each file")
    args = parser.parse_args()
    signal.signal(signal.SIGPROF, _stop)
    loaded: list[Loaded] = []
    refused: list[Refused] = []
    for folder in args.folder:
        for path in robot_files(folder, args.leave_out):
            signal.setitimer(signal.ITIMER_PROF, args.limit)
            outcome = checked(path, args.poses, args.moves)
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            if isinstance(outcome, Loaded):
                loaded.append(outcome)
            else:
                refused.append(outcome)
            print(path, outcome.sentence if isinstance(outcome, Refused) else outcome.arm, flush=True)
    moves = sum((each.moves for each in loaded), Counter())
    wrong = [each.path.name for each in loaded if not each.is_right]
    judged = sum(each.error is not None for each in loaded)
    several = sum(len(each.arm.tips) > 1 for each in loaded)
    summary = (
        f"{len(loaded)} of {len(loaded) + len(refused)} files load, {several} of them with several tips. "
        f"{len(loaded) - len(wrong)} stand within their limits; of {judged} MuJoCo or Pinocchio could judge the tips, and "
        f"{judged - len(wrong)} are right.\n"
    )
    if moves:
        counts = ", ".join(f"{count} {kind}" for kind, count in sorted(moves.items()))
        summary += f"{moves.total()} moves to random reachable points: {counts}.\n"
    args.out.write_text(
        f"{summary}\n{loaded_table(loaded, args.folder)}\n\n{refused_table(refused, args.folder)}\n", encoding="utf-8"
    )
    print(summary)
    if wrong:
        raise SystemExit(f"wrong: {', '.join(wrong)}")


if __name__ == "__main__":
    main()
