"""Margins of loops whose margins a textbook gives."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import tf2ss

from armctl.design.stability import loop_margins
from armctl.design.state_space import StateSpace

DT = 1e-4


def sampled(A: np.ndarray, B: np.ndarray, C: np.ndarray) -> StateSpace:
    """A continuous system behind a zero-order hold."""
    n = len(A)
    both = expm(np.block([[A, B], [np.zeros((B.shape[1], n + B.shape[1]))]]) * DT)
    return StateSpace(both[:n, :n], both[:n, n:], C, np.zeros((len(C), B.shape[1])))


def test_a_lag_margin_of_an_integrator_is_a_quarter_turn():
    found = loop_margins(sampled(np.zeros((1, 1)), np.eye(1), 10.0 * np.eye(1)), DT)
    assert found.phase_margin == pytest.approx(0.5 * np.pi, abs=2e-3)
    assert found.delay_margin == pytest.approx(0.5 * np.pi / 10.0, rel=2e-3)
    assert found.gain_margin == np.inf


def test_the_phase_margin_of_an_unstable_pole_under_feedback_is_that_of_the_nyquist_plot():
    """An unstable pole under proportional feedback, 20 / (s - 10): the gain is 1 at sqrt(3) 10 rad/s, the phase -120 degrees.

    A lag of 60 degrees, or a lead of 300, makes it unstable.
    """
    found = loop_margins(sampled(10.0 * np.eye(1), np.eye(1), 20.0 * np.eye(1)), DT)
    assert found.ok
    assert found.phase_margin == pytest.approx(np.pi / 3.0, abs=3e-3)


def test_a_loop_that_leads_is_destabilized_by_a_smaller_lead_than_lag():
    """A resonance whose loop leads by up to 90 degrees, and a lead filter, which brings it nearer to 180 degrees."""
    numerator = np.polymul([10.0, 0.0], [1 / 20.0, 1.0])
    denominator = np.polymul([1.0, 2.0, 20.0**2], [1 / 400.0, 1.0])
    A, B, C, _ = tf2ss(numerator, denominator)
    found = loop_margins(sampled(A, B, C), DT)
    w = np.linspace(1.0, 400.0, 400_000)
    size = np.abs(np.polyval(numerator, 1j * w) / np.polyval(denominator, 1j * w))
    crossings = w[np.flatnonzero(np.diff(np.sign(size - 1.0)))]
    angles = np.angle(np.polyval(numerator, 1j * crossings) / np.polyval(denominator, 1j * crossings))
    lags = (angles + np.pi) % (2 * np.pi)
    leads = 2 * np.pi - lags
    assert min(leads) < min(lags) - 0.2
    assert found.phase_margin == pytest.approx(min(leads), abs=0.02)
    assert found.delay_margin == pytest.approx(min(lags / crossings), rel=0.02)


def test_an_unstable_loop_has_no_margins():
    found = loop_margins(sampled(10.0 * np.eye(1), np.eye(1), 5.0 * np.eye(1)), DT)
    assert not found
    assert (found.delay_margin, found.phase_margin) == (0.0, 0.0)
    assert "unstable" in found.reason


def test_the_gain_margin_and_peak_sensitivity_of_three_lags_are_those_of_the_nyquist_plot():
    """2 / (s + 1)^3 has the phase -180 degrees at sqrt(3) rad/s, where its gain is 2 / 8."""
    A = np.array([[-1.0, 1.0, 0.0], [0.0, -1.0, 1.0], [0.0, 0.0, -1.0]])
    found = loop_margins(sampled(A, np.array([[0.0], [0.0], [1.0]]), np.array([[2.0, 0.0, 0.0]])), DT)
    w = np.geomspace(0.3, 100.0, 20_000)
    assert found.gain_margin == pytest.approx(4.0, rel=2e-3)
    assert found.peak_sensitivity == pytest.approx(np.abs(1 / (1 + 2 / (1j * w + 1) ** 3)).max(), rel=2e-3)
