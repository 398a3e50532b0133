"""Torque motors from whatever a model has, and the limits of the joints they move."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from armctl.arrays import Array
from armctl.datasheets import Row
from armctl.elements import Chain, is_on_joint, joint_actuators, joint_name
from armctl.errors import ModelError
from armctl.trajectory import Limits

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


def from_row(row: Row | None, joints: Chain) -> JointData | None:
    """A data-sheet row as limits of a chain.

    Args:
        row: The row, or None.
        joints: The chain.

    Returns:
        The limits; None without a row, or where the chain is not the one the row describes.
    """
    values = {} if row is None else {k: getattr(row, k) for k in ("v_max", "a_max", "j_max", "tau_max")}
    given = {k: np.array(v) for k, v in values.items() if v is not None}
    if row is None or not given or any(len(v) != len(joints) for v in given.values()):
        return None
    return JointData(row.source, **given)


def torque_limits(model: mujoco.MjModel, joints: Chain, sheet: JointData | None) -> tuple[Array, dict[str, str], list[str]]:
    """What torque each joint of a chain can be given.

    The least of what the model says, by the actuator's forcerange x gear, the joint's actfrcrange and, for an actuator that was
    a motor, ctrlrange x gear; else the data sheet's; else an assumption, which is said aloud.

    Args:
        model: The model as compiled from its file, with its own actuators.
        joints: The chain.
        sheet: Its data-sheet limits, or None.

    Returns:
        (n,) N m; where it comes from; the assumptions made, one sentence each.

    Raises:
        ModelError: A range holds no torque of one sign.
    """
    actuators, tau, sources, notes = joint_actuators(model), np.full(len(joints), np.inf), set(), []
    for i, joint in enumerate(joints):
        for source, (low, high) in _torque_ranges(model, joint, actuators[joint]).items():
            bound = min(-low, high)
            if bound <= 0:
                raise ModelError(f"joint {joint_name(model, joint)!r}: its {source} [{low:g}, {high:g}] lacks one direction")
            if bound <= tau[i]:
                tau[i] = bound
                sources.add(source)
    unknown = ~np.isfinite(tau)
    if unknown.any() and sheet is not None and sheet.tau_max is not None:
        tau[unknown] = sheet.tau_max[unknown]
        sources.add(sheet.source)
    elif unknown.any():
        tau[unknown] = _assumed_torque(model, joints)[unknown]
        sources.add("assumed")
        names = ", ".join(joint_name(model, j) for j, u in zip(joints, unknown, strict=True) if u)
        values = ", ".join(f"{x:.3g}" for x in tau[unknown])
        notes.append(f"no torque limit given for {names}: assumed {values} N m (twice gravity at rest plus 10 rad/s^2)")
    return tau, {"tau_max": ", ".join(sorted(sources))}, notes


def joint_limits(
    model: mujoco.MjModel, joints: Chain, home_qpos: Array, tau_max: Array, sheet: JointData | None
) -> tuple[Limits, dict[str, str]]:
    """The limits of a chain: positions from the model, the rest from the data sheet or a documented default.

    Speed defaults to 2 rad/s (0.5 m/s). Acceleration defaults to half of what the torque beyond gravity gives the joint at home
    when all joints accelerate together (a row sum of the mass matrix), at most ten times the speed per second. Jerk defaults to
    the acceleration reached in 0.05 s.

    Args:
        model: The model.
        joints: The chain.
        home_qpos: (nq,) the model at home.
        tau_max: (n,) N m.
        sheet: Data-sheet limits, or None.

    Returns:
        The limits, and where each kind comes from.
    """
    index = list(joints)
    limited = model.jnt_limited[index].astype(bool)
    q_min = np.where(limited, model.jnt_range[index, 0], -np.inf)
    q_max = np.where(limited, model.jnt_range[index, 1], np.inf)
    given = JointData("default") if sheet is None else sheet
    v_max, a_max, j_max = given.v_max, given.a_max, given.j_max
    if v_max is None:
        v_max = np.array([DEFAULT_SPEED[mujoco.mjtJoint(int(model.jnt_type[j]))] for j in joints])
    if a_max is None:
        M, gravity = _inertia_and_gravity(model, joints, home_qpos)
        headroom = np.maximum(tau_max - np.abs(gravity), 0.1 * tau_max)
        a_max = np.minimum(0.5 * headroom / np.abs(M).sum(axis=1), 10.0 * v_max)
    if j_max is None:
        j_max = a_max / DEFAULT_RISE_TIME
    sources = {k: "default" if getattr(given, k) is None else given.source for k in ("v_max", "a_max", "j_max")}
    return Limits(q_min, q_max, v_max, a_max, j_max, tau_max), {"q_min": "model", "q_max": "model", **sources}


def make_motors(spec: mujoco.MjSpec, model: mujoco.MjModel, joints: Chain, tau_max: Array) -> list[str]:
    """Turns the actuators of a chain into torque motors, in place; gears, names, armature and damping stay.

    Args:
        spec: The specification that `model` was compiled from.
        model: The compiled model.
        joints: The chain.
        tau_max: (n,) N m, which become the motors' ranges.

    Returns:
        What had to be changed besides, one sentence each.
    """
    chosen = joint_actuators(model)
    hinges, motors = {j.id: j for j in spec.joints}, {a.id: a for a in spec.actuators}
    states: set[int] = set()
    for i, joint in enumerate(joints):
        hinges[joint].actgravcomp = False  # a lift from outside: as a motor's it would count as torque
        for actuator in range(model.nu):
            if model.actuator_trnid[actuator, 0] != joint or not is_on_joint(model, actuator):
                continue
            motor, gear = motors[actuator], abs(float(model.actuator_gear[actuator, 0])) or 1.0
            states |= {int(model.actuator_actadr[actuator]) + k for k in range(int(model.actuator_actnum[actuator]))}
            _move_reflected(motor, hinges[joint], gear)
            motor.set_to_motor()
            motor.actlimited, motor.actrange = mujoco.mjtLimited.mjLIMITED_FALSE, (0.0, 0.0)
            bound = tau_max[i] / gear if actuator == chosen[joint] else 1e-12
            motor.ctrllimited = motor.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
            motor.ctrlrange = motor.forcerange = (-bound, bound)
    for key in spec.keys:
        key.act = [x for k, x in enumerate(key.act) if k not in states]
    return _switch_on(spec, {motors[chosen[joint]].group for joint in joints})


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


def _torque_ranges(model: mujoco.MjModel, joint: int, actuator: int) -> dict[str, tuple[float, float]]:
    """What the model says about a joint's torque, by where it says it: (low, high) N m."""
    gear = float(model.actuator_gear[actuator, 0])
    if model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_MUSCLE:
        raise ModelError(
            f"joint {joint_name(model, joint)!r} is moved by a muscle, which pulls one way only; an arm needs motors"
        )
    if gear == 0:
        raise ModelError(f"joint {joint_name(model, joint)!r}: its actuator has a gear of 0 and cannot move it")
    ranges = {}
    if model.actuator_forcelimited[actuator]:
        ranges["forcerange"] = sorted(gear * model.actuator_forcerange[actuator])
    if model.jnt_actfrclimited[joint]:
        ranges["actfrcrange"] = model.jnt_actfrcrange[joint]
    control = model.actuator_ctrladr[actuator]
    if _is_motor(model, actuator) and model.actuator_ctrllimited[control]:
        gain = gear * float(model.actuator_gainprm[actuator, 0])
        ranges["ctrlrange"] = sorted(gain * model.actuator_ctrlrange[control])
    return {source: (float(low), float(high)) for source, (low, high) in ranges.items()}


