"""identify_servo: rotor inertia, gains, friction, offsets, backlash and delay of position servos, from positions alone."""

from __future__ import annotations

import copy
import math
import os
from dataclasses import dataclass

import mujoco
import numpy as np

from armctl.core.errors import InputError
from armctl.core.log import Log
from armctl.core.validation import Array, frozen, instance
from armctl.lab.identification.identified_model import IdentifiedArm
from armctl.lab.identification.servo_fit import PER_JOINT, SETTLING_S, ServoFit, is_lower
from armctl.lab.identification.servo_simulation import ServoParameters, ServoSimulation, set_rotors_and_friction
from armctl.model.arm.arm import Arm, check_arm, with_model
from armctl.model.loading.catalog import locate

_BANDWIDTH = 20.0  # rad/s, where to start with a file that has no servos
_INERTIA_SHARE = 0.05  # of a joint's inertia, where to start with a file that has no rotor inertia
_MAX_STARTS = 4
_START_EVALUATIONS = 5  # of each start, before the best go on
_MAX_SOLVED = 2
_SAME_DELAY_S = 0.002
_ON_JOINTS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_MIN_SECONDS = 3.0
_MAX_NOISE_RATIO = 2.5  # of an error over the noise of the positions, beside:
_MAX_MODEL_ERROR = 0.01  # of the difference between command and position: what steps of the simulation are off
_NOISE_ORDER = 6  # of the differences that show noise; of motions below a tenth of the sampling rate they leave nothing
_MAX_UNEXPLAINED = 0.5  # of the difference between command and position along the judge


@dataclass(frozen=True, slots=True, eq=False)
class ServoEstimate(IdentifiedArm):
    """Position servos, identified from positions. True if the second motion confirms them.

    Attributes:
        ok: Whether the judge's positions are predicted to the noise of the measured positions, and better than with the
            parameters of the file.
        reason: The reason if it is not ok; empty if it is.
        arm: The arm before.
        parameters: The identified parameters.
        errors: Their standard errors, robust to correlated residuals, and what the steps of the simulation change; they do not
            know what the model leaves out.
        file: The parameters of the file, from which the fit started.
        unseen: Names of parameters, such as "wrist armature", that the motion does not show. The least visible one has the
            file's value, unless the recording contradicts it. Others may be known relative to it: without gravity, positions
            show ratios of parameters only.
        rms: (n,) rad, of measured minus simulated positions along the recording.
        noise: (n,) rad, of the measured positions, from the step of their encoder and from what changes at every sample.
        judge_rms: (n,) rad, along the judge, which the fit did not use; NaN without a judge.
        judge_file_rms: (n,) rad, along the judge with the parameters of the file.
    """

    ok: bool
    reason: str
    arm: Arm
    parameters: ServoParameters
    errors: ServoParameters
    file: ServoParameters
    unseen: tuple[str, ...]
    rms: Array
    noise: Array
    judge_rms: Array
    judge_file_rms: Array

    def __str__(self) -> str:
        found = self.parameters
        lines = [f"{self.arm.name}: " + ("identified" if self.ok else f"not identified: {self.reason}")]
        lines.append(f"delay {1e3 * found.delay:.1f} +- {1e3 * self.errors.delay:.1f} ms")
        for i, name in enumerate(self.arm.joint_names):
            values = [
                f"{kind} {getattr(found, kind)[i]:.3g} +- {getattr(self.errors, kind)[i]:.2g}".replace("_friction", "")
                for kind in PER_JOINT
            ]
            errors = ", ".join(f"{1e3 * rms[i]:.2f}" for rms in (self.rms, self.judge_rms, self.judge_file_rms))
            lines.append(f"{name}: {', '.join(values)}; error, that along the judge, and before: {errors} mrad")
        if self.unseen:
            lines.append(f"not shown, as in the file or relative to it: {', '.join(self.unseen)}")
        return "\n".join(lines)

    def positions(self, recording: Log) -> Array:
        """The positions that the identified servos have along a recording's commands.

        Args:
            recording: A log with commands in `q_ref`; its first positions are where the simulation starts.

        Returns:
            (T, n) rad.

        Raises:
            InputError: The log has no commands, or is of other joints.
        """
        _check(self.arm, "recording", recording)
        gaps = bool(self.parameters.backlash.any())
        return ServoSimulation(self.arm, recording.dt, gaps).limit([self.parameters], recording)[0]

    def _identified(self, arm: Arm) -> Arm:
        model = copy.copy(arm.model)
        set_rotors_and_friction(model, arm, self.parameters)
        return with_model(arm, model)

    def _complete(self, spec: mujoco.MjSpec, identified: Arm) -> None:
        for i, name in enumerate(self.arm.joint_names):
            servo, *others = [each for each in spec.actuators if _is_on_joint(each, name)] or [None]
            for other in others:  # the gains are those of the joint, whatever moved it
                spec.delete(other)
            if servo is None:
                continue
            limit = self.arm.limits.tau_max[i]
            servo.set_to_position(kp=self.parameters.stiffness[i], kv=self.parameters.damping[i])
            servo.gear = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
            servo.ctrlrange = [self.arm.limits.q_min[i], self.arm.limits.q_max[i]]
            servo.forcerange = [-limit, limit] if np.isfinite(limit) else [0.0, 0.0]
            servo.delay = self.parameters.delay
            servo.nsample = int(np.ceil(self.parameters.delay / self.arm.dt)) + 1 if self.parameters.delay > 0.0 else 0


