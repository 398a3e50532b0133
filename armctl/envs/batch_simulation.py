"""BatchSimulation: the simulated arms of a batch of environments, and their compiled step on several threads."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from armctl import _core
from armctl.control import controller_by_name
from armctl.control.interface import State, has_compiled_law
from armctl.core.log import SimulationError
from armctl.core.validation import Array, IntArray
from armctl.envs.actions import ActionMode, smoothing_ticks, target_limits, tip_sizes
from armctl.envs.arm_copies import ArmCopies
from armctl.envs.randomization import ObjectFactors, Randomization
from armctl.envs.tasks.task import Episode, Task
from armctl.run.sim.mujoco_library import mujoco_api
from armctl.run.sim.plant import NOMINAL, Plant

_APPROACH_RATE = 40.0  # 1/s, at which a reference approaches its target, at most one fifth of the way in a tick
_MAX_SHARE_PER_TICK = 0.2
_IK_DAMPING = 1e-4  # of J J^T, whose entries are squares of m and rad


class EncoderNoise:
    """Noise of what is measured on several copies of an arm in the next step.

    The velocity is differenced from the measured positions, as that of `Plant` without a velocity sensor.
    """

    def __init__(self, count: int, ticks: int, n: int, dt: float, *, is_noisy: bool):
        """Signals without noise, for steps of so many ticks of dt s."""
        # (count, ticks, 2, n) rad and rad/s, on measured positions and velocities; empty if there is none
        self.noise = np.zeros((count if is_noisy else 0, ticks, 2, n))
        self._dt = dt
        self._deviation = np.zeros(count)
        self._rngs: list[np.random.Generator | None] = [None] * count

    def reset(self, row: int, plant: Plant, rng: np.random.Generator) -> None:
        """Starts an episode of a copy with the noise of a plant."""
        if len(self.noise):
            self._deviation[row] = plant.encoder_noise
            self._rngs[row] = np.random.default_rng(int(rng.integers(2**63)))
            self.noise[row] = 0.0

    def draw(self) -> None:
        if not len(self.noise):
            return
        last = self.noise[:, -1, 0].copy()
        positions = self.noise[:, :, 0]
        for row, rng in enumerate(self._rngs):
            if rng is not None:
                positions[row] = self._deviation[row] * rng.standard_normal(positions.shape[1:])
        self.noise[:, :, 1] = np.diff(positions, axis=1, prepend=last[:, None]) / self._dt

    def measured(self, q: Array) -> Array:
        """(count, n) rad, positions (count, n) as they are measured now."""
        return q + self.noise[:, -1, 0] if len(self.noise) else q


class BatchSimulation:
    """Several copies of an arm, each with its own plant, state and target."""

    def __init__(
        self,
        task: Task,
        mode: ActionMode,
        controller: str,
        count: int,
        *,
        ticks: int,
        threads: int,
        has_contacts: bool,
        randomization: Randomization,
    ):
        """Copies of an arm at home; UnknownNameError if there is no such controller."""
        arm = task.arm
        n = arm.n
        self.arm = arm  # the model of the controllers
        self.count = count
        self.ticks = ticks  # control periods in a step
        self.mode = mode  # what the actions mean
        self.tip_sizes = tip_sizes(arm)  # the numbers of each tip, if the actions are cartesian
        # What disturbs measurements and commands
        self.signals = EncoderNoise(count, ticks, n, arm.dt, is_noisy=randomization.is_noisy)
        limits = target_limits(arm)
        # (5, n) least and greatest position, greatest speed, acceleration and torque
        self.limits = np.array([limits.q_min, limits.q_max, limits.v_max, limits.a_max, limits.tau_max])
        self.action = np.zeros((count, mode.size(arm) + int(task.uses_gripper)))  # (count, k), the actions of the next step
        self.q = np.tile(arm.home, (count, 1))  # (count, n) rad, the positions
        self.v = np.zeros((count, n))  # (count, n) rad/s, the velocities
        self.target = self.q.copy()  # (count, n) rad, the joint targets of the actions
        self.tip = np.zeros((count, 12))  # (count, 12) position and rotation matrix of the (first) tip
        self.opening = np.ones(count)  # (count,) of the gripper, from closed (0) to open (1)
        # (count, 13) position, quaternion, velocity and angular velocity of the loose object
        self.object = np.zeros((count, 13))
        self.touched = np.zeros(count, np.int64)  # (count,) ticks of the last step at which something touched the obstacle
        self._q_ref = self.q.copy()
        self._v_ref = np.zeros((count, n))
        self._grip = task.grip if task.uses_gripper else None
        self._cuts = np.linspace(0, count, threads + 1).astype(int).tolist()
        # The models and states of the copies
        self.simulated = ArmCopies(task, np.diff(self._cuts), has_contacts=has_contacts)
        law = controller_by_name(controller, arm)
        assert has_compiled_law(law, n)  # as all controllers that have a name
        self._law = law.begin(State(arm.home, np.zeros(n), 0.0, arm.dt))
        self._core = self._compiled_batch(self._law, randomization.max_delay, mode.kind, self.action, ticks)
        for row in range(count):
            self._core.set_simulation(row, self.simulated.model(row), self.simulated.data(row))
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None

    def step(self) -> None:
        """Steps all copies by their actions; SimulationError if MuJoCo could not make a step."""
        self.signals.draw()
        if self._pool is None:
            errors = [self._core.step(0, self.count)]
        else:
            errors = list(self._pool.map(self._core.step, self._cuts[:-1], self._cuts[1:]))
        if any(errors):
            raise SimulationError(f"mj_step: {next(filter(None, errors)):.300}")

    def reset(
        self, row: int, episode: Episode, plant: Plant | None, factors: ObjectFactors | None, rng: np.random.Generator
    ) -> None:
        """Starts an episode of a copy, at rest; a plant or factors of the object that are None stay as they are."""
        self.q[row] = episode.q
        self.v[row] = 0.0
        self.target[row] = episode.q
        self._q_ref[row] = episode.q
        self._v_ref[row] = 0.0
        self.opening[row] = 1.0
        self.touched[row] = 0
        self.signals.reset(row, plant or NOMINAL, rng)
        self.simulated.reset(row, episode, plant, factors)
        self.object[row] = self.simulated.object_state(row)
        self._core.set_simulation(row, self.simulated.model(row), self.simulated.data(row))
        self._core.restart(row, (plant or NOMINAL).delay)

    def rehearse(self, action: Array, target: Array, q_ref: Array, v_ref: Array) -> None:
        """Changes targets and references (n,) of the joints as a step with an action does; the arms stay where they are."""
        self._core.rehearse(np.ascontiguousarray(action, dtype=np.float64), target, q_ref, v_ref)

    def target_after(self, row: int) -> Array:
        """(n,) rad, the joint targets of a copy after its action; nothing moves."""
        target = self.target[row].copy()
        self.rehearse(self.action[row], target, *self.reference(row))
        return target

    def reference(self, row: int) -> tuple[Array, Array]:
        """(n,) rad and rad/s, where the reference of the joints of a copy is; copies."""
        return self._q_ref[row].copy(), self._v_ref[row].copy()

    def tick_by_tick(self) -> _core.EnvironmentBatch:
        """What rehearses single ticks of the reference: an action (n,) of zeros leaves its targets where they are."""
        return self._compiled_batch(self._law, 0, _core.ActionMode.joint_delta, np.zeros((self.count, self.arm.n)), 1)

    @property
    def tip_positions(self) -> Array:
        """(count, 3 K) m, where the K tips are."""
        first = self.tip[:, :3]
        others = [self.arm.fk_many(self.q, frame.name)[0] for frame in self.arm.further_tips]
        return np.concatenate([first, *others], axis=1) if others else first

    def find_tips(self, rows: Sequence[int] | IntArray) -> None:
        positions, rotations = self.arm.fk_many(self.q[rows])
        self.tip[rows, :3] = positions
        self.tip[rows, 3:] = rotations.reshape(-1, 9)

    def close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None

    def _compiled_batch(
        self, law: _core.Law, max_delay: int, kind: _core.ActionMode, action: Array, ticks: int
    ) -> _core.EnvironmentBatch:
        """The compiled steps of all copies, which work on the arrays of this object; actions (count, k) for so many ticks."""
        arm = self.arm
        mode = self.mode
        size = arm.n if action is not self.action else mode.size(arm)
        noise = self.signals.noise if len(self.signals.noise) and ticks == self.ticks else None
        grip = self._grip
        objects = self.simulated.object_addresses
        carried = [arm.pinocchio_model.carried(k) for k in range(len(arm.tips))]
        homes = [arm.fk(arm.home, tip) for tip in arm.tips]
        return _core.EnvironmentBatch(
            mujoco_api(),
            arm=arm.core_model.for_period(arm.dt, False),
            law=law,
            limits=self.limits,
            qpos_addresses=np.asarray(arm.qpos_adr, np.int64),
            dof_addresses=np.asarray(arm.dof_adr, np.int64),
            ctrl_addresses=np.asarray(arm.ctrl_adr, np.int64),
            gear=np.array(arm.gear, dtype=np.float64),
            gripper_ctrl=np.zeros(0, np.int64) if grip is None else grip.indices[0],
            gripper_length=np.zeros(0, np.int64) if grip is None else grip.indices[1],
            gripper_ends=np.zeros((4, 0)) if grip is None else grip.ends,
            grip_step=0.0 if grip is None else grip.speed * arm.dt,
            object_addresses=None if objects is None else np.array(objects, np.int64),
            obstacle=self.simulated.obstacle_geom,
            max_delay=max_delay,
            action=action,
            q=self.q,
            v=self.v,
            target=self.target,
            q_ref=self._q_ref,
            v_ref=self._v_ref,
            tip=self.tip,
            opening=self.opening,
            object=self.object,
            touched=self.touched,
            noise=noise,
            mode=kind.value,
            size=size,
            ticks=ticks,
            dt=arm.dt,
            joint_scale=mode.joint_scale * self.ticks * arm.dt,
            position_scale=mode.position_scale,
            rotation_scale=mode.rotation_scale,
            smoothing=smoothing_ticks(arm) if mode.is_smooth else 1,
            approach_rate=min(_APPROACH_RATE, _MAX_SHARE_PER_TICK / arm.dt),
            tip_damping=_IK_DAMPING,
            tip_joints=np.array([joint for joint, _ in carried], np.int64),
            tip_placements=np.array([placement for _, placement in carried]),
            tip_sizes=np.array(self.tip_sizes, np.int64),
            home_tips=np.array([np.concatenate([home.rotation.ravel(), home.position]) for home in homes]),
        )
