"""The delay from a command to the torque of a robot, measured with small torques while the arm is held."""

from __future__ import annotations

import numpy as np

from armctl.core.errors import LinkError
from armctl.core.validation import Array, IntArray, array
from armctl.run.links.link import Link
from armctl.run.links.torque_interface import MAX_TORQUE_DELAY_S, TorqueLink
from armctl.run.links.torque_limiter import TorqueLimiter
from armctl.run.links.torque_loop import LinkLaw

_PROBE_S = 0.6
_LONGEST_PROBE_TICKS = 1000
_TORQUE_SHARE = 5e-3  # of the greatest torques
_RATE_SHARE = 0.4  # of the greatest rate: two values in turn differ by twice their size
_MAX_ACCELERATION = 4.0  # rad/s^2, of a joint alone: for one tick, then back
_HOLDING_BANDWIDTH = 4.0  # rad/s, which is stable with 0.1 s of delay
_SEED = 0
_ARRIVED_SHARE = 0.9  # of a command's effect, after which it counts as arrived
_MIN_EFFECT = 0.1  # of a command, in the torque that is measured
_JITTER_SHARE = 0.99  # of the ticks, in which torques are not older than the delay
_MATCH_SHARE = 0.05  # of the size of the commands, by which a torque may differ from the command that it follows
_MATCHED_SHARE = 0.7  # of the ticks, in which a command is found
_LEAST_SHARE = 0.05  # of the greatest response; less is left out
_NOISE_FACTOR = 6.0  # on the median response, which is noise: most lags have none


def measured_delay(torques: TorqueLink, link: Link, law: LinkLaw) -> float:
    """s, from a command to the torque, besides the tick in which a law computes it, with its jitter.

    While a soft spring holds the arm, random torques are added, each of which is taken back in the next tick. Where measured
    torques equal commands, the delay is the age of these, in 99 of 100 ticks. Else, as behind a filter, the response of the
    torques to a command is found by least squares, and the delay is that after which 90 % of it have come.

    Raises:
        LinkError: The measured torques do not follow the commands.
    """
    arm = law.arm
    dt = link.dt
    bounds = TorqueLimiter(arm, law.interface, dt)
    reading = link.read()
    q0 = reading.q
    inertia = arm.mass_matrix(q0)
    size = np.minimum(_TORQUE_SHARE * law.interface.torque_limits, _MAX_ACCELERATION * np.diag(inertia))
    size = np.minimum(size, _RATE_SHARE * dt * law.interface.rate_limits)
    count = min(round(_PROBE_S / dt), _LONGEST_PROBE_TICKS)
    added = np.repeat(np.random.default_rng(_SEED).uniform(-1.0, 1.0, (count // 2 + 1, arm.n)), 2, axis=0)
    added[1::2] *= -1.0
    sent = np.full((count, arm.n), np.nan)
    measured = np.full((count, arm.n), np.nan)
    torques.start_torques()
    tick = -1
    while tick < count - 1:
        ticks, reading = link.wait()
        if reading.fault:
            raise LinkError(reading.fault)
        if tick < 0:
            bounds.start(reading)
        before = tick
        tick = min(tick + ticks, count - 1)
        if before >= 0:
            sent[before + 1 : tick] = bounds.total  # a robot holds the torques of a tick that is lost
        error = _HOLDING_BANDWIDTH**2 * (q0 - reading.q) - 2.0 * _HOLDING_BANDWIDTH * reading.v
        total = arm.gravity(reading.q) + inertia @ error + size * added[tick]
        torques.send_torques(bounds.to_send(total, reading), tick == count - 1)
        sent[tick] = bounds.total
        measured[tick] = reading.tau
    return dt * delay_ticks(sent, measured, round(MAX_TORQUE_DELAY_S / dt), size)


def delay_ticks(sent: Array, measured: Array, longest: int, size: Array) -> int:
    """The ticks from a command to its torque; (T, n) N m each, NaN where nothing was measured, and (n,) N m, how they vary.

    Raises:
        LinkError: The measured torques do not follow the commands within `longest` ticks.
        InputError: The arrays have other shapes.
    """
    sent = array("sent", sent, 2, finite=False)
    measured = array("measured", measured, 2, finite=False)
    longest = min(longest + 2, len(sent) // 4)
    ages = _ages(sent, measured, longest, size)
    if len(ages):
        return max(int(np.quantile(ages, _JITTER_SHARE, method="higher")) - 1, 0)
    # Differences over a tick: what the spring adds changes slowly.
    sent = np.diff(sent, axis=0)
    measured = np.diff(measured, axis=0)
    rows = np.arange(longest, len(sent))
    responses = []
    for joint in np.flatnonzero(size > 0.0):
        columns = np.column_stack([sent[rows - lag, joint] for lag in range(longest)])
        known = np.isfinite(columns).all(axis=1) & np.isfinite(measured[rows, joint])
        if known.sum() > 2 * longest:
            responses.append(np.linalg.lstsq(columns[known], measured[rows, joint][known], rcond=None)[0])
    if not responses:
        raise LinkError(
            "the delay of the torques cannot be measured: the robot measures no torques; give delay= of its interface"
        )
    response = np.mean(responses, axis=0)
    greatest = float(response.max())
    noise = _NOISE_FACTOR * float(np.median(np.abs(response)))
    if greatest < max(_MIN_EFFECT, noise):
        raise LinkError(
            "the delay of the torques cannot be measured: the torques that the robot measures do not follow its commands "
            f"within {longest} ticks; give delay= of its interface"
        )
    response[response < max(noise, _LEAST_SHARE * greatest)] = 0.0
    arrived = np.cumsum(response) / response.sum()
    first = int(np.flatnonzero(arrived >= _ARRIVED_SHARE)[0])
    return max(first - 1, 0)


def _ages(sent: Array, measured: Array, longest: int, size: Array) -> IntArray:
    """(k,) ticks, how old the command is that each torque follows; empty if most torques follow no single command."""
    rows = np.arange(longest, len(sent))
    if not np.isfinite(measured[rows]).any(axis=0).all():
        return np.zeros(0, dtype=int)
    offset = np.nanmean(measured[rows], axis=0) - np.nanmean(sent[rows], axis=0)
    distance = np.stack([np.linalg.norm(measured[rows] - sent[rows - age] - offset, axis=1) for age in range(longest)])
    distance[~np.isfinite(distance)] = np.inf
    is_matched = distance.min(axis=0) < _MATCH_SHARE * np.linalg.norm(size)
    known = np.isfinite(distance).any(axis=0)
    if is_matched.sum() < max(1, _MATCHED_SHARE * known.sum()):
        return np.zeros(0, dtype=int)
    return distance.argmin(axis=0)[is_matched]