def _is_on_joint(actuator: mujoco.MjsActuator, joint: str) -> bool:
    return actuator.target == joint and int(actuator.trntype) in _ON_JOINTS


def identify_servo(arm: Arm, recording: Log, *, judge: Log, source: str | os.PathLike[str] | None = None) -> ServoEstimate:
    """Identifies the position servos of an arm from commanded and measured positions; no torques are needed.

    MuJoCo's own model, with position servos, simulates the whole recording; least squares with bounds changes rotor inertia,
    gains, Coulomb friction, offsets and backlash of all joints and one delay (output-error method: Ljung, "System
    Identification", 1999), in the limit of short steps. A backlash is zero if it is within three standard errors, or not better
    than the best fit without; it is unseen where 3 to 20 mrad of it would not be clearly worse.
    Masses of links are those of the file: gravity gives the torques their scale. Where it shows too little of it, the parameter
    with the largest error keeps the file's value. Damping of a joint has the effect of its servo's, so the file's stays.
    The search starts from servos up to 100 times as stiff or soft as those of the file, each joint by itself, at delays up to
    120 ms. It solves a further start while errors are above the noise of the positions: another minimum may be right.

    Args:
        recording: A log with commands in `q_ref` and measured positions in `q`, at least 3 s, better 30, from a rest.
            Fast motions show inertia and delay. `Log.from_positions` makes one.
        judge: The log of another motion of the same arm, which the fit does not use.
        source: The name or file that the arm was loaded from, for the gains to start with; the name of the arm if left out.

    Returns:
        The estimate. It is not ok, with a reason, if the positions of the judge are not predicted to 2.5 times their noise and,
        beside it, 1 % of what they differ from the commands, or if another delay or no backlash predicts them as well.

    Raises:
        InputError: A log has no commands, is too short or of other joints, or the source is not that of the arm.
        UnknownNameError: There is no robot of the name of the arm; give `source`.
    """
    check_arm(arm)
    _check(arm, "recording", recording)
    _check(arm, "judge", judge)
    if judge.q_ref.shape == recording.q_ref.shape and np.array_equal(judge.q_ref, recording.q_ref):
        raise InputError("judge: it has the same commands as the recording; give another motion")
    file = _of_file(arm, source)
    noise = np.maximum(_noise(recording.q), _noise(judge.q))
    fit, rivals = _best_fit(arm, recording, file, noise)
    fit.drop_unseen()
    found = fit.parameters(fit.z)
    along = ServoSimulation(arm, judge.dt, bool(found.backlash.any())).limit([found, file], judge) - judge.q
    judged = np.sqrt(np.mean(along[:, round(SETTLING_S / judge.dt) :] ** 2, axis=1))
    rms = fit.rms()
    reason = _reason(arm, judge, noise, *judged) or fit.at_bound() or better_rival(fit, rivals, judge)
    return ServoEstimate(
        ok=not reason,
        reason=reason,
        arm=arm,
        parameters=found,
        errors=fit.standard_errors(),
        file=file,
        unseen=tuple(fit.names[i] for i in np.flatnonzero(fit.unseen)),
        rms=frozen(rms),
        noise=frozen(noise),
        judge_rms=frozen(judged[0]),
        judge_file_rms=frozen(judged[1]),
    )


