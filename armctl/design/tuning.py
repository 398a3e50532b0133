"""Tuning: the stiffest loop of a control law within bounds on delay margin, peak sensitivity and torque noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from armctl.control import CONTROLLERS, controller_by_name
from armctl.control.gains import DEFAULT_BANDWIDTH, margin_gains, sample_configurations
from armctl.control.impedance import IMPEDANCE_BANDWIDTH
from armctl.control.interface import Controller
from armctl.control.lqr import LQR
from armctl.control.observer_gains import observer_gains
from armctl.control.pd import PD
from armctl.core.errors import InputError, ModelError, UnknownNameError
from armctl.core.result import Verdict
from armctl.core.validation import Array, IntArray, frozen, number, shown
from armctl.design.linearization import Linearizer
from armctl.design.loop import MIN_DAMPING_RATIO, Loop, Mode, coarse_margins_with, coarse_plant
from armctl.design.margins import configurations, judged_loops
from armctl.design.stability import CoarseMargins
from armctl.design.state_space import ComplexArray, linear_controller
from armctl.robot.arm import Arm, check_arm
from armctl.sim.plant import ENCODER_NOISE_RAD, NOMINAL, Plant, read_plant

_COMPLIANCE_FREQUENCY = 2 * np.pi  # rad/s
# Configurations of the design, of those for default gains: the extreme ones, and random ones for laws without inertia matrix.
_DESIGN_POSES = 10
_DESIGN_POSES_WITH_MODEL = 2
# Of the bounds, in the design, whose margins are accurate to the first of them. The others follow where configurations that the
# design did not know violated a bound.
_RESERVES = (1.003, 1.015, 1.04, 1.08, 1.15)
_SCALES = (1.0, 1.4, 0.7, 2.0, 0.5, 2.8, 0.35, 4.0, 0.25, 8.0, 0.125, 16.0, 0.0625)  # of all gains, where a design may begin
_BISECTIONS = 6  # to come back within the bounds
_DAMPING_RATIOS = (0.5, 2.0)  # of laws with a model: their errors shall not oscillate
_RATIOS = (1.0, 0.5, 0.25, 0.1)  # of the stiffness of PD and of the observer's bandwidth, there
# Sequential linear programming. Steps are those of the logarithms of the gains.
_ITERATIONS = 6
_FURTHER_ITERATIONS = 3  # of a design that is repeated
_FIRST_STEP = 0.3
_MAX_STEP = 1.0
_MIN_STEP = 0.01
_MIN_GAIN = 0.005  # of the logarithm of the displacement; a step that gains less is the last one
_DIFFERENCE = 1e-3
_TRIES = 3
_ACTIVE = 0.25  # constraints with less than this left are linearized
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
    delay_margin: float = 5e-3,
    peak_sensitivity: float = 1.7,
    chatter: float | None = None,
    poses: int | ArrayLike = 20,
    plants: Sequence[Plant] = (),
) -> Tuning:
    """Finds the gains of a control law that yield least to disturbances while the loop satisfies bounds everywhere.

    What is minimal is the root mean square of the displacements of the joints at 1 Hz, by disturbance torques in proportion to
    the torque limits. All gains of the law are free: stiffness and damping of each joint of PD; bandwidth, damping
    ratio and the observer's bandwidth of laws with a model; bandwidths and integral time of LQR. Sequential linear programming
    finds them for configurations of the design. They are then judged like in `margins`, with its search for the worst
    configuration. Each configuration that violates a bound becomes one of the design, which is repeated.

    Args:
        law: The name of a controller whose gains can be tuned: all but "computed-torque-textbook".
        delay_margin: s, the smallest permitted one.
        peak_sensitivity: The largest permitted Ms, above 1.
        chatter: N m (N), the largest permitted torque noise at rest with an encoder of 1e-5 rad; None for no bound.
        poses: Number of configurations at which the result is judged: home and random ones, always the same; or the
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
    if not isinstance(law, str) or law not in LAWS:
        raise UnknownNameError.of("law", law, LAWS)
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
    design_poses = _DESIGN_POSES if law in _PD_LAWS else _DESIGN_POSES_WITH_MODEL
    judge = _Judge([Linearizer(arm, plant) for plant in checked], poses, design_poses, bounds)
    family = _family(arm, law, periods.pop())
    default = controller_by_name(law, arm)
    before = judge.figures(default, judge.loops(default))
    x = None
    loops: list[Loop] = []
    worst: list[Loop] = []
    for reserve in _RESERVES:
        judge.design.reserve = reserve
        x = judge.design.start(family) if x is None else judge.design.restored(family, x)
        if x is None:
            break
        x = judge.design.improved(family, x, _FURTHER_ITERATIONS if worst else _ITERATIONS)
        loops = judge.loops(family.controller(x))
        worst = judge.violating(loops)
        if not worst:
            break
        judge.design.add(worst)
    if x is None or worst:
        reason = f"no gains of {law} satisfy delay margin {1e3 * bounds.delay_margin:g} ms and Ms {bounds.peak_sensitivity:g}"
        reason += "" if chatter is None else f" and torque noise {chatter:g} N m"
        if any(linearizer.is_elastic for linearizer in judge.linearizers):
            reason += " on elastic joints, which it takes as rigid (ElasticFeedforward knows the springs)"
        reason += f" on {arm.name:.80}, among {min(_SCALES):g} to {max(_SCALES):g} times the default ones"
        return Tuning(False, default, (), {}, before, before, reason)
    tuned = family.controller(x)
    return Tuning(True, tuned, judge.design.active(family, x), family.gains(x), before, judge.figures(tuned, loops), "")


