"""Margins of loops whose margins a textbook gives."""

import numpy as np
import pytest
from scipy.linalg import expm

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


def test_a_loop_near_the_critical_point_from_above_is_destabilized_by_the_smaller_lead():
    """L = k s / (s^2 + 2 d w s + w^2) leads by up to 90 degrees: below the resonance, a lead beyond 90 destabilizes it."""
    w = 20.0
    k = 40.0
    A = np.array([[0.0, 1.0], [-(w**2), -2.0]])
    found = loop_margins(sampled(A, np.array([[0.0], [1.0]]), np.array([[0.0, k]])), DT)
    crossings = np.roots([1.0, 0.0, -(2 * w**2 + k**2 - 4.0), 0.0, w**4])
    crossings = crossings.real[crossings.real > 0]
    lags = (np.angle(k * 1j * crossings / (w**2 - crossings**2 + 2j * crossings)) + np.pi) % (2 * np.pi)
    leads = 2 * np.pi - lags
    assert min(leads) < min(lags)
    assert found.phase_margin == pytest.approx(min(leads), abs=5e-3)
    assert found.delay_margin == pytest.approx(
        min(lag / x for lag, x in zip(lags, crossings.real[crossings.real > 0], strict=True)), rel=5e-3
    )


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
