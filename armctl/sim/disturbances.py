"""Disturbances: how a plant disturbs signals during a run: measurement noise, command delay, torque ripple, pushes."""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np

from armctl.core.validation import Array, IntArray
from armctl.robot.packed_dynamics import PackedDynamics
from armctl.sim.plant import Plant, Push


class Signals(NamedTuple):
    """The disturbances of the coming ticks, for the compiled loop.

    Attributes:
        noise: (ticks, 2, n) on measured positions, rad, and velocities, rad/s; None for none.
        wrenches: (ticks, 6) N and N m, of the pushes on the tip; None for none.
        push: (6,) the one of the last tick, which the loop writes.
        pushed_joints: The joints of the arm on whose tip they act.
        commands: (delay + 1, n) N m, ring buffer of the last commands.
        commands_given: How many commands there were since the last reset.
        ripple: (1,) amplitude of the torque ripple.
    """

    noise: Array | None
    wrenches: Array | None
    push: Array
    pushed_joints: int
    commands: Array
    commands_given: int
    ripple: Array


class Disturbances:
    """Noise, delay, ripple and pushes of one run; every run of the same plant has the same ones.

    Attributes:
        push: (6,) N and N m, the wrench of the pushes in the last tick; both loops write it.
    """

    def __init__(
        self, plant: Plant, model: mujoco.MjModel, data: mujoco.MjData, dof_adr: IntArray, tip: PackedDynamics, dt: float
    ):
        """The disturbances of a run that starts now.

        Args:
            plant: The plant that describes them.
            model: The plant's model.
            data: The state of the simulation; pushes are applied to it.
            dof_adr: (n,) addresses of the joints in `MjData.qvel`.
            tip: The dynamics of the arm on whose tip pushes act; its joints are the first ones.
            dt: s, the tick, over which positions are differenced.
        """
        n = len(dof_adr)
        self._plant = plant
        self._data = data
        self._pushed_dofs = dof_adr[: tip.n]
        self._tip = tip
        self._tip_model = tip.vector(0.0)
        self._tip_scratch = np.zeros(tip.work_size())
        self._pushes: tuple[Push, ...] = tuple(plant.pushes)  # type: ignore[arg-type]  # a tuple after Plant.__post_init__
        self._dt = dt
        self._steps = round(dt / model.opt.timestep)
        self._timestep = float(model.opt.timestep)
        self.push = np.zeros(6)
        self._rng = np.random.default_rng(plant.seed)
        self._last_noise = np.zeros(n)
        self._commands = np.zeros((plant.delay + 1, n))
        self._commands_given = 0
        self._ripple = np.array([plant.torque_ripple])
        self._planned: Signals | None = None
        self._noise_before: tuple[Any, Array] | None = None

    def measured(self, q: Array, v: Array) -> tuple[Array, Array]:
        """The true positions, rad, and velocities, rad/s, with measurement noise.

        Without a velocity sensor, the velocity has the noise of a difference of two measured positions.
        """
        noise = self._noise(1)[0]
        return q + noise[0], v + noise[1]

    def driven(self, tau: Array, q: Array) -> Array:
        """Applies the pushes of this moment, and returns the torque that the motors receive for a commanded torque.

        That is the command `delay` ticks ago, or the first command until then, with ripple.
        """
        from armctl.sim.tick_kernel import rippled, tip_torque

        if self._pushes:
            self.push[:] = self._wrenches(np.array([self._data.time]))[0]
            n = self._tip.n
            torque = np.zeros(n)
            tip_torque(self._tip_model, q[:n].copy(), self.push, self._tip_scratch, np.zeros((6, n)), torque)
            self._data.qfrc_applied[self._pushed_dofs] = torque
        length = len(self._commands)
        self._commands[self._commands_given % length] = tau
        oldest = self._commands[max(self._commands_given - self._plant.delay, 0) % length]
        self._commands_given += 1
        return np.array([rippled(*each, self._plant.torque_ripple) for each in zip(oldest.tolist(), q.tolist(), strict=True)])

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
        self._planned = Signals(noise, wrenches, self.push, self._tip.n, self._commands, self._commands_given, self._ripple)
        return self._planned

    def took(self, measured: int, commands_given: int) -> None:
        """Notes which of the planned disturbances were used.

        Args:
            measured: The number of ticks at which the state was measured.
            commands_given: The number of commands since the last reset.
        """
        planned = self._planned
        assert planned is not None
        self._commands_given = commands_given
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


def tick_times(start: float, ticks: int, steps: int, timestep: float) -> Array:
    """(ticks,) s, contiguous: the times of the coming ticks, to the bit. MuJoCo adds its time step at every step."""
    times = np.full(ticks * steps, timestep)
    times[0] = start
    return np.add.accumulate(times)[::steps].copy()
