"""FreeSpace: a plant that moves by armctl's compiled dynamics instead of `mj_step`, for an arm that touches nothing.

MuJoCo spends most of a step on collision detection, though nothing touches. The steps here are those of MuJoCo's Euler and
implicitfast integrators without constraints. They are compared with MuJoCo's before the first run, and every recorded run is
checked for contacts and joint limits.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from armctl.core.errors import InputError
from armctl.core.validation import Array, BoolArray
from armctl.mjmodel.queries import body_name, joint_name
from armctl.robot import dynamics_kernel
from armctl.robot.actuation import Actuation
from armctl.robot.arm import Arm
from armctl.robot.forward_dynamics_kernel import free_step
from armctl.robot.packed_dynamics import PackedDynamics
from armctl.robot.pinocchio_model import build_pinocchio_model
from armctl.sim.box_proofs import BoxProofs
from armctl.sim.free_space_kernel import inspect
from armctl.sim.recorder import TickRows

if TYPE_CHECKING:
    from armctl.sim.box_proof import BoxProof

_TOLERANCE = 1e-12  # of the velocity after a step, relative to the largest change of velocity in it (at least 1)
_CHECKED_STEPS = 4
_CHECK_DISTANCE = 0.01  # rad (m): contacts are looked for at least this often along the way of every joint
_CONSTRAINTS_OFF = int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(mujoco.mjtDisableBit.mjDSBL_LIMIT)


class FreeSpace:
    """The motion of one arm that touches nothing.

    Attributes:
        vector: The dynamics of the plant for `dynamics_kernel`.
        bounds: (2, n) N m, the least and the largest torque of the motors.
        work: Scratch memory.
    """

    def __init__(self, arm: Arm, model: mujoco.MjModel, data: mujoco.MjData):
        """The motion of an arm.

        Args:
            arm: The arm.
            model: The plant's model.
            data: Any state of it; it is lost.

        Raises:
            InputError: The arm does not move freely, with the reason.
        """
        pinocchio_model = build_pinocchio_model(
            model, arm.pinocchio_model.chain_length, arm.joint_map, arm.home_qpos, arm.tip_body, arm.T_body_tip
        )
        packed = PackedDynamics(model, pinocchio_model)
        self.vector = packed.vector(model.opt.timestep)
        _check_vector(arm, model, self.vector)
        self.bounds = _torque_bounds(arm.actuation, model)
        self.work = np.zeros(packed.work_size() + arm.n)
        self._actuation = arm.actuation
        self._joints = np.array(arm.actuation.qpos_adr, np.int64)
        joints = list(arm.actuation.joint_map.joints)
        is_limited = model.jnt_limited[joints].astype(bool)[:, None]
        self._limits = np.where(is_limited, model.jnt_range[joints], [-np.inf, np.inf]).T.copy()
        self._model = model
        self._data = data
        self._compare(arm)

    def step(self, model: mujoco.MjModel, data: mujoco.MjData, steps: int) -> None:
        """What `mj_step(model, data, steps)` does."""
        actuation = self._actuation
        q = data.qpos[actuation.qpos_adr]
        v = data.qvel[actuation.dof_adr]
        applied = data.qfrc_applied[actuation.dof_adr]
        tau = data.ctrl[actuation.ctrl_adr] * actuation.gear
        for _ in range(steps):
            free_step(self.vector, self.bounds, tau, applied, self.work, q, v)
            data.time += model.opt.timestep
        data.qpos[actuation.qpos_adr] = q
        data.qvel[actuation.dof_adr] = v
        data.qfrc_actuator[actuation.torque_adr] = tau

    def check(self, rows: TickRows, first: int, proofs: BoxProofs) -> str:
        """Why rows from `first` on are not free motion, in words; empty if they are. Contacts are noted in the rows.

        Contacts are those of MuJoCo, at every tick at which a joint has moved by 0.01 rad (m) since the last check, except
        where it is proved that nothing touches.
        """
        data = self._data
        model = self._model
        now = data.qpos.copy()
        motion = rows.qpos[first : rows.count]
        is_spaced = np.zeros(len(motion) + 1, bool)
        is_beyond = np.zeros(self._actuation.n, bool)
        inspect(motion, now, self._joints, self._limits, _CHECK_DISTANCE, is_spaced, is_beyond)
        spaced = np.flatnonzero(is_spaced)
        q = np.concatenate([motion[spaced[:-1]], now[None]])
        reason = ""
        for k in np.flatnonzero(~_proved_free(proofs.of(model, len(motion) + 1), q)):
            data.qpos[:] = q[k]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_collision(model, data)
            if data.ncon:
                row = int(spaced[k])
                rows.contacts.append((min(first + row, rows.count - 1), data.contact.geom.tobytes()))
                names = " touches ".join(body_name(model, int(model.geom_bodyid[geom])) for geom in data.contact.geom[0])
                reason = f"{names} at {data.time - (len(motion) - row) * model.opt.timestep:.3f} s"
                break
        data.qpos[:] = now
        mujoco.mj_forward(model, data)
        if not reason and is_beyond.any():
            joint = self._actuation.joint_map.joints[int(is_beyond.argmax())]
            reason = f"{joint_name(model, joint)} reaches its limit"
        return reason

    def _compare(self, arm: Arm) -> None:
        """Compares some steps with MuJoCo's."""
        model = self._model
        data = self._data
        rng = np.random.default_rng(0)
        flags = int(model.opt.disableflags)
        model.opt.disableflags |= _CONSTRAINTS_OFF
        try:
            for q in arm.limits.random(arm.limits.clamp(arm.home), _CHECKED_STEPS, rng):
                mujoco.mj_resetData(model, data)
                data.qpos[:] = arm.qpos(q)
                data.qvel[:] = arm.qvel(rng.uniform(-1.0, 1.0, arm.n))
                data.ctrl[:] = arm.home_ctrl
                data.ctrl[arm.ctrl_adr] = rng.uniform(-1.5, 1.5, arm.n) * arm.limits.tau_max / arm.gear
                qpos = data.qpos.copy()
                before = data.qvel.copy()
                self.step(model, data, 1)
                velocity = data.qvel[arm.dof_adr]
                data.qpos[:] = qpos
                data.qvel[:] = before
                mujoco.mj_step(model, data)
                expected = data.qvel[arm.dof_adr]
                error = float(np.abs(velocity - expected).max() / max(1.0, np.abs(expected - before[arm.dof_adr]).max()))
                if not error <= _TOLERANCE:
                    raise InputError(
                        f"free_space: a step of {arm.name:.80} differs by {error:.2g} from MuJoCo's, so something besides its "
                        "links and motors acts on it, such as a tendon, an equality or a fluid; simulate it without free_space"
                    )
        finally:
            model.opt.disableflags = flags


