"""Finding the serial chains in a compiled model: which joints make an arm, and why others make none."""

from __future__ import annotations

import re
from dataclasses import dataclass

import mujoco

from armctl.core.errors import ModelError
from armctl.loading.tip import find_tip
from armctl.mjmodel.couplings import coupling
from armctl.mjmodel.queries import (
    Chain,
    actuator_name,
    body_name,
    branches,
    is_below,
    joint_actuators,
    joint_name,
    joints_above,
    joints_of,
)
from armctl.mjmodel.transmissions import Transmission, chain_transmissions, transmission_of

_JAW = re.compile(r"jaw|grip|finger|claw|knuckle", re.IGNORECASE)
_JAW_BODY = re.compile(r"^(?!.*(fix|static|base)).*(jaw|finger|fngr|claw|moving)", re.IGNORECASE)


@dataclass(frozen=True)
class SerialChain:
    """Joints in series inside a model: an arm, a leg, a finger, a head.

    Attributes:
        base: The body it stands on; "world" where nothing moves below it.
        tip: The site or body at its end.
        joint_names: Its joints, from the base to the tip, as an arm's; of joints tied to each other the first one.
        actuator_names: What moves them; empty where nothing does.
        followers: The joints, in the chain or beside it, that are tied to one of these and go along.
        reason: Why `armctl.load` refuses it, in words; empty where it does not.
    """

    base: str
    tip: str
    joint_names: tuple[str, ...]
    actuator_names: tuple[str, ...]
    followers: tuple[str, ...] = ()
    reason: str = ""

    @property
    def ok(self) -> bool:
        """Whether `armctl.load(robot, base=..., tip=...)` takes it."""
        return not self.reason


def all_chains(model: mujoco.MjModel) -> list[SerialChain]:
    """Every serial chain of a model, whose free bases are taken to be held.

    A chain ends where the model branches no further, before the fingers of a gripper, and before a joint that cannot be driven:
    what follows is a chain of its own, on the body before it.

    Args:
        model: The compiled model.

    Returns:
        The chains that can be driven, longest first, then the joints that cannot, with the reason.
    """
    refused: dict[tuple[int, Chain], str] = {}
    runs: set[tuple[int, Chain]] = set()
    base, run = [0] * model.nbody, [()] * model.nbody
    for body in range(1, model.nbody):
        parent, own = int(model.body_parentid[body]), joints_of(model, body)
        reason = next(filter(None, (_refusal(model, joint) for joint in own)), "")
        base[body], run[body] = (body, ()) if reason else (base[parent], run[parent] + own)
        runs |= {(base[body], run[body])} if run[body] else set()
        if reason and not _is_free(model, own[0]):
            refused[parent, own] = reason
    found: set[tuple[int, Chain]] = set()
    actuators = _actuators(model)
    for start, joints in _longest(runs):
        end = _end_of_arm(model, joints, actuators)
        found |= {(start, joints[:end]), (int(model.jnt_bodyid[joints[end - 1]]), joints[end:])}
    kept = sorted(_longest({key for key in found if key[1]}))
    described = [
        _describe(model, *key, reason, actuators)
        for key, reason in [*((k, _tied_above(model, *k)) for k in kept), *refused.items()]
    ]
    return sorted(described, key=lambda chain: (not chain.ok, -len(chain.joint_names)))


def find_chain(model: mujoco.MjModel, base: int = 0) -> Chain:
    """The arm of a model that nobody described: its longest run of actuated joints from the base.

    The run ends before the fingers of a gripper part: at a body that carries several jointed branches with fewer joints behind
    it than before it, or at joints named like a jaw.

    Args:
        model: The compiled model.
        base: The body it stands on; the world if left out.

    Returns:
        The joints from the base to the tip.

    Raises:
        ModelError: There is none, or several are equally long.
    """
    actuators = _actuators(model)
    runs = {run[: _end_of_arm(model, run, actuators)] for run in _runs(model, base, actuators)}
    longest = max((len(run) for run in runs), default=0)
    if longest == 0:
        raise ModelError(_why_no_arm(model, base, actuators))
    best = sorted(run for run in runs if len(run) == longest)
    if len(best) > 1:
        tips = ", ".join(repr(find_tip(model, run)[0]) for run in best)
        on = f"on {body_name(model, base)!r}" if base else "at the base"
        raise ModelError(f"{len(best)} chains of {longest} joints start {on}; choose one with tip=: {tips}")
    _check_drives(model, base, best[0])
    return best[0]


def chain_to(model: mujoco.MjModel, body: int, base: int = 0) -> Chain:
    """All joints between a base and a body.

    Args:
        model: The compiled model.
        body: The body at the end.
        base: The body it stands on; the world if left out.

    Returns:
        The joints from the base to the body.

    Raises:
        ModelError: One of them is no hinge or slide joint, or no one actuator moves it.
    """
    name = body_name(model, body)
    if not is_below(model, body, base):
        raise ModelError(f"{name!r} does not hang on {body_name(model, base)!r}; choose a base on the way to it")
    joints = joints_above(model, body, base)
    if joints and _is_free(model, joints[0]):
        raise ModelError(_free_base(model, joints[0]))
    if not joints:
        raise ModelError(f"no joint moves {name!r}, so it is the tip of no arm")
    try:
        _check_drives(model, base, joints)
    except ModelError as error:
        raise ModelError(f"on the way to {name!r}: {error}; base= can be a body behind it, which holds it") from None
    return joints