@dataclass(frozen=True, slots=True, eq=False)
class _Bounds:
    delay_margin: float
    peak_sensitivity: float
    chatter: float

    def left(self, found: CoarseMargins, reserve: float) -> Array:
        """(2, n) what is left of the bounds on delay margin and Ms; -inf where the loop is unstable."""
        with np.errstate(divide="ignore"):
            delay = np.log(found.delay / (reserve * self.delay_margin))
            sensitivity = np.log(self.peak_sensitivity / (reserve * found.peak_sensitivity))
        return np.array([np.minimum(delay, 1.0), sensitivity])


@dataclass(frozen=True, slots=True, eq=False)
class _Family:
    """The gains of a law as a function of x, the logarithms of factors on its default gains."""

    size: int  # of x
    joints: tuple[tuple[int, ...], ...]  # the elements of x that belong to each joint, or to all joints together
    limits: Array  # (size, 2) bounds of x
    softened: range  # the elements of x that may be smaller in a design's start
    scaling: Array  # (size,) how all gains grow with the bandwidth: x for a factor f on it is log(f) x scaling
    gains: Callable[[Array], dict[str, float | Array]]  # the arguments of the constructor at x
    make: Callable[..., Controller]

    def controller(self, x: Array) -> Controller:
        return self.make(**self.gains(x))


_PD_LAWS = ("pd", "pd-feedforward", "pd-gravity")
_BANDWIDTH_LAWS = {
    "computed-torque": DEFAULT_BANDWIDTH,
    "operational-space": DEFAULT_BANDWIDTH,
    "impedance": IMPEDANCE_BANDWIDTH,
    "qp": DEFAULT_BANDWIDTH,
    "mpc": DEFAULT_BANDWIDTH,
}
_OBSERVER_LAWS = ("computed-torque-observer", "computed-torque-learning")
LAWS = (*_PD_LAWS, *_BANDWIDTH_LAWS, *_OBSERVER_LAWS, "lqr")


