"""Actuation: the driven joints of an arm, and where MuJoCo keeps their numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from armctl.core import units
from armctl.core.limits import Limits
from armctl.core.validation import Array, IntArray, frozen, instance
from armctl.model.arm.joint_map import JointMap
from armctl.model.mjmodel.queries import joint_name
from armctl.model.mjmodel.transmissions import Transmission


@dataclass(frozen=True, eq=False)
class Actuation:
    """The n driven joints of an arm: names, limits, and addresses in the arrays of MuJoCo.

    A tick loop and a log need no more than this. All arrays are read-only.

    Attributes:
        joint_names: The n joints, from the base to the tip.
        joint_map: How the n joints move all joints that are coupled to them.
        limits: The limits of the n joints.
        units: "rad" for each joint that turns, "m" for each that slides.
        qpos_adr: (n,) addresses of the joints in `MjData.qpos`.
        dof_adr: (n,) addresses of the joints in `MjData.qvel`.
        ctrl_adr: (n,) addresses of their motors in `MjData.ctrl`.
        motor_adr: (n,) addresses of their motors in `MjData.actuator_force`.
        gear: (n,) joint torque per unit of control, and of the motor's force.
    """

    joint_names: tuple[str, ...]
    joint_map: JointMap
    limits: Limits
    units: tuple[str, ...]
    qpos_adr: IntArray
    dof_adr: IntArray
    ctrl_adr: IntArray
    motor_adr: IntArray
    gear: Array

    @property
    def n(self) -> int:
        """The number of driven joints."""
        return len(self.joint_names)

    @cached_property
    def torque_units(self) -> tuple[str, ...]:
        """ "N m" for each joint that turns, "N" for each that slides."""
        return units.of_torque(self.units)

    @classmethod
    def from_model(
        cls, model: mujoco.MjModel, joint_map: JointMap, transmissions: Sequence[Transmission], limits: Limits
    ) -> Actuation:
        """Reads the addresses of an arm's joints and motors from a compiled model.

        Args:
            model: The compiled model; its actuators are motors.
            joint_map: The arm's joints and those coupled to them.
            transmissions: What moves the n joints.
            limits: The limits of the n joints.
        """
        instance("model", model, mujoco.MjModel, "arm.model is one")
        instance("joint_map", joint_map, JointMap, "arm.joint_map is one")
        instance("limits", limits, Limits, "arm.limits is one")
        for each in transmissions if isinstance(transmissions, Sequence) else [transmissions]:
            instance("transmissions", each, Transmission, "a list of them is needed")
        joints = [transmission.joint for transmission in transmissions]
        actuators = [transmission.actuator for transmission in transmissions]
        slides = model.jnt_type[joints] == int(mujoco.mjtJoint.mjJNT_SLIDE)
        return cls(
            joint_names=tuple(joint_name(model, joint) for joint in joints),
            joint_map=joint_map,
            limits=limits,
            units=units.of_joints(slides),
            qpos_adr=frozen(model.jnt_qposadr[joints].astype(np.int64)),
            dof_adr=frozen(model.jnt_dofadr[joints].astype(np.int64)),
            ctrl_adr=frozen(model.actuator_ctrladr[actuators].astype(np.int64)),
            motor_adr=frozen(np.array(actuators, dtype=np.int64)),
            gear=frozen(np.array([transmission.gear for transmission in transmissions])),
        )
