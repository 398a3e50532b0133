"""The limits of an arm's joints: from the model, a data sheet or a URDF, else documented defaults."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import mujoco
import numpy as np

from armctl.core import units
from armctl.core.errors import ModelError
from armctl.core.limits import Limits
from armctl.core.note import Note
from armctl.core.validation import Array, shown
from armctl.model.arm.joint_map import JointMap
from armctl.model.loading.datasheets import Row
from armctl.model.mjmodel.couplings import tendon_coefficients
from armctl.model.mjmodel.dc_motor import DcMotor
from armctl.model.mjmodel.queries import LINEAR_BIASES, LINEAR_GAINS, actuator_name, joint_name, joint_range
from armctl.model.mjmodel.transmissions import Mimic, Transmission

DEFAULT_SPEED = {mujoco.mjtJoint.mjJNT_HINGE: 2.0, mujoco.mjtJoint.mjJNT_SLIDE: 0.5}  # rad/s, m/s
DEFAULT_ACCELERATION_TIME_S = 0.05  # from zero to the greatest acceleration
SPEEDS_PER_S = 10.0  # the greatest default acceleration: so many times the speed in a second
_ASSUMED_ACCELERATION = 10.0  # rad/s^2 beyond gravity, of a motor whose torque nothing specifies
_TORQUE_SAMPLES = 50  # configurations in which gravity is evaluated
# As numbers: `numpy.int32(3) in (mjtDyn.mjDYN_FILTER,)` is False, although the two compare equal with ==.
_LINEAR_DYNAMICS = (
    int(mujoco.mjtDyn.mjDYN_NONE),
    int(mujoco.mjtDyn.mjDYN_INTEGRATOR),
    int(mujoco.mjtDyn.mjDYN_FILTER),
    int(mujoco.mjtDyn.mjDYN_FILTEREXACT),
)


@dataclass(frozen=True)
class JointData:
    """Limits of joints that the compiled model does not contain: from a data sheet or a URDF."""

    source: str  # where they are published
    v_max: Array | None = None  # (n,) rad/s, or None
    a_max: Array | None = None  # (n,) rad/s^2, or None
    j_max: Array | None = None  # (n,) rad/s^3, or None
    tau_max: Array | None = None  # (n,) N m, or None
    has_defaults: bool = False  # whether v_max is a default for some of them
    deceleration_limit: Array | None = None  # (n,) rad/s^2, infinite without one, or None; see `Limits`
    velocity_offset: Array | None = None  # (n,) rad/s, or None

    def behind(self, v_max: Array) -> Self:
        """The limits of these joints behind others with default speeds (k,), accelerations and jerks."""
        a_max = SPEEDS_PER_S * v_max
        first = {
            "v_max": v_max,
            "a_max": a_max,
            "j_max": a_max / DEFAULT_ACCELERATION_TIME_S,
            "tau_max": np.full(len(v_max), np.inf),
            "deceleration_limit": np.full(len(v_max), np.inf),
            "velocity_offset": np.zeros(len(v_max)),
        }
        own = {name: getattr(self, name) for name in first}
        limits = {name: None if own[name] is None else np.concatenate([first[name], own[name]]) for name in first}
        return replace(self, **limits, has_defaults=True)

    def repeated(self, arms: int) -> Self:
        """The limits of so many equal arms, one after the other."""
        names = ("v_max", "a_max", "j_max", "tau_max", "deceleration_limit", "velocity_offset")
        limits = {name: getattr(self, name) for name in names}
        return replace(self, **{name: None if each is None else np.tile(each, arms) for name, each in limits.items()})


@dataclass(frozen=True)
class TorqueLimits:
    """The torque limits of an arm."""

    tau_max: Array  # (n,) N m
    source: str  # where they come from
    notes: tuple[str, ...]  # the assumptions made, one sentence each


def datasheet_limits(row: Row | None, n: int) -> JointData | None:
    """A data-sheet row as limits of an arm of n joints; None without a row, or if it is of another number of joints."""
    if row is None:
        return None
    values = {name: getattr(row, name) for name in ("v_max", "a_max", "j_max", "tau_max")}
    given: dict[str, Any] = {name: np.array(value) for name, value in values.items() if value is not None}
    if any(len(value) != n for value in given.values()):
        return None
    return JointData(row.source, **given)


def torque_limits(
    model: mujoco.MjModel,
    transmissions: Sequence[Transmission],
    datasheet: JointData | None,
    motors: Sequence[DcMotor | None],
    joint_limit: str = "actfrcrange",  # what the file calls the joint's own limit
    added: int = 0,  # how many of the first joints armctl added: their motors are none of the robot's
    closed: JointMap | None = None,  # the joint map of an arm with closed loops
) -> TorqueLimits:
    """The torque limits of an arm's joints in a model as compiled from its file, with its own actuators.

    The smallest of the model's own limits: the actuator's forcerange x gear, the actfrcrange of the joint or the tendon, the
    stall torque of a DC motor and, for an actuator with a constant gain, its ctrlrange (or actrange) x gain x gear. Without
    any, the data sheet's limit; without that, an assumption, with a note. ModelError if a range does not allow torques of both
    signs.
    """
    tau = np.full(len(transmissions), np.inf)
    sources: set[str] = set()
    notes: tuple[str, ...] = ()
    for i, (transmission, motor) in enumerate(zip(transmissions, motors, strict=True)):
        stall = [] if motor is None else [("stall torque", (-motor.stall_torque, motor.stall_torque))]
        for source, (low, high) in [*_torque_ranges(model, transmission, joint_limit), *stall]:
            bound = min(-low, high)
            if bound <= 0:
                name = shown(joint_name(model, transmission.joint))
                raise ModelError(f"joint {name}: its {source} [{low:g}, {high:g}] permits only one direction")
            if bound <= tau[i] and bound < np.inf:
                tau[i] = bound
                sources.add(source)
    unknown = ~np.isfinite(tau)
    if unknown.any() and datasheet is not None and datasheet.tau_max is not None:
        tau[unknown] = datasheet.tau_max[unknown]
        sources.add(datasheet.source)
        unknown = ~np.isfinite(tau)
    if unknown.any():
        for i in np.flatnonzero(unknown).tolist():
            _check_sum_is_known(model, transmissions[i])
            _check_voltage_is_known(model, transmissions[i], motors[i])
        published = None if datasheet is None else datasheet.v_max
        v_max = default_speeds(model, transmissions) if published is None else published
        tau[unknown] = _assumed_torque(model, transmissions, v_max, closed)[unknown]
        sources.add("assumed")
        noted = [i for i in np.flatnonzero(unknown).tolist() if i >= added]
        notes = (_assumed_torque_note(model, [transmissions[i].joint for i in noted], tau[noted]),) if noted else ()
    return TorqueLimits(tau, ", ".join(sorted(sources)), notes)


def joint_limits(
    model: mujoco.MjModel,
    transmissions: Sequence[Transmission],
    home_qpos: Array,
    tau_max: Array,
    datasheet: JointData | None,
    motors: Sequence[DcMotor | None],
    closed: JointMap | None = None,
) -> tuple[Limits, dict[str, str], frozenset[str]]:
    """The limits of an arm, where each kind comes from, and the kinds that are defaults, at least for some joints.

    Positions come from the model, the rest from the data sheet or a default.

    A joint that others follow goes only as far as all of them can. The default speed is 2 rad/s (0.5 m/s), of a DC motor
    that without a load. The default acceleration is half of what the torque beyond gravity gives the joint at home if all
    joints accelerate together (a row sum of the mass matrix), at most ten times the speed per second. The default jerk
    reaches the acceleration in 0.05 s. `closed` is the joint map of an arm with closed loops.
    """
    q_min, q_max = position_limits(model, transmissions)
    given = JointData("default") if datasheet is None else datasheet
    no_load = np.array([np.inf if motor is None else motor.no_load_speed for motor in motors])
    stall = np.array([np.inf if motor is None else motor.stall_torque for motor in motors])
    has_curve = np.isfinite(no_load)
    v_max = default_speeds(model, transmissions) if given.v_max is None else given.v_max
    v_max = np.where(has_curve & (given.v_max is None), no_load, np.minimum(v_max, no_load))
    a_max = given.a_max
    j_max = given.j_max
    if a_max is None:
        with np.errstate(over="ignore", invalid="ignore"):  # a model may state any speed and any mass
            M, gravity = _inertia_and_gravity(model, transmissions, home_qpos, closed)
            inertia = np.abs(M).sum(axis=1)
            _check_inertia(model, transmissions, inertia, gravity)
            headroom = np.maximum(tau_max - np.abs(gravity), 0.1 * tau_max)
            a_max = np.minimum(0.5 * headroom / inertia, SPEEDS_PER_S * v_max)
    if j_max is None:
        j_max = a_max / DEFAULT_ACCELERATION_TIME_S
    sources = {k: "default" if getattr(given, k) is None else given.source for k in ("v_max", "a_max", "j_max")}
    if has_curve.any():
        sources["v_max"] = "no-load speed" if has_curve.all() else f"no-load speed, {sources['v_max']}"
    defaults = {k for k in sources if getattr(given, k) is None}
    if given.has_defaults:
        defaults.add("v_max")
    if has_curve.all():
        defaults.discard("v_max")
    limits = Limits(
        q_min=q_min,
        q_max=q_max,
        v_max=v_max,
        a_max=a_max,
        j_max=j_max,
        tau_max=tau_max,
        stall_torque=stall,
        no_load_speed=no_load,
        deceleration_limit=given.deceleration_limit,  # type: ignore[arg-type]  # None is no limit
        velocity_offset=given.velocity_offset,  # type: ignore[arg-type]
    )
    return limits, {"q_min": "model", "q_max": "model", **sources}, frozenset(defaults)


def position_limits(model: mujoco.MjModel, transmissions: Sequence[Transmission]) -> tuple[Array, Array]:
    """(n,) the smallest and the greatest position of each joint, rad; infinite if it is not limited."""
    low, high = np.transpose([_range(model, transmission) for transmission in transmissions])
    return low, high


def default_speed(model: mujoco.MjModel, joint: int) -> float:
    """The speed limit of a joint that nothing specifies, rad/s or m/s."""
    return DEFAULT_SPEED[mujoco.mjtJoint(int(model.jnt_type[joint]))]


def default_speeds(model: mujoco.MjModel, transmissions: Sequence[Transmission]) -> Array:
    """(n,) the default speed of each joint: no joint that follows it exceeds its own default, but for rotors behind gears.

    A rotor is a joint without a range, coupled to one that has a range and is slower.
    """
    speeds = []
    for transmission in transmissions:
        coupled = transmission.coupled
        ranged = [joint for joint in coupled if model.jnt_limited[joint]]
        slowest = min((abs(coupled[joint].ratio) for joint in ranged), default=np.inf)
        counted = [joint for joint in coupled if joint in ranged or abs(coupled[joint].ratio) <= slowest]
        speeds.append(min(default_speed(model, joint) / abs(coupled[joint].ratio) for joint in counted))
    return np.array(speeds)


def _torque_ranges(
    model: mujoco.MjModel, transmission: Transmission, joint_limit: str
) -> Iterator[tuple[str, tuple[float, float]]]:
    """Each limit of the model on a joint's torque: its name in MJCF, and (low, high) N m.

    Where several actuators act on the joint, their torques add.
    """
    gears = {transmission.actuator: transmission.gear, **transmission.added}
    name = shown(joint_name(model, transmission.joint))
    for actuator, gear in gears.items():
        if model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_MUSCLE:
            raise ModelError(f"joint {name} is driven by a muscle, which pulls in one direction only; an arm needs motors")
        if gear == 0:
            raise ModelError(f"joint {name}: its actuator has a gear of 0 and cannot move it")
    ranges = {actuator: torque_range(model, actuator, gear) for actuator, gear in gears.items()}
    if all(source for source, _, _ in ranges.values()):
        low = 0.0
        high = 0.0
        for bounds, actuators in _groups(model, gears):
            low += max(bounds[0], sum(ranges[actuator][1] for actuator in actuators))
            high += min(bounds[1], sum(ranges[actuator][2] for actuator in actuators))
        yield ", ".join(sorted({source for source, _, _ in ranges.values()})), (low, high)
    for joint, moment in transmission.moments.items():
        if model.jnt_actfrclimited[joint]:
            yield joint_limit, _scaled(transmission.gear / moment, model.jnt_actfrcrange[joint])


def torque_range(model: mujoco.MjModel, actuator: int, gear: float) -> tuple[str, float, float]:
    """The torque that one actuator can give to its joint: what limits it in MJCF ("" if nothing does), low and high, N m."""
    found: list[tuple[str, tuple[float, float]]] = []
    if model.actuator_forcelimited[actuator]:
        found.append(("forcerange", _scaled(gear, model.actuator_forcerange[actuator])))
    if has_constant_gain(model, actuator):
        gain = float(model.actuator_gainprm[actuator, 0])
        has_bias = model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE
        offset = float(model.actuator_biasprm[actuator, 0]) if has_bias else 0.0
        ranges = _input_ranges(model, actuator)
        found += [(source, _scaled(gear, gain * bounds + offset)) for source, bounds in ranges.items()]
    if (tendon := _limited_tendon(model, actuator)) >= 0:
        per_force = gear / float(model.actuator_gear[actuator, 0])
        found.append(("actuatorfrcrange of a tendon", _scaled(per_force, model.tendon_actfrcrange[tendon])))
    low = max((bounds[0] for _, bounds in found), default=-np.inf)
    high = min((bounds[1] for _, bounds in found), default=np.inf)
    least = min(-low, high)
    return (
        next((source for source, bounds in found if min(-bounds[0], bounds[1]) <= least), found[0][0] if found else ""),
        low,
        high,
    )


def _check_sum_is_known(model: mujoco.MjModel, transmission: Transmission) -> None:
    """Refuses actuators on the same joint of which some have a torque limit and others have none."""
    gears = {transmission.actuator: transmission.gear, **transmission.added}
    is_known = {actuator: bool(torque_range(model, actuator, gear)[0]) for actuator, gear in gears.items()}
    if not any(is_known.values()):
        return
    named = " and ".join(shown(actuator_name(model, actuator)) for actuator in gears)
    unlimited = " and ".join(shown(actuator_name(model, actuator)) for actuator, known in is_known.items() if not known)
    raise ModelError(
        f"joint {shown(joint_name(model, transmission.joint))} is moved by {named}, and {unlimited} without a torque limit: "
        "the sum is unknown; write a forcerange, or actuatorfrcrange at the joint, or delete all but one of them"
    )


def _check_voltage_is_known(model: mujoco.MjModel, transmission: Transmission, motor: DcMotor | None) -> None:
    """Refuses a DC motor without a voltage: its torque at rest is unknown."""
    if motor is not None and not np.isfinite(motor.voltage):
        name = shown(actuator_name(model, transmission.actuator))
        raise ModelError(
            f"the dcmotor {name} has no voltage, so its torque is unknown; MuJoCo keeps no nominal voltage in a specification "
            'or a model: load the file itself, or write ctrlrange="-24 24" (V), or saturation="1.5 0 0" (N m at the motor)'
        )


def has_constant_gain(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator's force is a constant times its control, or its filtered or integrated control, plus a constant."""
    gain = model.actuator_gainprm[actuator, 1:3].any() and model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_AFFINE
    bias = model.actuator_biasprm[actuator, 1:3].any() and model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE
    return bool(
        model.actuator_gaintype[actuator] in LINEAR_GAINS
        and model.actuator_biastype[actuator] in LINEAR_BIASES
        and model.actuator_dyntype[actuator] in _LINEAR_DYNAMICS
        and model.actuator_plugin[actuator] < 0
        and not (gain or bias)
    )


