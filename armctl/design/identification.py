"""Identification: what an arm holds, and how its joints rub, from one short run."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from armctl.collision.checkers import collision_checker
from armctl.core.errors import InputError, LimitError, PlanError
from armctl.core.log import Log
from armctl.core.validation import Array, frozen, instance, number
from armctl.motion import JointTrajectory, check_torque, move_through
from armctl.robot.arm import Arm, check_arm
from armctl.robot.dynamics import Dynamics

_PAYLOAD = 4  # mass and first moment, of as many numbers as friction has besides
_CUTOFF = 10.0  # Hz, of the filter that both sides of the fit go through
_SLOW = 0.05  # rad/s (m/s): below it the sign of a velocity is noise, and dry friction with it
_TORQUE_NOISE = 2e-3  # of the torque limit: no joint's torque is known better, however well a fit goes
_UNCERTAIN = 0.1  # of the mass (of half a kilogram where it is less): with a standard error above it nothing is identified
_PRIOR = (50.0, 0.5, 0.5, 0.5)  # kg and kg m: what is not shown stays within them
_ROUNDS = 4  # of the fit: inertia is not linear in a payload's centre, and joints differ in noise
_SETS, _SIZES, _POSITIONS = 120, 4, 5  # sets of positions that an excitation is chosen from
_PLANS = 2  # motions that may fail for each size: what then is wrong is wrong with the arm
_TOUCHES = "it touches something on every way that was tried"
_REACH = 1.5  # rad (m) from home
_OFF_LIMIT = 0.05  # of a joint's range
_LITTLE = 1e-6  # what a determinant of the information gets added
_SHOWN, _APART = 20, 1e-6  # states at which a mass is looked for, and the share of what they show that is not round-off
_TORQUE_SHARE = 0.9  # of the limits, for the controller to have some left
_SLOWER = (1.0, 0.7, 0.5)  # of the pace, for what takes more


@dataclass(frozen=True, eq=False)
class PayloadEstimate:
    """What a run tells about a payload and about friction besides the model's.

    Attributes:
        ok: Whether the run showed enough.
        reason: Why not, in words; empty if it did.
        mass: kg; NaN, like all numbers here, where nothing could be fitted.
        mass_error: kg, its standard error.
        center: (3,) m, in the tip's frame.
        center_error: (3,) m, standard errors; infinite where the run does not show the centre.
        coulomb_friction: (n,) N m of dry friction.
        coulomb_error: (n,) N m, standard errors.
        viscous_friction: (n,) N m s/rad of damping.
        viscous_error: (n,) N m s/rad, standard errors.
    """

    ok: bool
    reason: str
    mass: float
    mass_error: float
    center: Array
    center_error: Array
    coulomb_friction: Array
    coulomb_error: Array
    viscous_friction: Array
    viscous_error: Array

    def __bool__(self) -> bool:
        return self.ok

    def __str__(self) -> str:
        if not self.ok:
            return f"not identified: {self.reason}"
        known = zip(self.center, self.center_error, strict=True)
        x, y, z = (f"{1e3 * c:.1f}+-{1e3 * e:.1f}" if math.isfinite(e) else "not shown" for c, e in known)
        return f"{self.mass:.4f}+-{self.mass_error:.4f} kg at [{x}, {y}, {z}] mm from the tip"

    def applied_to(self, arm: Arm) -> Arm:
        """An arm's model with what was identified: give it to a controller.

        Args:
            arm: The arm that the run was of.

        Returns:
            The arm with payload and friction; friction that came out negative counts as none.

        Raises:
            InputError: Nothing was identified.
        """
        if not self.ok:
            raise InputError(f"estimate: {self}")
        coulomb, viscous = (np.maximum(x, 0.0) for x in (self.coulomb_friction, self.viscous_friction))
        return arm.with_payload(max(self.mass, 0.0), self.center, coulomb_friction=coulomb, viscous_friction=viscous)


def excitation(arm: Arm, payload: float = 1.0, *, pace: float = 0.6, rng: int | np.random.Generator = 0) -> JointTrajectory:
    """A motion that shows a payload: out of home and back through positions that load every joint differently.

    It keeps all limits, torque with the payload included, and touches nothing. Of many random sets of positions those are
    tried first whose weights tell mass and centre apart best.

    Args:
        arm: The arm.
        payload: kg, the most that it may be holding at its tip.
        pace: Share of the fastest speed, greater than 0 and at most 1.
        rng: Seed of the positions.

    Returns:
        The motion, a few seconds long, at rest at both ends.

    Raises:
        InputError: It is no arm, or the payload or the pace is out of its bounds.
        PlanError: There is no such motion from home.
    """
    check_arm(arm)
    number("pace", pace, 1e-3, 1.0)
    loaded, contacts = arm.with_payload(number("payload", payload, 0.0)), collision_checker(arm)
    held = Dynamics(loaded.model, loaded.pinocchio_model)
    why, failed = _TOUCHES, [0] * _SIZES
    for size, waypoints in _candidates(arm, np.random.default_rng(rng)):
        straight = np.linspace(waypoints[:-1], waypoints[1:], 10).reshape(-1, arm.n)
        if failed[size] == _PLANS:
            continue
        if any((np.abs(held.gravity(q)) + held.friction_loss > _TORQUE_SHARE * arm.limits.tau_max).any() for q in straight):
            why = "its weight there is more than the motors hold"
            continue
        if contacts.along(straight):
            continue
        try:
            fastest = move_through(loaded, waypoints)
            if contacts.along(fastest.sample(np.arange(0.0, fastest.duration, 0.02 * pace)).q):
                why = _TOUCHES
            else:
                for motion in (fastest.scaled(share * pace) for share in _SLOWER):
                    if max(check_torque(x, motion).ratio for x in (arm, loaded)) < _TORQUE_SHARE:
                        return motion
                why = f"it takes more than {100 * _TORQUE_SHARE:g} % of the torque limits on every way that was tried"
        except (PlanError, LimitError) as error:
            why = str(error)
        failed[size] += 1
    raise PlanError(f"{arm.name}: no motion from home shows a payload of {payload:g} kg safely: {why}")


def identify_payload(arm: Arm, log: Log) -> PayloadEstimate:
    """The payload and the friction that explain a run's torques.

    Least squares of the torques that the arm's model leaves over on {m, m c} at the tip, Coulomb and viscous friction, both
    sides through the same zero-phase filter; after Swevers, Verdonck, De Schutter, "Dynamic model identification for industrial
    robots" (2007), and Gautier, "Dynamic identification of robots with power model" (1997) for the filter. All ten inertial
    parameters of a payload would be ill-conditioned; its inertia is taken to be a point mass's.

    Args:
        arm: The arm as its model knows it.
        log: A run of it with the payload, best along `excitation`.

    Returns:
        The estimate; where the run shows too little, `ok` is False and `reason` says why.

    Raises:
        InputError: It is no arm, no log, or the log is of an arm with other joints.
    """
    check_arm(arm)
    instance("log", log, Log, "armctl.simulate and every move of a Simulation give one")
    if log.joint_names != arm.joint_names:
        raise InputError(f"log: of the joints {list(log.joint_names)}, {list(arm.joint_names)} wanted")
    window = _window(log.dt)
    if len(log) < 4 * len(window):
        return _nothing(arm, f"the run lasts {len(log) * log.dt:.2f} s, at least {4 * len(window) * log.dt:.2f} s wanted")
    moves = np.abs(log.v).max(axis=0) > 2 * _SLOW
    if not moves.any():
        return _nothing(arm, "no joint moves; follow armctl.excitation(arm)")
    fit = _Fit(arm, log, window)
    for _ in range(_ROUNDS):
        fit.improve()
    return _judged(fit)


class _Fit:
    """The equations of one run, the parameters that explain it so far, and how well they are known."""

    def __init__(self, arm: Arm, log: Log, window: Array):
        self.arm, self._dt, self._window = arm, log.dt, window
        self._q, self._v, self._tau = log.q[:-1], log.v[:-1], log.tau[:-1]
        self._a = np.diff(log.v, axis=0) / log.dt
        self._prior = np.concatenate([_PRIOR, np.tile(arm.limits.tau_max, 2)])
        self._noise = _TORQUE_NOISE * arm.limits.tau_max
        self.theta = np.zeros(len(self._prior))
        self._used = np.abs(self._filtered(self._v)) > _SLOW
        self._X = self._columns()[self._used]
        self.error = self._prior

    def improve(self) -> None:
        """A Gauss-Newton step, each joint weighed by its noise, the prior as weak as it is wide."""
        residual = self._filtered(self._left_over())
        scale = (1 / np.broadcast_to(self._noise, self._used.shape))[self._used]
        X, r = self._X * scale[:, None], residual[self._used] * scale
        information = X.T @ X + np.diag(self._prior**-2.0)
        self.theta = self.theta + np.linalg.solve(information, X.T @ r - self.theta / self._prior**2)
        self.error = np.sqrt(np.diag(np.linalg.inv(information)))
        left = np.zeros(self._used.shape)
        left[self._used] = residual[self._used] - self._X @ np.linalg.solve(information, X.T @ r)
        spread = np.sqrt((left**2).sum(axis=0) / np.maximum(self._used.sum(axis=0), 1))
        self._noise = np.maximum(spread, _TORQUE_NOISE * self.arm.limits.tau_max)

    def _columns(self) -> Array:
        """(T, n, 4 + 2 n): what each parameter adds to each joint's torque, filtered."""
        dynamics, n = Dynamics(self.arm.model, self.arm.pinocchio_model), self.arm.n
        payload = np.array([dynamics.payload_regressor(*row) for row in zip(self._q, self._v, self._a, strict=True)])
        eye = np.eye(n)
        return np.concatenate(
            [
                self._filtered(payload.reshape(len(payload), -1)).reshape(-1, n, _PAYLOAD),
                self._filtered(np.sign(self._v))[:, :, None] * eye,
                self._filtered(self._v)[:, :, None] * eye,
            ],
            axis=2,
        )

    def _left_over(self) -> Array:
        """(T, n) N m that the model with the parameters so far does not explain."""
        mass, moment = self.theta[0], self.theta[1:_PAYLOAD]
        coulomb, viscous = self.theta[_PAYLOAD:].reshape(2, -1)
        positive = mass > _UNCERTAIN * 0.5
        known = self.arm.with_payload(mass, moment / mass) if positive else self.arm
        dynamics = Dynamics(known.model, known.pinocchio_model)
        rows = zip(self._q, self._v, self._a, strict=True)
        explained = np.array([dynamics.discrete_inverse_dynamics(q, v, a, self._dt) for q, v, a in rows])
        explained += np.sign(self._v) * (dynamics.friction_loss + coulomb) + self._v * viscous
        left = self._tau - explained
        if not positive:
            bare = Dynamics(self.arm.model, self.arm.pinocchio_model)
            regressors = (bare.payload_regressor(*row) for row in zip(self._q, self._v, self._a, strict=True))
            left -= np.array([Y @ self.theta[:_PAYLOAD] for Y in regressors])
        return left

    def _filtered(self, columns: Array) -> Array:
        """Columns over time (T, k) through the zero-phase filter, and no more rows of them than it lets through."""
        stride = max(1, round(0.25 / _CUTOFF / self._dt))
        return np.column_stack([np.convolve(c, self._window, "valid")[::stride] for c in columns.T])


