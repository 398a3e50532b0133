"""What a linear loop answers: Bode and Nyquist curves of its joints, step responses, and disk margins."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf, pi
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from armctl.core.defaults import MAX_PEAK_SENSITIVITY
from armctl.core.plotting import COLORS, finish_axes
from armctl.core.validation import Array
from armctl.lab.loops.stability import loop_frequencies
from armctl.lab.loops.state_space import ComplexArray, StateSpace

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BODE_SIZE_INCHES = (6.4, 5.2)
_NYQUIST_SIZE_INCHES = (4.8, 4.8)
_STEP_SIZE_INCHES = (6.4, 3.6)
_SETTLED = 0.02  # of the final value: the usual band, also of python-control's step_info
_RISE = (0.1, 0.9)  # of the final value, likewise
_DECAYS = 6.0  # time constants of the slowest pole that a step response shows by default
MAX_STEP_TICKS = 20_000
_REFINEMENTS = 3  # of a peak between two points of a grid, each by a twentieth of it
_POINTS_PER_REFINEMENT = 41
_SCALING_STEPS = 80  # after which the bound of a structured singular value decreases by less than 0.1 %


BOUND = {"color": "#555555", "linestyle": (0, (4, 3)), "linewidth": 0.9, "zorder": 1}
_HALF_TURN_DEGREES = 180.0


@dataclass(frozen=True, slots=True, eq=False)
class Bode:
    """The Bode plot of a loop: the loop gain of each joint with the loops of the other joints closed.

    Attributes:
        w: (k,) rad/s.
        magnitude: (k, n).
        phase: (k, n) rad, continuous over the frequencies, and between -2 pi and 0 where the magnitude is nearest to 1: the
            phase margin there is pi + phase.
        names: The joints.
    """

    w: Array
    magnitude: Array
    phase: Array
    names: tuple[str, ...]

    def __repr__(self) -> str:
        return _curves_text("Bode", self.names, self.w)

    def to_dict(self) -> dict[str, Array]:
        """The curves as a flat table, for `pandas.DataFrame(bode.to_dict())`.

        Returns:
            Columns (k,) by their names, such as "w" and "magnitude.joint1".
        """
        return _columns("w", self.w, self.names, magnitude=self.magnitude, phase=self.phase)

    def plot(
        self,
        path: str | os.PathLike[str] | None = None,
        *,
        size: tuple[float, float] | None = None,
        ax: Sequence[Axes] | None = None,
    ) -> Path | None:
        """Draws magnitude and phase over frequency.

        Args:
            path: The picture, .png, .svg or .pdf; its folder is made, and the file is written atomically. Left out, a window
                opens.
            size: Width and height in inches.
            ax: Two axes of matplotlib to draw into instead, for magnitude and phase.

        Raises:
            InputError: The path has another ending, or the axes are not two.
            ArmctlError: The file cannot be written.
            NotInstalledError: There is no screen for a window.
        """
        return finish_axes(lambda axes: draw_bode(axes, self), (2, 1), size or _BODE_SIZE_INCHES, path, ax)


@dataclass(frozen=True, slots=True, eq=False)
class Nyquist:
    """The Nyquist curve of each joint with the loops of the other joints closed.

    Attributes:
        w: (k,) rad/s.
        curve: (k, n) complex, the loop gain.
        names: The joints.
    """

    w: Array
    curve: ComplexArray
    names: tuple[str, ...]

    def __repr__(self) -> str:
        return _curves_text("Nyquist", self.names, self.w)

    def to_dict(self) -> dict[str, Array]:
        """The curves as a flat table, for `pandas.DataFrame(nyquist.to_dict())`.

        Returns:
            Columns (k,) by their names, such as "w", "real.joint1" and "imag.joint1".
        """
        return _columns("w", self.w, self.names, real=self.curve.real, imag=self.curve.imag)

    def plot(
        self,
        path: str | os.PathLike[str] | None = None,
        *,
        size: tuple[float, float] | None = None,
        ax: Axes | None = None,
    ) -> Path | None:
        """Draws the curves around -1, with the circle in which the sensitivity is above 1.7.

        Args:
            path: The picture, .png, .svg or .pdf; its folder is made, and the file is written atomically. Left out, a window
                opens.
            size: Width and height in inches.
            ax: Axes of matplotlib to draw into instead.

        Raises:
            InputError: The path has another ending.
            ArmctlError: The file cannot be written.
            NotInstalledError: There is no screen for a window.
        """
        return finish_axes(lambda axes: draw_nyquist(axes[0], self), (1, 1), size or _NYQUIST_SIZE_INCHES, path, ax)


@dataclass(frozen=True, slots=True, eq=False)
class StepResponse:
    """The response of each joint to a step on itself.

    Attributes:
        t: (k,) s.
        y: (k, n) in `unit`.
        final: (n,) what y approaches; NaN if the closed loop is unstable.
        names: The joints.
        quantity: What y is, in words.
        unit: Of y; empty for a share.
    """

    t: Array
    y: Array
    final: Array
    names: tuple[str, ...]
    quantity: str
    unit: str

    @property
    def overshoot(self) -> Array:
        """(n,) how far y exceeds its final value, as a share of it; 0 if it does not, NaN without a final value."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.maximum((self.y / self.final).max(axis=0) - 1.0, 0.0) + 0.0 * self.final

    @property
    def rise_time(self) -> Array:
        """(n,) s from 10 % to 90 % of the final value; NaN if y does not get there."""
        first = [np.where((self._share >= share).any(axis=0), (self._share >= share).argmax(axis=0), -1) for share in _RISE]
        times = np.where(first[1] >= 0, self.t[first[1]] - self.t[first[0]], np.nan)
        return np.asarray(times, dtype=np.float64)

    @property
    def settling_time(self) -> Array:
        """(n,) s until y stays within 2 % of its final value; NaN if it does not do so within `t`."""
        outside = ~(np.abs(self._share - 1.0) < _SETTLED)
        last = len(self.t) - 1 - outside[::-1].argmax(axis=0)
        last[~outside.any(axis=0)] = -1
        return np.where(last + 1 < len(self.t), self.t[np.minimum(last + 1, len(self.t) - 1)], np.nan)

    @property
    def _share(self) -> Array:
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.y / self.final

    def __repr__(self) -> str:
        return f"StepResponse({', '.join(self.names):.120}; {self.t[-1]:.4g} s)"

    def to_dict(self) -> dict[str, Array]:
        """The responses as a flat table, for `pandas.DataFrame(response.to_dict())`.

        Returns:
            Columns (k,) by their names, such as "t" and "y.joint1".
        """
        return _columns("t", self.t, self.names, y=self.y)

    def plot(
        self,
        path: str | os.PathLike[str] | None = None,
        *,
        size: tuple[float, float] | None = None,
        ax: Axes | None = None,
    ) -> Path | None:
        """Draws the responses over time.

        Args:
            path: The picture, .png, .svg or .pdf; its folder is made, and the file is written atomically. Left out, a window
                opens.
            size: Width and height in inches.
            ax: Axes of matplotlib to draw into instead.

        Raises:
            InputError: The path has another ending.
            ArmctlError: The file cannot be written.
            NotInstalledError: There is no screen for a window.
        """
        return finish_axes(lambda axes: draw_step(axes[0], self), (1, 1), size or _STEP_SIZE_INCHES, path, ax)