def _input_ranges(model: mujoco.MjModel, actuator: int) -> dict[str, Array]:
    """The ranges of what the gain of an actuator multiplies: its control, or what its filter or its integral makes of it."""
    control = model.actuator_ctrladr[actuator]
    dynamics = model.actuator_dyntype[actuator]
    found: dict[str, Array] = {}
    if model.actuator_ctrllimited[control] and dynamics != mujoco.mjtDyn.mjDYN_INTEGRATOR:
        found["ctrlrange"] = model.actuator_ctrlrange[control]
    if model.actuator_actlimited[actuator] and dynamics != mujoco.mjtDyn.mjDYN_NONE:
        found["actrange"] = model.actuator_actrange[actuator]
    return found


def _groups(model: mujoco.MjModel, gears: dict[int, float]) -> Iterator[tuple[tuple[float, float], list[int]]]:
    """The actuators of a joint whose torques a limit bounds together, N m: those on a limited tendon; each other one alone."""
    on_tendon: dict[int, list[int]] = {}
    for actuator in gears:
        tendon = _limited_tendon(model, actuator)
        if tendon < 0:
            yield (-np.inf, np.inf), [actuator]
        else:
            on_tendon.setdefault(tendon, []).append(actuator)
    for tendon, actuators in on_tendon.items():
        per_force = gears[actuators[0]] / float(model.actuator_gear[actuators[0], 0])
        yield _scaled(per_force, model.tendon_actfrcrange[tendon]), actuators


