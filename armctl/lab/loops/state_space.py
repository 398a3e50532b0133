"""Discrete linear systems, and the linear model of any controller from its response to impulses."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from armctl import _core
from armctl.control.failure import checked_torque
from armctl.control.interface import Controller, State, has_compiled_law, traits
from armctl.core.errors import InputError, ModelError
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm

ComplexArray = NDArray[np.complex128]

# Size of an impulse. The error of a central difference is of the order of the size squared, that of rounding of its inverse.
_POSITION_IMPULSE = 1e-4  # rad (m)
_VELOCITY_IMPULSE = 1e-3  # rad/s (m/s)
_IMPULSE_SCALES = (1.0, 0.05)  # the smaller one is for controllers that are linear around rest only, such as those that learn
_HORIZONS_TICKS = (16, 128)  # length of an impulse response; the longer one is for controllers with long delay lines
_RANK_TOLERANCE = 1e-7  # of singular values of the scaled Hankel matrix; rounding is below 1e-8
_MAX_MODEL_ERROR = 1e-4  # relative; a controller that differs more from its linear model is not linear around this state


@dataclass(frozen=True, slots=True, eq=False)
class StateSpace:
    """A discrete linear system x[k + 1] = A x[k] + B u[k], y[k] = C x[k] + D u[k]."""

    A: Array  # (k, k)
    B: Array  # (k, inputs)
    C: Array  # (outputs, k)
    D: Array  # (outputs, inputs)

    def response(self, inputs: Array) -> Array:
        """(T, outputs), the outputs for (T, inputs), from rest."""
        outputs = np.empty((len(inputs), len(self.C)))
        x = np.zeros(len(self.A))
        for k, u in enumerate(inputs):
            outputs[k] = self.C @ x + self.D @ u
            x = self.A @ x + self.B @ u
        return outputs

    def transfer(self, z: ComplexArray) -> ComplexArray:
        """(len(z), outputs, inputs), the transfer function C (z - A)^-1 B + D."""
        if not len(self.A):
            return np.broadcast_to(self.D.astype(complex), (len(z), *self.D.shape))
        identity = np.eye(len(self.A))
        B = np.broadcast_to(self.B.astype(complex), (len(z), *self.B.shape))
        return self.C @ np.linalg.solve(z[:, None, None] * identity - self.A, B) + self.D

    def poles(self) -> ComplexArray:
        """(k,) the eigenvalues of A; those at zero may be left out."""
        return np.linalg.eigvals(self.A).astype(np.complex128)


@dataclass(frozen=True, slots=True, eq=False)
class DelayedCascade(StateSpace):
    """A cascade of systems and a delay, whose transfer function and poles do not need the states of the delay."""

    parts: tuple[StateSpace, ...]  # from input to output
    weights: Array  # of the output 0, 1, ... ticks ago

    def transfer(self, z: ComplexArray) -> ComplexArray:
        """As that of any system."""
        found = delay_transfer(self.weights, z)[:, None, None] * self.parts[0].transfer(z)
        for part in self.parts[1:]:
            found = part.transfer(z) @ found
        return found

    def poles(self) -> ComplexArray:
        """As those of any system; those of the delay, at zero, are left out."""
        return np.concatenate([part.poles() for part in self.parts])


def delay_transfer(weights: Array, z: ComplexArray) -> ComplexArray:
    """(len(z),) the transfer function of a weighted mean of a signal 0, 1, ... ticks ago."""
    used = np.flatnonzero(weights)
    return np.asarray(z[:, None] ** -used.astype(float) @ weights[used], dtype=np.complex128)


def linear_controller(arm: Arm, controller: Controller, q: Array, dt: float, continuous: bool) -> StateSpace:
    """The linear model of a controller that holds an arm at q: from measured positions and velocities (2n) to torques (n).

    Those of deflections follow, if it needs them. The model follows from responses of a copy to impulses, after
    Ho and Kalman (1966) in the balanced form of Kung (1978), and is compared with the controller on a random signal.
    """
    if has_compiled_law(controller, arm.n) and not controller.needs_wrench:
        law = controller.make_law(dt, continuous)
        run = _compiled_runs(law, q)
        if not law.memory.size:
            return _static(run, arm.n)
    else:
        run = _runs(arm, controller, q, dt, continuous)
    error = np.inf
    for horizon, scale in product(_HORIZONS_TICKS, _IMPULSE_SCALES):
        sides = 2 if traits(controller).needs_deflection else 1
        sizes = scale * np.tile(np.repeat([_POSITION_IMPULSE, _VELOCITY_IMPULSE], arm.n), sides)
        responses = _impulse_responses(run, sizes, horizon, arm.n)
        if not np.isfinite(responses).all():
            raise ModelError(
                f"{traits(controller).name:.80}: its torque after a small impulse is not finite; give smaller gains"
            )
        model = _realization(responses)
        error = _model_error(run, model, sizes, 3 * horizon)
        if error <= _MAX_MODEL_ERROR:
            return model
    raise ModelError(
        f"{traits(controller).name:.80}: no linear model describes this controller at rest (relative error {error:.1g}); "
        "its torque jumps, varies with time or is random"
    )


def _static(run: _Run, n: int) -> StateSpace:
    sizes = np.repeat([_POSITION_IMPULSE, _VELOCITY_IMPULSE], n)
    rows = run(np.vstack([np.diag(sizes), -np.diag(sizes)]))
    difference = rows[: len(sizes)] - rows[len(sizes) :]
    nothing = np.zeros((0, 0))
    return StateSpace(A=nothing, B=np.zeros((0, 2 * n)), C=np.zeros((n, 0)), D=(difference / (2 * sizes[:, None])).T)


_Run = Callable[[Array], Array]


def _runs(arm: Arm, controller: Controller, q: Array, dt: float, continuous: bool) -> _Run:
    """A function that returns the torques (T, n) for deviations (T, 2n) of the measured state, each time from a fresh start."""
    n = arm.n
    rest = np.zeros(n)
    setpoint = Setpoint(q, rest, rest, rest, rest)

    def torques(law: Controller, deviations: Array) -> Array:
        rows = np.empty((len(deviations), n))
        for k, deviation in enumerate(deviations):
            springs = deviation[2 * n :].reshape(-1, n) if len(deviation) > 2 * n else None
            state = State(q + deviation[:n], deviation[n : 2 * n].copy(), k * dt, dt, continuous, None, springs)
            try:
                rows[k] = checked_torque(law.torque(state, setpoint), n)
            except Exception as error:
                name = traits(law).name
                raise ModelError(
                    f"{name:.80}: the controller failed at q = {q.round(3).tolist()!s:.80}: {error!s:.80}"
                ) from error
        return rows

    shared = {id(arm): arm}  # a copy of an arm takes long, and no controller changes it
    try:
        original = copy.deepcopy(controller, dict(shared))
    except Exception:
        original = None
    law = controller if original is None else copy.deepcopy(original, dict(shared))
    probe = np.full((4, 4 * n), _POSITION_IMPULSE)
    if np.array_equal(torques(law, probe), torques(law, probe)):
        return lambda deviations: torques(law, deviations)
    if original is None:
        raise InputError(
            f"{traits(controller).name:.80}: the controller keeps its memory when state.t starts again at 0, and cannot be "
            "copied; reset the memory if state.t is not one state.dt later than in the previous call"
        )
    return lambda deviations: torques(copy.deepcopy(original, dict(shared)), deviations)


def _compiled_runs(law: _core.Law, q: Array) -> _Run:
    """As `_runs`, for a compiled law."""
    n = law.n
    reference = np.zeros((5, n))
    reference[0] = q
    no_wrench = np.zeros(0)

    def torques(deviations: Array) -> Array:
        positions = q + deviations[:, :n]
        velocities = deviations[:, n:].copy()
        rows = np.empty((len(deviations), n))
        law.reset()
        for position, velocity, tau in zip(positions, velocities, rows, strict=True):
            law.torque(position, velocity, reference, no_wrench, tau)
        return rows

    return torques


def _impulse_responses(run: _Run, sizes: Array, horizon: int, n: int) -> Array:
    """(horizon, n, 2n or 4n), the torques after an impulse in each measured signal, divided by its size."""
    warm_up = horizon // 2  # until the first ticks after a start, which are different, have passed
    responses = np.empty((horizon, n, len(sizes)))
    for column, size in enumerate(sizes):
        deviations = np.zeros((warm_up + horizon, len(sizes)))
        deviations[warm_up, column] = size
        difference = run(deviations) - run(-deviations)
        responses[:, :, column] = difference[warm_up:] / (2 * size)
    return responses


def _realization(responses: Array) -> StateSpace:
    """The smallest system with these impulse responses (horizon, outputs, inputs)."""
    horizon, outputs, inputs = responses.shape
    # All signals are scaled to the same size, so that one tolerance decides on the order.
    by_output = 1 / np.maximum(np.abs(responses).max(axis=(0, 2)), np.finfo(float).tiny)
    by_input = 1 / np.maximum((np.abs(responses) * by_output[:, None]).max(axis=(0, 1)), np.finfo(float).tiny)
    scaled = responses * by_output[:, None] * by_input
    blocks = (horizon - 1) // 2
    rows = np.arange(blocks)[:, None]
    columns = np.arange(blocks)
    hankel = scaled[1 + rows + columns].transpose(0, 2, 1, 3).reshape(blocks * outputs, blocks * inputs)
    shifted = scaled[2 + rows + columns].transpose(0, 2, 1, 3).reshape(blocks * outputs, blocks * inputs)
    U, sizes, V = np.linalg.svd(hankel, full_matrices=False)
    order = int((sizes > _RANK_TOLERANCE).sum())
    root = np.sqrt(sizes[:order])
    observability = U[:, :order] * root
    reachability = root[:, None] * V[:order]
    A = (U[:, :order] / root).T @ shifted @ (V[:order].T / root)
    return StateSpace(
        A=A, B=reachability[:, :inputs] / by_input, C=observability[:outputs] / by_output[:, None], D=responses[0].copy()
    )


def _model_error(run: _Run, model: StateSpace, sizes: Array, ticks: int) -> float:
    """The largest difference of controller and model on random signals of these sizes, relative to the largest torque."""
    warm_up = ticks // 6
    rng = np.random.default_rng(0)
    deviations = np.zeros((warm_up + ticks, len(sizes)))
    deviations[warm_up:] = sizes * rng.uniform(-1.0, 1.0, (ticks, len(sizes)))
    measured = 0.5 * (run(deviations) - run(-deviations))[warm_up:]
    predicted = model.response(deviations[warm_up:])
    size = np.abs(measured).max(axis=0)
    return float((np.abs(measured - predicted).max(axis=0) / np.maximum(size, np.finfo(float).tiny)).max())
