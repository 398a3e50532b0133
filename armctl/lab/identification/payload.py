"""Payload identification: mass, centre and inertia of a body at the tip, and the friction of the joints, from one run."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from armctl.core.defaults import FINDING_ERRORS
from armctl.core.errors import InputError
from armctl.core.log import Log
from armctl.core.result import Verdict
from armctl.core.validation import Array, frozen, instance
from armctl.lab.identification.pseudo_inertia import tensor_of
from armctl.model.arm.arm import Arm, check_arm
from armctl.model.arm.dynamics import Dynamics
from armctl.model.loading.inertias import nearest_inertia

_MOMENT = slice(1, 4)  # behind the mass
_INERTIA = slice(4, 10)  # elements about the centre of mass
_PAYLOAD_PARAMETERS = 10  # behind them come Coulomb and viscous friction of each joint
_CUTOFF_HZ = 10.0  # -3 dB, of the zero-phase filter that both sides of the fit go through
_FILTER_SIGMAS = 4.0  # at which its Gaussian window ends
_MIN_WINDOWS = 4  # that a run must last
_MIN_SPEED = 0.05  # rad/s (m/s): below it the sign of a velocity is noise, and dry friction with it
_TORQUE_NOISE = 2e-3  # of the torque limit: no joint's torque is known better, however well a fit goes
_MAX_RELATIVE_ERROR = 0.1  # of the mass; with a larger standard error nothing is identified
_SMALL_MASS_KG = 0.5  # from which on the error is relative to the mass
# Standard deviations, kg, kg m and kg m^2: parameters that are not shown stay within them.
_PRIOR = (50.0, *(0.5,) * 3)
_PRIOR_GYRATION = 0.1  # m, the radius that gives a body of the mass found so far, or of the small one, its moments of inertia
_MAX_SATURATED_SHARE = 0.05  # of a run that a motor spends at its torque limit
_MIN_OSCILLATION = 0.2  # rad/s (m/s): smaller differences from the velocity of the reference are noise
_ROUNDS = 8  # of the fit: inertia is not linear in a payload's centre, and joints differ in noise
# Standard errors by which friction of the model is too high, or a moment of inertia is above 0, to be reported.
_STATES = 20  # random states at which the regressor of the mass is compared with that of the centre
_MIN_INDEPENDENT_SHARE = 1e-6  # of the mass's regressor that is not round-off


@dataclass(frozen=True, eq=False)
class PayloadEstimate(Verdict):
    """A payload, and friction that the model does not have, identified from one run. True if the run determines them.

    Attributes:
        ok: Whether the run determines them.
        reason: The reason if it is not ok; empty if it is.
        mass: kg; NaN, like all numbers here, where nothing could be fitted.
        mass_error: kg, its standard error.
        center: (3,) m, in the tip's frame.
        center_error: (3,) m, standard errors; infinite if the run does not determine the center.
        inertia: (3, 3) kg m^2 about the center of mass, in the tip's axes: of the body that is nearest to what was fitted.
        inertia_error: (3, 3) kg m^2, standard errors of what was fitted; infinite if the run does not determine an element.
        coulomb_friction: (n,) N m of dry friction.
        coulomb_error: (n,) N m, standard errors.
        viscous_friction: (n,) N m s/rad of damping.
        viscous_error: (n,) N m s/rad, standard errors.
        findings: Joints whose friction in the model is too high, one sentence each.
    """

    ok: bool
    reason: str
    mass: float
    mass_error: float
    center: Array
    center_error: Array
    inertia: Array
    inertia_error: Array
    coulomb_friction: Array
    coulomb_error: Array
    viscous_friction: Array
    viscous_error: Array
    findings: tuple[str, ...] = ()

    def __str__(self) -> str:
        if not self.ok:
            return f"not identified: {self.reason}"
        known = zip(self.center, self.center_error, strict=True)
        center = ", ".join(f"{1e3 * c:.1f}+-{1e3 * e:.1f}" if math.isfinite(e) else "not shown" for c, e in known)
        payload = f"{self.mass:.4f}+-{self.mass_error:.4f} kg at [{center}] mm from the tip"
        moments = list(zip(self.inertia.diagonal(), self.inertia_error.diagonal(), strict=True))
        if any(moment > FINDING_ERRORS * error for moment, error in moments):
            listed = ", ".join(f"{m:.5f}+-{e:.5f}" if math.isfinite(e) else "not shown" for m, e in moments)
            payload += f", moments of inertia [{listed}] kg m^2"
        return "\n".join([payload, *self.findings])

    def applied_to(self, arm: Arm) -> Arm:
        """An arm's model with what was identified: give it to a controller.

        Args:
            arm: The arm that the run was of.

        Returns:
            The arm with payload and friction. Negative friction reduces that of the model, to 0 at the least.

        Raises:
            InputError: Nothing was identified, or the argument is no arm with as many joints.
        """
        instance("arm", arm, Arm, "armctl.load returns one")
        if not self.ok:
            raise InputError(f"estimate: {self}")
        if arm.n != len(self.coulomb_friction):
            raise InputError(f"arm: {arm.n} joints, but the estimate is of an arm with {len(self.coulomb_friction)}")
        coulomb = np.maximum(self.coulomb_friction, -arm.model.dof_frictionloss[arm.dof_adr])
        viscous = np.maximum(self.viscous_friction, -arm.model.dof_damping[arm.dof_adr])
        mass = max(self.mass, 0.0)
        inertia = self.inertia if mass else np.zeros(3)
        return arm.with_payload(mass, self.center, inertia, coulomb_friction=coulomb, viscous_friction=viscous)


def identify_payload(arm: Arm, log: Log) -> PayloadEstimate:
    """Identifies payload and friction from the torques of a run.

    Least squares of the torques that the arm's model leaves over on the ten inertial parameters of a body at the tip, Coulomb
    and viscous friction, both sides through the same zero-phase filter; after Swevers, Verdonck, De Schutter, "Dynamic model
    identification for industrial robots" (2007), and Gautier, "Dynamic identification of robots with power model" (1997) for
    the filter. A motion that is slow, or an arm with much friction, hardly shows the inertia about the center of mass: a wide
    prior keeps it small then, and its standard error is large.

    Args:
        log: A run of it with the payload, best along `excitation`.

    Returns:
        The estimate; if the run does not determine it, `ok` is False with a reason.

    Raises:
        InputError: It is not an arm, not a log, or the log is of an arm with other joints.
    """
    check_arm(arm)
    instance("log", log, Log, "armctl.simulate and every move of a Simulation that is not refused give one")
    if log.joint_names != arm.joint_names:
        recorded = ", ".join(log.joint_names)
        wanted = ", ".join(arm.joint_names)
        raise InputError(f"log: it is of the joints {recorded:.120}, but the arm has {wanted:.120}")
    least = _MIN_WINDOWS * (2 * RowFilter(log.dt).radius + 1)
    if len(log) < least:
        return _nothing(arm, f"the run lasts {len(log) * log.dt:.2f} s, and at least {least * log.dt:.2f} s are needed")
    if not (np.abs(log.v) > 2 * _MIN_SPEED).any():
        return _nothing(arm, "no joint moves; follow armctl.excitation(arm)")
    disturbed = _disturbed(arm, log)
    if disturbed:
        return _nothing(arm, disturbed)
    fit = _PayloadFit(arm, log)
    for _ in range(_ROUNDS):
        fit.improve()
    return _judged(fit)


def _disturbed(arm: Arm, log: Log) -> str:
    """Why a run with saturated motors or oscillations, which look like payload, shows none; empty if there are neither."""
    saturated = (np.abs(log.tau) >= (1 - 1e-6) * arm.limits.tau_max).mean(axis=0)
    worst = int(saturated.argmax())
    cure = "repeat the run with lower gains or computed-torque"
    if saturated[worst] > _MAX_SATURATED_SHARE:
        share = f"{100 * saturated[worst]:.0f} % of the run"
        return (
            f"{arm.joint_names[worst]:.80} is at its torque limit in {share}: it oscillates, or the motion is too fast; {cure}"
        )
    beside = np.sqrt(np.mean((log.v - log.v_ref) ** 2, axis=0))
    ratio = beside / np.maximum(np.sqrt(np.mean(log.v_ref**2, axis=0)), _MIN_OSCILLATION)
    worst = int(ratio.argmax())
    if ratio[worst] > 1.0:
        return f"{arm.joint_names[worst]:.80} oscillates: it moves faster beside its reference than the reference does; {cure}"
    return ""


class RowFilter:
    """A zero-phase low-pass filter: a Gaussian window whose spectrum is down 3 dB at the cut-off."""

    def __init__(self, dt: float):
        self._sigma = math.sqrt(math.log(2)) / (2 * math.pi * _CUTOFF_HZ * dt)  # samples
        self.radius = math.ceil(_FILTER_SIGMAS * self._sigma)
        self._stride = max(1, round(0.25 / _CUTOFF_HZ / dt))

    def __call__(self, columns: Array) -> Array:
        """Columns over time (T, k), filtered, without the ends, and with no more rows than the filter lets through."""
        from scipy.ndimage import gaussian_filter1d

        filtered = gaussian_filter1d(columns, self._sigma, axis=0, radius=self.radius)
        return filtered[self.radius : len(columns) - self.radius : self._stride]


class _PayloadFit:
    """The equations of one run, the parameters that explain it so far, and how well they are known."""

    def __init__(self, arm: Arm, log: Log):
        self.arm = arm
        self._dt = log.dt
        self._filtered = RowFilter(log.dt)
        self._q = log.q[:-1]
        self._v = log.v[:-1]
        self._tau = log.tau[:-1]
        self._a = np.diff(log.v, axis=0) / log.dt
        self.prior = np.concatenate([_PRIOR, np.zeros(6), np.tile(arm.limits.tau_max, 2)])
        self._noise = _TORQUE_NOISE * arm.limits.tau_max
        self.theta = np.zeros(len(self.prior))
        self._used = np.abs(self._filtered(self._v)) > _MIN_SPEED
        dynamics = Dynamics(arm.model, arm.pinocchio_model)
        rows = zip(self._q, self._v, self._a, strict=True)
        self._regressors = np.array([dynamics.payload_regressor(*row) for row in rows])  # (T, n, 10)
        self._X = self._columns()[self._used]
        self.error = self.prior

    def improve(self) -> None:
        """A Gauss-Newton step, each joint weighed by its noise, the prior as weak as it is wide."""
        self.prior[_INERTIA] = max(self.theta[0], _SMALL_MASS_KG) * _PRIOR_GYRATION**2
        residual = self._filtered(self._left_over())
        scale = (1 / np.broadcast_to(self._noise, self._used.shape))[self._used]
        X = self._X * scale[:, None]
        r = residual[self._used] * scale
        information = X.T @ X + np.diag(self.prior**-2.0)
        self.theta = self.theta + np.linalg.solve(information, X.T @ r - self.theta / self.prior**2)
        self.error = np.sqrt(np.diag(np.linalg.inv(information)))
        left = np.zeros(self._used.shape)
        left[self._used] = residual[self._used] - self._X @ np.linalg.solve(information, X.T @ r)
        spread = np.sqrt((left**2).sum(axis=0) / np.maximum(self._used.sum(axis=0), 1))
        self._noise = np.maximum(spread, _TORQUE_NOISE * self.arm.limits.tau_max)

    def _columns(self) -> Array:
        """(T, n, 10 + 2 n): what each parameter adds to each joint's torque, filtered."""
        n = self.arm.n
        payload = self._regressors
        eye = np.eye(n)
        return np.concatenate(
            [
                self._filtered(payload.reshape(len(payload), -1)).reshape(-1, n, _PAYLOAD_PARAMETERS),
                self._filtered(np.sign(self._v))[:, :, None] * eye,
                self._filtered(self._v)[:, :, None] * eye,
            ],
            axis=2,
        )

    def _left_over(self) -> Array:
        """(T, n) N m that the model with the parameters so far does not explain."""
        mass = self.theta[0]
        moment = self.theta[_MOMENT]
        coulomb, viscous = self.theta[_PAYLOAD_PARAMETERS:].reshape(2, -1)
        positive = mass > _MAX_RELATIVE_ERROR * _SMALL_MASS_KG
        known = self.arm.with_payload(mass, moment / mass) if positive else self.arm
        dynamics = Dynamics(known.model, known.pinocchio_model)
        rows = zip(self._q, self._v, self._a, strict=True)
        explained = np.array([dynamics.discrete_inverse_dynamics(q, v, a, self._dt) for q, v, a in rows])
        explained += np.sign(self._v) * (dynamics.friction_loss + coulomb) + self._v * viscous
        linear = self.theta[:_PAYLOAD_PARAMETERS].copy()
        if positive:
            linear[: _INERTIA.start] = 0.0
        return self._tau - explained - self._regressors @ linear


