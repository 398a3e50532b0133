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
_STABLE_RATIO = 2.1  # stable with so many times the inertia ratio of the design; 2 with a reserve for sampling


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
def integral_gains(dt: float, delay_margin: float, continuous: bool, inertia_ratio: float) -> IntegralGains:
    """The highest gains with a delay margin, on the unit mass that computed torque makes of every joint.

    Minimizes the weighted squares of the error, its integral and its rate (Anderson and Moore, Optimal Control: Linear
    Quadratic Methods, 1990, 3.3). The weights leave two unknowns: the bandwidth, which the delay margin determines, and the
    share of the integral. An unknown payload divides the loop gain by the ratio in which it multiplies the inertia, and a loop
    with an integral becomes unstable where its gain is too low, so the share falls with this ratio.

    Args:
        dt: s, the control period; 0 for continuous time.
        delay_margin: s, above 0; at least two and a half control periods are used.
        continuous: Whether the mass moves continuously during the control period.
        inertia_ratio: The ratio that the gains are designed for, at least 1; they are stable with twice that.
    """
    unit = _unit_gains(inertia_ratio)
    target = _RESERVE * max(delay_margin, MIN_DELAY_MARGIN_TICKS * dt)
    low = 1e-3 / target
    high = 10.0 / target  # without sampling, the delay margin is 0.41 / w
    for _ in range(_BISECTIONS):
        w = math.sqrt(low * high)
        if _delay_margin(_scaled(unit, w), dt, continuous) >= target:
            low = w
        else:
            high = w
    return _scaled(unit, low)


def _scaled(gains: IntegralGains, w: float) -> IntegralGains:
    return IntegralGains(gains.kp * w**2, gains.kd * w, gains.ki * w**3)


def _unit_gains(inertia_ratio: float) -> IntegralGains:
    """The gains at the bandwidth 1 rad/s, with the largest integral gain, at most 1, that is stable with a payload."""
    low = 0.0
    high = 1.0
    gains = _optimal_gains(high)
    for _ in range(_BISECTIONS):
        # A mass r is stable up to r = k_p k_d / k_i (Routh-Hurwitz).
        if gains.kp * gains.kd >= _STABLE_RATIO * inertia_ratio * gains.ki:
            low = gains.ki
        else:
            high = gains.ki
        gains = _optimal_gains(0.5 * (low + high))
    return _optimal_gains(low)


def _optimal_gains(ki: float) -> IntegralGains:
    """The gains of a unit mass that minimize the integral of k_i^2 (integral of e)^2 + 2 e^2 + e'^2 + u^2.

    They satisfy k_d^2 - 2 k_p = 1 and k_p^2 - 2 k_d k_i = 2 (spectral factorization).
    """
    kd = float(max(np.roots([1.0, 0.0, -2.0, -8.0 * ki, -7.0]).real))
    return IntegralGains((kd**2 - 1) / 2, kd, ki)


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
