"""First stage of loading: describe the arm in a compiled model. Nothing is changed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import mujoco

from armctl.core.errors import InputError, UnknownNameError, few_names
from armctl.core.pose import Pose
from armctl.core.validation import Array, instance, shown
from armctl.model.arm.joint_map import JointMap
from armctl.model.loading.actuators import actuator_notes, dc_motors
from armctl.model.loading.base import BASE_JOINTS, base_joints
from armctl.model.loading.catalog import Source
from armctl.model.loading.chain import chain_to, end_note, find_chain, held_note, several_limbs
from armctl.model.loading.home import keyframe_qpos
from armctl.model.loading.joint_limits import JointData, datasheet_limits, default_speeds, torque_limits
from armctl.model.loading.tip import Tip, axis_note, named_tip, tip_of_chain
from armctl.model.loading.unit_checks import unit_doubts
from armctl.model.loading.urdf import speed_limits
from armctl.model.mjmodel.closed_loops import LoopGroup
from armctl.model.mjmodel.dc_motor import DcMotor
from armctl.model.mjmodel.queries import Joints, body_name, body_named, joint_name, joints_above, object_id
from armctl.model.mjmodel.transmissions import Transmission, Transmissions


@dataclass(frozen=True, eq=False)
class ArmEnds:
    """Where an arm begins and ends, as the caller names it."""

    tip: str | None = None  # the name of the site, body or geom at the end; None for the one that armctl finds
    base: str | None = None  # the name of the body that the arm stands on; None for the world
    tip_offset: Pose | None = None  # the tip in that element's frame; None for the frame itself
    further_tips: tuple[str, ...] = ()  # the names of other tips of the same arm
    moving_base: str | None = None  # "planar" or "free": the base has joints of its own, which come before the others


@dataclass(frozen=True, eq=False)
class ArmPlan:
    """What the arm of a model will be."""

    joints: Joints  # the joints from the base to the tip, then those to further tips, without the springs of elastic joints
    chain_length: int  # how many of them lead to the tip
    transmissions: tuple[Transmission, ...]  # what moves each of its n joints
    dc_motors: tuple[DcMotor | None, ...]  # the DC motor of each of them, or None
    tip: Tip  # its tip, in the body's number of the model that is described
    datasheet: JointData | None  # limits from a data sheet or a URDF, or None
    tau_max: Array  # (n,) N m
    tau_source: str  # where the torque limits come from
    notes: tuple[str, ...]  # what had to be assumed, one sentence each
    info_notes: tuple[str, ...]  # what needs no warning, one sentence each
    further_tips: tuple[Tip, ...] = ()  # numbered as the tip
    base: str = "fixed"  # or "planar" or "free"
    loops: tuple[LoopGroup, ...] = ()  # the closed loops that its joints are in

    def renumbered(self, number: Callable[[int], int]) -> ArmPlan:
        """The same arm in another model, in which the bodies of the tips have other numbers."""
        tip = replace(self.tip, body=number(self.tip.body))
        return replace(self, tip=tip, further_tips=tuple(replace(each, body=number(each.body)) for each in self.further_tips))


def describe_arm(source: Source, analysis: Transmissions, ends: ArmEnds) -> ArmPlan:
    """The arm to some tips from a base of a model with its own actuators; errors as those of `armctl.load`."""
    return _described(source, analysis, _chains_of(source, analysis, ends), ends)


def _chains_of(source: Source, analysis: Transmissions, ends: ArmEnds) -> list[tuple[Joints, Tip]]:
    """The joints and the tip of each chain of an arm: one, those to the caller's tips, or all limbs of a robot with several."""
    before = base_joints(analysis.model, ends.moving_base)
    analysis.of_chain(before)  # raises ModelError if a loop holds the base
    limbs = several_limbs(analysis, _base(analysis, ends), before) if ends.tip is None and ends.base is None else []
    if limbs and (source.row is None or source.row.tip is None):
        chains = _limbs_to_tips(analysis.model, limbs)
    else:
        chains = [find_ends(source, analysis, ends), *_further_chains(analysis, ends)]
    chains = [(before + joints, tip) for joints, tip in chains]
    joints, tip = chains[0]
    return [(joints, tip.moved(ends.tip_offset)), *chains[1:]]


def _limbs_to_tips(model: mujoco.MjModel, limbs: Sequence[Joints]) -> list[tuple[Joints, Tip]]:
    """Each limb with the tip at its end; of two tips of one name the second is called by its body."""
    chains: list[tuple[Joints, Tip]] = []
    names: set[str] = set()
    for joints in limbs:
        tip = tip_of_chain(model, joints)
        if tip.name in names:
            tip = replace(tip, name=body_name(model, int(model.jnt_bodyid[joints[-1]])))
        names.add(tip.name)
        chains.append((joints, tip))
    return chains


def find_ends(source: Source, analysis: Transmissions, ends: ArmEnds) -> tuple[Joints, Tip]:
    """The joints and the tip of one arm, without its tip offset."""
    model = analysis.model
    base = _base(analysis, ends)
    if ends.tip is not None:
        tip = named_tip(model, ends.tip)
        return chain_to(analysis, tip.body, base), tip
    joints = find_chain(analysis, base)
    row = source.row
    if row is None or row.tip is None or ends.base is not None:
        return joints, tip_of_chain(model, joints)
    try:
        tip = named_tip(model, row.tip)
    except UnknownNameError:  # another entry point of the robot, such as one without its hand
        return joints, tip_of_chain(model, joints)
    return joints, tip.moved(Pose(row.tip_offset or (0.0, 0.0, 0.0)))


