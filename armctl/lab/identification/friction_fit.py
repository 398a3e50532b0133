"""FrictionFit: the law of dry friction that explains torques best."""

import itertools
from typing import NamedTuple

import numpy as np

from armctl.core.validation import Array, BoolArray, IntArray
from armctl.lab.identification.filtered_recording import FilteredRecording
from armctl.lab.identification.fit_samples import LawFit, best_of, cost_of_damping, squared_residual
from armctl.lab.identification.regressor import ArmRegressor, FrictionShape
from armctl.model.arm.passive_forces import DryFriction

_SHAPE_SPEEDS = np.geomspace(0.003, 1.0, 11)  # rad/s, candidates for the smoothing of Coulomb friction
_LAW_ERROR = 0.2  # standard deviation of the logarithm of the slope in MuJoCo's law: it follows from the joint's inertia
_SHAPE_ERROR = 1.0  # the same of an arm whose law is not known
_LAW_SLOPES = (0.8, 1.0, 1.25)  # relative to the model: first candidates
_LAW_FRICTIONS = np.concatenate([np.geomspace(1e-3, 0.1, 7), np.linspace(0.2, 1.0, 9)])  # of the largest torque of the damper
_MIN_FRICTION_SHARE = 1e-6  # of the typical torque: a lower bound in MuJoCo's law
_LAW_STEPS = np.geomspace(1.5, 1.005, 12)  # factors of a search for slope and bound
_BISECTIONS = 5  # of the interval between two candidates
_SLIDING_SPEEDS = np.concatenate([[0.0], np.geomspace(0.01, 1.0, 9)])  # rad/s, candidates for the least speed of a row
_MIN_SLIDING_SHARE = 0.25  # of the rows
_STRIBECK_SPEEDS = np.geomspace(0.02, 1.0, 7)  # rad/s, candidates
SIGNIFICANT_ERRORS = 4.0  # standard errors; the choice of a shape makes more of noise than one fit does


class FrictionTerms(NamedTuple):
    """Dry friction in the K samples of a recording, through its filter once.

    By MuJoCo's law, dry friction is clip(slope v, +-bound). Its derivative by the bound is the sign where v is fast enough, and
    0 below: slower motions do not show the bound. The rest of the friction does not depend on it.
    """

    columns: Array  # (K, n, 1 or 2), the derivatives by its parameters
    by_shape: Array  # (K, n) N m, the derivative by the logarithm of its slope
    rest: Array  # (K, n) N m, what does not depend on its parameters
    start: Array  # (K, n) N m, by the arm's own model


class LeftTorques(NamedTuple):
    """What some rows of a recording leave to friction, damping and offsets."""

    tau: Array  # (k, n) N m
    v: Array  # (k, n) rad/s
    noise: Array  # (n,) N m, of independent rows
    rows: IntArray  # (k,), their samples