def stopped_before(model: mujoco.MjModel, joints: Chain) -> list[str]:
    """What to say where a chain goes on, but by a joint that nothing drives.

    Args:
        model: The compiled model.
        joints: The chain.

    Returns:
        One sentence, or none.
    """
    behind = branches(model, int(model.jnt_bodyid[joints[-1]]))
    following = joints_of(model, behind[0])[0] if len(behind) == 1 else None
    if following is None or following in _actuators(model) or coupling(model, following, frozenset([following])):
        return []
    return [f"the arm ends before joint {joint_name(model, following)!r}, which has no actuator of its own and is held"]


def _check_drives(model: mujoco.MjModel, base: int, joints: Chain) -> None:
    """Makes sure that each joint of a chain can be driven, and that its base stands still meanwhile."""
    chain_transmissions(model, joints)
    if reason := _tied_above(model, base, joints):
        raise ModelError(reason)


def _tied_above(model: mujoco.MjModel, base: int, joints: Chain) -> str:
    """Which joint of a chain is tied to one that carries the chain's base; empty where none is."""
    above = joints_above(model, base)
    for drive in chain_transmissions(model, joints):
        for other in drive.ties.keys() & set(above):
            return f"joint {joint_name(model, drive.joint)!r} is tied to {joint_name(model, other)!r}, which carries the base"
    return ""


def _refusal(model: mujoco.MjModel, joint: int) -> str:
    """Why a joint cannot be part of an arm; empty where it can."""
    if _is_free(model, joint):
        return _free_base(model, joint)
    drive = transmission_of(model, joint)
    return drive if isinstance(drive, str) else ""


def _actuators(model: mujoco.MjModel) -> dict[int, int]:
    """Which actuator moves which joint: directly, or through joints that it is tied to."""
    drives = [transmission_of(model, joint) for joint in range(model.njnt)]
    return joint_actuators(model) | {drive.joint: drive.actuator for drive in drives if isinstance(drive, Transmission)}


def _describe(model: mujoco.MjModel, base: int, joints: Chain, reason: str, actuators: dict[int, int]) -> SerialChain:
    drives = [] if reason else chain_transmissions(model, joints)
    own = tuple(drive.joint for drive in drives) or joints
    return SerialChain(
        base=body_name(model, base),
        tip=find_tip(model, joints)[0],
        joint_names=tuple(joint_name(model, joint) for joint in own),
        actuator_names=tuple(actuator_name(model, actuators[j]) if j in actuators else "" for j in own),
        followers=tuple(joint_name(model, joint) for drive in drives for joint in drive.ties if joint not in own),
        reason=reason,
    )


def _longest(runs: set[tuple[int, Chain]]) -> set[tuple[int, Chain]]:
    """Those runs that no other run on the same base goes on from."""
    beginnings = {(base, joints[:k]) for base, joints in runs for k in range(len(joints))}
    return runs - beginnings


def _runs(model: mujoco.MjModel, base: int, actuators: dict[int, int]) -> set[Chain]:
    """The runs of actuated joints from a base to every body behind it, as far as nothing interrupts them."""
    run: dict[int, Chain] = {base: ()}
    for body in range(base + 1, model.nbody):
        parent, own = int(model.body_parentid[body]), joints_of(model, body)
        if parent in run and all(joint in actuators for joint in own):
            run[body] = run[parent] + own
    return {r for r in run.values() if r}


def _end_of_arm(model: mujoco.MjModel, run: Chain, actuators: dict[int, int]) -> int:
    """How many joints of a run come before its fingers."""
    for before in range(1, len(run)):
        last, following = int(model.jnt_bodyid[run[before - 1]]), int(model.jnt_bodyid[run[before]])
        if last != following and len(run) - before < before and len(branches(model, last)) > 1:
            return before
    end = len(run)
    if not run or branches(model, int(model.jnt_bodyid[run[-1]])):
        return end  # it carries something that moves: a wrist, whatever its name
    while end > 0 and _is_jaw(model, run[end - 1], actuators[run[end - 1]]):
        end -= 1
    return end or len(run)


def _is_jaw(model: mujoco.MjModel, joint: int, actuator: int) -> bool:
    names = joint_name(model, joint), actuator_name(model, actuator)
    return any(map(_JAW.search, names)) or bool(_JAW_BODY.search(body_name(model, int(model.jnt_bodyid[joint]))))


def _is_free(model: mujoco.MjModel, joint: int) -> bool:
    return bool(model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE)


def _free_base(model: mujoco.MjModel, joint: int) -> str:
    body = body_name(model, int(model.jnt_bodyid[joint]))
    return f"the base {body!r} is free (joint {joint_name(model, joint)!r}); hold_base=True holds it where its keyframe puts it"


def _why_no_arm(model: mujoco.MjModel, base: int, actuators: dict[int, int]) -> str:
    if model.njnt == 0:
        return "no arm: the model has no joints"
    if not actuators:
        return "no arm: no hinge or slide joint has an actuator; add one, such as <motor joint=...>, for each joint"
    below = [j for j in range(model.njnt) if is_below(model, int(model.jnt_bodyid[j]), base)]
    behind = [j for j in below if model.jnt_bodyid[j] != base]
    if not behind:
        return f"no arm: no joint hangs on {body_name(model, base)!r}"
    moved = [int(model.jnt_bodyid[j]) for j in actuators]
    for joint in (j for j in behind if _is_free(model, j)):
        if any(is_below(model, body, int(model.jnt_bodyid[joint])) for body in moved):  # else it is a loose object
            return f"no arm: {_free_base(model, joint)}"
    blocking = next(j for j in sorted(behind, key=lambda j: _is_free(model, j)) if j not in actuators)
    return f"no arm: {transmission_of(model, blocking)}, and it is the first one from the base"