class DiskMargin(NamedTuple):
    """A disk of gain and phase changes at once that keep a loop stable.

    Balanced, as in Seiler, Packard, Gahinet, An introduction to disk margins, IEEE Control Systems Magazine 40 (2020).

    Attributes:
        radius: The disk margin alpha; 0 if the closed loop is unstable.
        frequency: rad/s, at which the disk is reached.
    """

    radius: float
    frequency: float

    @property
    def gain(self) -> tuple[float, float]:
        """The factors between which the gain may vary, if the phase stays; 0 and infinite for a radius of 2 and more."""
        if self.radius >= 2.0:
            return 0.0, inf
        return (2.0 - self.radius) / (2.0 + self.radius), (2.0 + self.radius) / (2.0 - self.radius)

    @property
    def phase(self) -> float:
        """By how much the phase may vary, rad, if the gain stays."""
        return 2.0 * math.atan(self.radius / 2.0)


@dataclass(frozen=True, slots=True, eq=False)
class DiskMargins:
    """Disk margins of a loop: those of single joints, and that of all at once.

    Attributes:
        joints: For each joint that of its loop, with the loops of the other joints closed.
        together: All joints vary at once and independently; at least this is safe, since structured singular values are bounded
            from above (Doyle, Analysis of feedback systems with structured uncertainties, 1982).
    """

    joints: tuple[DiskMargin, ...]
    together: DiskMargin

    def __str__(self) -> str:
        low, high = self.together.gain
        return (
            f"disk margin {self.together.radius:.3g} of all joints together: gain {low:.3g} to {high:.3g}, "
            f"phase {math.degrees(self.together.phase):.3g} deg; single joints at least {min(self.joints).radius:.3g}"
        )


