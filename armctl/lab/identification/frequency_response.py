"""Frequency response of one joint, from a recording or from a simulation with a multisine, beside its prediction."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armctl.control.interface import Controller, ControllerWrapper, State, traits
from armctl.core.log import Log
from armctl.core.plotting import COLORS, AxesLayout, finish_axes
from armctl.core.result import Verdict
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, IntArray, choice, flag, instance
from armctl.lab.identification.arm_excitation import Excitation
from armctl.lab.identification.multisine import MIN_FREQUENCY_HZ, MULTISINE_LINES, MULTISINE_PERIOD_S, joint_index
from armctl.lab.identification.recorded_response import OF, bound_factor, recorded_response
from armctl.lab.identification.two_mass import TwoMass, fit_two_mass
from armctl.lab.loops.linearization import Linearizer
from armctl.lab.loops.loop import Loop
from armctl.lab.loops.state_space import ComplexArray
from armctl.model.arm.arm import Arm, check_arm
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.run.execution.move import read_controller
from armctl.run.sim.plant import Plant, read_plant
from armctl.run.sim.simulate import simulate

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes

_MEASURED_PERIODS = 6
# Periods before these, in which the transient decays to this fraction if the limit permits.
_MIN_SETTLING_PERIODS = 2
_MAX_SETTLING_PERIODS = 20
_TRANSIENT = 1e-6
_MAX_FREQUENCY_SHARE = 0.8  # of the Nyquist frequency
# Root mean square of the excitation, as a fraction of the torque limit. A small one keeps the arm in its linear range; where
# measurements have noise, it has to be larger.
_AMPLITUDE = 2e-4
_AMPLITUDE_WITH_NOISE = 0.02
# A second measurement is this many times larger. It shows dry friction, which is linear as long as it holds a joint: it is
# larger than that of the joint, too.
_LARGER = 2.0
_FRICTION_RATIO = 2.0
_MIN_COHERENCE = 0.5
_MAX_NONLINEAR_SHARE = 0.1
_SIGNIFICANT_VARIANCES = 9.0  # squares of what is smaller than three standard deviations of the noise do not count
_DETECTION_EVERY = 3  # of this many odd lines one is not excited
_PHASE_SEED = 0  # of the phases
_SIZE_INCHES = (9.0, 4.6)


@dataclass(frozen=True, slots=True, eq=False)
class FrequencyResponse(Verdict):
    """A frequency response of one joint, measured and predicted. True if the measurement can be trusted.

    Attributes:
        ok: In simulation, whether both runs were complete, no motor was saturated, the coherence is at least 0.5 and the
            nonlinear share at most 0.1 at every frequency. From a recording, whether the run was complete, no motor was
            saturated, and the coherence is at least 0.5 at most frequencies.
        frequency: (k,) rad/s.
        measured: (k,) complex.
        predicted: (k,) complex, from the linear loop; NaN without one.
        coherence: (k,) in [0, 1], the share of the measured signal that repeats with the excitation. Noise lowers it. In
            simulation dry friction does not: it distorts each period alike. In a recording it does: phases change.
        nonlinear: (k,) the part of the measured torque that no linear loop explains, relative to it: what appears at
            frequencies that are not excited, and what changes with the size of the excitation. Empty for a recording, whose
            bounds contain it.
        reason: The reason if it is not ok; empty if it is.
        of: What it is: "plant", the position (rad) per torque (N m) while the other joints are free; "closed loop", the
            position per reference; "sensitivity", the torque of the motor per disturbance torque.
        bound: (k,) the radius around `measured` in which the true response is with a probability of 95 %.
        dt: s, the interval between samples.
    """

    ok: bool
    joint: str
    frequency: Array
    measured: ComplexArray
    predicted: ComplexArray
    coherence: Array
    nonlinear: Array
    reason: str
    of: str = "sensitivity"
    bound: Array = field(default_factory=lambda: np.zeros(0))
    dt: float = 0.0

    @classmethod
    def from_log(
        cls,
        log: Log,
        motion: Excitation,
        joint: int | str,
        of: str = "plant",
        *,
        loop: Loop | None = None,
        positions: ArrayLike | None = None,
    ) -> FrequencyResponse:
        """Measures a frequency response from a recording of a multisine, whatever controller or servo moved the arm.

        All joints move at once with orthogonal phases, so the responses of all joints to all torques follow, and from them that
        of one. The motion itself is the instrument: noise in positions and torques causes no bias. Bounds follow from what
        changes between periods with different phases: noise, transients and nonlinear distortion (the robust method of
        Pintelon and Schoukens, System Identification: A Frequency Domain Approach (2012), 4.3.1). All joints drift slowly in
        measured periods, so that dry friction is constant, and what all periods share is subtracted.

        Args:
            log: A recording that begins with the motion: positions, and torques of the motors or commands, or both. The plant
                then includes the delay from command to motor.
            motion: By `excitation(arm, for_="frequency")`.
            joint: The joint's name, or its index from the base.
            of: "plant", "closed loop" or "sensitivity", as the attribute; without torques only "closed loop".
            loop: By `linearize`, for the prediction; a sensitivity needs the law in it.
            positions: (T, n) rad, measured positions, if those in the log are others: a simulation records those of links.

        Returns:
            Measurement with bounds, and prediction, up to 80 Hz or 0.4 of the Nyquist frequency.

        Raises:
            InputError: An argument is of another kind, the log is too short or has another interval, or torques are missing.
        """
        of = choice("of", of, OF)
        instance("log", log, Log, "armctl.simulate and armctl.Log.from_csv give one")
        index = joint_index(log.joint_names, joint)
        found = recorded_response(log, motion, index, of, loop, positions)
        reason = log.failure or _disturbance(log)
        coherence = float(np.median(found.coherence))
        if not reason and coherence < _MIN_COHERENCE:
            reason = f"the coherence is {coherence:.2f} (median); record a larger or longer motion"
        return cls(
            ok=not reason,
            joint=log.joint_names[index],
            nonlinear=np.zeros(0),
            reason=reason,
            of=of,
            dt=log.dt,
            **found._asdict(),
        )

    @property
    def error(self) -> Array:
        """(k,) the difference of measurement and prediction, relative to the prediction."""
        return np.abs(self.measured - self.predicted) / np.abs(self.predicted)

    def two_mass(self) -> TwoMass:
        """Fits a motor and a link with a spring between them to the response of a plant.

        Returns:
            Inertias, spring, delay, resonance and antiresonance; not ok, with a reason, if the response shows no spring.

        Raises:
            InputError: It is no response of a plant.
        """
        return fit_two_mass(self)

    def plot(
        self,
        path: str | os.PathLike[str] | None = None,
        *,
        size: tuple[float, float] | None = None,
        title: bool = True,
        ax: Sequence[Axes] | None = None,
    ) -> Path | None:
        """Draws magnitude and phase, with bounds and prediction.

        Args:
            path: The picture, .png, .svg or .pdf; its folder is made, and the file is written atomically. Left out, a window
                opens.
            size: Width and height in inches.
            title: Whether the joint's name stands above the panels; False where a caption says it.
            ax: Two axes of matplotlib to draw into instead, for magnitude and phase.

        Raises:
            InputError: The path has another ending, or the axes are not two.
            ArmctlError: The file cannot be written.
            NotInstalledError: There is no screen for a window.
        """
        layout = AxesLayout(title=f"{self.joint}, {self.of}" if flag("title", title) else "")
        return finish_axes(lambda axes: _draw(axes, self), (2, 1), size or _SIZE_INCHES, path, ax, layout)

    def __str__(self) -> str:
        if not self.ok:
            return f"{self.joint}: {self.reason}"
        if self.of != "sensitivity":
            hertz = self.frequency / (2 * np.pi)
            relative = self.bound / np.abs(self.measured)
            return (
                f"{self.joint}, {self.of}: {len(hertz)} frequencies from {hertz[0]:.3g} to {hertz[-1]:.3g} Hz, bounds of 95 % "
                f"at {np.median(relative):.1e} of the magnitude (median), coherence {np.median(self.coherence):.3f}"
            )
        parts = [f"{self.joint}: |S| at most {np.abs(self.measured).max():.3f} measured"]
        if np.isfinite(self.predicted).all():
            parts[0] += f", {np.abs(self.predicted).max():.3f} predicted"
            parts.append(f"relative difference {np.median(self.error):.1e} median, {self.error.max():.1e} maximum")
        parts.append(f"coherence at least {self.coherence.min():.4f}")
        if len(self.nonlinear):
            parts[-1] += f", nonlinear share at most {self.nonlinear.max():.1e}"
        return "; ".join(parts)


_LABELS = {"plant": "position per torque, rad/(N m)", "closed loop": "position per reference", "sensitivity": "|S|"}


def _draw(axes: list[Axes], found: FrequencyResponse) -> None:
    magnitude, phase = axes
    hertz = found.frequency / (2 * np.pi)
    size = np.abs(found.measured)
    angle = np.unwrap(np.angle(found.measured))
    spread = np.arcsin(np.clip(found.bound / size, 0.0, 1.0))
    low = np.maximum(size - found.bound, 1e-3 * size)
    magnitude.fill_between(hertz, low, size + found.bound, color=COLORS[0], alpha=0.25, linewidth=0)
    magnitude.loglog(hertz, size, color=COLORS[0], marker=".", label="measured, with bounds of 95 %")
    phase.fill_between(hertz, *np.degrees([angle - spread, angle + spread]), color=COLORS[0], alpha=0.25, linewidth=0)
    phase.plot(hertz, np.degrees(angle), color=COLORS[0], marker=".")
    if np.isfinite(found.predicted).all():
        turns = np.unwrap(np.angle(found.predicted / found.measured)) + angle
        magnitude.loglog(hertz, np.abs(found.predicted), color=COLORS[1], label="predicted")
        phase.plot(hertz, np.degrees(turns), color=COLORS[1])
    magnitude.set_title(_LABELS[found.of])
    magnitude.legend()
    phase.set_title("phase, deg")
    phase.set_xlabel("frequency, Hz")


class Excited(ControllerWrapper):
    """Disturbs a controller's torque at one joint by a signal, and adds a constant that holds the arm from the first tick."""

    def __init__(self, controller: Controller, holding_torque: Array, joint: int, signal: Array):
        self.traits = traits(controller)
        self.commands: list[float] = []
        self._controller = controller
        self._holding_torque = holding_torque
        self._offset: Array | None = None
        self._joint = joint
        self._signal = signal

    def torque(self, state: State, setpoint: Setpoint) -> Array:
        tau = np.array(self._controller.torque(state, setpoint), dtype=np.float64)
        tick = len(self.commands)
        if self._offset is None:
            self._offset = self._holding_torque - tau
        tau += self._offset
        self.commands.append(float(tau[self._joint]))
        tau[self._joint] += self._signal[tick % len(self._signal)]
        return tau


