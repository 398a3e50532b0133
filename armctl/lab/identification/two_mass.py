"""TwoMass: a motor and a link with a spring between them, fitted to the frequency response of a joint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.result import Verdict
from armctl.core.validation import Array, instance
from armctl.lab.identification.multisine import joint_index
from armctl.lab.loops.linearization import linear_arm
from armctl.lab.loops.state_space import ComplexArray, StateSpace
from armctl.model.arm.arm import Arm, check_arm
from armctl.run.sim.plant import Plant, read_plant

_SIDES = ("motor", "link")
_MODEL_ERROR = 0.02  # of the magnitude: other joints and gravity are no part of two masses
_STARTS = 80  # antiresonances from which a fit begins
_INERTIA_RATIOS = (0.1, 0.3, 1.0, 5.0)  # of link and motor, there
_DAMPING_RATIO = 0.03
_FITS = 5
_MIN_IMPROVEMENT = 4.0  # a spring shows if the errors without one are so many times larger
_MIN_LOW_LINES = 5
_SAME_RESONANCE = 0.1  # relative difference of two resonances of one vibration


class MeasuredResponse(Protocol):
    """What a fit needs of a `FrequencyResponse`, with its names."""

    @property
    def joint(self) -> str: ...
    @property
    def of(self) -> str: ...
    @property
    def frequency(self) -> Array: ...
    @property
    def measured(self) -> ComplexArray: ...
    @property
    def bound(self) -> Array: ...


@dataclass(frozen=True, slots=True, eq=False)
class TwoMass(Verdict):
    """Two masses fitted to the response of a joint. True if the response shows a spring.

    Attributes:
        ok: Whether two masses explain the response much better than one, and the resonance is within its frequencies.
        side: "motor" or "link": where the positions were measured, by the better fit.
        resonance: rad/s, at which motor and link vibrate against each other; NaN if not ok, as what follows from springs.
        resonance_error: rad/s, standard error.
        antiresonance: rad/s, at which the link vibrates against a motor that stands still.
        damping_ratio: Of the resonance.
        stiffness: N m/rad.
        motor_inertia: kg m^2.
        link_inertia: kg m^2; without a spring, all inertia.
        viscous_friction: N m s/rad, of the motor.
        delay: s, from torque to position.
        reason: The reason if it is not ok; empty if it is.
        response: What was fitted.
    """

    ok: bool
    joint: str
    side: str
    resonance: float
    resonance_error: float
    antiresonance: float
    damping_ratio: float
    stiffness: float
    motor_inertia: float
    link_inertia: float
    viscous_friction: float
    delay: float
    reason: str
    response: MeasuredResponse = field(repr=False)

    def __str__(self) -> str:
        if not self.ok:
            return f"{self.joint}: {self.reason}"
        hertz = np.array([self.resonance, self.resonance_error, self.antiresonance]) / (2 * np.pi)
        return (
            f"{self.joint}: resonance {hertz[0]:.4g} Hz (+- {hertz[1]:.2g}), damping ratio {self.damping_ratio:.3g}, "
            f"antiresonance {hertz[2]:.4g} Hz; stiffness {self.stiffness:.4g} N m/rad, motor {self.motor_inertia:.3g} and "
            f"link {self.link_inertia:.3g} kg m^2; delay {1e3 * self.delay:.2f} ms"
        )

    @staticmethod
    def plant(arm: Arm, fits: Sequence[TwoMass], q: ArrayLike, plant: Plant | None = None) -> Plant:
        """A plant with the springs that were found, for `linearize`, `margins`, `tune` and `propose_filter`.

        A vibration shows in the responses of other joints, too. It is ascribed to the joint whose spring explains all responses
        best.

        Args:
            fits: One for each joint that was measured; joints whose response shows no spring stay rigid.
            q: (n,) rad, the configuration of the recording.
            plant: How the simulated arm differs from the model besides, such as by its delay.

        Returns:
            The plant, whose joints are measured where the fits say.

        Raises:
            InputError: A fit is of no joint of the arm, or of an arm without such springs, or sides differ.
            LimitError: A position outside the limits.
        """
        check_arm(arm)
        q = arm.checked("q", q)
        given = read_plant(plant)
        for fit in fits:
            instance("fits", fit, TwoMass, "FrequencyResponse.two_mass() gives one")
            joint_index(arm.joint_names, fit.joint)
        shown = [fit for fit in fits if fit]
        if len({fit.side for fit in shown}) > 1:
            raise InputError(
                "fits: some joints are measured at the motor and some at the link; a plant has encoders on one side"
            )
        chosen: list[TwoMass] = []
        for fit in shown:
            alike = [each for each in shown if abs(np.log(fit.resonance / each.resonance)) < _SAME_RESONANCE]
            if fit is alike[0]:
                chosen.append(min(alike, key=lambda each: _misfit(arm, fits, q, _with_springs(arm, [each], given))))
        return _with_springs(arm, chosen, given)


def _with_springs(arm: Arm, fits: Sequence[TwoMass], plant: Plant) -> Plant:
    if not fits:
        return plant
    stiffness = np.zeros(arm.n)
    rotors = np.zeros(arm.n)
    for fit in fits:
        stiffness[arm.joint_names.index(fit.joint)] = fit.stiffness
        rotors[arm.joint_names.index(fit.joint)] = fit.motor_inertia
    damping = float(np.mean([fit.damping_ratio for fit in fits]))
    of_springs: dict[str, Any] = {"elasticity": stiffness, "rotor_inertia": rotors, "elastic_damping": damping}
    return replace(plant, **of_springs, encoder_side=fits[0].side)


def _misfit(arm: Arm, fits: Sequence[TwoMass], q: Array, plant: Plant) -> float:
    """How much the responses of a plant differ from the measured ones, in magnitude: delays have no effect."""
    linear = linear_arm(arm, q, plant)
    system = StateSpace(A=linear.A, B=linear.B, C=linear.C[: arm.n], D=np.zeros((arm.n, arm.n)))
    total = 0.0
    for fit in fits:
        joint = arm.joint_names.index(fit.joint)
        response = fit.response
        predicted = system.transfer(np.exp(1j * response.frequency * linear.dt))[:, joint, joint]
        total += float(np.abs(np.log(np.abs(response.measured / predicted))).mean())
    return total


def fit_two_mass(response: MeasuredResponse) -> TwoMass:
    if response.of != "plant":
        raise InputError(f"two_mass: it is the {response.of} of {response.joint}; give of='plant' to from_log")
    fit = _TwoMassFit(response)
    rigid_cost, rigid = fit.best("rigid")
    cost, z, side = min((*fit.best(side), side) for side in _SIDES) if fit.lines > 2 * len(rigid) else (np.inf, rigid, "motor")
    motor, link, stiffness, damping, viscous = np.exp(z[:5])
    mobility = 1 / motor + 1 / link
    resonance = float(np.sqrt(stiffness * mobility))
    reason = ""
    if not cost * _MIN_IMPROVEMENT < rigid_cost:
        reason = "the response shows no spring: one mass explains it as well as two"
    elif not fit.w[0] < resonance < fit.w[-1]:
        reason = f"its resonance, {resonance / (2 * np.pi):.3g} Hz, is outside the measured frequencies"
    if reason:
        nan = float("nan")
        inertia, viscous = np.exp(rigid[[1, 4]])
        delay = float(rigid[6] / fit.w[-1])
        return TwoMass(
            ok=False,
            joint=response.joint,
            side=side,
            resonance=nan,
            resonance_error=nan,
            antiresonance=nan,
            damping_ratio=nan,
            stiffness=nan,
            motor_inertia=nan,
            link_inertia=float(inertia),
            viscous_friction=float(viscous),
            delay=delay,
            reason=reason,
            response=response,
        )
    return TwoMass(
        ok=True,
        joint=response.joint,
        side=side,
        resonance=resonance,
        resonance_error=fit.resonance_error(z, side),
        antiresonance=float(np.sqrt(stiffness / link)),
        damping_ratio=float(0.5 * damping * np.sqrt(mobility / stiffness)),
        stiffness=float(stiffness),
        motor_inertia=float(motor),
        link_inertia=float(link),
        viscous_friction=float(viscous),
        delay=float(z[6] / fit.w[-1]),
        reason="",
        response=response,
    )


class _TwoMassFit:
    """Fits z to a response: logarithms of motor inertia, link inertia, stiffness, damping of the spring and viscous friction;
    the stiffness of gravity as a share of what moves the link at the lowest frequency; and the phase lag at the highest one."""

    def __init__(self, response: MeasuredResponse):
        self.w = response.frequency
        self.lines = len(self.w)
        self.measured = response.measured
        self.weight = 1 / np.hypot(response.bound, _MODEL_ERROR * np.abs(self.measured))
        low = slice(0, max(_MIN_LOW_LINES, self.lines // 4))
        self.inertia = float(np.median(1 / (np.abs(self.measured[low]) * self.w[low] ** 2)))

    def model(self, z: Array, side: str) -> ComplexArray:
        """The response of two masses, or of one, whose inertia is that of the link."""
        s = 1j * self.w
        motor, link, stiffness, damping, viscous = np.exp(z[:5])
        lag = np.exp(-1j * z[6] * self.w / self.w[-1])
        load = link * s**2 + z[5] * link * self.w[0] ** 2
        if side == "rigid":
            return lag / (load + viscous * s)
        spring = stiffness + damping * s
        drive = motor * s**2 + viscous * s
        moved = load + spring if side == "motor" else spring
        return lag * moved / (drive * load + spring * (drive + load))

    def residual(self, z: Array, side: str) -> Array:
        difference = self.weight * (self.model(z, side) - self.measured)
        return np.concatenate([difference.real, difference.imag])

    def best(self, side: str) -> tuple[float, Array]:
        """The sum of squares and z of the best fit from several starts."""
        from scipy.optimize import least_squares

        solve: Any = least_squares
        friction = np.log(0.1 * self.inertia * self.w[0])
        starts = [np.array([0.0, np.log(self.inertia), 0.0, 0.0, friction, 0.0, 0.0])]
        if side != "rigid":
            starts = []
            frequencies = np.geomspace(self.w[1], self.w[-2], _STARTS)
            for antiresonance, ratio in product(frequencies, _INERTIA_RATIOS):
                motor = self.inertia / (1 + ratio)
                link = self.inertia - motor
                stiffness = link * antiresonance**2
                damping = 2 * _DAMPING_RATIO * np.sqrt(stiffness * motor * link / self.inertia)
                logs = np.log([motor, link, stiffness, damping])
                starts.append(np.array([*logs, friction, 0.0, 0.0]))
            starts = sorted(starts, key=lambda z: float((self.residual(z, side) ** 2).sum()))[:_FITS]
        with np.errstate(all="ignore"):  # a step may go too far; it is then taken back
            fits = [solve(self.residual, z, args=(side,), x_scale="jac", max_nfev=200) for z in starts]
        best = min(fits, key=lambda fit: fit.cost)
        return float(best.cost), best.x

    def resonance_error(self, z: Array, side: str) -> float:
        """The standard error of the resonance, by the linearized fit."""
        step = 1e-6
        columns = [(self.residual(z + step * e, side) - self.residual(z - step * e, side)) / (2 * step) for e in np.eye(len(z))]
        jacobian = np.array(columns).T
        variance = (self.residual(z, side) ** 2).sum() / (2 * self.lines - len(z))
        covariance = variance * np.linalg.pinv(jacobian.T @ jacobian)
        motor, link, stiffness = np.exp(z[:3])
        mobility = 1 / motor + 1 / link
        slope = 0.5 * np.array([-1 / (motor * mobility), -1 / (link * mobility), 1.0])
        return float(np.sqrt(stiffness * mobility) * np.sqrt(slope @ covariance[:3, :3] @ slope))
