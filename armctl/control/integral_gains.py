"""Gains of computed torque with integral action, by linear-quadratic optimal control, for a given delay margin."""

from __future__ import annotations

import cmath
import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

MIN_DELAY_MARGIN_TICKS = 2.5
_RESERVE = 1.045  # the loop of an arm with unmodelled effects of sampling has up to 4 % less than that of a unit mass
_BISECTIONS = 50
# The optimal gains of a unit mass for the cost  integral of w^6 (integral of e)^2 + 2 w^4 e^2 + w^2 e'^2 + u^2  are
# k_i = w^3, k_p = KP w^2, k_d = KD w with k_d^2 - 2 k_p = 1 and k_p^2 - 2 k_d k_i = 2 at w = 1 (spectral factorization).
_KD = float(max(np.roots([1.0, 0.0, -2.0, -8.0, -7.0]).real))
_KP = (_KD**2 - 1) / 2


class IntegralGains(NamedTuple):
    """Feedback gains of a unit mass.

    Attributes:
        kp: 1/s^2.
        kd: 1/s.
        ki: 1/s^3.
    """

    kp: float
    kd: float
    ki: float


@lru_cache(maxsize=64)
def integral_gains(dt: float, delay_margin: float, continuous: bool) -> IntegralGains:
    """The highest gains with a delay margin, on the unit mass that computed torque makes of every joint.

    Minimizes the weighted squares of the error, its integral and its rate (Anderson and Moore, Optimal Control: Linear
    Quadratic Methods, 1990, 3.3). The weights leave one unknown, the bandwidth w, which the delay margin determines.

    Args:
        dt: s, the control period; 0 for continuous time.
        delay_margin: s, above 0; at least two and a half control periods are used.
        continuous: Whether the mass moves continuously during the control period.

    Returns:
        The gains.
    """
    target = _RESERVE * max(delay_margin, MIN_DELAY_MARGIN_TICKS * dt)
    low = 1e-3 / target
    high = 10.0 / target  # without sampling, the delay margin is 0.41 / w
    for _ in range(_BISECTIONS):
        w = math.sqrt(low * high)
        if _delay_margin(_gains(w), dt, continuous) >= target:
            low = w
        else:
            high = w
    return _gains(low)


def _gains(w: float) -> IntegralGains:
    return IntegralGains(_KP * w**2, _KD * w, w**3)


def _delay_margin(gains: IntegralGains, dt: float, continuous: bool) -> float:
    """The delay margin, s, of the loop of a unit mass, whose gain falls with frequency; 0 if it is unstable."""
    low = 1e-3 * gains.kd
    high = 1e3 * gains.kd if dt == 0.0 else math.pi / dt
    if abs(_loop(gains, high, dt, continuous)) >= 1.0:
        return 0.0
    for _ in range(_BISECTIONS):
        w = math.sqrt(low * high)
        if abs(_loop(gains, w, dt, continuous)) >= 1.0:
            low = w
        else:
            high = w
    return max(0.0, cmath.phase(-_loop(gains, low, dt, continuous)) / low)


def _loop(gains: IntegralGains, w: float, dt: float, continuous: bool) -> complex:
    """The loop transfer function at a frequency w, rad/s: the mass, and the sum of past errors."""
    if dt == 0.0:
        integrator = 1 / (1j * w)
        position = integrator**2
    else:
        z = cmath.exp(1j * w * dt)
        integrator = dt / (z - 1)
        # MuJoCo moves the mass by the velocity at the end of the step, a continuous motion by the mean.
        position = integrator**2 * ((z + 1) / 2 if continuous else z)
    return (gains.kp + gains.ki * integrator) * position + gains.kd * integrator
