"""Disturbances: how a plant disturbs signals during a run: measurement noise, command delay, pushes."""

from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from armctl import _core
from armctl.core.validation import Array, vector
from armctl.run.sim.drivetrain import Drivetrain
from armctl.run.sim.plant import Plant, Push


class Signals(NamedTuple):
    """The disturbances of the coming ticks, for the compiled loop; None for none."""

    noise: Array | None  # (ticks, 2, n) on measured positions, rad, and velocities, rad/s
    wrenches: Array | None  # (ticks, 6) N and N m, of the pushes on the tip


class Disturbances:
    """Noise, delay and pushes of one run; every run of the same plant has the same ones."""

    def __init__(
        self, plant: Plant, model: mujoco.MjModel, data: mujoco.MjData, train: Drivetrain, pushed_arm: _core.ArmModel, dt: float
    ):
        """The disturbances of a run that starts now. Pushes act on the tip of `pushed_arm`, whose joints are the first ones."""
        n = train.actuation.n
        self._plant = plant
        self._model = model
        self._data = data
        self._train = train
        self._pushed = pushed_arm.n
        self._step = encoder_steps(plant, train.actuation.units) if plant.encoder_bits else None
        longest = int(np.ceil((train.sensors.delay + train.sensors.interval).max() / dt))
        self._late: deque[Array] = deque(maxlen=plant.sensor_delay + longest + 2)
        self._jitter = np.random.default_rng([plant.seed, 1])
        self._commands: deque[Array] = deque(maxlen=plant.delay + plant.jitter + 1)
        self._age = 0
        self._pushed_arm = pushed_arm
        self._pushes: tuple[Push, ...] = tuple(plant.pushes)  # type: ignore[arg-type]  # a tuple after Plant.__post_init__
        self._dt = dt
        self._steps = round(dt / model.opt.timestep)
        self._timestep = float(model.opt.timestep)
        self.push = np.zeros(6)  # N and N m, the wrench of the pushes in the last tick; both loops write it
        # (n,) rad, the true positions of the last tick, NaN at the first one; None if no velocity is differenced.
        # Without a velocity sensor, a law gets the difference of two positions. In a step of MuJoCo that is the velocity.
        self.last_position = np.full(n, np.nan) if plant.differences_positions else None
        self.deflection = np.zeros((2, n))  # of the springs, as measured at this tick
        self.delay = _core.Delay(n, plant.delay)  # of the commands; both loops use it
        self.delay.restart(plant.delay)
        self._rng = np.random.default_rng(plant.seed)
        self._last_noise = np.zeros(n)
        self._planned: Signals | None = None
        self._noise_before: tuple[Any, Array] | None = None

    def measured(self, q: Array, v: Array) -> tuple[Array, Array]:
        """What the sensors give at this tick for positions q, rad, and velocities v, rad/s. Call it once in a tick.

        Without a velocity sensor, the velocity is the difference of two measured positions. The one at the first tick is true.
        """
        train = self._train
        data = self._data
        if train.extra_joints and self._plant.encoder_side == "link":
            q = train.link_positions(data.qpos)
            v = train.link_speeds(data.qvel)
        elif train.extra_joints:
            q = data.qpos[train.motor_qpos]
            v = data.qvel[train.motor_dof]
        noise = self._noise(1)[0]
        measured_q = q + noise[0]
        if self._step is not None:
            measured_q = self._step * np.round(measured_q / self._step)
        measured_v = v + noise[1]
        if self.last_position is not None:
            # The noise of a velocity is that of the difference already; steps of the encoder are not.
            seen = q if self._step is None else measured_q
            difference = (seen - self.last_position) / self._dt + (noise[1] if self._step is None else 0.0)
            measured_v = np.where(np.isnan(difference), measured_v, difference)
            self.last_position[:] = seen
        deflection = train.deflection(data) if train.extra_joints else self.deflection
        self._late.append(np.array([measured_q, measured_v, *deflection]))
        if self._plant.sensor_delay or train.sensors.is_late:
            tick = np.array([round(data.time / self._dt)])
            age = self._plant.sensor_delay + train.sensors.ages(tick, self._dt)[0]
            read = np.maximum(len(self._late) - 1 - age, 0)
            joint = np.arange(len(q))
            measured_q, measured_v, *deflection = np.array(self._late)[read, :, joint].T
        self.deflection = np.asarray(deflection)
        return measured_q, measured_v

    def driven(self, tau: Array, q: Array, v: Array) -> Array:
        """Applies the pushes and the plant's joint torque of this moment, and returns what the motors receive for a command.

        That is the command `delay` ticks ago, at random up to `jitter` ticks older, or the first command until then.
        """
        if self._pushes or self._plant.joint_torque is not None:
            torque = np.zeros(len(q))
            if self._pushes:
                self.push[:] = self._wrenches(np.array([self._data.time]))[0]
                _core.tip_forces(
                    self._pushed_arm, q[None, : self._pushed].copy(), self.push[None], torque[None, : self._pushed]
                )
            if self._plant.joint_torque is not None:
                torque += vector("joint_torque", self._plant.joint_torque(q, v, float(self._data.time)), len(q))
            self._train.push(self._data, torque)
        if self._plant.jitter:
            self._commands.append(tau.copy())
            age = self._plant.delay + int(self._jitter.integers(0, self._plant.jitter + 1))
            self._age = min(age, self._age + 1, len(self._commands) - 1)  # a command is not followed by an older one
            return self._commands[-1 - self._age]
        oldest = np.empty_like(tau)
        self.delay.delayed(tau, oldest)
        return oldest

    def planned(self, ticks: int) -> Signals:
        """The disturbances of the coming ticks; call `took` afterwards."""
        noise = None
        self._noise_before = None
        if self._plant.encoder_noise or self._plant.velocity_noise:
            self._noise_before = self._rng.bit_generator.state, self._last_noise
            noise = self._noise(ticks)
        wrenches = None
        if self._pushes:
            wrenches = self._wrenches(tick_times(self._data.time, ticks, self._steps, self._timestep))
        self._planned = Signals(noise, wrenches)
        return self._planned

    def took(self, measured: int) -> None:
        """Notes at how many of the planned ticks the state was measured."""
        planned = self._planned
        assert planned is not None
        if planned.noise is not None and self._noise_before is not None and measured < len(planned.noise):
            state, self._last_noise = self._noise_before
            self._rng.bit_generator.state = state  # type: ignore[attr-defined]
            self._noise(measured)
        self._planned = None

    def _noise(self, ticks: int) -> Array:
        """(ticks, 2, n) the noise of the coming ticks on positions and velocities."""
        plant = self._plant
        n = len(self._last_noise)
        normal = self._rng.standard_normal((ticks, 2, n))
        noise = np.empty((ticks, 2, n))
        noise[:, 0] = plant.encoder_noise * normal[:, 0]
        if plant.velocity_noise is None:
            noise[:, 1] = np.diff(noise[:, 0], axis=0, prepend=self._last_noise[None]) / self._dt
        else:
            noise[:, 1] = plant.velocity_noise * normal[:, 1]
        if ticks:
            self._last_noise = noise[-1, 0].copy()
        return noise

    def _wrenches(self, times: Array) -> Array:
        """(T, 6) the wrench of the pushes at times, s."""
        wrenches = np.zeros((len(times), 6))
        for push in self._pushes:
            wrenches[(push.start <= times) & (times < push.start + push.duration)] += push.wrench
        return wrenches


def encoder_steps(plant: Plant, units: Sequence[str]) -> Array:
    """(n,) rad (m), the steps of a plant's encoders; 0 for exact positions."""
    turn = np.where(np.asarray(units) == "m", 1.0, 2 * np.pi)
    return turn * (0.5**plant.encoder_bits if plant.encoder_bits else 0.0)


def tick_times(start: float, ticks: int, steps: int, timestep: float) -> Array:
    """(ticks,) s, contiguous: the times of the coming ticks, to the bit. MuJoCo adds its time step at every step."""
    times = np.full(ticks * steps, timestep)
    times[0] = start
    return np.add.accumulate(times)[::steps].copy()
