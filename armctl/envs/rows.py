"""Rows: the simulated arms of a batch of environments, and their compiled step on several threads."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armctl.control import State, controller_by_name
from armctl.control.interface import has_compiled_law
from armctl.core.log import SimulationError
from armctl.core.validation import Array, IntArray
from armctl.envs.actions import ActionMode
from armctl.envs.limits import joint_limits
from armctl.envs.plants import FreePlants
from armctl.envs.randomization import ObjectFactors, Randomization
from armctl.envs.signals import Signals
from armctl.envs.simulated_arms import SimulatedArms
from armctl.envs.tasks.interface import Episode, Task
from armctl.robot.dynamics_kernel import HAS_LIFT
from armctl.sim.mujoco_library import address_of, contact_layout, guarded_call
from armctl.sim.plant import NOMINAL, Plant

_APPROACH_RATE = 40.0  # 1/s, at which a reference approaches its target, at most one fifth of the way in a tick
_MAX_SHARE_PER_TICK = 0.2
_IK_DAMPING = 1e-4  # of J J^T, whose entries are squares of m and rad


class Rows:
    """Several copies of an arm, each with its own plant, state and target.

    Attributes:
        arm: The model of the controllers.
        count: The number of copies.
        ticks: Control periods in a step.
        mode: What the actions mean.
        signals: What disturbs measurements and commands.
        q: (count, n) rad, the positions.
        v: (count, n) rad/s, the velocities.
        target: (count, n) rad, the joint targets of the actions.
        tip: (count, 12) position and rotation matrix of the tip.
        action: (count, k), the actions of the next step.
        limits: (5, n) least and greatest position, greatest speed, acceleration and torque.
        opening: (count,) of the gripper, from closed (0) to open (1).
        object: (count, 13) position, quaternion, velocity and angular velocity of the loose object.
        touched: (count,) ticks of the last step at which something touched the obstacle.
        simulated: The copies on `mj_step`; None in free space.
    """

    def __init__(
        self,
        task: Task,
        mode: ActionMode,
        controller: str,
        count: int,
        *,
        ticks: int,
        threads: int,
        free_space: bool,
        randomization: Randomization,
    ):
        """Copies of an arm at home.

        Args:
            task: The task, whose arm it is.
            mode: What the actions mean.
            controller: The name of a controller.
            count: The number of copies.
            ticks: Control periods in a step.
            threads: The number of threads.
            free_space: Whether nothing touches the arm, so that no contacts are simulated.
            randomization: What will vary.

        Raises:
            InputError: The arm does not move freely.
            UnknownNameError: There is no such controller.
        """
        from armctl.envs import difference_kernel
        from armctl.envs import step_kernel as kernel

        arm = task.arm
        n = arm.n
        self.arm = arm
        self.count = count
        self.ticks = ticks
        self.mode = mode
        self.signals = Signals(count, ticks, n, arm.dt, is_noisy=randomization.is_noisy, max_delay=randomization.max_delay)
        self.limits = np.array(joint_limits(arm))
        self.action = np.zeros((count, mode.size(arm) + int(task.uses_gripper)))
        self.q = np.tile(arm.home, (count, 1))
        self.v = np.zeros((count, n))
        self.target = self.q.copy()
        self.tip = np.zeros((count, 12))
        self.opening = np.ones(count)
        self.object = np.zeros((count, 13))
        self.touched = np.zeros(count, np.int64)
        self.simulated: SimulatedArms | None = None
        self._q_ref = self.q.copy()
        self._v_ref = np.zeros((count, n))
        self._grip_target = np.ones(count)
        self._grip = task.grip if task.uses_gripper else None
        law = controller_by_name(controller, arm)
        assert has_compiled_law(law, n)  # as all controllers that have a name
        self._law = law
        self._parameters, memory = law.begin(State(arm.home, np.zeros(n), 0.0, arm.dt))
        self._memory = np.zeros((count, len(memory)))
        self._nominal = arm.packed_dynamics.vector(arm.dt)
        self._bounds = np.array([-arm.limits.tau_max, arm.limits.tau_max])
        self._free_plants: FreePlants | None = None
        if free_space:
            self._free_plants = FreePlants(arm)
            self._bounds = self._free_plants.bounds
            self._plants = np.tile(self._free_plants.nominal, (count, 1))
        else:
            self.simulated = SimulatedArms(task, np.diff(self._cuts(threads)))
            self._plants = np.zeros((0, len(self._nominal)))
        self._differences = np.zeros((count if free_space else 0, arm.n, difference_kernel.COLUMNS))
        self._knows_geometry = self._computes_with_nominal()
        self._shared = np.full(count, kernel.EVERYTHING if self._knows_geometry else kernel.NOTHING, np.int64)
        self._make_tables(threads)
        self._function = kernel.STEP_TABLE
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None

    def step(self) -> None:
        """Steps all copies by their actions.

        Raises:
            SimulationError: MuJoCo could not make a step.
        """
        self.signals.draw()
        if self._pool is None:
            errors = [guarded_call(self._function, self._table_addresses[0])]
        else:
            errors = list(self._pool.map(lambda address: guarded_call(self._function, address), self._table_addresses))
        if self.simulated is not None:
            self.simulated.count_steps(self.ticks)
        if any(errors):
            raise SimulationError(f"mj_step: {next(filter(None, errors)):.300}")

    def reset(
        self, row: int, episode: Episode, plant: Plant | None, factors: ObjectFactors | None, rng: np.random.Generator
    ) -> None:
        """Starts an episode of a copy, at rest.

        Args:
            row: Which copy.
            episode: Where everything is.
            plant: How it differs from the model from now on; None leaves it as it is.
            factors: How the loose object differs; None leaves it as it is.
            rng: What the noise is drawn from.

        Raises:
            InputError: Plants in free space cannot have one of the differences.
        """
        self.q[row] = episode.q
        self.v[row] = 0.0
        self.target[row] = episode.q
        self._q_ref[row] = episode.q
        self._v_ref[row] = 0.0
        self._memory[row] = 0.0
        self._grip_target[row] = 1.0
        self.opening[row] = 1.0
        self.touched[row] = 0
        self.signals.reset(row, plant or NOMINAL, rng)
        if self.simulated is not None:
            self.simulated.reset(row, episode, plant, factors)
            self.object[row] = self.simulated.object_state(row)
        elif plant is not None and self._free_plants is not None:
            self._plants[row], self._differences[row] = self._free_plants.of(plant)
            self._shared[row] = self._shared_with(row)

    def rehearse(self, action: Array, target: Array, q_ref: Array, v_ref: Array) -> None:
        """Moves the targets and the references of the joints as a step does; the arms stay where they are.

        Args:
            action: (k,) of the arm.
            target: (n,) rad, changed.
            q_ref: (n,) rad, the positions of the reference; changed.
            v_ref: (n,) rad/s, its velocities; changed.
        """
        from armctl.envs import step_kernel as kernel

        numbers = self._kept[kernel.NUMBERS]
        scratch = self._scratch[0]
        mode = self.mode.number
        kernel.rehearse(mode, self.ticks, self._nominal, numbers, self.limits, action, target, q_ref, v_ref, scratch)

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

    def _computes_with_nominal(self) -> bool:
        """Whether the controller computes with the nominal dynamics of plants in free space, at their true positions."""
        from armctl.control.computed_torque_kernel import computed_torque
        from armctl.envs import step_kernel as kernel

        if self._free_plants is None or len(self.signals.noise):
            return False
        known = self._nominal
        if self.mode.number != kernel.TORQUE:
            if self._law.kernel is not computed_torque:
                return False
            known = self._parameters[-len(known) :]  # the law's parameters end with its model
        return np.array_equal(known, self._free_plants.nominal)

    def _shared_with(self, row: int) -> int:
        """What the dynamics that the controller computes share with those of a copy in free space."""
        from armctl.envs import step_kernel as kernel

        if not self._knows_geometry:
            return kernel.NOTHING
        if not self._differences[row].any():
            return kernel.EVERYTHING
        return kernel.NOTHING if self._nominal[HAS_LIFT] != 0.0 else kernel.GEOMETRY

    def _make_tables(self, threads: int) -> None:
        """Makes a table for each thread."""
        from armctl.envs import step_kernel as kernel

        arrays = self._arrays()
        entries = self._sizes() | {entry: array.ctypes.data if array.size else 0 for entry, array in arrays.items()}
        self._kept = arrays
        work_size = kernel.scratch_size(self.arm.n, self.arm.packed_dynamics.work_size())
        self._scratch = np.zeros((threads, work_size))
        self._tables = np.zeros((threads, kernel.TABLE_SIZE), np.int64)
        for entry, number in entries.items():
            self._tables[:, entry] = number
        cuts = self._cuts(threads)
        self._tables[:, kernel.FIRST] = cuts[:-1]
        self._tables[:, kernel.LAST] = cuts[1:]
        self._tables[:, kernel.SCRATCH_SIZE] = self._scratch.shape[1]
        self._tables[:, kernel.SCRATCH] = [scratch.ctypes.data for scratch in self._scratch]
        self._table_addresses = [table.ctypes.data for table in self._tables]

    def _cuts(self, threads: int) -> IntArray:
        """(threads + 1,) where the rows of each thread begin and end."""
        return np.linspace(0, self.count, threads + 1).astype(int)

    def _sizes(self) -> dict[int, int]:
        """The numbers of a table that are no addresses of arrays."""
        from armctl.control.kernel_call import entry_point
        from armctl.envs import step_kernel as kernel

        arm = self.arm
        layout = contact_layout()
        simulated = self.simulated
        qpos, qvel = (-1, -1) if simulated is None else simulated.object_addresses
        return {
            kernel.ROWS: self.count,
            kernel.N: arm.n,
            kernel.NQ: arm.model.nq,
            kernel.NV: arm.model.nv,
            kernel.NCTRL: len(arm.home_ctrl),
            kernel.NU: arm.model.nu,
            kernel.TICKS: self.ticks,
            kernel.MODE: self.mode.number,
            kernel.ACTIONS: self.mode.size(arm),
            kernel.ACTION_WIDTH: self.action.shape[1],
            kernel.PARAMETERS_SIZE: len(self._parameters),
            kernel.MEMORY_SIZE: self._memory.shape[1],
            kernel.MODEL_SIZE: len(self._nominal),
            kernel.GRIPPERS: 0 if self._grip is None else self._grip.indices.shape[1],
            kernel.COMMAND_DEPTH: self.signals.commands.shape[1],
            kernel.OBJECT_QPOS: qpos,
            kernel.OBJECT_QVEL: qvel,
            kernel.OBSTACLE: -1 if simulated is None else simulated.obstacle_geom,
            kernel.CONTACT_COUNT: layout.size,
            kernel.CONTACT_ARRAY: layout.array,
            kernel.CONTACT_STRIDE: layout.stride,
            kernel.CONTACT_GEOMS: layout.geoms,
            kernel.STEP_FUNCTION: address_of("mj_step"),
            kernel.KERNEL: entry_point(self._law.kernel),
        }

    def _arrays(self) -> dict[int, NDArray[Any]]:
        """The arrays of a table."""
        from armctl.envs import step_kernel as kernel

        arm = self.arm
        mode = self.mode
        numbers = np.zeros(kernel.NUMBER_COUNT)
        numbers[kernel.PERIOD] = arm.dt
        numbers[kernel.JOINT_SCALE] = mode.joint_scale * self.ticks * arm.dt
        numbers[kernel.POSITION_SCALE] = mode.position_scale
        numbers[kernel.ROTATION_SCALE] = mode.rotation_scale
        numbers[kernel.APPROACH_RATE] = min(_APPROACH_RATE, _MAX_SHARE_PER_TICK / arm.dt)
        numbers[kernel.DAMPING] = _IK_DAMPING
        numbers[kernel.GRIP_STEP] = 0.0 if self._grip is None else self._grip.speed * arm.dt
        home = arm.fk(arm.home)
        numbers[kernel.HOME_TIP :] = np.concatenate([home.position, home.rotation.ravel()])
        in_free_space = np.zeros((self.count, 7), np.int64)
        return {
            kernel.PARAMETERS: self._parameters,
            kernel.MEMORY: self._memory,
            kernel.NOMINAL: self._nominal,
            kernel.PLANTS: self._plants,
            kernel.DATAS: in_free_space if self.simulated is None else self.simulated.addresses,
            kernel.BOUNDS: self._bounds,
            kernel.LIMITS: self.limits,
            kernel.NUMBERS: numbers,
            kernel.INDICES: np.array([arm.qpos_adr, arm.dof_adr, arm.ctrl_adr], np.int64),
            kernel.GEAR: np.array(arm.gear, dtype=float),
            kernel.ACTION: self.action,
            kernel.Q: self.q,
            kernel.V: self.v,
            kernel.TARGET: self.target,
            kernel.Q_REFERENCE: self._q_ref,
            kernel.V_REFERENCE: self._v_ref,
            kernel.TIP: self.tip,
            kernel.GRIPPER_INDICES: np.zeros((2, 0), np.int64) if self._grip is None else self._grip.indices,
            kernel.GRIPPER_ENDS: np.zeros((4, 0)) if self._grip is None else self._grip.ends,
            kernel.GRIP_TARGET: self._grip_target,
            kernel.OPENING: self.opening,
            kernel.OBJECT: self.object,
            kernel.TOUCHED: self.touched,
            kernel.DELAYS: self.signals.delays,
            kernel.COMMANDS: self.signals.commands,
            kernel.GIVEN: self.signals.given,
            kernel.NOISE: self.signals.noise,
            kernel.SHARED: self._shared,
            kernel.DIFFERENCES: self._differences,
        }
