"""Coriolis matrix, energies, center of mass, regressor, and the poses and Jacobians of all bodies."""

from __future__ import annotations

import mujoco
import numpy as np
import pinocchio as pin

from armctl.core.errors import UnknownNameError
from armctl.core.validation import Array, frozen
from armctl.model.arm.passive_forces import PassiveForces
from armctl.model.arm.pinocchio_model import WORLD_AXES_AT_TIP, PinocchioModel
from armctl.model.mjmodel.queries import last_joint_above


class Mechanics:
    """Quantities of an arm by Pinocchio, on a model in which no joint follows another.

    Pinocchio computes few of them with mimic joints. With the m positions R q + r of all joints that n move, matrices are
    R^T X R, and Jacobians J R; with closed loops R varies, and its derivative adds to both. An object has its own scratch
    memory: use it in one thread at a time.
    """

    def __init__(self, model: mujoco.MjModel, pinocchio_model: PinocchioModel, home_qpos: Array):
        self._joint_map = pinocchio_model.joint_map
        self._passive = PassiveForces(model, self._joint_map)
        self._armature = model.dof_armature[self._joint_map.dof_adr]
        self._support = pinocchio_model.gravity_support
        self._support_data = None if self._support is None else self._support.createData()
        self._model = _without_mimic_joints(model, pinocchio_model)
        self._first_tip = self._model.nframes
        self._bodies = _add_frames(self._model, model, pinocchio_model, home_qpos)
        self._data = self._model.createData()
        bodies = self._model.inertias[1:]
        self.parameters = frozen(np.concatenate([body.toDynamicParameters() for body in bodies]))

    def coriolis(self, q: Array, v: Array) -> Array:
        """(n, n) by Christoffel symbols of the first kind; the torque is C v (Siciliano, Robotics (2009), 7.1.1)."""
        joint_map = self._joint_map
        C = pin.computeCoriolisMatrix(self._model, self._data, joint_map.positions(q), joint_map.speeds(v, q))
        C = np.asarray(C, dtype=np.float64).reshape(self._model.nv, -1)
        if joint_map.is_plain:
            return C.copy()
        ratio = joint_map.ratio_at(q)
        total = C @ ratio
        if joint_map.closure is not None:
            M = pin.crba(self._model, self._data, joint_map.positions(q), pin.Convention.WORLD)
            upper = np.triu(M)
            total += (upper + np.triu(M, 1).T + np.diag(self._armature)) @ joint_map.closure.ratio_derivative(q, v)
        return ratio.T @ total

    def potential_energy(self, q: Array) -> float:
        """J of gravity, minus what gravity compensation lifts, and of joint springs."""
        energy = pin.computePotentialEnergy(self._model, self._data, self._joint_map.positions(q))
        if self._support is not None:
            given = q if self._joint_map.closure is None else self._joint_map.positions(q)
            energy -= pin.computePotentialEnergy(self._support, self._support_data, given)
        return float(energy) + self._passive.spring_energy(q)

    def center_of_mass(self, q: Array) -> Array:
        """(3,) m."""
        return pin.centerOfMass(self._model, self._data, self._joint_map.positions(q)).copy()

    def center_of_mass_jacobian(self, q: Array) -> Array:
        """(3, n)."""
        return self._reduced(pin.jacobianCenterOfMass(self._model, self._data, self._joint_map.positions(q)), 3, q)

    def frame(self, body: str) -> int:
        """The number of a body's frame. UnknownNameError if there is none of that name."""
        if body not in self._bodies:
            raise UnknownNameError.from_known("body", body, list(self._bodies))
        return self._bodies[body]

    def tip_frame(self, number: int) -> int:
        """The number of a tip's frame."""
        return self._first_tip + number

    def pose(self, q: Array, frame: int) -> tuple[Array, Array]:
        """Position (3,) m and rotation (3, 3) of a frame in the world; valid until the next call."""
        pin.framesForwardKinematics(self._model, self._data, self._joint_map.positions(q))
        T = self._data.oMf[frame]
        return T.translation, T.rotation

    def jacobian(self, q: Array, frame: int) -> Array:
        """(6, n), linear first, world axes, at the frame."""
        positions = self._joint_map.positions(q)
        return self._reduced(pin.computeFrameJacobian(self._model, self._data, positions, frame, WORLD_AXES_AT_TIP), 6, q)

    def jacobian_derivative(self, q: Array, v: Array, frame: int) -> Array:
        """(6, n) the time derivative of `jacobian`."""
        joint_map = self._joint_map
        pin.computeJointJacobiansTimeVariation(self._model, self._data, joint_map.positions(q), joint_map.speeds(v, q))
        pin.updateFramePlacements(self._model, self._data)
        dJ = self._reduced(pin.getFrameJacobianTimeVariation(self._model, self._data, frame, WORLD_AXES_AT_TIP), 6, q)
        if joint_map.closure is not None:
            J = pin.getFrameJacobian(self._model, self._data, frame, WORLD_AXES_AT_TIP)
            dJ += np.asarray(J).reshape(6, -1) @ joint_map.closure.ratio_derivative(q, v)
        return dJ

    def regressor(self, q: Array, v: Array, a: Array) -> Array:
        """(n, 10 m) the torque of the links is this times `parameters`."""
        joint_map = self._joint_map
        positions = joint_map.positions(q)
        all_a = joint_map.accelerations(a, q, v)
        Y = pin.computeJointTorqueRegressor(self._model, self._data, positions, joint_map.speeds(v, q), all_a)
        Y = np.asarray(Y, dtype=np.float64).reshape(self._model.nv, -1)
        return Y.copy() if joint_map.is_plain else joint_map.ratio_at(q).T @ Y

    def _reduced(self, J: Array, rows: int, q: Array) -> Array:
        """A Jacobian of all joints as that of the arm's; Pinocchio drops the column of a single joint."""
        J = np.asarray(J, dtype=np.float64).reshape(rows, -1)
        return J.copy() if self._joint_map.is_plain else J @ self._joint_map.ratio_at(q)


