"""Serial chains in a compiled model: which joints make an arm, and why others do not."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from armctl.core.errors import ModelError, few_names
from armctl.core.validation import shown
from armctl.model.loading.rods import without_rods
from armctl.model.loading.tip import tip_of_chain
from armctl.model.mjmodel.queries import (
    Joints,
    actuator_name,
    body_name,
    branch_counts,
    branches,
    is_below,
    is_free,
    joint_name,
    joints_above,
    joints_of,
    robot_roots,
    welded_behind,
)
from armctl.model.mjmodel.transmissions import Transmissions

_JAW_NAME = re.compile(r"jaw|grip|finger|claw|knuckle", re.IGNORECASE)
_JAW_BODY_NAME = re.compile(r"^(?!.*(fix|static|base)).*(jaw|finger|fngr|claw|moving)", re.IGNORECASE)
_MAX_WHEEL_JOINTS = 2  # a suspension or a steering, and the wheel
_BALANCED = 0.05  # of the radius of gyration: how far the center of mass of a wheel may be off its axis
_TIP_FRAME_NAME = re.compile(r"(?<![a-z])(tcp|grasp|pinch|tip)(?![a-z])", re.IGNORECASE)


@dataclass(frozen=True)
class SerialChain:
    """Joints in series inside a model: an arm, a leg, a finger, a head.

    Attributes:
        base: The body at its start; "world" if no joint moves its base.
        tip: The site or body at its end.
        joint_names: Its joints, from the base to the tip, as an arm's; of joints tied to each other the first one.
        actuator_names: Their actuators; empty for a joint without one.
        followers: The joints, in the chain or beside it, that equalities tie to one of these and that follow it.
        reason: The reason if `armctl.load` rejects it; empty if it does not.
    """

    base: str
    tip: str
    joint_names: tuple[str, ...]
    actuator_names: tuple[str, ...]
    followers: tuple[str, ...] = ()
    reason: str = ""

    @property
    def ok(self) -> bool:
        """Whether `armctl.load(robot, base=..., tip=...)` accepts it."""
        return not self.reason

    def __bool__(self) -> bool:
        return self.ok


@dataclass(frozen=True)
class _JointSeries:
    """Joints in series behind a base."""

    base: int
    joints: Joints


def all_chains(analysis: Transmissions) -> list[SerialChain]:
    """Every serial chain of a model, whose free bases are taken as held: the longest first, last those that cannot be driven.

    A chain ends where the model branches no further, before the fingers of a gripper, and before a joint that cannot be
    driven: the joints after that are a chain of their own, on the body before them.
    """
    model = analysis.model
    runs, refused = _drivable_runs(analysis)
    found: set[_JointSeries] = set()
    fingers = _FingerSearch(analysis, [run.joints for run in runs])
    for run in _longest(runs):
        end = fingers.end_of_arm(run.joints)
        found.add(_JointSeries(run.base, run.joints[:end]))
        found.add(_JointSeries(int(model.jnt_bodyid[run.joints[end - 1]]), run.joints[end:]))
    kept = sorted(_longest({run for run in found if run.joints}), key=lambda run: (run.base, run.joints))
    chains = [_serial_chain(analysis, run, _coupled_above(analysis, run.base, run.joints)) for run in kept]
    chains += [_serial_chain(analysis, run, reason) for run, reason in refused.items()]
    return sorted(chains, key=lambda chain: (not chain.ok, -len(chain.joint_names)))


def several_limbs(analysis: Transmissions, base: int = 0, before: Joints = ()) -> list[Joints]:
    """The limbs of a robot that is more than one arm: two arms, a hand, legs. Empty for an arm, also with a gripper or wheels.

    They start at a base, the world if left out, behind some joints.

    A robot is more than an arm if it has no longest chain, or if another limb has at least half as many joints of its own.
    """
    model = analysis.model
    runs, _ = _drivable_runs(analysis)
    fingers = _FingerSearch(analysis, [run.joints for run in runs])
    behind = {run.joints[len(before) :] for run in _longest(runs) if run.base == 0 and run.joints[: len(before)] == before}
    ends = {joints[: fingers.end_of_arm(joints)] for joints in behind if joints}
    limbs = sorted({end for end in ends if not any(end == other[: len(end)] and end != other for other in ends)})
    limbs = without_rods(analysis, limbs)
    if len(limbs) < 2:
        return []
    without_wheels = [limb for limb in limbs if not _is_wheel(model, limb, limbs)]
    if len(without_wheels) > 1:
        limbs = without_wheels
    try:
        arm = find_chain(analysis, base)
    except ModelError:
        return limbs
    for limb in limbs:
        shared = sum(one == other for one, other in zip(limb, arm, strict=False))
        if shared < len(arm) and 2 * (len(limb) - shared) >= len(arm) - shared:
            return limbs
    return []


def find_chain(analysis: Transmissions, base: int = 0) -> Joints:
    """The arm of a model without a description: its longest run of actuated joints from the base, the world if left out.

    The run ends before the fingers of a gripper: at a body that carries several jointed branches, each with fewer joints than
    come before it, or at joints named like a jaw. ModelError if there is none, or several are equally long.
    """
    model = analysis.model
    actuated = _actuated_runs(analysis, base)
    fingers = _FingerSearch(analysis, actuated)
    runs = set(without_rods(analysis, sorted({run[: fingers.end_of_arm(run)] for run in actuated})))
    longest = max((len(run) for run in runs), default=0)
    if longest == 0:
        raise ModelError(_why_no_arm(analysis, base))
    best = sorted(run for run in runs if len(run) == longest)
    if len(best) > 1:
        best = [run for run in best if not _reason_against(analysis, base, run)] or best[:1]
    if len(best) > 1:
        tips = ", ".join(repr(name) for run in best if (name := _selectable_tip(model, run)))
        on = f"on {shown(body_name(model, base))}" if base else "at the base"
        raise ModelError(
            f"{len(best)} chains of {longest} joints start {on}; choose one with tip=: {tips or 'name a body first'}"
        )
    _check_drivable(analysis, base, best[0])
    return best[0]


def _selectable_tip(model: mujoco.MjModel, run: Joints) -> str:
    """The name that `tip=` accepts for the end of a run; empty if nothing there has a name."""
    tip = tip_of_chain(model, run)
    kinds = (mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_GEOM)
    if any(mujoco.mj_name2id(model, kind, tip.name) >= 0 for kind in kinds):
        return tip.name
    names = (model.geom(int(geom)).name for geom in np.flatnonzero(model.geom_bodyid == tip.body))
    return next(filter(None, names), "")


def chain_to(analysis: Transmissions, body: int, base: int = 0) -> Joints:
    """All joints from a base, the world if left out, to a body; ModelError if one cannot be driven."""
    model = analysis.model
    name = shown(body_name(model, body))
    if not is_below(model, body, base):
        raise ModelError(f"{name} is not attached to {shown(body_name(model, base))}; choose a base among its ancestors")
    joints = joints_above(model, body, base)
    if joints and is_free(model, joints[0]):
        raise ModelError(_free_base_reason(model, joints[0]))
    if not joints:
        raise ModelError(f"no joint moves {name}, so it cannot be the tip of an arm")
    try:
        _check_drivable(analysis, base, joints)
    except ModelError as error:
        raise ModelError(f"in the chain to {name}: {error}; base= a body after this joint holds the joint") from None
    return joints


def end_note(analysis: Transmissions, joints: Joints) -> list[str]:
    """One sentence if a chain continues with a joint that nothing drives; or none."""
    model = analysis.model
    behind = branches(model, int(model.jnt_bodyid[joints[-1]]))
    if len(behind) != 1:
        return []
    following = joints_of(model, behind[0])[0]
    if following in analysis.actuators or analysis.coupling_reason(following):
        return []
    return [f"the arm ends before joint {joint_name(model, following)!r}, which has no actuator of its own and is held"]


def held_note(analysis: Transmissions, joints: Joints, end: int | None = None) -> list[str]:
    """One sentence on the joints of a robot that are none of an arm's and stay at home, and the first reason; or none.

    With the body `end` of an arm's last joint, they are only those beside the arm that cannot be driven: another limb, perhaps.
    """
    model = analysis.model
    moved = {joint for transmission in analysis.of_chain(joints) for joint in transmission.coupled} | set(joints)
    roots = robot_roots(model, joints)
    rest = [j for j in range(model.njnt) if j not in moved and int(model.body_rootid[model.jnt_bodyid[j]]) in roots]
    reasons = {joint: _refusal(analysis, joint) for joint in rest}
    if end is not None:
        rest = [joint for joint in rest if reasons[joint] and not is_below(model, int(model.jnt_bodyid[joint]), end)]
    if not rest:
        return []
    reason = next(filter(None, (reasons[joint] for joint in rest)), "")
    names = few_names([joint_name(model, joint) for joint in rest])
    return [f"held at home: {names}" + (f"; {reason}" if reason else "")]


def _check_drivable(analysis: Transmissions, base: int, joints: Joints) -> None:
    """Refuses a chain with a joint that cannot be driven, or that is coupled to a joint above the base."""
    analysis.of_chain(joints)
    if reason := _coupled_above(analysis, base, joints):
        raise ModelError(reason)


def _reason_against(analysis: Transmissions, base: int, joints: Joints) -> str:
    """Why a chain cannot be driven; empty if it can."""
    try:
        _check_drivable(analysis, base, joints)
    except ModelError as error:
        return str(error)
    return ""


def _coupled_above(analysis: Transmissions, base: int, joints: Joints) -> str:
    """Which joint of a chain is coupled to one that carries the chain's base; empty if none is."""
    model = analysis.model
    above = joints_above(model, base)
    for joint in (joint for joint in joints if joint in analysis.loops):
        for other in set(analysis.loops[joint].joints) & set(above):
            name = shown(joint_name(model, joint))
            return f"joint {name} is in a closed loop with {shown(joint_name(model, other))}, which carries the base"
    for transmission in analysis.of_chain(joints):
        for other in transmission.coupled.keys() & set(above):
            name = shown(joint_name(model, transmission.joint))
            return f"joint {name} is tied to {shown(joint_name(model, other))}, which carries the base"
    return ""