class FrictionFit:
    """The speeds at which dry friction changes, or, in a simulation, slope and bound of MuJoCo's law."""

    def __init__(self, regressor: ArmRegressor, recording: FilteredRecording, law: DryFriction | None):
        """The friction of the model; `law` is MuJoCo's if it is that of the recording."""
        n = regressor.layout.n
        self.law = law
        self.shape = FrictionShape(np.full(n, _SHAPE_SPEEDS[4]), np.full(n, _STRIBECK_SPEEDS[3]))
        self.sliding = np.zeros(n)  # (n,) rad/s, the least speeds of rows that a fit uses
        self._regressor = regressor
        self._recording = recording
        self._scale = regressor.torque_scale()
        self._slope = np.zeros(n) if law is None else law.slope  # N m s/rad
        self._bound = np.zeros(n)  # N m, of the damper with this slope
        self.follow(regressor.start[regressor.layout.coulomb])

    @property
    def slope_error(self) -> float:
        """The standard deviation of the logarithm of the slope."""
        return _SHAPE_ERROR if self.law is None else _LAW_ERROR

    def follow(self, coulomb: Array) -> None:
        """Takes the speeds of dry friction from MuJoCo's law, if it is known, for a Coulomb friction."""
        if self.law is not None:
            self._bound = np.maximum(coulomb, _MIN_FRICTION_SHARE * self._scale)
            self.shape = self.shape._replace(smoothing=self._bound / self._slope)

    def terms(self, coulomb: Array) -> FrictionTerms:
        """Dry friction through the filter that the positions have passed, about a Coulomb friction (n,) N m."""
        recording = self._recording
        v = recording.v_dry
        dry = self._regressor.dry_friction(v, self.shape)
        is_damper = np.abs(v) < self.shape.smoothing
        by_shape = np.zeros_like(v)
        rest = np.zeros_like(v)
        if self.law is not None:
            by_shape = self._slope * v * is_damper
            rest = by_shape
            dry[:, :, 0] *= ~is_damper
        elif self._regressor.layout.has_friction:
            by_shape = -dry[:, :, 0] * coulomb * is_damper
        columns = recording.filtered(dry.reshape(len(dry), -1)).reshape(-1, *dry.shape[1:])
        return FrictionTerms(
            columns, recording.filtered(by_shape), recording.filtered(rest), recording.filtered(self._start_friction())
        )

    def effect(self, v: Array) -> Array:
        """(T, n): the change of dry friction if Coulomb friction is larger by its prior's deviation, relative to that."""
        if self.law is None:
            return self._regressor.dry_friction(v, self.shape)[:, :, 0]
        more = self._bound + self._regressor.prior[self._regressor.layout.coulomb]
        torque = self._slope * v
        return (np.clip(torque, -more, more) - np.clip(torque, -self._bound, self._bound)) / (more - self._bound)

    def improve(self, left: LeftTorques, terms: FrictionTerms) -> None:
        """Explains what rows leave better than by the terms so far."""
        recording = self._recording
        if self.law is not None:
            self._improve_law(left._replace(tau=left.tau + recording.filtered_again(terms.rest)[left.rows]))
        else:
            self._improve_speeds(left)
        columns = self._columns(self.shape)[left.rows]
        for j in range(self._regressor.layout.n):
            A = np.column_stack([columns[:, j, 0], left.v[:, j], np.ones(len(left.v))])
            slides = [recording.slides(j, speed)[left.rows] for speed in _SLIDING_SPEEDS]
            self.sliding[j] = _sliding_speed(A, left.tau[:, j], slides)

    def _start_friction(self) -> Array:
        """(T, n) N m, dry friction by the arm's own model."""
        v = self._recording.v_dry
        if not self._regressor.layout.has_friction:
            return np.zeros_like(v)
        friction = self._regressor.start[self._regressor.layout.coulomb]
        if self.law is not None:
            return np.clip(self.law.slope * v, -friction, friction)
        return friction * self._regressor.dry_friction(v, self.shape)[:, :, 0]

    def _columns(self, shape: FrictionShape) -> Array:
        """(K, n, 1 or 2): the columns of dry friction, filtered like the torques."""
        dry = self._regressor.dry_friction(self._recording.v_dry, shape)
        once = self._recording.filtered(dry.reshape(len(dry), -1))
        return self._recording.filtered_again(once).reshape(-1, *dry.shape[1:])

    def _improve_law(self, left: LeftTorques) -> None:
        """Slope and bound of MuJoCo's law from the torques of friction, for each joint."""
        assert self.law is not None
        layout = self._regressor.layout
        recording = self._recording
        noise = left.noise
        by_model = self.law.slope
        bound_by_model = self._regressor.start[layout.coulomb]
        damping_by_model = self._regressor.start[layout.viscous]
        # Below the bound, dry friction and damping are hardly distinguished. A model that has both is right about their order.
        bound_error = np.where(bound_by_model > 0, bound_by_model, self._regressor.prior[layout.coulomb])
        damping_error = np.where(damping_by_model > 0, damping_by_model, self._regressor.prior[layout.viscous])
        least = _MIN_FRICTION_SHARE * self._scale
        joints = range(layout.n)

        def costs(slope: Array, bound: Array) -> Array:
            damper = recording.filtered(np.clip(slope * recording.v_dry, -bound, bound))
            rest = (left.tau - recording.filtered_again(damper)[left.rows]) / noise
            prior = (np.log(slope / by_model) / _LAW_ERROR) ** 2 + ((bound - bound_by_model) / bound_error) ** 2
            return prior + np.array([cost_of_damping(left.v[:, j] / noise[j], damping_error[j], rest[:, j]) for j in joints])

        def improved(best: LawFit, slope: Array, bound: Array) -> LawFit:
            cost = costs(slope, bound)
            better = cost < best.cost
            return LawFit(*(np.where(better, new, old) for new, old in zip((slope, bound, cost), best, strict=True)))

        start = np.maximum(bound_by_model, least)
        by_start = costs(by_model, start)
        best = improved(LawFit(by_model, start, by_start), self._slope, np.maximum(self._bound, least))
        largest = np.abs(recording.v_dry).max(axis=0)
        for factor, share in itertools.product(_LAW_SLOPES, _LAW_FRICTIONS):
            slope = factor * by_model
            best = improved(best, slope, np.maximum(share * slope * largest, least))
        for step in _LAW_STEPS:
            for on_slope, on_bound in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                best = improved(best, best.slope * step**on_slope, np.maximum(best.bound * step**on_bound, least))
        is_certain = best.cost < by_start - SIGNIFICANT_ERRORS**2
        self._slope = np.where(is_certain, best.slope, by_model)
        self._bound = np.where(is_certain, best.bound, start)
        self.shape = self.shape._replace(smoothing=self._bound / self._slope)

    def _improve_speeds(self, left: LeftTorques) -> None:
        """For each joint the speeds of the friction that explain its torques best."""
        layout = self._regressor.layout

        def costs(shape: FrictionShape) -> Array:
            columns = self._columns(shape)[left.rows]
            return np.array([squared_residual(columns[:, j], left.v[:, j], left.tau[:, j]) for j in range(layout.n)])

        candidates = np.repeat(_SHAPE_SPEEDS[:, None], layout.n, axis=1)
        step = np.log(candidates[1] / candidates[0])
        smoothing = best_of(candidates, lambda s: costs(self.shape._replace(smoothing=s)))
        self.shape = self.shape._replace(smoothing=smoothing)
        if layout.has_stribeck:
            candidates = np.repeat(_STRIBECK_SPEEDS[:, None], layout.n, axis=1)
            stribeck = best_of(candidates, lambda s: costs(self.shape._replace(stribeck=s)))
            self.shape = self.shape._replace(stribeck=stribeck)
        for _ in range(_BISECTIONS):
            step = 0.5 * step
            candidates = smoothing * np.exp([-step, np.zeros(layout.n), step])
            smoothing = best_of(candidates, lambda s: costs(self.shape._replace(smoothing=s)))
        self.shape = self.shape._replace(smoothing=smoothing)


def _sliding_speed(A: Array, torques: Array, slides: list[BoolArray]) -> float:
    """The least speed of rows by which Coulomb friction is known best: near a reversal it is no function of speed."""
    best = 0.0
    least = np.inf
    for speed, kept in zip(_SLIDING_SPEEDS, slides, strict=True):
        if kept.sum() < _MIN_SLIDING_SHARE * len(kept):
            break
        residual = torques[kept] - A[kept] @ np.linalg.lstsq(A[kept], torques[kept])[0]
        variance = float(residual @ residual / kept.sum() * np.linalg.pinv(A[kept].T @ A[kept])[0, 0])
        if variance < least:
            least = variance
            best = float(speed)
    return best
