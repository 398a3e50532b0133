"""identify: the inertia and friction of an arm from a recording, with everything that speaks against the result."""

from __future__ import annotations

import os
from typing import NamedTuple

import numpy as np

from armctl.core.defaults import FINDING_ERRORS
from armctl.core.errors import InputError
from armctl.core.log import Log, LogSource
from armctl.core.validation import Array, BoolArray, IntArray, choice, flag, frozen, instance, number, shown
from armctl.lab.identification.arm_estimate import ArmEstimate, Validation, counted
from armctl.lab.identification.parameter_fit import ParameterFit
from armctl.lab.identification.pseudo_inertia import PARAMETERS, is_consistent
from armctl.lab.identification.regressor import ArmRegressor, condition_number, pivoted_qr
from armctl.model.arm.arm import Arm, check_arm

FRICTION_MODELS = ("none", "coulomb+viscous", "stribeck")
_MIN_DURATION_S = 2.0
_MIN_FILTERED_ROWS = 50  # filtered, of the fit
_MIN_HELD_OUT_SAMPLES = 10
_MIN_SPEED = 0.02  # rad/s (m/s): a joint that never moves faster stands still
# A base parameter counts as excited if the data reduce its standard deviation to this share of that before any data.
_MAX_UNCERTAINTY_SHARE = 0.5
_SIGNIFICANT_SHARE = 0.1  # of a joint's typical torque: the uncertainty of the torques of random states that is accepted
_MAX_CONDITION = 1e5  # of columns of equal length; above, small errors of the positions change the result more than the data
_MAX_RELATIVE_ERROR = 0.5  # of the standard deviation of a measured torque
_MIN_TORQUE_SHARE = 0.01  # of the typical torque: a smaller error is no failure
_MIN_LIMIT_SHARE = 0.01  # of the torque limit: a typical torque is at least this
_NOISE_FACTOR = 2.0  # an error up to this factor times the noise of the measured torque is no failure
_FINDING_SHARE = 0.02  # of the typical torque at 1 rad/s, for friction


class _Base(NamedTuple):
    """The combinations of parameters that torques depend on."""

    leading: IntArray  # (b,) the parameter that leads each combination
    combination: Array  # (b, p), in units of the prior's standard deviations
    torques: Array  # (T, n, b), torques of random states for a standard deviation of the prior, as shares of a typical torque


def identify(
    arm: Arm,
    log: Log | str | os.PathLike[str],
    friction: str = "coulomb+viscous",
    consistent: bool = True,
    *,
    holdout: float = 0.2,
) -> ArmEstimate:
    """Identifies inertia, rotor inertia, friction and torque offsets of an arm from recorded positions and torques.

    Torques are linear in the parameters (Pinocchio's regressor). Positions, regressor and torques pass the same zero-phase
    filter; velocities are not used. Base parameters follow from a QR factorization with pivoting; a prior keeps what the data
    do not show near the model. With `consistent`, links have Cholesky factors of their pseudo-inertia as parameters, so a rigid
    body can have them. A fit without the last part of the recording predicts its torques; if that succeeds, the result is a fit
    to the whole recording.

    Sources: Gautier, "Numerical calculation of the base inertial parameters of robots" (1991); Swevers, Verdonck,
    De Schutter, "Dynamic model identification for industrial robots" (2007); Rucker, Wensing, "Smooth parameterization of
    rigid-body inertia" (2022).

    Args:
        log: A recording, or a CSV file with the default columns of `Log.from_csv` in the arm's units.
        friction: "none", "coulomb+viscous", or "stribeck" for a breakaway torque as well.
        consistent: Whether each link must be physically consistent.
        holdout: Share of the recording, at its end, that validates the fit, in [0.05, 0.5].

    Returns:
        The estimate. It is not ok, with a reason, if the motion did not excite a parameter that matters, the regressor is badly
        conditioned, or the prediction of the held-out torques fails.

    Raises:
        InputError: An argument is wrong, or the log is of other joints.
        ModelError: A joint of the arm follows another one, or only a part of a link is lifted by gravity compensation.
    """
    check_arm(arm)
    friction = choice("friction", friction, FRICTION_MODELS)
    consistent = flag("consistent", consistent)
    holdout = number("holdout", holdout, 0.05, 0.5)
    log = _read_log(arm, log)
    fit = ParameterFit(ArmRegressor(arm, friction), log, holdout, consistent)
    return _judged(fit, friction)


