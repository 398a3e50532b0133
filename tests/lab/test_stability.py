"""Margins of loops whose margins a textbook gives."""

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are
from scipy.optimize import brentq
from scipy.signal import tf2ss

from armctl.lab.loops.stability import loop_margins
from armctl.lab.loops.state_space import StateSpace

DT = 1e-4


def sampled(A: np.ndarray, B: np.ndarray, C: np.ndarray, dt: float = DT) -> StateSpace:
    """A continuous system behind a zero-order hold."""
    n = len(A)
    both = expm(np.block([[A, B], [np.zeros((B.shape[1], n + B.shape[1]))]]) * dt)
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


@pytest.mark.parametrize("rate", [30.0, 1.0, 0.05, 0.002])
def test_margins_do_not_depend_on_the_unit_of_time(rate):
    """rate / (s (1 + s / (2 rate))) at any rate, in rad/s: gain 1 where x^2 (1 + x^2 / 4) = 1 with x = w / rate."""
    dt = 0.002 / rate
    A, B, C, _ = tf2ss([rate], [0.5 / rate, 1.0, 0.0])
    found = loop_margins(sampled(A, B, C, dt), dt)
    x = np.sqrt(2 * (np.sqrt(2.0) - 1))
    assert found.phase_margin == pytest.approx(np.pi / 2 - np.arctan(x / 2), rel=2e-3)
    assert found.delay_margin == pytest.approx((np.pi / 2 - np.arctan(x / 2)) / x / rate, rel=2e-3)
    w = np.geomspace(0.01, 100.0, 20_000)
    assert found.peak_sensitivity == pytest.approx(np.abs(1 / (1 + 1 / (1j * w * (1 + 0.5j * w)))).max(), rel=2e-3)


def test_the_lower_gain_margin_of_three_integrators_is_that_of_the_nyquist_plot():
    """(s + 0.1)^2 / (s^3 (s + 1)) turns through -180 degrees at a low frequency, where its gain is far above 1."""
    A, B, C, _ = tf2ss([1.0, 0.2, 0.01], [1.0, 1.0, 0.0, 0.0, 0.0])
    found = loop_margins(sampled(A, B, C, 0.01), 0.01)
    w = brentq(lambda w: 2 * np.arctan(w / 0.1) - np.arctan(w) - np.pi / 2, 0.05, 0.5)
    assert found.lower_gain_margin == pytest.approx(w**3 * abs(1j * w + 1) / abs(1j * w + 0.1) ** 2, rel=1e-2)
    assert found.gain_margin == found.lower_gain_margin
    assert found.upper_gain_margin > 100.0


def test_margins_of_several_inputs_agree_with_eigenvalues_over_all_gains():
    rng = np.random.default_rng(3)
    finite = 0
    for _ in range(12):
        m = rng.integers(1, 4)
        size = 2 * m + 1
        dt = 10.0 ** rng.uniform(-3, -1)
        A = rng.normal(size=(size, size))
        A *= 10.0 ** rng.uniform(-2, -0.7) / dt / np.abs(np.linalg.eigvals(A)).max()
        plant = sampled(A, rng.normal(size=(size, m)), np.eye(size), dt)
        weight = 10.0 ** rng.uniform(-2, 2) * np.eye(m)
        P = solve_discrete_are(plant.A, plant.B, np.eye(size), weight)
        K = np.linalg.solve(weight + plant.B.T @ P @ plant.B, plant.B.T @ P @ plant.A)
        loop = StateSpace(plant.A, plant.B, K, np.zeros((m, m)))
        found = loop_margins(loop, dt)
        assert found.ok
        for limit, margin, none in ((0.01, found.lower_gain_margin, 0.0), (100.0, found.upper_gain_margin, np.inf)):
            factors = np.geomspace(1.0, limit, 1000)
            closed = loop.A - factors[:, None, None] * (loop.B @ loop.C)
            unstable = factors[np.abs(np.linalg.eigvals(closed)).max(axis=1) >= 1.0]
            assert margin == (pytest.approx(unstable[0], rel=5e-3) if len(unstable) else none)
            finite += len(unstable) > 0
    assert finite >= 12