def _best_fit(arm: Arm, recording: Log, file: ServoParameters, noise: Array) -> tuple[ServoFit, list[ServoFit]]:
    """The best of local fits from several starts, and others that a judge has to reject."""
    largest = _largest_errors(recording, noise)
    begun: list[ServoFit] = []
    for start in ServoFit(arm, recording, file).starts()[:_MAX_STARTS]:
        fit = ServoFit(arm, recording, file)
        fit.z = start
        fit.solve(_START_EVALUATIONS)
        begun.append(fit)
    begun.sort(key=ServoFit.cost)
    fits: list[ServoFit] = []
    rivals: list[ServoFit] = []
    for fit in begun[:_MAX_SOLVED]:
        fit.solve()
        without = fit.find_backlash(noise)
        fits.append(fit)
        rivals += [] if without is None else [without]
        if (fit.rms() <= largest).all():
            break
    best = min(fits, key=ServoFit.cost)
    return best, [fit for fit in [*fits, *begun[_MAX_SOLVED:], *rivals] if fit is not best]


def better_rival(fit: ServoFit, rivals: list[ServoFit], judge: Log) -> str:
    """Why a fit with another delay or without a backlash cannot be told from the best; empty if the judge rejects each."""
    residuals = fit.along(judge)
    for rival in rivals:
        lower = is_lower(residuals, rival.along(judge), judge.dt)
        mine = fit.parameters(fit.z)
        other = rival.parameters(rival.z)
        for joint in np.flatnonzero((mine.backlash > 0.0) & (other.backlash == 0.0) & ~lower):
            return (
                f"{fit.arm.joint_names[joint]:.60}: the judge is predicted as well without a backlash as with one of "
                f"{1e3 * mine.backlash[joint]:.3g} mrad; record motions with more reversals"
            )
        if abs(mine.delay - other.delay) > _SAME_DELAY_S and not lower.any():
            return (
                f"the judge is predicted as well by a delay of {1e3 * other.delay:.3g} ms as by one of "
                f"{1e3 * mine.delay:.3g} ms; record faster motions"
            )
    return ""


def _noise(q: Array) -> Array:
    """(n,) rad, the standard deviation of the noise of measured positions: of their rounding, or of high differences."""
    values = np.diff(np.sort(q, axis=0), axis=0)
    tiny = 1e-9 * np.ptp(q, axis=0)
    step = np.min(np.where(values > tiny, values, np.inf), axis=0, initial=np.inf)
    rounding = np.where(np.isfinite(step), step / math.sqrt(12.0), 0.0)
    typical = np.median(np.abs(np.diff(q, _NOISE_ORDER, axis=0)), axis=0) / 0.6745  # of a normal distribution
    return np.maximum(rounding, typical / math.sqrt(math.comb(2 * _NOISE_ORDER, _NOISE_ORDER)))


def _lag(log: Log) -> Array:
    """(n,) rad RMS, between command and position."""
    return np.sqrt(np.mean((log.q_ref - log.q) ** 2, axis=0))


