"""From a name to an Arm: any serial chain in any model, its actuators turned into torque motors."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from armctl.core.errors import ArmctlWarning, InputError, ModelError, UnknownNameError
from armctl.core.pose import Pose
from armctl.core.validation import Array, frozen
from armctl.loading.catalog import Source, locate
from armctl.loading.chain import SerialChain, all_chains, chain_to, find_chain, stopped_before
from armctl.loading.independence import check_apart
from armctl.loading.motors import JointData, from_row, joint_limits, make_motors, torque_limits
from armctl.loading.prepare import add_target, backward, drag, exclude_overlaps, hold_bases, place_target, rest_ctrl, rest_qpos
from armctl.loading.scene import Scene
from armctl.loading.tip import find_tip, named_body, named_tip
from armctl.loading.tool import mount
from armctl.loading.urdf import speed_limits
from armctl.mjmodel.edit import add_bearers
from armctl.mjmodel.queries import Chain
from armctl.mjmodel.transmissions import Transmission, chain_transmissions
from armctl.robot.actuation import Actuation
from armctl.robot.arm import Arm, check_parity
from armctl.robot.joint_map import joint_map_of
from armctl.robot.pinocchio_model import build

_TARGET_OFFSET = 0.3  # rad (m) from home at every joint: where a target that armctl adds is reached


def load(
    name: str | os.PathLike[str],
    *,
    tip: str | None = None,
    tip_offset: Pose | None = None,
    base: str | None = None,
    hold_base: bool = False,
    tool: str | os.PathLike[str] | None = None,
    scene: Scene | str | os.PathLike[str] | None = None,
) -> Arm:
    """An arm by name: any serial chain of any robot, its actuators turned into torque motors.

    All joints outside the chain are held where the model's keyframe puts them.

    Args:
        name: The bundled arm ("robot_arm_3dof"), an alias ("panda"), a Menagerie name ("franka_emika_panda", or
            "franka_emika_panda/panda_nohand" for another of its entry points), or the path of an .xml or .urdf file.
        tip: The site, body or geom at the end of the chain. Left out, armctl finds the chain and its tip.
        tip_offset: The tip in that element's frame.
        base: The body the chain stands on: joints above it are held. Left out, the chain starts at the world.
        hold_base: Whether to hold a robot that floats or walks, such as a quadruped, where its keyframe puts it.
        tool: What to mount at the tip: a gripper or a hand by name, or any MJCF file. The tip is then the tool's.
        scene: What stands and lies around: a Scene, or the path of an MJCF file that holds one.

    Returns:
        The arm.

    Raises:
        InputError: The name is no name, `tip_offset` is no Pose, or the scene's names are taken.
        UnknownNameError: No robot, or nothing in the model, has that name.
        ModelError: The file cannot be read, is no arm, or could not be downloaded.

    Warns:
        ArmctlWarning: The model leaves out something that had to be assumed.
    """
    if tip_offset is not None and not isinstance(tip_offset, Pose):
        raise InputError(f"tip_offset: {tip_offset!r} is not a Pose; armctl.Pose([0, 0, 0.1]) is 0.1 m along z")
    source = locate(name)
    spec, notes = _read(source, hold_base)
    if tool is not None:
        model = source.compile(spec)
        _, _, body, T_body_flange = _found(source, model, tip, base)
        tip = mount(spec, next(b for b in spec.bodies if b.id == body), T_body_flange, locate(tool, tool=True))
    _set_scene(spec, scene)
    return _assemble(source, spec, notes, [(tip, base)], tip_offset)[0]


def load_arms(
    name: str | os.PathLike[str],
    tips: Sequence[str],
    *,
    base: str | Sequence[str | None] | None = None,
    hold_base: bool = False,
    scene: Scene | str | os.PathLike[str] | None = None,
) -> tuple[Arm, ...]:
    """Several chains of one robot, to be moved at once: two arms, four legs, five fingers.

    Args:
        name: As for `load`.
        tips: The site, body or geom at the end of each chain.
        base: The body they all stand on, or one for each: joints above it are held. Left out (None), they start at the world.
        hold_base: As for `load`.
        scene: As for `load`.

    Returns:
        An arm for each tip; all share one model, in which all of them have torque motors.

    Raises:
        InputError: As for `load`; or the bases are not as many as the tips.
        UnknownNameError: As for `load`.
        ModelError: As for `load`; or two chains share a joint, or one stands on another, which it would shake.

    Warns:
        ArmctlWarning: As for `load`.
    """
    if isinstance(tips, str) or not tips:
        raise InputError(f"tips: {tips!r} given, a list of names wanted, such as ['left/gripper', 'right/gripper']")
    bases = [base] * len(tips) if base is None or isinstance(base, str) else list(base)
    if len(bases) != len(tips):
        raise InputError(f"base: {len(bases)} given for {len(tips)} tips; give one for each, or one for all")
    source = locate(name)
    spec, notes = _read(source, hold_base)
    _set_scene(spec, scene)
    return _assemble(source, spec, notes, list(zip(tips, bases, strict=True)), None)


def chains(name: str | os.PathLike[str]) -> list[SerialChain]:
    """Every serial chain of a robot: its arms, legs, fingers, heads. A free base is taken to be held.

    Args:
        name: As for `load`.

    Returns:
        Those that `load` takes with their base and tip, longest first, then those it refuses, with the reason.

    Raises:
        InputError: The name is no name.
        UnknownNameError: No robot has that name.
        ModelError: The file cannot be read, or could not be downloaded.
    """
    source = locate(name)
    spec, _ = source.read()
    return all_chains(source.compile(spec))


@dataclass(frozen=True)
class _Part:
    """One chain on its way to become an arm; what it holds is explained at Arm."""

    joints: Chain
    drives: list[Transmission]
    tip: str
    tip_body: int
    T_body_tip: Pose
    sheet: JointData | None
    tau_max: Array
    sources: dict[str, str]
    notes: list[str]


def _set_scene(spec: mujoco.MjSpec, scene: Scene | str | os.PathLike[str] | None) -> None:
    if scene is not None:
        (scene if isinstance(scene, Scene) else Scene(scene)).build(spec)


def _read(source: Source, hold_base: bool) -> tuple[mujoco.MjSpec, list[str]]:
    spec, notes = source.read()
    if hold_base:
        hold_bases(spec, source.compile(spec))
    return spec, notes + drag(spec) + backward(spec)


def _assemble(
    source: Source,
    spec: mujoco.MjSpec,
    notes: list[str],
    ends: Sequence[tuple[str | None, str | None]],
    tip_offset: Pose | None,
) -> tuple[Arm, ...]:
    """The arms to some tips from some bases, in one model."""
    original = source.compile(spec)
    bodies = {body.id: body for body in spec.bodies}
    found = [_found(source, original, tip, base) for tip, base in ends]
    try:
        check_apart(original, [joints for joints, *_ in found])
        parts = [_with_motors(source, spec, original, *chain, tip_offset) for chain in found]
    except ModelError as error:
        raise ModelError(f"{source.name}: {error}") from None
    for sentence in [*notes, *(note for part in parts for note in part.notes)]:
        warnings.warn(f"{source.name}: {sentence}", ArmctlWarning, stacklevel=3)
    notes += [note for part in parts for note in exclude_overlaps(spec, original, part.joints)]
    add_target(spec, original)
    add_bearers(spec, original, {part.tip_body: bodies[part.tip_body] for part in parts})
    model = source.compile(spec)
    parts = [replace(part, tip_body=bodies[part.tip_body].id) for part in parts]
    qpos = rest_qpos(model, tuple(joint for part in parts for joint in part.joints))
    arms = tuple(_arm(source, model, original, part, qpos, notes) for part in parts)
    place_target(model, arms[0].fk(arms[0].limits.clamp(arms[0].home + _TARGET_OFFSET)).position)
    ctrl = rest_ctrl(model, np.concatenate([arm.ctrl_adr for arm in arms]))
    arms = tuple(replace(arm, home_ctrl=ctrl) for arm in arms)
    for arm in arms:
        check_parity(arm)
    return arms


def _with_motors(
    source: Source,
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    joints: Chain,
    tip: str,
    tip_body: int,
    T_body_tip: Pose,
    tip_offset: Pose | None,
) -> _Part:
    """A chain with its torque limits, its actuators turned into motors in the specification."""
    drives = chain_transmissions(model, joints)
    sheet = speed_limits(source.path, model, drives) or from_row(source.row, len(drives))
    tau_max, sources, notes = torque_limits(model, drives, sheet)
    notes += make_motors(spec, model, drives, tau_max) + stopped_before(model, joints)
    T_body_tip = T_body_tip if tip_offset is None else T_body_tip @ tip_offset
    return _Part(joints, drives, tip, tip_body, T_body_tip, sheet, tau_max, sources, notes)


def _arm(source: Source, model: mujoco.MjModel, original: mujoco.MjModel, part: _Part, qpos: Array, notes: list[str]) -> Arm:
    drives, joint_map = part.drives, joint_map_of(original, part.joints)
    limits, sources = joint_limits(model, drives, qpos, part.tau_max, part.sheet)
    leaders = [drive.joint for drive in drives]
    home = limits.clamp(qpos[model.jnt_qposadr[leaders]])
    qpos = qpos.copy()
    qpos[joint_map.qpos_adr] = joint_map.positions(home)
    return Arm(
        name=source.name,
        model=model,
        actuation=Actuation.from_model(model, joint_map, drives, limits),
        tip=part.tip,
        home=frozen(home),
        pinocchio_model=build(model, len(part.joints), joint_map, qpos, part.tip_body, part.T_body_tip),
        home_qpos=frozen(qpos),
        home_ctrl=qpos[:0],
        tip_body=part.tip_body,
        T_body_tip=part.T_body_tip,
        notes=tuple(notes + part.notes),
        sources=part.sources | sources,
    )


def _found(source: Source, model: mujoco.MjModel, tip: str | None, base: str | None) -> tuple[Chain, str, int, Pose]:
    """The chain, its tip's name, the body that carries the tip, and the tip in that body."""
    try:
        start = 0 if base is None else named_body(model, base)
        if tip is not None:
            name, body, T_body_tip = named_tip(model, tip)
            return chain_to(model, body, start), name, body, T_body_tip
        joints = find_chain(model, start)
    except ModelError as error:
        raise ModelError(f"{source.name}: {error}") from None
    row = source.row
    if row is not None and row.tip is not None and base is None:
        try:
            name, body, T_body_tip = named_tip(model, row.tip)
        except UnknownNameError:  # another entry point of the robot, such as one without its hand
            return joints, *find_tip(model, joints)
        return joints, name, body, T_body_tip @ Pose(row.tip_offset or (0.0, 0.0, 0.0))
    return joints, *find_tip(model, joints)
