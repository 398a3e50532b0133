"""Tuning: the highest gains of a control law within bounds on delay margin, peak sensitivity and torque noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from armctl.control import (
    PD,
    ComputedTorque,
    ComputedTorqueLearning,
    ComputedTorqueObserver,
    ComputedTorqueQP,
    Controller,
    Impedance,
    OperationalSpace,
    PDFeedforward,
    PDGravity,
    PIDGravity,
    controller_by_name,
)
from armctl.control.computed_torque import DEFAULT_DELAY_MARGIN_S
from armctl.control.gains import margin_gains
from armctl.control.integral_gains import MIN_DELAY_MARGIN_TICKS
from armctl.control.observer_gains import observer_gains
from armctl.core.errors import InputError, ModelError, UnknownNameError
from armctl.core.validation import Array, frozen, number, shown
from armctl.design.frequency_response import standstill
from armctl.design.linearization import loop_at
from armctl.design.loop import Loop
from armctl.design.margins import configurations
from armctl.design.state_space import linear_controller
from armctl.robot.arm import Arm, check_arm
from armctl.sim.plant import NOMINAL, Plant, read_plant
from armctl.sim.simulate import simulate

_ENCODER_NOISE_RAD = 1e-5  # of the torque noise that the bound is about
_NOISE_SECONDS = 0.3
_COMPLIANCE_FREQUENCY = 2 * np.pi  # rad/s
_MIN_SCALE = 1 / 16
_MAX_SCALE = 16.0
_BISECTIONS = 4
_JOINT_STEPS = (1.6, 1.25)  # factors tried on the gains of one joint


@dataclass(frozen=True, slots=True, eq=False)
class LoopFigures:
    """What a controller achieves: the worst values of all configurations and plants.

    Attributes:
        delay_margin: s.
        peak_sensitivity: Ms.
        chatter: N m (N), torque noise at rest with an encoder of 1e-5 rad that velocities are differenced from.
        compliance: m/N, of the tip at 1 Hz in the worst direction: the error that slow unknown forces and payloads cause.
    """

    delay_margin: float
    peak_sensitivity: float
    chatter: float
    compliance: float

    def __str__(self) -> str:
        return (
            f"delay margin {1e3 * self.delay_margin:.3g} ms, Ms {self.peak_sensitivity:.3g}, "
            f"torque noise {self.chatter:.2g} N m, compliance at 1 Hz {1e6 * self.compliance:.3g} um/N"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Tuning:
    """A tuned controller and what limits it. True if it satisfies the bounds.

    Attributes:
        ok: Whether gains within the bounds were found.
        controller: The controller with the highest gains that were found; the default one if not ok.
        active: The bound that the next higher gain of each joint violates: "delay margin", "peak sensitivity", "chatter" or
            "none"; one for all joints where they have a common gain.
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

    def __bool__(self) -> bool:
        return self.ok

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
        figures = {
            name: {field: getattr(each, field) for field in ("delay_margin", "peak_sensitivity", "chatter", "compliance")}
            for name, each in (("before", self.before), ("after", self.after))
        }
        gains = {name: np.asarray(value).tolist() for name, value in self.gains.items()}
        return {"ok": self.ok, "reason": self.reason, "active": list(self.active), "gains": gains, **figures}


