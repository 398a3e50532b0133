"""Loading: from a name, a file, a specification or a model to an Arm.

Three stages: describe the arm in the compiled model, prepare a model with torque motors, build the arm. Couplings and
transmissions are analysed once, in the first stage, and passed on.
"""

from __future__ import annotations

import contextlib
import copy
import os
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import mujoco

from armctl.core.defaults import TIMESTEPS_S
from armctl.core.errors import ArmctlWarning, InputError, MissingShapeWarning, ModelError, few_names
from armctl.core.note import Note, Severity
from armctl.core.pose import Pose
from armctl.core.validation import instance, number, shown
from armctl.model.arm.arm import Arm
from armctl.model.arm.parity import check_parity
from armctl.model.loading.added_shapes import CAPSULES, VISUAL, add_shapes, read_shapes, visual_links
from armctl.model.loading.arm_plan import ArmEnds, describe_arm, find_ends
from armctl.model.loading.base import BASE_JOINTS, add_base_joints, hold_free_bases, may_float
from armctl.model.loading.build import make_arm
from armctl.model.loading.catalog import Source, locate
from armctl.model.loading.chain import SerialChain, all_chains
from armctl.model.loading.home import home_qpos
from armctl.model.loading.inertias import corrected_model
from armctl.model.loading.link_shapes import fixed_without_shape, names_of, unchecked_links
from armctl.model.loading.model_checks import (
    check_joint_parameters,
    check_mass_matrix,
    check_memory,
    check_timestep,
    model_notes,
    open_loop_notes,
)
from armctl.model.loading.prepare import PreparedModel, make_arm_model, make_arm_model_from_compiled
from armctl.model.loading.scene import SceneLike, SceneParts, read_scene
from armctl.model.loading.srdf import Srdf, apply_srdf, find_srdf, read_srdf
from armctl.model.loading.tip import tip_on
from armctl.model.loading.undriven import add_missing_motors
from armctl.model.loading.urdf_file import UrdfFile
from armctl.model.mjmodel.edit import copy_options
from armctl.model.mjmodel.queries import Joints, colliding_geoms
from armctl.model.mjmodel.transmissions import Transmissions

_SHAPE_ADVICE = "write <collision> (URDF), or geoms with contype and conaffinity (MJCF), into these links"
_FLANGE = "armctl_flange"


@dataclass(frozen=True, eq=False)
class _RobotSpec:
    """A robot as it was read, before a tool or a scene is added."""

    spec: mujoco.MjSpec
    notes: tuple[str, ...]  # what was assumed, one sentence each; they are reported as warnings
    info_notes: tuple[str, ...]  # what needs no warning, one sentence each
    srdf: Srdf | None  # the SRDF that belongs to it, or None
    links_without_contact_rules: frozenset[str]  # its links, if no file says which of them may touch
    unread: frozenset[str]  # its links whose shapes are in the file, and could not be read
    drawn: frozenset[str]  # its links that the file draws by a visual shape that can be read

    def resolved(self, ends: ArmEnds) -> ArmEnds:
        """The ends of an arm whose tips can be names of groups of the SRDF; that of a single tip says the base, too."""
        if not isinstance(ends.tip, str):
            return ends
        base, tip = self._ends_of_group(ends.tip)
        further_tips = tuple(self._ends_of_group(name)[1] for name in ends.further_tips)
        own_base = base if ends.base is None and not further_tips else ends.base
        return replace(ends, tip=tip, base=own_base, further_tips=further_tips)

    def _ends_of_group(self, name: str) -> tuple[str | None, str]:
        """The base and the tip of a group of the SRDF; no base and the name itself if there is no such group."""
        groups = {} if self.srdf is None else self.srdf.groups
        if name not in groups or any(each.name == name for each in (*self.spec.bodies, *self.spec.sites, *self.spec.geoms)):
            return None, name
        return groups[name]


