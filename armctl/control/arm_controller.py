"""The base of the shipped controllers."""

from __future__ import annotations

from abc import abstractmethod
from typing import Self

from armctl import _core
from armctl.control.interface import CompiledController, checked_period
from armctl.core.other_names import check_keywords
from armctl.robot.arm import Arm, check_arm


class ArmController(CompiledController):
    """A controller for an arm."""

    def __new__(cls, *args: object, **keywords: object) -> Self:
        """A controller, not yet constructed; a TypeError says which keyword it does not take."""
        check_keywords(cls, keywords)
        return super().__new__(cls)

    def __init__(self, arm: Arm):
        """A controller at the start of a run."""
        check_arm(arm)
        super().__init__(arm.n)
        self._arm = arm

    def make_law(self, dt: float, continuous: bool) -> _core.Law:
        """A law with the present gains, at the start of a run.

        Args:
            dt: s, the control period; 0 means continuous time.
            continuous: Whether the arm moves continuously during the control period.
        """
        return self._make_law(*checked_period(dt, continuous))

    @abstractmethod
    def _make_law(self, dt: float, continuous: bool) -> _core.Law:
        """`make_law` with checked arguments."""

    def _model(self, dt: float, continuous: bool) -> _core.ArmModel:
        return self._arm.core_model.for_period(dt, continuous)
