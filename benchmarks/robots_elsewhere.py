"""Robots that others describe: which files of installed packages load, and how well the arms in them do.

    python benchmarks/robots_elsewhere.py [--folder FOLDER ...] [--poses 50] [--moves 3] [--limit 60] [--out FILE]

Every MJCF, URDF and xacro with a joint in the folders is loaded; without --folder, in the packages of this Python. Of several
equally long chains the first is taken, and a free base is held. `solve_ik` gets the poses of random configurations, `move_to`
the points of others, one after another, with computed torque. A move counts as reached, refused (with a reason, before
anything moves) or missed. The second table sorts the files that do not load by their reason, and says how many of them MuJoCo
itself, or for a URDF Pinocchio's parser, reads.
"""

from __future__ import annotations

import argparse
import signal
import sysconfig
import time
import warnings
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

import mujoco
import numpy as np
import pinocchio
from markdown_table import markdown_table

import armctl

COLUMNS = ("file", "joints", "tip", "IK", "moves", "gripper", "load, s", "warnings", "reason")
_ENDINGS = (".urdf", ".xml", ".mjcf", ".xacro")
_HEAD_CHARACTERS = 200_000  # of a file, in which its first joint is expected
_SHOWN_CHARACTERS = 60


# Reasons for which a file does not load, by a phrase of armctl's message.
_REASONS = {
    "the model has no joints": "no joints: an object, or macros of xacro without a robot",
    "a part of an MJCF": "a part of another file",
    "URDF joint parent or child missing": "a part of another file",
    "Error opening file": "a file that it needs is not in the package",
    "Package not found": "a file that it needs is not in the package",
    "No such file": "a file that it needs is not in the package",
    "is planar": "a URDF's planar joint, which has neither limits nor motors",
    "no hinge or slide joint has an actuator": "a free object or a mechanism, no serial chain with motors",
    "has no actuator of its own": "its first joint has no motor: a planar walker, a mobile base",
    "closes a loop": "its joints are in a closed loop",
    "coupled": "its joints are tied in no fixed ratio: tendons, several actuators",
    "longer than the limit": "takes longer than the limit",
}
_INVALID = "invalid: not the XML, the elements or the values that MJCF or URDF allow"


@dataclass(frozen=True)
class Outcome:
    """What came of one file: whether it loaded, or else the reason."""

    path: Path
    kind: str
    cells: tuple[str, ...]
    moves: Counter[str] = field(default_factory=Counter)


class TooSlowError(Exception):
    """A file took longer than the limit."""


def robot_files(folder: Path) -> list[Path]:
    """The files below a folder that describe something with joints."""
    return [path for path in sorted(folder.rglob("*")) if path.suffix.lower() in _ENDINGS and _has_joints(path)]


def _has_joints(path: Path) -> bool:
    try:
        head = path.read_text(errors="replace")[:_HEAD_CHARACTERS]
    except OSError:
        return False
    return "<joint" in head and ("<mujoco" in head or "<robot" in head)


def load_any(path: Path) -> armctl.Arm:
    """The arm of a file, its base held if it is free; the first of several equally long chains."""
    try:
        return armctl.load(path)
    except armctl.ModelError:
        first = next((chain for chain in armctl.chains(path) if chain), None)
        if first is None:
            raise
        return armctl.load(path, tip=first.tip)


def gripper_of(arm: armctl.Arm) -> str:
    """The opening of the arm's gripper, or nothing."""
    try:
        width = armctl.Simulation(arm, "pd").gripper.model.width
    except armctl.ArmctlError:
        return ""
    return f"{1e3 * float(max(width)):.0f} mm"


def moves_of(arm: armctl.Arm, count: int) -> tuple[Counter[str], list[str]]:
    """Outcomes of moves to the points of random configurations, and the reasons of those that did not reach theirs."""
    outcomes: Counter[str] = Counter()
    reasons = []
    sim = armctl.Simulation(arm, "computed-torque")
    for q in arm.limits.random(arm.home, count, np.random.default_rng(1)):
        sim.reset()
        result = sim.move_to(arm.fk(q).position)
        kind = "reached" if result else "missed" if result.duration else "refused"
        outcomes[kind] += 1
        if not result:
            reasons.append(f"{kind}: {result.reason}")
    return outcomes, reasons


