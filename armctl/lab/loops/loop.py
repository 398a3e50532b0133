"""Loop: an arm and a controller around a configuration, as a discrete linear system."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.plotting import finish_axes
from armctl.core.validation import Array, IntArray, flag, integer, number
from armctl.lab.loops.linear_loop import LoopAnalysis, by_damping
from armctl.lab.loops.loop_figures import LOOP_PANELS, LOOP_SIZE_INCHES, draw_loop_panels, loop_layout
from armctl.lab.loops.loop_responses import StepResponse
from armctl.lab.loops.stability import CoarseMargins, coarse_grid, coarse_margins, coarse_margins_near
from armctl.lab.loops.state_space import ComplexArray, DelayedCascade, StateSpace, delay_transfer

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MAX_DELAY_TICKS = 200
# A mode counts if a step of torque on a joint makes that joint ring with this share of its displacement: what rings less, as
# modes far above the bandwidth do, is not seen in the motion. In simulations of elastic joints, ten swings of more than 2 % of
# the displacement follow from modes that count with a damping ratio below `MIN_DAMPING_RATIO`.
_MIN_RINGING_SHARE = 0.05
_STEP_LEVELS = 12  # of the step response, whose samples lie twice as far apart in each
_STEPS_PER_LEVEL = 16
_MAX_DOUBLINGS = 60  # of the time over which noise is added up
_LEAST_SHARE = 1e-14  # of a variance; less is not added any more


class Mode(NamedTuple):
    """A vibration of a closed loop."""

    damping_ratio: float
    frequency: float  # rad/s, with its damping

    def __str__(self) -> str:
        return f"{self.frequency / (2 * np.pi):.3g} Hz with a damping ratio of {self.damping_ratio:.2g}"


@dataclass(frozen=True, eq=False, repr=False)
class Loop(LoopAnalysis):
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
    _arm: StateSpace  # from torques that act to what is measured, without the delays of `_lag`
    _lag: Array  # weights of a torque 0, 1, ... ticks ago: the delays between motors and controller besides `delay`
    _push: Array
    _position: Array
    _law: StateSpace
    _tip_jacobian: Array
    # (3, n) standard deviations: of positions that velocities are differenced from, of other positions, and of velocities
    _noise: Array

    @property
    def n(self) -> int:
        """The number of joints."""
        return len(self.joint_names)

    @property
    def names(self) -> tuple[str, ...]:
        """The joints."""
        return self.joint_names

    @property
    def title(self) -> str:
        """Arm, controller and plant, in words."""
        return f"{self.robot}, {self.controller}, {self.plant}"

    def _summary(self) -> dict[str, str]:
        return {"q": f"{self.q.round(3).tolist()!s:.120}", "delay": f"{self.delay} ticks"} | super()._summary()

    @property
    def A(self) -> Array:
        """(k, k), the matrix of the state.

        The state is that of the arm, positions and velocities first, what its sensors keep, the memory of the controller, and
        the delayed torques. A delay that all sensors or all actuators of the plant have is one of the torques, too.
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

    @property
    def delay_weights(self) -> Array:
        """(k,), the weights of the controller's torque 0, 1, ... ticks ago in what the loop feeds back: those of all delays."""
        return np.concatenate([np.zeros(self.delay), self._lag])

    @cached_property
    def system(self) -> StateSpace:  # type: ignore[override]
        """The loop transfer function as one object: `A`, `B`, `C` and `D`."""
        n = self.n
        moving = len(self._arm.A)
        memory = moving + len(self._law.A)
        weights = self.delay_weights
        size = memory + (len(weights) - 1) * n
        A = np.zeros((size, size))
        A[:moving, :moving] = self._arm.A
        A[moving:memory, :moving] = self._law.B @ self._arm.C
        A[moving:memory, moving:memory] = self._law.A
        stage = np.zeros((n, size))
        stage[:, :moving] = -self._law.D @ self._arm.C
        stage[:, moving:memory] = -self._law.C
        output = weights[0] * stage
        for weight in weights[1:]:  # each tick of delay stores the output of the stage before it
            A[memory : memory + n] = stage
            stage = np.zeros((n, size))
            stage[:, memory : memory + n] = np.eye(n)
            output += weight * stage
            memory += n
        B = np.zeros((size, n))
        B[:moving] = self._arm.B
        law = replace(self._law, C=-self._law.C, D=-self._law.D)
        return DelayedCascade(A=A, B=B, C=output, D=np.zeros((n, n)), parts=(self._arm, law), weights=weights)

    def vibrations(self) -> Array:
        """Those modes of the closed loop that a load on a joint excites and that move the joint.

        A mode counts if it rings with at least 5 % of the displacement after a step of torque on some joint.

        Returns:
            (k, 2) frequency, rad/s, with its damping, and damping ratio of each; the least damped one first. A damping ratio
            below 0.1 is a vibration that one sees.
        """
        from scipy.linalg import eig

        closed = self.A - self.B @ self.C
        push = np.pad(self._push, ((0, len(closed) - len(self._push)), (0, 0)))
        position = np.pad(self._position, ((0, 0), (0, len(closed) - self._position.shape[1])))
        poles, left, right = eig(closed, left=True, right=True)  # type: ignore[misc]
        # The part of a mode in the step response of each joint: modal analysis, as in Kailath, Linear Systems (1980), 1.2.
        is_mode = poles.imag > 0.0
        left = left[:, is_mode].conj()
        right = right[:, is_mode]
        norms = (left * right).sum(axis=0) * (1 - poles[is_mode])
        ringing = np.abs((position @ right).T * (push.T @ left).T / norms[:, None])
        share = (2 * ringing / _largest_displacement(closed, push, position)).max(axis=1)
        return by_damping(poles[is_mode][share >= _MIN_RINGING_SHARE], self.dt)

    def least_damped(self) -> Mode:
        """The first one of `vibrations`; its damping ratio is infinite if there is none, and 0 if the loop is unstable."""
        if not self.is_stable:
            return Mode(0.0, np.nan)
        modes = self.vibrations()
        return Mode(float(modes[0, 1]), float(modes[0, 0])) if len(modes) else Mode(np.inf, np.nan)

    def chatter(self, encoder_noise: float | None = None) -> Array:
        """The torque noise that the sensors of the plant cause: what `Report.chatter_nm` is of a run.

        The step of an encoder counts as white noise (step^2 / 12; Widrow, Kollar, Quantization Noise, 2008). It is that while
        the speed varies: simulated chatter is within a third of this. At constant speed its steps are periodic, and the
        chatter is down to a third. At rest it is none within a step, or up to three times as much between two steps.

        Args:
            encoder_noise: rad, of an encoder instead of the plant's sensors, with differenced velocities.

        Returns:
            (n,) N m, root mean square difference of each torque from the mean of its two neighbours in time; infinite if the
            closed loop is unstable.

        Raises:
            InputError: The noise is negative or not finite.
        """
        n = self.n
        noise = self._noise
        if encoder_noise is not None:
            noise = np.outer([number("encoder_noise", encoder_noise, 0.0), 0.0, 0.0], np.ones(n))
        if not noise.any():
            return np.zeros(n)
        if not self.is_stable:
            return np.full(n, np.inf)
        differenced, position, velocity = map(np.diag, noise)
        nothing = np.zeros((n, n))
        signals = len(self._arm.C)
        added = np.zeros((signals, 3 * n))  # of the measurements, by the noise of this tick
        added[: 2 * n] = np.block([[differenced, position, nothing], [differenced / self.dt, nothing, velocity]])
        before = np.zeros((signals, n))
        before[n : 2 * n] = -differenced / self.dt
        # The states are those of the loop, with the noise of the last tick. Torque acts on the arm, and minus it is delayed.
        system = self.system
        moving = len(self._arm.A)
        memory = moving + len(self._law.A)
        by_torque = np.zeros((len(system.A), n))
        weights = self.delay_weights
        by_torque[:moving] = weights[0] * self._arm.B
        by_torque[memory : memory + n] = -np.eye(n) if len(weights) > 1 else 0.0
        by_measurement = by_torque @ self._law.D
        by_measurement[moving:memory] += self._law.B
        A = np.block([[system.A - system.B @ system.C, by_measurement @ before], [np.zeros((n, len(system.A) + n))]])
        B = np.vstack([by_measurement @ added, np.eye(n, 3 * n)])
        rest = np.zeros((n, len(system.A) - memory))
        C = np.hstack([self._law.D @ self._arm.C, self._law.C, rest, self._law.D @ before])
        D = self._law.D @ added
        covariance = _covariance(A, B @ B.T)
        with_state = A @ covariance @ C.T + B @ D.T
        of_lags = [C @ covariance @ C.T + D @ D.T, C @ with_state, C @ A @ with_state]
        variance = np.array([1.5, -2.0, 0.5]) @ [lag.diagonal() for lag in of_lags]
        return np.sqrt(np.maximum(variance, 0.0))

    def load_response(self, duration: float | None = None) -> StepResponse:
        """The displacement of each joint after a step of torque on its link: how a load moves it, and whether it returns.

        Args:
            duration: s; by default six time constants of the slowest pole, at most 20 000 control periods.

        Returns:
            The response in rad/(N m), of a slide joint in m/N.

        Raises:
            InputError: The duration is not positive, or longer than 20 000 control periods.
        """
        size = len(self.A)
        push = np.pad(self._push, ((0, size - len(self._push)), (0, 0)))
        position = np.pad(self._position, ((0, 0), (0, size - self._position.shape[1])))
        closed = StateSpace(A=self.A - self.B @ self.C, B=push, C=position, D=np.zeros((self.n, self.n)))
        return self._step(closed, duration, "displacement after a step of load", "rad/(N m)")

    def coarse_margins(self) -> CoarseMargins:
        """The margins of single eigenvalues and joints, accurate to 1 % in a fraction of the time."""
        return coarse_margins_with(coarse_plant(self), self)

    @property
    def has_static_law(self) -> bool:
        """Whether the controller has no memory."""
        return not len(self._law.A)

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
        arm = StateSpace(A=self._arm.A, B=inputs, C=outputs, D=np.zeros((len(outputs), 2 * n))).transfer(z)
        law = self._law.transfer(z) * delay_transfer(self.delay_weights, z)[:, None, None]
        signals = len(self._arm.C)
        seen = np.linalg.solve(np.eye(signals) - arm[:, :signals, :n] @ law, arm[:, :signals, n:])
        closed = arm[:, signals:, n:] + arm[:, signals:, :n] @ law @ seen
        return np.asarray(closed, dtype=np.complex128)

    def plot(
        self,
        path: str | os.PathLike[str] | None = None,
        *,
        size: tuple[float, float] | None = None,
        title: bool = True,
        ax: Sequence[Axes] | None = None,
    ) -> Path | None:
        """Draws loop gain, phase, Nyquist curve, step response and sensitivity of each joint, and the compliance of the tip.

        Args:
            path: The picture, .png, .svg or .pdf; its folder is made, and the file is written atomically. Left out, a window
                opens.
            size: Width and height in inches.
            title: Whether arm, controller and plant stand above the panels; False where a caption says it.
            ax: Six axes of matplotlib to draw into instead: loop gain, Nyquist curve, sensitivity, phase, step response and
                compliance.

        Raises:
            InputError: The path has another ending, or the axes are not six.
            ArmctlError: The file cannot be written.
            NotInstalledError: There is no screen for a window.
        """
        layout = loop_layout(self, title=flag("title", title))
        return finish_axes(lambda axes: draw_loop_panels(axes, self), LOOP_PANELS, size or LOOP_SIZE_INCHES, path, ax, layout)


