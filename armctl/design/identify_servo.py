"""identify_servo: rotor inertia, gains, friction, offsets, backlash and delay of position servos, from positions alone."""

from __future__ import annotations

import copy
import itertools
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from armctl.core.errors import InputError, ModelError
from armctl.core.log import Log
from armctl.core.validation import Array, frozen, instance
from armctl.design.identified_model import IdentifiedArm
from armctl.design.servo_simulation import ServoParameters, ServoSimulation, set_rotors_and_friction
from armctl.loading.catalog import locate
from armctl.robot.arm import Arm, check_arm, with_model

PER_JOINT = ("armature", "stiffness", "damping", "coulomb_friction", "offset", "backlash")
_BANDWIDTH = 20.0  # rad/s, where to start with a file that has no servos
_INERTIA_SHARE = 0.05  # of a joint's inertia, where to start with a file that has no rotor inertia
_RANGE = 100.0  # the bounds of armature, stiffness and damping over their values in the file, and reversed
_FRICTION_SHARE = 0.05  # of a joint's typical torque: the unit of dry friction in the fit
_BACKLASH_UNIT = 0.01  # rad, in the fit
_START_BACKLASHES = (0.0, 0.1, 0.3, 0.6, 1.0, 2.0)  # in this unit
_MAX_BACKLASH = 10.0
_MAX_BACKLASH_ERROR = 0.25  # in this unit: with a larger standard error a recording does not show it
_SIGNIFICANT = 3.0  # standard errors of a backlash that is not taken for zero
_MAX_DELAY_S = 0.25
_START_DELAYS = (0.0, 0.015, 0.03, 0.06, 0.1)
_START_SCALES = np.geomspace(1.0 / _RANGE, _RANGE, 9)  # of the stiffness of each joint
_START_DAMPING_RATIOS = (0.3, 1.0, 3.0)
_MAX_STARTS = 3
# Of finite differences, in units of the fit. Rounding of friction's solver, divided by a shorter step, looks like information.
_STEP = 0.05
_MAX_EVALUATIONS = 25
_TOLERANCE = 1e-4
_SETTLING_S = 0.3  # at the beginning, where the state of the arm is not known
_BLOCK_S = 0.5  # over which residuals may be correlated
_MIN_TRAVEL_RAD = 0.02
_MIN_SECONDS = 3.0
_MIN_GAP_GAIN = 0.1  # share of a joint's sum of squares that its backlash explains, if it is kept
_MAX_NOISE_RATIO = 2.5  # of an error over the noise of the positions, beside:
_MAX_MODEL_ERROR = 0.01  # of the difference between command and position: what steps of the simulation are off
_NOISE_ORDER = 6  # of the differences that show noise; of motions below a tenth of the sampling rate they leave nothing
_AT_BOUND = 1e-3
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
        errors: Their standard errors, robust to correlated residuals; they know noise, and not what the model leaves out.
        file: The parameters of the file, from which the fit started.
        unseen: Names of parameters, such as "wrist armature", that the motion does not show. The least visible one has the
            file's value. Others may be known relative to it: without gravity, positions show ratios of parameters only.
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
        return ServoSimulation(self.arm, recording.dt, gaps).positions([self.parameters], recording)[0]

    def _identified(self, arm: Arm) -> Arm:
        model = copy.copy(arm.model)
        set_rotors_and_friction(model, arm, self.parameters)
        return with_model(arm, model)

    def _complete(self, spec: mujoco.MjSpec, identified: Arm) -> None:
        motors = np.isin(self.arm.model.actuator_ctrladr, self.arm.ctrl_adr)
        for actuator, is_motor in zip(spec.actuators, motors, strict=False):
            if not is_motor or actuator.target not in self.arm.joint_names:
                continue
            i = self.arm.joint_names.index(actuator.target)
            limit = self.arm.limits.tau_max[i]
            actuator.set_to_position(kp=self.parameters.stiffness[i], kv=self.parameters.damping[i])
            actuator.gear = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
            actuator.ctrlrange = [self.arm.limits.q_min[i], self.arm.limits.q_max[i]]
            actuator.forcerange = [-limit, limit] if np.isfinite(limit) else [0.0, 0.0]
            actuator.delay = self.parameters.delay
            actuator.nsample = int(np.ceil(self.parameters.delay / self.arm.dt)) + 1 if self.parameters.delay > 0.0 else 0