def _drivable_runs(analysis: Transmissions) -> tuple[set[_JointSeries], dict[_JointSeries, str]]:
    """All runs of joints that can be driven, and the joints that cannot, with the reason."""
    model = analysis.model
    runs: set[_JointSeries] = set()
    refused: dict[_JointSeries, str] = {}
    run_to = [_JointSeries(0, ())] * model.nbody
    for body in range(1, model.nbody):
        parent = int(model.body_parentid[body])
        own = joints_of(model, body)
        reason = next(filter(None, (_refusal(analysis, joint) for joint in own)), "")
        before = run_to[parent]
        run_to[body] = _JointSeries(body, ()) if reason else _JointSeries(before.base, before.joints + own)
        if run_to[body].joints:
            runs.add(run_to[body])
        if reason and not is_free(model, own[0]):
            refused[_JointSeries(parent, own)] = reason
    return runs, refused


def _refusal(analysis: Transmissions, joint: int) -> str:
    """Why a joint cannot be part of an arm; empty if it can."""
    if is_free(analysis.model, joint):
        return _free_base_reason(analysis.model, joint)
    if joint in analysis.springs or joint in analysis.passive:
        return ""
    transmission = analysis.of(joint)
    return transmission if isinstance(transmission, str) else ""


def _serial_chain(analysis: Transmissions, run: _JointSeries, reason: str) -> SerialChain:
    model = analysis.model
    transmissions = () if reason else analysis.of_chain(run.joints)
    own = tuple(transmission.joint for transmission in transmissions) or run.joints
    actuators = analysis.actuators
    followers = [joint for transmission in transmissions for joint in transmission.coupled if joint not in own]
    return SerialChain(
        base=body_name(model, run.base),
        tip=tip_of_chain(model, run.joints).name,
        joint_names=tuple(joint_name(model, joint) for joint in own),
        actuator_names=tuple(actuator_name(model, actuators[j]) if j in actuators else "" for j in own),
        followers=tuple(joint_name(model, joint) for joint in followers),
        reason=reason,
    )


