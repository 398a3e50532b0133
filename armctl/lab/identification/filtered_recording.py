"""FilteredRecording: a recording through the filters of a fit, with fewer samples."""

import numpy as np

from armctl.core.filtering import choose_cutoff, derivatives, low_pass
from armctl.core.log import Log
from armctl.core.validation import Array, BoolArray, IntArray
from armctl.lab.identification.fit_samples import speeds_of_torques
from armctl.model.arm.dynamics import Dynamics
from armctl.model.arm.passive_forces import DryFriction

_REGRESSOR_SAMPLES_PER_PERIOD = 8  # of the cut-off: products of positions and velocities have higher frequencies
ROWS_PER_PERIOD = 4
TRIMMED_PERIODS = 1.0  # at both ends, where the filter has no data on one side
_REVERSAL_PERIODS = 0.5  # of the cut-off: the filter spreads a reversal over this time on both sides


class FilteredRecording:
    """Positions, speeds and torques of a recording of n joints.

    A fit passes everything through the same filter twice: `filtered` what depends on the recorded speeds, which are not
    decimated, and `filtered_again` what has been, K samples.
    """

    def __init__(self, log: Log, dynamics: Dynamics, law: DryFriction | None):
        """Filters a recording of an arm; `law` is MuJoCo's law of its dry friction, if that is known."""
        self.dt = log.dt  # s
        self.cutoff = choose_cutoff(log.q, log.dt)  # Hz
        q = low_pass(log.q, self.cutoff, log.dt)
        v, a = derivatives(q, log.dt)
        white = np.diff(log.tau, axis=0).std(axis=0) / np.sqrt(2)
        self.torque_noise = white * np.sqrt(min(1.0, 2 * self.cutoff * log.dt))  # (n,) N m, RMS of the filtered white noise
        self.stride = max(1, int(1 / (_REGRESSOR_SAMPLES_PER_PERIOD * self.cutoff * log.dt)))
        speeds = speeds_of_torques(law, dynamics, log, q, v, a)
        self.q = q[:: self.stride]  # (K, n) rad
        self.v = v[:: self.stride]  # (K, n) rad/s
        self.a = a[:: self.stride]  # (K, n) rad/s^2
        self.v_start = speeds.start[:: self.stride]  # (K, n) rad/s, of Coriolis torques
        self.v_end = speeds.end[:: self.stride]  # (K, n) rad/s, of damping
        self.v_dry = speeds.dry  # (T, n) rad/s, of dry friction
        self._t = log.t
        self._tau = low_pass(log.tau, self.cutoff, log.dt)

    def __len__(self) -> int:
        return len(self.q)

    @property
    def t(self) -> Array:
        """(K,) s."""
        return self._t[:: self.stride][: len(self)]

    @property
    def rows(self) -> slice:
        """The samples of the K that are almost independent."""
        trimmed = int(TRIMMED_PERIODS / self.cutoff / (self.dt * self.stride)) + 1
        return slice(trimmed, len(self) - trimmed, max(1, round(_REGRESSOR_SAMPLES_PER_PERIOD / ROWS_PER_PERIOD)))

    def first_rows(self, count: int) -> IntArray:
        return np.arange(self.rows.start, self.rows.stop, self.rows.step)[:count]

    def filtered(self, columns: Array) -> Array:
        """(K, k): columns (T, k) that depend on velocities through the filter that the positions have passed."""
        return low_pass(columns, self.cutoff, self.dt)[:: self.stride]

    def filtered_again(self, columns: Array) -> Array:
        """Columns (K, k) through the filter that the torques have passed, too."""
        return low_pass(columns, self.cutoff, self.dt * self.stride)

    def torques(self, delay: float) -> Array:
        """(K, n) N m, through both filters, that were recorded `delay` s later than positions."""
        twice = low_pass(self._tau, self.cutoff, self.dt)
        return np.column_stack([np.interp(self.t + delay, self._t, column) for column in twice.T])

    def slides(self, j: int, speed: float) -> BoolArray:
        """(K,) whether a joint is faster than a speed, and stays so for as long as the filter looks."""
        from scipy.ndimage import binary_dilation

        slow = np.abs(self.v[:, j]) < speed
        reach = round(_REVERSAL_PERIODS * _REGRESSOR_SAMPLES_PER_PERIOD)
        return ~np.asarray(binary_dilation(slow, np.ones(2 * reach + 1, bool)), dtype=np.bool_)
