"""Identified inertia in models: compiled MuJoCo models, MJCF and URDF."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin

from armctl.core.atomic import file_path, write_text
from armctl.core.errors import InputError
from armctl.core.result import Verdict
from armctl.core.validation import Array, shown
from armctl.lab.identification.pseudo_inertia import inertial_parameters, pseudo_inertia, regularized, upper_factor
from armctl.model.arm.arm import Arm, check_arm
from armctl.model.loading.catalog import locate
from armctl.model.mjmodel.edit import set_body_inertia
from armctl.model.mjmodel.queries import last_joint_above

_MIN_MASS_KG = 1e-9
_MIN_LENGTH_M = 1e-6
_NO_LIMIT = 1e6  # URDF requires numbers


class IdentifiedArm(Verdict):
    """What was identified of an arm, as a model, MJCF and URDF."""

    __slots__ = ()
    _WHAT = "identified"
    reason: str
    arm: Arm

    def applied_to(self, arm: Arm) -> Arm:
        """The arm with what was identified, for a controller; its motors stay torque motors.

        `inverse_dynamics` of the result contains identified viscous friction, and leaves out Coulomb friction: that is MuJoCo's
        `frictionloss` of the result, which controllers compensate. What has no place in a MuJoCo model is left out: breakaway
        friction, offsets, and the frames of sensor and marker.

        Args:
            arm: The arm that was measured. If a link consists of several bodies, all of them change alike.

        Raises:
            InputError: Nothing was identified, the arm has other joints, or a link is not physically consistent.
            ModelError: For a geometry: a joint of the arm follows another one.
        """
        check_arm(arm)
        if not self.ok:
            raise InputError(f"estimate: {self.arm.name:.40}: not {self._WHAT}: {self.reason:.250}")
        if arm.joint_names != self.arm.joint_names:
            raise InputError(f"arm: its joints are {shown(arm.joint_names)}, {self._WHAT} are {shown(self.arm.joint_names)}")
        return self._identified(arm)

    def to_mjcf(self, path: str | os.PathLike[str], source: str | os.PathLike[str] | None = None) -> Path:
        """Writes the robot's MJCF with what was identified; all else stays as it is.

        Rotor inertia and friction are those of `applied_to`. Identified servos become position servos with gains and delay,
        without offsets, which belong to the measurement. With a calibrated geometry, a tip that is a site is moved; else the
        site "calibrated_tip" is added, for `armctl.load(path, tip="calibrated_tip")`.

        Args:
            path: The .xml file; it is written atomically, and its folder is made. Meshes are referred to by absolute paths.
            source: The name or file that the arm was loaded from; the name of the arm if left out.

        Raises:
            InputError: Nothing was identified, a link is not physically consistent, or the source is not that of the arm.
            UnknownNameError: There is no robot of the name of the arm; give `source`.
            ArmctlError: The file cannot be written.
        """
        path = file_path("path", path, (".xml",))
        identified = self.applied_to(self.arm)
        spec = edited_spec(self.arm, identified.model, source)
        self._complete(spec, identified)
        write_text(path, spec.to_xml())
        return path

    def to_urdf(self, path: str | os.PathLike[str]) -> Path:
        """Writes the identified arm's chain as a URDF: joints, limits, inertia and friction, no meshes.

        URDF has no rotor inertia and no servos; they are left out.

        Args:
            path: The .urdf file; it is written atomically, and its folder is made.

        Raises:
            InputError: Nothing was identified, or a link is not physically consistent.
            ArmctlError: The file cannot be written.
        """
        path = file_path("path", path, (".urdf",))
        write_text(path, urdf_text(self.applied_to(self.arm)))
        return path

    def _complete(self, spec: mujoco.MjSpec, identified: Arm) -> None:
        """Writes more than inertia and friction into the specification of the arm."""

    def _identified(self, arm: Arm) -> Arm:
        raise NotImplementedError


def consistent_model(arm: Arm, model: mujoco.MjModel, inertia: Array) -> None:
    """Gives the links of an arm other inertia, in place: (n, 10), physically consistent. The caller must call `mj_setConst`.

    A link may consist of several bodies, such as a flange with a gripper. With the pseudo-inertia P = U U^T of the whole link,
    the required P' = U' U'^T and A = U' U^-1, every body gets A P_k A^T; all are consistent and their sum is P'. The remainder
    where P is singular goes to the first body.
    """
    owners = np.asarray(last_joint_above(arm.model, arm.joint_map.joints))
    frames = _body_frames(arm)
    for i in range(arm.n):
        bodies = [int(b) for b in np.flatnonzero(owners == i) if arm.model.body_mass[b] or arm.model.body_inertia[b].any()]
        wanted = pseudo_inertia(inertia[i])
        if not bodies:
            bodies = [int(arm.model.jnt_bodyid[arm.joint_map.joints[i]])]
        parts = [pseudo_inertia(_in_joint_frame(arm.model, b, frames[b]).toDynamicParameters()) for b in bodies]
        whole = regularized(inertial_parameters(sum(parts, np.zeros((4, 4)))), _MIN_MASS_KG, _MIN_LENGTH_M)
        A = upper_factor(wanted) @ np.linalg.inv(upper_factor(pseudo_inertia(whole)))
        parts = [A @ part @ A.T for part in parts]
        parts[0] = parts[0] + wanted - sum(parts, np.zeros((4, 4)))
        for body, part in zip(bodies, parts, strict=True):
            own = frames[body].actInv(pin.Inertia.FromDynamicParameters(inertial_parameters(part)))
            set_body_inertia(model, body, own)


def edited_spec(arm: Arm, model: mujoco.MjModel, given: str | os.PathLike[str] | None) -> mujoco.MjSpec:
    """The specification that an arm was loaded from, with the inertia, rotor inertia and friction of a model."""
    source = locate(arm.name if given is None else given)
    spec = source.read().spec
    source.compile(spec)
    if source.path is not None:
        folder = source.path.parent.resolve()
        spec.meshdir = str(folder / spec.meshdir)
        spec.texturedir = str(folder / spec.texturedir)
    owners = np.asarray(last_joint_above(arm.model, arm.joint_map.joints))
    joints = {joint.name: joint for joint in spec.joints}
    bodies = {body.name: body for body in spec.bodies if body.name}
    for number in np.flatnonzero(owners >= 0):
        if not model.body_mass[number]:
            continue
        body = _same_body(model, int(number), bodies, joints)
        if body is None:
            name = model.body(int(number)).name or f"number {number}"
            raise InputError(f"source: {source.name:.80} has no body {name!r:.60}; load it without tools and scenes")
        body.explicitinertial = True
        body.mass = float(model.body_mass[number])
        body.ipos = model.body_ipos[number]
        body.iquat = model.body_iquat[number]
        body.inertia = model.body_inertia[number]
        body.fullinertia = np.full(6, np.nan)
    for name, dof in zip(arm.joint_names, arm.dof_adr, strict=True):
        if name not in joints:
            raise InputError(f"source: {source.name:.80} has no joint {name!r:.60}")
        joint = joints[name]
        joint.armature = float(model.dof_armature[dof])
        joint.damping = np.concatenate([[model.dof_damping[dof]], np.ravel(joint.damping)[1:]])
        joint.frictionloss = float(model.dof_frictionloss[dof])
        joint.solimp_friction = model.dof_solimp[dof]
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    return spec


def place_bodies(spec: mujoco.MjSpec, arm: Arm, corrected: Arm) -> None:
    """Moves the bodies of a specification, in place, and its tip, to where they are in a corrected arm."""
    joints = {joint.name: joint for joint in spec.joints}
    bodies = {body.name: body for body in spec.bodies if body.name}
    model = corrected.model
    moved = (model.body_pos != arm.model.body_pos).any(axis=1) | (model.body_quat != arm.model.body_quat).any(axis=1)
    for number in np.flatnonzero(moved):
        body = _same_body(model, int(number), bodies, joints)
        if body is None:
            raise InputError(f"source: it has no body {model.body(number).name!r:.60}")
        _place(body, body.parent, model.body_pos[number], model.body_quat[number])
    carrier = _same_body(model, arm.tip_body, bodies, joints)
    if carrier is None:
        raise InputError(f"source: it has no body {model.body(arm.tip_body).name!r:.60}")
    T = corrected.T_body_tip
    site = next((site for site in carrier.sites if site.name == arm.tip), None)
    if site is not None:
        _place(site, carrier, T.position, T.quat)
    elif not (np.allclose(T.position, arm.T_body_tip.position) and np.allclose(T.quat, arm.T_body_tip.quat)):
        carrier.add_site(name="calibrated_tip", pos=T.position, quat=T.quat)


def _place(element: mujoco.MjsBody | mujoco.MjsSite, parent: mujoco.MjsBody, position: Array, quat: Array) -> None:
    """Sets where an element is in its parent, whatever frame or angles its file gave."""
    if element.frame is not None:
        element.set_frame(parent.add_frame())
    element.pos = position
    element.quat = quat
    element.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT


def _same_body(
    model: mujoco.MjModel, number: int, bodies: dict[str, mujoco.MjsBody], joints: dict[str, mujoco.MjsJoint]
) -> mujoco.MjsBody | None:
    """The body of a specification that is a body of a model, by its name or else by that of its joint."""
    body = model.body(number)
    if body.name:
        return bodies.get(body.name)
    if not model.body_jntnum[number]:
        return None
    joint = joints.get(model.joint(int(model.body_jntadr[number])).name)
    return None if joint is None else joint.parent


def urdf_text(arm: Arm) -> str:
    """The chain of an arm as URDF: every joint turns about, or slides along, the z axis of its link's frame."""
    pin_model = arm.pinocchio_model.pin_model
    limits = arm.limits
    root = ET.Element("robot", name=arm.name)
    ET.SubElement(root, "link", name="base")
    damping = arm.model.dof_damping[arm.dof_adr]
    friction = arm.model.dof_frictionloss[arm.dof_adr]
    for i, name in enumerate(arm.joint_names):
        inertia = pin_model.inertias[i + 1]
        link = ET.SubElement(root, "link", name=f"link_{i + 1}")
        inertial = ET.SubElement(link, "inertial")
        ET.SubElement(inertial, "origin", xyz=_text(inertia.lever), rpy="0 0 0")
        ET.SubElement(inertial, "mass", value=repr(float(inertia.mass)))
        moments = inertia.inertia
        entries = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
        ET.SubElement(inertial, "inertia", {key: repr(float(moments[at])) for key, at in entries.items()})
        slides = bool(arm.pinocchio_model.is_slide[i])
        joint = ET.SubElement(root, "joint", name=name, type="prismatic" if slides else "revolute")
        T = pin_model.jointPlacements[i + 1]
        ET.SubElement(joint, "origin", xyz=_text(T.translation), rpy=_text(pin.rpy.matrixToRpy(T.rotation)))
        ET.SubElement(joint, "parent", link="base" if i == 0 else f"link_{i}")
        ET.SubElement(joint, "child", link=f"link_{i + 1}")
        ET.SubElement(joint, "axis", xyz="0 0 1")
        bounds = {"lower": limits.q_min[i], "upper": limits.q_max[i], "effort": limits.tau_max[i], "velocity": limits.v_max[i]}
        clipped = {key: repr(float(np.clip(value, -_NO_LIMIT, _NO_LIMIT))) for key, value in bounds.items()}
        ET.SubElement(joint, "limit", clipped)
        ET.SubElement(joint, "dynamics", damping=repr(float(damping[i])), friction=repr(float(friction[i])))
    ET.SubElement(root, "link", name="tip")
    tip = ET.SubElement(root, "joint", name="tip_joint", type="fixed")
    T_tip = pin.SE3(np.asarray(arm.pinocchio_model.T_last_tip))
    ET.SubElement(tip, "origin", xyz=_text(T_tip.translation), rpy=_text(pin.rpy.matrixToRpy(T_tip.rotation)))
    ET.SubElement(tip, "parent", link=f"link_{arm.n}")
    ET.SubElement(tip, "child", link="tip")
    ET.indent(root)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _body_frames(arm: Arm) -> dict[int, pin.SE3]:
    """The frame of every body behind a joint of the arm, in the frame of that joint."""
    data = mujoco.MjData(arm.model)
    data.qpos[:] = arm.home_qpos
    mujoco.mj_kinematics(arm.model, data)
    pin_data = arm.pinocchio_model.pin_model.createData()
    pin.forwardKinematics(arm.pinocchio_model.pin_model, pin_data, arm.home_qpos[arm.qpos_adr])
    frames = {}
    for body, owner in enumerate(last_joint_above(arm.model, arm.joint_map.joints)):
        if owner >= 0:
            T_world_body = pin.SE3(data.xmat[body].reshape(3, 3).copy(), data.xpos[body].copy())
            frames[body] = pin_data.oMi[owner + 1].actInv(T_world_body)
    return frames


def _in_joint_frame(model: mujoco.MjModel, body: int, frame: pin.SE3) -> pin.Inertia:
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.body_iquat[body])
    rotation = rotation.reshape(3, 3)
    moments = rotation @ np.diag(model.body_inertia[body]) @ rotation.T
    return frame.act(pin.Inertia(float(model.body_mass[body]), model.body_ipos[body].copy(), moments))


def _text(values: Array) -> str:
    return " ".join(repr(float(value)) for value in values)