@dataclass(frozen=True, eq=False)
class _LoadRecipe:
    """The arguments of `load`, from which its model is made."""

    robot: str | os.PathLike[str] | mujoco.MjSpec  # as for `load`
    ends: ArmEnds  # where the arm begins and ends
    moving_base: str | None  # "planar" or "free"; None for one that is held
    tool: str | os.PathLike[str] | mujoco.MjSpec | None  # as for `load`
    scene: SceneParts | None  # what is around it
    srdf: str | os.PathLike[str] | None  # as for `load`
    shapes: str | None = None  # as for `load`
    timestep: float | None = None  # as for `load`
    is_complete: bool = True  # false in another process for the arm of a specification, which does not go along

    def __getstate__(self) -> dict[str, Any]:
        is_text = not isinstance(self.robot, mujoco.MjSpec) and not isinstance(self.tool, mujoco.MjSpec)
        return self.__dict__ if is_text else self.__dict__ | {"robot": "", "tool": None, "is_complete": False}

    def model(self, edit: Callable[[mujoco.MjSpec], None]) -> mujoco.MjModel:
        """The model of the arm, made once more after an edit of the specification."""
        return self.prepared(edit)[1].model

    def prepared(self, edit: Callable[[mujoco.MjSpec], None] | None = None) -> tuple[str, PreparedModel, list[str]]:
        """The name of the robot, its model with torque motors, and what is doubtful, one sentence each."""
        if not self.is_complete:
            raise ModelError("an arm of an MjSpec gets no further elements in another process; load it from a file")
        source = locate(self.robot)
        robot = _read(source, self.moving_base, self.srdf, visual=self.shapes == VISUAL)
        spec = robot.spec
        if self.timestep is not None:
            spec.option.timestep = self.timestep
        ends = robot.resolved(self.ends)
        unread = robot.unread
        notes = list(robot.notes)
        if self.tool is not None:
            with _naming(source.name):
                analysis = Transmissions(source.compile_without_textures(spec))
                _, flange = find_ends(source, analysis, ArmEnds(ends.tip, ends.base))
            body = next(b for b in spec.bodies if b.id == flange.body)
            mounted = mount(spec, body, flange.T_body_tip, locate(self.tool, tool=True))
            ends = replace(ends, tip=mounted.tip)
            unread |= mounted.unread
            notes += mounted.notes
        if self.scene is not None:
            self.scene.build(spec)
            if self.timestep is not None and spec.option.timestep != self.timestep:
                raise InputError(
                    f"timestep: {self.timestep:g} s; in a scene with loose bodies it is at most {spec.option.timestep:g} s"
                )
        original = source.compile_without_textures(spec)
        with _naming(source.name):
            check_timestep(original)
            analysis = Transmissions(original)
            plan = describe_arm(source, analysis, ends)
        unchecked = unchecked_links(original, plan.joints, unread)
        links_without_contact_rules = robot.links_without_contact_rules
        if unchecked and self.shapes is not None:
            tips = [(plan.tip.body, plan.tip.T_body_tip.position)]
            qpos = home_qpos(original, plan.joints)
            notes += add_shapes(spec, original, qpos, self.shapes, unchecked, tips)
            original = source.compile_without_textures(spec)
            with _naming(source.name):
                analysis = Transmissions(original)
                plan = describe_arm(source, analysis, ends)
            shaped = set(original.geom_bodyid[colliding_geoms(original)].tolist())
            given = names_of(original, [body for body in unchecked if body in shaped])
            links_without_contact_rules |= frozenset(given)
            unchecked = unchecked_links(original, plan.joints, unread - set(given))
        prepared = make_arm_model(source, spec, analysis, plan, links_without_contact_rules, edit)
        rating = source.row.rating if source.row is not None and plan.datasheet is not None else ""
        prepared = _with_shape_notes(prepared, original, plan.joints, unchecked, robot.drawn)
        notes += model_notes(original)
        info_notes = (*filter(None, [rating]), *robot.info_notes, *prepared.info_notes)
        return source.name, replace(prepared, info_notes=info_notes), notes


