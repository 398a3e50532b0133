"""The fit of all parameters of an arm to recorded torques: filtered regressor, delay, friction, physical consistency."""

import numpy as np

from armctl.core.log import Log, LogSource
from armctl.core.validation import Array
from armctl.lab.identification.constrained_solution import constrained_solution
from armctl.lab.identification.filtered_recording import ROWS_PER_PERIOD, TRIMMED_PERIODS, FilteredRecording
from armctl.lab.identification.fit_samples import FitSamples
from armctl.lab.identification.friction_fit import SIGNIFICANT_ERRORS, FrictionFit, LeftTorques
from armctl.lab.identification.regressor import ArmRegressor
from armctl.model.arm.passive_forces import DryFriction

_MAX_DELAY_S = 0.05
_ROUNDS = 3  # delay, shape of the friction and noise depend on each other
_MIN_NOISE_SHARE = 1e-4  # of the typical torque: no joint's torque is known better
_MAX_CORRELATED_ROWS = 30
_MAX_DROPPED_ERROR = 0.5  # of the prior's standard deviation: what the data do not show at all absorbs no noise
_DROPPED_PRIOR = 1e-4  # factor on the standard deviation of the prior


class ParameterFit:
    """A fit to the first rows of a recording; the others are held out.

    Attributes:
        regressor: The torques as a linear function of the parameters.
        recording: The recording, filtered.
        friction: The law of dry friction.
        x: (p,) the parameters.
        prior: (p,) their standard deviations before any data; small for parameters that are not kept.
        kept: (p,) False for friction and offsets that stay as in the model.
        noise: (n,) N m, RMS of the residuals of the fit.
        inflation: (n,) factors by which correlated residuals increase the variance of an estimate.
        delay: s, by which torques were recorded later than positions.
        rows: The rows, held out or not.
    """

    def __init__(self, regressor: ArmRegressor, log: Log, holdout: float, consistent: bool):
        is_simulated = log.source is LogSource.SIMULATION
        is_law_known = is_simulated and not log.continuous and regressor.layout.has_friction
        law = DryFriction.from_model(regressor.arm.model, regressor.arm.joint_map) if is_law_known else None
        recording = FilteredRecording(log, regressor.dynamics, law)
        self.regressor = regressor
        self.recording = recording
        self.friction = FrictionFit(regressor, recording, law)
        self.x = regressor.start.copy()
        self.prior = regressor.prior.copy()
        self.kept = np.ones(regressor.layout.size, bool)
        self._scale = regressor.torque_scale()
        self.noise = 0.02 * self._scale
        self.inflation = np.ones(regressor.layout.n)
        self.delay = 0.0
        self._holdout = holdout
        self._consistent = consistent
        self._raw = regressor.rows(recording.q, recording.v_start, recording.a, self.friction.shape)
        self._model = regressor.model_torques(recording.q, recording.v_start, recording.a)
        self._model += regressor.dynamics.damping * (recording.v_end - recording.v_start)
        self._terms = self.friction.terms(self.x[regressor.layout.coulomb])
        for _ in range(_ROUNDS):
            self._improve(may_be_delayed=not is_simulated)  # positions and torques of a simulation are of the same tick
        self.inflation = self._inflation()
        self._drop_insignificant()
        self._fit_links()

    def use_all_rows(self) -> None:
        """Repeats the last fit with the rows that were held out."""
        self._holdout = 0.0
        self._fit_links()

    def _fit_links(self) -> None:
        """Physically consistent parameters, and what remains of the torques."""
        rows = self.training
        linear = self._linear_solution(rows)
        self.x = constrained_solution(
            self.weighted(rows), self._targets(rows), linear, self.regressor, self.prior, self._consistent
        )
        self._set_noise()
        self.inflation = self._inflation()
        self.friction.follow(self.x[self.regressor.layout.coulomb])

    @property
    def training(self) -> FitSamples:
        return self.rows.part(slice(0, self._count_used()))

    @property
    def held_out(self) -> FitSamples:
        """The other rows, without a filter's length between."""
        gap = round(ROWS_PER_PERIOD * TRIMMED_PERIODS)
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
        by_shape = np.zeros((K, n, n))
        by_shape[:, np.arange(n), np.arange(n)] = self.friction.slope_error * weights * rows.by_shape
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
            small = np.abs(self.x[part] - regressor.start[part]) < SIGNIFICANT_ERRORS * errors[part]
            small &= errors[part] < _MAX_DROPPED_ERROR * regressor.prior[part]
            self.kept[part] = ~small
            self.prior[part] = np.where(small, _DROPPED_PRIOR * regressor.prior[part], regressor.prior[part])

    def _count_used(self) -> int:
        return round((1 - self._holdout) * len(self.rows))

    def _improve(self, may_be_delayed: bool) -> None:
        """One round: rows with the delay and the friction so far, parameters, then delay, friction and noise."""
        self.rows = self._filtered_rows()
        training = self.training
        self.x = self._linear_solution(training)
        self._set_noise()
        if may_be_delayed:
            self._improve_delay(training)
        if self.regressor.layout.has_friction:
            self._improve_friction()

    def _filtered_rows(self) -> FitSamples:
        """Regressor, model and torques through the same filter; torques moved back by the delay."""
        recording = self.recording
        terms = self._terms
        self.regressor.set_friction(self._raw, recording.v_end, terms.columns)
        K, n, p = self._raw.shape
        together = np.concatenate(
            [self._raw.reshape(K, n * p), self._model, recording.v, terms.start, terms.by_shape, terms.rest], axis=1
        )
        filtered = recording.filtered_again(together)
        W = filtered[:, : n * p].reshape(K, n, p)
        model, v, start, by_shape, rest = np.split(filtered[:, n * p :], 5, axis=1)
        used = np.column_stack([recording.slides(j, speed) for j, speed in enumerate(self.friction.sliding)])
        rows = recording.rows
        return FitSamples(
            t=recording.t[rows],
            v=v[rows],
            tau=recording.torques(self.delay)[rows],
            model=(model + rest)[rows],
            W=W[rows],
            start=(model + start)[rows],
            by_shape=by_shape[rows],
            used=used[rows].astype(np.float64),
        )

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
        is_certain = abs(delay) > SIGNIFICANT_ERRORS * error
        self.delay = float(np.clip(delay, -_MAX_DELAY_S, _MAX_DELAY_S)) if is_certain else 0.0

    def _improve_friction(self) -> None:
        """The law of dry friction that explains the torques of each joint best, the other parameters as they are."""
        rows = self.training
        layout = self.regressor.layout
        without = self.x - self.regressor.model_values
        for part in (layout.viscous, layout.coulomb, layout.stribeck, layout.offset):
            without[part] = 0.0
        left = LeftTorques(
            tau=rows.tau - rows.model - rows.W @ without,
            v=rows.v,
            noise=self.noise * np.sqrt(self.inflation),
            rows=self.recording.first_rows(self._count_used()),
        )
        self.friction.improve(left, self._terms)
        self._terms = self.friction.terms(self.x[layout.coulomb])
        self.rows = self._filtered_rows()

    def _targets(self, rows: FitSamples) -> Array:
        """(K n,) what the start leaves of the torques, in units of the noise."""
        predicted = rows.model + rows.W @ (self.regressor.start - self.regressor.model_values)
        return (self._weights(rows) * (rows.tau - predicted)).ravel()

    def _linear_solution(self, rows: FitSamples) -> Array:
        """Least squares with the prior, without bounds."""
        W = self.weighted(rows)
        dx = np.linalg.solve(W.T @ W + np.eye(W.shape[1]), W.T @ self._targets(rows))
        return self.regressor.start + self.prior * dx

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