def _largest_errors(log: Log, noise: Array) -> Array:
    """(n,) rad RMS, with which positions count as predicted."""
    return np.hypot(_MAX_NOISE_RATIO * noise, _MAX_MODEL_ERROR * _lag(log))


def _reason(arm: Arm, judge: Log, noise: Array, judged: Array, by_file: Array) -> str:
    """What the judge says against the estimate; empty if nothing."""
    if np.linalg.norm(judged) > np.linalg.norm(by_file):
        return f"the file predicts the judge better: {1e3 * by_file.max():.3g} mrad instead of {1e3 * judged.max():.3g}"
    share = float(np.linalg.norm(judged) / np.linalg.norm(_lag(judge)))
    if share > _MAX_UNEXPLAINED:
        return (
            f"the error along the judge is {100 * share:.0f} % of what positions differ from commands; "
            "check joints, units and limits"
        )
    excess = judged / np.maximum(_largest_errors(judge, noise), np.finfo(float).tiny)
    worst = int(excess.argmax())
    if excess[worst] > 1.0:
        errors = f"{1e3 * judged[worst]:.3g} mrad, the noise of its positions {1e3 * noise[worst]:.3g}"
        return (
            f"{arm.joint_names[worst]:.60}: the error along the judge is {errors}; record a richer motion, "
            "or this arm has what the model leaves out, for which other parameters make up"
        )
    return ""


def _check(arm: Arm, what: str, log: Log) -> None:
    instance(what, log, Log, "armctl.Log.from_positions makes one")
    if log.joint_names != arm.joint_names:
        raise InputError(
            f"{what}: it is of the joints {', '.join(log.joint_names):.120}, the arm has {', '.join(arm.joint_names):.120}"
        )
    if not (np.isfinite(log.q).all() and np.isfinite(log.q_ref).all()):
        raise InputError(f"{what}: q and q_ref must be finite; q_ref holds the commanded positions")
    for name in ("q", "q_ref"):
        arm.check_units(f"{what}: {name}", getattr(log, name), "a Log has rad")
    if len(log) * log.dt < _MIN_SECONDS:
        raise InputError(f"{what}: expected at least {_MIN_SECONDS:g} s, got {len(log) * log.dt:.3g} s")


def _of_file(arm: Arm, source: str | os.PathLike[str] | None) -> ServoParameters:
    """The servos of the file that an arm was loaded from; gains of a default bandwidth where it has none."""
    found = locate(arm.name if source is None else source)
    spec = found.read().spec
    model = found.compile(spec)
    inertia = np.diag(arm.mass_matrix(arm.limits.clamp(arm.home)))
    armature = arm.model.dof_armature[arm.dof_adr]
    armature = np.where(armature > 0.0, armature, _INERTIA_SHARE * inertia)
    gains = np.zeros((2, arm.n))  # of all servos of a joint
    for actuator in range(model.nactuator):
        joint = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, int(model.actuator_trnid[actuator, 0]))
        if int(model.actuator_trntype[actuator]) in _ON_JOINTS and joint in arm.joint_names:
            gear = model.actuator_gear[actuator, 0]
            gains[:, arm.joint_names.index(joint)] -= model.actuator_biasprm[actuator, 1:3] * gear**2
    is_servo = gains[0] > 0.0
    stiffness = np.where(is_servo, gains[0], inertia * _BANDWIDTH**2)
    damping = np.where(is_servo & (gains[1] > 0.0), gains[1], 2.0 * inertia * _BANDWIDTH)
    friction = arm.model.dof_frictionloss[arm.dof_adr].copy()
    return ServoParameters(
        armature=armature,
        stiffness=stiffness,
        damping=damping,
        coulomb_friction=friction,
        offset=np.zeros(arm.n),
        backlash=np.zeros(arm.n),
        delay=0.0,
    )
