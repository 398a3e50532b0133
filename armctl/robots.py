"""From a name to an Arm: the bundled arm, a Menagerie robot, or a file of one's own."""

from __future__ import annotations

import os
import warnings
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from armctl.arm import Arm, check_parity
from armctl.arrays import Array, IntArray, frozen
from armctl.chain import Chain, chain_to, find_chain, find_tip, joint_actuators, joint_name, named_tip
from armctl.datasheets import ALIASES, ROWS, Row
from armctl.errors import ArmctlWarning, InputError, ModelError, UnknownNameError
from armctl.motors import JointData, from_row, joint_limits, make_motors, torque_limits
from armctl.pose import Pose
from armctl.rigid_body import build, joint_above

BUNDLED = "robot_arm_3dof"
TARGET = "target"
_GREEN = (0.0, 1.0, 0.0, 0.5)
_TARGET_RADIUS = 0.03
_TARGET_OFFSET = 0.3  # rad (m) from home at every joint: where a target that armctl adds is reached


@dataclass(frozen=True)
class Source:
    """Where a robot's description is.

    Attributes:
        name: What the arm will be called.
        path: Its MJCF or URDF file.
        row: Its data-sheet row, or None.
    """

    name: str
    path: Path
    row: Row | None = None


def load(name: str | os.PathLike[str], *, tip: str | None = None, tip_offset: Pose | None = None) -> Arm:
    """An arm by name, its actuators turned into torque motors.

    Args:
        name: The bundled arm ("robot_arm_3dof"), an alias ("panda"), a Menagerie name ("franka_emika_panda", or
            "franka_emika_panda/panda_nohand" for another of its entry points), or the path of an .xml or .urdf file.
        tip: The site, body or geom at the end of the chain. Left out, armctl finds the chain and its tip.
        tip_offset: The tip in that element's frame.

    Returns:
        The arm.

    Raises:
        InputError: The name is no name, or `tip_offset` is no Pose.
        UnknownNameError: No robot, or nothing in the model, has that name.
        ModelError: The file cannot be read, is no arm, or could not be downloaded.

    Warns:
        ArmctlWarning: The model leaves out something that had to be assumed.
    """
    if tip_offset is not None and not isinstance(tip_offset, Pose):
        raise InputError(f"tip_offset: {tip_offset!r} is not a Pose; armctl.Pose([0, 0, 0.1]) is 0.1 m along z")
    source = locate(name)
    spec = _read(source.path)
    arm = _assemble(source, spec, tip, tip_offset)
    check_parity(arm)
    return arm


def locate(name: str | os.PathLike[str]) -> Source:
    """Where the description of a robot is; downloads a Menagerie robot on first use.

    Args:
        name: As for `load`.

    Returns:
        The place.

    Raises:
        InputError: It is neither a name nor a path.
        UnknownNameError: No robot has that name.
        ModelError: There is no such file, or the robot could not be downloaded.
    """
    import mujoco_menagerie as menagerie

    if not isinstance(name, (str, os.PathLike)) or not os.fspath(name):
        raise InputError(f"robot: {name!r} is neither a name nor a path; try armctl.load('panda')")
    given = os.fspath(name)
    if given.lower().endswith((".xml", ".mjcf", ".urdf")) or isinstance(name, os.PathLike):
        path = Path(given)
        if not path.is_file():
            raise ModelError(f"{given}: no such file")
        return Source(path.stem, path)
    if given == BUNDLED:
        return Source(given, bundled_models() / f"{BUNDLED}.xml")
    family, _, entry = given.partition("/")
    robot_name = ALIASES.get(family, family)
    if robot_name not in menagerie.names():
        raise UnknownNameError.of("robot", given, [BUNDLED, *ALIASES, *menagerie.names()])
    try:
        path = menagerie.get(robot_name).xml(entry or None)
    except menagerie.UnknownEntryPointError as error:
        known = menagerie.get(robot_name).entry_names
        raise UnknownNameError.of(f"entry point of {robot_name}", entry, known) from error
    except menagerie.MenagerieError as error:
        raise ModelError(
            f"{given}: its model is not at hand ({error}); with a network run `mujoco-menagerie prefetch {robot_name}`, "
            "or set MENAGERIE_ROOT to a checkout of MuJoCo Menagerie"
        ) from error
    if not path.is_file():
        raise ModelError(f"{given}: {path} does not exist; this copy of MuJoCo Menagerie is older than its index")
    return Source(given, path, ROWS.get(robot_name))


