"""Torque motors from whatever a model has, and the limits of the joints they move."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from armctl.core import units
from armctl.core.errors import ModelError
from armctl.core.limits import Limits
from armctl.core.validation import Array
from armctl.loading.datasheets import Row
from armctl.mjmodel.couplings import tendon_coefficients
from armctl.mjmodel.queries import joint_name
from armctl.mjmodel.transmissions import Tie, Transmission, moments_of

DEFAULT_SPEED = {mujoco.mjtJoint.mjJNT_HINGE: 2.0, mujoco.mjtJoint.mjJNT_SLIDE: 0.5}  # rad/s, m/s
DEFAULT_RISE_TIME = 0.05  # s, from no acceleration to the greatest
_DEFAULT_TAU_ACCELERATION = 10.0  # rad/s^2 that a motor of unknown torque is taken to make beyond gravity


@dataclass(frozen=True)
class JointData:
    """Limits by joint that did not come out of the compiled model: a data sheet's, or a URDF's.

    Attributes:
        source: Where they are published.
        v_max: (n,) rad/s, or None.
        a_max: (n,) rad/s^2, or None.
        j_max: (n,) rad/s^3, or None.
        tau_max: (n,) N m, or None.
    """

    source: str
    v_max: Array | None = None
    a_max: Array | None = None
    j_max: Array | None = None
    tau_max: Array | None = None


def from_row(row: Row | None, count: int) -> JointData | None:
    """A data-sheet row as limits of a chain.

    Args:
        row: The row, or None.
        count: How many joints the arm has.

    Returns:
        The limits; None without a row, or where the chain is not the one the row describes.
    """
    values = {} if row is None else {k: getattr(row, k) for k in ("v_max", "a_max", "j_max", "tau_max")}
    given = {k: np.array(v) for k, v in values.items() if v is not None}
    if row is None or not given or any(len(v) != count for v in given.values()):
        return None
    return JointData(row.source, **given)


def torque_limits(
    model: mujoco.MjModel, drives: Sequence[Transmission], sheet: JointData | None
) -> tuple[Array, dict[str, str], list[str]]:
    """What torque each joint of an arm can be given.

    The least of what the model says, by the actuator's forcerange x gear, the joint's actfrcrange and, for an actuator that was
    a motor, ctrlrange x gear; else the data sheet's; else an assumption, which is said aloud.

    Args:
        model: The model as compiled from its file, with its own actuators.
        drives: What moves the joints.
        sheet: Its data-sheet limits, or None.

    Returns:
        (n,) N m; where it comes from; the assumptions made, one sentence each.

    Raises:
        ModelError: A range holds no torque of one sign.
    """
    tau, sources, notes = np.full(len(drives), np.inf), set(), []
    for i, drive in enumerate(drives):
        for source, (low, high) in _torque_ranges(model, drive):
            bound = min(-low, high)
            if bound <= 0:
                raise ModelError(
                    f"joint {joint_name(model, drive.joint)!r}: its {source} [{low:g}, {high:g}] lacks one direction"
                )
            if bound <= tau[i]:
                tau[i] = bound
                sources.add(source)
    unknown = ~np.isfinite(tau)
    if unknown.any() and sheet is not None and sheet.tau_max is not None:
        tau[unknown] = sheet.tau_max[unknown]
        sources.add(sheet.source)
    elif unknown.any():
        tau[unknown] = _assumed_torque(model, drives)[unknown]
        sources.add("assumed")
        names = ", ".join(joint_name(model, drive.joint) for drive, u in zip(drives, unknown, strict=True) if u)
        slides = model.jnt_type[[drive.joint for drive in drives]] == int(mujoco.mjtJoint.mjJNT_SLIDE)
        joints = units.of_joints(slides[unknown])
        values = ", ".join(f"{x:.3g} {unit}" for x, unit in zip(tau[unknown], units.of_torque(joints), strict=True))
        rates = units.label(joints, "/s^2")
        notes.append(f"no torque limit given for {names}: assumed {values} (twice gravity at rest plus 10 {rates})")
    return tau, {"tau_max": ", ".join(sorted(sources))}, notes


def joint_limits(
    model: mujoco.MjModel, drives: Sequence[Transmission], home_qpos: Array, tau_max: Array, sheet: JointData | None
) -> tuple[Limits, dict[str, str]]:
    """The limits of an arm: positions from the model, the rest from the data sheet or a documented default.

    Where other joints follow one, it goes only as far as all of them can.

    Speed defaults to 2 rad/s (0.5 m/s). Acceleration defaults to half of what the torque beyond gravity gives the joint at home
    when all joints accelerate together (a row sum of the mass matrix), at most ten times the speed per second. Jerk defaults to
    the acceleration reached in 0.05 s.

    Args:
        model: The model.
        drives: What moves the joints.
        home_qpos: (nq,) the model at home.
        tau_max: (n,) N m.
        sheet: Data-sheet limits, or None.

    Returns:
        The limits, and where each kind comes from.
    """
    q_min, q_max = np.transpose([_range(model, drive) for drive in drives])
    given = JointData("default") if sheet is None else sheet
    v_max, a_max, j_max = given.v_max, given.a_max, given.j_max
    if v_max is None:
        v_max = np.array([min(default_speed(model, j) / abs(t.ratio) for j, t in drive.ties.items()) for drive in drives])
    if a_max is None:
        M, gravity = _inertia_and_gravity(model, drives, home_qpos)
        headroom = np.maximum(tau_max - np.abs(gravity), 0.1 * tau_max)
        a_max = np.minimum(0.5 * headroom / np.abs(M).sum(axis=1), 10.0 * v_max)
    if j_max is None:
        j_max = a_max / DEFAULT_RISE_TIME
    sources = {k: "default" if getattr(given, k) is None else given.source for k in ("v_max", "a_max", "j_max")}
    return Limits(q_min, q_max, v_max, a_max, j_max, tau_max), {"q_min": "model", "q_max": "model", **sources}


def make_motors(spec: mujoco.MjSpec, model: mujoco.MjModel, drives: Sequence[Transmission], tau_max: Array) -> list[str]:
    """Turns the actuators of an arm into torque motors, in place; gears, names, armature and damping stay.

    Args:
        spec: The specification that `model` was compiled from.
        model: The compiled model.
        drives: What moves the joints.
        tau_max: (n,) N m, which become the motors' ranges.

    Returns:
        What had to be changed besides, one sentence each.
    """
    hinges, motors = {j.id: j for j in spec.joints}, {a.id: a for a in spec.actuators}
    states: set[int] = set()
    for drive, torque in zip(drives, tau_max, strict=True):
        for joint in drive.ties:
            hinges[joint].actgravcomp = False  # a lift from outside: as a motor's it would count as torque
        for actuator in range(model.nu):
            moments = moments_of(model, actuator)
            if not moments or not moments.keys() <= drive.ties.keys():
                continue
            motor, gear = motors[actuator], abs(replace(drive, moments=moments).gear) or 1.0
            states |= {int(model.actuator_actadr[actuator]) + k for k in range(int(model.actuator_actnum[actuator]))}
            _move_reflected(motor, hinges[drive.joint], gear)
            motor.set_to_motor()
            motor.actlimited, motor.actrange = mujoco.mjtLimited.mjLIMITED_FALSE, (0.0, 0.0)
            bound = torque / gear if actuator == drive.actuator else 1e-12
            motor.ctrllimited = motor.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
            motor.ctrlrange = motor.forcerange = (-bound, bound)
    for key in spec.keys:
        key.act = [x for k, x in enumerate(key.act) if k not in states]
    return _switch_on(spec, {motors[drive.actuator].group for drive in drives})


def _switch_on(spec: mujoco.MjSpec, groups: set[int]) -> list[str]:
    """Lets the motors of some groups act where the model has actuation switched off; whether it had."""
    flag, bits = int(mujoco.mjtDisableBit.mjDSBL_ACTUATION), sum(1 << group for group in groups if 0 <= group < 31)
    is_off = bool(spec.option.disableflags & flag or spec.option.disableactuator & bits)
    spec.option.disableflags &= ~flag
    spec.option.disableactuator &= ~bits
    return ["the model's options switch its actuators off: they are switched on"] * is_off


def _move_reflected(motor: mujoco.MjsActuator, joint: mujoco.MjsJoint, gear: float) -> None:
    """Moves an actuator's own armature and damping to its joint, where MuJoCo would add them anyway."""
    joint.armature = joint.armature + gear**2 * motor.armature
    joint.damping = np.asarray(joint.damping) + gear**2 * np.asarray(motor.damping)
    motor.armature, motor.damping = 0.0, np.zeros_like(motor.damping)


