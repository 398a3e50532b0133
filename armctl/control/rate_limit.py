"""TorqueRateLimit: bounds how fast the torques of another controller change."""

from __future__ import annotations

from collections.abc import Callable
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from armctl.control.gains import gain
from armctl.control.interface import (
    Controller,
    KernelController,
    State,
    checked_period,
    controller_name,
    explains_wrong_arguments,
    has_compiled_law,
)
from armctl.core.errors import InputError
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, shown, vector
from armctl.robot.arm import Arm, check_arm


class TorqueRateLimit(KernelController):
    """A controller with limited torque rates, as the interfaces of many arms require.

    The first torque of a run is not limited.

    Attributes:
        controller: The controller whose torques are limited.
        tau_rate_max: (n,) N m/s.
        name: The name of the controller.
        needs_wrench: Whether the controller needs the wrench.
    """

    def __init__(self, arm: Arm, controller: Controller, tau_rate_max: ArrayLike):
        """A controller with limited torque rates.

        Args:
            arm: The arm.
            controller: The controller whose torques are limited.
            tau_rate_max: (n,) or one number for all joints, N m/s; 1000 N m/s is 1 N m a tick of 1 ms.

        Raises:
            InputError: It is no controller, or a rate is negative, not finite or of the wrong length.
        """
        check_arm(arm)
        super().__init__(arm.n)
        if not callable(getattr(controller, "torque", None)):
            raise InputError(f"controller: {shown(controller)} has no method torque; armctl.PD(arm) is one")
        self.controller = controller
        self.tau_rate_max = gain("tau_rate_max", tau_rate_max, arm.n)
        self.name = controller_name(controller)
        self.needs_wrench = bool(getattr(controller, "needs_wrench", False))

    @property
    def is_compiled(self) -> bool:
        """Whether the law of the controller is a kernel."""
        return has_compiled_law(self.controller, self.n) and type(self).torque is TorqueRateLimit.torque

    @property
    def kernel(self) -> Callable[..., None]:
        """The compiled law, as `KernelController` describes it; it calls the kernel of the controller."""
        from armctl.control.rate_limit_kernel import rate_limited

        return rate_limited

    def parameters(self, dt: float, continuous: bool) -> Array:
        """The constants of a run; `begin` adds the kernel of the controller.

        Args:
            dt: s, the control period.
            continuous: Whether the arm moves continuously during the control period.

        Returns:
            A new vector, the first argument of the kernel.

        Raises:
            InputError: The control period is no number in [0, 1] s, or `continuous` is not True or False.
        """
        from armctl.control.rate_limit_kernel import HEADER

        dt, _ = checked_period(dt, continuous)
        return np.concatenate([np.zeros(HEADER), self.tau_rate_max * dt])

    @property
    def memory_size(self) -> int:
        """How many numbers of memory the kernel needs, besides that of the controller."""
        from armctl.control.rate_limit_kernel import MEMORY_HEADER

        return MEMORY_HEADER + self.n

    def fresh(self) -> Self:
        """The same law with a memory of its own, for a run at the same time."""
        other = super().fresh()
        if has_compiled_law(self.controller, self.n):
            other.controller = self.controller.fresh()
        return other

    def begin(self, state: State) -> tuple[Array, Array]:
        """Prepares for a tick.

        Args:
            state: The measured state.

        Returns:
            The parameters and the memory for the kernel, with the kernel of the controller.

        Raises:
            InputError: It is no `State`.
        """
        parameters, memory = super().begin(state)
        if has_compiled_law(self.controller, self.n):
            from armctl.control.kernel_call import entry_point
            from armctl.control.rate_limit_kernel import HEADER

            called = self.controller.begin(state)
            entries = [entry_point(self.controller.kernel), int(self.needs_wrench)]
            for array in called:  # the controller keeps them
                entries += [array.ctypes.data, len(array)]
            parameters[:HEADER].view(np.int64)[:] = entries
        return parameters, memory

    def finish(self, t: float) -> None:
        """Notes that the kernel computed further ticks, with the arrays that `begin` returned.

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
            state: The measured state.
            setpoint: Where the arm should be.

        Returns:
            (n,) N m.

        Raises:
            InputError: The controller gave no list of n numbers, or an argument is no `State` or no `Setpoint`.
        """
        if self.is_compiled:
            return super().torque(state, setpoint)
        from armctl.control.rate_limit_kernel import HEADER, MEMORY_HEADER, limit_rate

        tau = vector("torque", self.controller.torque(state, setpoint), self.n, finite=False).copy()
        parameters, memory = super().begin(state)
        limit_rate(parameters[HEADER:], memory[MEMORY_HEADER - 1 :], tau)
        return tau