def identify_servo(arm: Arm, recording: Log, *, judge: Log, source: str | os.PathLike[str] | None = None) -> ServoEstimate:
    """Identifies the position servos of an arm from commanded and measured positions; no torques are needed.

    MuJoCo's own model, with position servos, simulates the whole recording; least squares with bounds changes rotor inertia,
    gains, Coulomb friction, offsets and backlash of all joints and one delay (output-error method: Ljung, "System
    Identification", 1999). A backlash that is not larger than three standard errors is zero.
    Masses of links are those of the file: gravity gives the torques their scale. Where it shows too little of it, the parameter
    with the largest error keeps the file's value. Damping of a joint has the effect of its servo's, so the file's stays.
    The search starts from servos up to 100 times as stiff or soft as those of the file, each joint by itself. It tries further
    starts while errors are above the noise of the positions, because then another minimum may be the right one.

    Args:
        recording: A log with commands in `q_ref` and measured positions in `q`, at least 3 s, better 30, from a rest.
            Fast motions show inertia and delay. `Log.from_positions` makes one.
        judge: The log of another motion of the same arm, which the fit does not use.
        source: The name or file that the arm was loaded from, for the gains to start with; the name of the arm if left out.

    Returns:
        The estimate. It is not ok, with a reason, if the positions of the judge are not predicted to 2.5 times their noise and,
        beside it, 1 % of what they differ from the commands.

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
    fit = _best_fit(arm, recording, file, _largest_errors(recording, noise))
    if fit.drop_unseen():
        fit.solve()
    found = fit.parameters(fit.z)
    along = ServoSimulation(arm, judge.dt, bool(found.backlash.any())).positions([found, file], judge) - judge.q
    judged = np.sqrt(np.mean(along[:, round(_SETTLING_S / judge.dt) :] ** 2, axis=1))
    rms = fit.rms()
    reason = _reason(arm, judge, noise, *judged) or fit.at_bound()
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


def _best_fit(arm: Arm, recording: Log, file: ServoParameters, largest: Array) -> _Fit:
    """The best of local fits from several starts; the first whose errors are the noise needs no other beside it."""
    fits: list[_Fit] = []
    for start in _Fit(arm, recording, file).starts()[:_MAX_STARTS]:
        fit = _Fit(arm, recording, file)
        fit.z = start
        fit.solve()
        fits.append(fit)
        if (fit.rms() <= largest).all():
            break
    best = min(fits, key=lambda each: float(np.sum(each.rms() ** 2)))
    best.find_backlash()
    return best


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
    stiffness = inertia * _BANDWIDTH**2
    damping = 2.0 * inertia * _BANDWIDTH
    for actuator in range(model.nactuator):
        joint = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, int(model.actuator_trnid[actuator, 0]))
        gear = model.actuator_gear[actuator, 0]
        kp, kv = -model.actuator_biasprm[actuator, 1:3] * gear**2
        is_on_joint = model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT and joint in arm.joint_names
        if is_on_joint and kp > 0.0:
            i = arm.joint_names.index(joint)
            stiffness[i] = kp
            damping[i] = kv if kv > 0.0 else damping[i]
    friction = arm.model.dof_frictionloss[arm.dof_adr].copy()
    return ServoParameters(armature, stiffness, damping, friction, np.zeros(arm.n), np.zeros(arm.n), 0.0)


class _Fit:
    """Parameters of servos fitted to a recording, in units in which they are about 1.

    The armature is a logarithm over the file's value; stiffness and damping are logarithms of their ratio to the armature over
    that of the file, and dry friction is in proportion to it. So an armature that is not shown is one coordinate, along which
    finite differences are exact: sums of large columns that cancel would not be. Offsets are rad, the delay sampling periods.
    """

    def __init__(self, arm: Arm, log: Log, file: ServoParameters):
        self.arm = arm
        self.file = file
        self._log = log
        self._simulation = ServoSimulation(arm, log.dt, False)
        self._from = round(_SETTLING_S / log.dt)
        n = arm.n
        self._n = n
        typical = np.sqrt(np.mean((log.q_ref - log.q) ** 2, axis=0)) * file.stiffness
        self._friction_unit = np.maximum(_FRICTION_SHARE * typical, np.finfo(float).tiny)
        self.names = [f"{joint} {kind}" for kind in PER_JOINT for joint in arm.joint_names] + ["delay"]
        self.z = np.zeros(6 * n + 1)  # (p,) the parameters
        self.z[3 * n : 4 * n] = file.coulomb_friction / self._friction_unit
        self._file_z = self.z.copy()
        self._low = np.full(6 * n + 1, -np.log(_RANGE))
        self._low[3 * n :] = np.concatenate([np.zeros(n), np.full(n, -1.0), np.zeros(n), [0.0]])
        self._high = np.full(6 * n + 1, np.log(_RANGE))
        high = [np.full(n, np.inf), np.full(n, 1.0), np.full(n, _MAX_BACKLASH), [_MAX_DELAY_S / log.dt]]
        self._high[3 * n :] = np.concatenate(high)
        self._still = np.ptp(log.q, axis=0) < _MIN_TRAVEL_RAD
        none = np.zeros(n, bool)
        # (p,) False if it keeps the file's value
        self.free = ~np.concatenate([np.tile(self._still, 4), none, ~none, [False]])
        self.unseen = ~self.free  # (p,) True for those that the recording does not show
        self._absent = np.zeros(len(self.z), bool)  # (p,) True for a backlash that the recording shows to be none
        self._alone = np.full(len(self.z), np.nan)  # (p,) standard errors with all that is free
        self._J = np.zeros((0, 0))

    def parameters(self, z: Array) -> ServoParameters:
        """The parameters in SI units."""
        rows = z[:-1].reshape(6, self._n)
        scale = np.exp(rows[0])
        return ServoParameters(
            armature=self.file.armature * scale,
            stiffness=self.file.stiffness * scale * np.exp(rows[1]),
            damping=self.file.damping * scale * np.exp(rows[2]),
            coulomb_friction=self._friction_unit * scale * rows[3],
            offset=rows[4],
            backlash=_BACKLASH_UNIT * rows[5],
            delay=max(float(z[-1] * self._log.dt), 0.0),
        )

    def residuals(self, z: Array) -> Array:
        """(T, n) rad, simulated minus measured."""
        return self._many([z])[0]

    def rms(self) -> Array:
        """(n,) rad, of the residuals."""
        return np.sqrt(np.mean(self.residuals(self.z) ** 2, axis=0))

    def starts(self) -> list[Array]:
        """(p,) each, the best first: for each delay of a grid, each joint with the stiffness and damping that fit it best."""
        n = self._n
        inertia = np.diag(self.arm.mass_matrix(self.arm.limits.clamp(self.arm.home)))
        critical = 2.0 * np.sqrt(self.file.stiffness * inertia) / self.file.damping
        starts = []
        for delay in _START_DELAYS:
            same = []
            for scale, ratio in itertools.product(_START_SCALES, _START_DAMPING_RATIOS):
                z = self.z.copy()
                z[-1] = delay / self._log.dt
                z[n : 2 * n] = np.log(scale)
                z[2 * n : 3 * n] = np.log(ratio * np.sqrt(scale) * critical)
                z = np.clip(z, self._low, self._high)
                same.append(np.where(self.free, z, self._file_z))
            best = (self._many(same) ** 2).sum(axis=1).argmin(axis=0)
            z = same[0].copy()
            for joint, row in enumerate(best):
                z[joint:-1:n] = same[row][joint:-1:n]
            starts.append(z)
        costs = (self._many(starts) ** 2).sum(axis=(1, 2))
        return [starts[i] for i in np.argsort(costs, kind="stable")]

    def at_bound(self) -> str:
        """The reason if a gain or a rotor inertia ended at a bound of the fit; empty if none did."""
        shown = slice(0, 3 * self._n)
        ends = np.minimum(self.z - self._low, self._high - self.z)[shown] < _AT_BOUND
        for i in np.flatnonzero(ends & self.free[shown]):
            return f"{self.names[i]:.80} is at a bound, {_RANGE:g} times or a {_RANGE:g}th of the file's; give a nearer file"
        return ""

    def solve(self) -> None:
        from scipy.optimize import least_squares

        free = self.free.copy()

        def whole(x: Array) -> Array:
            z = self._file_z.copy()
            z[free] = x
            return z

        solve: Any = least_squares
        found = solve(
            lambda x: self.residuals(whole(x)).ravel(),
            np.clip(self.z, self._low, self._high)[free],
            lambda x: self._jacobian(whole(x))[:, free],
            bounds=(self._low[free] - 1e-9, self._high[free]),
            x_scale="jac",
            ftol=_TOLERANCE,
            xtol=_TOLERANCE,
            max_nfev=_MAX_EVALUATIONS,
        )
        self.z = whole(found.x)
        self._J = np.zeros((len(found.fun), len(self.z)))
        self._J[:, free] = found.jac

    def find_backlash(self) -> None:
        """Adds backlash to the fit, from the best of a grid for each joint, and keeps what is significant."""
        rigid = (self._simulation, self.z, self._J)
        without = self.rms()
        try:
            self._simulation = ServoSimulation(self.arm, self._log.dt, True)
        except (InputError, ModelError):  # no rotors can be added, as to a compiled model
            return
        gaps = slice(5 * self._n, 6 * self._n)
        starts = [np.where(np.arange(len(self.z)) // self._n == 5, gap, self.z) for gap in _START_BACKLASHES]
        best = (self._many(starts) ** 2).sum(axis=1).argmin(axis=0)
        self.z = starts[0]
        self.z[gaps] = np.array(_START_BACKLASHES)[best]
        self.free[gaps] = ~self._still
        self.solve()
        self._alone = np.where(self.free, self._physical(self._covariance()), self._alone)
        explains = self.rms() ** 2 < (1.0 - _MIN_GAP_GAIN) * without**2
        found = explains & (self.z[gaps] > _SIGNIFICANT * self._alone[gaps])
        self._absent[gaps] = ~found & ~self._still & (self._alone[gaps] < _MAX_BACKLASH_ERROR)
        self.free[gaps] = found
        if not found.any():
            self._simulation, self.z, self._J = rigid
        elif not found.all():
            self.solve()

    def _limit(self) -> Array:
        """(p,) the largest standard errors of parameters that a recording shows."""
        # An e-fold change of a parameter, with all others adapted to it, must move its joint by as much as the residuals.
        # Smaller effects drown in what the model leaves out, whatever the number of samples says.
        limit = np.full(len(self.z), 1.0 / np.sqrt(len(self._log)))
        limit[3 * self._n : 4 * self._n] *= np.maximum(self.z[3 * self._n : 4 * self._n], 1.0)
        limit[5 * self._n : -1] = _MAX_BACKLASH_ERROR
        limit[-1] = 1.0
        return limit

    def drop_unseen(self) -> bool:
        """Gives parameters with large errors the file's value, the worst first, until the others are known relative to them.

        True if the fit has to be solved again.
        """
        limit = self._limit()
        before = self.free.copy()
        self._alone = np.where(self.free, self._physical(self._covariance()), self._alone)
        self.unseen = (~self.free | (self._alone > limit)) & ~self._absent
        while True:
            excess = np.sqrt(np.diag(self._covariance())) / limit
            worst = int(excess.argmax())
            if excess[worst] < 1.0:
                break
            self.free[worst] = False
        self.unseen |= ~self.free & ~self._absent
        if self.unseen[: 5 * self._n].any():  # all joints show the delay: it must not make up for the file's values of others
            self.free[-1] = False
            self._file_z[-1] = self.z[-1]
        return not np.array_equal(before, self.free)

    def standard_errors(self) -> ServoParameters:
        errors = np.where(self.unseen | ~self.free, self._alone, self._physical(self._covariance()))
        rows = errors[:-1].reshape(6, self._n)
        found = self.parameters(self.z)
        return ServoParameters(
            armature=found.armature * rows[0],
            stiffness=found.stiffness * rows[1],
            damping=found.damping * rows[2],
            coulomb_friction=self._friction_unit * found.armature / self.file.armature * rows[3],
            offset=rows[4],
            backlash=_BACKLASH_UNIT * rows[5],
            delay=float(errors[-1] * self._log.dt),
        )

    def _physical(self, covariance: Array) -> Array:
        """(p,) standard errors, relative ones of armature, stiffness and damping themselves instead of ratios."""
        n = self._n
        T = np.eye(len(self.z))
        joints = np.arange(n)
        T[n + joints, joints] = 1.0
        T[2 * n + joints, joints] = 1.0
        T[3 * n + joints, joints] = self.z[3 * n : 4 * n]
        return np.sqrt(np.diag(T @ covariance @ T.T))

    def _covariance(self) -> Array:
        """(p, p), from the scores of blocks of each joint (sandwich estimate: White, 1982); 0 where not free."""
        J = self._J[:, self.free]
        inverse = np.linalg.pinv(J.T @ J)
        scores = (J * self.residuals(self.z).reshape(-1, 1)).reshape(-1, self._n, J.shape[1])
        edges = np.arange(0, len(scores), max(1, round(_BLOCK_S / self._log.dt)))
        blocks = np.add.reduceat(scores, edges, axis=0).reshape(-1, J.shape[1])
        covariance = np.zeros((len(self.z), len(self.z)))
        covariance[np.ix_(self.free, self.free)] = inverse @ (blocks.T @ blocks) @ inverse
        return covariance

    def _jacobian(self, z: Array) -> Array:
        """(T n, p), by forward differences; 0 where not free."""
        moved = self._many([z, *(z + _STEP * row for row in np.eye(len(z))[self.free])])
        J = np.zeros((moved[0].size, len(z)))
        J[:, self.free] = ((moved[1:] - moved[0]) / _STEP).transpose(1, 2, 0).reshape(len(J), -1)
        return J

    def _many(self, candidates: Sequence[Array]) -> Array:
        """(B, T, n) residuals after the settling."""
        found = self._simulation.positions([self.parameters(z) for z in candidates], self._log)
        return (found - self._log.q)[:, self._from :]