def _judged(fit: _PayloadFit) -> PayloadEstimate:
    mass = float(fit.theta[0])
    error = float(fit.error[0])
    reason = ""
    if error > _MAX_RELATIVE_ERROR * max(mass, _SMALL_MASS_KG):
        why = "the joints that carry it move too little or have too much friction; follow armctl.excitation(arm)"
        if not _can_show_mass(fit.arm):
            why = "and no motion of this arm separates it from the payload's center"
        reason = f"the mass is known to {error:.2g} kg only, {why}"
    elif mass < -2 * error:
        reason = f"the torques ask for a payload of {mass:.3g} kg: the arm's model has too much mass already"
    return _estimate(fit.arm, reason, fit.theta, fit.error, fit.prior)


def _can_show_mass(arm: Arm) -> bool:
    """Whether a payload's mass shows otherwise than its centre does: not where all joints turn about one vertical line."""
    rng = np.random.default_rng(0)
    dynamics = Dynamics(arm.model, arm.pinocchio_model)
    limits = arm.limits
    positions = limits.random(limits.clamp(arm.home), _STATES, rng)
    rates = rng.uniform(-1, 1, (_STATES, 2, arm.n))
    Y = np.vstack([dynamics.payload_regressor(q, *rows) for q, rows in zip(positions, rates, strict=True)])
    explained = Y[:, 1:] @ np.linalg.lstsq(Y[:, 1:], Y[:, 0])[0]
    return bool(np.linalg.norm(Y[:, 0] - explained) > _MIN_INDEPENDENT_SHARE * np.linalg.norm(Y))