def _curves_text(kind: str, names: tuple[str, ...], w: Array) -> str:
    """The repr of curves in one line."""
    span = f"{w[0]:.3g} to {w[-1]:.4g} rad/s" if len(w) else "no frequency"
    return f"{kind}({', '.join(names):.120}; {len(w)} frequencies, {span})"


def _columns(first: str, x: Array, names: tuple[str, ...], **values: Array) -> dict[str, Array]:
    """A flat table: the first column, and one for each kind of value and each name."""
    columns = {first: x}
    for kind, matrix in values.items():
        columns |= {f"{kind}.{name}": matrix[:, i] for i, name in enumerate(names)}
    return columns


def joint_loops(loop: StateSpace, z: ComplexArray) -> ComplexArray:
    """(k, n) the loop gain of each input with the others closed: 1 / S_ii - 1, where S is the sensitivity."""
    transfer = loop.transfer(z)
    n = transfer.shape[1]
    if n == 1:
        return transfer[:, :, 0]
    sensitivity = np.linalg.inv(np.eye(n) + transfer)
    return np.asarray(1 / np.diagonal(sensitivity, axis1=1, axis2=2) - 1, dtype=np.complex128)


def bode_of(w: Array, gains: ComplexArray, names: tuple[str, ...]) -> Bode:
    """The Bode plot of loop gains (k, n)."""
    magnitude = np.abs(gains)
    phase = np.unwrap(np.angle(gains), axis=0)
    with np.errstate(divide="ignore"):
        nearest = np.abs(np.log(magnitude)).argmin(axis=0)
    phase -= 2 * pi * np.ceil(phase[nearest, np.arange(len(names))] / (2 * pi))
    return Bode(w=w, magnitude=magnitude, phase=phase, names=names)


def default_step_duration(slowest_pole: float, dt: float) -> float:
    """s that a step response lasts if nobody says it; the pole is a rate in 1/s."""
    rate = max(abs(slowest_pole), _DECAYS / (MAX_STEP_TICKS * dt))
    return max(_DECAYS / rate, 2 * dt)


def simulated_step(system: StateSpace, ticks: int) -> Array:
    """(ticks + 1, n) the outputs of a square system after a step, each on the input of its own number, from rest."""
    n = system.B.shape[1]
    y = np.empty((ticks + 1, n))
    x = np.zeros((len(system.A), n))
    direct = system.D.diagonal()
    for k in range(ticks + 1):
        y[k] = (system.C * x.T).sum(axis=1) + direct
        x = system.A @ x + system.B
    return y


def final_value(system: StateSpace) -> Array:
    """(n,) the diagonal of the gain of a square system at rest."""
    gain = system.C @ np.linalg.solve(np.eye(len(system.A)) - system.A, system.B) + system.D
    return gain.diagonal().copy()


def disk_margins_of(loop: StateSpace, dt: float, is_stable: bool) -> DiskMargins:
    """The disk margins of a loop transfer function with negative feedback."""
    n = loop.B.shape[1]
    if not is_stable:
        return DiskMargins(joints=(DiskMargin(0.0, math.nan),) * n, together=DiskMargin(0.0, math.nan))

    def balanced(w: Array) -> ComplexArray:
        """(k, n, n) half the difference of sensitivity and complementary sensitivity, S - 1 / 2."""
        sensitivity = np.linalg.inv(np.eye(n) + loop.transfer(np.exp(1j * w * dt)))
        return np.asarray(sensitivity - 0.5 * np.eye(n), dtype=np.complex128)

    w = loop_frequencies(loop, dt)
    on_grid = balanced(w)
    joints = []
    for i in range(n):
        size = np.abs(on_grid[:, i, i])
        frequency = _refined(w, int(size.argmax()), lambda w, i=i: np.abs(balanced(w)[:, i, i]))
        joints.append(DiskMargin(float(1 / np.abs(balanced(np.array([frequency]))[0, i, i])), frequency))
    if n == 1:
        return DiskMargins(joints=tuple(joints), together=joints[0])
    frequency = _refined(w, int(_structured_bounds(on_grid).argmax()), lambda w: _structured_bounds(balanced(w)))
    largest = max(float(_structured_bounds(balanced(np.array([frequency])))[0]), *(1 / each.radius for each in joints))
    return DiskMargins(joints=tuple(joints), together=DiskMargin(1 / largest, frequency))


