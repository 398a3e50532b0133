"""Envelope: the limits that a maker publishes, checked on the samples that will be sent."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from armctl.core.limits import Limits, check_speed
from armctl.core.validation import Array, instance, integer, matrix, number

# Shares of the maker's limits that motions are planned with. The rest is for a lost tick: the robot continues the last samples,
# and the next one is then a step of acceleration.
_PLANNED_V = 0.9
_PLANNED_A = 0.6
_PLANNED_J = 0.6
_CHECKED = 1.0 - 1e-3  # share of the maker's limits on a, j that a sample may use: differences of float32 positions are noisy
_TICK_S = 1e-3  # half of the longest tick of a robot whose velocity limits depend on the position
_SPEED_MARGIN = 1e-3  # rad/s below the maker's limits on v, as in libfranka's rate limiter


@dataclass(frozen=True, eq=False)
class Envelope:
    """What a maker publishes for a stream of joint positions.

    Attributes:
        source: Where it is published.
        limits: The limits of positions, and of the differences of positions over ticks; also those that depend on the sign or,
            near the ends of the joints' ranges, on the position.
    """

    source: str
    limits: Limits

    def planning_limits(self, arm: Limits, speed: float) -> Limits:
        """The limits that motions are planned with: the smaller ones of maker and model, with a margin.

        Args:
            arm: The limits of the model.
            speed: Share of the full speed, in (0, 1]. It also scales acceleration and jerk, so that a stop takes as long at
                any speed.

        Raises:
            InputError: The speed is not in (0, 1], or these are no limits.
        """
        instance("arm", arm, Limits, "armctl.load('panda').limits are some")
        speed = check_speed(speed)
        maker = self.limits
        signs = {}
        if arm.depends_on_sign or maker.depends_on_sign:
            signs["v_min"] = speed * np.maximum(arm.v_low, _PLANNED_V * maker.v_low)
            signs["a_min"] = speed * np.maximum(arm.a_low, _PLANNED_A * maker.a_low)
        ends = {}
        if maker.depends_on_position:
            # The mean velocity of a tick is larger than that at its end, with whose position it is compared.
            margin = np.where(np.isfinite(maker.deceleration_limit), _SPEED_MARGIN + _TICK_S * maker.deceleration_limit, 0.0)
            ends["velocity_offset"] = np.maximum(arm.velocity_offset, maker.velocity_offset + margin)
            ends["deceleration_limit"] = np.minimum(arm.deceleration_limit, maker.deceleration_limit)
        return replace(
            arm,
            q_min=np.maximum(arm.q_min, maker.q_min),
            q_max=np.minimum(arm.q_max, maker.q_max),
            v_max=speed * np.minimum(arm.v_max, _PLANNED_V * maker.v_max),
            a_max=speed * np.minimum(arm.a_max, _PLANNED_A * maker.a_max),
            j_max=speed * np.minimum(arm.j_max, _PLANNED_J * maker.j_max),
            **signs,
            **ends,
        )

    def speed_limits(self, q: Array) -> tuple[Array, Array]:
        """The velocities that are allowed at positions.

        Args:
            q: (n,) or (T, n) rad.

        Returns:
            The lowest and the highest ones, each of the same shape, rad/s.

        Raises:
            InputError: The positions are not numbers, or not of n joints.
        """
        lowest, highest = self.limits.velocity_bounds(q)
        return lowest + _SPEED_MARGIN, highest - _SPEED_MARGIN

    def refusal(self, samples: Array, before: Array, dt: float) -> str:
        """Why samples must not be sent; empty if they may.

        Args:
            samples: (T, n) rad, one each tick.
            before: (3, n) rad, what was sent before them.
            dt: s, the tick.

        Raises:
            InputError: An argument has another shape, or the tick is not above 0.
        """
        samples = matrix("samples", samples, len(self.limits.q_min), finite=False)
        before = matrix("before", before, len(self.limits.q_min), finite=False)
        integer("before: samples", len(before), 3, 3)
        q = np.vstack([before, samples])
        dt = number("dt", dt, 1e-9)
        v = np.diff(q, axis=0) / dt
        a = np.diff(v, axis=0) / dt
        j = np.diff(a, axis=0) / dt
        v = v[2:]
        a = a[1:]
        limits = self.limits
        low, high = self.speed_limits(samples)
        still = v == 0.0  # a joint may stand where the maker allows no speed
        outside = {
            "is at {:.4g} rad, outside [{:.4g}, {:.4g}]": (samples, limits.q_min, limits.q_max),
            "moves at {:.4g} rad/s, outside [{:.4g}, {:.4g}]": (v, np.where(still, 0.0, low), np.where(still, 0.0, high)),
            "accelerates at {:.4g} rad/s^2, outside [{:.4g}, {:.4g}]": (a, _CHECKED * limits.a_low, _CHECKED * limits.a_max),
            "has a jerk of {:.4g} rad/s^3, outside [{:.4g}, {:.4g}]": (j, -_CHECKED * limits.j_max, _CHECKED * limits.j_max),
        }
        first = len(samples)
        reason = ""
        for words, (values, lowest, highest) in outside.items():
            lowest = np.broadcast_to(lowest, values.shape)
            highest = np.broadcast_to(highest, values.shape)
            wrong = ~((values >= lowest) & (values <= highest))
            tick = int(wrong.any(axis=1).argmax())
            if wrong.any() and tick < first:
                first = tick
                joint = int(wrong[tick].argmax())
                figures = words.format(values[tick, joint], lowest[tick, joint], highest[tick, joint])
                reason = f"joint {joint + 1} {figures} at {tick * dt:.3f} s ({self.source})"
        return reason


def envelope_of(limits: Limits, source: str) -> Envelope:
    """An envelope for a robot whose maker publishes none: the limits of its model are what motions are planned with."""
    return Envelope(
        source,
        replace(
            limits,
            v_max=limits.v_max / _PLANNED_V,
            a_max=limits.a_max / _PLANNED_A,
            j_max=limits.j_max / _PLANNED_J,
            v_min=limits.v_min / _PLANNED_V,
            a_min=limits.a_min / _PLANNED_A,
        ),
    )