def _limited_tendon(model: mujoco.MjModel, actuator: int) -> int:
    """The tendon of an actuator if it limits the forces of its actuators; -1 if there is none."""
    tendon = int(model.actuator_trnid[actuator, 0])
    is_on_tendon = model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_TENDON
    return tendon if is_on_tendon and model.tendon_actfrclimited[tendon] else -1


def _scaled(factor: float, bounds: Array) -> tuple[float, float]:
    low, high = sorted((factor * bounds).tolist())
    return low, high


def _range(model: mujoco.MjModel, transmission: Transmission) -> tuple[float, float]:
    """How far a joint can go before it, or one that follows it, reaches a limit."""
    coupled = transmission.coupled
    ranges = [(mimic, np.array(joint_range(model, joint))) for joint, mimic in coupled.items() if model.jnt_limited[joint]]
    for tendon in np.flatnonzero(model.tendon_limited).tolist():
        parts = {joint: c for joint, c in tendon_coefficients(model, tendon).items() if c != 0}
        if parts and parts.keys() <= coupled.keys():
            ratio = sum(c * coupled[joint].ratio for joint, c in parts.items())
            offset = sum(c * coupled[joint].offset for joint, c in parts.items())
            if ratio:
                ranges.append((Mimic(ratio, offset), model.tendon_range[tendon]))
    low = -np.inf
    high = np.inf
    for mimic, bounds in ranges:
        ends = sorted(((bounds - mimic.offset) / mimic.ratio).tolist())
        low = max(low, ends[0])
        high = min(high, ends[1])
    if low > high:
        name = shown(joint_name(model, transmission.joint))
        raise ModelError(f"joint {name} and those that follow it have no position inside the limits of all")
    return low, high