def load(
    robot: str | os.PathLike[str] | mujoco.MjSpec | mujoco.MjModel,
    *,
    tip: str | None = None,
    tips: Sequence[str] | None = None,
    tip_offset: Pose | None = None,
    base: str | None = None,
    tool: str | os.PathLike[str] | mujoco.MjSpec | None = None,
    scene: SceneLike | None = None,
    srdf: str | os.PathLike[str] | None = None,
    shapes: str | None = None,
    timestep: float | None = None,
) -> Arm:
    """An arm: any serial chain of any robot, or several that move together, its actuators turned into torque motors.

    A robot with one arm gives this arm. Of a robot with several limbs, such as two arms, a hand, a quadruped or a humanoid, it
    is all of them: all joints with a motor, and a tip at each end. All other joints are held where the model's keyframe puts
    them, and so is a base that floats or walks.

    Args:
        robot: The bundled arm ("robot_arm_3dof"), an alias ("panda"), a Menagerie name ("franka_emika_panda", or
            "franka_emika_panda/panda_nohand" for another of its entry points), a name of the package robot_descriptions
            ("panda_description"), the path of an .xml, .urdf or .xacro file, an MjSpec, or an MjModel. An MjSpec or MjModel is
            copied and never changed. A compiled MjModel cannot get further elements: its arm has no target marker unless the
            model has a mocap body named "target", and a base that moves, `tool`, `scene`, `srdf` and `shapes` need the MjSpec
            or the file.
        tip: The site, body or geom at the end of the chain. Left out, armctl finds the chain and its tip.
        tips: Instead of `tip`, the ends of several chains of one arm, such as both hands of a robot. The first one is the tip
            of calls that take no other; joints that two chains share count once.
        tip_offset: The tip, or the first one, in that element's frame.
        base: The body at the start of the chain: joints above it are held. Left out, the chain starts at the world. "planar"
            gives the robot's base joints of its own along x, along y and about z, "free" along and about all axes (yaw, pitch,
            roll), all at zero where the keyframe puts it. A free base has no motors in a simulation.
        tool: The gripper or hand to mount at the tip: by name, MJCF file or MjSpec. The tip is then the tool's.
        scene: The objects around the robot: a World, as it is now, the path of an MJCF file, or a list of them.
        srdf: The path of an SRDF, with allowed contacts, the home configuration, and groups for `tip`. Left out,
            armctl uses the one beside a URDF; without any, links of a URDF that touch at home may touch.
        shapes: What stands for the collision shape of links that need one and have none: "capsules" along them, or "visual",
            the geoms that the file draws them with. Left out, contacts of such an arm cannot be checked: no motion of it is
            proved, and `arm.unchecked_links` names the links.
        timestep: s, of the model: the tick of simulations, controllers and logs; left out, that of the file.

    Raises:
        InputError: An argument has a wrong type, or the names of the scene are taken.
        UnknownNameError: No robot, or nothing in the model, has that name.
        ModelError: The file cannot be read, is no arm, or could not be downloaded.

    Warns:
        ArmctlWarning: The model leaves out something that had to be assumed; a `MissingShapeWarning` if links have no shape.
    """
    if tip_offset is not None:
        instance("tip_offset", tip_offset, Pose, "armctl.Pose([0, 0, 0.1]) is 0.1 m along z")
    further_tips: tuple[str, ...] = ()
    if tips is not None:
        if tip is not None:
            raise InputError("tip, tips: both are given; give tips for several tips, and tip for one")
        tip, *others = _names("tips", tips)
        if tool is not None and others:
            raise InputError("tool: it is mounted at the tip of an arm with one tip; give one tip")
        further_tips = tuple(others)
    moving_base = base if isinstance(base, str) and base in BASE_JOINTS else None
    named = None if moving_base else base
    ends = ArmEnds(tip=tip, base=named, tip_offset=tip_offset, further_tips=further_tips, moving_base=moving_base)
    dt = None if timestep is None else number("timestep", timestep, *TIMESTEPS_S)
    return _loaded(robot, ends, moving_base=moving_base, tool=tool, scene=scene, srdf=srdf, shapes=shapes, timestep=dt)


def _names(what: str, names: Sequence[str]) -> list[str]:
    """A list of names from a caller."""
    if isinstance(names, str) or not isinstance(names, Sequence) or not names:
        raise InputError(f"{what}: {shown(names)} is not a list of names, such as ['left/gripper', 'right/gripper']")
    return list(names)


