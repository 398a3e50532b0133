"""The compiled solver of quadratic programs against daqp, an independent one, on random programs."""

import daqp
import numpy as np
import pytest

from armctl._core import UNBOUNDED, solve_program

pytestmark = pytest.mark.core

PROGRAMS = 400  # of each kind
MAX_UNKNOWNS = 9


def positive_definite(rng: np.random.Generator, n: int, condition: float) -> np.ndarray:
    Q, _ = np.linalg.qr(rng.normal(size=(n, n)))
    matrix = (Q * np.geomspace(1.0, 1.0 / condition, n)) @ Q.T
    return 0.5 * (matrix + matrix.T)


def intervals(rng: np.random.Generator, n: int, M: np.ndarray):
    """A point (n,), and bounds (2n,) around it and M times it."""
    point = rng.normal(size=n) * 10 ** rng.uniform(-2, 3)
    center = np.concatenate([point, M @ point])
    scale = np.abs(point).max() * np.concatenate([np.ones(n), np.abs(M).sum(axis=1)])
    width = np.abs(rng.normal(size=2 * n)) * scale
    share = rng.uniform(size=2 * n)
    return center, center - share * width, center + (1 - share) * width


def redundant(rng, n, M, center, lower, upper):
    """Some bounds of M x are those of x again: M is diagonal."""
    again = rng.random(n) < 0.5
    lower[n:][again] = (np.diag(M) * lower[:n])[again]
    upper[n:][again] = (np.diag(M) * upper[:n])[again]


def at_a_vertex(rng, n, M, center, lower, upper):
    """Many bounds meet in one point."""
    tight = rng.random(2 * n) < 0.6
    lower[tight] = center[tight]


def equal_bounds(rng, n, M, center, lower, upper):
    equal = rng.permutation(2 * n)[: rng.integers(0, n + 1)]
    lower[equal] = center[equal]
    upper[equal] = center[equal]


def one_sided(rng, n, M, center, lower, upper):
    lower[rng.random(2 * n) < 0.5] = -UNBOUNDED
    upper[rng.random(2 * n) < 0.5] = UNBOUNDED


def wide(rng, n, M, center, lower, upper):
    pass


def box_without_the_torque(rng, n, M, center, lower, upper):
    """A bound of M x that no x in the box reaches."""
    row = rng.integers(n)
    least = np.minimum(M[row] * lower[:n], M[row] * upper[:n]).sum()
    upper[n + row] = least - 0.01 * np.abs(M[row]) @ (upper[:n] - lower[:n])
    lower[n + row] = -UNBOUNDED


def fixed_outside_the_box(rng, n, M, center, lower, upper):
    """M x is fixed where one x is outside its bounds."""
    lower[n:] = center[n:]
    upper[n:] = center[n:]
    i = rng.integers(n)
    lower[i] = center[i] + 0.1 * (abs(center[i]) + 1e-3)
    upper[i] = UNBOUNDED


def empty_interval(rng, n, M, center, lower, upper):
    row = rng.integers(2 * n)
    lower[row] = upper[row] + 1e-6 * (abs(upper[row]) + 1e-3)


# What changes the bounds of a program, and the largest condition number of its matrices.
POSSIBLE = {
    wide: 1e2,
    redundant: 1e6,
    at_a_vertex: 1e4,
    equal_bounds: 1e4,
    one_sided: 1e6,
}
IMPOSSIBLE = (box_without_the_torque, fixed_outside_the_box, empty_interval)


def program(rng: np.random.Generator, kind, condition: float):
    n = int(rng.integers(1, MAX_UNKNOWNS + 1))
    H = positive_definite(rng, n, condition ** rng.uniform())
    M = positive_definite(rng, n, condition ** rng.uniform()) * 10 ** rng.uniform(-3, 3)
    if kind is redundant:
        M = np.diag(np.diag(M))
    center, lower, upper = intervals(rng, n, M)
    kind(rng, n, M, center, lower, upper)
    f = H @ rng.normal(size=n) * np.abs(center[:n]).max() * rng.integers(0, 3)
    return H, f, M, lower, upper


def solution(H, f, M, lower, upper):
    n = len(f)
    x = np.full(n, np.nan)
    return x if solve_program(H, f, M, lower, upper, x) else None


@pytest.mark.parametrize("kind", POSSIBLE, ids=lambda kind: kind.__name__)
def test_the_solution_is_that_of_daqp_and_within_the_bounds(kind):
    rng = np.random.default_rng(1)
    compared = 0
    for _ in range(PROGRAMS):
        H, f, M, lower, upper = program(rng, kind, POSSIBLE[kind])
        x = solution(H, f, M, lower, upper)
        assert x is not None
        rows = np.vstack([np.eye(len(x)), M])
        slack = 1e-9 * (np.abs(rows) @ np.abs(x))
        assert (rows @ x >= lower - slack).all()
        assert (rows @ x <= upper + slack).all()
        expected, _, status, _ = daqp.solve(H, f, M, upper, lower, primal_tol=1e-11)
        if status == 1:  # daqp takes some of the programs with equal bounds for contradictory
            assert np.abs(x - expected).max() <= 1e-9 * np.abs(expected).max()
            compared += 1
    assert compared > 0.95 * PROGRAMS


@pytest.mark.parametrize("kind", IMPOSSIBLE, ids=lambda kind: kind.__name__)
def test_contradicting_bounds_are_found(kind):
    rng = np.random.default_rng(3)
    for _ in range(PROGRAMS // 4):
        H, f, M, lower, upper = program(rng, kind, 1e3)
        assert solution(H, f, M, lower, upper) is None


def test_numbers_that_are_not_finite_end():
    for bad in (np.nan, np.inf, -np.inf):
        for k in range(5):
            arguments = list(program(np.random.default_rng(4), wide, 10.0))
            arguments[k] = np.full_like(arguments[k], bad)
            solution(*arguments)
