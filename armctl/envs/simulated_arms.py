"""SimulatedArms: the models and states of MuJoCo for several copies of an arm, and what changes in them for each episode."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from armctl.collision.free_boxes import free_boxes
from armctl.core.validation import Array, IntArray
from armctl.envs.randomization import ObjectFactors
from armctl.envs.tasks.interface import Episode, Task
from armctl.sim.box_proofs import BoxProofs
from armctl.sim.gripper_model import make_usable
from armctl.sim.plant import NOMINAL, Plant, apply_plant, brake, held_dofs

if TYPE_CHECKING:
    from armctl.sim.contact_skip import ContactSkip

_MIN_SKIP_STEPS = 10_000  # to prepare proofs takes as long as collision detection in so many steps
_UPRIGHT = (1.0, 0.0, 0.0, 0.0)  # quaternion


class SimulatedArms:
    """Several copies of an arm on `mj_step`. Those of a thread share a model until one gets a plant or an object of its own.

    Where it is proved that the arm touches nothing, a step has no collision detection, if there is neither an object nor an
    obstacle. The results are the same bits.

    Attributes:
        addresses: (count, 7) of each copy's MjModel, MjData, qpos, qvel, ctrl, actuator_length and table of `ContactSkip`.
    """

    def __init__(self, task: Task, counts: Sequence[int] | IntArray):
        """Copies at home.

        Args:
            task: The task, whose arm it is.
            counts: The number of copies of each thread.
        """
        arm = task.arm
        self._arm = arm
        self._grip = task.grip
        self._uses_gripper = task.uses_gripper
        held = held_dofs(arm)
        self._held = np.setdiff1d(held, task.grip.model.dofs) if task.grip is not None and task.uses_gripper else held
        self._thing = arm.model.body(task.object).id if task.object else -1
        self._mocap = int(arm.model.body(task.obstacle).mocapid[0]) if task.obstacle else -1
        self._nominal = copy.copy(arm.model)
        self._set_plant(self._nominal, NOMINAL)
        if self._grip is not None and self._uses_gripper:
            make_usable(self._nominal, self._grip.model)
        self._flags = int(self._nominal.opt.disableflags)
        self._models: list[mujoco.MjModel] = []
        self._proofs: list[BoxProofs] = []
        for thread, count in enumerate(counts):
            self._models += [self._nominal if thread == 0 else copy.copy(self._nominal)] * int(count)
            self._proofs += [BoxProofs(free_boxes(arm))] * int(count)
        self._has_own_model = np.zeros(len(self._models), bool)
        self._datas = [mujoco.MjData(model) for model in self._models]
        self._steps = 0
        self._skips: list[ContactSkip] = []
        self.addresses = np.zeros((len(self._models), 7), np.int64)
        for row in range(len(self._models)):
            self._set_addresses(row)

    def data(self, row: int) -> mujoco.MjData:
        """The state of a copy."""
        return self._datas[row]

    def model(self, row: int) -> mujoco.MjModel:
        """The model of a copy."""
        return self._models[row]

    def count_steps(self, steps: int) -> None:
        """Notes that all copies have made some steps; after many, it pays to prove that nothing touches."""
        if self._skips or self._thing >= 0 or self._mocap >= 0:
            return
        self._steps += steps * len(self._models)
        if self._steps >= _MIN_SKIP_STEPS:
            self._skips = [self._start_skip(row) for row in range(len(self._models))]

    def reset(self, row: int, episode: Episode, plant: Plant | None, factors: ObjectFactors | None) -> None:
        """Starts an episode of a copy, at rest.

        Args:
            row: Which copy.
            episode: Where everything is.
            plant: How it differs from the model from now on; None leaves it as it is.
            factors: How the loose object differs; None leaves it as it is.
        """
        if plant is not None or factors is not None:
            self._change_model(row, plant or NOMINAL, factors or ObjectFactors())
        model = self._models[row]
        data = self._datas[row]
        model.opt.disableflags = self._flags
        mujoco.mj_resetData(model, data)
        data.qpos[:] = self._arm.qpos(episode.q)
        data.ctrl[:] = self._arm.home_ctrl
        if self._grip is not None:
            state = self._grip.opened if self._uses_gripper else self._grip.closed
            data.qpos[self._grip.qpos_adr] = state.qpos[self._grip.qpos_adr]
            data.ctrl[self._grip.indices[0]] = self._grip.ends[1 if self._uses_gripper else 0]
        if episode.object is not None:
            geom = model.body_geomadr[self._thing]
            raised = model.geom_size[geom, 1] - self._nominal.geom_size[geom, 1]  # a larger one stands on the same table
            address = self.object_addresses[0]
            data.qpos[address : address + 3] = episode.object + np.array([0.0, 0.0, raised])
            data.qpos[address + 3 : address + 7] = _UPRIGHT
        if episode.obstacle is not None:
            data.mocap_pos[self._mocap] = episode.obstacle
        mujoco.mj_forward(model, data)

    def object_state(self, row: int) -> Array:
        """(13,) position, quaternion, velocity and angular velocity of the loose object of a copy; zeros without one."""
        if self._thing < 0:
            return np.zeros(13)
        qpos, qvel = self.object_addresses
        data = self._datas[row]
        return np.concatenate([data.qpos[qpos : qpos + 7], data.qvel[qvel : qvel + 6]])

    @property
    def skipped(self) -> int:
        """Steps without collision detection, of all copies."""
        return sum(skip.skipped for skip in self._skips)

    @property
    def object_addresses(self) -> tuple[int, int]:
        """Where the loose object begins in qpos and in qvel; -1 without one."""
        if self._thing < 0:
            return -1, -1
        joint = self._arm.model.body_jntadr[self._thing]
        return int(self._arm.model.jnt_qposadr[joint]), int(self._arm.model.jnt_dofadr[joint])

    @property
    def obstacle_geom(self) -> int:
        """The geom of the obstacle; -1 without one."""
        body = np.flatnonzero(self._arm.model.body_mocapid == self._mocap)
        return int(self._arm.model.body_geomadr[body[0]]) if self._mocap >= 0 else -1

    def _change_model(self, row: int, plant: Plant, factors: ObjectFactors) -> None:
        """Gives a copy its own model, changed by a plant and by the factors of the object."""
        if not self._has_own_model[row]:
            self._has_own_model[row] = True
            self._models[row] = copy.copy(self._nominal)
            self._models[row].opt.disableflags = self._flags
            self._datas[row] = mujoco.MjData(self._models[row])
            self._set_addresses(row)
        self._set_plant(self._models[row], plant)
        if self._thing >= 0:
            self._set_object(self._models[row], factors)
            mujoco.mj_setConst(self._models[row], self._datas[row])

    def _set_plant(self, model: mujoco.MjModel, plant: Plant) -> None:
        apply_plant(model, mujoco.MjData(model), plant, [self._arm])
        brake(model, self._held)
        if self._grip is not None and self._uses_gripper:
            model.jnt_limited[self._grip.model.followers] = 0

    def _set_object(self, model: mujoco.MjModel, factors: ObjectFactors) -> None:
        """Sets size, mass and friction of the loose object, which has one geom."""
        nominal = self._nominal
        body = self._thing
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

    def _set_addresses(self, row: int) -> None:
        model = self._models[row]
        data = self._datas[row]
        arrays = (data.qpos, data.qvel, data.ctrl, data.actuator_length)
        self.addresses[row, :6] = [model._address, data._address, *(array.ctypes.data for array in arrays)]
        if self._skips:
            self._skips[row] = self._start_skip(row)

    def _start_skip(self, row: int) -> ContactSkip:
        """Steps without collision detection of a copy, from now on."""
        from armctl.sim.contact_skip import ContactSkip  # loads numba

        skip = ContactSkip(self._proofs[row], self._models[row], self._datas[row])
        self.addresses[row, 6] = skip.start(self._steps)
        return skip