def _estimate(arm: Arm, reason: str, theta: Array, error: Array, prior: Array) -> PayloadEstimate:
    known = abs(theta[0]) > _MAX_RELATIVE_ERROR * _SMALL_MASS_KG
    center = theta[_MOMENT] / theta[0] if known else np.zeros(3)
    shown = known & (error[:_PAYLOAD_PARAMETERS] < 0.5 * prior[:_PAYLOAD_PARAMETERS])  # beyond that it is the prior's
    errors = np.where(shown, error[:_PAYLOAD_PARAMETERS], np.inf)
    coulomb, viscous = theta[_PAYLOAD_PARAMETERS:].reshape(2, arm.n)
    coulomb_error, viscous_error = error[_PAYLOAD_PARAMETERS:].reshape(2, arm.n)
    return PayloadEstimate(
        ok=not reason,
        reason=reason,
        mass=float(theta[0]),
        mass_error=float(error[0]),
        center=frozen(center.copy()),
        center_error=frozen(errors[_MOMENT] / max(abs(theta[0]), 1e-9)),
        inertia=frozen(nearest_inertia(tensor_of(theta[_INERTIA])) if known else np.zeros((3, 3))),
        inertia_error=frozen(tensor_of(errors[_INERTIA])),
        coulomb_friction=frozen(coulomb.copy()),
        coulomb_error=frozen(coulomb_error.copy()),
        viscous_friction=frozen(viscous.copy()),
        viscous_error=frozen(viscous_error.copy()),
        findings=_findings(arm, (coulomb, viscous), (coulomb_error, viscous_error)),
    )


def _findings(arm: Arm, frictions: tuple[Array, Array], errors: tuple[Array, Array]) -> tuple[str, ...]:
    kinds = (("frictionloss", "N m", "N"), ("damping", "N m s/rad", "N s/m"))
    found = []
    for (what, turning, sliding), friction, error in zip(kinds, frictions, errors, strict=True):
        for i in np.flatnonzero(friction < -FINDING_ERRORS * error):
            unit = turning if arm.units[i] == "rad" else sliding
            found.append(f"the model's {what} of {arm.joint_names[i]} is {-friction[i]:.3g} {unit} too high")
    return tuple(found)


def _nothing(arm: Arm, reason: str) -> PayloadEstimate:
    unknown = np.full(_PAYLOAD_PARAMETERS + 2 * arm.n, np.nan)
    return _estimate(arm, reason, unknown, unknown, unknown)
