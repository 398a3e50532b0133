"""The nearest configuration at which an arm touches nothing, to one at which it does."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from armctl._core import solve_program
from armctl.core.limits import Limits
from armctl.core.validation import Array
from armctl.model.collision.checker import CollisionChecker

_DESCENT_STEPS = 10  # of the descent from one start; distances are nearly linear over a few centimeters
_STEP_RAD = 0.3  # rad (m) that one iteration moves a joint: gradients of distances say little about what is farther away
_SEEN_M = 0.15  # pairs that are nearer bound a step
_SPARE_M = 5e-5  # above the clearance: what is left of a distance is not linear
_RADII = 12  # of the shells around what was asked for, in which starts are drawn
_FIRST_RADIUS_RAD = 0.02  # rad (m)
_RADIUS_GROWTH = 1.6  # from shell to shell: the last is beyond 3 rad
_DRAWN = 96  # configurations of each shell
_KEPT = 3  # the nearest free ones of a shell, from which the descent starts
_NEARER_SHARES = (0.25, 0.4, 0.6, 0.8)  # of the distance of the best one: shells that are searched last, until none is nearer
_MAX_ROUNDS = 6
_HALVINGS = 12  # of the way from a free configuration towards what was asked for


def nearest_safe(
    checker: CollisionChecker, limits: Limits, asked: Array, known: Iterable[Array], clearance: float
) -> Array | None:
    """The nearest configuration (n,) rad, inside the limits, at which all pairs are farther apart than a clearance, m.

    The distance is the Euclidean norm over the joints. From several starts, a step to the nearest point of the distances'
    linear approximations is repeated (sequential quadratic programming: Kraft, "A software package for sequential quadratic
    programming", 1988); the starts are what was asked for, configurations that are known, and the nearest free ones of random
    samples in shells around what was asked for. The same arguments give the same bits.

    Returns:
        The nearest one that was found; None if there is none.
    """
    asked = limits.clamp(asked)
    if checker.hit(asked, clearance) < 0:
        return asked
    search = _Search(checker, limits, asked, clearance)
    search.descend(asked)
    for q in known:
        search.take(q)
        search.descend(q)
    search.draw(np.random.default_rng(0))
    return search.best


class _Search:
    """The best configuration so far."""

    def __init__(self, checker: CollisionChecker, limits: Limits, asked: Array, clearance: float):
        self.best: Array | None = None
        self._checker = checker
        self._low = limits.q_min
        self._high = limits.q_max
        self._asked = asked
        self._clearance = clearance
        self._kept = np.full(len(checker.geometry.pairs), _SEEN_M + clearance)
        self._still = np.zeros(len(asked))

    @property
    def distance(self) -> float:
        """rad, of the best one; infinite without one."""
        return np.inf if self.best is None else float(np.linalg.norm(self.best - self._asked))

    def take(self, q: Array) -> None:
        """Takes the nearest free configuration on the way from q (n,) to what was asked for, if it is nearer than the best."""
        if self._checker.hit(q, self._clearance) >= 0:
            return
        far = 1.0
        near = 0.0
        for _ in range(_HALVINGS):
            middle = 0.5 * (near + far)
            if self._checker.hit(self._asked + middle * (q - self._asked), self._clearance) < 0:
                far = middle
            else:
                near = middle
        nearer = self._asked + far * (q - self._asked)
        if float(np.linalg.norm(nearer - self._asked)) < self.distance:
            self.best = nearer

    def descend(self, q: Array) -> None:
        """Goes from q (n,) to the nearest place where the linear approximations of the distances are free, again and again."""
        for _ in range(_DESCENT_STEPS):
            step = self._step(q)
            if step is None:
                return
            q = np.clip(q + step, self._low, self._high)
            self.take(q)
            if np.abs(step).max() < 1e-3 * _STEP_RAD:
                return

    def draw(self, rng: np.random.Generator) -> None:
        """Draws configurations in shells around what was asked for, and descends from the nearest free ones."""
        for radius in _FIRST_RADIUS_RAD * _RADIUS_GROWTH ** np.arange(_RADII):
            if radius > self.distance:
                break
            self._draw_shell(radius, rng)
        for _ in range(_MAX_ROUNDS):
            distance = self.distance
            for share in _NEARER_SHARES:
                if np.isfinite(distance):
                    self._draw_shell(share * distance, rng)
            if self.distance == distance:
                return

    def _draw_shell(self, radius: float, rng: np.random.Generator) -> None:
        directions = rng.normal(size=(_DRAWN, len(self._asked)))
        directions *= radius / np.linalg.norm(directions, axis=1)[:, None]
        drawn = np.clip(self._asked + directions, self._low, self._high)
        free = [q for q in drawn if self._checker.hit(q, self._clearance) < 0]
        free.sort(key=lambda q: float(np.linalg.norm(q - self._asked)))
        for q in free[:_KEPT]:
            self.take(q)
            self.descend(q)
        self.descend(drawn[0])

    def _step(self, q: Array) -> Array | None:
        """The step to the place nearest to what was asked for at which the approximations are free; None if there is none."""
        near = self._checker.near(q, self._still, 1.0, self._kept)
        lacking = self._clearance + _SPARE_M - near.distances
        low = np.maximum(self._low - q, -_STEP_RAD)
        high = np.minimum(self._high - q, _STEP_RAD)
        # A step cannot gain more than its bounds allow; what lacks then is gained by the steps after it.
        most = np.maximum(near.gradients * low, near.gradients * high).sum(axis=1)
        lacking = np.minimum(lacking, 0.9 * most)
        step = np.zeros(len(q))
        lower = np.concatenate([low, lacking])
        upper = np.concatenate([high, np.full(len(lacking), np.inf)])
        gradients = np.ascontiguousarray(near.gradients)
        solved = solve_program(np.eye(len(q)), q - self._asked, gradients, lower, upper, step)
        return step if solved else None
