"""Mechanism: a gripper whose joints follow its actuators at fixed ratios, so that it can be placed without a simulation."""

import copy
from dataclasses import dataclass

import mujoco
import numpy as np

from armctl.core.validation import Array, IntArray
from armctl.model.arm.joint_map import JointMap
from armctl.model.mjmodel.transmissions import Transmission, Transmissions


@dataclass(frozen=True, eq=False)
class Mechanism:
    """What each actuator of a gripper moves: one transmission for each, led by the joint that it acts on, if any."""

    transmissions: tuple[Transmission, ...]
    joint_map: JointMap  # how the leading joints move all others

    @property
    def followers(self) -> list[int]:
        """The joints that follow another at a fixed ratio."""
        return np.delete(self.joint_map.joints, self.joint_map.leaders).tolist()

    def inertia(self, model: mujoco.MjModel) -> Array:
        """(actuators,) kg m^2 (kg): the inertia of all that each actuator moves, at the speed of its leading joint."""
        return (self.joint_map.ratio**2 * model.dof_M0[self.joint_map.dof_adr, None]).sum(axis=0)

    def placed(self, model: mujoco.MjModel, start: mujoco.MjData, ctrl: Array) -> mujoco.MjData:
        """The gripper where servos without load hold it, within the ranges of its joints; other joints are as in `start`."""
        data = copy.copy(start)
        leaders = [
            np.clip(_leader_at(model, transmission, float(command)), *_leader_range(model, transmission))
            for transmission, command in zip(self.transmissions, ctrl, strict=True)
        ]
        self.joint_map.set_positions(data.qpos, np.array(leaders))
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_tendon(model, data)
        mujoco.mj_transmission(model, data)
        return data


def find_mechanism(model: mujoco.MjModel, dofs: IntArray, actuators: tuple[int, ...]) -> Mechanism | None:
    """The mechanism of a gripper; None if its joints close a loop or share a pull in no fixed ratio."""
    analysis = Transmissions(model)
    found: dict[int, Transmission] = {}
    free: list[int] = []
    for joint in (int(model.dof_jntid[d]) for d in dofs):
        if joint in analysis.loops:
            return None
        transmission = analysis.of(joint)
        if isinstance(transmission, str):
            free.append(joint)
        elif transmission.actuator not in found or joint == model.actuator_trnid[transmission.actuator, 0]:
            found[transmission.actuator] = transmission
    if not set(actuators) <= found.keys() or any(analysis.coupling_reason(joint) for joint in free):
        return None
    transmissions = tuple(found[actuator] for actuator in actuators)
    return Mechanism(transmissions, JointMap.from_transmissions(model, (), transmissions))


def _leader_at(model: mujoco.MjModel, transmission: Transmission, ctrl: float) -> float:
    """The position of the leading joint where the servo's force gain ctrl + bias0 + bias1 length is zero."""
    bias = model.actuator_biasprm[transmission.actuator]
    length = -(float(model.actuator_gainprm[transmission.actuator, 0]) * ctrl + float(bias[0])) / float(bias[1])
    offset = sum(moment * transmission.coupled[joint].offset for joint, moment in transmission.moments.items())
    return (length - offset) / transmission.gear


def _leader_range(model: mujoco.MjModel, transmission: Transmission) -> tuple[float, float]:
    """The range of the leading joint in which all joints that follow it are in theirs; its own if there is none."""
    low = -np.inf
    high = np.inf
    for joint, mimic in transmission.coupled.items():
        if model.jnt_limited[joint]:
            ends = (model.jnt_range[joint] - mimic.offset) / mimic.ratio
            low = max(low, float(ends.min()))
            high = min(high, float(ends.max()))
    if low < high:
        return low, high
    own = model.jnt_range[transmission.joint]
    return float(own[0]), float(own[1])
