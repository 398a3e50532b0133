"""Zero-phase low-pass filters for recorded signals, and the choice of their cut-off from the data."""

from functools import lru_cache

import numpy as np

from armctl.core.validation import Array, BoolArray

_ORDER = 4  # of the Butterworth filter; it runs forward and backward, so the total order is 8
_MIN_CUTOFF_HZ = 2.0
_MAX_CUTOFF_HZ = 25.0  # faster parts of a motion are not rigid-body dynamics
MAX_NYQUIST_SHARE = 0.4
_SEGMENT_S = 2.0  # of the spectrum: a frequency resolution of 0.5 Hz
_NOISE_FROM_HZ = 25.0  # robots do not move with higher frequencies
_NOISE_FROM_NYQUIST_SHARE = 0.5  # of the Nyquist frequency, for slow recordings
_NOISE_SHARE = 0.02  # of the RMS acceleration
_PAD_PERIODS = 1.0  # periods of the cut-off by which both ends are extended


def choose_cutoff(positions: Array, dt: float) -> float:
    """The cut-off, Hz, of a zero-phase filter, from the spectrum of positions (T, n) rad recorded every dt s.

    Position noise has the level S of the spectrum (rad^2/Hz) above the motion's frequencies. Up to a cut-off f it becomes
    an acceleration of RMS (2 pi)^2 sqrt(S f^5 / 5). The cut-off is where this is 2 % of the RMS acceleration of the motion:
    the median of all joints, in [2, 25] Hz and at most 40 % of the Nyquist frequency.
    """
    nyquist = 0.5 / dt
    highest = min(_MAX_CUTOFF_HZ, MAX_NYQUIST_SHARE * nyquist)
    moves = np.ptp(positions, axis=0) > 0
    if not moves.any():
        return highest
    f, power, noise = _spectrum(positions[:, moves], dt)
    motion = np.maximum(power - noise, 0.0)
    motion[_is_noise(f, dt)] = 0.0
    acceleration = (motion * (2 * np.pi * f)[:, None] ** 4).sum(axis=0) * f[0]  # mean square
    level = np.maximum(noise * (2 * np.pi) ** 4, np.finfo(float).tiny)
    cutoffs = (5 * _NOISE_SHARE**2 * acceleration / level) ** 0.2
    return float(np.clip(np.median(cutoffs), min(_MIN_CUTOFF_HZ, highest), highest))


def velocity_cutoff(positions: Array, dt: float, noise_rms: float) -> float:
    """The highest cut-off, Hz, at which the velocity of positions (T, n) has at most a noise (RMS, rad/s) in all joints.

    Up to a cut-off f, position noise of the level S of the spectrum (rad^2/Hz) becomes a velocity of RMS 2 pi sqrt(S f^3 / 3).
    """
    highest = MAX_NYQUIST_SHARE * 0.5 / dt
    moves = np.ptp(positions, axis=0) > 0
    if not moves.any():
        return highest
    level = max(float(_spectrum(positions[:, moves], dt)[2].max()), np.finfo(float).tiny)
    return min(highest, float((3 * noise_rms**2 / (4 * np.pi**2 * level)) ** (1 / 3)))


def _spectrum(positions: Array, dt: float) -> tuple[Array, Array, Array]:
    """Frequencies (F,) Hz above 0, the spectrum (F, n) rad^2/Hz of the positions, and the level (n,) of their noise."""
    from scipy.signal import welch

    segment = min(len(positions) - 1, max(8, round(_SEGMENT_S / dt)))
    f, power = welch(np.diff(positions, axis=0) / dt, 1 / dt, nperseg=segment, axis=0)
    f = f[1:]
    power = power[1:] / (2 / dt * np.sin(np.pi * f * dt))[:, None] ** 2
    return f, power, np.median(power[_is_noise(f, dt)], axis=0)


def _is_noise(f: Array, dt: float) -> BoolArray:
    """Which frequencies contain no motion."""
    return f >= min(_NOISE_FROM_HZ, _NOISE_FROM_NYQUIST_SHARE * 0.5 / dt)


def low_pass(columns: Array, cutoff: float, dt: float) -> Array:
    """Columns (T, k), low-pass filtered without delay: a Butterworth filter forward and backward; cutoff in Hz."""
    from scipy.signal import sosfiltfilt

    padding = min(len(columns) - 1, round(_PAD_PERIODS / cutoff / dt))
    return np.asarray(sosfiltfilt(_sections(cutoff, dt), columns, axis=0, padlen=padding), dtype=np.float64)


@lru_cache(maxsize=16)
def _sections(cutoff: float, dt: float) -> Array:
    from scipy.signal import butter

    return np.asarray(butter(_ORDER, cutoff, fs=1 / dt, output="sos"), dtype=np.float64)


def derivatives(positions: Array, dt: float) -> tuple[Array, Array]:
    """Velocity and acceleration (T, n) of filtered positions, by central differences."""
    velocity = np.gradient(positions, dt, axis=0)
    acceleration = np.zeros_like(positions)
    acceleration[1:-1] = (positions[2:] - 2 * positions[1:-1] + positions[:-2]) / dt**2
    acceleration[0] = acceleration[1]
    acceleration[-1] = acceleration[-2]
    return velocity, acceleration
