"""The base of the shipped controllers: a kernel whose parameters are constants and the arm's model."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import numpy as np

from armctl.control.interface import KernelController, checked_period
from armctl.core.validation import Array
from armctl.robot.arm import Arm, check_arm


class ArmController(KernelController):
    """A controller for an arm. Behind its own memory, the kernel has scratch memory of the model."""

    _has_model = True

    def __init__(self, arm: Arm):
        """A controller whose memory is empty.

        Args:
            arm: The arm.
        """
        check_arm(arm)
        super().__init__(arm.n)
        self._arm = arm

    @property
    def memory_size(self) -> int:
        """How many numbers of memory the kernel needs, with scratch."""
        return self._own_memory_size() + (self._arm.packed_dynamics.work_size() if self._has_model else 0)

    def parameters(self, dt: float, continuous: bool) -> Array:
        """The constants of a run: gains and limits, then the model.

        Args:
            dt: s, the control period.
            continuous: Whether the arm moves continuously during the control period.

        Returns:
            A new vector, the first argument of the kernel.

        Raises:
            InputError: The control period is no number in [0, 1] s, or `continuous` is not True or False.
        """
        dt, continuous = checked_period(dt, continuous)
        parts = [*self._constants(dt, continuous)]
        if self._has_model:
            parts.append(self._packed_model(dt, continuous))
        return np.concatenate(parts, dtype=np.float64)

    @abstractmethod
    def _constants(self, dt: float, continuous: bool) -> Sequence[Array | Sequence[float]]:
        """The parameters before the model, in parts."""

    def _packed_model(self, dt: float, continuous: bool) -> Array:
        """The model that the law inverts."""
        return self._arm.packed_dynamics.vector(dt, continuous)

    def _own_memory_size(self) -> int:
        """How many numbers of memory the kernel needs besides scratch of the model."""
        return 0
