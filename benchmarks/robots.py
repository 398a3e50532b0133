"""Every chain of every robot at hand: joints, limits and their source, model parity, inverse kinematics, tracking.

    python benchmarks/robots.py [--poses 1000] [--out docs/robots.md]

It writes the page `docs/robots.md`. A robot is at hand where MENAGERIE_ROOT or the cache of `mujoco-menagerie` holds it.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mujoco_menagerie as menagerie
import numpy as np

import armctl
from armctl.collision.checkers import collision_checker
from armctl.ik import solve_ik_batch
from armctl.loading.catalog import BUNDLED
from armctl.robot.parity import check_parity

PAGE = Path(__file__).parent.parent / "docs" / "robots.md"
EXACT = 1e-6  # rad, m: below it, tracking counts as exact
RIGID = 0.999  # of 1, the impedance of an equality that counts as rigid
STEP = 0.2  # rad, m: how far the joints move from home in the tracking runs
HEAD = """# Robots

Every serial chain of the robots that were at hand when this page was made, by `python benchmarks/robots.py`. The command
`armctl chains NAME` finds them; `load(NAME, base=..., tip=..., hold_base=True)` takes one.

- Parity: the largest difference between armctl's model and MuJoCo's in tip pose, mass matrix and bias, over 20 states.
- IK: of {poses} poses, each of some position inside the limits, the share that `solve_ik` finds again, within 1e-5 m.
- PD, computed torque: the joint errors on a motion of up to {step} rad from home, RMS for PD, the largest for computed torque.
- Joints in brackets follow the one before them: an equality ties them to it.

"""
COLUMNS = (
    "| base to tip | joints | torque limits | speed limits | parity | IK | PD, rad | computed torque, rad | |\n"
    + "|---" * 9
    + "|\n"
)


@dataclass(frozen=True)
class Row:
    """What was measured of one chain; `reason` says why its tracking is not exact, where it is not."""

    arm: armctl.Arm
    base: str
    parity: float
    solved: float
    pd: float
    computed_torque: float
    reason: str

    def __str__(self) -> str:
        arm, joints = self.arm, joints_of(self.arm)
        figures = f"{self.parity:.0e} | {100 * self.solved:.1f} % | {self.pd:.1e} | {self.computed_torque:.0e} | {self.reason}"
        return f"| {self.base} to {arm.tip} | {joints} | {arm.sources['tau_max']} | {arm.sources['v_max']} | {figures} |"


def joints_of(arm: armctl.Arm) -> str:
    """The joints of an arm, each with those that follow it in brackets."""
    names, ratio = [arm.model.joint(joint).name for joint in arm.joint_map.joints], arm.joint_map.ratio
    texts = []
    for i, leader in enumerate(arm.joint_names):
        others = [name for name, share in zip(names, ratio[:, i], strict=True) if share and name != leader]
        texts.append(f"{leader} ({', '.join(others)})" if others else leader)
    return ", ".join(texts)


def robots_at_hand() -> list[str]:
    """The bundled arm and the robots of Menagerie that need no download, each without its scene."""
    store = menagerie.Cache()
    here = [r for r in menagerie.robots() if ((store.root / r.name).is_dir() if store.root else store.is_cached(r))]
    return [BUNDLED, *(f"{robot.name}/{robot.default_model}" for robot in here)]


def chains_of(robot: str) -> Iterator[tuple[str, armctl.Arm]]:
    """The chains that can be loaded, with their bases; those that can move at once are loaded at once."""
    waiting = [chain for chain in armctl.chains(robot) if chain.ok]
    while waiting:
        first = waiting[0]
        together = [first]
        for chain in waiting[1:]:
            apart = all(not set(chain.actuator_names) & set(other.actuator_names) for other in together)
            if apart and chain.base == first.base:
                together.append(chain)
        waiting = [chain for chain in waiting if chain not in together]
        base = None if first.base == "world" else first.base
        for arm in armctl.load_arms(robot, [chain.tip for chain in together], base=base, hold_base=True):
            yield first.base, arm


def measure(arm: armctl.Arm, base: str, poses: int) -> Row:
    """Parity, inverse kinematics and tracking of one chain."""
    parity = check_parity(arm, samples=20)
    targets = [arm.fk(q) for q in arm.limits.random(arm.home, poses, np.random.default_rng(0))]
    solved = solve_ik_batch(arm, targets)
    found = np.mean([_is_answer(arm, q, T) for q, T, ok in zip(solved.q, targets, solved.ok, strict=True) if ok] or [0.0])
    goal, reason = _goal(arm)
    there = armctl.move_j(arm, arm.home, goal)
    logs = [armctl.simulate(arm, name, there, dwell=0.0) for name in ("pd", "computed-torque")]
    errors = [log.q - log.q_ref for log in logs]
    if not reason and np.abs(errors[1]).max() > EXACT and not arm.joint_map.is_plain and not _is_rigid(arm):
        reason = "an equality of the model ties joints to each other, and gives way"
    if not reason and (np.abs(logs[1].tau_cmd) > logs[1].tau_max).any():
        reason = "a motor saturates"
    rms = float(np.sqrt(np.mean(errors[0] ** 2)))
    return Row(arm, base, parity, float(found * solved.ok.mean()), rms, float(np.abs(errors[1]).max()), reason)


def _is_rigid(arm: armctl.Arm) -> bool:
    """Whether the equalities of a model leave their joints no give: MuJoCo's impedance is nearly 1 from the start."""
    return bool((arm.model.eq_solimp[:, 0] >= RIGID).all())


def _is_answer(arm: armctl.Arm, q: np.ndarray, target: armctl.Pose) -> bool:
    return bool(np.linalg.norm(arm.fk(q).position - target.position) < 2e-5)


def _goal(arm: armctl.Arm) -> tuple[np.ndarray, str]:
    """A position near home that the arm reaches without touching anything, or why there is none."""
    contacts, touching = collision_checker(arm), ""
    for sign in (1.0, -1.0):
        for share in (1.0, 0.1):
            goal = arm.limits.clamp(arm.home + sign * share * STEP)
            if np.array_equal(goal, arm.home):
                continue
            touching = contacts.along(arm.home + np.linspace(0, 1, 12)[:, None] * (goal - arm.home))
            if not touching:
                return goal, ""
    return arm.limits.clamp(arm.home + STEP), f"{touching} at home"


def page(poses: int) -> str:
    """The whole page."""
    text = HEAD.format(poses=poses, step=STEP)
    for robot in robots_at_hand():
        rows = [measure(arm, base, poses) for base, arm in chains_of(robot)]
        refused = [chain for chain in armctl.chains(robot) if not chain.ok]
        text += f"## {robot}\n\n" + (COLUMNS + "".join(f"{row}\n" for row in rows) if rows else "") + ("\n" if rows else "")
        if refused:
            text += "Refused, with the reason:\n\n"
            text += "".join(f"- {chain.reason}\n" for chain in refused) + "\n"
        print(f"{robot}: {len(rows)} chains, {len(refused)} refused", flush=True)
    return text.rstrip() + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--poses", type=int, default=1000)
    parser.add_argument("--out", type=Path, default=PAGE)
    args = parser.parse_args()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", armctl.ArmctlWarning)
        args.out.write_text(page(args.poses), encoding="utf-8")
    print(f"written: {args.out}")
