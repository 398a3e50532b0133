"""GripperModel: the gripper behind an arm's tip, found in the MuJoCo model: actuators, pads, and the control for each width."""

import copy
from dataclasses import dataclass, replace
from itertools import product

import mujoco
import numpy as np

from armctl.core.defaults import SETTLE_TIMEOUT_S
from armctl.core.errors import InputError, ModelError
from armctl.core.validation import Array, IntArray, frozen, number
from armctl.model.arm.arm import Arm
from armctl.model.gripper.jaws import MIN_OPENING, Jaws, find_jaws
from armctl.model.gripper.mechanism import find_mechanism
from armctl.model.mjmodel.brake import brake
from armctl.model.mjmodel.couplings import dofs_of_tendon
from armctl.model.mjmodel.queries import acts, actuator_name, is_below, is_on_joint, placed, welded_behind

_TABLE_SIZE = 12  # widths for which the controls are tabulated
_TOUCHING_STATES = 2  # of them: the jaws of a nearly closed gripper may touch
_MIN_SETTLE_S = 0.1
_SETTLED_SPEED = 1e-4  # rad/s, m/s
# A servo made of a motor pushes with its full force at this fraction of the joint's range.
_FULL_FORCE_FRACTION = 0.1
_FORCE_TOLERANCE = 1e-9  # relative, for forces at the gripper's limit
_SERVO_BANDWIDTH = 0.2  # rad per time step: a tenth of the stability limit of explicit integration of its damping


@dataclass(frozen=True, eq=False)
class GripperModel:
    """A gripper of one actuator, or of two that move together."""

    actuators: tuple[int, ...]
    dofs: IntArray  # addresses in `MjData.qvel` of all joints that move with the gripper
    jaws: Jaws
    width: Array  # (k,) m, increasing from closed to open
    ctrl: Array  # (k, actuators) the controls for each width
    length: Array  # (k, actuators) the lengths of the actuators at each width
    force_max: float  # N, the largest force between the pads; infinite if the model sets no limit
    inertia: Array  # (actuators,) kg m^2, reflected to each actuator's joint, of all that it moves
    followers: IntArray  # the joints that follow an actuator's own at a fixed ratio; its range is theirs too
    # geoms of the jaws that overlap others of the robot while the gripper moves, as convex hulls do; their contacts with each
    # other are switched off while the gripper is in use
    overlapping: IntArray
    qpos: Array  # (k, nq) positions of all joints of the model at each width, those of the arm at home
    qpos_adr: IntArray  # addresses in `MjData.qpos` of the joints that move with the gripper

    def ctrl_at(self, width: float) -> Array:
        """(actuators,) controls for a width, m."""
        return np.array([np.interp(width, self.width, column) for column in self.ctrl.T])

    def positions_at(self, width: float) -> Array:
        """The positions of its joints, in the order of `qpos_adr`, at a width, m."""
        return np.array([np.interp(width, self.width, self.qpos[:, address]) for address in self.qpos_adr])

    def actuator_force(self, force: float) -> Array:
        """(actuators,) forces that press the pads together with a force, N, by virtual work: sum f dl = -F dw."""
        slope = np.ptp(self.width) / (self.length[-1] - self.length[0])
        return -force * slope / len(self.actuators)


def checked_force(force: float, force_max: float) -> float:
    """A force between the pads, N; InputError for more than a gripper has."""
    force = number("force", force, 0.0)
    if force > force_max * (1 + _FORCE_TOLERANCE):
        raise InputError(f"force: {force:g} N is more than the maximum of this gripper, {force_max:.3g} N")
    return force