def frequency_response(
    arm: Arm, controller: Controller | str, q: ArrayLike, joint: int | str, plant: Plant | None = None
) -> FrequencyResponse:
    """Measures the sensitivity of one joint in simulation, and predicts it from the linear loop.

    The controller holds the arm at q while a multisine of odd harmonics and random phases disturbs the torque of the joint:
    periods of 2 s, first until the transient has decayed (at most 40 s), then six that are measured. Its size is 0.02 % of the
    torque limit, or 2 % if the plant has noise. A second run with a larger excitation, and the harmonics that are not excited,
    show what is not linear. See Pintelon and Schoukens, System Identification: A Frequency Domain Approach (2012), chapters 2
    and 4.

    Args:
        q: (n,) rad, the configuration.
        joint: The joint's name, or its index from the base.
        plant: How the simulated arm differs from the model; by default it does not.

    Returns:
        Measurement with bounds, prediction, coherence and nonlinear share at 60 frequencies or fewer.

    Raises:
        InputError: An argument has a wrong type, length or value.
        LimitError: A position outside the limits.
        ModelError: The controller fails, or no linear model describes it.
        SimulationError: The controller failed in the simulation.
        UnknownNameError: There is no such controller.
    """
    check_arm(arm)
    law = read_controller(controller, arm)
    q = arm.checked("q", q)
    plant = read_plant(plant)
    index = joint_index(arm.joint_names, joint)
    loop = Linearizer(arm, plant).loop_at(law, q)
    ticks = round(MULTISINE_PERIOD_S / loop.dt)
    lines = _lines(ticks)
    frequency = np.asarray(2 * np.pi * lines / (ticks * loop.dt), dtype=np.float64)
    predicted = loop.sensitivity(frequency)[:, index, index]
    share = _AMPLITUDE_WITH_NOISE if plant.encoder_noise or plant.velocity_noise else _AMPLITUDE
    small = share * float(arm.limits.tau_max[index])
    friction = float(plant.model(arm).dof_frictionloss[arm.dof_adr[index]])
    decay = -np.log(min(loop.margins().spectral_radius, 1 - 1e-9)) * ticks  # in one period
    settling = int(np.clip(np.ceil(-np.log(_TRANSIENT) / decay), _MIN_SETTLING_PERIODS, _MAX_SETTLING_PERIODS))
    count = (settling + _MEASURED_PERIODS) * ticks
    motion = standstill(arm, q, count * loop.dt)
    runs = []
    for amplitude in (small, max(_LARGER * small, _FRICTION_RATIO * friction)):
        signal = _multisine(ticks, lines, amplitude)
        excited = Excited(law, loop.holding_torque, index, signal)
        log = simulate(arm, excited, motion, plant, dwell=0.0)
        reason = _failure(log, count)
        if reason:
            nothing = np.full(len(lines), np.nan)
            unknown = nothing.astype(complex)
            return FrequencyResponse(
                ok=False,
                joint=arm.joint_names[index],
                frequency=frequency,
                measured=unknown,
                predicted=predicted,
                coherence=nothing,
                nonlinear=nothing,
                reason=reason,
            )
        total = np.array(excited.commands[:count]).reshape(-1, ticks)[settling:] + signal
        runs.append(averaged_response(total, signal, lines))
    run, larger = runs
    change = _above_noise(np.abs(run.response - larger.response) ** 2, run.variance + larger.variance)
    nonlinear = np.sqrt(change + np.maximum(run.distortion, larger.distortion)) / np.abs(run.response)
    reason = _doubt(frequency, run.coherence, nonlinear)
    return FrequencyResponse(
        ok=not reason,
        joint=arm.joint_names[index],
        frequency=frequency,
        measured=run.response,
        predicted=predicted,
        coherence=run.coherence,
        nonlinear=nonlinear,
        reason=reason,
        bound=np.sqrt(bound_factor(_MEASURED_PERIODS - 1) * run.variance),
        dt=loop.dt,
    )


