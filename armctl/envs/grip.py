"""Grip: the gripper of an environment, which one number of an action closes and opens."""

from __future__ import annotations

import copy
from typing import NamedTuple

import mujoco
import numpy as np

from armctl.core.validation import Array, IntArray
from armctl.robot.arm import Arm
from armctl.sim.gripper.model import GripperModel, find_gripper_model, make_usable
from armctl.sim.plant import brake

_SETTLE_TIME = 1.0  # s
_PAD_SPEED = 0.1  # m/s, of the pads relative to each other


class Grip(NamedTuple):
    """The gripper behind an arm's tip."""

    model: GripperModel  # the gripper as it was found in the MuJoCo model
    qpos_adr: IntArray  # addresses in `MjData.qpos` of its joints
    closed: mujoco.MjData  # the state of the arm at home when it is closed
    opened: mujoco.MjData  # the state of the arm at home when it is open
    indices: IntArray  # (2, actuators) of its actuators in `MjData.ctrl` and in `MjData.actuator_length`
    ends: Array  # (4, actuators) the controls when closed and open, and the actuators' lengths when closed and open
    speed: float  # 1/s, the fraction of the way from closed to open that its controls move in a second

    @property
    def width_max(self) -> float:
        """The distance between the pads when open, m."""
        return float(self.model.width[-1])


def find_grip(arm: Arm) -> Grip:
    """The gripper behind an arm's tip; ModelError if nothing moves there, or a hand of many actuators."""
    gripper = find_gripper_model(arm)
    actuators = list(gripper.actuators)
    indices = np.array([arm.model.actuator_ctrladr[actuators], actuators], np.int64)
    joints = np.unique(arm.model.dof_jntid[gripper.dofs])
    return Grip(
        model=gripper,
        qpos_adr=arm.model.jnt_qposadr[joints].astype(np.int64),
        closed=state_at(arm, gripper, gripper.ctrl[0]),
        opened=state_at(arm, gripper, gripper.ctrl[-1]),
        indices=indices,
        ends=np.array([gripper.ctrl[0], gripper.ctrl[-1], gripper.length[0], gripper.length[-1]]),
        speed=_PAD_SPEED / float(np.ptp(gripper.width)),
    )


def state_at(arm: Arm, gripper: GripperModel, ctrl: Array) -> mujoco.MjData:
    """The state at home in which controls (actuators,) hold the gripper, without contacts and gravity."""
    model = copy.copy(arm.model)
    model.opt.gravity[:] = 0.0
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    brake(model, np.setdiff1d(np.arange(model.nv), gripper.dofs))
    make_usable(model, gripper)
    data = mujoco.MjData(model)
    data.qpos[:] = arm.home_qpos
    data.ctrl[model.actuator_ctrladr[list(gripper.actuators)]] = ctrl
    mujoco.mj_step(model, data, round(_SETTLE_TIME / model.opt.timestep))
    mujoco.mj_forward(model, data)
    return data
