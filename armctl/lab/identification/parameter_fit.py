"""The fit of all parameters of an arm to recorded torques: filtered regressor, delay, friction, physical consistency."""

import itertools
from typing import Any

import numpy as np

from armctl.core.filtering import choose_cutoff, derivatives, low_pass
from armctl.core.log import Log, LogSource
from armctl.core.validation import Array, BoolArray, IntArray
from armctl.lab.identification.fit_samples import (
    FitSamples,
    LawFit,
    best_of,
    cost_of_damping,
    speeds_of_torques,
    squared_residual,
)
from armctl.lab.identification.pseudo_inertia import PARAMETERS, from_log_cholesky, is_consistent, regularized, to_log_cholesky
from armctl.lab.identification.regressor import ArmRegressor, FrictionShape
from armctl.model.arm.passive_forces import DryFriction

_REGRESSOR_SAMPLES_PER_PERIOD = 8  # of the cut-off: products of positions and velocities have higher frequencies
_ROWS_PER_PERIOD = 4
_TRIMMED_PERIODS = 1.0  # at both ends, where the filter has no data on one side
_MAX_DELAY_S = 0.05
_ROUNDS = 3  # delay, shape of the friction and noise depend on each other
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
_REVERSAL_PERIODS = 0.5  # of the cut-off: the filter spreads a reversal over this time on both sides
_STRIBECK_SPEEDS = np.geomspace(0.02, 1.0, 7)  # rad/s, candidates
_MIN_NOISE_SHARE = 1e-4  # of the typical torque: no joint's torque is known better
_MIN_MASS_KG = 1e-6
_MIN_LENGTH_M = 1e-4
_MAX_EVALUATIONS = 80
_DIAGONAL = 4  # of a Cholesky factor's ten parameters
# Standard deviation of the logarithm of a link's size before any data. It keeps links away from points and rods, which no
# simulator accepts.
_LOG_SIZE_PRIOR = 1.0
_MAX_CORRELATED_ROWS = 30
_SIGNIFICANT_ERRORS = 4.0  # standard errors; the choice of a shape makes more of noise than one fit does
_MAX_DROPPED_ERROR = 0.5  # of the prior's standard deviation: what the data do not show at all absorbs no noise
_DROPPED_PRIOR = 1e-4  # factor on the standard deviation of the prior