class _Response(NamedTuple):
    """The response to one multisine, each (k,), relative to the excitation."""

    response: ComplexArray  # complex, the mean of all periods
    variance: Array  # of that mean, by noise
    coherence: Array  # in [0, 1]
    distortion: Array  # the square of what appears at neighbouring lines that are not excited, without noise


def averaged_response(total: Array, signal: Array, lines: IntArray) -> _Response:
    """The response from the measured torque of whole periods, (periods, ticks) N m."""
    spectrum = np.fft.fft(total, axis=1)
    mean = spectrum.mean(axis=0)
    power = (np.abs(spectrum) ** 2).mean(axis=0)
    variance = np.maximum(power - np.abs(mean) ** 2, 0.0) / (len(total) - 1)
    distortion = _above_noise(np.abs(mean) ** 2, variance)
    highest = int(lines[-1]) + 1
    odd = np.setdiff1d(np.arange(1, highest, 2), lines)
    closest = odd[np.abs(lines[:, None] - odd).argmin(axis=1)]
    around = distortion[closest] + 0.5 * (distortion[lines - 1] + distortion[lines + 1])
    excitation = np.fft.fft(signal)[lines]
    size = np.abs(excitation) ** 2
    coherence = np.abs(mean[lines]) ** 2 / power[lines]
    return _Response(mean[lines] / excitation, variance[lines] / size, coherence, around / size)


