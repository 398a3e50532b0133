"""TorqueRateLimit: bounds how fast the torques of another controller change."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from armctl import _core
from armctl.control.gain_attribute import Gain, joint_gain
from armctl.control.interface import (
    CompiledController,
    Controller,
    State,
    checked_period,
    controller_name,
    explains_wrong_arguments,
    has_compiled_law,
)
from armctl.core.errors import InputError
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, instance, shown, vector
from armctl.robot.arm import Arm, check_arm


def _with_torque(name: str, controller: Controller, _n: int) -> Controller:
    if not callable(getattr(controller, "torque", None)):
        raise InputError(f"{name}: {shown(controller)} has no method torque; armctl.PD(arm) is one")
    return controller


class TorqueRateLimit(CompiledController):
    """A controller with limited torque rates, as the interfaces of many arms require.

    The first torque of a run is not limited.

    Attributes:
        controller: The controller whose torques are limited.
        tau_rate_max: (n,) N m/s.
        name: The name of the controller.
        needs_wrench: Whether the controller needs the wrench.
    """

    controller: Gain[Controller] = Gain(_with_torque)
    tau_rate_max: Gain[Array] = joint_gain()

    def __init__(self, arm: Arm, controller: Controller, tau_rate_max: ArrayLike):
        """A controller with limited torque rates.

        Args:
            controller: The controller whose torques are limited.
            tau_rate_max: (n,) or one number for all joints, N m/s; 1000 N m/s is 1 N m a tick of 1 ms.

        Raises:
            InputError: It is no controller, or a rate is negative, not finite or of the wrong length.
        """
        check_arm(arm)
        super().__init__(arm.n)
        self.controller = controller
        self.tau_rate_max = tau_rate_max
        self.name = controller_name(controller)
        self._limited: _core.Law | None = None
        self._last_torque: Array | None = None  # of a controller without compiled law

    @property
    def needs_wrench(self) -> bool:  # type: ignore[override]
        """Whether the controller needs the wrench."""
        return bool(getattr(self.controller, "needs_wrench", False))

    @property
    def is_compiled(self) -> bool:
        """Whether the law of the controller is compiled."""
        return has_compiled_law(self.controller, self.n) and type(self).torque is TorqueRateLimit.torque

    def make_law(self, dt: float, continuous: bool) -> _core.Law:
        """A law with the present gains, at the start of a run, if the controller has a compiled one.

        Args:
            dt: s, the control period; 0 means continuous time.
            continuous: Whether the arm moves continuously during the control period.

        Raises:
            InputError: The controller has no compiled law, the control period is no number in [0, 1] s, or `continuous` is not
                True or False.
        """
        if not isinstance(self.controller, CompiledController):
            raise InputError(f"controller: {shown(self.controller)} has no compiled law")
        dt, continuous = checked_period(dt, continuous)
        return self._limit(self.controller.make_law(dt, continuous), dt)

    def _limit(self, limited: _core.Law, dt: float) -> _core.Law:
        return _core.TorqueRateLimit(limited, tau_rate_max=self.tau_rate_max, dt=dt)

    def fresh(self) -> Self:
        """The same law with a memory of its own, for a run at the same time."""
        other = super().fresh()
        if has_compiled_law(self.controller, self.n):
            other.controller = self.controller.fresh()
        return other

    def __getstate__(self) -> dict[str, Any]:
        """The state of a copy, or of one in another process: it begins a run."""
        return super().__getstate__() | {"_limited": None, "_last_torque": None}

    def begin(self, state: State) -> _core.Law:
        """Prepares for a tick.

        Returns:
            The law, which shares that of the controller: so the controller shows what it estimates.

        Raises:
            InputError: It is no `State`, or the controller has no compiled law.
        """
        if isinstance(self.controller, CompiledController):
            limited = self.controller.begin(state)
            if limited is not self._limited or self._period is None:
                self._limited = limited
                self._replace_law(self._limit(limited, state.dt), (state.dt, state.continuous))
        return super().begin(state)

    def finish(self, t: float) -> None:
        """Notes that the law computed further ticks without `begin`.

        Args:
            t: s, the time of the next tick.

        Raises:
            InputError: It is not a finite number.
        """
        super().finish(t)
        if has_compiled_law(self.controller, self.n):
            self.controller.finish(t)

    @explains_wrong_arguments
    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque for the coming control period.

        Args:
            setpoint: Where the arm should be.

        Returns:
            (n,) N m.

        Raises:
            InputError: The controller gave no list of n numbers, or an argument is no `State` or no `Setpoint`.
        """
        if self.is_compiled:
            return super().torque(state, setpoint)
        tau = vector("torque", self.controller.torque(state, setpoint), self.n, finite=False).copy()
        instance("state", state, State, "armctl.State(q, v) is one")
        if self._clock.follows(state) and self._last_torque is not None:
            change = self.tau_rate_max * state.dt
            highest = self._last_torque + change
            lowest = self._last_torque - change
            tau = np.where(tau > highest, highest, np.where(tau < lowest, lowest, tau))
        self._last_torque = tau.copy()
        return tau