def chains(robot: str | os.PathLike[str] | mujoco.MjSpec | mujoco.MjModel) -> list[SerialChain]:
    """Every serial chain of a robot: its arms, legs, fingers, heads. A free base is treated as fixed.

    Args:
        robot: A name, the path of a file, an MjSpec or an MjModel.

    Returns:
        The chains that `load` accepts with their base and tip, longest first, then those it rejects, with the reason.

    Raises:
        InputError: The argument is no robot.
        UnknownNameError: No robot has that name.
        ModelError: The file cannot be read, or could not be downloaded.
    """
    if isinstance(robot, mujoco.MjModel):
        return all_chains(Transmissions(robot))
    source = locate(robot)
    spec = _read(source, None, hold_base=False).spec
    return all_chains(Transmissions(source.compile_without_textures(spec)))


def _loaded(
    robot: str | os.PathLike[str] | mujoco.MjSpec | mujoco.MjModel,
    ends: ArmEnds,
    *,
    moving_base: str | None,
    tool: str | os.PathLike[str] | mujoco.MjSpec | None,
    scene: SceneLike | None,
    srdf: str | os.PathLike[str] | None,
    shapes: str | None,
    timestep: float | None,
) -> Arm:
    """The arm with these ends. A specification is copied, since a caller can change it later."""
    shapes = read_shapes(shapes)
    if isinstance(robot, mujoco.MjModel):
        additions = {"base": moving_base, "tool": tool, "scene": scene, "srdf": srdf, "shapes": shapes}
        for what, addition in additions.items():
            if addition is not None:
                raise InputError(
                    f"{what}: a compiled MjModel cannot be changed in this way; pass the MjSpec or the path of the file"
                )
        model, corrections = corrected_model(robot)
        if timestep is not None:
            model = copy.copy(model)
            model.opt.timestep = timestep
        source = Source(model.names[: model.names.index(b"\0")].decode(errors="replace") or "model", None)
        with _naming(source.name):
            check_timestep(model)
            check_memory(model)
            analysis = Transmissions(model)
            plan = describe_arm(source, analysis, ends)
            prepared = make_arm_model_from_compiled(analysis, plan)
        unchecked = unchecked_links(model, plan.joints)
        prepared = _with_shape_notes(prepared, model, plan.joints, unchecked)
        return _checked_arm(source.name, prepared, [*corrections, *model_notes(model)], None)
    kept = locate(robot).copied_spec() if isinstance(robot, mujoco.MjSpec) else robot
    parts = None if scene is None else read_scene(scene)
    recipe = _LoadRecipe(
        kept, ends, moving_base=moving_base, tool=tool, scene=parts, srdf=srdf, shapes=shapes, timestep=timestep
    )
    return _checked_arm(*recipe.prepared(), recipe)


def _checked_arm(name: str, prepared: PreparedModel, notes: Sequence[str], recipe: _LoadRecipe | None) -> Arm:
    """The arm of a prepared model, checked, after the warnings about it."""
    warned = [*notes, *prepared.notes]
    for sentence in [*warned, *prepared.plan.notes]:
        note = sentence if isinstance(sentence, Note) else Note(sentence)
        warnings.warn(ArmctlWarning(f"{name}: {note}", note), stacklevel=4)
    if prepared.shape_note:
        note = Note(prepared.shape_note, _SHAPE_ADVICE, Severity.ERROR)
        warnings.warn(MissingShapeWarning(f"{name}: {note}", note), stacklevel=4)
        warned.append(prepared.shape_note)
    check_joint_parameters(prepared.model)
    own = {equality for loop in prepared.plan.loops for equality in loop.equalities}
    open_loops = open_loop_notes(prepared.model, home_qpos(prepared.model, prepared.plan.joints), own)
    notes = [*warned, *prepared.info_notes, *open_loops]
    arm = make_arm(name, prepared.model, prepared.plan, notes, recipe, prepared.unchecked_links)
    check_mass_matrix(arm)
    check_parity(arm)
    return arm