def _longest(runs: set[_JointSeries]) -> set[_JointSeries]:
    """Those runs that are not the beginning of another run on the same base."""
    beginnings: set[_JointSeries] = set()
    for run in sorted(runs, key=lambda run: -len(run.joints)):
        if run not in beginnings:
            beginnings.update(_JointSeries(run.base, run.joints[:k]) for k in range(len(run.joints)))
    return runs - beginnings


def _actuated_runs(analysis: Transmissions, base: int) -> set[Joints]:
    """The runs of actuated joints from a base to every body behind it, as far as nothing interrupts them."""
    model = analysis.model
    run: dict[int, Joints] = {base: ()}
    for body in range(base + 1, model.nbody):
        parent = int(model.body_parentid[body])
        own = joints_of(model, body)
        if parent in run and all(_moves(analysis, joint) for joint in own):
            run[body] = run[parent] + own
    return {r for r in run.values() if r}


def _moves(analysis: Transmissions, joint: int) -> bool:
    """Whether a motor moves a joint: its own, or one through a spring or a closed loop."""
    return joint in analysis.actuators or joint in analysis.springs or joint in analysis.passive


class _FingerSearch:
    """Where runs of joints end before the fingers of a gripper."""

    def __init__(self, analysis: Transmissions, runs: Iterable[Joints]):
        """`runs` are all of them, whose lengths tell fingers from limbs."""
        self._analysis = analysis
        self._counts = branch_counts(analysis.model)
        self._most_behind: dict[int, int] = {}  # for each joint, how many joints any run has behind it
        for run in runs:
            for before, joint in enumerate(run, 1):
                self._most_behind[joint] = max(self._most_behind.get(joint, 0), len(run) - before)

    def end_of_arm(self, run: Joints) -> int:
        """How many joints of a run come before its fingers, at a body that carries several branches, all of them shorter."""
        model = self._analysis.model
        for before in range(1, len(run)):
            joint = run[before - 1]
            last = int(model.jnt_bodyid[joint])
            following = int(model.jnt_bodyid[run[before]])
            if last != following and self._most_behind[joint] < before and self._counts[last] > 1:
                return before
        end = len(run)
        if not run or self._counts[int(model.jnt_bodyid[run[-1]])]:
            return end  # it carries something that moves: a wrist, whatever its name
        while end > 0 and _is_jaw(self._analysis, run[end - 1]):
            end -= 1
        return end or len(run)


