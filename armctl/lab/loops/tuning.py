"""Tuning: the stiffest loop of a control law within bounds on delay margin, peak sensitivity and torque noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from itertools import compress, product
from operator import itemgetter

import numpy as np
from numpy.typing import ArrayLike

from armctl.control import controller_by_name
from armctl.control.gains import sample_configurations
from armctl.control.interface import Controller
from armctl.control.pd import PD
from armctl.core.defaults import MAX_PEAK_SENSITIVITY, MIN_DAMPING_RATIO, MIN_DELAY_MARGIN_S
from armctl.core.errors import InputError, ModelError, UnknownNameError
from armctl.core.result import Verdict
from armctl.core.validation import Array, number, shown
from armctl.lab.loops.gain_family import GainFamily, gain_family, tunable_laws
from armctl.lab.loops.linearization import Linearizer
from armctl.lab.loops.loop import Loop, Mode, coarse_margins_around, coarse_margins_with, coarse_plant
from armctl.lab.loops.margins import judged_configurations, search_starts, worst_loops
from armctl.lab.loops.stability import CoarseMargins
from armctl.lab.loops.state_space import ComplexArray, linear_controller
from armctl.model.arm.arm import Arm, check_arm
from armctl.run.sim.plant import ENCODER_NOISE_RAD, NOMINAL, Plant, read_plant

_COMPLIANCE_FREQUENCY = 2 * np.pi  # rad/s
# Of the goal. At 1 Hz, a slow loop moves its inertia rather than its springs: what lasts for minutes decides there.
_GOAL_FREQUENCIES = (1e-2 * _COMPLIANCE_FREQUENCY, 1e-1 * _COMPLIANCE_FREQUENCY, _COMPLIANCE_FREQUENCY)
# Configurations of the design, of those for default gains: the extreme ones, and random ones for laws without inertia matrix.
_DESIGN_CONFIGURATIONS = 10
_DESIGN_CONFIGURATIONS_WITH_MODEL = 2
# Of the bounds, in the design, whose margins are accurate to it.
_RESERVE = 1.003
_BOUND_TOLERANCE = 0.001  # of the logarithms of the bounds, to which the design meets them
_ROUNDS = 12  # of design and search for configurations that violate the bounds
_EXACT_ROUNDS = 6  # after which each further round keeps more of a distance from the bounds, by this factor
_MORE_RESERVE = 1.02
_SCALES = (1.0, 1.4, 0.7, 2.0, 0.5, 2.8, 0.35, 4.0, 0.25, 8.0, 0.125, 16.0, 0.0625)  # of all gains, where a design may begin
_BISECTIONS = 6  # to come back within the bounds
_RATIOS = (1.0, 0.5, 0.25, 0.1)  # of the stiffness of PD and of the observer's bandwidth, there
_ADDED = 6  # configurations in a round
_ITERATIONS = 12
_RESTARTS = 4  # of the search for the least displacement, and its logarithm that one must gain for another one
_GAINED = 0.02
_SPARE = 0.01  # of the logarithms of the bounds, with which a search for gains within them ends
_ACCURACY = 1e-3  # of the logarithm of the displacement
_DIFFERENCE = 1e-3  # of the logarithms of the gains
_ACTIVE = 0.5  # constraints with more than this left have no slope
_UNSTABLE = -1.0  # what is left at most of the bounds of a loop that is unstable
_COST_CASES = 6  # configurations of the first plant at which the displacement is computed
_RAISE = 1.05  # of the gains of a joint, for the bound that limits it


@dataclass(frozen=True, slots=True, eq=False)
class LoopFigures:
    """What a controller achieves: the worst values of all configurations and plants."""

    delay_margin: float  # s
    peak_sensitivity: float  # Ms
    chatter: float  # N m (N), torque noise at rest with an encoder of 1e-5 rad that velocities are differenced from
    compliance: float  # m/N, of the tip at 1 Hz in the worst direction: the error that slow unknown forces and payloads cause
    damping_ratio: float  # of the least damped vibration; infinite if there is none. Below 0.1, one sees it
    frequency: float  # rad/s, of that vibration; NaN if there is none

    def __str__(self) -> str:
        vibrates = ""
        if self.damping_ratio < MIN_DAMPING_RATIO:
            vibrates = f"; vibrates, at {Mode(self.damping_ratio, self.frequency)}"
        return (
            f"delay margin {1e3 * self.delay_margin:.3g} ms, Ms {self.peak_sensitivity:.3g}, "
            f"torque noise {self.chatter:.2g} N m, compliance at 1 Hz {1e6 * self.compliance:.3g} um/N{vibrates}"
        )

    def to_dict(self) -> dict[str, float | None]:
        """All figures for JSON; one that is not finite is None."""
        return {name: value if np.isfinite(value) else None for name, value in asdict(self).items()}


@dataclass(frozen=True, slots=True, eq=False)
class Tuning(Verdict):
    """A tuned controller and what limits it. True if it satisfies the bounds.

    Attributes:
        ok: Whether gains within the bounds were found.
        controller: The controller with the highest gains that were found; the default one if not ok.
        active: The bound that the next higher gain of each joint violates: "delay margin", "peak sensitivity", "chatter" or
            "none"; one for all joints where they have common gains.
        gains: The gains by name, each a number or (n,).
        before: The figures of the default gains.
        after: The figures of the tuned gains.
        reason: The reason if no gains satisfy the bounds; empty if ok.
    """

    ok: bool
    controller: Controller
    active: tuple[str, ...]
    gains: dict[str, float | Array]
    before: LoopFigures
    after: LoopFigures
    reason: str

    def __str__(self) -> str:
        lines = [f"default: {self.before}"]
        if not self.ok:
            return "\n".join([f"not tuned: {self.reason}", *lines])
        lines.append(f"tuned:   {self.after}")
        lines += [f"{name}: {np.round(value, 4).tolist()}" for name, value in self.gains.items()]
        lines.append(f"active bound of each joint: {', '.join(self.active)}")
        return "\n".join(lines)

    def to_dict(self) -> dict[str, object]:
        """The figures as plain values for JSON."""
        return {
            "ok": self.ok,
            "reason": self.reason,
            "active": list(self.active),
            "gains": {name: np.asarray(value).tolist() for name, value in self.gains.items()},
            "before": self.before.to_dict(),
            "after": self.after.to_dict(),
        }


def tune(
    arm: Arm,
    law: str,
    delay_margin: float = MIN_DELAY_MARGIN_S,
    peak_sensitivity: float = MAX_PEAK_SENSITIVITY,
    chatter: float | None = None,
    configurations: int | ArrayLike = 20,
    plants: Sequence[Plant] = (),
) -> Tuning:
    """Finds the gains of a control law that yield least to disturbances while the loop satisfies bounds everywhere.

    What is minimal is the root mean square of the displacements of the joints at 0.01, 0.1 and 1 Hz, by disturbance torques in
    proportion to the torque limits. All gains of the law are free: stiffness and damping of each joint of PD; bandwidths and
    damping ratio of laws with a model; bandwidths and integral time of LQR. Sequential quadratic programming finds them for
    configurations of the design. They are then judged like in `margins`, with its search for the worst configuration. Each
    configuration that violates a bound becomes one of the design, which is repeated.

    Args:
        law: The name of a controller whose gains can be tuned: all but "computed-torque-textbook".
        delay_margin: s, the smallest permitted one.
        peak_sensitivity: The largest permitted Ms, above 1.
        chatter: N m (N), the largest permitted torque noise at rest with an encoder of 1e-5 rad; None for no bound.
        configurations: How many there are at which the result is judged: home and random ones, always the same; or the
            configurations themselves, (k, n) rad, for which the gains are then designed, too. Bounds that only a rare
            configuration violates, such as one near a singularity for "impedance", take hundreds to find.
        plants: The simulated plants, all with one control period; by default the one that does not differ from the model.

    Returns:
        The controller, its gains, the bound that limits each joint, and figures before and after.

    Raises:
        InputError: An argument has a wrong type or value.
        ModelError: No linear model describes the controller.
        UnknownNameError: There is no such law.
    """
    check_arm(arm)
    if not isinstance(law, str) or law not in tunable_laws():
        raise UnknownNameError.from_known("law", law, tunable_laws())
    if not isinstance(plants, Sequence):
        raise InputError(f"plants: expected a list of plants, such as [armctl.Plant(payload=1.0)], got {shown(plants)}")
    bounds = _Bounds(
        delay_margin=number("delay_margin", delay_margin, 0.0),
        peak_sensitivity=number("peak_sensitivity", peak_sensitivity, 1.0),
        chatter=np.inf if chatter is None else number("chatter", chatter, 0.0),
    )
    checked = [read_plant(plant) for plant in plants] or [NOMINAL]
    periods = {arm.dt if plant.timestep is None else plant.timestep for plant in checked}
    if len(periods) > 1:
        raise InputError(f"plants: expected one control period, got {sorted(periods)} s; gains are tuned for one")
    default = controller_by_name(law, arm)
    family = gain_family(arm, law, periods.pop())
    # A law whose gains are those of the joints does not know how the inertia matrix varies.
    design_configurations = _DESIGN_CONFIGURATIONS if family.is_joint_by_joint else _DESIGN_CONFIGURATIONS_WITH_MODEL
    judge = _Judge([Linearizer(arm, plant) for plant in checked], configurations, design_configurations, bounds, default)
    before = judge.before
    x = judge.design.start(family)
    loops: list[Loop] = []
    worst: list[_Case] = []
    for k in range(_ROUNDS):
        judge.design.bounds = replace(bounds, reserve=_RESERVE * _MORE_RESERVE ** max(0, k - _EXACT_ROUNDS + 1))
        x = None if x is None else judge.design.improved(family, x)
        if x is None:
            break
        worst, loops = judge.violating(family.controller(x))
        if not worst:
            break
        judge.design.cases += worst
    if x is None or worst:
        reason = f"no gains of {law} satisfy delay margin {1e3 * bounds.delay_margin:g} ms and Ms {bounds.peak_sensitivity:g}"
        reason += "" if chatter is None else f" and torque noise {chatter:g} N m"
        if any(linearizer.is_elastic for linearizer in judge.linearizers):
            reason += " on elastic joints, which it takes as rigid (ElasticFeedforward knows the springs)"
        reason += f" on {arm.name:.80}, among {min(_SCALES):g} to {max(_SCALES):g} times the default ones"
        return Tuning(ok=False, controller=default, active=(), gains={}, before=before, after=before, reason=reason)
    tuned = family.controller(x)
    return Tuning(
        ok=True,
        controller=tuned,
        active=judge.design.active(family, x),
        gains=family.gains(x),
        before=before,
        after=judge.figures(loops),
        reason="",
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Bounds:
    delay_margin: float
    peak_sensitivity: float
    chatter: float
    reserve: float = _RESERVE

    def left(self, found: CoarseMargins) -> Array:
        """(2, n) what is left of the bounds on delay margin and Ms, as logarithms."""
        with np.errstate(divide="ignore"):
            delay = np.log(found.delay / (self.reserve * self.delay_margin))
            sensitivity = np.log(self.peak_sensitivity / (self.reserve * found.peak_sensitivity))
        return np.clip([delay, sensitivity], _UNSTABLE, 1.0)

    def violated_by(self, loops: Sequence[Loop], coarse: Sequence[CoarseMargins]) -> list[bool]:
        """Whether each violates a bound by its coarse margins; if none does so, by its margins."""
        kept = [
            each.delay.min() >= self.delay_margin and each.peak_sensitivity.max() <= self.peak_sensitivity for each in coarse
        ]
        if all(kept):
            exact = [loop.robustness() for loop in loops]
            kept = [each.delay_margin >= self.delay_margin and each.peak_sensitivity <= self.peak_sensitivity for each in exact]
        return [not each for each in kept]


@dataclass(frozen=True, slots=True, eq=False)
class _Case:
    linearizer: Linearizer
    loop: Loop
    transfer: ComplexArray

    def with_controller(self, controller: Controller) -> Loop:
        linearizer = self.linearizer
        law = linear_controller(linearizer.arm, controller, self.loop.q, self.loop.dt, linearizer.plant.continuous)
        return self.loop.with_law(law)

    def margins(self, controller: Controller) -> CoarseMargins:
        return coarse_margins_with(self.transfer, self.with_controller(controller))


def _cases(linearizers: Sequence[Linearizer], configurations: Array) -> list[_Case]:
    arm = linearizers[0].arm
    static = PD(arm, stiffness=0.0, damping=0.0)
    loops = [(linearizer, linearizer.loop_at(static, q)) for linearizer in linearizers for q in configurations]
    return [_Case(linearizer, loop, coarse_plant(loop)) for linearizer, loop in loops]


class _Design:
    def __init__(self, arm: Arm, cases: list[_Case], bounds: _Bounds):
        self._arm = arm
        self.cases = cases
        self.bounds = bounds
        self._bounds_per_case = 2 * arm.n

    def start(self, family: GainFamily) -> Array | None:
        """Gains within the bounds, near multiples of the default ones; None if none are found."""
        x = np.zeros(family.size)
        if self._is_feasible(family.controller(x)):
            return x
        within: list[tuple[float, Array]] = []
        beyond: list[tuple[tuple[float, float], Array]] = []
        for scale, ratio in product(_SCALES, _RATIOS):
            x = np.log(scale) * family.scaling
            x[list(family.softened)] += np.log(ratio)
            left, cost = self._evaluated(family.controller(x))
            if left.min() >= -_BOUND_TOLERANCE:
                within.append((cost, x))
            elif left.min() > _UNSTABLE:
                beyond.append(((float(left.min()), float(left.mean())), x))
        if within:
            return min(within, key=itemgetter(0))[1]
        return self._feasible(family, max(beyond, key=itemgetter(0))[1]) if beyond else None

    def _feasible(self, family: GainFamily, x: Array) -> Array | None:
        """The gains within the bounds that a search for the largest least distance from them meets first, or None."""
        from scipy.optimize import minimize

        evaluated, slopes = self._functions(family)
        ones = np.ones((1, 1))
        within = {
            "type": "ineq",
            "fun": lambda y: evaluated(y[:-1].tobytes())[0] - y[-1],
            "jac": lambda y: np.hstack([slopes(y[:-1].tobytes())[0], -np.repeat(ones, len(evaluated(y[:-1].tobytes())[0]), 0)]),
        }
        found = minimize(
            lambda y: -y[-1],
            np.append(x, evaluated(x.tobytes())[0].min()),
            jac=lambda y: -np.eye(len(y))[-1],
            bounds=np.vstack([family.limits, [_UNSTABLE, _SPARE]]),
            constraints=within,
            method="SLSQP",
            options={"maxiter": 2 * _ITERATIONS, "ftol": _ACCURACY},
        )
        return found.x[:-1] if self._is_feasible(family.controller(found.x[:-1])) else None

    def improved(self, family: GainFamily, x: Array) -> Array | None:
        """Least displacement within the bounds, from gains near them; None if no gains within them are found."""
        best = None
        least = np.inf
        for _ in range(1 + _RESTARTS):
            found = self._improved(family, x if best is None else best)
            if found is None:
                break
            cost = self._evaluated(family.controller(found))[1]
            gained = least - cost
            if gained > 0.0:
                best = found
                least = cost
            if gained < _GAINED:
                break
        return best

    def _improved(self, family: GainFamily, x: Array) -> Array | None:
        """By sequential quadratic programming (Kraft, A software package for sequential quadratic programming, 1988)."""
        from scipy.optimize import minimize

        evaluated, slopes = self._functions(family)
        within = {"type": "ineq", "fun": lambda x: evaluated(x.tobytes())[0], "jac": lambda x: slopes(x.tobytes())[0]}
        found = minimize(
            lambda x: evaluated(x.tobytes())[1],
            x,
            jac=lambda x: slopes(x.tobytes())[1],
            bounds=family.limits,
            constraints=within,
            method="SLSQP",
            options={"maxiter": _ITERATIONS, "ftol": _ACCURACY},
        )
        return self._restored(family, found.x)

    def _functions(
        self, family: GainFamily
    ) -> tuple[Callable[[bytes], tuple[Array, float]], Callable[[bytes], tuple[Array, Array]]]:
        """`_evaluated` and `_slopes` of the bytes of x, each of which keeps its last result."""
        evaluated = lru_cache(1)(lambda key: self._evaluated(family.controller(np.frombuffer(key))))
        slopes = lru_cache(1)(lambda key: self._slopes(family, np.frombuffer(key), *evaluated(key)))
        return evaluated, slopes

    def _restored(self, family: GainFamily, x: Array) -> Array | None:
        """The gains, or the nearest ones within the bounds on the way to where a design begins; None if there are none."""
        if self._is_feasible(family.controller(x)):
            return x
        near = self._feasible(family, x)
        if near is not None:
            return near
        within = self.start(family)
        if within is None:
            return None
        for _ in range(_BISECTIONS):
            middle = 0.5 * (within + x)
            if self._is_feasible(family.controller(middle)):
                within = middle
            else:
                x = middle
        return within

    def _evaluated(self, controller: Controller) -> tuple[Array, float]:
        """What is left of the bounds, 2n of each case and one of noise; the logarithm of the displacement."""
        try:
            left = [self.bounds.left(case.margins(controller)).ravel() for case in self.cases]
            loops = [case.with_controller(controller) for case in self.cases[:_COST_CASES]]
            return np.append(np.concatenate(left), self._left_of_noise(loops[0])), self._cost(loops)
        except ModelError:  # gains so high that the torque of the impulses has no meaning
            return np.full(self._bounds_per_case * len(self.cases) + 1, _UNSTABLE), 0.0

    def _slopes(self, family: GainFamily, x: Array, left: Array, cost: float) -> tuple[Array, Array]:
        """How `left` (k, size) and the cost (size,) change with the gains; zero of bounds that are far."""
        controllers = [family.controller(x + step) for step in _DIFFERENCE * np.eye(family.size)]
        slopes = np.zeros((len(left), family.size))
        cost_loops = []
        for k, case in enumerate(self.cases):
            rows = slice(k * self._bounds_per_case, (k + 1) * self._bounds_per_case)
            if k >= _COST_CASES and left[rows].min() > _ACTIVE:
                continue
            loops = [case.with_controller(each) for each in controllers]
            near = coarse_margins_around(case.transfer, case.with_controller(family.controller(x)), loops)
            slopes[rows] = np.array([self.bounds.left(each).ravel() - left[rows] for each in near]).T
            cost_loops += [loops] if k < _COST_CASES else []
        slopes[-1] = [self._left_of_noise(loop) - left[-1] for loop in cost_loops[0]]
        changes = np.array([self._cost(loops) - cost for loops in zip(*cost_loops, strict=True)])
        return slopes / _DIFFERENCE, changes / _DIFFERENCE

    def _left_of_noise(self, loop: Loop) -> float:
        if not np.isfinite(self.bounds.chatter):
            return 1.0
        return float(np.clip(np.log(self.bounds.chatter / (self.bounds.reserve * torque_noise(loop))), _UNSTABLE, 1.0))

    def _cost(self, loops: Sequence[Loop]) -> float:
        """The logarithm of the displacement of the joints by torques in proportion to the limits."""
        shares = [loop.joint_compliance(_GOAL_FREQUENCIES) * self._arm.limits.tau_max for loop in loops]
        return 0.5 * float(np.log(np.mean(np.abs(shares) ** 2)))

    def violated(self, controller: Controller) -> str:
        """The bound that a controller violates most, or nothing."""
        left, _ = self._evaluated(controller)
        if left.min() >= -_BOUND_TOLERANCE:
            return ""
        k = int(left.argmin())
        return "chatter" if k == len(left) - 1 else ("delay margin", "peak sensitivity")[k // self._arm.n % 2]

    def active(self, family: GainFamily, x: Array) -> tuple[str, ...]:
        found = []
        for indices in map(list, family.joints):
            raised = x.copy()
            raised[indices] += np.log(_RAISE) * family.scaling[indices]
            found.append(self.violated(family.controller(raised)) or "none")
        return tuple(found)

    def _is_feasible(self, controller: Controller) -> bool:
        return bool(self._evaluated(controller)[0].min() >= -_BOUND_TOLERANCE)


class _Judge:
    """Examines controllers at configurations that the design does not know, unless they are given."""

    def __init__(
        self,
        linearizers: Sequence[Linearizer],
        configurations: int | ArrayLike,
        design_configurations: int,
        bounds: _Bounds,
        default: Controller,
    ):
        arm = linearizers[0].arm
        self.linearizers = linearizers
        self._bounds = bounds
        given = judged_configurations(arm, configurations)
        sampled = np.vstack([arm.limits.clamp(arm.home), sample_configurations(arm)[-design_configurations:]])
        self._has_searches = not np.ndim(configurations)
        self.design = _Design(arm, _cases(linearizers, sampled if self._has_searches else given), bounds)
        self._cases = _cases(linearizers, given)
        self._given = len(self._cases)  # how many of the cases are judged; searches may begin at the others, too
        if self._has_searches:
            self._cases += _cases(linearizers, search_starts(arm, self._cases[0].with_controller(default)))
        self.before = self.figures([loop for _, loop in self._judged(default, *self._known(default))])

    def violating(self, controller: Controller) -> tuple[list[_Case], list[Loop]]:
        """The worst cases that violate a bound, and all loops that were judged. They are searched for if no known one does."""
        known, found = self._known(controller)
        left = [float(self._bounds.left(each).min()) for each in found]
        worst = [self._cases[i] for i in np.argsort(left)[:_ADDED] if left[i] < -_BOUND_TOLERANCE]
        if worst and self._has_searches:
            return worst, []
        judged = self._judged(controller, known, found)
        loops = [loop for _, loop in judged]
        coarse = found[: self._given] + [loop.coarse_margins() for loop in loops[self._given :]]
        violating = compress(judged, self._bounds.violated_by(loops, coarse))
        return [_Case(linearizer, loop, coarse_plant(loop)) for linearizer, loop in violating], loops

    def _known(self, controller: Controller) -> tuple[list[Loop], list[CoarseMargins]]:
        """The loops of the known configurations, and their margins."""
        loops = [case.with_controller(controller) for case in self._cases]
        return loops, [coarse_margins_with(case.transfer, loop) for case, loop in zip(self._cases, loops, strict=True)]

    def _judged(self, controller: Controller, known: list[Loop], found: list[CoarseMargins]) -> list[tuple[Linearizer, Loop]]:
        """As `judged_loops`, from the loops of the known configurations, and with their linearizers."""
        linearizers = [case.linearizer for case in self._cases]
        judged = list(zip(linearizers, known, strict=True))[: self._given]
        if self._has_searches:
            judged += worst_loops(linearizers, controller, known, found)
        return judged

    def figures(self, loops: Sequence[Loop]) -> LoopFigures:
        found = [loop.robustness() for loop in loops]
        vibration = min(loop.least_damped() for loop in loops)
        return LoopFigures(
            delay_margin=min(each.delay_margin for each in found),
            peak_sensitivity=max(each.peak_sensitivity for each in found),
            chatter=torque_noise(loops[0]),
            compliance=max(float(loop.compliance([_COMPLIANCE_FREQUENCY])[0]) for loop in loops),
            damping_ratio=vibration.damping_ratio,
            frequency=vibration.frequency,
        )


def torque_noise(loop: Loop) -> float:
    """N m (N), the chatter at rest with an encoder of 1e-5 rad."""
    return float(np.sqrt(np.mean(loop.chatter(ENCODER_NOISE_RAD) ** 2)))