def bundled_models() -> Path:
    """The folder of the models that come with armctl, in a checkout as in an installed package."""
    installed = Path(__file__).parent / "models"
    return installed if installed.is_dir() else Path(__file__).parent.parent / "models"


def robots() -> dict[str, str]:
    """Every name that `load` takes, but paths.

    Returns:
        Name to a short description: the bundled arm, the aliases, then Menagerie's arms.
    """
    import mujoco_menagerie as menagerie

    known = {BUNDLED: "bundled: three joints, the tutorial's arm"}
    known |= {alias: f"MuJoCo Menagerie: {menagerie.get(name).display_name}" for alias, name in ALIASES.items()}
    unlisted = (r for r in menagerie.robots() if "arm" in r.category and r.name not in ALIASES.values())
    return known | {r.name: f"MuJoCo Menagerie: {r.display_name}" for r in unlisted}


def _read(path: Path) -> mujoco.MjSpec:
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        if path.suffix.lower() == ".urdf":
            spec.compiler.fusestatic = False
            _add_motors(spec)
        return spec
    except (ValueError, OSError) as error:
        raise ModelError(f"{path}: MuJoCo cannot read it: {_one_line(error)}") from None


def _assemble(source: Source, spec: mujoco.MjSpec, tip: str | None, tip_offset: Pose | None) -> Arm:
    original = _compiled(source, spec)
    row = source.row
    try:
        joints, tip_name, tip_body, T_body_tip = _chain_and_tip(original, tip, row)
        sheet = _urdf_data(source.path, original, joints) or from_row(row, joints)
        tau_max, sources, notes = torque_limits(original, joints, sheet)
        make_motors(spec, original, joints, tau_max)
    except ModelError as error:
        raise ModelError(f"{source.name}: {error}") from None
    T_body_tip = T_body_tip @ tip_offset if tip_offset is not None else T_body_tip
    for sentence in notes:
        warnings.warn(f"{source.name}: {sentence}", ArmctlWarning, stacklevel=3)
    notes += _exclude_overlaps(spec, original, joints)
    _add_target(spec, original)
    model = _compiled(source, spec)
    index = list(joints)
    home_qpos = _home(model, joints)
    limits, more = joint_limits(model, joints, home_qpos, tau_max, sheet)
    actuators = [joint_actuators(model)[j] for j in joints]
    ctrl_adr = model.actuator_ctrladr[actuators].astype(int)
    _rest_keyframes(model, ctrl_adr)
    rigid_body = build(model, joints, home_qpos, tip_body, T_body_tip)
    home = frozen(home_qpos[model.jnt_qposadr[index]])
    _place_target(model, rigid_body.tip(limits.clamp(home + _TARGET_OFFSET))[0])
    return Arm(
        name=source.name,
        model=model,
        joint_names=tuple(joint_name(model, j) for j in joints),
        tip=tip_name,
        home=home,
        limits=limits,
        rigid_body=rigid_body,
        qpos_adr=frozen(model.jnt_qposadr[index].astype(int)),
        dof_adr=frozen(model.jnt_dofadr[index].astype(int)),
        ctrl_adr=frozen(ctrl_adr),
        gear=frozen(model.actuator_gear[actuators, 0].copy()),
        home_qpos=home_qpos,
        home_ctrl=_home_ctrl(model, ctrl_adr),
        tip_body=tip_body,
        T_body_tip=T_body_tip,
        notes=tuple(notes),
        sources=sources | more,
    )


def _compiled(source: Source, spec: mujoco.MjSpec) -> mujoco.MjModel:
    try:
        return spec.compile()
    except (ValueError, OSError) as error:
        raise ModelError(f"{source.path}: MuJoCo cannot compile it: {_one_line(error)}") from None


