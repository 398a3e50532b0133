"""The frequency responses of all joints from a recording of a multisine, with bounds."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.filtering import MAX_NYQUIST_SHARE
from armctl.core.log import Log, LogTorques
from armctl.core.validation import Array, instance
from armctl.lab.identification.arm_excitation import Excitation, Multisine
from armctl.lab.loops.linearization import WHOLE_TICK_TOLERANCE
from armctl.lab.loops.loop import Loop
from armctl.lab.loops.state_space import ComplexArray, delay_transfer

OF = ("plant", "closed loop", "sensitivity")
_RISK = 0.05  # that the true response is outside the bounds
MIN_FREEDOM = 4  # periods more than joints


class RecordedResponse(NamedTuple):
    """As the attributes of `FrequencyResponse`."""

    frequency: Array
    measured: ComplexArray
    bound: Array
    predicted: ComplexArray
    coherence: Array


class _ResponseEstimate(NamedTuple):
    """A response matrix (k, n, n) with the bounds of its elements, and the coherence (k, n) of its outputs."""

    response: ComplexArray
    bound: Array
    coherence: Array


class _Spectra(NamedTuple):
    """Signals at the excited lines, each (k, n, M): n joints that move, M periods."""

    reference: ComplexArray  # of the motion
    position: ComplexArray  # measured
    torque: ComplexArray  # commanded; the torque at the motors if commands were not recorded


def bound_factor(freedom: int) -> float:
    """Squared radius of a circle of 95 % over the variance of a response, by Fisher's distribution with 2, 2 `freedom`."""
    return float(freedom * (_RISK ** (-1 / freedom) - 1))


def recorded_response(
    log: Log, motion: Excitation, index: int, of: str, loop: Loop | None, positions: ArrayLike | None
) -> RecordedResponse:
    """The response of one joint. Arguments as for `FrequencyResponse.from_log`, but for the index of the joint."""
    multisine = _multisine(log, motion, index)
    z = np.exp(2j * np.pi * multisine.lines / multisine.period * log.dt)
    joints = list(multisine.joints)
    column = joints.index(index)
    seen = _positions(log, positions)
    spectra = _spectra(log, motion, multisine, seen)
    if of == "closed loop":
        found = _estimate(spectra.position, spectra.reference, spectra.reference)
    elif not np.isfinite(spectra.torque).all():
        raise InputError("log: it has no torques, so only of='closed loop' can be measured")
    elif of == "plant":
        found = _estimate(spectra.position, spectra.torque, spectra.reference)
    else:
        moved = _transformed(multisine, log.dt, seen)
        disturbance = spectra.torque - (_feedback(log, _checked_loop(loop, log), z) @ moved)[:, joints]
        found = _estimate(spectra.torque, disturbance, spectra.reference)
    predicted = np.full(len(z), np.nan, dtype=complex)
    if loop is not None and of != "closed loop":
        is_late = log.torques is not LogTorques.MEASURED
        predicted = _predicted(_checked_loop(loop, log), multisine, of, is_late)[:, column, column]
    return RecordedResponse(
        frequency=np.asarray(2 * np.pi * multisine.lines / multisine.period, dtype=np.float64),
        measured=found.response[:, column, column],
        bound=found.bound[:, column, column],
        predicted=predicted,
        coherence=found.coherence[:, column],
    )


def _multisine(log: Log, motion: Excitation, index: int) -> Multisine:
    """The periods of a motion that a log contains, and the lines below its Nyquist frequency."""
    instance("motion", motion, Excitation, "armctl.excitation(arm, for_='frequency') gives one")
    multisine = motion.multisine
    if multisine is None:
        raise InputError(f"motion: it excites the {motion.excites}; armctl.excitation(arm, for_='frequency') gives another one")
    if log.q.shape[1] != motion.n or index not in multisine.joints:
        moving = ", ".join(motion.joint_names[i] for i in multisine.joints)
        raise InputError(f"joint: the motion of {motion.n} joints moves {moving:.80}; the log has {log.q.shape[1]} joints")
    ticks = multisine.period / log.dt
    if abs(ticks - round(ticks)) > WHOLE_TICK_TOLERANCE * ticks:
        raise InputError(f"log: its interval of {log.dt:g} s must divide the period of {multisine.period:g} s")
    starts = multisine.starts[multisine.starts + multisine.period <= (len(log) - 1) * log.dt]
    if len(starts) < len(multisine.joints) + MIN_FREEDOM:
        raise InputError(f"log: it contains {len(starts)} periods, at least {len(multisine.joints) + MIN_FREEDOM} are needed")
    lines = multisine.lines[multisine.lines <= MAX_NYQUIST_SHARE * 0.5 * ticks]
    return Multisine(joints=multisine.joints, period=multisine.period, starts=starts, lines=lines)


