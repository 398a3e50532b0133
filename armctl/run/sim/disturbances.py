"""Disturbances: how a plant disturbs signals during a run, planned ahead: measurement noise, ages, delays, pushes."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from armctl import _core
from armctl.core.validation import Array, IntArray, vector
from armctl.run.sim.plant import Plant, Push
from armctl.run.sim.plant_model import PlantModel


class Planned(NamedTuple):
    """The disturbances of the coming ticks, as the tick loop takes them; None for none."""

    noise: Array | None  # (ticks, 2, n) on measured positions, rad, and velocities, rad/s
    ages: IntArray | None  # (ticks, n) ticks by which what is read is old
    jitter: IntArray | None  # (ticks,) ticks by which commands are late, besides the delay
    pushes: Array | None  # (ticks, 6) N and N m, on the tip


class _Before(NamedTuple):
    """The random numbers before the coming ticks were planned."""

    noise_state: Any
    last_noise: Array
    jitter_state: Any
    drawn: int  # rows of noise


class Disturbances:
    """Noise, delays and pushes of one run; every run of the same plant has the same ones.

    What it has at the coming ticks is planned here; the compiled core has what sensors and delays know of earlier ones.
    """

    def __init__(self, built: PlantModel):
        """The disturbances of a run that starts now."""
        plant = built.plant
        n = built.actuation.n
        timing = built.drivetrain.sensors
        self._built = built
        self._is_noisy = bool(plant.encoder_noise or plant.velocity_noise)
        self._is_late = bool(plant.sensor_delay or timing.is_late)
        self._pushes: tuple[Push, ...] = tuple(plant.pushes)  # type: ignore[arg-type]  # a tuple after Plant.__post_init__
        self._rng = np.random.default_rng(plant.seed)
        self._last_noise = np.zeros(n)
        self._jitter = np.random.default_rng([plant.seed, 1])
        self._before: _Before | None = None
        self.push = np.zeros(6)  # N and N m, the wrench of the pushes in the last tick, which the loop writes
        self.delay = _core.Delay(n, plant.delay + plant.jitter)
        self.delay.restart(plant.delay)
        # Without a velocity sensor, a law gets the difference of two positions. In a step of MuJoCo that is the velocity.
        self.sensors = _core.Sensors(
            **built.drivetrain.addresses,
            dt=built.dt,
            steps=encoder_steps(plant, built.actuation.units) if plant.encoder_bits else None,
            is_at_motors=plant.encoder_side == "motor",
            is_differenced=plant.differences_positions,
            max_age=plant.sensor_delay + int(np.ceil((timing.delay + timing.interval).max() / built.dt)) + 1,
        )

    def measure(self) -> tuple[Array, Array, Array]:
        """What the sensors give at this tick, the same until the next: positions and velocities (n,), deflections (2, n)."""
        built = self._built
        n = built.actuation.n
        if not self.sensors.has_measured:
            noise = self._noise(1)[0] if self._is_noisy else np.zeros((2, n))
            self.sensors.measure(built.model, built.data, noise, self._ages(np.array([built.data.time]))[0])
        q = np.empty(n)
        v = np.empty(n)
        deflection = np.empty((2, n))
        self.sensors.read(q, v, deflection)
        return q, v, deflection

    def joint_torque(self) -> _core.CallbackLaw | None:
        """The plant's torques on the links as a law, for one call of the loop: none of the two may keep the other."""
        built = self._built
        torque = built.plant.joint_torque
        if torque is None:
            return None
        n = built.actuation.n
        tau = np.empty(n)

        def call() -> None:
            tau[:] = vector("joint_torque", torque(built.q, built.v, float(built.data.time)), n)

        return _core.CallbackLaw(call, tau)

    def plan(self, ticks: int) -> Planned:
        """The disturbances of the coming ticks; call `took` afterwards."""
        jitter = self._built.plant.jitter
        drawn = ticks - self.sensors.has_measured if self._is_noisy else 0
        self._before = _Before(
            noise_state=self._rng.bit_generator.state if self._is_noisy else None,
            last_noise=self._last_noise,
            jitter_state=self._jitter.bit_generator.state if jitter else None,
            drawn=drawn,
        )
        noise = None
        if self._is_noisy:
            noise = self._noise(drawn)
            if drawn < ticks:  # the first tick is measured
                noise = np.concatenate([np.zeros((1, *noise.shape[1:])), noise])
        times = self._built.tick_times(ticks) if self._is_late or self._pushes else np.zeros(0)
        return Planned(
            noise=noise,
            ages=self._ages(times) if self._is_late else None,
            jitter=self._jitter.integers(0, jitter + 1, size=ticks) if jitter else None,
            pushes=self._wrenches(times) if self._pushes else None,
        )

    def took(self, planned: Planned, measured: int, driven: int) -> None:
        """Notes at how many of the planned ticks the state was measured, and the motors were driven."""
        before = self._before
        assert before is not None
        if planned.noise is not None:
            drawn = max(0, measured - (len(planned.noise) - before.drawn))
            if drawn < before.drawn:
                self._rng.bit_generator.state = before.noise_state
                self._last_noise = before.last_noise
                self._noise(drawn)
        if planned.jitter is not None and driven < len(planned.jitter):
            self._jitter.bit_generator.state = before.jitter_state
            self._jitter.integers(0, self._built.plant.jitter + 1, size=driven)

    def _noise(self, ticks: int) -> Array:
        """(ticks, 2, n) the noise of the coming ticks on positions and velocities."""
        plant = self._built.plant
        n = len(self._last_noise)
        normal = self._rng.standard_normal((ticks, 2, n))
        noise = np.empty((ticks, 2, n))
        noise[:, 0] = plant.encoder_noise * normal[:, 0]
        if plant.velocity_noise is None:
            noise[:, 1] = np.diff(noise[:, 0], axis=0, prepend=self._last_noise[None]) / self._built.dt
        else:
            noise[:, 1] = plant.velocity_noise * normal[:, 1]
        if ticks:
            self._last_noise = noise[-1, 0].copy()
        return noise

    def _ages(self, times: Array) -> IntArray:
        """(T, n) by how many ticks is old what is read at times, s."""
        built = self._built
        ticks = np.round(times / built.dt).astype(np.int64)
        return np.ascontiguousarray(built.plant.sensor_delay + built.drivetrain.sensors.ages(ticks, built.dt))

    def _wrenches(self, times: Array) -> Array:
        """(T, 6) the wrench of the pushes at times, s."""
        wrenches = np.zeros((len(times), 6))
        for push in self._pushes:
            wrenches[(push.start <= times) & (times < push.start + push.duration)] += push.wrench
        return wrenches


def disturbances_of(built: PlantModel) -> Disturbances | None:
    """The disturbances of a run that starts now; None if the plant has none."""
    plant = built.plant
    is_disturbed = plant.has_signal_disturbances or plant.jitter or plant.sensor_delay or plant.encoder_bits
    is_late = built.drivetrain.sensors.is_late or built.drivetrain.extra_joints
    return Disturbances(built) if is_disturbed or plant.joint_torque is not None or is_late else None


def encoder_steps(plant: Plant, units: Sequence[str]) -> Array:
    """(n,) rad (m), the steps of a plant's encoders; 0 for exact positions."""
    turn = np.where(np.asarray(units) == "m", 1.0, 2 * np.pi)
    return turn * (0.5**plant.encoder_bits if plant.encoder_bits else 0.0)
