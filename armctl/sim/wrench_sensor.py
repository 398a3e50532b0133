"""WrenchSensor: the wrench of the environment on the tips, true or as a plant's sensors measure it."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import mujoco
import numpy as np

from armctl.control import State, feedforward
from armctl.core.validation import Array
from armctl.mjmodel.queries import is_below
from armctl.robot.arm import Arm
from armctl.robot.dynamics import Dynamics
from armctl.sim.plant import Plant

WRENCH_SIZE = 6
ESTIMATE_BANDWIDTH = 200.0  # rad/s of the low-pass of wrenches that are estimated from torques
_CARTESIAN_EQUALITIES = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD), int(mujoco.mjtEq.mjEQ_FLEX))
_MIN_JOINTS_FOR_MOMENTS = 6  # the torques of fewer joints do not separate moments from forces


class WrenchSensor:
    """The wrenches on the tips of k arms, (6 k,) N and N m: force first, world axes, at the tip.

    A true wrench is the sum of all contacts, connections and pushes on the bodies behind the arm's last joint; an ideal flange
    sensor measures it, with weight and inertia of the tool compensated. MuJoCo computes it during a step: the wrench at a tick
    is that of the previous step.

    Attributes:
        true: (6 k,) the true wrenches at the last call of `read`.
    """

    def __init__(self, arms: Sequence[Arm], plant: Plant, model: mujoco.MjModel, data: mujoco.MjData):
        """A sensor at each arm."""
        self._plant = plant
        self._model = model
        self._data = data
        self._tips = [_TipWrench(arm) for arm in arms]
        self._estimates = [_WrenchEstimate(arm) for arm in arms] if plant.wrench_source == "torques" else []
        self._ends = np.cumsum([arm.n for arm in arms])[:-1]
        self._has_connections = bool(np.isin(model.eq_type, _CARTESIAN_EQUALITIES).any())
        scale = [plant.force_noise] * 3 + [plant.moment_noise] * 3
        self._noise_scale = np.tile(scale, len(arms))
        self._has_noise = bool(self._noise_scale.any())
        self.true = np.zeros(WRENCH_SIZE * len(arms))
        self.reset()

    def reset(self) -> None:
        """Forgets all measurements and restarts the noise."""
        self._rng = np.random.default_rng([self._plant.seed, WRENCH_SIZE])
        self._samples: deque[tuple[float, Array]] = deque()
        for estimate in self._estimates:
            estimate.reset()

    def read(self, push: Array | None) -> Array:
        """The true wrenches now; `push` (6,) is the wrench of the plant's pushes on the first tip, if there are any."""
        data = self._data
        self.true = np.zeros_like(self.true)
        if data.ncon or self._has_connections or data.xfrc_applied.any():
            mujoco.mj_rnePostConstraint(self._model, data)
            for first, tip in enumerate(self._tips):
                self.true[WRENCH_SIZE * first :][:WRENCH_SIZE] = tip.read(data)
        if push is not None:
            self.true[:WRENCH_SIZE] += push
        return self.true

    def measure(self, push: Array | None, state: State, tau: Array) -> Array:
        """What the sensors give at this tick, with noise and delay; the same until the next tick.

        Args:
            push: As for `read`.
            state: The measured state of all arms.
            tau: (n,) N m, the torque of the motors during the last tick.
        """
        wrench = self.read(push)
        plant = self._plant
        if not (self._estimates or self._has_noise or plant.wrench_delay):
            return wrench
        if not self._samples or self._samples[-1][0] != state.t:
            if self._estimates:
                wrench = self._estimated(state, tau)
            if self._has_noise:
                wrench = wrench + self._noise_scale * self._rng.standard_normal(len(wrench))
            self._samples.append((state.t, wrench))
        oldest = state.t - (plant.wrench_delay + 0.5) * state.dt
        while len(self._samples) > 1 and self._samples[0][0] < oldest:
            self._samples.popleft()
        return self._samples[0][1]

    def _estimated(self, state: State, tau: Array) -> Array:
        q = np.split(state.q, self._ends)
        v = np.split(state.v, self._ends)
        torques = np.split(tau, self._ends)
        estimates = [estimate.update(state._replace(q=q[i], v=v[i]), torques[i]) for i, estimate in enumerate(self._estimates)]
        return np.concatenate(estimates)


class _TipWrench:
    """The wrench of the environment on the bodies behind an arm's last joint, at its tip."""

    def __init__(self, arm: Arm):
        model = arm.model
        last = int(model.dof_bodyid[arm.dof_adr[-1]])
        self._bodies = np.array([body for body in range(last, model.nbody) if is_below(model, body, last)])
        self._root = int(model.body_rootid[last])
        self._body = arm.tip_body
        self._offset = arm.T_body_tip.position

    def read(self, data: mujoco.MjData) -> Array:
        """(6,) from MuJoCo's external forces, which have torques first, about the center of mass of the whole tree."""
        # Forces between two of the bodies, such as two fingers, cancel.
        total = data.cfrc_ext[self._bodies].sum(axis=0)
        tip = data.xpos[self._body] + data.xmat[self._body].reshape(3, 3) @ self._offset
        force = total[3:]
        return np.concatenate([force, total[:3] - np.cross(tip - data.subtree_com[self._root], force)])


class _WrenchEstimate:
    """The wrench on a tip from torques and motion of the joints, w = J^-T LP[ID(q, v, (v_next - v) / dt) - tau].

    After De Luca, Mattone, "Sensorless robot collision detection and hybrid force/motion control" (2005), with the discrete
    inverse dynamics of the nominal model. Errors of the model, such as friction and payloads, appear as forces.
    """

    def __init__(self, arm: Arm):
        self._dynamics = Dynamics(arm.model, arm.pinocchio_model)
        self._jacobian = arm.pinocchio_model.jacobian
        self._rows = slice(0, WRENCH_SIZE if arm.n >= _MIN_JOINTS_FOR_MOMENTS else 3)
        self.reset()

    def reset(self) -> None:
        """Forgets the last tick."""
        self._last: State | None = None
        self._torque = np.zeros(len(self._dynamics.damping))

    def update(self, state: State, tau: Array) -> Array:
        """The estimate (6,) after a tick with motor torque tau (n,) N m. Fewer than six joints: forces only."""
        last = self._last
        if last is None or abs(state.t - last.t - state.dt) > 0.5 * state.dt:
            self._torque = np.zeros_like(tau)
        else:
            a = (state.v - last.v) / state.dt
            external = feedforward.inverse_dynamics_with_friction(self._dynamics, last, a, last.v, a) - tau
            self._torque = self._torque - math.expm1(-ESTIMATE_BANDWIDTH * state.dt) * (external - self._torque)
        self._last = state._replace(q=state.q.copy(), v=state.v.copy())
        wrench = np.zeros(WRENCH_SIZE)
        wrench[self._rows] = np.linalg.lstsq(self._jacobian(state.q)[self._rows].T, self._torque)[0]
        return wrench