def _positions(log: Log, positions: ArrayLike | None) -> Array:
    seen = log.q if positions is None else np.asarray(positions, dtype=np.float64)
    if seen.shape != log.q.shape or not np.isfinite(seen).all():
        raise InputError(f"positions: expected finite numbers, {len(log)} x {log.q.shape[1]}, as the log's, got {seen.shape}")
    return seen


def _transformed(multisine: Multisine, dt: float, samples: Array) -> ComplexArray:
    """(k, n, M) the spectrum of samples (T, n) in each period, without what all share, such as drift and gravity."""
    ticks = round(multisine.period / dt)
    first = np.ceil(multisine.starts / dt - WHOLE_TICK_TOLERANCE).astype(int)
    windows = np.array([samples[start : start + ticks] for start in first])
    spectrum = np.fft.rfft(windows - windows.mean(axis=0), axis=1)
    return spectrum[:, multisine.lines].transpose(1, 2, 0)


def _spectra(log: Log, motion: Excitation, multisine: Multisine, seen: Array) -> _Spectra:
    reference = motion.sample(log.dt * np.arange(len(log), dtype=np.float64)).q
    torque = log.tau_cmd if np.isfinite(log.tau_cmd).all() else log.tau
    joints = list(multisine.joints)
    return _Spectra(*[_transformed(multisine, log.dt, samples[:, joints]) for samples in (reference, seen, torque)])


def _estimate(output: ComplexArray, given: ComplexArray, instrument: ComplexArray) -> _ResponseEstimate:
    """The response matrix from `given` to `output`, each (k, n, M), with a signal without noise that excites both."""
    adjoint = instrument.conj().transpose(0, 2, 1)
    try:
        weights = adjoint @ np.linalg.inv(given @ adjoint)
    except np.linalg.LinAlgError:
        raise InputError("log: a joint did not move or had no torque; record the motion again, or excite one joint") from None
    response = output @ weights
    freedom = output.shape[2] - output.shape[1] - 1  # one mean was subtracted
    variance = (np.abs(output - response @ given) ** 2).sum(axis=2) / freedom
    of_elements = variance[:, :, None] * (np.abs(weights) ** 2).sum(axis=1)[:, None, :]
    coherence = 1 - variance / np.maximum((np.abs(output) ** 2).mean(axis=2), np.finfo(float).tiny)
    return _ResponseEstimate(response, np.sqrt(bound_factor(freedom) * of_elements), np.clip(coherence, 0.0, 1.0))


def _checked_loop(loop: Loop | None, log: Log) -> Loop:
    if loop is None:
        raise InputError("loop: a sensitivity needs the law; armctl.linearize(arm, controller, q) gives the loop")
    instance("loop", loop, Loop, "armctl.linearize(arm, controller, q) gives one")
    if loop.n != log.q.shape[1] or abs(loop.dt - log.dt) > WHOLE_TICK_TOLERANCE * log.dt:
        raise InputError(
            f"loop: it has {loop.n} joints and a period of {loop.dt:g} s, the log {log.q.shape[1]} and {log.dt:g} s; "
            "linearize with the timestep of the recording"
        )
    return loop


def _feedback(log: Log, loop: Loop, z: ComplexArray) -> ComplexArray:
    """(k, n, n) from measured positions to the torques of the law, with velocities that are differences of positions."""
    law = loop._law.transfer(z)
    if law.shape[2] != 2 * loop.n:
        raise InputError(f"loop: {loop.controller:.60} measures deflections, which are not recorded; measure the plant instead")
    return law[:, :, : loop.n] + law[:, :, loop.n :] * ((1 - 1 / z) / log.dt)[:, None, None]


def _predicted(loop: Loop, multisine: Multisine, of: str, is_late: bool) -> ComplexArray:
    """(k, n, n) for the joints that move, the loops of the others closed. Late torques are commands, before the delay."""
    w = 2 * np.pi * multisine.lines / multisine.period
    z = np.exp(1j * w * loop.dt)
    sensitivity = loop.sensitivity(w)
    joints = np.ix_(range(len(z)), multisine.joints, multisine.joints)
    if of == "sensitivity":
        return sensitivity[joints]
    late = delay_transfer(loop.delay_weights if is_late else loop._lag, z)
    plant = loop._arm.transfer(z)[:, : loop.n] * late[:, None, None]
    if len(multisine.joints) == loop.n:
        return plant
    return (plant @ sensitivity)[joints] @ np.linalg.inv(sensitivity[joints])
