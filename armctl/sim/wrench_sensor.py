"""WrenchSensor: the wrench of the environment on the tips, true or as a plant's sensors measure it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import nan
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from armctl.control.interface import WRENCH_SIZE, State
from armctl.core.validation import Array
from armctl.robot.arm import Arm
from armctl.sim.plant import Plant
from armctl.sim.sensor_site import SensorKind, Site

if TYPE_CHECKING:
    from armctl.sim.tip_sensor import TipSensor

_CARTESIAN_EQUALITIES = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD), int(mujoco.mjtEq.mjEQ_FLEX))


class WrenchSensor:
    """The wrenches on the tips of k arms, (6 k,) N and N m: force first, world axes, at the tip.

    A true wrench is the sum of all contacts, connections and pushes on the bodies behind the arm's last joint; an ideal flange
    sensor measures it, with weight and inertia of the tool compensated. MuJoCo computes it during a step: the wrench at a tick
    is that of the previous step.

    Attributes:
        true: (6 k,) the true wrenches at the last call of `read` or `measure`.
    """

    def __init__(
        self, arms: Sequence[Arm], plant: Plant, model: mujoco.MjModel, data: mujoco.MjData, dt: float, continuous: bool
    ):
        """A sensor at each arm.

        Args:
            arms: Arms of the model.
            plant: What disturbs the measurements.
            model: The plant's model.
            data: Its state.
            dt: s, the tick.
            continuous: Whether the arm moves almost continuously between ticks.
        """
        self._plant = plant
        self._model = model
        self._data = data
        self._period = (dt, continuous)
        self._sites = [Site.of(arm) for arm in arms]
        self._ends = np.cumsum([arm.n for arm in arms]).tolist()
        self._has_connections = bool(np.isin(model.eq_type, _CARTESIAN_EQUALITIES).any())
        self._noise_scale = np.tile([plant.force_noise] * 3 + [plant.moment_noise] * 3, len(arms))
        self._has_noise = bool(plant.force_noise or plant.moment_noise)
        self._is_sampled = self._has_noise or bool(plant.wrench_delay) or plant.wrench_source == "torques"
        self._tips: list[TipSensor] = []
        self.true = np.zeros(WRENCH_SIZE * len(arms))
        self.reset()

    @property
    def arms(self) -> int:
        """The number of arms."""
        return len(self._sites)

    def reset(self) -> None:
        """Forgets all measurements and restarts the noise."""
        if self._has_noise:
            self._rng = np.random.default_rng([self._plant.seed, WRENCH_SIZE])
        self._sampled_at = nan
        for tip in self._tips:
            tip.reset()

    def has_measured(self, t: float) -> bool:
        """Whether the measurement at time t, s, is made already."""
        return self._sampled_at == t

    def read(self, push: Array | None) -> Array:
        """The true wrenches now; `push` (6,) is the wrench of the plant's pushes on the first tip, if there are any."""
        data = self._data
        self.true = np.zeros_like(self.true)
        if data.ncon or self._has_connections or data.xfrc_applied.any():
            for k, tip in enumerate(self._sensors()):
                self.true[WRENCH_SIZE * k :][:WRENCH_SIZE] = tip.read(None if k else push)
        elif push is not None:
            self.true[:WRENCH_SIZE] += push
        return self.true

    def measure(self, push: Array | None, state: State, tau: Array) -> Array:
        """What the sensors give at this tick, with noise and delay; the same until the next tick.

        Args:
            push: As for `read`.
            state: The measured state of all arms.
            tau: (n,) N m, the torque of the motors during the last tick.
        """
        if not self._is_sampled:
            return self.read(push)
        noise = np.zeros_like(self.true)
        if self._has_noise and not self.has_measured(state.t):
            noise = self._noise(1)[0]
        self._sampled_at = state.t
        self.true = np.empty_like(self.true)
        measured = np.empty_like(self.true)
        first = 0
        for k, (tip, last) in enumerate(zip(self._sensors(), self._ends, strict=True)):
            own = slice(WRENCH_SIZE * k, WRENCH_SIZE * (k + 1))
            signals = (state.q[first:last], state.v[first:last], tau[first:last], state.t, noise[own])
            measured[own], self.true[own] = tip.measure(*signals, None if k else push)
            first = last
        return measured

    def plan(self, push: Array | None, times: Array, true: Array, signals: Mapping[int, int]) -> int:
        """Prepares the sensor of a single arm for the coming ticks of the compiled loop; call `took` afterwards.

        Args:
            push: As for `read`; the loop changes it.
            times: (ticks,) s.
            true: (ticks, 6), where the true wrenches are noted.
            signals: Addresses of measured positions and velocities, of the torque of the motors, and of the result, by the
                entries of the table.

        Returns:
            The address of the table for `wrench_kernel`.
        """
        (tip,) = self._sensors()
        self._planned_noise = None
        if self._has_noise:
            self._noise_before: Any = self._rng.bit_generator.state
            self._planned_noise = self._noise(len(times))
        self._times = times
        return tip.plan(push, times, true, self._planned_noise, signals)

    def took(self, measured: int) -> None:
        """Notes at how many of the planned ticks the wrench was measured."""
        if not measured or not self._is_sampled:
            return
        self._sampled_at = float(self._times[measured - 1])
        if self._has_noise and measured < len(self._times):
            self._rng.bit_generator.state = self._noise_before
            self._noise(measured)

    def _noise(self, ticks: int) -> Array:
        """(ticks, 6 k) the noise of the coming ticks."""
        return self._noise_scale * self._rng.standard_normal((ticks, len(self._noise_scale)))

    def _sensors(self) -> list[TipSensor]:
        """The sensors of all arms, which are made when the first wrench is asked for: most simulations need none."""
        from armctl.sim.tip_sensor import TipSensor

        if not self._tips:
            kind = SensorKind(*self._period, self._plant, self._is_sampled, self._has_connections)
            self._tips = [TipSensor(site, kind, self._model, self._data) for site in self._sites]
        return self._tips
