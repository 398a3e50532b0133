"""ArmCopies: the models and states of MuJoCo for several copies of an arm, and what changes in them for each episode."""

import copy
from collections.abc import Sequence

import mujoco
import numpy as np

from armctl.core.validation import Array, IntArray
from armctl.envs.randomization import ObjectFactors
from armctl.envs.tasks.task import Episode, Task
from armctl.model.gripper.gripper_model import make_usable
from armctl.model.mjmodel.brake import brake
from armctl.run.sim.plant import NOMINAL, Plant, apply_plant, held_dofs

_UPRIGHT = (1.0, 0.0, 0.0, 0.0)  # quaternion


class ArmCopies:
    """Several copies of an arm on `mj_step`. Those of a thread share a model until one gets a plant or an object of its own."""

    def __init__(self, task: Task, counts: Sequence[int] | IntArray, *, has_contacts: bool):
        """Copies at home, so many (`counts`) for each thread."""
        arm = task.arm
        self._arm = arm
        self._has_contacts = has_contacts
        self._grip = task.grip
        self._uses_gripper = task.uses_gripper
        held = held_dofs(arm)
        self._held = np.setdiff1d(held, task.grip.model.dofs) if task.grip is not None and task.uses_gripper else held
        self._object = arm.model.body(task.object).id if task.object else -1
        self._mocap = int(arm.model.body(task.obstacle).mocapid[0]) if task.obstacle else -1
        self._nominal = copy.copy(arm.model)
        self._set_plant(self._nominal, NOMINAL)
        if self._grip is not None and self._uses_gripper:
            make_usable(self._nominal, self._grip.model)
        self._models: list[mujoco.MjModel] = []
        for thread, count in enumerate(counts):
            self._models += [self._nominal if thread == 0 else copy.copy(self._nominal)] * int(count)
        self._has_own_model = np.zeros(len(self._models), bool)
        self._datas = [mujoco.MjData(model) for model in self._models]

    def data(self, row: int) -> mujoco.MjData:
        return self._datas[row]

    def model(self, row: int) -> mujoco.MjModel:
        return self._models[row]

    def reset(self, row: int, episode: Episode, plant: Plant | None, factors: ObjectFactors | None) -> None:
        """Starts an episode of a copy, at rest; a plant or factors of the object that are None stay as they are."""
        if plant is not None or factors is not None:
            self._change_model(row, plant or NOMINAL, factors or ObjectFactors())
        model = self._models[row]
        data = self._datas[row]
        mujoco.mj_resetData(model, data)
        data.qpos[:] = self._arm.qpos(episode.q)
        data.ctrl[:] = self._arm.home_ctrl
        if self._grip is not None:
            state = self._grip.opened if self._uses_gripper else self._grip.closed
            data.qpos[self._grip.qpos_adr] = state.qpos[self._grip.qpos_adr]
            data.ctrl[self._grip.indices[0]] = self._grip.ends[1 if self._uses_gripper else 0]
        if episode.object is not None and self.object_addresses is not None:
            geom = model.body_geomadr[self._object]
            raised = model.geom_size[geom, 1] - self._nominal.geom_size[geom, 1]  # a larger one stands on the same table
            address = self.object_addresses[0]
            data.qpos[address : address + 3] = episode.object + np.array([0.0, 0.0, raised])
            data.qpos[address + 3 : address + 7] = _UPRIGHT
        if episode.obstacle is not None:
            data.mocap_pos[self._mocap] = episode.obstacle
        mujoco.mj_forward(model, data)

    def object_state(self, row: int) -> Array:
        """(13,) position, quaternion, velocity and angular velocity of the loose object of a copy; zeros without one."""
        if self.object_addresses is None:
            return np.zeros(13)
        qpos, qvel = self.object_addresses
        data = self._datas[row]
        return np.concatenate([data.qpos[qpos : qpos + 7], data.qvel[qvel : qvel + 6]])

    @property
    def object_addresses(self) -> tuple[int, int] | None:
        """Where the loose object begins in qpos and in qvel; None without one."""
        if self._object < 0:
            return None
        joint = self._arm.model.body_jntadr[self._object]
        return int(self._arm.model.jnt_qposadr[joint]), int(self._arm.model.jnt_dofadr[joint])

    @property
    def obstacle_geom(self) -> int | None:
        """The geom of the obstacle; None without one."""
        if self._mocap < 0:
            return None
        body = np.flatnonzero(self._arm.model.body_mocapid == self._mocap)
        return int(self._arm.model.body_geomadr[body[0]])

    def _change_model(self, row: int, plant: Plant, factors: ObjectFactors) -> None:
        """Gives a copy its own model, changed by a plant and by the factors of the object."""
        if not self._has_own_model[row]:
            self._has_own_model[row] = True
            self._models[row] = copy.copy(self._nominal)
            self._datas[row] = mujoco.MjData(self._models[row])
        self._set_plant(self._models[row], plant)
        if self._object >= 0:
            self._set_object(self._models[row], factors)
            mujoco.mj_setConst(self._models[row], self._datas[row])

    def _set_plant(self, model: mujoco.MjModel, plant: Plant) -> None:
        apply_plant(model, mujoco.MjData(model), plant, self._arm)
        if not self._has_contacts:
            model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        brake(model, self._held)
        if self._grip is not None and self._uses_gripper:
            model.jnt_limited[self._grip.model.followers] = 0

    def _set_object(self, model: mujoco.MjModel, factors: ObjectFactors) -> None:
        """Sets size, mass and friction of the loose object, which has one geom."""
        nominal = self._nominal
        body = self._object
        geom = model.body_geomadr[body]
        box = model.body_bvhadr[body]
        model.geom_size[geom] = factors.object_size * nominal.geom_size[geom]
        model.geom_rbound[geom] = factors.object_size * nominal.geom_rbound[geom]
        model.geom_aabb[geom] = factors.object_size * nominal.geom_aabb[geom]
        model.bvh_aabb[box] = factors.object_size * nominal.bvh_aabb[box]
        mass = float(nominal.body_mass[body]) if factors.object_mass is None else factors.object_mass
        model.body_mass[body] = mass
        model.body_inertia[body] = nominal.body_inertia[body] * (mass / nominal.body_mass[body]) * factors.object_size**2
        if factors.object_friction is not None:
            model.geom_friction[geom, 0] = factors.object_friction
