"""Rows: the simulated arms of a batch of environments, and their compiled step on several threads."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from armctl.control import KernelController, State, controller_by_name
from armctl.core.errors import InputError
from armctl.core.log import SimulationError
from armctl.core.validation import Array, IntArray
from armctl.envs.actions import ActionMode
from armctl.envs.plants import plant_vector
from armctl.robot.arm import Arm
from armctl.sim.free_space import FreeSpace
from armctl.sim.mujoco_library import address_of, guarded_call
from armctl.sim.plant import Plant

_APPROACH_RATE = 40.0  # 1/s, at which a reference approaches its target, at most one fifth of the way in a tick
_MAX_SHARE_PER_TICK = 0.2
_DEFAULT_SPEED = 2.0  # rad/s (m/s), of a joint without a limit
_DEFAULT_ACCELERATION = 10.0
_DEFAULT_RANGE = 2.0 * np.pi  # rad (m) to both sides, of a joint without limits
_MARGIN = 1e-3  # of the range of a joint, between the stops and the targets
_IK_DAMPING = 1e-4  # of J J^T, whose entries are squares of m and rad


class Rows:
    """Several copies of an arm, each with its own plant, state and target.

    Attributes:
        arm: The arm as controllers know it.
        count: The number of copies.
        ticks: Control periods in a step.
        q: (count, n) rad, the positions.
        v: (count, n) rad/s, the velocities.
        target: (count, n) rad, where the actions want the joints.
        tip: (count, 12) position and rotation matrix of the tip.
        action: (count, k), the actions of the next step.
        limits: (5, n) least and greatest position, greatest speed, acceleration and torque.
    """

    def __init__(self, arm: Arm, mode: ActionMode, controller: str, count: int, ticks: int, threads: int, free_space: bool):
        """Copies of an arm at home.

        Args:
            arm: The arm.
            mode: What the actions mean.
            controller: The name of a controller with a kernel.
            count: The number of copies.
            ticks: Control periods in a step.
            threads: The number of threads.
            free_space: Whether nothing touches the arm, so that no contacts are simulated.

        Raises:
            InputError: The controller has no kernel, or the arm does not move freely.
        """
        from armctl.envs import step_kernel as kernel
        from armctl.sim.tick_kernel import entry_point

        law = controller_by_name(controller, arm)
        if not isinstance(law, KernelController):
            raise InputError(f"controller: {controller} is not compiled; computed-torque and pd-gravity are")
        n = arm.n
        self.arm = arm
        self.count = count
        self.ticks = ticks
        self.limits = _limits(arm)
        self.action = np.zeros((count, mode.size(arm)))
        self.q = np.tile(arm.home, (count, 1))
        self.v = np.zeros((count, n))
        self.target = self.q.copy()
        self.tip = np.zeros((count, 12))
        self._q_ref = self.q.copy()
        self._v_ref = np.zeros((count, n))
        self._packed = arm.packed_dynamics
        self._parameters, memory = law.begin(State(arm.home, np.zeros(n), 0.0, arm.dt))
        self._memory = np.zeros((count, len(memory)))
        self._nominal = self._packed.vector(arm.dt)
        self._bounds = np.array([-arm.limits.tau_max, arm.limits.tau_max])
        self._models: list[mujoco.MjModel] = []
        self._datas: list[mujoco.MjData] = []
        self._addresses = np.zeros((count, 5), np.int64)
        if free_space:
            model = Plant(free_space=True).model(arm)
            free = FreeSpace(arm, model, mujoco.MjData(model))
            self._free_vector = free.vector
            self._bounds = free.bounds
        else:
            self._free_vector = self._nominal
            self._simulate_contacts()
        self._plants = np.tile(self._free_vector, (count, 1))
        self._numbers = np.zeros(kernel.NUMBER_COUNT)
        self._numbers[: kernel.HOME_TIP] = [
            arm.dt,
            mode.joint_scale * ticks * arm.dt,
            mode.position_scale,
            mode.rotation_scale,
            min(_APPROACH_RATE, _MAX_SHARE_PER_TICK / arm.dt),
            _IK_DAMPING,
        ]
        position, rotation = arm.fk_many(arm.home[None])
        self._numbers[kernel.HOME_TIP :] = np.concatenate([position[0], rotation[0].ravel()])
        sizes = {
            kernel.TICKS: ticks,
            kernel.MODE: mode.number,
            kernel.PARAMETERS_SIZE: len(self._parameters),
            kernel.KERNEL: entry_point(law.kernel),
        }
        self._make_tables(sizes, threads)
        self._function = kernel.STEP_TABLE
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None

    def step(self) -> None:
        """Steps all copies by their actions.

        Raises:
            SimulationError: MuJoCo could not make a step.
        """
        if self._pool is None:
            errors = [guarded_call(self._function, self._table_addresses[0])]
        else:
            errors = list(self._pool.map(lambda address: guarded_call(self._function, address), self._table_addresses))
        if any(errors):
            raise SimulationError(f"mj_step: {next(filter(None, errors)):.300}")

    def reset(self, row: int, q: Array, plant: Plant | None) -> None:
        """Puts a copy at q, at rest.

        Args:
            row: Which copy.
            q: (n,) rad.
            plant: How it differs from the model from now on; None leaves it as it is.

        Raises:
            InputError: Plants in free space cannot have one of the differences.
        """
        self.q[row] = q
        self.v[row] = 0.0
        self.target[row] = q
        self._q_ref[row] = q
        self._v_ref[row] = 0.0
        self._memory[row] = 0.0
        if self._datas:
            self._reset_data(row, q, plant)
        elif plant is not None:
            self._plants[row] = plant_vector(self.arm, self._free_vector, plant)

    def find_tips(self, rows: Sequence[int] | IntArray) -> None:
        """Computes the tips of copies that were reset."""
        positions, rotations = self.arm.fk_many(self.q[rows])
        self.tip[rows, :3] = positions
        self.tip[rows, 3:] = rotations.reshape(-1, 9)

    def close(self) -> None:
        """Ends the threads."""
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None

    def _make_tables(self, sizes: dict[int, int], threads: int) -> None:
        """Makes a table for each thread."""
        from armctl.envs import step_kernel as kernel

        arm = self.arm
        self._indices = np.array([arm.qpos_adr, arm.dof_adr, arm.ctrl_adr], np.int64)
        self._gear = np.array(arm.gear, dtype=float)
        entries = sizes | {
            kernel.ROWS: self.count,
            kernel.N: arm.n,
            kernel.NQ: arm.model.nq,
            kernel.NV: arm.model.nv,
            kernel.NCTRL: len(arm.home_ctrl),
            kernel.ACTIONS: self.action.shape[1],
            kernel.MEMORY_SIZE: self._memory.shape[1],
            kernel.MODEL_SIZE: len(self._nominal),
            kernel.STEP_FUNCTION: address_of("mj_step"),
        }
        arrays: dict[int, NDArray[Any]] = {
            kernel.PARAMETERS: self._parameters,
            kernel.MEMORY: self._memory,
            kernel.NOMINAL: self._nominal,
            kernel.PLANTS: self._plants,
            kernel.DATAS: self._addresses,
            kernel.BOUNDS: self._bounds,
            kernel.LIMITS: self.limits,
            kernel.NUMBERS: self._numbers,
            kernel.INDICES: self._indices,
            kernel.GEAR: self._gear,
            kernel.ACTION: self.action,
            kernel.Q: self.q,
            kernel.V: self.v,
            kernel.TARGET: self.target,
            kernel.Q_REFERENCE: self._q_ref,
            kernel.V_REFERENCE: self._v_ref,
            kernel.TIP: self.tip,
        }
        entries |= {entry: array.ctypes.data for entry, array in arrays.items()}
        self._scratch = np.zeros((threads, kernel.scratch_size(arm.n, self._packed.work_size())))
        self._tables = np.zeros((threads, kernel.TABLE_SIZE), np.int64)
        for entry, number in entries.items():
            self._tables[:, entry] = number
        cuts = np.linspace(0, self.count, threads + 1).astype(int)
        self._tables[:, kernel.FIRST] = cuts[:-1]
        self._tables[:, kernel.LAST] = cuts[1:]
        self._tables[:, kernel.SCRATCH_SIZE] = self._scratch.shape[1]
        self._tables[:, kernel.SCRATCH] = [scratch.ctypes.data for scratch in self._scratch]
        self._table_addresses = [table.ctypes.data for table in self._tables]

    def _simulate_contacts(self) -> None:
        """Gives each copy a state of MuJoCo; copies share a model until one gets a plant of its own."""
        nominal = Plant().model(self.arm)
        for row in range(self.count):
            self._datas.append(mujoco.MjData(nominal))
            self._models.append(nominal)
            self._set_addresses(row)

    def _set_addresses(self, row: int) -> None:
        data = self._datas[row]
        arrays = (data.qpos, data.qvel, data.ctrl)
        self._addresses[row] = [self._models[row]._address, data._address, *(array.ctypes.data for array in arrays)]

    def _reset_data(self, row: int, q: Array, plant: Plant | None) -> None:
        if plant is not None:
            self._models[row] = plant.model(self.arm)
            self._set_addresses(row)
        data = self._datas[row]
        mujoco.mj_resetData(self._models[row], data)
        data.qpos[:] = self.arm.qpos(q)
        data.ctrl[:] = self.arm.home_ctrl


def _limits(arm: Arm) -> Array:
    """(5, n) least and greatest position, greatest speed, acceleration and torque, all finite."""
    limits = arm.limits
    low = np.where(np.isfinite(limits.q_min), limits.q_min, arm.home - _DEFAULT_RANGE)
    high = np.where(np.isfinite(limits.q_max), limits.q_max, arm.home + _DEFAULT_RANGE)
    margin = _MARGIN * (high - low)
    speed = np.where(np.isfinite(limits.v_max), limits.v_max, _DEFAULT_SPEED)
    acceleration = np.where(np.isfinite(limits.a_max), limits.a_max, _DEFAULT_ACCELERATION)
    return np.array([low + margin, high - margin, speed, acceleration, limits.tau_max])