def _read_log(arm: Arm, log: Log | str | os.PathLike[str]) -> Log:
    if isinstance(log, (str, os.PathLike)):
        units = {"q": arm.units, "tau": arm.torque_units}
        log = Log.from_csv(log, units=units, robot=arm.name)
    instance("log", log, Log, "armctl.simulate and armctl.Log.from_csv give one")
    if log.q.shape[1] != arm.n:
        raise InputError(f"log: {log.q.shape[1]} joints are recorded, but {arm.name:.80} has {arm.n}")
    if log.source is not LogSource.RECORDING and log.joint_names != arm.joint_names:
        raise InputError(f"log: it is of the joints {shown(log.joint_names)}, but the arm has {shown(arm.joint_names)}")
    if log.units != arm.units:
        raise InputError(f"log: its joints are measured in {shown(log.units)}, those of the arm in {shown(arm.units)}")
    duration = len(log) * log.dt
    if duration < _MIN_DURATION_S:
        raise InputError(f"log: expected at least {_MIN_DURATION_S:g} s, got {duration:.2f} s")
    if len(log) and np.isnan(log.tau).all():
        raise InputError("log: tau: the robot measured no torque; identify needs that of torque sensors")
    for name in ("q", "tau"):
        if not np.isfinite(getattr(log, name)).all():
            raise InputError(f"log: {name}: a number is not finite")
    arm.check_units("log: q", log.q, "Log.from_csv(path, units={'q': 'deg'}) reads degrees")
    return log


def _judged(fit: ParameterFit, friction: str) -> ArmEstimate:
    regressor = fit.regressor
    arm = regressor.arm
    layout = regressor.layout
    validation = _validated(fit)
    if validation:
        fit.use_all_rows()
    base = _base_parameters(fit)
    W = fit.weighted(fit.training)
    covariance = fit.covariance()
    errors = regressor.prior * np.sqrt(np.diag(covariance))
    base_covariance = base.combination @ covariance @ base.combination.T
    hidden = _hidden(base, base_covariance)
    names = np.array(regressor.names)[base.leading]
    unexcited = tuple(str(name) for name in names[hidden])
    condition = condition_number(W[:, base.leading[fit.kept[base.leading]]])
    reason = _reason(fit, unexcited, condition, validation)
    scale = regressor.prior[base.leading]
    links = fit.x[: PARAMETERS * arm.n].reshape(arm.n, PARAMETERS)
    zero = np.zeros(arm.n)
    has_friction = layout.has_friction
    return ArmEstimate(
        ok=not reason,
        reason=reason,
        arm=arm,
        friction=friction,
        inertia=frozen(links.copy()),
        inertia_error=frozen(errors[: PARAMETERS * arm.n].reshape(arm.n, PARAMETERS).copy()),
        consistent=frozen(np.array([is_consistent(link) for link in links])),
        rotor_inertia=frozen(fit.x[layout.rotor].copy()),
        rotor_inertia_error=frozen(errors[layout.rotor].copy()),
        viscous_friction=frozen(fit.x[layout.viscous].copy() if has_friction else zero),
        viscous_error=frozen(errors[layout.viscous].copy() if has_friction else zero),
        coulomb_friction=frozen(fit.x[layout.coulomb].copy() if has_friction else zero),
        coulomb_error=frozen(errors[layout.coulomb].copy() if has_friction else zero),
        breakaway=frozen(fit.x[layout.stribeck].copy() if layout.has_stribeck else zero),
        friction_speeds=fit.friction.shape,
        torque_offset=frozen(fit.x[layout.offset].copy()),
        delay=fit.delay,
        cutoff=fit.recording.cutoff,
        base_names=tuple(str(name) for name in names),
        base_values=frozen(scale * (base.combination @ (fit.x / regressor.prior))),
        base_errors=frozen(scale * np.sqrt(np.diag(base_covariance))),
        unexcited=unexcited,
        condition_number=condition,
        findings=_findings(fit, errors),
        validation=validation,
    )


def _base_parameters(fit: ParameterFit) -> _Base:
    """Base parameters by QR with pivoting of the regressor of random states, its columns in units of the prior."""
    regressor = fit.regressor
    states = regressor.random_states()
    torques = regressor.rows(*states, fit.friction.shape)
    if regressor.layout.has_friction:
        joints = np.arange(regressor.layout.n)
        torques[:, joints, regressor.layout.coulomb.start + joints] = fit.friction.effect(states[1])
    torques /= _typical_torque(fit)[:, None]
    W = torques.reshape(-1, regressor.layout.size) * regressor.prior
    R, order, count = pivoted_qr(W)
    dependent = np.linalg.solve(R[:count, :count], R[:count, count:])
    combination = np.zeros((count, len(order)))
    combination[np.arange(count), order[:count]] = 1.0
    combination[:, order[count:]] = dependent
    leading = order[:count]
    return _Base(leading, combination, (torques * regressor.prior)[:, :, leading])


def _typical_torque(fit: ParameterFit) -> Array:
    """(n,) N m, to which uncertain torques are compared."""
    limits = fit.regressor.arm.limits.tau_max
    least = np.where(np.isfinite(limits), _MIN_LIMIT_SHARE * limits, 0.0)
    return np.maximum(fit.regressor.torque_scale(), least)