def tune(
    arm: Arm,
    law: str,
    delay_margin: float = 5e-3,
    peak_sensitivity: float = 1.7,
    chatter: float | None = None,
    poses: int | ArrayLike = 20,
    plants: Sequence[Plant] = (),
) -> Tuning:
    """Finds the highest gains of a control law whose loop satisfies bounds at all configurations and on all plants.

    First all gains change together, then those of single joints (PD and PID). Damping is proportional to the scale of a joint,
    stiffness to its square, an integral gain to its cube.

    Args:
        law: The name of a controller whose gains can be tuned: all but "computed-torque-textbook".
        delay_margin: s, the smallest permitted one.
        peak_sensitivity: The largest permitted Ms, above 1.
        chatter: N m (N), the largest permitted torque noise at rest with an encoder of 1e-5 rad; None for no bound.
        poses: Number of configurations: home and random ones, always the same; or the configurations themselves, (k, n) rad.
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
    family = _family(arm, law, periods.pop())
    judge = _Judge(arm, checked, configurations(arm, poses), bounds)
    default = controller_by_name(law, arm)
    before = judge.figures(default)
    scale = _common_scale(family, judge)
    if scale is None:
        reason = f"no gains of {law} satisfy delay margin {1e3 * bounds.delay_margin:g} ms and Ms {bounds.peak_sensitivity:g}"
        reason += "" if chatter is None else f" and torque noise {chatter:g} N m"
        return Tuning(False, default, (), {}, before, before, f"{reason} on {arm.name:.80}: lower ones violate a bound, too")
    scales, active = _joint_scales(family, judge, scale)
    tuned = family.controller(scales)
    return Tuning(True, tuned, active, family.gains(scales), before, judge.figures(tuned), "")


@dataclass(frozen=True, slots=True, eq=False)
class _Bounds:
    delay_margin: float
    peak_sensitivity: float
    chatter: float


@dataclass(frozen=True, slots=True, eq=False)
class _Family:
    """The gains of a law as functions of one scale per joint, or of one scale.

    Attributes:
        scales: How many scales there are.
        gains: The arguments of the constructor at (scales,) scales.
    """

    scales: int
    gains: Callable[[Array], dict[str, float | Array]]
    make: Callable[..., Controller]

    def controller(self, scales: Array) -> Controller:
        return self.make(**self.gains(scales))


_PD_LAWS: dict[str, Callable[..., Controller]] = {
    "pd": PD,
    "pd-feedforward": PDFeedforward,
    "pd-gravity": PDGravity,
    "pid-gravity": PIDGravity,
}
_BANDWIDTH_LAWS: dict[str, Callable[..., Controller]] = {
    "computed-torque": ComputedTorque,
    "operational-space": OperationalSpace,
    "impedance": Impedance,
    "qp": ComputedTorqueQP,
}
_OBSERVER_LAWS: dict[str, Callable[..., Controller]] = {
    "computed-torque-observer": ComputedTorqueObserver,
    "computed-torque-learning": ComputedTorqueLearning,
}
LAWS = (*_PD_LAWS, *_BANDWIDTH_LAWS, *_OBSERVER_LAWS, "computed-torque-integral")


def _family(arm: Arm, law: str, dt: float) -> _Family:
    if law in _PD_LAWS:
        default = margin_gains(arm, dt, law == "pid-gravity")

        def pd(scales: Array) -> dict[str, float | Array]:
            gains: dict[str, float | Array] = {
                "stiffness": frozen(default.stiffness * scales**2),
                "damping": frozen(default.damping * scales),
            }
            if law == "pid-gravity":
                gains["integral_gain"] = frozen(default.integral_gain * scales**3)
            return gains

        return _Family(arm.n, pd, lambda **gains: _PD_LAWS[law](arm, **gains))
    if law in _OBSERVER_LAWS:
        of_margins = observer_gains(arm, dt)

        def observed(scales: Array) -> dict[str, float | Array]:
            return {
                "bandwidth": of_margins.feedback * float(scales[0]),
                "damping_ratio": of_margins.damping_ratio,
                "observer_bandwidth": of_margins.disturbance * float(scales[0]),
            }

        return _Family(1, observed, lambda **gains: _OBSERVER_LAWS[law](arm, **gains))
    if law in _BANDWIDTH_LAWS:
        bandwidth = float(getattr(controller_by_name(law, arm), "bandwidth", 40.0))
        make = _BANDWIDTH_LAWS[law]
        return _Family(1, lambda scales: {"bandwidth": bandwidth * float(scales[0])}, lambda **gains: make(arm, **gains))
    delay = max(DEFAULT_DELAY_MARGIN_S, MIN_DELAY_MARGIN_TICKS * dt)
    return _Family(
        1,
        lambda scales: {"delay_margin": delay / float(scales[0])},
        lambda **gains: ComputedTorque(arm, integral=True, **gains),
    )


class _Judge:
    """Examines controllers at the same configurations and plants; the arm is linearized once."""

    def __init__(self, arm: Arm, plants: Sequence[Plant], poses: Array, bounds: _Bounds):
        self._arm = arm
        self._plants = plants
        self._bounds = bounds
        static = PD(arm, stiffness=0.0, damping=0.0)
        self._loops = [(loop_at(arm, static, q, plant), plant) for plant in plants for q in poses]

    def violated(self, controller: Controller) -> str:
        """The first bound that a controller violates, or nothing. The loop that violated it is examined first the next time."""
        for k, (loop, plant) in enumerate(self._loops):
            found = self._violated_at(loop, plant, controller)
            if found:
                self._loops.insert(0, self._loops.pop(k))
                return found
        if np.isfinite(self._bounds.chatter) and self._chatter(controller) > self._bounds.chatter:
            return "chatter"
        return ""

    def figures(self, controller: Controller) -> LoopFigures:
        """The worst figures of a controller."""
        loops = [self._loop(loop, plant, controller) for loop, plant in self._loops]
        found = [loop.robustness() for loop in loops]
        return LoopFigures(
            delay_margin=min(each.delay_margin for each in found),
            peak_sensitivity=max(each.peak_sensitivity for each in found),
            chatter=self._chatter(controller),
            compliance=max(float(loop.compliance([_COMPLIANCE_FREQUENCY])[0]) for loop in loops),
        )

    def _violated_at(self, loop: Loop, plant: Plant, controller: Controller) -> str:
        try:
            found = self._loop(loop, plant, controller).robustness()
        except ModelError:  # gains so high that the torque of the impulses has no meaning
            return "peak sensitivity"
        if not found or found.delay_margin < self._bounds.delay_margin:
            return "delay margin"
        return "peak sensitivity" if found.peak_sensitivity > self._bounds.peak_sensitivity else ""

    def _loop(self, loop: Loop, plant: Plant, controller: Controller) -> Loop:
        return replace(loop, _law=linear_controller(self._arm, controller, loop.q, loop.dt, plant.continuous))

    def _chatter(self, controller: Controller) -> float:
        plant = replace(self._plants[0], encoder_noise=_ENCODER_NOISE_RAD, velocity_noise=None)
        home = self._arm.limits.clamp(self._arm.home)
        tau = simulate(self._arm, controller, standstill(self._arm, home, _NOISE_SECONDS), plant, dwell=0.0).tau
        tau = tau[len(tau) // 3 :]
        return float(np.sqrt(np.mean((tau[1:-1] - 0.5 * (tau[:-2] + tau[2:])) ** 2)))


def _common_scale(family: _Family, judge: _Judge) -> float | None:
    """The largest scale of all gains within the bounds; None if there is none."""
    ones = np.ones(family.scales)
    low = 1.0
    while judge.violated(family.controller(low * ones)):
        low *= 0.5
        if low < _MIN_SCALE:
            return None
    high = 2.0 * low
    while low >= 1.0 and high <= _MAX_SCALE and not judge.violated(family.controller(high * ones)):
        low = high
        high *= 2.0
    for _ in range(_BISECTIONS):
        middle = float(np.sqrt(low * high))
        if judge.violated(family.controller(middle * ones)):
            high = middle
        else:
            low = middle
    return low


def _joint_scales(family: _Family, judge: _Judge, common: float) -> tuple[Array, tuple[str, ...]]:
    """The scales after each joint was raised alone, from the base to the tip, and the bound that limits each."""
    scales = np.full(family.scales, common)
    active = [""] * family.scales
    for step in _JOINT_STEPS:
        for i in range(family.scales):
            raised = scales.copy()
            raised[i] *= step
            active[i] = judge.violated(family.controller(raised))
            if not active[i]:
                scales = raised
    return scales, tuple(each or "none" for each in active)
