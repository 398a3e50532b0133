"""Gains from margins: the highest gains for which the loop tolerates a delay, in any configuration of the arm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import pi, sin, sqrt, tan
from typing import cast
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armctl.core.defaults import DEFAULT_BANDWIDTH, MIN_DELAY_MARGIN_S
from armctl.core.errors import InputError, ModelError
from armctl.core.limits import smallest_configuration
from armctl.core.validation import Array, IntArray, frozen, number, vector
from armctl.model.arm.arm import Arm
from armctl.model.arm.dynamics import Dynamics, make_dynamics

SAMPLED_CONFIGURATIONS = 64
_DESIGN_SEED = 0  # of these; `armctl.margins` judges controllers at others
_SEARCH_STARTS = 3  # of the search for extreme configurations, and its steps from each
_SEARCH_STEPS = 150
# rad/s^2. A motor that could accelerate its joint faster than this has a joint of negligible inertia.
MAX_MOTOR_ACCELERATION = 1000.0

# Bounds of the default gains, which hold at configurations that the design did not sample, hence the reserve.
DELAY_MARGINS_S = (1e-3, 1.0)  # that may be asked for
MIN_DELAY_MARGIN_PERIODS = 2.5
_DELAY_RESERVE = 1.04
_DESIGN_SENSITIVITY = 1.6
# Where the arm moves continuously, a velocity that is differenced from positions is half a period late. The lag of a step of
# MuJoCo, for which the delay is required, is part of it.
_DIFFERENCE_DELAY = 0.35
# Stiffness / gravity stiffness below which an arm under PD would fall over, with a reserve for configurations between samples.
_MIN_GRAVITY_RATIO = 1.25
_GRAVITY_STEP = 1e-5  # rad (m), of the central differences of gravity torques
_MAX_STIFFNESS_PER_DAMPING = 0.25  # of the crossover frequency of the fastest mode, which is then critically damped
_MAX_STIFFNESS_AGAINST_GRAVITY = 0.5  # the same where gravity needs it
# If gravity needs more than this times the stiffness that the peak sensitivity allows, no gains satisfy that bound. The gains
# then keep the delay margin of 5 ms and the sag under gravity small: a higher ratio, and the stiffness per damping, 1/s, that
# damps a joint at 20 rad/s critically.
MAX_GRAVITY_EXCESS = 8.0
_FALLBACK_GRAVITY_RATIO = 2.5
_SHORT_PERIOD_S = MIN_DELAY_MARGIN_S / MIN_DELAY_MARGIN_PERIODS  # up to it, the delay margin is that in seconds
_FALLBACK_STIFFNESS_PER_DAMPING = 10.0
_BISECTIONS = 60
# Stiffness per damping / damping per inertia of the slowest mode at which |s^2 / (s^2 + d s + b d)| peaks at the sensitivity of
# the design.
_PD_STIFFNESS = 1 / (2 * (1 - sqrt(1 - 1 / _DESIGN_SENSITIVITY**2)))

# A joint whose own damping is larger than that of its feedback takes more stiffness than one without: steps by these factors,
# as long as margins computed with that damping keep the bounds; first at a few configurations, then less by a factor for all.
_STIFFNESS_STEPS = (8.0, 2.0, 1.25, 1.1)
_SEARCHED_CONFIGURATIONS = 12  # the last ones, which include the extreme ones
_SEARCHED_FREQUENCIES = 30
_LESS = 0.93
_MIN_FREQUENCY = 0.5  # rad/s, of these margins
_MAX_FREQUENCY = 0.99 * pi  # rad per control period
_FREQUENCIES = 60

MAX_BANDWIDTH = 1e6  # rad/s, and the bound of damping ratios: a thousand times what any control period can use


@dataclass(frozen=True, slots=True, eq=False)
class SampledInertia:
    """Mass matrices of an arm at `sample_configurations`, and what gravity does there."""

    configurations: Array  # (k, n) rad
    mass: Array  # (k, n, n) kg m^2, the mass matrices M
    mobility: Array  # (k, n, n) 1/(kg m^2), their inverses
    gravity_stiffness: Array  # (k, n, n) N m/rad, the derivatives of the torques that hold the arm
    damping: Array  # (n,) N m s/rad, of the model's joints


_sampled: WeakKeyDictionary[Arm, SampledInertia] = WeakKeyDictionary()
_designed: WeakKeyDictionary[Arm, dict[tuple[float, float], FeedbackGains]] = WeakKeyDictionary()
_extra: WeakKeyDictionary[Arm, dict[tuple[float, float, float], Array]] = WeakKeyDictionary()


def sampled_inertia(arm: Arm) -> SampledInertia:
    """The `SampledInertia` of an arm, computed once per arm."""
    found = _sampled.get(arm)
    if found is not None:
        return found
    dynamics = make_dynamics(arm.model, arm.pinocchio_model)
    rng = np.random.default_rng(_DESIGN_SEED)
    drawn = arm.limits.random(arm.limits.clamp(arm.home), SAMPLED_CONFIGURATIONS, rng)
    closure = arm.joint_map.closure
    configurations = np.vstack([arm.home, drawn if closure is None else closure.inward(arm.home, drawn)])
    try:
        configurations = np.vstack([configurations, _extreme_configurations(arm, dynamics, configurations, rng)])
        mass = np.array([dynamics.mass_matrix(q) for q in configurations])
        mobility = np.asarray(np.linalg.inv(mass), dtype=np.float64)
    except np.linalg.LinAlgError:
        raise ModelError(
            f"{arm.name}: the mass matrix is singular, so no gains follow from it; check the masses and inertias of the model"
        ) from None
    steps = _GRAVITY_STEP * np.eye(arm.n)
    gravity = np.array([[dynamics.gravity(q + dq) - dynamics.gravity(q - dq) for dq in steps] for q in configurations])
    found = SampledInertia(
        configurations=frozen(configurations),
        mass=frozen(mass),
        mobility=frozen(mobility),
        gravity_stiffness=frozen(gravity / (2 * _GRAVITY_STEP)),
        damping=dynamics.damping,
    )
    _sampled[arm] = found
    return found


def _extreme_configurations(arm: Arm, dynamics: Dynamics, sampled: Array, rng: np.random.Generator) -> Array:
    """(2, n) rad, where M^-1, scaled like the dampings of `margin_gains`, has its largest and its smallest eigenvalue.

    Random configurations rarely meet them, and the delay margin and the peak sensitivity of PD depend on them.
    """
    mass = np.array([dynamics.mass_matrix(q) for q in sampled])
    free = 1 / np.diagonal(np.linalg.inv(mass), axis1=1, axis2=2)
    root = _damping_scale(free, np.diagonal(mass, axis1=1, axis2=2)) ** 0.5

    closure = arm.joint_map.closure

    def rates(q: Array) -> Array:
        if closure is not None and closure.first_refusal(q[None])[1]:
            return np.array([np.inf, -np.inf])  # where closed loops do not close is no extreme
        inverses = np.linalg.eigvalsh(dynamics.mass_matrix(q) / np.outer(root, root))
        return np.asarray(inverses, dtype=np.float64)

    values = np.array([rates(q) for q in sampled])
    found = []
    for score, order in (
        (lambda q: float(rates(q)[0]), np.argsort(values[:, 0])),
        (lambda q: -float(rates(q)[-1]), np.argsort(-values[:, -1])),
    ):
        starts = list(sampled[order[:_SEARCH_STARTS]])
        found.append(smallest_configuration(arm.limits, score, starts, _SEARCH_STEPS, rng))
    return np.array(found)


def _damping_scale(free: Array, locked: Array) -> Array:
    """(n,) kg m^2, the ratios of the dampings, from inertias (k, n) with the other joints free and locked."""
    return np.asarray(np.sqrt(free.min(axis=0) * locked.max(axis=0)), dtype=np.float64)


def sample_configurations(arm: Arm) -> Array:
    """Home, 64 random configurations and two extreme ones, always the same, (67, n) rad: gains are designed for all of them."""
    return sampled_inertia(arm).configurations


def effective_inertia(arm: Arm) -> Array:
    """The inertia that each motor accelerates if the other joints are free, 1 / (M^-1)_ii, (k, n) kg m^2, at the samples.

    M_ii, the inertia with the other joints locked, is up to 21 times larger where joint axes are parallel.
    """
    return 1 / np.diagonal(sampled_inertia(arm).mobility, axis1=1, axis2=2)


def max_locked_inertia(arm: Arm) -> Array:
    """The largest inertia of each joint if the other joints are locked, max M_ii over `sample_configurations`, (n,) kg m^2."""
    return np.asarray(np.diagonal(sampled_inertia(arm).mass, axis1=1, axis2=2).max(axis=0), dtype=np.float64)


def required_delay(dt: float, delay_margin: float = MIN_DELAY_MARGIN_S) -> float:
    """The delay, s, after which default gains may make a loop unstable: its delay margin plus half of the control period.

    A torque that is held for dt acts as if it were late by dt / 2.
    """
    return _DELAY_RESERVE * max(delay_margin, MIN_DELAY_MARGIN_PERIODS * dt) + 0.5 * dt


def max_damping_rate(stiffness_per_damping: float, dt: float) -> float:
    """The largest damping / inertia, 1/s, with which a joint has the required delay margin, for b = stiffness / damping, 1/s.

    The loop of a joint of inertia 1 with damping d and stiffness b d is d (s + b) / s^2. With y the product of crossover
    frequency and delay T, the delay at which it becomes unstable follows from b T = y / tan(y) and d T = y sin(y).
    """
    delay = required_delay(dt)
    product = stiffness_per_damping * delay
    return _largest_rate(lambda y: y / tan(y) > product, delay)


def _largest_rate(is_stable: Callable[[float], bool], delay: float) -> float:
    """The d, 1/s, of `max_damping_rate` at the largest stable y at a delay, s."""
    low = 0.0
    high = 0.5 * pi
    for _ in range(_BISECTIONS):
        y = 0.5 * (low + high)
        if is_stable(y):
            low = y
        else:
            high = y
    return low * sin(low) / delay


@dataclass(frozen=True, slots=True, eq=False)
class FeedbackGains:
    """Gains of each joint, and what they cost."""

    stiffness: Array  # (n,) N m/rad (Kp)
    damping: Array  # (n,) N m s/rad (Kd)
    # stiffness that gravity needs / stiffness that the peak sensitivity allows a PD, in the worst joint, at least 1; above 8,
    # the gains do not satisfy the bounds
    gravity_excess: float


def margin_gains(arm: Arm, dt: float, delay_margin: float = MIN_DELAY_MARGIN_S) -> FeedbackGains:
    """The stiffest PD gains with a sufficient delay margin, s, and peak sensitivity in all sampled configurations.

    The ratios of the dampings D make the eigenvalues of M^-1 D as equal as a diagonal matrix can. If stiffness is b D with one
    b for all joints, the loop consists of n independent ones, d (s + b) / s^2, where d is an eigenvalue of M^-1 D, and the
    sensitivity of a joint is a convex combination of theirs. The largest d of all configurations has the delay margin, the
    smallest the peak sensitivity. Damping in the model allows more stiffness. Where gravity needs more, the peak is higher.
    Where a joint's own damping is the larger one, no loops are independent, and `_damped_stiffness` raises its stiffness.
    """
    known = _designed.setdefault(arm, {})
    if (dt, delay_margin) not in known:
        known[dt, delay_margin] = _margin_gains(arm, dt, delay_margin)
    return known[dt, delay_margin]


def _margin_gains(arm: Arm, dt: float, delay_margin: float) -> FeedbackGains:
    sampled = sampled_inertia(arm)
    scale = _damping_scale(effective_inertia(arm), np.diagonal(sampled.mass, axis1=1, axis2=2))
    root = np.sqrt(scale)
    rates = np.linalg.eigvalsh(root[:, None] * sampled.mobility * root)
    slowest = float(rates.min() / rates.max())
    ratio = min(_MAX_STIFFNESS_PER_DAMPING, slowest * _PD_STIFFNESS)
    # The largest d if b is this ratio of it.
    rate = _largest_rate(lambda y: ratio * tan(y) * sin(y) < 1.0, required_delay(dt, delay_margin) + _DIFFERENCE_DELAY * dt)
    damping = scale * rate / rates.max()
    allowed = ratio * rate * (damping + sampled.damping)
    gravity = _gravity_stiffness(sampled, damping)
    stiffest = _MAX_STIFFNESS_AGAINST_GRAVITY * rate * damping
    needed = np.minimum(_MIN_GRAVITY_RATIO * gravity, stiffest)
    excess = float(np.max(needed / np.maximum(allowed, np.finfo(float).tiny), initial=1.0))
    stiffness = np.maximum(allowed, needed)
    if (sampled.damping > damping).any():
        raised, keeps_peak = _damped_stiffness(sampled, stiffness, damping, dt, delay_margin)
        if keeps_peak or excess <= MAX_GRAVITY_EXCESS:
            return FeedbackGains(frozen(raised), frozen(damping), 1.0 if keeps_peak else excess)
    if excess > MAX_GRAVITY_EXCESS:
        if dt > _SHORT_PERIOD_S:
            return replace(margin_gains(arm, _SHORT_PERIOD_S, delay_margin), gravity_excess=excess)
        stiffness = np.maximum(stiffness, np.minimum(_FALLBACK_GRAVITY_RATIO * gravity, stiffest))
        stiffness = np.maximum(stiffness, _FALLBACK_STIFFNESS_PER_DAMPING * damping)
    return FeedbackGains(frozen(stiffness), frozen(damping), excess)


def _damped_stiffness(
    sampled: SampledInertia, stiffness: Array, damping: Array, dt: float, delay_margin: float
) -> tuple[Array, bool]:
    """(n,) N m/rad, and whether its peak sensitivity is that of the design.

    The stiffness of joints whose own damping is larger than that of the feedback is raised up to the bounds: first of all of
    them at once, then of each alone. Bounds that the given gains miss are those that these have.
    """
    heavy = np.flatnonzero(sampled.damping > damping)
    given = PdLoops(sampled, stiffness, damping, dt)
    max_peak = max(given.peak_sensitivity, _DESIGN_SENSITIVITY)
    min_delay = min(given.delay_margin, _DELAY_RESERVE * max(delay_margin, MIN_DELAY_MARGIN_PERIODS * dt))

    def is_within(raised: Array, at: SampledInertia, frequencies: int) -> bool:
        loops = PdLoops(at, raised, damping, dt, frequencies)
        return loops.peak_sensitivity <= max_peak and 0.0 < loops.delay_margin >= min_delay

    last = slice(-_SEARCHED_CONFIGURATIONS, None)
    some = replace(
        sampled, mass=sampled.mass[last], mobility=sampled.mobility[last], gravity_stiffness=sampled.gravity_stiffness[last]
    )
    found = stiffness
    for joints in (heavy, *heavy[:, None]):
        for step in _STIFFNESS_STEPS:
            raised = _times(found, joints, step)
            while is_within(raised, some, _SEARCHED_FREQUENCIES):
                found = raised
                raised = _times(found, joints, step)
    while not is_within(found, sampled, _FREQUENCIES) and (found > stiffness).any():
        found = np.maximum(_times(found, heavy, _LESS), stiffness)
    return found, max_peak == _DESIGN_SENSITIVITY


def _times(gains: Array, joints: IntArray, factor: float) -> Array:
    scaled = gains.copy()
    scaled[joints] *= factor
    return scaled


class PdLoops:
    """The loops of PD, with gravity compensation and without, at all configurations of `sampled`.

    In MuJoCo's steps, whose damping acts at the end of a step, at the samples.
    """

    def __init__(
        self, sampled: SampledInertia, stiffness: Array, damping: Array, dt: float, frequencies: int = _FREQUENCIES
    ) -> None:
        self._design = (sampled, stiffness, damping, dt)
        n = len(stiffness)
        w = np.geomspace(_MIN_FREQUENCY, _MAX_FREQUENCY / dt, frequencies)
        rate = ((1 - np.exp(-1j * w * dt)) / dt)[:, None, None, None]  # of a velocity to its position
        acceleration = rate * ((np.exp(1j * w * dt) - 1) / dt)[:, None, None, None]
        own = np.diag(sampled.damping)
        inertia = acceleration * (sampled.mass + dt * own) + rate * own
        compliance = np.linalg.inv(inertia + sampled.gravity_stiffness)
        pd = np.eye(n) * (stiffness + rate * damping)
        self._frequencies = w
        self._loops = [
            np.asarray(feedback @ compliance, dtype=np.complex128) for feedback in (pd, pd - sampled.gravity_stiffness)
        ]

    @property
    def peak_sensitivity(self) -> float:
        """The largest sensitivity of a joint, the other joints closed."""
        unit = np.eye(self._loops[0].shape[-1])
        sensitivities = (np.linalg.inv(unit + loop) for loop in self._loops)
        return max(float(np.abs(np.diagonal(each, axis1=2, axis2=3)).max()) for each in sensitivities)

    @property
    def delay_margin(self) -> float:
        """s; 0 if a loop is unstable."""
        return min(_delay_margin(self._frequencies, loop) for loop in self._loops) if _is_stable(*self._design) else 0.0


def _is_stable(sampled: SampledInertia, stiffness: Array, damping: Array, dt: float) -> bool:
    """Whether PD with differenced positions holds all configurations, with gravity compensation and without."""
    n = len(stiffness)
    none = np.zeros_like(sampled.mass)
    own = np.diag(sampled.damping)
    mobility = np.linalg.inv(sampled.mass + dt * own)
    for gravity in (sampled.gravity_stiffness, none):
        # The states are positions, velocities, and the positions before.
        by_position = -dt * mobility @ (np.diag(stiffness + damping / dt) + gravity)
        by_velocity = np.eye(n) - dt * mobility @ own
        by_past = mobility * damping
        later = np.concatenate([by_position, by_velocity, by_past], axis=2)
        here = np.hstack([np.eye(n), np.zeros((n, 2 * n))])
        step = np.concatenate([here + dt * later, later, np.broadcast_to(here, later.shape)], axis=1)
        if not np.abs(np.linalg.eigvals(step)).max() < 1.0:
            return False
    return True


def _delay_margin(w: Array, loop: NDArray[np.complex128]) -> float:
    """s, the smallest of loop transfer functions (k, configurations, n, n): where an eigenvalue has the magnitude 1."""
    eigenvalues = np.linalg.eigvals(loop)
    eigenvalues = np.take_along_axis(eigenvalues, np.abs(eigenvalues).argsort(axis=2), axis=2)
    size = np.log(np.maximum(np.abs(eigenvalues), np.finfo(np.float64).tiny))  # 0 where a stiffness is 0
    k, configuration, rank = np.nonzero((size[1:] > 0.0) != (size[:-1] > 0.0))
    before = size[k, configuration, rank]
    share = before / (before - size[k + 1, configuration, rank])
    start = np.angle(eigenvalues[k, configuration, rank])
    turn = (np.angle(eigenvalues[k + 1, configuration, rank]) - start + pi) % (2 * pi) - pi
    lag = (start + share * turn + pi) % (2 * pi)
    return float(np.min(lag / (w[k] * (w[k + 1] / w[k]) ** share), initial=np.inf))


def _gravity_stiffness(sampled: SampledInertia, damping: Array) -> Array:
    """(n,) N m/rad, a diagonal matrix that no derivative of the gravity torques exceeds, joints scaled by their damping."""
    root = np.sqrt(damping)
    scaled = np.abs(sampled.gravity_stiffness) * (root[:, None] / root)
    return np.asarray(scaled.sum(axis=2).max(axis=0), dtype=np.float64)


def extra_inertia(arm: Arm, bandwidth: float, damping_ratio: float, dt: float) -> Array:
    """Inertia, (n,) kg m^2, that the feedback of computed torque may add to joints of negligible inertia.

    Feedback in proportion to a negligible inertia would yield to any friction or payload. The inertia that the joint's motor
    accelerates at 1000 rad/s^2 is enough. With an added inertia E, whose feedback is 2 z w E (e_dot + w e) for the bandwidth w,
    rad/s, and the damping ratio z of the unit masses, the loop gain grows by the eigenvalues of 1 + M^-1 E; the delay margin
    bounds the largest one, which a search over all configurations finds.
    """
    known = _extra.setdefault(arm, {})
    key = (bandwidth, damping_ratio, dt)
    if key not in known:
        known[key] = frozen(_extra_inertia(arm, *key))
    return known[key]


def _extra_inertia(arm: Arm, bandwidth: float, damping_ratio: float, dt: float) -> Array:
    smallest = effective_inertia(arm).min(axis=0)
    rate = max(2 * damping_ratio * bandwidth, 1e-12)
    stiffness_per_damping = bandwidth * max(1.0, bandwidth / rate)  # of the added feedback, or of that of the unit masses
    max_growth = max(0.0, max_damping_rate(stiffness_per_damping, dt) / rate - 1.0)
    extra = np.clip(arm.limits.tau_max / MAX_MOTOR_ACCELERATION - smallest, 0.0, max_growth * smallest)
    if not extra.any():
        return extra
    root = np.sqrt(extra)
    dynamics = make_dynamics(arm.model, arm.pinocchio_model)
    closure = arm.joint_map.closure

    def largest(q: Array) -> float:
        if closure is not None and closure.first_refusal(q[None])[1]:
            return -np.inf
        return float(np.linalg.eigvalsh(root[:, None] * np.linalg.inv(dynamics.mass_matrix(q)) * root)[-1])

    sampled = sampled_inertia(arm)
    growths = np.linalg.eigvalsh(root[:, None] * sampled.mobility * root)[:, -1]
    starts = list(sampled.configurations[np.argsort(-growths)[:_SEARCH_STARTS]])
    rng = np.random.default_rng(_DESIGN_SEED)
    growth = largest(smallest_configuration(arm.limits, lambda q: -largest(q), starts, _SEARCH_STEPS, rng))
    return extra * min(1.0, max_growth / max(growth, 1e-12))


def bandwidth_gains(
    arm: Arm,
    bandwidth: float | None = None,
    damping_ratio: float = 1.0,
    stiffness: ArrayLike | None = None,
    damping: ArrayLike | None = None,
) -> FeedbackGains:
    """Stiffness and damping of each joint, from a bandwidth, rad/s, unless given.

    The bandwidth, 30 rad/s if None, is the natural frequency of each joint's closed loop at its median inertia: the stiffness
    is bandwidth^2 x inertia, and the damping 2 x damping_ratio x sqrt(stiffness x inertia).
    """
    bandwidth = number("bandwidth", DEFAULT_BANDWIDTH if bandwidth is None else bandwidth, 0.0, MAX_BANDWIDTH)
    scale = np.median(effective_inertia(arm), axis=0)
    stiffness = gain("stiffness", bandwidth * bandwidth * scale if stiffness is None else stiffness, arm.n)
    damping = gain("damping", 2 * damping_ratio * np.sqrt(stiffness * scale) if damping is None else damping, arm.n)
    return FeedbackGains(stiffness, damping, 1.0)


def gain(name: str, value: ArrayLike, n: int) -> Array:
    """Validated gains, (n,), read-only; one number applies to all n."""
    is_one_number = np.isscalar(value) or getattr(value, "ndim", None) == 0
    gains = vector(name, np.full(n, number(name, cast(float, value))) if is_one_number else value, n)
    if (gains < 0.0).any():
        raise InputError(f"{name}: every value must be at least 0, got {gains.min():g}")
    return gains