def _assumed_torque(
    model: mujoco.MjModel, transmissions: Sequence[Transmission], v_max: Array, closed: JointMap | None
) -> Array:
    """(n,) N m: twice gravity at rest, at worst over the ranges, a moderate acceleration, and friction at full speed."""
    joints = [transmission.joint for transmission in transmissions]
    worst = np.zeros(len(joints))
    q_min, q_max = position_limits(model, transmissions)
    unlimited = np.full(len(joints), np.inf)
    limits = Limits(q_min=q_min, q_max=q_max, v_max=unlimited, a_max=unlimited, j_max=unlimited, tau_max=unlimited)
    drawn = model.qpos0[model.jnt_qposadr[joints]]
    for q in limits.random(limits.clamp(drawn), _TORQUE_SAMPLES, np.random.default_rng(0)):
        if closed is not None and closed.closure is not None:
            q = closed.closure.near_reference(q - closed.closure.arguments["reference_q"])
        qpos = model.qpos0.copy()
        qpos[model.jnt_qposadr[joints]] = q
        M, gravity = _inertia_and_gravity(model, transmissions, qpos, closed)
        worst = np.maximum(worst, 2 * np.abs(gravity) + _ASSUMED_ACCELERATION * np.diag(M))
    return worst + _friction_torque(model, transmissions, v_max)