def find_gripper_model(arm: Arm, tip: str | None = None) -> GripperModel:
    """The gripper behind one of an arm's tips, the first if left out; ModelError if there is none, or a hand of many actuators.

    The gripper is closed and opened alone, to find which of its parts meet and which width each control gives: kinematically,
    within the limits of its joints; a linkage that closes a loop, by a simulation without gravity.
    """
    number = 0 if tip is None else arm.tips.index(tip)
    tip = arm.tips[number]
    last = arm.last_bodies[number]
    bodies, dofs = _behind(arm, last)
    actuators = tuple(a for a in range(arm.model.nactuator) if _moves(arm.model, a, set(dofs.tolist())))
    if not actuators:
        raise ModelError(f"{arm.name}: no gripper: no actuator moves anything behind the tip {tip!r}")
    actuators = tuple(a for a in actuators if _has_range(arm.model, a)) or actuators  # a wheel between racks is no jaw
    if len(actuators) > 2:
        raise ModelError(
            f"{arm.name}: {len(actuators)} actuators move what is behind the tip {tip!r}: a hand, not a gripper; "
            "load its fingers as chains"
        )
    mechanism = find_mechanism(arm.model, dofs, actuators)
    inertia = np.full(len(actuators), arm.model.dof_M0[dofs].sum()) if mechanism is None else mechanism.inertia(arm.model)
    model = _alone(arm, bodies, dofs, actuators, inertia)
    ends = [model.actuator_ctrlrange[a] for a in actuators]
    corners = [np.array(corner) for corner in product(*ends)]
    home = placed(model, arm.home_qpos)

    def at(ctrl: Array, start: mujoco.MjData) -> mujoco.MjData:
        if mechanism is not None:
            return mechanism.placed(model, start, ctrl)
        return _settled(model, dofs, ctrl, actuators, start)

    states = [at(corner, home) for corner in corners]
    palm = frozenset(welded_behind(model, last))
    try:
        jaws, closed, opened = find_jaws(model, states, palm)
    except ModelError as error:
        raise ModelError(f"{arm.name}: {error}; the tip is {tip!r}") from None
    table = [(1 - s) * corners[closed] + s * corners[opened] for s in np.linspace(0, 1, _TABLE_SIZE)]
    data = states[closed]
    positions = np.zeros((_TABLE_SIZE, model.nq))
    width = np.zeros(_TABLE_SIZE)
    length = np.zeros((_TABLE_SIZE, len(actuators)))
    for k, ctrl in enumerate(table):
        data = at(ctrl, data)
        positions[k] = data.qpos
        width[k] = jaws.width(model, data)
        length[k] = data.actuator_length[list(actuators)]
    size = int(width.argmax()) + 1  # a jaw that turns by more than 180 degrees comes back
    width = np.array(np.maximum.accumulate(width[:size]) + 1e-12 * np.arange(size), dtype=float)  # strictly increasing
    if np.ptp(width) < MIN_OPENING:
        raise ModelError(f"{arm.name}: no gripper: what is behind the tip {tip!r} neither opens nor closes")
    gripper = GripperModel(
        actuators=actuators,
        dofs=dofs,
        jaws=jaws,
        width=frozen(width),
        ctrl=frozen(np.array(table[:size])),
        length=frozen(length[:size]),
        force_max=np.inf,
        inertia=frozen(inertia),
        followers=_indices([] if mechanism is None else mechanism.followers),
        overlapping=_indices([] if mechanism is None else _overlapping(arm, last, positions[_TOUCHING_STATES:size])),
        qpos=frozen(positions[:size]),
        qpos_adr=_indices(arm.model.jnt_qposadr[np.unique(arm.model.dof_jntid[dofs])].tolist()),
    )
    force_limits = np.array([_force_limit(model, a) for a in actuators])
    return replace(gripper, force_max=float(np.min(force_limits / np.abs(gripper.actuator_force(1.0)))))


def _overlapping(arm: Arm, last: int, positions: Array) -> list[int]:
    """The moving geoms of a gripper that touch its own arm in given positions, (k, nq), without an object between them."""
    model = arm.model
    data = mujoco.MjData(model)
    found: set[int] = set()
    for qpos in positions:
        data.qpos[:] = qpos
        mujoco.mj_fwdPosition(model, data)
        for contact in filter(acts, data.contact):
            bodies = model.geom_bodyid[contact.geom]
            moving = [int(g) for g, b in zip(contact.geom, bodies, strict=True) if b != last and is_below(model, int(b), last)]
            if moving and model.body_rootid[bodies[0]] == model.body_rootid[bodies[1]]:
                found.update(moving)
    return sorted(found)


def _indices(values: list[int]) -> IntArray:
    return frozen(np.array(values, dtype=np.int64))


def make_servos(model: mujoco.MjModel, actuators: tuple[int, ...], inertia: Array) -> None:
    """Turns motors into position servos, in place; sets the range of those that have none. Inertia as of `GripperModel`."""
    for a, moved in zip(actuators, inertia, strict=True):
        stiffness = -float(model.actuator_biasprm[a, 1])
        ctrl = int(model.actuator_ctrladr[a])
        joint = -1
        if is_on_joint(model, a) and model.jnt_limited[model.actuator_trnid[a, 0]]:
            joint = int(model.actuator_trnid[a, 0])
        if joint < 0 and (stiffness <= 0 or not model.actuator_ctrllimited[ctrl]):
            raise ModelError(f"the gripper's actuator {actuator_name(model, a)!r} has no range; give its joint one")
        if stiffness <= 0:
            _make_servo(model, a, joint, float(moved))
        if joint >= 0:
            scale = -float(model.actuator_biasprm[a, 1]) / float(model.actuator_gainprm[a, 0])
            low, high = sorted(scale * float(model.actuator_gear[a, 0]) * model.jnt_range[joint])
            if model.actuator_ctrllimited[ctrl] and stiffness > 0:
                low, high = np.clip((low, high), *model.actuator_ctrlrange[ctrl])
            model.actuator_ctrllimited[ctrl] = 1
            model.actuator_ctrlrange[ctrl] = (low, high)


def make_usable(model: mujoco.MjModel, gripper: GripperModel) -> None:
    """Makes servos of a gripper's actuators and lets it move, in place."""
    make_servos(model, gripper.actuators, gripper.inertia)
    model.jnt_limited[gripper.followers] = 0  # in a URDF they often contradict the leading joint's
    # Two geoms touch if one's contype meets the other's conaffinity: without contype these touch other things only.
    model.geom_conaffinity[gripper.overlapping] |= model.geom_contype[gripper.overlapping]
    model.geom_contype[gripper.overlapping] = 0