def _window(dt: float) -> Array:
    """A Gaussian over time whose spectrum is down 3 dB at the cut-off."""
    sigma = math.sqrt(math.log(2)) / (2 * math.pi * _CUTOFF * dt)
    k = np.arange(-math.ceil(4 * sigma), math.ceil(4 * sigma) + 1)
    window = np.exp(-0.5 * (k / sigma) ** 2)
    return window / window.sum()


def _candidates(arm: Arm, rng: np.random.Generator) -> list[tuple[int, Array]]:
    """Sets of positions (k, n), from home to home, those first whose weights tell a payload's four numbers apart best.

    With each goes how close to home it keeps: 0 is far.
    """
    low, high = (np.clip(x, arm.home - _REACH, arm.home + _REACH) for x in (arm.limits.q_min, arm.limits.q_max))
    low, high = low + _OFF_LIMIT * (high - low), high - _OFF_LIMIT * (high - low)
    home, still, dynamics = arm.limits.clamp(arm.home), np.zeros(arm.n), Dynamics(arm.model, arm.pinocchio_model)
    sets = []
    for k in range(_SETS):
        size = k % _SIZES
        share = 0.5**size  # some keep closer to home, where little is in the way
        between = home + share * (rng.uniform(low, high, (_POSITIONS, arm.n)) - home)
        Y = np.vstack([dynamics.payload_regressor(q, still, still) / arm.limits.tau_max[:, None] for q in between])
        sets.append((np.linalg.slogdet(Y.T @ Y + _LITTLE * np.eye(_PAYLOAD))[1], size, np.vstack([home, between, home])))
    return [(size, waypoints) for _, size, waypoints in sorted(sets, key=lambda scored: -scored[0])]


