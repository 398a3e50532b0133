"""Loop: an arm and a controller around a configuration, as a discrete linear system."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError, NotInstalledError
from armctl.core.plotting import COLORS, finish_figure
from armctl.core.validation import Array, IntArray, integer, vector
from armctl.design.stability import (
    CoarseMargins,
    LoopMargins,
    coarse_grid,
    coarse_margins,
    coarse_margins_of,
    frequency_grid,
    loop_margins,
    robustness,
)
from armctl.design.state_space import ComplexArray, StateSpace

if TYPE_CHECKING:
    import control
    from matplotlib.figure import Figure

MAX_DELAY_TICKS = 200
_SHOWN_SENSITIVITY = 1.7  # a usual bound of Ms (Astrom and Hagglund, Advanced PID Control, 2006, 4.6)
_BOUND = {"color": "#555555", "linestyle": (0, (4, 3)), "linewidth": 0.9, "zorder": 1}


@dataclass(frozen=True, eq=False)
class Loop:
    """The loop of an arm and a controller around a configuration at rest, broken at the input of the motors.

    A, B, C and D are the loop transfer function L(z) = C (z - A)^-1 B + D from the torque of the motors to minus the torque of
    the controller; the loop is closed by negative feedback. Contacts, limits and dry friction are left out.

    Attributes:
        plant: The simulated plant, in words.
        q: (n,) rad, the configuration.
        dt: s, the control period.
        delay: Ticks of delay between controller and motors.
        holding_torque: (n,) N m that holds the plant still at q.
    """

    robot: str
    controller: str
    plant: str
    joint_names: tuple[str, ...]
    q: Array
    dt: float
    delay: int
    holding_torque: Array
    _arm: StateSpace
    _push: Array
    _position: Array
    _law: StateSpace
    _tip_jacobian: Array

    @property
    def n(self) -> int:
        """The number of joints."""
        return len(self.joint_names)

    @property
    def A(self) -> Array:
        """(k, k), the matrix of the state.

        The state is that of the arm, positions and velocities first, what its sensors keep, the memory of the controller, and
        the delayed torques.
        """
        return self.system.A

    @property
    def B(self) -> Array:
        """(k, n)."""
        return self.system.B

    @property
    def C(self) -> Array:
        """(n, k)."""
        return self.system.C

    @property
    def D(self) -> Array:
        """(n, n); zero, because torque does not act on the position at the same tick."""
        return self.system.D

    @cached_property
    def system(self) -> StateSpace:
        """The loop transfer function as one object: `A`, `B`, `C` and `D`."""
        n = self.n
        moving = len(self._arm.A)
        memory = moving + len(self._law.A)
        size = memory + self.delay * n
        A = np.zeros((size, size))
        A[:moving, :moving] = self._arm.A
        A[moving:memory, :moving] = self._law.B @ self._arm.C
        A[moving:memory, moving:memory] = self._law.A
        output = np.zeros((n, size))
        output[:, :moving] = -self._law.D @ self._arm.C
        output[:, moving:memory] = -self._law.C
        for _ in range(self.delay):  # each tick of delay stores the output of the stage before it
            A[memory : memory + n] = output
            output = np.zeros((n, size))
            output[:, memory : memory + n] = np.eye(n)
            memory += n
        B = np.zeros((size, n))
        B[:moving] = self._arm.B
        return StateSpace(A, B, output, np.zeros((n, n)))

    @cached_property
    def _margins(self) -> LoopMargins:
        return loop_margins(self.system, self.dt)

    def margins(self) -> LoopMargins:
        """Delay, gain and phase margin, and the peak sensitivity.

        Returns:
            The margins; not ok if the closed loop is unstable.
        """
        return self._margins

    def robustness(self) -> LoopMargins:
        """The margins without the gain margin, which takes longest to compute and is infinite here."""
        return robustness(self.system, self.dt)

    def modes(self) -> Array:
        """The vibrations of the closed loop.

        Returns:
            (k, 2) frequency, rad/s, with its damping, and damping ratio of each; the least damped one first.
        """
        poles = np.linalg.eigvals(self.A - self.B @ self.C)
        poles = poles[poles.imag > 0.0]
        rates = np.log(poles) / self.dt
        modes = np.column_stack([rates.imag, -rates.real / np.abs(rates)])
        return modes[modes[:, 1].argsort()]

    def coarse_margins(self) -> CoarseMargins:
        """The margins of single eigenvalues and joints, accurate to 1 % in a fraction of the time."""
        return coarse_margins_with(coarse_plant(self), self)

    def with_law(self, law: StateSpace) -> Loop:
        """The same arm with another linear controller.

        Args:
            law: From measured positions and velocities (2n) to torques (n).
        """
        return replace(self, _law=law)

    def delayed(self, ticks: int) -> Loop:
        """The same loop with another delay.

        Args:
            ticks: Delay between controller and motors, instead of the one it has.

        Raises:
            InputError: The delay is negative, above 200 ticks or no integer.
        """
        return replace(self, delay=integer("ticks", ticks, 0, MAX_DELAY_TICKS))

    def transfer(self, w: ArrayLike) -> ComplexArray:
        """The loop transfer function L.

        Args:
            w: (k,) frequencies, rad/s, above 0 and up to pi / dt.

        Returns:
            (k, n, n) complex.

        Raises:
            InputError: A frequency is outside its bounds or not finite.
        """
        return self.system.transfer(self._z(w))

    def sensitivity(self, w: ArrayLike) -> ComplexArray:
        """The sensitivity S = (1 + L)^-1: how much of a disturbance torque remains at the motors.

        Args:
            w: (k,) frequencies, rad/s, above 0 and up to pi / dt.

        Returns:
            (k, n, n) complex. The magnitude of the diagonal is below 1 where the controller suppresses disturbances.

        Raises:
            InputError: A frequency is outside its bounds or not finite.
        """
        return np.asarray(np.linalg.inv(np.eye(self.n) + self.transfer(w)), dtype=np.complex128)

    def compliance(self, w: ArrayLike) -> Array:
        """The dynamic compliance of the tip: its displacement per force on it, in the worst direction.

        Args:
            w: (k,) frequencies, rad/s, above 0 and up to pi / dt.

        Returns:
            (k,) m/N.

        Raises:
            InputError: A frequency is outside its bounds or not finite.
        """
        displacement = self._tip_jacobian @ self.joint_compliance(w) @ self._tip_jacobian.T
        return np.asarray(np.linalg.svd(displacement, compute_uv=False)[:, 0], dtype=np.float64)

    def joint_compliance(self, w: ArrayLike) -> ComplexArray:
        """The dynamic compliance of the joints: their displacements per disturbance torque.

        Args:
            w: (k,) frequencies, rad/s, above 0 and up to pi / dt.

        Returns:
            (k, n, n) complex, rad/(N m).

        Raises:
            InputError: A frequency is outside its bounds or not finite.
        """
        z = self._z(w)
        n = self.n
        outputs = np.vstack([self._arm.C, self._position])
        inputs = np.hstack([self._arm.B, self._push])
        arm = StateSpace(self._arm.A, inputs, outputs, np.zeros((len(outputs), 2 * n))).transfer(z)
        law = self._law.transfer(z) * z[:, None, None] ** -self.delay
        signals = len(self._arm.C)
        seen = np.linalg.solve(np.eye(signals) - arm[:, :signals, :n] @ law, arm[:, :signals, n:])
        closed = arm[:, signals:, n:] + arm[:, signals:, :n] @ law @ seen
        return np.asarray(closed, dtype=np.complex128)

    def plot(self, path: str | os.PathLike[str] | None = None) -> Path | None:
        """Draws the Nyquist curves of the joints, their sensitivities and the compliance of the tip.

        Args:
            path: The picture, .png, .svg or .pdf; its folder is made, and the file is written atomically. Left out, a window
                opens.

        Raises:
            InputError: The path has another ending.
            ArmctlError: The file cannot be written.
            NotInstalledError: There is no screen for a window.
        """
        return finish_figure(lambda figure: draw_loop(figure, self), (13, 4.6), path)

    def to_control(self) -> control.StateSpace:
        """The loop transfer function for python-control, for root loci, step responses and the design of controllers.

        Returns:
            A discrete `control.StateSpace` with n inputs and n outputs.

        Raises:
            NotInstalledError: python-control is not installed.
        """
        try:
            import control
        except ImportError:
            raise NotInstalledError.of_extra("to_control needs python-control", "design") from None
        names: dict[str, Any] = {"inputs": list(self.joint_names), "outputs": list(self.joint_names)}
        return control.StateSpace(self.A, self.B, self.C, self.D, self.dt, **names)

    def _z(self, w: ArrayLike) -> ComplexArray:
        w = vector("w", w)
        if len(w) and not (w.min() > 0.0 and w.max() <= np.pi / self.dt * (1 + 1e-9)):
            raise InputError(f"w: expected frequencies in (0, {np.pi / self.dt:g}] rad/s, got {w.min():g} to {w.max():g}")
        return np.exp(1j * w * self.dt)


def draw_loop(figure: Figure, loop: Loop) -> None:
    """Three panels: Nyquist curve and sensitivity of each joint with the other joints closed, and the tip's compliance."""
    nyquist, sensitivity, compliance = figure.subplots(1, 3)
    frequencies = frequency_grid(loop.dt)
    hertz = frequencies / (2 * np.pi)
    diagonal = np.diagonal(loop.sensitivity(frequencies), axis1=1, axis2=2)
    for i, name in enumerate(loop.joint_names):
        color = COLORS[i % len(COLORS)]
        curve = 1 / diagonal[:, i] - 1  # the loop of one joint while the others are closed
        nyquist.plot(curve.real, curve.imag, color=color)
        sensitivity.loglog(hertz, np.abs(diagonal[:, i]), color=color, label=name)
    angle = np.linspace(0.0, 2 * np.pi, 200)
    nyquist.plot(np.cos(angle) / _SHOWN_SENSITIVITY - 1, np.sin(angle) / _SHOWN_SENSITIVITY, **_BOUND)
    nyquist.plot(-1.0, 0.0, marker="+", color="black")
    nyquist.set_xlim(-3.0, 1.0)
    nyquist.set_ylim(-2.0, 2.0)
    nyquist.set_aspect("equal")
    nyquist.set_title(f"Nyquist, the other joints closed (circle: Ms = {_SHOWN_SENSITIVITY:g})")
    sensitivity.axhline(1.0, **_BOUND)
    sensitivity.set_title("sensitivity |S| of each joint")
    sensitivity.set_xlabel("frequency, Hz")
    compliance.loglog(hertz, 1e6 * loop.compliance(frequencies), color=COLORS[0])
    compliance.set_title("compliance of the tip, worst direction, um/N")
    compliance.set_xlabel("frequency, Hz")
    figure.legend(loc="outside lower center", ncols=min(loop.n, 8))
    figure.suptitle(f"{loop.robot}, {loop.controller}, {loop.plant}", fontweight="bold", x=0.01, ha="left")


def coarse_margins_with(plant: ComplexArray, loop: Loop, decisive: IntArray | None = None) -> CoarseMargins:
    """`Loop.coarse_margins`, where the `coarse_plant` of its arm is known, and maybe which frequencies of the grid decide."""
    frequencies = coarse_grid(loop.dt)
    if decisive is not None:
        frequencies = frequencies[decisive]
        plant = plant[decisive]
    transfer = -loop._law.transfer(np.exp(1j * frequencies * loop.dt)) @ plant
    return coarse_margins(loop.system, frequencies, transfer) if decisive is None else coarse_margins_of(frequencies, transfer)


def coarse_plant(loop: Loop) -> ComplexArray:
    """The transfer function of arm and delay from torques to measured positions and velocities, on `coarse_grid`."""
    z = np.exp(1j * coarse_grid(loop.dt) * loop.dt)
    return loop._arm.transfer(z) * z[:, None, None] ** -loop.delay
