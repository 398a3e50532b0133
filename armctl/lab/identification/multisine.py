"""Multisine: a motion of all joints at once from which frequency responses are measured."""

from dataclasses import replace

import numpy as np

from armctl.core.errors import InputError, PlanError
from armctl.core.filtering import MAX_NYQUIST_SHARE
from armctl.core.validation import Array, IntArray, integer
from armctl.lab.identification.arm_excitation import (
    CLEARANCE_M,
    NOT_PROVED,
    TORQUE_SHARE,
    Excitation,
    Multisine,
    excitation_along,
)
from armctl.lab.identification.recorded_response import MIN_FREEDOM
from armctl.model.arm.arm import Arm
from armctl.model.collision.checkers import collision_checker
from armctl.model.collision.clearance import clearance_of
from armctl.plan.motion.torque_limits import check_torque
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.piecewise import JointSamples, hermite, sample

MULTISINE_PERIOD_S = 2.0  # its inverse is the resolution in Hz
_PERIODS = 3  # with each set of phases: the transient decays in the first ones, the last is measured
_FREEDOM = 8  # sets of phases besides one for each joint, by default; the bounds of the response follow from them
_MAX_SETS = 1000
MULTISINE_LINES = 60
MIN_FREQUENCY_HZ = 1.0
_MAX_FREQUENCY_HZ = 80.0  # links of arms are no rigid bodies above
_KNOTS_PER_PERIOD = 6  # of the highest frequency: quintic pieces are then accurate to 1e-5 of the amplitude
_TURN_S = 1.0  # between two sets of phases
# All joints drift, so that none turns in a measured period: dry friction is then constant.
_DRIFT_SPEED = 0.05  # rad/s (m/s)
_MIN_DRIFT_SPEED = 0.002
_SHARE_OF_DRIFT = 0.5  # of the speed of the multisine
_SHARE_OF_ROOM = 0.4
_CORNER_HZ = 10.0  # the amplitude of the velocity is constant below, that of the acceleration above
_RESERVE = 0.98  # of the limits, for what happens between samples
_FACTORS = (1.0, 0.7, 0.5, 0.3, 0.2, 0.1, 0.05)  # of the size, tried one after another


def multisine_excitation(
    arm: Arm, duration: float | None, speed: float, seed: int, start: Array | None, joint: int | str | None
) -> Excitation:
    """A motion of joints around a configuration in odd harmonics, as large as the limits permit and proved free.

    Joints drift through it again and again. Their phases turn from period to period, so that they are orthogonal: Pintelon and
    Schoukens, System Identification: A Frequency Domain Approach (2012), 2.7 and 3.7.
    """
    q = arm.limits.clamp(arm.home) if start is None else start
    joints = tuple(range(arm.n)) if joint is None else (joint_index(arm.joint_names, joint),)
    block = _PERIODS * MULTISINE_PERIOD_S
    sets = len(joints) + _FREEDOM if duration is None else min(int((duration - _TURN_S) / block), _MAX_SETS)
    shortest = (len(joints) + MIN_FREEDOM) * block + _TURN_S
    if sets < len(joints) + MIN_FREEDOM:
        raise InputError(f"duration: expected at least {shortest:g} s for {len(joints)} joints, got {duration:g} s")
    highest = min(_MAX_FREQUENCY_HZ, MAX_NYQUIST_SHARE * 0.5 / arm.dt)
    lines = odd_lines(highest, MULTISINE_PERIOD_S)
    spacing = _TURN_S / np.ceil(_TURN_S * _KNOTS_PER_PERIOD * highest)
    times = spacing * np.arange(round((sets * block + _TURN_S) / spacing) + 1)
    room = np.minimum(arm.limits.q_max - q, q - arm.limits.q_min)[list(joints)].clip(0.0)
    drift: Array = np.minimum(_DRIFT_SPEED, _SHARE_OF_ROOM * room)
    if not (drift > _MIN_DRIFT_SPEED).all():
        name = arm.joint_names[joints[int(drift.argmin())]]
        raise PlanError(f"{arm.name:.80}: {name:.60} has no room to move at q = {np.round(q, 3)}; choose another start")
    unit = _unit_motion(times, lines, sets, len(joints), np.random.default_rng(seed))
    starts: Array = block * np.arange(1.0, sets + 1) - MULTISINE_PERIOD_S
    multisine = Multisine(joints=joints, period=MULTISINE_PERIOD_S, starts=starts, lines=lines)
    size = _largest_size(arm, joints, unit, spacing, drift, speed)
    direction = (-1.0) ** np.arange(len(joints))  # of the drift: some responses would change more if all were the same
    slow_drift = sample(hermite(*_drift(sets, direction * drift)), times)
    checker = collision_checker(arm)
    checker.require_provable_among_obstacles()
    reason = ""
    for factor in _FACTORS:
        samples = [np.zeros((len(times), arm.n)) for _ in unit]
        for rows, each, slow in zip(samples, unit, slow_drift, strict=True):
            rows[:, joints] = factor * (size * each + slow)
        samples[0] += q
        motion = JointTrajectory(*hermite(times, *samples), arm.joint_names, arm.limits, units=arm.units)
        limits = motion.check_limits()
        torque = check_torque(arm, motion)
        if not limits.ok or torque.ratio > TORQUE_SHARE:
            reason = str(limits.violations[0]) if not limits.ok else str(torque)
            continue
        clearance = clearance_of(checker, motion, CLEARANCE_M)
        if clearance:
            proved = NOT_PROVED if checker.not_checkable else clearance.distance
            found = excitation_along(motion, "frequency", float("nan"), proved)
            return replace(found, multisine=multisine)
        reason = clearance.reason
    raise PlanError(f"{arm.name:.80}: no multisine around q = {np.round(q, 3)} is safe: {reason:.200}")