def _torque_ranges(model: mujoco.MjModel, drive: Transmission) -> Iterator[tuple[str, tuple[float, float]]]:
    """What the model says about a joint's torque: where it says it, (low, high) N m."""
    actuator, gear, name = drive.actuator, drive.gear, joint_name(model, drive.joint)
    if model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_MUSCLE:
        raise ModelError(f"joint {name!r} is moved by a muscle, which pulls one way only; an arm needs motors")
    if gear == 0:
        raise ModelError(f"joint {name!r}: its actuator has a gear of 0 and cannot move it")
    if model.actuator_forcelimited[actuator]:
        yield "forcerange", _scaled(gear, model.actuator_forcerange[actuator])
    for joint, moment in drive.moments.items():
        if model.jnt_actfrclimited[joint]:
            yield "actfrcrange", _scaled(gear / moment, model.jnt_actfrcrange[joint])
    control = model.actuator_ctrladr[actuator]
    if _is_motor(model, actuator) and model.actuator_ctrllimited[control]:
        yield "ctrlrange", _scaled(gear * float(model.actuator_gainprm[actuator, 0]), model.actuator_ctrlrange[control])


def _scaled(factor: float, bounds: Array) -> tuple[float, float]:
    low, high = sorted((factor * bounds).tolist())
    return low, high