def _make_servo(model: mujoco.MjModel, actuator: int, joint: int, inertia: float) -> None:
    """Turns a motor into a critically damped servo, which pushes with its full force at a tenth of its range.

    A motor without a force limit, or with one that would make the servo faster than the time step allows, is as stiff as that
    allows.
    """
    bound = _force_limit(model, actuator)
    gear = float(model.actuator_gear[actuator, 0])
    mass = inertia / gear**2
    stiffness = bound / (_FULL_FORCE_FRACTION * abs(gear) * float(np.ptp(model.jnt_range[joint])))
    stiffness = min(stiffness, mass * (_SERVO_BANDWIDTH / model.opt.timestep) ** 2)
    model.actuator_gaintype[actuator] = mujoco.mjtGain.mjGAIN_FIXED
    model.actuator_biastype[actuator] = mujoco.mjtBias.mjBIAS_AFFINE
    model.actuator_gainprm[actuator, 0] = stiffness
    model.actuator_biasprm[actuator, :3] = (0.0, -stiffness, -2.0 * np.sqrt(stiffness * mass))
    if np.isfinite(bound):
        model.actuator_forcelimited[actuator] = 1
        model.actuator_forcerange[actuator] = (-bound, bound)


def _has_range(model: mujoco.MjModel, actuator: int) -> bool:
    if not is_on_joint(model, actuator) or model.jnt_limited[model.actuator_trnid[actuator, 0]]:
        return True
    return bool(model.actuator_biasprm[actuator, 1] < 0 and model.actuator_ctrllimited[model.actuator_ctrladr[actuator]])


def _behind(arm: Arm, last: int) -> tuple[frozenset[int], IntArray]:
    """The last body that the joints to a tip move, with those behind it, and the degrees of freedom among them."""
    model = arm.model
    bodies = frozenset(b for b in range(1, model.nbody) if is_below(model, b, last))
    dofs = [d for d in range(model.nv) if int(model.dof_bodyid[d]) in bodies and d not in arm.dof_adr]
    return bodies, frozen(np.array(dofs, dtype=np.int64))


def _moves(model: mujoco.MjModel, actuator: int, dofs: set[int]) -> bool:
    """Whether an actuator acts on nothing but these degrees of freedom."""
    target = int(model.actuator_trnid[actuator, 0])
    if is_on_joint(model, actuator):
        return int(model.jnt_dofadr[target]) in dofs
    on_tendon = model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_TENDON
    return bool(on_tendon and set(dofs_of_tendon(model, target)) <= dofs)


def _alone(arm: Arm, bodies: frozenset[int], dofs: IntArray, actuators: tuple[int, ...], inertia: Array) -> mujoco.MjModel:
    """A copy of the model in which only the gripper moves: no gravity, other joints braked, other geoms without contact."""
    model = copy.copy(arm.model)
    model.opt.gravity[:] = 0.0
    brake(model, np.setdiff1d(np.arange(model.nv), dofs))
    other = ~np.isin(model.geom_bodyid, list(bodies))
    model.geom_contype[other] = 0
    model.geom_conaffinity[other] = 0
    make_servos(model, actuators, inertia)
    return model


def _settled(
    model: mujoco.MjModel, dofs: IntArray, ctrl: Array, actuators: tuple[int, ...], start: mujoco.MjData
) -> mujoco.MjData:
    """The gripper's state after its controls were held until nothing moves."""
    data = copy.copy(start)
    data.ctrl[model.actuator_ctrladr[list(actuators)]] = ctrl
    begin = data.time
    while data.time < begin + SETTLE_TIMEOUT_S:
        mujoco.mj_step(model, data, 10)
        if data.time > begin + _MIN_SETTLE_S and np.abs(data.qvel[dofs]).max() < _SETTLED_SPEED:
            break
    mujoco.mj_forward(model, data)
    return data


def _force_limit(model: mujoco.MjModel, actuator: int) -> float:
    """The largest force of an actuator, in its own units; infinite if the model sets no limit."""
    limits = [np.inf]
    if model.actuator_forcelimited[actuator]:
        limits.append(float(np.abs(model.actuator_forcerange[actuator]).min()))
    ctrl = int(model.actuator_ctrladr[actuator])
    is_motor = not model.actuator_biasprm[actuator].any()
    if is_motor and model.actuator_ctrllimited[ctrl]:
        gain = float(model.actuator_gainprm[actuator, 0])
        limits.append(abs(gain) * float(np.abs(model.actuator_ctrlrange[ctrl]).min()))
    joint = int(model.actuator_trnid[actuator, 0])
    if is_on_joint(model, actuator) and model.jnt_actfrclimited[joint]:
        gear = abs(float(model.actuator_gear[actuator, 0]))
        limits.append(float(np.abs(model.jnt_actfrcrange[joint]).min()) / gear)
    return min(limits)
