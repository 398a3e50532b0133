"""MPC: computed torque whose acceleration is planned over a horizon, within the limits of the arm."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armctl import _core
from armctl.control.computed_torque_qp import ComputedTorqueQP
from armctl.control.gain_attribute import Gain, joint_gain, scalar_gain
from armctl.core.defaults import DEFAULT_BANDWIDTH
from armctl.core.trajectory import TickReference
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm

DEFAULT_HORIZON_S = 0.25
_BLOCKS = 10  # of the horizon
_GROWTH = 1.25  # of their lengths: what is far ahead may be coarse
_MIN_BLOCK_TICKS = 2


class MPCCounts(NamedTuple):
    """How often limits acted since the start of a run.

    Attributes:
        ticks: All ticks.
        planned: Those in which the motion of computed torque would have exceeded a limit within the horizon.
        unplanned: Those of them without a plan: the solver found none, and the last plan goes on; or a joint is outside of its
            range. The program of the tick alone then keeps the limits of torque, and the others unless they contradict those.
        relaxed: Those of them whose plan exceeds limits of velocity or position by the least, because limits contradict each
            other.
    """

    ticks: int
    planned: int
    unplanned: int
    relaxed: int


class MPC(ComputedTorqueQP):
    """Model predictive control: plans the acceleration over a horizon, within the limits of torque, velocity and position.

    While the motion of computed torque respects all limits within the horizon, the law is computed torque. Otherwise a
    quadratic program adds accelerations c, linear in each of ten blocks of the horizon, that minimize their squares and those
    of the tip's errors that the limits add (see `armctl/cpp/laws/mpc.hpp`). The model is that of inverse dynamics, linearized
    along the last plan at every tick. A simulation passes the reference of the next ticks on, so the arm accelerates before a
    torque limit becomes active; without it, the reference is extrapolated at constant velocity. A setpoint from which the
    feedback would ask for more than twice the limit of velocity is moved nearer.

    The program of `ComputedTorqueQP` then keeps the limits of the tick itself, and brakes before the end of a joint's range.
    `counts` reports limits that contradict each other, and ticks without a plan. A reference outside of the range of a joint is
    moved to its end.
    """

    horizon: Gain[float] = scalar_gain(1e-3, 10.0)
    torque_rate: Gain[Array] = joint_gain()

    def __init__(
        self,
        arm: Arm,
        *,
        horizon: float = DEFAULT_HORIZON_S,
        bandwidth: float = DEFAULT_BANDWIDTH,
        damping_ratio: float = 1.0,
        torque_rate: ArrayLike = 0.0,
    ):
        """A model predictive controller for an arm.

        Args:
            arm: The arm whose model and limits it uses.
            horizon: s.
            bandwidth: rad/s, the natural frequency of the error.
            damping_ratio: 1 is critically damped.
            torque_rate: (n,) or one number, N m/s, the largest change of the torques; 0 for no limit.
        """
        super().__init__(arm, bandwidth=bandwidth, damping_ratio=damping_ratio)
        self.horizon = horizon
        self.torque_rate = torque_rate
        self.name = "mpc"

    @property
    def counts(self) -> MPCCounts:
        """How often limits acted in the present or last run."""
        law = self._law
        return MPCCounts(*(law.counts.astype(int).tolist() if isinstance(law, _core.MPC) else 4 * (0,)))

    def foresee(self, ahead: TickReference) -> None:
        """Takes the reference of the coming ticks for the next call of `torque`. A simulation does this by itself.

        Args:
            ahead: The setpoints on the tick grid, from that of the next call on.
        """
        self._ahead = (ahead.q, ahead.v_tick, ahead.a_tick)

    def _make_law(self, dt: float, continuous: bool) -> _core.Law:
        shares = _GROWTH ** np.arange(_BLOCKS)
        ticks = np.round(self.horizon / (dt or self._arm.dt) * shares / shares.sum()).astype(np.int64)
        return _core.MPC(
            self._model(dt, continuous),
            **self._law_gains(dt, continuous),
            blocks=np.maximum(ticks, _MIN_BLOCK_TICKS),
            torque_rate=np.where(self.torque_rate > 0.0, self.torque_rate, np.inf),
        )
