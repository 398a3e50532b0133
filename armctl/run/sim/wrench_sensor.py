"""WrenchSensor: the wrench of the environment on the tip, true or as a plant's sensors measure it."""

from typing import Any, NamedTuple

import mujoco
import numpy as np

from armctl import _core
from armctl.control.interface import WRENCH_SIZE
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.model.mjmodel.queries import is_below
from armctl.run.sim.mujoco_library import mujoco_api
from armctl.run.sim.plant_model import PlantModel

_MIN_JOINTS_FOR_MOMENTS = 6  # the torques of fewer joints do not separate moments from forces
_CARTESIAN_EQUALITIES = {int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD), int(mujoco.mjtEq.mjEQ_FLEX)}


class _Site(NamedTuple):
    """Where an arm's wrench acts, without the arm itself: a waiting simulation must not keep it."""

    last_body: int  # behind the arm's last joint
    tip_body: int
    offset: Array  # (3,) m, the tip in that body
    arm: _core.ArmModel


class WrenchSensor:
    """The wrench on the first tip of an arm, (6,) N and N m: force first, world axes, at the tip.

    A true wrench is the sum of all contacts, connections and pushes on the bodies behind the arm's last joint; an ideal flange
    sensor measures it, with weight and inertia of the tool compensated. MuJoCo computes it during a step: the wrench at a tick
    is that of the previous step.
    """

    def __init__(self, arm: Arm, built: PlantModel):
        plant = built.plant
        model = built.model
        self._built = built
        self._plant = plant
        self._model = model
        self._data = built.data
        self._period = (built.dt, built.continuous)
        self._site = _Site(arm.last_bodies[0], arm.tip_body, arm.T_body_tip.position, arm.core_model)
        self._has_connections = not _CARTESIAN_EQUALITIES.isdisjoint(model.eq_type.tolist())
        self._noise_scale = np.array([plant.force_noise] * 3 + [plant.moment_noise] * 3)
        self._has_noise = bool(plant.force_noise or plant.moment_noise)
        self._is_sampled = self._has_noise or bool(plant.wrench_delay) or plant.wrench_source == "torques"
        self._tip: _core.WrenchSensor | None = None
        self._rng: np.random.Generator | None = None  # of a sensor with noise
        self._before: tuple[Any, int] | None = None
        self.true = np.zeros(WRENCH_SIZE)  # the true wrench at the last call of `read` or `measure`
        self.reset()

    def reset(self) -> None:
        """Forgets all measurements and restarts the noise."""
        if self._has_noise:
            self._rng = np.random.default_rng([self._plant.seed, WRENCH_SIZE])
        if self._tip is not None:
            self._tip.reset()

    def has_measured(self, t: float) -> bool:
        """Whether the measurement at time t, s, is made already."""
        return self._tip is not None and self._tip.has_measured(t)

    def read(self, push: Array | None) -> Array:
        """The true wrench now; `push` (6,) is that of the plant's pushes, if there are any."""
        data = self._data
        self.true = np.zeros(len(self.true))
        if data.ncon or self._has_connections or data.xfrc_applied.any():
            self._sensor().read(push, self.true)
        elif push is not None:
            self.true += push
        return self.true

    def measure(self, push: Array | None, q: Array, v: Array, t: float) -> Array:
        """What the sensor gives at this tick, at t s, with noise and delay; q and v, (n,) each, are measured."""
        if not self._is_sampled:
            return self.read(push)
        tau = self._built.motor_torque
        noise = np.zeros_like(self.true)
        if self._has_noise and not self.has_measured(t):
            noise = self._noise(1)[0]
        self.true = np.empty_like(self.true)
        measured = np.empty_like(self.true)
        self._sensor().measure(
            np.ascontiguousarray(q),
            np.ascontiguousarray(v),
            np.ascontiguousarray(tau),
            t,
            noise,
            push,
            measured,
            self.true,
        )
        return measured

    def plan(self, times: Array) -> tuple[_core.WrenchSensor, Array | None]:
        """The sensor for coming ticks of the loop, and its noise (ticks, 6) N and N m, or None.

        Call `took` afterwards.
        """
        sensor = self._sensor()
        if self._rng is None:
            return sensor, None
        drawn = len(times) - self.has_measured(times[0])
        self._before = (self._rng.bit_generator.state, drawn)
        noise = self._noise(drawn)
        if drawn < len(times):  # the first tick is measured
            noise = np.concatenate([np.zeros((1, noise.shape[1])), noise])
        return sensor, noise

    def took(self, noise: Array | None, measured: int) -> None:
        """Notes at how many of the planned ticks the wrench was measured."""
        if noise is None or self._before is None or self._rng is None:
            return
        state, drawn = self._before
        used = max(0, measured - (len(noise) - drawn))
        if used < drawn:
            self._rng.bit_generator.state = state
            self._noise(used)

    def _noise(self, ticks: int) -> Array:
        """(ticks, 6) the noise of the coming ticks."""
        assert self._rng is not None
        return self._noise_scale * self._rng.standard_normal((ticks, len(self._noise_scale)))

    def _sensor(self) -> _core.WrenchSensor:
        """The sensor, which is made when the first wrench is asked for: most simulations need none."""
        if self._tip is None:
            self._tip = self._made()
        return self._tip

    def _made(self) -> _core.WrenchSensor:
        site = self._site
        model = self._model
        bodies = [body for body in range(site.last_body, model.nbody) if is_below(model, body, site.last_body)]
        told_by_torques = WRENCH_SIZE if site.arm.n >= _MIN_JOINTS_FOR_MOMENTS else 3
        return _core.WrenchSensor(
            mujoco_api(),
            model,
            self._data,
            arm=site.arm.for_period(*self._period),
            bodies=np.array(bodies, np.int64),
            root=int(model.body_rootid[site.last_body]),
            tip=site.tip_body,
            offset=np.array(site.offset),
            is_connected=self._has_connections,
            dt=self._period[0],
            delay=self._plant.wrench_delay,
            is_sampled=self._is_sampled,
            estimated=told_by_torques if self._plant.wrench_source == "torques" else 0,
        )
