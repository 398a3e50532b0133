"""Gains of the disturbance observer: the torque that, besides the commanded one, explains the motion of the last tick.

The observer has three stages. The commanded acceleration predicts position and velocity of each joint; the measured position
corrects both (two equal poles). The inverse dynamics of the estimated motion minus the commanded torque is a disturbance, after
Ohnishi, Shibata, Murakami, "Motion control for advanced mechatronics" (1996). A low-pass of first order smoothes it. The law is
in `armctl/cpp/laws/computed_torque_observer.hpp`.

An estimated velocity has much less noise than the difference of two measured positions, and it is late by less than that
difference behind a low-pass of the same noise; see Friedland, Control System Design (1986), chapter 8.
"""

from dataclasses import dataclass
from math import expm1, log
from typing import TypedDict
from weakref import WeakKeyDictionary

import numpy as np

from armctl.control.gains import max_locked_inertia, required_delay, sample_configurations, sampled_inertia
from armctl.core.defaults import MIN_DELAY_MARGIN_S
from armctl.model.arm.arm import Arm

# rad. A faster low-pass has a delay margin of less than two control periods with any other gains.
MAX_BANDWIDTH_TIMES_DT = 0.3
# Bandwidth of the estimated velocity x required delay. A slower one raises the peak sensitivity, a faster one gains little.
_MIN_ESTIMATE = 2.7
_MAX_ESTIMATE = 9.0
# A slower estimate of the velocity takes damping from the feedback.
_MIN_ESTIMATE_PER_FEEDBACK = 5.0
# rad/s^2. Noise is a share of the motors' torque: where they accelerate the arm less than this, the estimate is the slowest.
_NOISE_ACCELERATION = 23.0
# Slower gains leave a larger share to the damping of the joints, which costs some delay margin. The exponent of the ratio to
# 5 ms.
_LONG_DELAY_RESERVE = 0.05
# Payloads that multiply the inertia more than this are left out: the lower gains that they need track worse with all others.
MAX_INERTIA_RATIO = 4.0
PAYLOAD_LEVER_M = 0.05  # beside the tip, where a payload multiplies the small inertia of a light wrist

_inertia_ratios: WeakKeyDictionary[Arm, float] = WeakKeyDictionary()  # computed once per arm


@dataclass(frozen=True, slots=True)
class ObserverGains:
    """Bandwidths of computed torque with an observer."""

    feedback: float  # rad/s, the natural frequency of the error
    damping_ratio: float  # of the error
    estimate: float  # rad/s, of the estimated velocity
    disturbance: float  # rad/s, of the low-pass of the disturbance


def observer_gains(arm: Arm, dt: float, delay_margin: float = MIN_DELAY_MARGIN_S) -> ObserverGains:
    """The bandwidths that suppress disturbances best with sufficient margins, with and without an unknown payload.

    Inverse dynamics make every joint a unit mass, so one design holds for all arms, and all joints have the same gains:
    different ones would couple them. A payload divides the loop gain by the ratio in which it multiplies the inertia. The error
    after a step of torque and that of a slow motion are minimal subject to the required delay margin and a peak sensitivity of
    1.6 without payload, a peak sensitivity of 2 with the ratio of `max_inertia_ratio`, and stability with twice that ratio.
    With T the delay of `required_delay`, the formulas fit the results of that optimization for ratios of 1.2 to 4 and control
    periods of 1, 2 and 4 ms.
    """
    estimate = _estimate(arm)
    ratio = max_inertia_ratio(arm)
    delay = required_delay(dt, delay_margin) * max(1.0, delay_margin / MIN_DELAY_MARGIN_S) ** _LONG_DELAY_RESERVE
    disturbance = 0.717 - 0.243 / ratio - 0.156 / estimate
    feedback = 0.57 - 0.194 * log(ratio) - 0.384 / estimate
    return ObserverGains(
        feedback=feedback / delay,
        damping_ratio=0.5 * disturbance / feedback,
        estimate=estimate / delay,
        disturbance=disturbance / delay,
    )


def feedback_estimate(arm: Arm, dt: float, bandwidth: float) -> float:
    """The bandwidth, rad/s, of the estimated velocity for feedback, also in rad/s, without an observer of disturbances."""
    return max(_estimate(arm) / required_delay(dt), _MIN_ESTIMATE_PER_FEEDBACK * bandwidth)


def _estimate(arm: Arm) -> float:
    """The bandwidth of the estimated velocity x the required delay."""
    acceleration = float((arm.limits.tau_max / max_locked_inertia(arm)).min())
    return min(max(acceleration / _NOISE_ACCELERATION, 1.0) * _MIN_ESTIMATE, _MAX_ESTIMATE)


def max_inertia_ratio(arm: Arm) -> float:
    """How much an unknown payload may multiply the inertia of the arm in some direction of motion, 1 to 4.

    As much as the largest payload at the tip that the motors hold at all sampled configurations, but at most 4. A payload
    multiplies the inertia by 1 + its mass / effective mass of the tip (Khatib, "A unified approach for motion and force control
    of robot manipulators", 1987).
    """
    if arm not in _inertia_ratios:
        _inertia_ratios[arm] = min(1 + max_held_payload(arm) / min_effective_mass(arm, 0.0), MAX_INERTIA_RATIO)
    return _inertia_ratios[arm]


def max_unknown_payload(arm: Arm) -> float:
    """The unknown payload, kg, a point mass within 5 cm of the tip, up to which no inertia exceeds that of the design."""
    return (max_inertia_ratio(arm) - 1) * min_effective_mass(arm, PAYLOAD_LEVER_M)


def min_effective_mass(arm: Arm, lever: float) -> float:
    """The least mass, kg, that a force on a point beside the tip, at a lever in m, has to accelerate.

    Over `sample_configurations`, directions, and points along the axes of the world.
    """
    offsets = lever * np.vstack([np.eye(3), -np.eye(3)])
    largest = np.finfo(float).tiny
    for q, mobility in zip(sample_configurations(arm), sampled_inertia(arm).mobility, strict=True):
        J = arm.jacobian(q)
        points = np.array([J[:3] - np.cross(offset, J[3:], axisb=0, axisc=0) for offset in offsets])
        largest = max(largest, float(np.linalg.eigvalsh(points @ mobility @ points.transpose(0, 2, 1)).max()))
    return 1 / largest


def max_held_payload(arm: Arm) -> float:
    """The largest mass, kg, at the tip that the motors hold at all `sample_configurations`; infinite without gravity."""
    largest = np.inf
    for q in sample_configurations(arm):
        per_kg = np.abs(arm.jacobian(q)[:3].T @ arm.model.opt.gravity)
        reserve = np.maximum(arm.limits.tau_max - np.abs(arm.gravity(q)), 0.0)
        largest = min(largest, float(np.min(reserve[per_kg > 0] / per_kg[per_kg > 0], initial=np.inf)))
    return largest


def low_pass_weight(bandwidth: float, dt: float) -> float:
    """The weight, 0 to 0.26, of the newest value in a low-pass: of so many rad/s if the control period is short enough."""
    return -expm1(-min(bandwidth * dt, MAX_BANDWIDTH_TIMES_DT))


class EstimateWeights(TypedDict):
    """How much the error of the predicted position corrects the estimated position and velocity, as arguments of a law."""

    position_weight: float
    velocity_weight: float


def estimate_weights(bandwidth: float, dt: float) -> EstimateWeights:
    """The weights for a bandwidth, rad/s, of the estimate, whose two poles are equal."""
    return {"position_weight": -expm1(-2 * bandwidth * dt), "velocity_weight": expm1(-bandwidth * dt) ** 2}