def joint_index(names: tuple[str, ...], joint: int | str) -> int:
    if isinstance(joint, str):
        if joint not in names:
            raise InputError(f"joint: there is no joint {joint!r:.80}; there are {', '.join(names):.200}")
        return names.index(joint)
    return integer("joint", joint, 0, len(names) - 1)


def odd_lines(highest: float, period: float) -> IntArray:
    """About geometric odd multiples of 1 / period, from 1 Hz to the highest frequency in Hz."""
    odd = np.arange(int(MIN_FREQUENCY_HZ * period) // 2 * 2 + 1, int(highest * period) + 1, 2)
    wanted = np.geomspace(odd[0], odd[-1], MULTISINE_LINES)
    return np.unique(odd[np.abs(wanted[:, None] - odd).argmin(axis=1)])


def _unit_motion(times: Array, lines: IntArray, sets: int, joints: int, rng: np.random.Generator) -> JointSamples:
    """Oscillations (T, joints) whose velocity has the amplitude 1 at low frequencies, from rest to rest."""
    w = 2 * np.pi * lines / MULTISINE_PERIOD_S
    amplitudes = 1 / (w * (1 + w / (2 * np.pi * _CORNER_HZ)))
    # The same random phases for all sets, but for a turn by which joints are orthogonal, and one for each set.
    turn = 2 * np.pi * np.arange(sets)[:, None, None] * np.arange(joints)[:, None] / sets
    phases = rng.uniform(0, 2 * np.pi, (1, joints, len(w))) + turn + rng.uniform(0, 2 * np.pi, (sets, 1, len(w)))
    count = round(MULTISINE_PERIOD_S / times[1])
    rotating = np.exp(1j * w * times[:count, None])
    waves = [np.zeros((3, count, joints))]
    for phase in phases:
        derivatives = [((1j * w) ** k * amplitudes)[:, None] * np.exp(1j * phase.T) for k in range(3)]
        waves.append(np.array([(rotating @ each).real for each in derivatives]))
    waves.append(waves[0])
    rows = np.empty((3, len(times), joints))
    block = _PERIODS * MULTISINE_PERIOD_S
    which = np.minimum((times + 1e-9) // block, sets).astype(int)
    column = np.arange(len(times)) % count
    old = np.array([waves[k][:, c] for k, c in zip(which, column, strict=True)]).transpose(1, 0, 2)
    new = np.array([waves[k + 1][:, c] for k, c in zip(which, column, strict=True)]).transpose(1, 0, 2)
    u = np.clip((times - block * which) / _TURN_S, 0.0, 1.0)[:, None]
    share = u**3 * (10 - 15 * u + 6 * u**2)
    rate = 30 * u**2 * (1 - u) ** 2 / _TURN_S
    bend = 60 * u * (1 - u) * (1 - 2 * u) / _TURN_S**2
    change = new - old
    rows[0] = old[0] + share * change[0]
    rows[1] = old[1] + share * change[1] + rate * change[0]
    rows[2] = old[2] + share * change[2] + 2 * rate * change[1] + bend * change[0]
    return JointSamples(*rows)


def _drift(sets: int, speed: Array) -> tuple[Array, Array, Array, Array]:
    """Times, positions, velocities, accelerations of the slow motion, which passes zero in the middle of measured periods."""
    block = _PERIODS * MULTISINE_PERIOD_S
    begins = block * np.arange(sets)
    turn = block - MULTISINE_PERIOD_S - _TURN_S
    times = np.concatenate([[0.0], np.sort([*(begins + turn), *(begins + block)]), [block * sets + _TURN_S]])
    to_middle = block - 0.5 * MULTISINE_PERIOD_S
    places = np.concatenate([[0.0], np.tile([turn - to_middle, 0.5 * MULTISINE_PERIOD_S], sets), [0.0]])
    moves = np.concatenate([[0.0], np.ones(2 * sets), [0.0]])
    return times, places[:, None] * speed, moves[:, None] * speed, np.zeros((len(times), len(speed)))


def _largest_size(arm: Arm, joints: tuple[int, ...], unit: JointSamples, spacing: float, drift: Array, speed: float) -> Array:
    """The factors on a motion of unit size at which joints reach a share of their limits, or of the drift."""
    moving = list(joints)
    jerk = np.diff(unit.a, axis=0) / spacing
    bounds = (_SHARE_OF_DRIFT * drift, _RESERVE * speed * arm.limits.a_max[moving], _RESERVE * speed * arm.limits.j_max[moving])
    ratios = [bound / np.abs(rows).max(axis=0) for bound, rows in zip(bounds, (unit.v, unit.a, jerk), strict=True)]
    return np.min(ratios, axis=0)