def _is_motor(model: mujoco.MjModel, actuator: int) -> bool:
    fixed = model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED
    return fixed and model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_NONE and not model.actuator_dyntype[actuator]


def _assumed_torque(model: mujoco.MjModel, joints: Chain) -> Array:
    worst, M = np.zeros(len(joints)), np.zeros((len(joints), len(joints)))
    rng, index = np.random.default_rng(0), list(joints)
    low, high = np.where(model.jnt_limited[index, None], model.jnt_range[index], (-np.pi, np.pi)).T
    for _ in range(50):
        qpos = model.qpos0.copy()
        qpos[model.jnt_qposadr[index]] = rng.uniform(low, high)
        M, gravity = _inertia_and_gravity(model, joints, qpos)
        worst = np.maximum(worst, 2 * np.abs(gravity) + _DEFAULT_TAU_ACCELERATION * np.diag(M))
    return worst


def _inertia_and_gravity(model: mujoco.MjModel, joints: Chain, qpos: Array) -> tuple[Array, Array]:
    """(n, n) mass matrix and (n,) gravity torque of a chain, by MuJoCo."""
    data, full = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    data.qpos[:] = qpos
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fwdVelocity(model, data)
    mujoco.mj_fullM(model, data, full)
    dofs = model.jnt_dofadr[list(joints)]
    return full[np.ix_(dofs, dofs)], data.qfrc_bias[dofs] - data.qfrc_gravcomp[dofs]