def _friction_torque(model: mujoco.MjModel, transmissions: Sequence[Transmission], v_max: Array) -> Array:
    """(n,) N m: what dry friction and damping take from each joint at its full speed, those of coupled joints included."""
    torques = []
    for transmission, speed in zip(transmissions, v_max, strict=True):
        torque = 0.0
        for joint, mimic in transmission.coupled.items():
            dof = int(model.jnt_dofadr[joint])
            ratio = abs(mimic.ratio)
            torque += ratio * float(model.dof_frictionloss[dof]) + ratio**2 * float(model.dof_damping[dof]) * float(speed)
        torques.append(torque)
    return np.array(torques)


def _assumed_torque_note(model: mujoco.MjModel, joints: Sequence[int], tau: Array) -> str:
    names = ", ".join(joint_name(model, joint) for joint in joints)
    joint_units = units.of_joints(model.jnt_type[list(joints)] == int(mujoco.mjtJoint.mjJNT_SLIDE))
    values = ", ".join(f"{x:.3g} {unit}" for x, unit in zip(tau, units.of_torque(joint_units), strict=True))
    rates = units.label(joint_units, "/s^2")
    text = f"no torque limit given for {names}: assumed {values} (twice gravity at rest plus 10 {rates} plus friction)"
    return Note(text, 'write <limit effort="..."/> (URDF) or forcerange="..." (MJCF) from the data sheet')