def _refined(w: Array, k: int, value: Callable[[Array], Array]) -> float:
    """rad/s, the frequency near w[k] at which a function of frequencies is largest."""
    best = float(w[k])
    low = float(w[max(k - 1, 0)])
    high = float(w[min(k + 1, len(w) - 1)])
    for _ in range(_REFINEMENTS):
        inside = np.geomspace(low, high, _POINTS_PER_REFINEMENT)
        i = int(value(inside).argmax())
        best = float(inside[i])
        low = float(inside[max(i - 1, 0)])
        high = float(inside[min(i + 1, len(inside) - 1)])
    return best


def _structured_bounds(matrices: ComplexArray) -> Array:
    """(k,) upper bounds of the structured singular values of matrices (k, n, n) for n independent complex factors.

    The least norm of D M D^-1 over diagonal D, by steps along its slope sigma (|u_i|^2 - |v_i|^2) with the first singular
    vectors u and v (Packard, Doyle, The complex structured singular value, Automatica 29, 1993). Every D gives a bound.
    """
    logarithms = np.zeros(matrices.shape[:2])
    best = np.full(len(matrices), inf)
    for step in range(_SCALING_STEPS):
        scaled = matrices * np.exp(logarithms[:, :, None] - logarithms[:, None, :])
        left, sizes, right = np.linalg.svd(scaled)
        best = np.minimum(best, sizes[:, 0])
        slope = np.abs(left[:, :, 0]) ** 2 - np.abs(right[:, 0, :]) ** 2
        logarithms -= slope / (1.0 + step) ** 0.5
    return best


def draw_bode(axes: Sequence[Axes], bode: Bode) -> None:
    """Magnitude and phase of each joint's loop over frequency, in two axes."""
    gain, phase = axes
    hertz = bode.w / (2 * np.pi)
    for i, name in enumerate(bode.names):
        color = COLORS[i % len(COLORS)]
        gain.loglog(hertz, bode.magnitude[:, i], color=color, label=name)
        phase.semilogx(hertz, np.degrees(bode.phase[:, i]), color=color)
    gain.axhline(1.0, **BOUND)
    gain.set_ylabel("loop gain |L|")
    phase.axhline(-_HALF_TURN_DEGREES, **BOUND)
    phase.set_ylim(-3 * _HALF_TURN_DEGREES, 0.5 * _HALF_TURN_DEGREES)
    phase.set_yticks(np.arange(-3, 1) * _HALF_TURN_DEGREES)
    phase.set_ylabel("phase, deg")
    phase.set_xlabel("frequency, Hz")
    if len(bode.names) > 1:
        gain.legend(loc="best")


def draw_nyquist(axes: Axes, nyquist: Nyquist) -> None:
    """The curves around -1."""
    for i, name in enumerate(nyquist.names):
        axes.plot(nyquist.curve[:, i].real, nyquist.curve[:, i].imag, color=COLORS[i % len(COLORS)], label=name)
    angle = np.linspace(0.0, 2 * np.pi, 200)
    axes.plot(np.cos(angle) / MAX_PEAK_SENSITIVITY - 1, np.sin(angle) / MAX_PEAK_SENSITIVITY, **BOUND)
    axes.plot(-1.0, 0.0, marker="+", color="black")
    axes.set_xlim(-3.0, 1.0)
    axes.set_ylim(-2.0, 2.0)
    axes.set_aspect("equal")
    axes.set_xlabel("real part of L")
    axes.set_ylabel("imaginary part of L")


def draw_step(axes: Axes, response: StepResponse) -> None:
    """The responses of all joints over time."""
    for i, name in enumerate(response.names):
        axes.plot(response.t, response.y[:, i], color=COLORS[i % len(COLORS)], label=name)
    axes.set_ylabel(response.quantity + (f", {response.unit}" if response.unit else ""))
    axes.set_xlabel("time, s")