def _above_noise(square: Array, variance: Array) -> Array:
    """The part of squared sizes that the noise does not explain."""
    return np.where(square > _SIGNIFICANT_VARIANCES * variance, square - variance, 0.0)


def _failure(log: Log, ticks: int) -> str:
    if log.failure or len(log) < ticks:
        return log.failure or "the run was too short"
    return _disturbance(log)


def _disturbance(log: Log) -> str:
    """The torque limit or the contact that disturbed a run; empty if there is none."""
    if (np.abs(log.tau_cmd) > log.tau_max).any():
        return "a motor reached its torque limit"
    return f"the arm touched {log.contacts[0].other:.80}" if log.contacts else ""


def _doubt(frequency: Array, coherence: Array, nonlinear: Array) -> str:
    hertz = frequency / (2 * np.pi)
    worst = int(coherence.argmin())
    if coherence[worst] < _MIN_COHERENCE:
        return f"the coherence is {coherence[worst]:.2f} at {hertz[worst]:.3g} Hz"
    worst = int(nonlinear.argmax())
    if nonlinear[worst] > _MAX_NONLINEAR_SHARE:
        return (
            f"the nonlinear share is {nonlinear[worst]:.2g} at {hertz[worst]:.3g} Hz, above {_MAX_NONLINEAR_SHARE:g}: "
            "dry friction or a large motion, for which no linear loop stands"
        )
    return ""


def _lines(ticks: int) -> IntArray:
    """The excited lines of the spectrum: about geometric, odd multiples of 1 / period, with odd ones left out between them."""
    odd = np.arange(3, int(_MAX_FREQUENCY_SHARE * ticks / 2) + 1, 2)
    odd = odd[np.arange(len(odd)) % _DETECTION_EVERY < _DETECTION_EVERY - 1]
    wanted = np.geomspace(MIN_FREQUENCY_HZ * MULTISINE_PERIOD_S, odd[-1], MULTISINE_LINES)
    return np.unique(odd[np.abs(wanted[:, None] - odd).argmin(axis=1)])


def _multisine(ticks: int, lines: IntArray, amplitude: float) -> Array:
    """(ticks,) N m, one period of sines with random phases and the given root mean square."""
    phases = np.random.default_rng(_PHASE_SEED).uniform(0.0, 2 * np.pi, len(lines))
    angles = 2 * np.pi * np.arange(ticks)[:, None] * lines / ticks + phases
    signal = np.sin(angles).sum(axis=1)
    return amplitude * signal / np.std(signal)


def standstill(arm: Arm, q: Array, duration: float) -> JointTrajectory:
    coefficients = np.zeros((1, 6, arm.n))
    coefficients[0, 0] = q
    return JointTrajectory(
        knots=np.array([0.0, duration]), coefficients=coefficients, joint_names=arm.joint_names, limits=arm.limits
    )
