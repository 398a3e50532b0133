"""TorqueFilter: notches and low-passes for the torques of another controller; TorqueRateLimit: bounds how fast they change."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armctl import _core
from armctl.control.controller_around import ControllerAround
from armctl.control.gain_attribute import Gain, joint_gain
from armctl.control.interface import Controller
from armctl.core.errors import InputError
from armctl.core.validation import Array, integer, number, shown
from armctl.model.arm.arm import Arm

_MAX_ORDER = 8
_MAX_FREQUENCY = 1e5  # rad/s
_MAX_FILTERS = 16


@dataclass(frozen=True)
class Notch:
    """A notch: torques of one frequency are removed, such as that of an elastic joint.

    Attributes:
        frequency: rad/s.
        quality: The frequency over the width of the notch at -3 dB. A wide notch forgives a wrong frequency, and delays more.
    """

    frequency: float
    quality: float = 2.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "frequency", number("frequency", self.frequency, 1e-3, _MAX_FREQUENCY))
        object.__setattr__(self, "quality", number("quality", self.quality, 0.1, 100.0))

    def sections(self, dt: float) -> Array:
        """Its second-order sections for a control period, by `scipy.signal.iirnotch`.

        Args:
            dt: s, the control period.

        Returns:
            (1, 6): b0, b1, b2, a0 = 1, a1, a2.
        """
        from scipy.signal import iirnotch

        b, a = iirnotch(_checked_frequency(self, self.frequency, dt), self.quality, fs=2 * math.pi / dt)
        return np.concatenate([b, a], dtype=np.float64)[None]


@dataclass(frozen=True)
class LowPass:
    """A Butterworth low-pass: noise above a frequency is removed.

    Attributes:
        frequency: rad/s, at -3 dB.
        order: Of the filter.
    """

    frequency: float
    order: int = 2

    def __post_init__(self) -> None:
        object.__setattr__(self, "frequency", number("frequency", self.frequency, 1e-3, _MAX_FREQUENCY))
        object.__setattr__(self, "order", integer("order", self.order, 1, _MAX_ORDER))

    def sections(self, dt: float) -> Array:
        """Its second-order sections for a control period, by `scipy.signal.butter`.

        Args:
            dt: s, the control period.

        Returns:
            (k, 6): rows of b0, b1, b2, a0 = 1, a1, a2.
        """
        from scipy.signal import butter

        frequency = _checked_frequency(self, self.frequency, dt)
        return np.asarray(butter(self.order, frequency, fs=2 * math.pi / dt, output="sos"), dtype=np.float64)


def _filters(name: str, value: Any, _n: int) -> tuple[Notch | LowPass, ...]:
    filters = tuple(value) if isinstance(value, Sequence) else (value,)
    if not 1 <= len(filters) <= _MAX_FILTERS:
        raise InputError(f"{name}: expected 1 to {_MAX_FILTERS} filters, got {len(filters)}")
    for each in filters:
        if not isinstance(each, (Notch, LowPass)):
            raise InputError(f"{name}: {shown(each)} is no filter; armctl.Notch(50.0) and armctl.LowPass(300.0) are two")
    return filters


class TorqueFilter(ControllerAround):
    """A controller whose torques go through filters, in series, the same for all joints.

    A run begins with filters that are settled at its first torque.
    """

    filters: Gain[tuple[Notch | LowPass, ...]] = Gain(_filters)

    def __init__(self, arm: Arm, controller: Controller, filters: Notch | LowPass | Sequence[Notch | LowPass]):
        """A controller with filtered torques.

        Args:
            controller: The controller whose torques are filtered.
            filters: A notch or a low-pass, or several in series, the first one first.
        """
        super().__init__(arm, controller)
        self.filters = filters

    def sections(self, dt: float) -> Array:
        """The second-order sections of all filters for a control period.

        Args:
            dt: s, the control period.

        Returns:
            (k, 6): rows of b0, b1, b2, a0 = 1, a1, a2, as in `scipy.signal.sosfilt`.

        Raises:
            InputError: A frequency is not below the Nyquist frequency, or the control period is 0.
        """
        return np.concatenate([each.sections(dt) for each in self.filters])

    def _around(self, inner: _core.Law, dt: float) -> _core.Law:
        return _core.TorqueFilter(inner, sections=self.sections(dt))


def _checked_frequency(filter_: Notch | LowPass, frequency: float, dt: float) -> float:
    """A frequency that a filter with this control period can have."""
    highest = math.pi / dt if number("dt", dt, 0.0) > 1e-12 else 0.0
    if not frequency < highest:
        raise InputError(f"{filter_}: the frequency must be below pi / dt = {highest:g} rad/s")
    return frequency


class TorqueRateLimit(ControllerAround):
    """A controller with limited torque rates, as the interfaces of many arms require.

    The first torque of a run is not limited.
    """

    tau_rate_max: Gain[Array] = joint_gain()

    def __init__(self, arm: Arm, controller: Controller, tau_rate_max: ArrayLike):
        """A controller with limited torque rates.

        Args:
            controller: The controller whose torques are limited.
            tau_rate_max: (n,) or one number for all joints, N m/s; 1000 N m/s is 1 N m a tick of 1 ms.
        """
        super().__init__(arm, controller)
        self.tau_rate_max = tau_rate_max

    def _around(self, inner: _core.Law, dt: float) -> _core.Law:
        return _core.TorqueRateLimit(inner, tau_rate_max=self.tau_rate_max, dt=dt)