def _largest_displacement(A: Array, push: Array, position: Array) -> Array:
    """(n,) the largest displacement of each joint after a step of torque on it."""
    x = np.zeros_like(push)
    largest = np.full(push.shape[1], np.finfo(float).tiny)
    for _ in range(_STEP_LEVELS):
        for _ in range(_STEPS_PER_LEVEL):
            x = A @ x + push
            largest = np.maximum(largest, np.abs((position * x.T).sum(axis=1)))
        push = A @ push + push
        A = A @ A
    return largest


def _covariance(A: Array, Q: Array) -> Array:
    """The sum of A^k Q A^k^T: of the state of a stable system that white noise with the covariance Q drives.

    By doubling (Smith, Matrix equation XA + BX = C, 1968), which does not depend on the units of the states.
    """
    covariance = Q
    for _ in range(_MAX_DOUBLINGS):
        later = A @ covariance @ A.T
        covariance = covariance + later
        if (np.abs(later.diagonal()) <= _LEAST_SHARE * covariance.diagonal()).all():
            break
        A = A @ A
    return covariance


def coarse_margins_with(plant: ComplexArray, loop: Loop) -> CoarseMargins:
    """`Loop.coarse_margins`, where the `coarse_plant` of its arm is known."""
    return coarse_margins(loop.system, coarse_grid(loop.dt), _coarse_transfer(plant, loop, slice(None)))


def coarse_margins_around(plant: ComplexArray, loop: Loop, others: Sequence[Loop]) -> list[CoarseMargins]:
    """Those of the same arm with laws that are nearly the same, to first order."""
    decisive = coarse_margins_with(plant, loop).decisive
    transfer = _coarse_transfer(plant, loop, decisive)
    changes = np.array([_coarse_transfer(plant, each, decisive) - transfer for each in others])
    return coarse_margins_near(coarse_grid(loop.dt)[decisive], transfer, changes)


def _coarse_transfer(plant: ComplexArray, loop: Loop, points: IntArray | slice) -> ComplexArray:
    z = np.exp(1j * coarse_grid(loop.dt)[points] * loop.dt)
    return np.asarray(-(loop._law.transfer(z) @ plant[points]), dtype=np.complex128)


def coarse_plant(loop: Loop) -> ComplexArray:
    """The transfer function of arm and delay from torques to measured positions and velocities, on `coarse_grid`."""
    z = np.exp(1j * coarse_grid(loop.dt) * loop.dt)
    return loop._arm.transfer(z) * delay_transfer(loop.delay_weights, z)[:, None, None]