def _range(model: mujoco.MjModel, drive: Transmission) -> tuple[float, float]:
    """How far a joint can go before it, or one that follows it, is at its limit."""
    ranges = [(tie, model.jnt_range[joint]) for joint, tie in drive.ties.items() if model.jnt_limited[joint]]
    for tendon in np.flatnonzero(model.tendon_limited).tolist():
        parts = {joint: c for joint, c in tendon_coefficients(model, tendon).items() if c != 0}
        if parts and parts.keys() <= drive.ties.keys():
            ties = [(c, drive.ties[joint]) for joint, c in parts.items()]
            whole = Tie(sum(c * tie.ratio for c, tie in ties), sum(c * tie.offset for c, tie in ties))
            ranges += [(whole, model.tendon_range[tendon])] if whole.ratio else []
    ends = [sorted(((bounds - tie.offset) / tie.ratio).tolist()) for tie, bounds in ranges] or [[-np.inf, np.inf]]
    low, high = max(end[0] for end in ends), min(end[1] for end in ends)
    if low > high:
        name = joint_name(model, drive.joint)
        raise ModelError(f"joint {name!r} and those that follow it have no position inside the limits of all")
    return low, high


def default_speed(model: mujoco.MjModel, joint: int) -> float:
    """The speed of a joint that nobody gives one.

    Args:
        model: The model.
        joint: Its number.

    Returns:
        rad/s, m/s.
    """
    return DEFAULT_SPEED[mujoco.mjtJoint(int(model.jnt_type[joint]))]


def _is_motor(model: mujoco.MjModel, actuator: int) -> bool:
    fixed = model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED
    return fixed and model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_NONE and not model.actuator_dyntype[actuator]


def _assumed_torque(model: mujoco.MjModel, drives: Sequence[Transmission]) -> Array:
    n = len(drives)
    worst, M = np.zeros(n), np.zeros((n, n))
    rng, index = np.random.default_rng(0), [drive.joint for drive in drives]
    low, high = np.transpose([_range(model, drive) for drive in drives])
    low, high = np.where(np.isfinite(low), low, -np.pi), np.where(np.isfinite(high), high, np.pi)
    for _ in range(50):
        qpos = model.qpos0.copy()
        qpos[model.jnt_qposadr[index]] = rng.uniform(low, high)
        M, gravity = _inertia_and_gravity(model, drives, qpos)
        worst = np.maximum(worst, 2 * np.abs(gravity) + _DEFAULT_TAU_ACCELERATION * np.diag(M))
    return worst


def _inertia_and_gravity(model: mujoco.MjModel, drives: Sequence[Transmission], qpos: Array) -> tuple[Array, Array]:
    """(n, n) mass matrix and (n,) gravity torque of an arm, by MuJoCo, all that follows its joints included."""
    data, full, ratio = mujoco.MjData(model), np.zeros((model.nv, model.nv)), np.zeros((model.nv, len(drives)))
    data.qpos[:] = qpos
    for i, drive in enumerate(drives):
        for joint, tie in drive.ties.items():
            ratio[model.jnt_dofadr[joint], i] = tie.ratio
            data.qpos[model.jnt_qposadr[joint]] = tie.ratio * qpos[model.jnt_qposadr[drive.joint]] + tie.offset
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fwdVelocity(model, data)
    mujoco.mj_fullM(model, data, full)
    return ratio.T @ full @ ratio, ratio.T @ (data.qfrc_bias - data.qfrc_gravcomp)
