"""Filters of recorded signals have the response of the textbook, and their cut-offs leave the noise that they say."""

import numpy as np
import pytest
from scipy.signal import butter, filtfilt, freqz

from armctl.core.filtering import choose_cutoff, derivatives, low_pass, velocity_cutoff

DT = 0.002
T = np.arange(20_000) * DT


def band_rms(x: np.ndarray, cutoff: float, order: int) -> float:
    """The RMS of a derivative of a signal without what is above a frequency in Hz, by its Fourier transform."""
    f = np.fft.rfftfreq(len(x), DT)
    spectrum = np.fft.rfft(x) * (f <= cutoff) * (2 * np.pi * f) ** order
    return float(np.sqrt(2.0 * np.sum(np.abs(spectrum) ** 2)) / len(x))


@pytest.mark.parametrize("frequency", [1.0, 6.0, 10.0, 14.0])
def test_the_gain_at_each_frequency_is_the_squared_one_of_a_butterworth_filter_and_there_is_no_delay(frequency):
    b, a = butter(4, 10.0, fs=1 / DT)
    gain = np.abs(freqz(b, a, [frequency], fs=1 / DT)[1][0]) ** 2
    wave = np.sin(2 * np.pi * frequency * T)
    inside = slice(5000, 15_000)
    assert low_pass(wave[:, None], 10.0, DT)[inside, 0] == pytest.approx(gain * wave[inside], abs=1e-4)


def test_recordings_are_filtered_as_by_scipys_filtfilt():
    columns = np.random.default_rng(0).normal(size=(3000, 2)).cumsum(axis=0)
    b, a = butter(4, 20.0, fs=1 / DT)
    inside = slice(500, -500)
    expected = filtfilt(b, a, columns, axis=0)
    assert low_pass(columns, 20.0, DT)[inside] == pytest.approx(expected[inside], abs=1e-6)


@pytest.mark.parametrize("noise_rms", [0.001, 0.004, 0.016])
def test_up_to_the_velocity_cutoff_the_noise_of_the_velocity_has_the_rms_that_is_asked_for(noise_rms):
    rng = np.random.default_rng(1)
    noise = 1e-4 * rng.normal(size=len(T))
    cutoff = velocity_cutoff((np.sin(T) + noise)[:, None], DT, noise_rms)
    assert band_rms(noise, cutoff, 1) == pytest.approx(noise_rms, rel=0.15)


@pytest.mark.parametrize("noise_size", [3e-5, 1e-4, 3e-4])
def test_up_to_the_cutoff_of_positions_the_noise_of_the_acceleration_is_two_percent_of_the_motions(noise_size):
    noise = noise_size * np.random.default_rng(2).normal(size=len(T))
    motion = 0.02 * np.sin(2 * np.pi * 2.0 * T)
    cutoff = choose_cutoff((motion + noise)[:, None], DT)
    assert 2.0 < cutoff < 25.0
    assert band_rms(noise, cutoff, 2) == pytest.approx(0.02 * band_rms(motion, 25.0, 2), rel=0.25)


def test_without_motion_the_cutoff_is_the_highest():
    assert choose_cutoff(np.zeros((100, 2)), 0.02) == pytest.approx(0.4 * 25.0)
    assert choose_cutoff(np.zeros((100, 2)), DT) == 25.0
    assert velocity_cutoff(np.zeros((100, 2)), DT, 0.01) == pytest.approx(0.4 * 250.0)


def test_derivatives_are_central_differences():
    q = np.column_stack([np.sin(T), T**2])
    v, a = derivatives(q, DT)
    assert v[1:-1] == pytest.approx(np.column_stack([np.cos(T), 2 * T])[1:-1], abs=1e-6)
    assert a[1:-1] == pytest.approx(np.column_stack([-np.sin(T), np.full_like(T, 2.0)])[1:-1], abs=1e-4)
    assert np.array_equal(a[[0, -1]], a[[1, -2]])