def _hidden(base: _Base, covariance: Array) -> BoolArray:
    """Base parameters that leave torques of random states uncertain, if any are: uncertain alone, they do no harm."""
    torques = np.sqrt(np.einsum("tni,ij,tnj->n", base.torques, covariance, base.torques) / len(base.torques))
    if (torques < _SIGNIFICANT_SHARE).all():
        return np.zeros(len(covariance), bool)
    deviation = np.sqrt(np.diag(covariance))
    effect = np.sqrt((base.torques**2).mean(axis=0)).max(axis=0) * deviation
    hidden = (deviation > _MAX_UNCERTAINTY_SHARE * np.linalg.norm(base.combination, axis=1)) & (effect > _SIGNIFICANT_SHARE)
    hidden[int(effect.argmax())] = True
    return hidden


def _validated(fit: ParameterFit) -> Validation:
    held_out = fit.held_out
    arm = fit.regressor.arm
    predicted = fit.predicted(held_out)
    by_model = held_out.start
    if len(held_out) < _MIN_HELD_OUT_SAMPLES:
        rms = np.full(arm.n, np.nan)
        model_rms = rms
        relative = rms
        reason = f"only {len(held_out)} samples are held out, {_MIN_HELD_OUT_SAMPLES} are needed; record a longer motion"
    else:
        rms = np.sqrt(((held_out.tau - predicted) ** 2).mean(axis=0))
        model_rms = np.sqrt(((held_out.tau - by_model) ** 2).mean(axis=0))
        relative = rms / np.maximum(held_out.tau.std(axis=0), np.finfo(float).tiny)
        reason = _failure(fit, rms, model_rms, relative)
    return Validation(
        ok=not reason,
        reason=reason,
        t=frozen(held_out.t.copy()),
        measured=frozen(held_out.tau.copy()),
        predicted=frozen(predicted),
        by_model=frozen(by_model),
        rms=frozen(rms),
        model_rms=frozen(model_rms),
        relative=frozen(relative),
    )


def _failure(fit: ParameterFit, rms: Array, model_rms: Array, relative: Array) -> str:
    arm = fit.regressor.arm
    moving = np.abs(fit.held_out.v).max(axis=0) > _MIN_SPEED
    if not moving.any():
        return "no joint moves in the held-out part"
    floor = np.maximum(_MIN_TORQUE_SHARE * fit.regressor.torque_scale(), _NOISE_FACTOR * fit.recording.torque_noise)
    bad = (rms > floor) & ((relative > _MAX_RELATIVE_ERROR) | (rms > model_rms + floor))
    if not bad.any():
        return ""
    i = int(np.where(bad, rms / floor, 0.0).argmax())
    name = arm.joint_names[i]
    unit = arm.torque_units[i]
    if rms[i] > model_rms[i] + floor[i]:
        return f"{name:.60}: held-out torque error {rms[i]:.3g} {unit}, {model_rms[i]:.3g} {unit} by the model before the fit"
    return f"{name:.60}: held-out torque error {rms[i]:.3g} {unit}, {100 * relative[i]:.0f} % of its standard deviation"


def _reason(fit: ParameterFit, unexcited: tuple[str, ...], condition: float, validation: Validation) -> str:
    arm = fit.regressor.arm
    training = fit.training
    if len(training) < _MIN_FILTERED_ROWS:
        return f"only {len(training)} independent samples at a cut-off of {fit.recording.cutoff:.3g} Hz; record a longer motion"
    still = np.abs(training.v).max(axis=0) < _MIN_SPEED
    if still.any():
        names = tuple(name for name, is_still in zip(arm.joint_names, still, strict=True) if is_still)
        return f"these joints do not move: {counted(names)}; follow armctl.excitation(arm, for_='arm')"
    if condition > _MAX_CONDITION:
        return f"the condition number is {condition:.3g}, above {_MAX_CONDITION:g}; record a richer motion"
    if unexcited:
        return f"the motion does not excite {counted(unexcited)}; follow armctl.excitation(arm, for_='arm')"
    return f"validation failed: {validation.reason}" if not validation else ""


def _findings(fit: ParameterFit, errors: Array) -> tuple[str, ...]:
    """Differences of friction and rotor inertia from the model that are certain and large."""
    regressor = fit.regressor
    arm = regressor.arm
    layout = regressor.layout
    scale = _FINDING_SHARE * regressor.torque_scale()
    kinds = [("armature", layout.rotor, " kg m^2", " kg"), ("damping", layout.viscous, " N m s/rad", " N s/m")]
    kinds.append(("frictionloss", layout.coulomb, " N m", " N"))
    found = []
    for what, part, turning, sliding in kinds if layout.has_friction else kinds[:1]:
        change = fit.x[part] - regressor.start[part]
        for i in np.flatnonzero((np.abs(change) > FINDING_ERRORS * errors[part]) & (np.abs(change) > scale)):
            side = "low" if change[i] > 0 else "high"
            unit = turning if arm.units[i] == "rad" else sliding
            found.append(f"the model's {what} of {arm.joint_names[i]} is {abs(change[i]):.3g}{unit} too {side}")
    return tuple(found)