def _is_wheel(model: mujoco.MjModel, limb: Joints, limbs: Sequence[Joints]) -> bool:
    """Whether a limb is a wheel, with or without a suspension or a steering: it ends in a body that turns about its own center.

    Such a limb has at most two joints of its own and ends with a hinge without limits through the center of mass.
    """
    own = [joint for joint in limb if not any(joint in other for other in limbs if other != limb)]
    last = limb[-1]
    if len(own) > _MAX_WHEEL_JOINTS or model.jnt_type[last] != mujoco.mjtJoint.mjJNT_HINGE or model.jnt_limited[last]:
        return False
    body = int(model.jnt_bodyid[last])
    axis = model.jnt_axis[last]
    off_axis = np.linalg.norm(np.cross(model.body_ipos[body] - model.jnt_pos[last], axis))
    gyration = np.sqrt(model.body_inertia[body].max() / max(model.body_mass[body], mujoco.mjMINVAL))
    return bool(off_axis <= _BALANCED * gyration)


def _is_jaw(analysis: Transmissions, joint: int) -> bool:
    model = analysis.model
    motor = analysis.actuators.get(analysis.springs.get(joint, joint), -1)
    names = (joint_name(model, joint), actuator_name(model, motor) if motor >= 0 else "")
    body = int(model.jnt_bodyid[joint])
    is_named_jaw = any(map(_JAW_NAME.search, names)) or _JAW_BODY_NAME.search(body_name(model, body))
    return bool(is_named_jaw) or (
        "grip" in body_name(model, body).lower() and _carries_a_tip(model, int(model.body_parentid[body]))
    )


def _carries_a_tip(model: mujoco.MjModel, body: int) -> bool:
    """Whether something on a rigid piece is named like a tip, so that what moves behind it is a gripper, not a wrist."""
    pieces = welded_behind(model, body)
    sites = [model.site(s).name for s in range(model.nsite) if int(model.site_bodyid[s]) in pieces]
    return any(map(_TIP_FRAME_NAME.search, [*(body_name(model, b) for b in pieces[1:]), *sites]))


def _free_base_reason(model: mujoco.MjModel, joint: int) -> str:
    body = shown(body_name(model, int(model.jnt_bodyid[joint])))
    name = shown(joint_name(model, joint))
    return f"the base {body} is free (joint {name}); give the file or the MjSpec: load holds it where its keyframe puts it"


def _why_no_arm(analysis: Transmissions, base: int) -> str:
    model = analysis.model
    actuators = analysis.actuators
    if model.njnt == 0:
        return "no arm: the model has no joints"
    if not actuators:
        reasons = {joint: _refusal(analysis, joint) for moments in analysis.moments for joint in moments}
        if reason := next(filter(None, reasons.values()), ""):
            return f"no arm: {reason}"  # there are actuators, on joints that a loop or a tendon ties to others
        return "no arm: no hinge or slide joint has an actuator; add one, such as <motor joint=...>, for each joint"
    below = [j for j in range(model.njnt) if is_below(model, int(model.jnt_bodyid[j]), base)]
    behind = [j for j in below if model.jnt_bodyid[j] != base]
    if not behind:
        return f"no arm: no joint hangs on {shown(body_name(model, base))}"
    moved = [int(model.jnt_bodyid[j]) for j in actuators]
    for joint in (j for j in behind if is_free(model, j)):
        if any(is_below(model, body, int(model.jnt_bodyid[joint])) for body in moved):  # else it is a loose object
            return f"no arm: {_free_base_reason(model, joint)}"
    blocking = next(j for j in sorted(behind, key=lambda j: is_free(model, j)) if j not in actuators)
    return f"no arm: {analysis.of(blocking)}, and it is the first one from the base"