class ParameterFit:
    """A fit to the first rows of a recording; the others are held out."""

    def __init__(self, regressor: ArmRegressor, log: Log, holdout: float, consistent: bool):
        self.regressor = regressor
        self._dt = log.dt
        self._t = log.t
        self._holdout = holdout
        is_simulated = log.source is LogSource.SIMULATION
        self._may_be_delayed = not is_simulated  # positions and torques of a simulation are of the same tick
        n = regressor.arm.n
        self.cutoff = choose_cutoff(log.q, log.dt)  # Hz
        q = low_pass(log.q, self.cutoff, log.dt)
        v, a = derivatives(q, log.dt)
        white = np.diff(log.tau, axis=0).std(axis=0) / np.sqrt(2)
        self.torque_noise = white * np.sqrt(min(1.0, 2 * self.cutoff * log.dt))  # (n,) N m, RMS of the filtered white noise
        self._tau = low_pass(log.tau, self.cutoff, log.dt)
        self._stride = max(1, int(1 / (_REGRESSOR_SAMPLES_PER_PERIOD * self.cutoff * log.dt)))
        self._q = q[:: self._stride]
        self._v = v[:: self._stride]
        self._a = a[:: self._stride]
        self.shape = FrictionShape(np.full(n, _SHAPE_SPEEDS[4]), np.full(n, _STRIBECK_SPEEDS[3]))
        self._sliding = np.zeros(n)
        is_law_known = is_simulated and not log.continuous and regressor.layout.has_friction
        self._law = DryFriction.from_model(regressor.arm.model, regressor.arm.joint_map) if is_law_known else None
        self._slope = np.zeros(n) if self._law is None else self._law.slope  # N m s/rad
        self._bound = np.zeros(n)  # N m, of the damper with this slope
        self._scale = regressor.torque_scale()
        self._follow_law(regressor.start[regressor.layout.coulomb])
        speeds = speeds_of_torques(self._law, regressor.dynamics, log, q, v, a)
        start = speeds.start[:: self._stride]
        self._v_end = speeds.end[:: self._stride]
        self._v_dry = speeds.dry
        self.x = regressor.start.copy()  # (p,) the parameters
        self._raw = regressor.rows(self._q, start, self._a, self.shape)
        self._set_friction()
        self._model = regressor.model_torques(self._q, start, self._a)
        self._model += regressor.dynamics.damping * (self._v_end - start)
        self.delay = 0.0  # s, by which torques were recorded later than positions
        self.prior = regressor.prior.copy()  # (p,) deviations before any data; small for parameters that are not kept
        self.kept = np.ones(regressor.layout.size, bool)  # (p,) False for friction and offsets that stay as in the model
        self.noise = 0.02 * self._scale  # (n,) N m, RMS of the residuals of the fit
        self.inflation = np.ones(n)  # (n,) factors by which correlated residuals increase the variance of an estimate
        for _ in range(_ROUNDS):
            self._improve()
        self.inflation = self._inflation()
        self._drop_insignificant()
        self._consistent = consistent
        self._fit_links()

    def use_all_rows(self) -> None:
        """Repeats the last fit with the rows that were held out."""
        self._holdout = 0.0
        self._fit_links()

    def _fit_links(self) -> None:
        """Physically consistent parameters, and what remains of the torques."""
        self.x = self._solution(self.training)
        self._set_noise()
        self.inflation = self._inflation()
        self._follow_law(self.x[self.regressor.layout.coulomb])

    def _follow_law(self, coulomb: Array) -> None:
        """Takes the speeds of dry friction from MuJoCo's law, if it is known, for a Coulomb friction."""
        if self._law is not None:
            self._bound = np.maximum(coulomb, _MIN_FRICTION_SHARE * self._scale)
            self.shape = self.shape._replace(smoothing=self._bound / self._slope)

    def _set_friction(self) -> None:
        """Writes friction into the regressor, dry friction through the filter that the positions have passed.

        By MuJoCo's law, dry friction is clip(slope v, +-bound). Its derivative by the bound is the sign where v is fast enough,
        and 0 below: slower motions do not show the bound. The rest of the friction does not depend on it.
        """
        v = self._v_dry
        dry = self.regressor.dry_friction(v, self.shape)
        is_damper = np.abs(v) < self.shape.smoothing
        self._by_shape = np.zeros_like(v)
        self._rest = np.zeros_like(v)
        if self._law is not None:
            self._by_shape = self._slope * v * is_damper
            self._rest = self._by_shape
            dry[:, :, 0] *= ~is_damper
        elif self.regressor.layout.has_friction:
            self._by_shape = -dry[:, :, 0] * self.x[self.regressor.layout.coulomb] * is_damper
        columns = self._filtered(dry.reshape(len(dry), -1)).reshape(-1, *dry.shape[1:])
        self.regressor.set_friction(self._raw, self._v_end, columns)

    def _filtered(self, columns: Array) -> Array:
        """Columns (T, k) that depend on velocities through the filter that the positions have passed."""
        return low_pass(columns, self.cutoff, self._dt)[:: self._stride]

    def friction_effect(self, v: Array) -> Array:
        """(T, n): the change of dry friction if Coulomb friction is larger by its prior's deviation, relative to that."""
        if self._law is None:
            return self.regressor.dry_friction(v, self.shape)[:, :, 0]
        more = self._bound + self.regressor.prior[self.regressor.layout.coulomb]
        torque = self._slope * v
        return (np.clip(torque, -more, more) - np.clip(torque, -self._bound, self._bound)) / (more - self._bound)

    @property
    def training(self) -> FitSamples:
        return self.rows.part(slice(0, self._count_used()))

    @property
    def held_out(self) -> FitSamples:
        """The other rows, without a filter's length between."""
        gap = round(_ROWS_PER_PERIOD * _TRIMMED_PERIODS)
        return self.rows.part(slice(self._count_used() + gap, None))

    def predicted(self, rows: FitSamples) -> Array:
        """(K, n) N m, by the fitted parameters."""
        return rows.model + rows.W @ (self.x - self.regressor.model_values)

    def weighted(self, rows: FitSamples) -> Array:
        """(K n, p): the regressor in units of the noise of independent rows, for each standard deviation of the prior."""
        return (rows.W * self._weights(rows)[:, :, None]).reshape(-1, rows.W.shape[2]) * self.prior

    def covariance(self) -> Array:
        """(p, p), in units of the prior's deviations, of all parameters, with the doubt about the slope of dry friction."""
        rows = self.training
        K, n, p = rows.W.shape
        weights = self._weights(rows)
        shape_error = _SHAPE_ERROR if self._law is None else _LAW_ERROR
        by_shape = np.zeros((K, n, n))
        by_shape[:, np.arange(n), np.arange(n)] = shape_error * weights * rows.by_shape
        W = np.concatenate([rows.W * weights[:, :, None] * self.regressor.prior, by_shape], axis=2).reshape(K * n, p + n)
        return np.asarray(np.linalg.inv(W.T @ W + np.eye(p + n))[:p, :p], dtype=np.float64)

    def _weights(self, rows: FitSamples) -> Array:
        return rows.used / (self.noise * np.sqrt(self.inflation))

    def _drop_insignificant(self) -> None:
        """Keeps dry friction and offsets that the data do not confirm at the model's values; they would only absorb noise."""
        regressor = self.regressor
        layout = regressor.layout
        errors = regressor.prior * np.sqrt(np.diag(self.covariance()))
        for part in (layout.coulomb, layout.stribeck, layout.offset):
            small = np.abs(self.x[part] - regressor.start[part]) < _SIGNIFICANT_ERRORS * errors[part]
            small &= errors[part] < _MAX_DROPPED_ERROR * regressor.prior[part]
            self.kept[part] = ~small
            self.prior[part] = np.where(small, _DROPPED_PRIOR * regressor.prior[part], regressor.prior[part])

    def _count_used(self) -> int:
        return round((1 - self._holdout) * len(self.rows))

    def _improve(self) -> None:
        """One round: rows with the delay and the friction so far, parameters, then delay, friction and noise."""
        self.rows = self._filtered_rows()
        training = self.training
        self.x = self._linear_solution(training)
        self._set_noise()
        if self._may_be_delayed:
            self._improve_delay(training)
        if self.regressor.layout.has_friction:
            self._improve_shape()

    def _filtered_rows(self) -> FitSamples:
        """Regressor, model and torques through the same filter; torques moved back by the delay."""
        dt = self._dt * self._stride
        K, n, p = self._raw.shape
        times = self._t[:: self._stride][:K]
        delayed = low_pass(self._tau, self.cutoff, self._dt)
        tau = np.column_stack([np.interp(times + self.delay, self._t, column) for column in delayed.T])
        start = self._filtered(self._start_friction())
        by_shape = self._filtered(self._by_shape)
        rest = self._filtered(self._rest)
        together = np.concatenate([self._raw.reshape(K, n * p), self._model, self._v, start, by_shape, rest], axis=1)
        filtered = low_pass(together, self.cutoff, dt)
        trimmed = int(_TRIMMED_PERIODS / self.cutoff / dt) + 1
        rows = slice(trimmed, K - trimmed, max(1, round(_REGRESSOR_SAMPLES_PER_PERIOD / _ROWS_PER_PERIOD)))
        W = filtered[:, : n * p].reshape(K, n, p)
        model, v, start, by_shape, rest = np.split(filtered[:, n * p :], 5, axis=1)
        used = np.column_stack([self._slides(j, speed) for j, speed in enumerate(self._sliding)])
        return FitSamples(
            t=times[rows],
            v=v[rows],
            tau=tau[rows],
            model=(model + rest)[rows],
            W=W[rows],
            start=(model + start)[rows],
            by_shape=by_shape[rows],
            used=used[rows].astype(np.float64),
        )

    def _start_friction(self) -> Array:
        """(T, n) N m, dry friction by the arm's own model."""
        if not self.regressor.layout.has_friction:
            return np.zeros_like(self._v_dry)
        friction = self.regressor.start[self.regressor.layout.coulomb]
        if self._law is not None:
            return np.clip(self._law.slope * self._v_dry, -friction, friction)
        return friction * self.regressor.dry_friction(self._v_dry, self.shape)[:, :, 0]

    def _slides(self, j: int, speed: float) -> BoolArray:
        """(T,) whether a joint is faster than a speed, and stays so for as long as the filter looks."""
        from scipy.ndimage import binary_dilation

        slow = np.abs(self._v[:, j]) < speed
        reach = round(_REVERSAL_PERIODS * _REGRESSOR_SAMPLES_PER_PERIOD)
        return ~np.asarray(binary_dilation(slow, np.ones(2 * reach + 1, bool)), dtype=np.bool_)

    def _set_noise(self) -> None:
        training = self.training
        residual = training.used * (training.tau - self.predicted(training))
        rms = np.sqrt((residual**2).sum(axis=0) / np.maximum(training.used.sum(axis=0), 1.0))
        self.noise = np.maximum(rms, _MIN_NOISE_SHARE * self._scale)

    def _improve_delay(self, rows: FitSamples) -> None:
        """A Gauss-Newton step: a delay d changes a torque by -d times its rate."""
        predicted = self.predicted(rows)
        weights = self._weights(rows)
        rate = weights * np.gradient(predicted, rows.t, axis=0)
        W = np.column_stack([self.weighted(rows), -rate.ravel()])
        y = (weights * (rows.tau - predicted)).ravel()
        information = W.T @ W
        information[:-1, :-1] += np.eye(W.shape[1] - 1)
        regularized = information + 1e-9 * np.trace(information) / len(information) * np.eye(len(information))
        inverse = np.linalg.inv(regularized)
        delay = self.delay + float((inverse @ (W.T @ y))[-1])
        error = float(np.sqrt(inverse[-1, -1] * self._inflation().max()))
        is_certain = abs(delay) > _SIGNIFICANT_ERRORS * error
        self.delay = float(np.clip(delay, -_MAX_DELAY_S, _MAX_DELAY_S)) if is_certain else 0.0

    def _improve_shape(self) -> None:
        """For each joint the speeds of the friction that explain its torques best, the other parameters as they are."""
        rows = self.training
        layout = self.regressor.layout
        without = self.x - self.regressor.model_values
        for part in (layout.viscous, layout.coulomb, layout.stribeck, layout.offset):
            without[part] = 0.0
        kept = self._kept_samples()
        rest = rows.tau - rows.model - rows.W @ without
        if self._law is not None:
            self._improve_law(rest + low_pass(self._filtered(self._rest), self.cutoff, self._dt * self._stride)[kept], kept)
        else:
            self._improve_speeds(rest, kept)
        columns = self._dry_columns(self._v_dry, self.shape)[kept]
        for j in range(layout.n):
            A = np.column_stack([columns[:, j, 0], rows.v[:, j], np.ones(len(rows))])
            self._sliding[j] = self._sliding_speed(A, rest[:, j], [self._slides(j, s)[kept] for s in _SLIDING_SPEEDS])
        self._set_friction()
        self.rows = self._filtered_rows()

    def _improve_law(self, torques: Array, kept: IntArray) -> None:
        """Slope and bound of MuJoCo's law from the torques of friction, for each joint."""
        assert self._law is not None
        layout = self.regressor.layout
        by_model = self._law.slope
        bound_by_model = self.regressor.start[layout.coulomb]
        damping_by_model = self.regressor.start[layout.viscous]
        # Below the bound, dry friction and damping are hardly distinguished. A model that has both is right about their order.
        bound_error = np.where(bound_by_model > 0, bound_by_model, self.regressor.prior[layout.coulomb])
        damping_error = np.where(damping_by_model > 0, damping_by_model, self.regressor.prior[layout.viscous])
        least = _MIN_FRICTION_SHARE * self._scale
        v = self.training.v
        weights = self.noise * np.sqrt(self.inflation)
        joints = range(layout.n)

        def costs(slope: Array, bound: Array) -> Array:
            damper = self._filtered(np.clip(slope * self._v_dry, -bound, bound))
            left = (torques - low_pass(damper, self.cutoff, self._dt * self._stride)[kept]) / weights
            prior = (np.log(slope / by_model) / _LAW_ERROR) ** 2 + ((bound - bound_by_model) / bound_error) ** 2
            return prior + np.array([cost_of_damping(v[:, j] / weights[j], damping_error[j], left[:, j]) for j in joints])

        def improved(best: LawFit, slope: Array, bound: Array) -> LawFit:
            cost = costs(slope, bound)
            better = cost < best.cost
            return LawFit(*(np.where(better, new, old) for new, old in zip((slope, bound, cost), best, strict=True)))

        start = np.maximum(bound_by_model, least)
        by_start = costs(by_model, start)
        best = improved(LawFit(by_model, start, by_start), self._slope, np.maximum(self._bound, least))
        largest = np.abs(self._v_dry).max(axis=0)
        for factor, share in itertools.product(_LAW_SLOPES, _LAW_FRICTIONS):
            slope = factor * by_model
            best = improved(best, slope, np.maximum(share * slope * largest, least))
        for step in _LAW_STEPS:
            for on_slope, on_bound in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                best = improved(best, best.slope * step**on_slope, np.maximum(best.bound * step**on_bound, least))
        is_certain = best.cost < by_start - _SIGNIFICANT_ERRORS**2
        self._slope = np.where(is_certain, best.slope, by_model)
        self._bound = np.where(is_certain, best.bound, start)
        self.shape = self.shape._replace(smoothing=self._bound / self._slope)

    def _improve_speeds(self, rest: Array, kept: IntArray) -> None:
        rows = self.training
        layout = self.regressor.layout

        def costs(shape: FrictionShape) -> Array:
            columns = self._dry_columns(self._v_dry, shape)[kept]
            return np.array([squared_residual(columns[:, j], rows.v[:, j], rest[:, j]) for j in range(layout.n)])

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

    def _kept_samples(self) -> IntArray:
        """The samples of the velocities that belong to the rows of the fit."""
        trimmed = int(_TRIMMED_PERIODS / self.cutoff / (self._dt * self._stride)) + 1
        every = max(1, round(_REGRESSOR_SAMPLES_PER_PERIOD / _ROWS_PER_PERIOD))
        return np.arange(trimmed, len(self._v) - trimmed, every)[: self._count_used()]

    def _dry_columns(self, speeds: Array, shape: FrictionShape) -> Array:
        """(T, k, 1 or 2): the columns of dry friction at speeds, filtered like the torques."""
        dry = self.regressor.dry_friction(speeds, shape)
        once = self._filtered(dry.reshape(len(dry), -1))
        return low_pass(once, self.cutoff, self._dt * self._stride).reshape(-1, *dry.shape[1:])

    def _sliding_speed(self, A: Array, torques: Array, slides: list[BoolArray]) -> float:
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

    def _targets(self, rows: FitSamples) -> Array:
        """(K n,) what the start leaves of the torques, in units of the noise."""
        predicted = rows.model + rows.W @ (self.regressor.start - self.regressor.model_values)
        return (self._weights(rows) * (rows.tau - predicted)).ravel()

    def _linear_solution(self, rows: FitSamples) -> Array:
        """Least squares with the prior, without bounds."""
        W = self.weighted(rows)
        dx = np.linalg.solve(W.T @ W + np.eye(W.shape[1]), W.T @ self._targets(rows))
        return self.regressor.start + self.prior * dx

    def _solution(self, rows: FitSamples) -> Array:
        """Least squares with the prior; friction and rotor inertias at least 0; physically consistent links on request."""
        from scipy.optimize import least_squares

        layout = self.regressor.layout
        n = layout.n
        linear = self._linear_solution(rows)
        positive = np.zeros(layout.size, bool)
        for part in (layout.rotor, layout.viscous, layout.coulomb, layout.stribeck):
            positive[part] = True
        links = [linear[layout.link(i)] for i in range(n)]
        all_consistent = not self._consistent or all(is_consistent(link) for link in links)
        if all_consistent and (linear[positive] >= 0).all():
            return linear
        start = self.regressor.start
        prior = self.prior
        R: Any = np.linalg.qr(np.column_stack([self.weighted(rows), self._targets(rows)]), mode="r")
        A = R[:, :-1]
        b = R[:, -1]

        def parameters(z: Array) -> Array:
            if not self._consistent:
                return z
            x = z.copy()
            for i in range(n):
                x[layout.link(i)] = from_log_cholesky(z[layout.link(i)])[0]
            return x

        def residual(z: Array) -> Array:
            dx = (parameters(z) - start) / prior
            return np.concatenate([A @ dx - b, dx, (z - first)[sizes] / _LOG_SIZE_PRIOR])

        def jacobian(z: Array) -> Array:
            change = np.eye(layout.size) / prior[:, None]
            for i in range(n if self._consistent else 0):
                link = layout.link(i)
                change[link, link] = from_log_cholesky(z[link])[1] / prior[link, None]
            return np.vstack([A @ change, change, np.eye(layout.size)[sizes] / _LOG_SIZE_PRIOR])

        z = np.maximum(linear, 1e-6 * prior)
        z[~positive] = start[~positive]
        for i in range(n if self._consistent else 0):
            z[layout.link(i)] = to_log_cholesky(regularized(start[layout.link(i)], _MIN_MASS_KG, _MIN_LENGTH_M))
        first = z.copy()
        sizes = np.flatnonzero(np.arange(layout.size) % PARAMETERS < _DIAGONAL)  # the logarithms in the Cholesky factors
        sizes = sizes[sizes < layout.rotor.start] if self._consistent else sizes[:0]
        low = np.where(positive, 0.0, -np.inf)
        solve: Any = least_squares  # its stubs demand a name for the Jacobian
        found = solve(
            residual, z, jacobian, bounds=(low, np.inf), x_scale="jac", max_nfev=_MAX_EVALUATIONS, ftol=1e-7, xtol=1e-9
        )
        return parameters(found.x)

    def _inflation(self) -> Array:
        """1 + 2 times the sum of the residuals' autocorrelations, until they are first negative; at least 1."""
        training = self.training
        residual = training.used * (training.tau - self.predicted(training))
        out = np.ones(residual.shape[1])
        for j, column in enumerate(residual.T):
            column = column - column.mean()
            power = max(float(column @ column), np.finfo(float).tiny)
            for lag in range(1, min(_MAX_CORRELATED_ROWS, len(column) - 1)):
                correlation = float(column[lag:] @ column[:-lag]) / power
                if correlation <= 0:
                    break
                out[j] += 2 * correlation
        return out