def _without_mimic_joints(model: mujoco.MjModel, pinocchio_model: PinocchioModel) -> pin.Model:
    """The same links and joints, each joint with a position of its own."""
    source = pinocchio_model.pin_model
    free = pin.Model()
    free.gravity.linear = source.gravity.linear
    for k, joint in enumerate(pinocchio_model.joint_map.joints):
        slides = model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_SLIDE)
        kind = pin.JointModelPZ() if slides else pin.JointModelRZ()
        added = free.addJoint(source.parents[k + 1], kind, source.jointPlacements[k + 1], source.names[k + 1])
        free.appendBodyToJoint(added, source.inertias[k + 1], pin.SE3.Identity())
    return free


def _add_frames(free: pin.Model, model: mujoco.MjModel, pinocchio_model: PinocchioModel, home_qpos: Array) -> dict[str, int]:
    """Adds the tips, in their order, and all bodies of the model; the numbers of the bodies by their names."""
    source = pinocchio_model.pin_model
    for tip in source.frames[pinocchio_model.tip_frame :]:
        free.addFrame(pin.Frame(f"tip {tip.name}", tip.parentJoint, 0, tip.placement, pin.FrameType.OP_FRAME))
    joint_map = pinocchio_model.joint_map
    data = mujoco.MjData(model)
    data.qpos[:] = home_qpos
    mujoco.mj_kinematics(model, data)
    moved = free.createData()
    pin.forwardKinematics(free, moved, home_qpos[joint_map.qpos_adr])
    frames = {}
    for body, owner in enumerate(last_joint_above(model, joint_map.joints)):
        name = model.body(body).name
        if name:
            T_world_body = pin.SE3(data.xmat[body].reshape(3, 3).copy(), data.xpos[body].copy())
            placement = moved.oMi[owner + 1].actInv(T_world_body)
            frames[name] = free.addFrame(pin.Frame(f"body {name}", owner + 1, 0, placement, pin.FrameType.OP_FRAME))
    return frames