def _with_shape_notes(
    prepared: PreparedModel, model: mujoco.MjModel, joints: Joints, unchecked: Sequence[int], drawn: Collection[str] = ()
) -> PreparedModel:
    """The prepared model with what is noted about links without a collision shape."""
    names = names_of(model, unchecked)
    note = ""
    if names:
        remedy = f'load(..., shapes="{CAPSULES}") puts capsules along them'
        if visual_links(model, unchecked) or set(names) & set(drawn):
            remedy += f', shapes="{VISUAL}" takes their visual geoms'
        note = f"no collision shape for {few_names(names)}, so contacts cannot be checked; {remedy}"
    fixed = [name for name in names_of(model, fixed_without_shape(model, joints)) if name not in names]
    quiet = [f"no collision shape for the fixed {few_names(fixed)}: contacts with it are not found"] if fixed else []
    info_notes = (*prepared.info_notes, *quiet)
    return replace(prepared, info_notes=info_notes, unchecked_links=names, shape_note=note)


def _read(
    source: Source,
    moving_base: str | None,
    srdf: str | os.PathLike[str] | None = None,
    *,
    hold_base: bool = True,
    visual: bool = False,
) -> _RobotSpec:
    """A robot's specification, with what its SRDF says, and what is noted about it."""
    spec, notes, unread, drawn = source.read(visual=visual)
    notes = [*notes, *add_missing_motors(spec)]
    if moving_base is not None or (hold_base and may_float(spec)):
        model = source.compile_without_textures(spec)
        held = hold_free_bases(spec, model)
        if moving_base is not None:
            with _naming(source.name):
                add_base_joints(spec, model, moving_base, held)
    if srdf is not None:
        instance("srdf", srdf, (str, os.PathLike), "give the path of an SRDF")
        semantics = read_srdf(Path(srdf))
    else:
        semantics = find_srdf(source.urdf) if source.urdf is not None else None
    info_notes = apply_srdf(spec, semantics) if semantics is not None else []
    links_without_contact_rules: frozenset[str] = frozenset()
    if source.urdf is not None and not _lists_all_pairs(semantics, source.urdf, is_given=srdf is not None):
        links_without_contact_rules = frozenset(link.get("name", "") for link in source.urdf.root.findall("link"))
    return _RobotSpec(
        spec=spec,
        notes=tuple(notes),
        info_notes=tuple(info_notes),
        srdf=semantics,
        links_without_contact_rules=links_without_contact_rules,
        unread=unread,
        drawn=drawn,
    )


def _lists_all_pairs(srdf: Srdf | None, urdf: UrdfFile, is_given: bool) -> bool:
    """Whether an SRDF lists the links that may touch: one of another file name can describe a variant of the robot."""
    if srdf is None or not srdf.disabled:
        return False
    return is_given or srdf.path.stem == urdf.path.stem.removesuffix(".urdf")


@contextlib.contextmanager
def _naming(name: str) -> Iterator[None]:
    """Puts the robot's name before the message of a ModelError."""
    try:
        yield
    except ModelError as error:
        raise ModelError(f"{name:.80}: {error}") from None


class MountedTool(NamedTuple):
    """A tool in the model of a robot."""

    tip: str  # the name of its tip
    notes: list[str]  # what was left out of it, one sentence each
    unread: frozenset[str]  # its bodies whose shapes are in the file, and could not be read


def mount(spec: mujoco.MjSpec, flange: mujoco.MjsBody, T_body_flange: Pose, tool: Source) -> MountedTool:
    """Mounts a tool at a frame of the body `flange`, in place.

    Its masses, joints and actuators become part of the robot's model; all of its names get the tool's own before them.
    """
    description = tool.read()
    child = description.spec
    model = tool.compile(child)
    for joint in list(child.joints):
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            child.delete(joint)
    # The better friction of the two: a gripper that holds by it says how it needs it.
    spec.option.cone = max(spec.option.cone, child.option.cone)
    spec.option.impratio = max(spec.option.impratio, child.option.impratio)
    copy_options(spec, child)
    prefix = f"{tool.name.replace('/', '_')}/"
    site = flange.add_site(name=_FLANGE, pos=T_body_flange.position, quat=T_body_flange.quat)
    spec.attach(child, site=site, prefix=prefix)
    root = next((body for body in range(1, model.nbody) if model.body_parentid[body] == 0), 0)
    unread = frozenset(prefix + name for name in description.unread)
    return MountedTool(prefix + tip_on(model, root).name, description.notes, unread)
