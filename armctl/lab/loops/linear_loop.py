"""LinearLoop: any discrete linear loop with negative feedback, and what can be asked of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError, NotInstalledError, shown
from armctl.core.tables import Table
from armctl.core.validation import Array, array, frozen, number, vector, words
from armctl.lab.loops.loop_responses import (
    MAX_STEP_TICKS,
    Bode,
    DiskMargins,
    Nyquist,
    StepResponse,
    bode_of,
    default_step_duration,
    disk_margins_of,
    final_value,
    joint_loops,
    simulated_step,
)
from armctl.lab.loops.stability import (
    GainCrossover,
    LoopMargins,
    PhaseCrossover,
    gain_crossovers,
    loop_frequencies,
    loop_margins,
    phase_crossovers,
    robustness,
)
from armctl.lab.loops.state_space import ComplexArray, StateSpace

if TYPE_CHECKING:
    import control

_MAX_SAMPLING_TIME_S = 1e6


class LoopAnalysis:
    """What can be asked of a discrete linear loop that is closed by negative feedback."""

    dt: float

    @property
    def names(self) -> tuple[str, ...]:
        """The n inputs and outputs of the loop: the joints of an arm."""
        raise NotImplementedError

    @property
    def system(self) -> StateSpace:
        """The loop transfer function as one object: `A`, `B`, `C` and `D`."""
        raise NotImplementedError

    @property
    def title(self) -> str:
        """What the loop is, in words."""
        return "LinearLoop"

    def __repr__(self) -> str:
        return "\n".join([self.title, *(f"  {name}: {text}" for name, text in self._summary().items())])

    def _repr_html_(self) -> str:
        rows = list(self._summary().items())
        return Table([self.title, ""], rows).html()

    def _summary(self) -> dict[str, str]:
        """Names and values of what one asks of a loop first."""
        lines = {"size": f"{len(self.names)} inputs, {len(self.system.A)} states, control period {1e3 * self.dt:.4g} ms"}
        margins = self.margins()
        if not margins:
            return lines | {"unstable": margins.reason}
        modes = self.modes()
        damped = f", least damping ratio {modes[0, 1]:.2g} at {modes[0, 0] / (2 * np.pi):.3g} Hz" if len(modes) else ""
        return lines | {"margins": str(margins), "poles": f"slowest {self.slowest_pole:.3g} 1/s{damped}"}

    @cached_property
    def _margins(self) -> LoopMargins:
        return loop_margins(self.system, self.dt)

    def margins(self) -> LoopMargins:
        """Delay, gain (lower and upper) and phase margin, and the peak sensitivity.

        Returns:
            The margins; not ok if the closed loop is unstable.
        """
        return self._margins

    def robustness(self) -> LoopMargins:
        """The margins without the gain margins, which are NaN here unless the closed loop is unstable."""
        return robustness(self.system, self.dt)

    def gain_crossovers(self) -> list[GainCrossover]:
        """All frequencies at which an eigenvalue of the loop has the magnitude 1, ascending, with their phase margins.

        The smallest of the phase and delay margins are those of `margins`, if the closed loop is stable.
        """
        return gain_crossovers(self.system, self.dt)

    def phase_crossovers(self) -> list[PhaseCrossover]:
        """All frequencies at which an eigenvalue of the loop is real and negative, ascending, with their gain margins.

        Margins below 0.01 and above 100 are left out.
        """
        return phase_crossovers(self.system, self.dt)

    def disk_margins(self) -> DiskMargins:
        """How far gain and phase may vary at once: for each joint, and for all joints independently."""
        return disk_margins_of(self.system, self.dt, self.is_stable)

    def poles(self) -> ComplexArray:
        """The poles of the closed loop.

        Returns:
            (k,) complex, in the z plane, the largest magnitude first; `numpy.log(poles) / loop.dt` are rates in 1/s.
        """
        return self._poles[np.abs(self._poles).argsort()[::-1]]

    @cached_property
    def _poles(self) -> ComplexArray:
        """Of the closed loop."""
        return np.linalg.eigvals(self._closed.A).astype(np.complex128)

    @property
    def _closed(self) -> StateSpace:
        """The closed loop, from a disturbance at the input of the loop to its output: L / (1 + L)."""
        loop = self.system
        if not loop.D.any():
            return StateSpace(A=loop.A - loop.B @ loop.C, B=loop.B, C=loop.C, D=loop.D)
        left = np.linalg.inv(np.eye(len(loop.D)) + loop.D)
        return StateSpace(
            A=loop.A - loop.B @ left @ loop.C, B=loop.B - loop.B @ left @ loop.D, C=left @ loop.C, D=left @ loop.D
        )

    @property
    def slowest_pole(self) -> float:
        """1/s, the rate with which the slowest error of the closed loop decays; negative if one grows."""
        return -float(np.log(max(np.abs(self._poles).max(initial=0.0), np.finfo(float).tiny))) / self.dt

    @property
    def is_stable(self) -> bool:
        """Whether the closed loop is stable."""
        return bool(np.abs(self._poles).max(initial=0.0) < 1.0)

    def modes(self) -> Array:
        """All modes of the closed loop that oscillate, also those that no joint shows.

        Returns:
            (k, 2) frequency, rad/s, with its damping, and damping ratio of each; the least damped one first.
        """
        return by_damping(self._poles, self.dt)

    def bode(self, w: ArrayLike | None = None) -> Bode:
        """The Bode plot: the loop gain of each joint, with the loops of the other joints closed; `bode().plot()` draws it.

        Args:
            w: (k,) frequencies, rad/s, above 0 and up to pi / dt; by default those at which the margins are searched.

        Raises:
            InputError: A frequency is outside its bounds or not finite.
        """
        w = self._grid(w)
        return bode_of(w, joint_loops(self.system, self._z(w)), self.names)

    def nyquist(self, w: ArrayLike | None = None) -> Nyquist:
        """The Nyquist curve of each joint, with the loops of the other joints closed; `nyquist().plot()` draws it.

        Args:
            w: (k,) frequencies, rad/s, above 0 and up to pi / dt; by default those at which the margins are searched.

        Raises:
            InputError: A frequency is outside its bounds or not finite.
        """
        w = self._grid(w)
        return Nyquist(w=w, curve=joint_loops(self.system, self._z(w)), names=self.names)

    def step_response(self, duration: float | None = None) -> StepResponse:
        """The closed loop L / (1 + L) after a step: the share of a constant disturbance torque that the controller balances.

        For a controller that acts on the error of position and velocity, it is also the response of a joint to a step of its
        reference: overshoot, rise time and settling time are those of textbooks. `step_response().plot()` draws it.

        Args:
            duration: s; by default six time constants of the slowest pole, at most 20 000 control periods.

        Returns:
            The response of each joint to a step on itself.

        Raises:
            InputError: The duration is not positive, or longer than 20 000 control periods.
        """
        return self._step(self._closed, duration, "response to a unit step", "")

    def _step(self, closed: StateSpace, duration: float | None, quantity: str, unit: str) -> StepResponse:
        if duration is None:
            duration = default_step_duration(self.slowest_pole, self.dt)
        duration = number("duration", duration, self.dt, MAX_STEP_TICKS * self.dt * (1 + 1e-9))
        ticks = round(duration / self.dt)
        final = final_value(closed) if self.is_stable else np.full(closed.B.shape[1], np.nan)
        return StepResponse(
            t=frozen(self.dt * np.arange(ticks + 1.0)),
            y=frozen(simulated_step(closed, ticks)),
            final=frozen(final),
            names=self.names,
            quantity=quantity,
            unit=unit,
        )

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
        return np.asarray(np.linalg.inv(np.eye(len(self.names)) + self.transfer(w)), dtype=np.complex128)

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
            raise NotInstalledError.from_extra("to_control needs python-control", "design") from None
        names: dict[str, Any] = {"inputs": list(self.names), "outputs": list(self.names)}
        loop = self.system
        return control.StateSpace(loop.A, loop.B, loop.C, loop.D, self.dt, **names)

    def _grid(self, w: ArrayLike | None) -> Array:
        return frozen(loop_frequencies(self.system, self.dt)) if w is None else vector("w", w)

    def _z(self, w: ArrayLike) -> ComplexArray:
        w = vector("w", w)
        if len(w) and not (w.min() > 0.0 and w.max() <= np.pi / self.dt * (1 + 1e-9)):
            raise InputError(f"w: expected frequencies in (0, {np.pi / self.dt:g}] rad/s, got {w.min():g} to {w.max():g}")
        return np.exp(1j * w * self.dt)


@dataclass(frozen=True, eq=False, repr=False)
class LinearLoop(LoopAnalysis):
    """Any discrete linear loop: x[k + 1] = A x[k] + B u[k], y[k] = C x[k] + D u[k], closed by u = -y.

    For a loop of your own, or one of another program; `armctl.linearize` returns that of an arm and a controller.

    Attributes:
        A: (k, k).
        B: (k, n).
        C: (n, k).
        D: (n, n); 1 + D must be invertible.
        dt: s, the control period.
        names: The n inputs, in plots.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    dt: float
    names: tuple[str, ...] = ()  # type: ignore[assignment]

    def __post_init__(self) -> None:
        matrices = {name: frozen(array(name, getattr(self, name), 2)) for name in ("A", "B", "C", "D")}
        size = len(matrices["A"])
        n = len(matrices["D"])
        for name, shape in {"A": (size, size), "B": (size, n), "C": (n, size), "D": (n, n)}.items():
            if matrices[name].shape != shape:
                raise InputError(
                    f"{name}: expected {shape[0]} x {shape[1]} numbers, got {' x '.join(map(str, matrices[name].shape))}; "
                    "a loop has as many inputs as outputs"
                )
        if np.linalg.matrix_rank(np.eye(n) + matrices["D"]) < n:
            raise InputError("D: 1 + D has no inverse, so the closed loop has no solution")
        names = words("names", self.names) or (("loop",) if n == 1 else tuple(f"loop {i + 1}" for i in range(n)))
        if len(names) != n:
            raise InputError(f"names: expected {n} names, got {len(names)}")
        values = {**matrices, "dt": number("dt", self.dt, 1e-12, _MAX_SAMPLING_TIME_S), "names": names}
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @classmethod
    def from_system(cls, system: object, dt: float | None = None) -> LinearLoop:
        """The loop of a system of another package.

        Args:
            system: A discrete system of python-control or `scipy.signal`, as a state space or a transfer function.
            dt: s, the control period, if the system does not say it.

        Raises:
            InputError: It is no such system, is continuous, or has another number of inputs than outputs.
            NotInstalledError: python-control is not installed.
        """
        state_space: Any = system
        if not all(hasattr(system, name) for name in ("A", "B", "C", "D")):
            state_space = _state_space(system)
        known = getattr(system, "dt", None)
        if isinstance(known, bool):  # python-control: discrete, of a period that is left open
            known = None
        if dt is None and not known:
            raise InputError(
                f"system: expected a discrete system with a control period, got {shown(system)}; give dt, and sample a "
                "continuous system first, as by control.sample_system(system, dt)"
            )
        if known == 0.0 or (type(system).__module__.startswith("scipy.signal") and "Continuous" in type(system).__name__):
            raise InputError(f"system: it is continuous: {shown(system)}; sample it first, as by control.sample_system")
        given = {name: np.asarray(getattr(state_space, name), dtype=float) for name in ("A", "B", "C", "D")}
        size = len(given["A"])
        outputs, inputs = np.atleast_2d(given["D"]).shape
        return cls(
            A=given["A"].reshape(size, size),
            B=given["B"].reshape(size, inputs),
            C=given["C"].reshape(outputs, size),
            D=given["D"].reshape(outputs, inputs),
            dt=float(dt or known or 0.0),
        )

    @property
    def n(self) -> int:
        """The number of inputs, and of outputs."""
        return len(self.D)

    @cached_property
    def system(self) -> StateSpace:  # type: ignore[override]
        """The loop transfer function as one object: `A`, `B`, `C` and `D`."""
        return StateSpace(A=self.A, B=self.B, C=self.C, D=self.D)


def _state_space(system: object) -> Any:
    """A transfer function as a state space, by the package that it is of."""
    package = type(system).__module__.partition(".")[0]
    if package == "scipy" and hasattr(system, "to_ss"):
        return system.to_ss()  # type: ignore[attr-defined]
    if package == "control":
        import control

        return control.ss(system)
    raise InputError(f"system: expected a discrete system of python-control or scipy.signal, got {shown(system)}")


def by_damping(poles: ComplexArray, dt: float) -> Array:
    """(k, 2) frequency and damping ratio of the poles with a positive imaginary part, the least damped one first."""
    rates = np.log(poles[poles.imag > 0.0]) / dt
    modes = np.column_stack([rates.imag, -rates.real / np.abs(rates)])
    return modes[modes[:, 1].argsort()]
