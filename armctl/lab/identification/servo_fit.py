"""Parameters of position servos fitted to a recording of their positions."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from armctl.core.errors import InputError, ModelError
from armctl.core.log import Log
from armctl.core.validation import Array, BoolArray, IntArray
from armctl.lab.identification.servo_simulation import FINER, ServoParameters, ServoSimulation
from armctl.model.arm.arm import Arm

PER_JOINT = ("armature", "stiffness", "damping", "coulomb_friction", "offset", "backlash")
SETTLING_S = 0.3  # at the beginning, where the state of the arm is not known
_MAX_RATIO = 100.0  # the bounds of armature, stiffness and damping over their values in the file, and reversed
_FRICTION_SHARE = 0.05  # of a joint's typical torque: the unit of dry friction in the fit
_BACKLASH_UNIT = 0.01  # rad, in the fit
_START_UNIT = 0.01  # rad, in the fit: of positions at the start from those that are measured
_START_BACKLASHES = (0.0, 0.1, 0.3, 0.6, 1.0, 2.0)  # in this unit
_MAX_BACKLASH = 10.0
_MAX_BACKLASH_ERROR = 0.25  # in this unit: with a larger standard error a recording does not show it
_SIGNIFICANT = 3.0  # standard errors of a backlash that is not taken for zero
_MAX_DELAY_S = 0.25
_START_DELAYS = np.arange(0.0, 0.121, 0.004)
_DIFFERENT_DELAY_S = 0.012  # between two starts
_START_SCALES = np.geomspace(1.0 / _MAX_RATIO, _MAX_RATIO, 17)  # of the stiffness of each joint
_START_DAMPING_RATIOS = (0.3, 0.6, 1.0, 2.0)
# Of finite differences, in units of the fit. Rounding of friction's solver, divided by a shorter step, looks like information.
_STEP = 0.05
_MAX_EVALUATIONS = 25
_TOLERANCE = 1e-4
_GAP_FACTORS = (0.6, 1.5)
_PROFILE_EVALUATIONS = 8
_LOWER = 1e-3  # share of the cost
_POLISHING = 3  # evaluations with central differences, at the end
_BLOCK_S = 0.5  # over which residuals may be correlated
_MIN_TRAVEL_RAD = 0.02
_MIN_GAIN = 0.1  # share of a joint's sum of squares by which a fit is clearly better
_EVALUATIONS_AT_NOISE = 3  # for the errors of a backlash that nothing calls for
_AT_BOUND = 1e-3


class ServoFit:
    """Parameters of servos fitted to a recording, in units in which they are about 1.

    The armature is a logarithm over the file's value; stiffness and damping are logarithms of their ratio to the inertia of
    rotor and links over that of the file, and dry friction is in proportion to it. So an armature that is not shown is one
    coordinate, along which finite differences are exact: sums of large columns that cancel would not be. Offsets are rad, the
    delay sampling periods. Where each joint rests at the start is a further parameter, of which the encoder shows one step.
    Residuals are those in the limit of short steps, derivatives those of the arm's steps.
    """

    def __init__(self, arm: Arm, log: Log, file: ServoParameters):
        self.arm = arm
        self.file = file
        self._log = log
        self._simulation = ServoSimulation(arm, log.dt, False)
        self._from = round(SETTLING_S / log.dt)
        n = arm.n
        self._n = n
        inertia = np.diag(arm.mass_matrix(arm.limits.clamp(arm.home)))
        self._links = np.maximum(inertia - arm.model.dof_armature[arm.dof_adr], 0.0)  # (n,) kg m^2
        typical = np.sqrt(np.mean((log.q_ref - log.q) ** 2, axis=0)) * file.stiffness
        self._friction_unit = np.maximum(_FRICTION_SHARE * typical, np.finfo(float).tiny)
        self.names = [f"{joint} {kind}" for kind in (*PER_JOINT, "start") for joint in arm.joint_names] + ["delay"]
        self.z = np.zeros(7 * n + 1)  # (p,) the parameters
        self.z[3 * n : 4 * n] = file.coulomb_friction / self._friction_unit
        self._file_z = self.z.copy()
        self._low = np.full(7 * n + 1, -np.log(_MAX_RATIO))
        self._low[3 * n :] = np.concatenate([np.zeros(n), np.full(n, -1.0), np.zeros(n), np.full(n, -1.0), [0.0]])
        self._high = np.full(7 * n + 1, np.log(_MAX_RATIO))
        high = [np.full(n, np.inf), np.full(n, 1.0), np.full(n, _MAX_BACKLASH), np.full(n, 1.0), [_MAX_DELAY_S / log.dt]]
        self._high[3 * n :] = np.concatenate(high)
        self._still = np.ptp(log.q, axis=0) < _MIN_TRAVEL_RAD
        none = np.zeros(n, bool)
        # (p,) False if it keeps the file's value
        self.free = ~np.concatenate([np.tile(self._still, 4), none, ~none, self._still, [False]])
        self.unseen = ~self.free & (np.arange(len(self.z)) < 6 * n)  # (p,) True for those that the recording does not show
        self._absent = np.zeros(len(self.z), bool)  # (p,) True for a backlash that the recording shows to be none
        self._alone = np.full(len(self.z), np.nan)  # (p,) standard errors with all that is free
        self._J = np.zeros((0, 0))
        self._central = False  # differences

    def parameters(self, z: Array) -> ServoParameters:
        """The parameters in SI units."""
        rows = z[:-1].reshape(7, self._n)
        armature = self.file.armature * np.exp(rows[0])
        scale = self._scale(armature)
        return ServoParameters(
            armature=armature,
            stiffness=self.file.stiffness * scale * np.exp(rows[1]),
            damping=self.file.damping * scale * np.exp(rows[2]),
            coulomb_friction=self._friction_unit * scale * rows[3],
            offset=rows[4],
            backlash=_BACKLASH_UNIT * rows[5],
            delay=max(float(z[-1] * self._log.dt), 0.0),
        )

    def _scale(self, armature: Array) -> Array:
        """(n,) the inertia of each joint over that of the file."""
        return (armature + self._links) / (self.file.armature + self._links)

    def residuals(self, z: Array) -> Array:
        """(T, n) rad, simulated minus measured."""
        return (self._simulation.limit([self.parameters(z)], self._log, self._starts([z]))[0] - self._log.q)[self._from :]

    def rms(self) -> Array:
        """(n,) rad, of the residuals."""
        return np.sqrt(np.mean(self.residuals(self.z) ** 2, axis=0))

    def along(self, log: Log) -> Array:
        """(T, n) rad, simulated minus measured along another log."""
        return (self._simulation.limit([self.parameters(self.z)], log)[0] - log.q)[self._from :]

    def cost(self) -> float:
        """rad^2, the sum of squares of the residuals."""
        return float(np.sum(self.residuals(self.z) ** 2))

    def starts(self) -> list[Array]:
        """(p,) each, the best first, of different delays: each joint has the stiffness and damping that fit it best."""
        n = self._n
        inertia = np.diag(self.arm.mass_matrix(self.arm.limits.clamp(self.arm.home)))
        critical = 2.0 * np.sqrt(self.file.stiffness * inertia) / self.file.damping
        same = []
        for scale, ratio in itertools.product(_START_SCALES, _START_DAMPING_RATIOS):
            z = self.z.copy()
            z[n : 2 * n] = np.log(scale)
            z[2 * n : 3 * n] = np.log(ratio * np.sqrt(scale) * critical)
            same.append(np.where(self.free, np.clip(z, self._low, self._high), self._file_z))
        moved = self._simulation.positions([self.parameters(z) for z in same], self._log)
        costs = np.array([self._costs_delayed(moved, delay) for delay in _START_DELAYS])  # (D, B, n)
        totals = costs.min(axis=1).sum(axis=1)
        starts: list[Array] = []
        for row in np.argsort(totals, kind="stable"):
            delay = _START_DELAYS[row] / self._log.dt
            if any(abs(delay - other[-1]) * self._log.dt < _DIFFERENT_DELAY_S for other in starts):
                continue
            z = same[0].copy()
            for joint, candidate in enumerate(costs[row].argmin(axis=0)):
                z[joint:-1:n] = same[candidate][joint:-1:n]
            z[-1] = delay
            starts.append(z)
        return starts

    def _costs_delayed(self, moved: Array, delay: float) -> Array:
        """(B, n) sums of squares of what moves `delay` s later than simulated positions: the arm starts from a rest."""
        whole, part = divmod(delay / self._log.dt, 1.0)
        rows = np.arange(self._from, len(self._log)) - int(whole)
        later = (1.0 - part) * moved[:, np.maximum(rows, 0)] + part * moved[:, np.maximum(rows - 1, 0)]
        return ((later - self._log.q[self._from :]) ** 2).sum(axis=1)

    def at_bound(self) -> str:
        """The reason if a gain or a rotor inertia ended at a bound of the fit; empty if none did."""
        shown = slice(0, 3 * self._n)
        ends = np.minimum(self.z - self._low, self._high - self.z)[shown] < _AT_BOUND
        for i in np.flatnonzero(ends & self.free[shown]):
            bound = f"{_MAX_RATIO:g} times or a {_MAX_RATIO:g}th of the file's"
            return f"{self.names[i]:.80} is at a bound, {bound}; give a nearer file"
        return ""

    def solve(self, evaluations: int = _MAX_EVALUATIONS) -> None:
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
            max_nfev=evaluations,
        )
        self.z = whole(found.x)
        self._J = np.zeros((len(found.fun), len(self.z)))
        self._J[:, free] = found.jac

    def find_backlash(self, noise: Array) -> ServoFit | None:
        """Adds backlash to the fit, from the best of a grid for each joint, and keeps what is significant.

        Args:
            noise: (n,) rad, of the positions. A joint without larger errors has no backlash that could be found.

        Returns:
            The best fit without any backlash, for a judge to compare; None if no backlash is kept.
        """
        rigid = copy.copy(self)
        rigid.free = self.free.copy()
        try:
            self._simulation = ServoSimulation(self.arm, self._log.dt, True)
        except (InputError, ModelError):  # no rotors can be added, as to a compiled model
            return None
        gaps = slice(5 * self._n, 6 * self._n)
        starts = [np.where(np.arange(len(self.z)) // self._n == 5, gap, self.z) for gap in _START_BACKLASHES]
        best = (self._many(starts) ** 2).sum(axis=1).argmin(axis=0)
        self.z = starts[0]
        self.z[gaps] = np.array(_START_BACKLASHES)[best]
        self.free[gaps] = ~self._still
        called_for = (1.0 - _MIN_GAIN) * rigid.rms() ** 2 > noise**2
        self.solve(_MAX_EVALUATIONS if called_for.any() else _EVALUATIONS_AT_NOISE)
        self._alone = np.where(self.free, self._physical(self._covariance()), self._alone)
        found = called_for & (self.z[gaps] > _SIGNIFICANT * self._alone[gaps])
        if found.any():  # the fit without backlash may have ended in another minimum: only the best such fit tells
            rigid = min(rigid, self._without_backlash(), key=ServoFit.cost)
            found &= is_lower(self.residuals(self.z), rigid.residuals(rigid.z), self._log.dt)
        shown = (self._alone[gaps] < _MAX_BACKLASH_ERROR) & self._excludes_backlash()
        self._absent[gaps] = ~found & ~self._still & shown
        self.free[gaps] = found
        if not found.any():
            self._simulation = rigid._simulation
            self.z = rigid.z
            self._J = rigid._J
            return None
        if not found.all():
            self.solve()
        self._profile(5 * self._n + np.flatnonzero(found))
        return rigid

    def _profile(self, gaps: IntArray) -> None:
        """Repeats the fit from smaller and larger gaps, while one of them leads to a lower minimum."""
        cost = self.cost()
        is_lower_found = True
        while is_lower_found:
            is_lower_found = False
            for gap, factor in itertools.product(gaps, _GAP_FACTORS):
                other = copy.copy(self)
                other.z = self.z.copy()
                other.z[gap] *= factor
                other.solve(_PROFILE_EVALUATIONS)
                if other.cost() < (1.0 - _LOWER) * cost:
                    self.z = other.z
                    self._J = other._J
                    cost = self.cost()
                    is_lower_found = True

    def _excludes_backlash(self) -> BoolArray:
        """(n,) True for joints at which each backlash of a grid is clearly worse than none, whatever all others are.

        A local error does not tell: the effect of a gap is not in proportion to it. The others follow by the linear model.
        """
        n = self._n
        large = [gap for gap in _START_BACKLASHES if gap > _MAX_BACKLASH_ERROR]
        grid = []
        for joint in range(n):
            for gap in (0.0, *large):
                z = self.z.copy()
                z[5 * n + joint] = gap
                grid.append(z)
        moved = self._many(grid) + self.residuals(self.z) - self._many([self.z])  # what steps change is that of the fit
        others = np.linalg.qr(self._J[:, self.free & (np.arange(len(self.z)) // n != 5)])[0]
        flat = moved.reshape(len(grid), -1)
        left = (flat - (flat @ others) @ others.T).reshape(moved.shape)
        excluded = np.ones(n, bool)
        for joint, (none, *rivals) in enumerate(left.reshape(n, 1 + len(large), *left.shape[1:])):
            for gap, rival in zip(large, rivals, strict=True):
                gain, error = _gain(none, rival, self._log.dt)
                if gain.sum() <= _SIGNIFICANT * np.hypot.reduce(error):
                    excluded[joint] = False
                    self._alone[5 * n + joint] = max(gap, self._alone[5 * n + joint])
        return excluded

    def _without_backlash(self) -> ServoFit:
        """The fit without backlash that starts from this one, with links at the middle or at a side of their gaps."""
        n = self._n
        rigid = ServoFit(self.arm, self._log, self.file)
        sides = [self.z.copy() for _ in range(3)]
        for side, z in zip((-0.5, 0.0, 0.5), sides, strict=True):
            z[4 * n : 5 * n] += side * _BACKLASH_UNIT * z[5 * n : 6 * n]
            z[5 * n : 6 * n] = 0.0
        best = (rigid._many(sides) ** 2).sum(axis=1).argmin(axis=0)
        rigid.z = sides[0]
        rigid.z[4 * n : 5 * n] = [sides[side][4 * n + joint] for joint, side in enumerate(best)]
        rigid.solve()
        return rigid

    def _moved_by_steps(self) -> Array:
        """(p,) by how much parameters would move, to first order, if the steps were half as long."""
        found = [self.parameters(self.z)]
        shorter = self._simulation.limit(found, self._log, self._starts([self.z]), 2 * FINER)[0] - self._log.q
        change = shorter[self._from :] - self.residuals(self.z)
        moved = np.zeros(len(self.z))
        moved[self.free] = np.linalg.pinv(self._J[:, self.free]) @ change.ravel()
        return 2.0 * moved  # errors are at most in proportion to the step

    def _of_steps(self) -> Array:
        """(p,) errors due to the steps of the simulation, as `_physical`."""
        moved = self._moved_by_steps()
        return self._physical(np.outer(moved, moved))

    def _limit(self) -> Array:
        """(p,) the largest standard errors of parameters that a recording shows."""
        # An e-fold change of a parameter, with all others adapted to it, must move its joint by as much as the residuals.
        # Smaller effects drown in what the model leaves out, whatever the number of samples says.
        limit = np.full(len(self.z), 1.0 / np.sqrt(len(self._log)))
        limit[3 * self._n : 4 * self._n] *= np.maximum(self.z[3 * self._n : 4 * self._n], 1.0)
        limit[5 * self._n : 6 * self._n] = _MAX_BACKLASH_ERROR
        limit[6 * self._n : -1] = np.inf
        limit[-1] = 1.0
        return limit

    def drop_unseen(self) -> None:
        """Gives parameters with large errors the file's value, the worst first, until the others are known relative to them.

        Errors are those of a linear model: where the recording is predicted clearly worse with these values, the fit stays.
        """
        self._polish()
        limit = self._limit()
        before = self.free.copy()
        self._alone = np.where(self.free, np.hypot(self._physical(self._covariance()), self._of_steps()), self._alone)
        unseen = (~self.free | (self._alone > limit)) & ~self._absent & np.isfinite(limit)
        while True:
            excess = np.sqrt(np.diag(self._covariance())) / limit
            worst = int(excess.argmax())
            if excess[worst] < 1.0:
                break
            self.free[worst] = False
        self.unseen = unseen | (~self.free & ~self._absent & np.isfinite(limit))
        if self.unseen[: 5 * self._n].any():  # all joints show the delay: it must not make up for the file's values of others
            self.free[-1] = False
            self._file_z[-1] = self.z[-1]
        if np.array_equal(before, self.free):
            return
        with_all = (self.z, self._J, self.residuals(self.z))
        self.solve()
        if is_lower(with_all[2], self.residuals(self.z), self._log.dt).any():
            self.free = before
            self.unseen = unseen
            self.z = with_all[0]
            self._J = with_all[1]

    def _polish(self) -> None:
        """Ends a fit, with the derivatives that errors need: forward differences let what is not shown look as if it were."""
        self._central = True
        self.solve(_POLISHING)

    def standard_errors(self) -> ServoParameters:
        """Of the noise, and of the steps of the simulation: stiff servos let 2 ms look like damping and inertia."""
        errors = np.where(self.free, np.hypot(self._physical(self._covariance()), self._of_steps()), 0.0)
        errors = np.where(np.isfinite(self._alone), np.maximum(errors, self._alone), errors)
        errors = np.where(self.free | np.isfinite(self._alone), errors, np.nan)
        rows = errors[:-1].reshape(7, self._n)
        found = self.parameters(self.z)
        return ServoParameters(
            armature=found.armature * rows[0],
            stiffness=found.stiffness * rows[1],
            damping=found.damping * rows[2],
            coulomb_friction=self._friction_unit * self._scale(found.armature) * rows[3],
            offset=rows[4],
            backlash=_BACKLASH_UNIT * rows[5],
            delay=float(errors[-1] * self._log.dt),
        )

    def _share(self) -> Array:
        """(n,) of the rotor in the inertia of its joint."""
        armature = self.parameters(self.z).armature
        return armature / (armature + self._links)

    def _physical(self, covariance: Array) -> Array:
        """(p,) standard errors, relative ones of armature, stiffness and damping themselves instead of ratios."""
        n = self._n
        T = np.eye(len(self.z))
        joints = np.arange(n)
        share = self._share()
        T[n + joints, joints] = share
        T[2 * n + joints, joints] = share
        T[3 * n + joints, joints] = self.z[3 * n : 4 * n] * share
        return np.sqrt(np.diag(T @ covariance @ T.T))

    def _covariance(self) -> Array:
        """(p, p), from the scores of blocks of each joint (sandwich estimate: White, 1982); 0 where not free."""
        J = self._J[:, self.free]
        inverse = np.linalg.pinv(J.T @ J)
        scores = (J * self.residuals(self.z).reshape(-1, 1)).reshape(-1, self._n, J.shape[1])
        edges = np.arange(0, len(scores), max(1, round(_BLOCK_S / self._log.dt)))
        blocks = np.add.reduceat(scores, edges, axis=0).reshape(-1, J.shape[1])
        covariance = np.zeros((len(self.z), len(self.z)))
        spared = max(len(blocks) - J.shape[1], 1) / len(blocks)  # the fit has taken its share of the scores
        covariance[np.ix_(self.free, self.free)] = inverse @ (blocks.T @ blocks) @ inverse / spared
        return covariance

    def _jacobian(self, z: Array) -> Array:
        """(T n, p), by forward or central differences; 0 where not free."""
        steps = _STEP * np.eye(len(z))[self.free]
        before = np.maximum(z - steps, self._low) if self._central else z[None]
        moved = self._many([*(z + steps), *before])
        J = np.zeros((moved[0].size, len(z)))
        widths = (z + steps - before).sum(axis=1)[:, None, None]
        J[:, self.free] = ((moved[: len(steps)] - moved[len(steps) :]) / widths).transpose(1, 2, 0).reshape(len(J), -1)
        return J

    def _many(self, candidates: Sequence[Array]) -> Array:
        """(B, T, n) residuals after the settling."""
        found = self._simulation.positions([self.parameters(z) for z in candidates], self._log, self._starts(candidates))
        return (found - self._log.q)[:, self._from :]

    def _starts(self, candidates: Sequence[Array]) -> Array:
        """(B, n) rad, where measured positions start."""
        return self._log.q[0] + _START_UNIT * np.array([z[6 * self._n : 7 * self._n] for z in candidates])


def is_lower(residuals: Array, others: Array, dt: float) -> BoolArray:
    """(n,) True for joints with residuals clearly below others: by a share, and by standard errors of blocks."""
    gain, error = _gain(residuals, others, dt)
    return (gain > _SIGNIFICANT * error) & (gain > _MIN_GAIN * (others**2).sum(axis=0))


def _gain(residuals: Array, others: Array, dt: float) -> tuple[Array, Array]:
    """(n,) by how much sums of squares are below those of others, and the standard errors, from blocks."""
    first = np.arange(0, len(residuals), max(1, round(_BLOCK_S / dt)))
    gain = np.add.reduceat(others**2 - residuals**2, first, axis=0)
    return gain.sum(axis=0), gain.std(axis=0, ddof=1) * np.sqrt(len(gain))
