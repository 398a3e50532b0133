"""Gains of the disturbance observer: the torque that, besides the commanded one, explains the motion of the last tick.

The observer has three stages. The commanded acceleration predicts position and velocity of each joint; the measured position
corrects both (two equal poles). The inverse dynamics of the estimated motion minus the commanded torque is a disturbance, after
Ohnishi, Shibata, Murakami, "Motion control for advanced mechatronics" (1996). A low-pass of first order smoothes it. The law is
in `computed_torque_observer_kernel`.

An estimated velocity has much less noise than the difference of two measured positions, and it is late by less than that
difference behind a low-pass of the same noise; see Friedland, Control System Design (1986), chapter 8.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import expm1

from armctl.control.gains import max_locked_inertia, required_delay
from armctl.robot.arm import Arm

# rad. A faster low-pass has a delay margin of less than two control periods with any other gains.
MAX_BANDWIDTH_TIMES_DT = 0.3
# Bandwidth of the estimated velocity x required delay. A slower one raises the peak sensitivity, a faster one gains nothing.
_MIN_ESTIMATE = 2.85
_MAX_ESTIMATE = 9.0
# rad/s^2. Noise is a share of the motors' torque: where they accelerate the arm less than this, the estimate is the slowest.
_NOISE_ACCELERATION = 23.0


@dataclass(frozen=True, slots=True)
class ObserverGains:
    """Bandwidths of computed torque with an observer.

    Attributes:
        feedback: rad/s, the natural frequency of the error.
        damping_ratio: Of the error.
        estimate: rad/s, of the estimated velocity.
        disturbance: rad/s, of the low-pass of the disturbance.
    """

    feedback: float
    damping_ratio: float
    estimate: float
    disturbance: float


def observer_gains(arm: Arm, dt: float) -> ObserverGains:
    """The bandwidths that suppress slow disturbances best with the required delay margin and a peak sensitivity of 1.6.

    Inverse dynamics make every joint a unit mass, so one design holds for all arms, and all joints have the same gains:
    different ones would couple them. With T the delay of `required_delay`, and the bandwidth of the estimate given,
    optimization yields the others; the formulas fit the results for control periods of 1, 2 and 4 ms.

    Args:
        arm: The arm.
        dt: s, the control period.
    """
    acceleration = float((arm.limits.tau_max / max_locked_inertia(arm)).min())
    estimate = min(max(acceleration / _NOISE_ACCELERATION, 1.0) * _MIN_ESTIMATE, _MAX_ESTIMATE)
    delay = required_delay(dt)
    return ObserverGains(
        feedback=(0.455 - 0.16 / estimate) / delay,
        damping_ratio=0.535 - 0.013 * estimate,
        estimate=estimate / delay,
        disturbance=(0.38 + 0.045 * estimate) / delay,
    )


def low_pass_weight(bandwidth: float, dt: float) -> float:
    """The weight, 0 to 0.26, of the newest value in a low-pass.

    Args:
        bandwidth: rad/s of the low-pass, used if the control period is short enough for it.
        dt: s, the control period.
    """
    return -expm1(-min(bandwidth * dt, MAX_BANDWIDTH_TIMES_DT))


def position_weight(bandwidth: float, dt: float) -> float:
    """The weight of the error of the predicted position in the estimated position.

    Args:
        bandwidth: rad/s of the estimate, whose two poles are equal.
        dt: s, the control period.
    """
    return -expm1(-2 * bandwidth * dt)


def velocity_weight(bandwidth: float, dt: float) -> float:
    """The weight of the error of the predicted position, divided by dt, in the estimated velocity.

    Args:
        bandwidth: rad/s of the estimate, whose two poles are equal.
        dt: s, the control period.
    """
    return expm1(-bandwidth * dt) ** 2