def _proved_free(proof: BoxProof | None, qpos: Array) -> BoolArray:
    """(T,) whether it is proved that nothing touches at positions (T, nq) of the model."""
    return np.zeros(len(qpos), bool) if proof is None else proof.free_rows(qpos)


def _check_vector(arm: Arm, model: mujoco.MjModel, vector: Array) -> None:
    reason = ""
    if model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4):
        reason = "continuous plants need MuJoCo's Runge-Kutta steps"
    elif not arm.joint_map.is_plain:
        reason = "one of its joints follows another"
    elif vector[dynamics_kernel.HAS_FRICTION]:
        reason = "its joints have dry friction, which MuJoCo's solver computes"
    elif vector[dynamics_kernel.HAS_SPRINGS]:
        reason = "its joints have springs"
    elif vector[dynamics_kernel.IMPLICIT_NONLINEAR]:
        reason = "its integrator or its damping is not linear in the velocity"
    elif (model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)).any():
        reason = "objects of its scene can move"
    if reason:
        raise InputError(f"free_space: {arm.name:.80} cannot be simulated this way: {reason}; simulate it without free_space")


def _torque_bounds(actuation: Actuation, model: mujoco.MjModel) -> Array:
    """(2, n) N m, the least and the largest joint torque of the motors, by the ranges of control, force and joint."""
    bounds = np.empty((2, actuation.n))
    for i in range(actuation.n):
        actuator = int(np.flatnonzero(model.actuator_ctrladr == actuation.ctrl_adr[i])[0])
        joint = actuation.joint_map.joints[i]
        ranges = [
            actuation.gear[i] * model.actuator_ctrlrange[actuator] if model.actuator_ctrllimited[actuator] else None,
            actuation.gear[i] * model.actuator_forcerange[actuator] if model.actuator_forcelimited[actuator] else None,
            model.jnt_actfrcrange[joint] if model.jnt_actfrclimited[joint] else None,
        ]
        limited = [np.sort(each) for each in ranges if each is not None]
        bounds[0, i] = max((each[0] for each in limited), default=-np.inf)
        bounds[1, i] = min((each[1] for each in limited), default=np.inf)
    return bounds