def _judged(fit: _Fit) -> PayloadEstimate:
    """What was fitted, if the run showed enough of it."""
    mass, error = float(fit.theta[0]), float(fit.error[0])
    reason = ""
    if error > _UNCERTAIN * max(mass, 0.5):
        why = "the joints that carry it hardly move or rub too much; armctl.excitation(arm) shows what this arm can"
        if not _can_show_mass(fit.arm):
            why = "and no motion of this arm tells it from the payload's centre"
        reason = f"the mass is known to {error:.2g} kg only, {why}"
    elif mass < -2 * error:
        reason = f"the torques ask for a payload of {mass:.3g} kg: the arm's model has too much mass already"
    return _estimate(fit.arm, reason, fit.theta, fit.error)


def _can_show_mass(arm: Arm) -> bool:
    """Whether a payload's mass shows otherwise than its centre does: not where all joints turn about one vertical line."""
    rng, dynamics, limits = np.random.default_rng(0), Dynamics(arm.model, arm.pinocchio_model), arm.limits
    positions = limits.random(limits.clamp(arm.home), _SHOWN, rng)
    rates = rng.uniform(-1, 1, (_SHOWN, 2, arm.n))
    Y = np.vstack([dynamics.payload_regressor(q, *rows) for q, rows in zip(positions, rates, strict=True)])
    explained = Y[:, 1:] @ np.linalg.lstsq(Y[:, 1:], Y[:, 0])[0]
    return bool(np.linalg.norm(Y[:, 0] - explained) > _APART * np.linalg.norm(Y))


def _estimate(arm: Arm, reason: str, theta: Array, error: Array) -> PayloadEstimate:
    known = abs(theta[0]) > _UNCERTAIN * 0.5
    center = theta[1:_PAYLOAD] / theta[0] if known else np.zeros(3)
    shown = known & (error[1:_PAYLOAD] < 0.5 * np.array(_PRIOR[1:]))  # beyond that it is the prior's
    center_error = np.full(3, np.inf)
    center_error[shown] = error[1:_PAYLOAD][shown] / abs(theta[0])
    coulomb, viscous = theta[_PAYLOAD:].reshape(2, arm.n)
    coulomb_error, viscous_error = error[_PAYLOAD:].reshape(2, arm.n)
    arrays = (frozen(x.copy()) for x in (center, center_error, coulomb, coulomb_error, viscous, viscous_error))
    return PayloadEstimate(not reason, reason, float(theta[0]), float(error[0]), *arrays)


def _nothing(arm: Arm, reason: str) -> PayloadEstimate:
    unknown = np.full(_PAYLOAD + 2 * arm.n, np.nan)
    return _estimate(arm, reason, unknown, unknown)
