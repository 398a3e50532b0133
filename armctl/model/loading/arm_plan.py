"""First stage of loading: describe the arms in a compiled model. Nothing is changed."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

from armctl.core.errors import ModelError, UnknownNameError
from armctl.core.pose import Pose
from armctl.core.validation import Array, instance, shown
from armctl.model.loading.actuators import actuator_notes, dc_motors
from armctl.model.loading.catalog import Source
from armctl.model.loading.chain import chain_to, end_note, find_chain
from armctl.model.loading.joint_limits import JointData, datasheet_limits, torque_limits
from armctl.model.loading.tip import Tip, axis_note, named_tip, tip_of_chain
from armctl.model.loading.unit_checks import unit_doubts
from armctl.model.loading.urdf import speed_limits
from armctl.model.mjmodel.dc_motor import DcMotor
from armctl.model.mjmodel.queries import Joints, body_name, body_named, is_below, joint_name
from armctl.model.mjmodel.transmissions import Transmission, Transmissions


@dataclass(frozen=True, eq=False)
class ArmEnds:
    """Where an arm begins and ends, as the caller names it."""

    tip: str | None = None  # the name of the site, body or geom at the end; None for the one that armctl finds
    base: str | None = None  # the name of the body that the arm stands on; None for the world
    tip_offset: Pose | None = None  # the tip in that element's frame; None for the frame itself


@dataclass(frozen=True, eq=False)
class ArmPlan:
    """What one arm of a model will be."""

    joints: Joints  # the joints from the base to the tip, without the springs of elastic joints
    transmissions: tuple[Transmission, ...]  # what moves each of its n joints
    dc_motors: tuple[DcMotor | None, ...]  # the DC motor of each of them, or None
    tip: Tip  # its tip, in the body's number of the model that is described
    datasheet: JointData | None  # limits from a data sheet or a URDF, or None
    tau_max: Array  # (n,) N m
    tau_source: str  # where the torque limits come from
    notes: tuple[str, ...]  # what had to be assumed, one sentence each
    info_notes: tuple[str, ...]  # what needs no warning, one sentence each


def describe_arms(source: Source, analysis: Transmissions, ends: Sequence[ArmEnds]) -> list[ArmPlan]:
    """The arms to some tips from some bases of a model with its own actuators; errors as those of `armctl.load`."""
    chains = [find_ends(source, analysis, each) for each in ends]
    for (one, _), (other, _) in permutations(chains, 2):
        if reason := _why_dependent(analysis, one, other):
            raise ModelError(reason)
    return [
        _described(source, analysis, joints, tip.moved(each.tip_offset), each.tip is None and source.urdf is not None)
        for (joints, tip), each in zip(chains, ends, strict=True)
    ]


def find_ends(source: Source, analysis: Transmissions, ends: ArmEnds) -> tuple[Joints, Tip]:
    """The joints and the tip of one arm, without its tip offset."""
    model = analysis.model
    base = 0
    if ends.base is not None:
        instance("base", ends.base, str, "give the name of a body")
        base = body_named(model, ends.base)
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


def _described(source: Source, analysis: Transmissions, joints: Joints, tip: Tip, chosen: bool) -> ArmPlan:
    model = analysis.model
    transmissions = analysis.of_chain(joints)
    datasheet = speed_limits(source.urdf, model, transmissions) or datasheet_limits(source.row, len(transmissions))
    motors = dc_motors(source, model, transmissions)
    torques = torque_limits(model, transmissions, datasheet, motors, "actfrcrange" if source.urdf is None else "URDF effort")
    warned, quiet = actuator_notes(analysis, joints, transmissions, motors)
    driven = tuple(joint for joint in joints if joint not in analysis.springs)
    doubts = unit_doubts(model, driven, tip.body, tip.T_body_tip.position)
    return ArmPlan(
        joints=driven,
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
            *end_note(analysis, joints),
            *(axis_note(model, joints, tip) if chosen else []),
        ),
        info_notes=tuple(quiet),
    )


def _why_dependent(analysis: Transmissions, one: Joints, other: Joints) -> str:
    """Why two chains cannot move at once: one is part of the other, both move the same joint, or one stands on the other."""
    model = analysis.model
    tip = shown(tip_of_chain(model, one).name)
    other_tip = shown(tip_of_chain(model, other).name)
    shared = sorted(set(one) & set(other))
    moved = _moved_joints(analysis, one)
    coupled = moved & _moved_joints(analysis, other) - set(shared)
    if coupled:
        return f"the chains to {tip} and {other_tip} both move joint {joint_name(model, min(coupled))!r:.80}; give one of them"
    if len(shared) == min(len(one), len(other)):
        return f"one of the chains to {tip} and {other_tip} is part of the other; give each chain once"
    if shared:
        names = ", ".join(repr(joint_name(model, joint)) for joint in shared)
        base = body_name(model, int(model.jnt_bodyid[shared[-1]]))
        joints = "joints" if len(shared) > 1 else "joint"
        return (
            f"the chains to {tip} and {other_tip} share {joints} {names:.120}, which only one of them could move; "
            f"base={base!r:.80} holds what they share"
        )
    if any(is_below(model, int(model.jnt_bodyid[other[0]]), int(model.jnt_bodyid[joint])) for joint in moved):
        return f"the chain to {other_tip} stands on the one to {tip}, which would shake it; move one at a time"
    return ""


def _moved_joints(analysis: Transmissions, joints: Joints) -> set[int]:
    """The joints of a chain and those coupled to them."""
    return {joint for transmission in analysis.of_chain(joints) for joint in transmission.coupled}