def _family(arm: Arm, law: str, dt: float) -> _Family:
    make: Callable[..., Controller] = CONTROLLERS[law]
    if law in _PD_LAWS:
        default = margin_gains(arm, dt)
        n = arm.n

        def pd(x: Array) -> dict[str, float | Array]:
            return {
                "stiffness": frozen(default.stiffness * np.exp(x[:n])),
                "damping": frozen(default.damping * np.exp(x[n:])),
            }

        joints = tuple((i, n + i) for i in range(n))
        free = np.tile([-np.inf, np.inf], (2 * n, 1))
        return _Family(2 * n, joints, free, range(n), np.repeat([2.0, 1.0], n), pd, lambda **gains: make(arm, **gains))
    if law in _OBSERVER_LAWS:
        of_margins = observer_gains(arm, dt)

        def observed(x: Array) -> dict[str, float | Array]:
            return {
                "bandwidth": of_margins.feedback * float(np.exp(x[0])),
                "damping_ratio": of_margins.damping_ratio * float(np.exp(x[1])),
                "observer_bandwidth": of_margins.disturbance * float(np.exp(x[2])),
            }

        limits = np.array([[-np.inf, np.inf], np.log(_DAMPING_RATIOS) - np.log(of_margins.damping_ratio), [-np.inf, np.inf]])
        return _Family(
            3, ((0, 1, 2),), limits, range(2, 3), np.array([1.0, 0.0, 1.0]), observed, lambda **gains: make(arm, **gains)
        )
    if law == "lqr":
        default_lqr = LQR(arm).effective_gains(dt)

        def quadratic(x: Array) -> dict[str, float | Array]:
            return {name: default_lqr[name] * float(np.exp(each)) for name, each in zip(default_lqr, x, strict=True)}

        free = np.tile([-np.inf, np.inf], (3, 1))
        return _Family(3, ((0, 1, 2),), free, range(0), np.array([1, 1, -1]), quadratic, lambda **gains: LQR(arm, **gains))
    bandwidth = _BANDWIDTH_LAWS[law]

    def with_bandwidth(x: Array) -> dict[str, float | Array]:
        return {"bandwidth": bandwidth * float(np.exp(x[0])), "damping_ratio": float(np.exp(x[1]))}

    limits = np.array([[-np.inf, np.inf], np.log(_DAMPING_RATIOS)])
    return _Family(2, ((0, 1),), limits, range(0), np.array([1.0, 0.0]), with_bandwidth, lambda **gains: make(arm, **gains))


@dataclass(frozen=True, slots=True, eq=False)
class _Case:
    linearizer: Linearizer
    loop: Loop
    transfer: ComplexArray

    def with_controller(self, controller: Controller) -> Loop:
        linearizer = self.linearizer
        law = linear_controller(linearizer.arm, controller, self.loop.q, self.loop.dt, linearizer.plant.continuous)
        return self.loop.with_law(law)

    def margins(self, controller: Controller, decisive: IntArray | None = None) -> CoarseMargins:
        return coarse_margins_with(self.transfer, self.with_controller(controller), decisive)