def checked(path: Path, folder: Path, poses: int, moves: int) -> Outcome:
    """Loads a file, which compares its models; solves poses of random configurations and moves to random points."""
    name = str(path.relative_to(folder))[-_SHOWN_CHARACTERS:]
    started = time.perf_counter()
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            arm = load_any(path)
        seconds = time.perf_counter() - started
        targets = [arm.fk(q) for q in arm.limits.random(arm.home, poses, np.random.default_rng(0))]
        solved = sum(armctl.solve_ik(arm, target).ok for target in targets)
        count = sum(issubclass(each.category, armctl.ArmctlWarning) for each in caught)
        outcomes, reasons = moves_of(arm, moves)
        cells = (
            name,
            str(arm.n),
            arm.tip,
            f"{solved}/{poses}",
            ", ".join(f"{number} {kind}" for kind, number in outcomes.items()),
            gripper_of(arm),
            f"{seconds:.2f}",
            str(count),
            "; ".join(reasons)[: 3 * _SHOWN_CHARACTERS],
        )
        return Outcome(path, "loaded", cells, outcomes)
    except (armctl.ArmctlError, TooSlowError) as error:
        kind = next((reason for phrase, reason in _REASONS.items() if phrase in str(error)), _INVALID)
        return Outcome(path, kind, (name, *[""] * (len(COLUMNS) - 2), str(error)[-2 * _SHOWN_CHARACTERS :]))


def is_read_elsewhere(path: Path) -> bool:
    """Whether MuJoCo itself compiles a file, or Pinocchio's parser reads it as a URDF."""
    try:
        mujoco.MjModel.from_xml_path(str(path))
        return True
    except ValueError:
        pass
    if path.suffix.lower() != ".urdf":
        return False
    try:
        pinocchio.buildModelFromUrdf(str(path))
        return True
    except ValueError:
        return False


def reasons_table(outcomes: list[Outcome], folders: list[Path]) -> str:
    """The files that did not load, by reason."""
    rows = []
    for reason, count in Counter(each.kind for each in outcomes if each.kind != "loaded").most_common():
        paths = [each.path for each in outcomes if each.kind == reason]
        example = next(str(paths[0].relative_to(folder)) for folder in folders if paths[0].is_relative_to(folder))
        rows.append([reason, str(count), str(sum(map(is_read_elsewhere, paths))), example[-_SHOWN_CHARACTERS:]])
    return markdown_table(("not loaded because", "files", "read by others", "for example"), rows)


def _stop(_signal: int, _frame: FrameType | None) -> None:
    raise TooSlowError("longer than the limit")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--folder", type=Path, nargs="+", default=[Path(sysconfig.get_path("purelib"))])
    parser.add_argument("--poses", type=int, default=50)
    parser.add_argument("--moves", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "robots_elsewhere.md")
    parser.add_argument("--limit", type=float, default=60.0, help="seconds of CPU for each file")
    args = parser.parse_args()
    signal.signal(signal.SIGPROF, _stop)
    outcomes = []
    for folder in args.folder:
        for path in robot_files(folder):
            signal.setitimer(signal.ITIMER_PROF, args.limit)
            outcomes.append(checked(path, folder, args.poses, args.moves))
            signal.setitimer(signal.ITIMER_PROF, 0.0)
    print(markdown_table(COLUMNS, [outcome.cells for outcome in outcomes]))
    loaded = [outcome for outcome in outcomes if outcome.kind == "loaded"]
    grippers = sum(bool(outcome.cells[COLUMNS.index("gripper")]) for outcome in loaded)
    moves = sum((outcome.moves for outcome in outcomes), Counter())
    summary = (
        f"{reasons_table(outcomes, args.folder)}\n\n{len(outcomes)} files: {len(loaded)} load, "
        f"{grippers} of them with a gripper; {len(outcomes) - len(loaded)} do not load.\n"
    )
    if moves:
        counts = ", ".join(f"{count} {kind}" for kind, count in sorted(moves.items()))
        summary += f"{moves.total()} moves to random reachable points: {counts}.\n"
    args.out.write_text(summary, encoding="utf-8")
    print("\n" + summary)


if __name__ == "__main__":
    main()