def _check_inertia(model: mujoco.MjModel, transmissions: Sequence[Transmission], inertia: Array, gravity: Array) -> None:
    """Refuses joints that move no inertia, or masses whose products overflow."""
    for transmission, moved, torque in zip(transmissions, inertia, gravity, strict=True):
        if not 0.0 < moved < np.inf or not np.isfinite(torque):
            name = shown(joint_name(model, transmission.joint))
            raise ModelError(f"joint {name}: it moves an inertia of {moved:g}; check masses and inertias or give an armature")


def _inertia_and_gravity(
    model: mujoco.MjModel, transmissions: Sequence[Transmission], qpos: Array, closed: JointMap | None
) -> tuple[Array, Array]:
    """(n, n) mass matrix and (n,) gravity torque of an arm by MuJoCo, all coupled joints included."""
    leaders = [transmission.joint for transmission in transmissions]
    joint_map = closed or JointMap.from_transmissions(model, tuple(leaders), transmissions)
    data = mujoco.MjData(model)
    full = np.zeros((model.nv, model.nv))
    data.qpos[:] = qpos
    q = qpos[model.jnt_qposadr[leaders]]
    joint_map.set_positions(data.qpos, q)
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fwdVelocity(model, data)
    mujoco.mj_fullM(model, data, full)
    return joint_map.reduced_matrix(full, q), joint_map.reduced(data.qfrc_bias - data.qfrc_gravcomp, q)