def _base(analysis: Transmissions, ends: ArmEnds) -> int:
    """The body that an arm stands on; 0 for the world."""
    if ends.moving_base is not None:
        return int(analysis.model.jnt_bodyid[base_joints(analysis.model, ends.moving_base)[0]])
    if ends.base is None:
        return 0
    instance("base", ends.base, str, "give the name of a body, 'planar' or 'free'")
    model = analysis.model
    if object_id(model, mujoco.mjtObj.mjOBJ_BODY, ends.base) < 0:
        names = filter(None, (model.body(i).name for i in range(model.nbody)))
        raise UnknownNameError.from_known("body", ends.base, [*BASE_JOINTS, *names])
    return body_named(model, ends.base)


def _further_chains(analysis: Transmissions, ends: ArmEnds) -> list[tuple[Joints, Tip]]:
    """The joints and the tip of each further chain of an arm."""
    taken = [ends.tip]
    chains = []
    for name in ends.further_tips:
        if name in taken:
            raise InputError(f"tips: {shown(name)} is given twice")
        taken.append(name)
        tip = named_tip(analysis.model, name)
        chains.append((chain_to(analysis, tip.body, _base(analysis, ends)), tip))
    return chains


def _described(source: Source, analysis: Transmissions, chains: Sequence[tuple[Joints, Tip]], ends: ArmEnds) -> ArmPlan:
    """What an arm will be; its first chain is that of its first tip."""
    model = analysis.model
    (chain, tip), *others = chains
    joints = _with_loops(analysis, [each for each, _ in chains])
    transmissions = analysis.of_chain(joints)
    before = base_joints(model, ends.moving_base)
    own = transmissions[len(before) :]
    datasheet = speed_limits(source.urdf, model, own) or _datasheet(
        source, analysis, [each[len(before) :] for each, _ in chains]
    )
    if before and datasheet is not None:
        datasheet = datasheet.behind(default_speeds(model, transmissions[: len(before)]))
    motors = dc_motors(source, model, transmissions)
    own_limit = "actfrcrange" if source.urdf is None else "URDF effort"
    loops = tuple(dict.fromkeys(analysis.loops[joint] for joint in joints if joint in analysis.loops))
    closed = JointMap.from_transmissions(model, joints, transmissions, loops, keyframe_qpos(model)) if loops else None
    torques = torque_limits(model, transmissions, datasheet, motors, own_limit, added=len(before), closed=closed)
    warned, quiet = actuator_notes(analysis, joints, transmissions, motors)
    driven = tuple(joint for joint in joints if joint not in analysis.springs)
    doubts = unit_doubts(model, driven, tip.body, tip.T_body_tip.position)
    is_chosen = ends.tip is None and source.urdf is not None
    held = held_note(analysis, joints, None if others else int(model.jnt_bodyid[chain[-1]]))
    return ArmPlan(
        joints=driven,
        chain_length=sum(joint not in analysis.springs for joint in chain),
        transmissions=transmissions,
        dc_motors=motors,
        tip=tip,
        datasheet=datasheet,
        tau_max=torques.tau_max,
        tau_source=torques.source,
        notes=(
            *doubts,
            *torques.notes,
            *warned,
            *(note for each, _ in chains for note in end_note(analysis, each)),
            *(axis_note(model, chain, tip) if is_chosen else []),
        ),
        info_notes=(*quiet, *_loop_notes(model, loops), *(held if ends.tip is None or others else [])),
        further_tips=tuple(other for _, other in others),
        base=ends.moving_base or "fixed",
        loops=loops,
    )


def _loop_notes(model: mujoco.MjModel, loops: Sequence[LoopGroup]) -> list[str]:
    """One sentence for each closed loop."""
    notes = []
    for loop in loops:
        passive = few_names([joint_name(model, joint) for joint in loop.passive])
        drivers = few_names([joint_name(model, joint) for joint in loop.drivers])
        notes.append(f"closed loops: {passive} have no motor and follow {drivers}")
    return notes


def _with_loops(analysis: Transmissions, chains: Sequence[Joints]) -> Joints:
    """All joints of chains as for `_depth_first`, and those of the closed loops that they are in."""
    model = analysis.model
    base = int(model.body_parentid[model.jnt_bodyid[chains[0][0]]])
    loops = dict.fromkeys(analysis.loops[joint] for chain in chains for joint in chain if joint in analysis.loops)
    paths = [joints_above(model, int(model.jnt_bodyid[joint]), base) for loop in loops for joint in loop.joints]
    return _depth_first([*chains, *paths])


def _depth_first(chains: Sequence[Joints]) -> Joints:
    """All joints of chains, each followed by all that it carries, as Pinocchio needs them; those of the first chain first."""
    carried: dict[int, list[int]] = {-1: []}
    for chain in chains:
        for above, joint in zip((-1, *chain), chain, strict=False):
            if joint not in carried:
                carried[joint] = []
                carried[above].append(joint)
    found: list[int] = []
    waiting = [-1]
    while waiting:
        joint = waiting.pop()
        found.append(joint)
        waiting += reversed(carried[joint])
    return tuple(found[1:])


def _datasheet(source: Source, analysis: Transmissions, chains: Sequence[Joints]) -> JointData | None:
    """The limits of a data sheet for the joints of chains: those of one arm, or of equal ones that share no joint."""
    counts = {len(analysis.of_chain(chain)) for chain in chains}
    if len(counts) > 1 or len(set().union(*chains)) < sum(map(len, chains)):
        return None
    one = datasheet_limits(source.row, counts.pop())
    return one if one is None else one.repeated(len(chains))