class _Design:
    def __init__(self, linearizers: Sequence[Linearizer], configurations: Array, bounds: _Bounds):
        self._arm = linearizers[0].arm
        self._linearizers = {str(linearizer.plant): linearizer for linearizer in linearizers}
        self._bounds = bounds
        self._bounds_per_case = 2 * self._arm.n
        self.reserve = _RESERVES[0]
        static = PD(self._arm, stiffness=0.0, damping=0.0)
        self._cases: list[_Case] = []
        self.add([linearizer.loop_at(static, q) for linearizer in linearizers for q in configurations])

    def add(self, loops: Sequence[Loop]) -> None:
        self._cases += [_Case(self._linearizers[loop.plant], loop, coarse_plant(loop)) for loop in loops]

    def start(self, family: _Family) -> Array | None:
        """Gains within the bounds, near the default ones; None if there are none among multiples of those."""
        for scale, ratio in product(_SCALES, _RATIOS):
            x = np.log(scale) * family.scaling
            x[list(family.softened)] += np.log(ratio)
            if self._is_feasible(family.controller(x)):
                return x
        return None

    def restored(self, family: _Family, x: Array) -> Array | None:
        """The gains, or the nearest ones within the bounds on the way to where a design begins; None if there are none."""
        if self._is_feasible(family.controller(x)):
            return x
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

    def improved(self, family: _Family, x: Array, iterations: int) -> Array:
        """Least displacement by sequential linear programming: Nocedal and Wright, Numerical Optimization, 2006, 18.5, 17.2."""
        from scipy.optimize import linprog

        size = _FIRST_STEP
        left, cost = self._evaluated(family.controller(x))
        for _ in range(iterations):
            active = np.flatnonzero(left < _ACTIVE + size)
            cases = sorted({int(k) // self._bounds_per_case for k in active if k < len(left) - 1})
            steps = _DIFFERENCE * np.eye(family.size)
            controller = family.controller(x)
            decisive = {k: self._cases[k].margins(controller).decisive for k in cases}
            changes = [self._evaluated(family.controller(x + step), decisive) for step in steps]
            slope = np.array([(each[1] - cost) / _DIFFERENCE for each in changes])
            slopes = np.array([(each[0] - left)[active] / _DIFFERENCE for each in changes]).T
            is_usable = np.isfinite(slopes).all(axis=1)
            rows = -slopes[is_usable]
            while size >= _MIN_STEP:
                box = np.clip(family.limits - x[:, None], -size, size)
                box[:, 0] = np.minimum(box[:, 0], 0.0)  # default gains may be outside the limits
                box[:, 1] = np.maximum(box[:, 1], 0.0)
                ends = left[active][is_usable]
                step = np.zeros(family.size)
                new_left = left
                new_cost = cost
                # The bounds are curved: further tries keep away from those that the first one violated.
                for _ in range(_TRIES):
                    found = linprog(slope, A_ub=rows, b_ub=ends, bounds=box)
                    if found.x is None:
                        break
                    step = found.x
                    new_left, new_cost = self._evaluated(family.controller(x + step))
                    if new_left.min() >= 0.0 or np.isneginf(new_left.min()):
                        break
                    ends = new_left[active][is_usable] + rows @ step - 1e-3
                if new_left.min() >= 0.0 and new_cost < cost - 1e-4:
                    break
                size *= 0.4
            else:
                return x
            x = x + step
            is_last = new_cost > cost - _MIN_GAIN
            left = new_left
            cost = new_cost
            size = min(2.0 * size, _MAX_STEP)
            if is_last:
                break
        return x

    def _evaluated(self, controller: Controller, decisive: Mapping[int, IntArray] | None = None) -> tuple[Array, float]:
        """What is left of the bounds, 2n of each case (NaN if not `decisive`) and one of noise; the log of displacement."""
        size = self._bounds_per_case
        left = np.full(size * len(self._cases) + 1, np.inf if decisive is None else np.nan)
        cost = []
        try:
            for k in range(len(self._cases)) if decisive is None else decisive:
                found = self._cases[k].margins(controller, None if decisive is None else decisive[k])
                left[size * k : size * (k + 1)] = self._bounds.left(found, self.reserve).ravel()
            for case in self._cases[:_COST_CASES]:
                compliance = case.with_controller(controller).joint_compliance([_COMPLIANCE_FREQUENCY])[0]
                cost.append(np.abs(compliance * self._arm.limits.tau_max) ** 2)
            if np.isfinite(self._bounds.chatter):
                noise = torque_noise(self._cases[0].with_controller(controller))
                left[-1] = np.log(self._bounds.chatter / (self.reserve * noise))
        except ModelError:  # gains so high that the torque of the impulses has no meaning
            return np.full_like(left, -np.inf), np.inf
        return left, 0.5 * float(np.log(np.mean(cost)))

    def violated(self, controller: Controller) -> str:
        """The bound that a controller violates most, or nothing."""
        left, _ = self._evaluated(controller)
        if left.min() >= 0.0:
            return ""
        k = int(left.argmin())
        return "chatter" if k == len(left) - 1 else ("delay margin", "peak sensitivity")[k // self._arm.n % 2]

    def active(self, family: _Family, x: Array) -> tuple[str, ...]:
        found = []
        for indices in map(list, family.joints):
            raised = x.copy()
            raised[indices] += np.log(_RAISE) * family.scaling[indices]
            found.append(self.violated(family.controller(raised)) or "none")
        return tuple(found)

    def _is_feasible(self, controller: Controller) -> bool:
        return bool(self._evaluated(controller)[0].min() >= 0.0)


class _Judge:
    """Examines controllers at configurations that the design does not know, unless they are given."""

    def __init__(self, linearizers: Sequence[Linearizer], poses: int | ArrayLike, design_poses: int, bounds: _Bounds):
        arm = linearizers[0].arm
        self.linearizers = linearizers
        self._poses = poses
        self._bounds = bounds
        given = configurations(arm, poses)
        sampled = np.vstack([arm.limits.clamp(arm.home), sample_configurations(arm)[-design_poses:]])
        self.design = _Design(linearizers, given if np.ndim(poses) else sampled, bounds)

    def loops(self, controller: Controller) -> list[Loop]:
        return judged_loops(self.linearizers, controller, self._poses)

    def violating(self, loops: Sequence[Loop]) -> list[Loop]:
        delay = self._bounds.delay_margin
        peak = self._bounds.peak_sensitivity
        found = [(loop, loop.robustness()) for loop in loops]
        return [loop for loop, each in found if not (each.delay_margin >= delay and each.peak_sensitivity <= peak)]

    def figures(self, controller: Controller, loops: Sequence[Loop]) -> LoopFigures:
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
