"""ControllerAround: the base of controllers that change the torques of another one."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, Self

import numpy as np

from armctl import _core
from armctl.control.gain_attribute import Gain
from armctl.control.interface import (
    CompiledController,
    Controller,
    ControllerWrapper,
    State,
    Traits,
    checked_period,
    explains_wrong_arguments,
    has_compiled_law,
    has_torque,
    traits,
)
from armctl.core.errors import InputError
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, instance, shown, vector
from armctl.model.arm.arm import Arm, check_arm


def _with_torque(name: str, controller: Controller, _n: int) -> Controller:
    if not has_torque(controller):
        raise InputError(f"{name}: {shown(controller)} has no method torque; armctl.PD(arm) is one")
    return controller


class ControllerAround(CompiledController, ControllerWrapper):
    """A controller that changes the torques of another one.

    Attributes:
        controller: The controller whose torques are changed.
        name: The name of the controller.
    """

    controller: Gain[Controller] = Gain(_with_torque)

    def __init__(self, arm: Arm, controller: Controller):
        """A controller around another one.

        Args:
            controller: The controller whose torques are changed.
        """
        check_arm(arm)
        super().__init__(arm.n)
        self.controller = controller
        self.name = traits(controller).name
        self._inner: _core.Law | None = None

    @property
    def needs_wrench(self) -> bool:  # type: ignore[override]
        """Whether the controller needs the wrench."""
        return traits(self.controller).needs_wrench

    @property
    def traits(self) -> Traits:  # type: ignore[override]
        """Those of the controller, under the name of this one."""
        return traits(self.controller)._replace(name=self.name, applied=None)

    @property
    def is_compiled(self) -> bool:
        """Whether the law of the controller is compiled."""
        return has_compiled_law(self.controller, self.n) and type(self).torque is ControllerAround.torque

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
        return self._around(self.controller.make_law(dt, continuous), dt)

    @abstractmethod
    def _around(self, inner: _core.Law, dt: float) -> _core.Law:
        """The law around that of the controller."""

    def fresh(self) -> Self:
        """The same law with a memory of its own, for a run at the same time."""
        other = super().fresh()
        if has_compiled_law(self.controller, self.n):
            other.controller = self.controller.fresh()
        return other

    def __getstate__(self) -> dict[str, Any]:
        """The state of a copy, or of one in another process: it begins a run."""
        return super().__getstate__() | {"_inner": None}

    def begin(self, state: State) -> _core.Law:
        """Prepares for a tick.

        Returns:
            The law, which shares that of the controller: so the controller shows what it estimates.
        """
        if isinstance(self.controller, CompiledController):
            inner = self.controller.begin(state)
            if inner is not self._inner or self._period is None:
                self._inner = inner
                self._replace_law(self._around(inner, state.dt), (state.dt, state.continuous))
        return super().begin(state)

    def _take_ahead(self) -> tuple[Array, ...]:
        return self.controller._take_ahead() if isinstance(self.controller, CompiledController) else ()

    def finish(self, t: float) -> None:
        """Notes that the law computed further ticks without `begin`.

        Args:
            t: s, the time of the next tick.
        """
        super().finish(t)
        if has_compiled_law(self.controller, self.n):
            self.controller.finish(t)

    @explains_wrong_arguments
    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque for the coming control period.

        Returns:
            (n,) N m.
        """
        if self.is_compiled:
            return super().torque(state, setpoint)
        tau = vector("torque", self.controller.torque(state, setpoint), self.n, finite=False).copy()
        instance("state", state, State, "armctl.State(q, v) is one")
        period = (state.dt, state.continuous)
        if self._period != period:
            # A controller without compiled law is replaced by PD of unit stiffness, whose reference is its torque.
            given = _core.PD(stiffness=np.ones(self.n), damping=np.zeros(self.n))
            self._replace_law(self._around(given, state.dt), period)
        nothing = np.zeros((5, self.n))
        super().begin(state).torque(nothing[0], nothing[0], np.vstack([tau, nothing[1:]]), nothing[0], tau)
        return tau