def _chain_and_tip(model: mujoco.MjModel, tip: str | None, row: Row | None) -> tuple[Chain, str, int, Pose]:
    if tip is not None:
        name, body, T_body_tip = named_tip(model, tip)
        return chain_to(model, body), name, body, T_body_tip
    joints = find_chain(model)
    if row is not None and row.tip is not None:
        try:
            name, body, T_body_tip = named_tip(model, row.tip)
        except UnknownNameError:  # another entry point of the robot, such as one without its hand
            return joints, *find_tip(model, joints)
        return joints, name, body, T_body_tip @ Pose(row.tip_offset or (0.0, 0.0, 0.0))
    return joints, *find_tip(model, joints)


def _home(model: mujoco.MjModel, joints: Chain) -> Array:
    """The keyframe `home`; without one, the middle of the arm's ranges and the first keyframe for the rest."""
    key = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home")
    qpos = model.key_qpos[max(key, 0)].copy() if model.nkey else model.qpos0.copy()
    for joint in joints:
        low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-np.inf, np.inf)
        address = model.jnt_qposadr[joint]
        if key < 0:
            qpos[address] = 0.5 * (low + high) if model.jnt_limited[joint] else model.qpos0[address]
        qpos[address] = min(max(qpos[address], low), high)
    return frozen(qpos)


def _home_ctrl(model: mujoco.MjModel, ctrl_adr: IntArray) -> Array:
    key = max(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home"), 0)
    ctrl = model.key_ctrl[key].copy() if model.nkey else np.zeros(len(mujoco.MjData(model).ctrl))
    ctrl[ctrl_adr] = 0.0
    return frozen(ctrl)


def _rest_keyframes(model: mujoco.MjModel, ctrl_adr: IntArray) -> None:
    """Keyframes hold joint angles where the motors now take torques: put zero there."""
    if model.nkey:
        model.key_ctrl[:, ctrl_adr] = 0.0


def _exclude_overlaps(spec: mujoco.MjSpec, model: mujoco.MjModel, joints: Chain) -> list[str]:
    """Takes off the contact of links that overlap their neighbour at home: it would brake the joint between them.

    MuJoCo leaves out contacts of a body with its parent, but not where the parent stands still in the world.
    """
    data, above = mujoco.MjData(model), joint_above(model, joints)
    data.qpos[:] = _home(model, joints)
    mujoco.mj_forward(model, data)
    pairs = {tuple(sorted(int(model.geom_bodyid[g]) for g in contact.geom)) for contact in data.contact if contact.dist < 0}
    notes = []
    for first, second in sorted(pairs):
        names = model.body(first).name, model.body(second).name
        if first > 0 and all(names) and abs(above[first] - above[second]) == 1:
            spec.add_exclude(bodyname1=names[0], bodyname2=names[1])
            notes.append(f"contact of {names[0]} with {names[1]} left out: neighbours that overlap at home")
    return notes


def _add_target(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, TARGET) >= 0:
        return
    body = spec.worldbody.add_body(name=TARGET, mocap=True)
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[_TARGET_RADIUS, 0, 0], rgba=_GREEN, contype=0, conaffinity=0, group=1
    )


def _place_target(model: mujoco.MjModel, position: Array) -> None:
    """Where a target that armctl added starts: within reach, and not where the tip is at home."""
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, TARGET)
    if model.body_mocapid[body] >= 0 and not model.body_pos[body].any():
        model.body_pos[body] = position
        if model.nkey:
            model.key_mpos[:, 3 * model.body_mocapid[body] : 3 * model.body_mocapid[body] + 3] = position


def _add_motors(spec: mujoco.MjSpec) -> None:
    """A URDF has no actuators: each of its hinge and slide joints gets a motor."""
    for joint in spec.joints:
        if joint.type in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
            spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)


def _urdf_data(path: Path, model: mujoco.MjModel, joints: Chain) -> JointData | None:
    """The speed limits of a URDF, which MuJoCo does not keep."""
    if path.suffix.lower() != ".urdf":
        return None
    limits = {j.get("name"): j.find("limit") for j in ElementTree.parse(path).getroot().iter("joint")}
    speeds = []
    for joint in joints:
        limit = limits.get(joint_name(model, joint))
        speeds.append(float(limit.get("velocity", 0)) if limit is not None else 0.0)
    return JointData("URDF", v_max=np.array(speeds)) if all(s > 0 for s in speeds) else None


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
