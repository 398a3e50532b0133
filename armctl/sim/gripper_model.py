"""GripperModel: the gripper behind an arm's tip, found in the MuJoCo model: actuators, pads, and the control for each width."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from itertools import combinations, product

import mujoco
import numpy as np

from armctl.core.errors import ModelError
from armctl.core.validation import Array, IntArray, frozen
from armctl.mjmodel.couplings import dofs_of_tendon
from armctl.mjmodel.queries import actuator_name, branches, is_below, is_on_joint, welded_behind
from armctl.robot.arm import Arm
from armctl.sim.plant import brake

_TABLE_SIZE = 12  # widths for which the controls are tabulated
_SETTLE_TIMEOUT_S = 1.0  # for each of them
_MIN_SETTLE_S = 0.1
_SETTLED_SPEED = 1e-4  # rad/s, m/s
_MIN_OPENING = 1e-3  # m
# The pads are the two geoms whose distance changes most. A gap that remains in the closed gripper counts against them.
_GAP_WEIGHT = 3.0
# A servo made of a motor pushes with its full force at this fraction of the joint's range.
_FULL_FORCE_FRACTION = 0.1
_MAX_DISTANCE = 1.0  # m, up to which distances are computed


@dataclass(frozen=True, eq=False)
class GripperModel:
    """A gripper of one actuator, or of two that move together.

    Attributes:
        actuators: The indices of the actuators.
        dofs: Addresses in `MjData.qvel` of all joints that move with the gripper.
        pads: The two geoms that meet when it closes; the width is the distance between them.
        sides: The bodies on the side of each pad.
        width: (k,) m, increasing from closed to open.
        ctrl: (k, actuators) the controls for each width.
        length: (k, actuators) the lengths of the actuators at each width.
        force_max: N, the largest force between the pads; infinite if the model sets no limit.
    """

    actuators: tuple[int, ...]
    dofs: IntArray
    pads: tuple[int, int]
    sides: tuple[frozenset[int], frozenset[int]]
    width: Array
    ctrl: Array
    length: Array
    force_max: float

    def ctrl_at(self, width: float) -> Array:
        """(actuators,) controls for a width, m."""
        return np.array([np.interp(width, self.width, column) for column in self.ctrl.T])

    def actuator_force(self, force: float) -> Array:
        """(actuators,) forces that press the pads together with a force, N, by virtual work: sum f dl = -F dw."""
        slope = np.ptp(self.width) / (self.length[-1] - self.length[0])
        return -force * slope / len(self.actuators)


def find_gripper_model(arm: Arm) -> GripperModel:
    """The gripper behind an arm's tip.

    The gripper is closed and opened alone, without gravity, to find which of its geoms meet and which width each control gives.

    Raises:
        ModelError: Nothing moves behind the tip, or it is a hand of many actuators.
    """
    bodies, dofs = _behind(arm)
    actuators = tuple(a for a in range(arm.model.nu) if _moves(arm.model, a, set(dofs.tolist())))
    if not actuators:
        raise ModelError(f"{arm.name}: no gripper: no actuator moves anything behind the tip {arm.tip!r}")
    if len(actuators) > 2:
        raise ModelError(
            f"{arm.name}: {len(actuators)} actuators move what is behind the tip {arm.tip!r}: a hand, not a gripper; "
            "load its fingers as chains"
        )
    model = _alone(arm, bodies, dofs, actuators)
    ends = [model.actuator_ctrlrange[a] for a in actuators]
    corners = [np.array(corner) for corner in product(*ends)]
    states = [_settled(model, arm, dofs, corner, actuators) for corner in corners]
    palm = frozenset(welded_behind(model, _last_body(arm)))
    pads, sides, closed, opened = _pads(model, states, palm)
    table = [(1 - s) * corners[closed] + s * corners[opened] for s in np.linspace(0, 1, _TABLE_SIZE)]
    data = states[closed]
    width = np.zeros(_TABLE_SIZE)
    length = np.zeros((_TABLE_SIZE, len(actuators)))
    for k, ctrl in enumerate(table):
        data = _settled(model, arm, dofs, ctrl, actuators, data)
        width[k] = pad_distance(model, data, pads)
        length[k] = data.actuator_length[list(actuators)]
    width[:] = np.maximum.accumulate(width) + 1e-12 * np.arange(_TABLE_SIZE)  # strictly increasing, for interpolation
    if np.ptp(width) < _MIN_OPENING:
        raise ModelError(f"{arm.name}: no gripper: what is behind the tip {arm.tip!r} neither opens nor closes")
    gripper = GripperModel(
        actuators=actuators,
        dofs=dofs,
        pads=pads,
        sides=sides,
        width=frozen(width),
        ctrl=frozen(np.array(table)),
        length=frozen(length),
        force_max=np.inf,
    )
    force_limits = np.array([_force_limit(model, a) for a in actuators])
    return replace(gripper, force_max=float(np.min(force_limits / np.abs(gripper.actuator_force(1.0)))))


def pad_distance(model: mujoco.MjModel, data: mujoco.MjData, pads: tuple[int, int]) -> float:
    """The distance between two geoms, m, in a state whose positions are computed; 0 if they touch."""
    return max(0.0, mujoco.mj_geomDistance(model, data, *pads, _MAX_DISTANCE, None))


def make_servos(model: mujoco.MjModel, actuators: tuple[int, ...]) -> None:
    """Turns motors into position servos, in place; sets the range of other actuators that have none.

    Raises:
        ModelError: A motor without limits, or one on a tendon.
    """
    for a in actuators:
        stiffness = -float(model.actuator_biasprm[a, 1])
        ctrl = int(model.actuator_ctrladr[a])
        joint = -1
        if is_on_joint(model, a) and model.jnt_limited[model.actuator_trnid[a, 0]]:
            joint = int(model.actuator_trnid[a, 0])
        if joint < 0 and (stiffness <= 0 or not model.actuator_ctrllimited[ctrl]):
            raise ModelError(f"the gripper's actuator {actuator_name(model, a)!r} has no range; give it a ctrlrange")
        if stiffness <= 0:
            _make_servo(model, a, joint)
        if joint >= 0:
            scale = -float(model.actuator_biasprm[a, 1]) / float(model.actuator_gainprm[a, 0])
            low, high = sorted(scale * float(model.actuator_gear[a, 0]) * model.jnt_range[joint])
            if model.actuator_ctrllimited[ctrl] and stiffness > 0:
                low, high = np.clip((low, high), *model.actuator_ctrlrange[ctrl])
            model.actuator_ctrllimited[ctrl] = 1
            model.actuator_ctrlrange[ctrl] = (low, high)


def _make_servo(model: mujoco.MjModel, actuator: int, joint: int) -> None:
    """Turns a motor into a critically damped servo, which pushes with its full force at a tenth of its range."""
    bound = _force_limit(model, actuator)
    gear = float(model.actuator_gear[actuator, 0])
    if not np.isfinite(bound):
        raise ModelError(f"the gripper's actuator {actuator_name(model, actuator)!r} is a motor without a force limit")
    stiffness = bound / (_FULL_FORCE_FRACTION * abs(gear) * float(np.ptp(model.jnt_range[joint])))
    inertia = float(model.dof_M0[model.jnt_dofadr[joint]]) / gear**2
    model.actuator_gaintype[actuator] = mujoco.mjtGain.mjGAIN_FIXED
    model.actuator_biastype[actuator] = mujoco.mjtBias.mjBIAS_AFFINE
    model.actuator_gainprm[actuator, 0] = stiffness
    model.actuator_biasprm[actuator, :3] = (0.0, -stiffness, -2.0 * np.sqrt(stiffness * inertia))
    model.actuator_forcelimited[actuator] = 1
    model.actuator_forcerange[actuator] = (-bound, bound)


def _last_body(arm: Arm) -> int:
    return int(arm.model.dof_bodyid[arm.dof_adr[-1]])


def _behind(arm: Arm) -> tuple[frozenset[int], IntArray]:
    """The bodies that the last joint moves, and the degrees of freedom among them."""
    model = arm.model
    last = _last_body(arm)
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


def _alone(arm: Arm, bodies: frozenset[int], dofs: IntArray, actuators: tuple[int, ...]) -> mujoco.MjModel:
    """A copy of the model in which only the gripper moves: no gravity, other joints braked, other geoms without contact."""
    model = copy.copy(arm.model)
    model.opt.gravity[:] = 0.0
    brake(model, np.setdiff1d(np.arange(model.nv), dofs))
    other = ~np.isin(model.geom_bodyid, list(bodies))
    model.geom_contype[other] = 0
    model.geom_conaffinity[other] = 0
    make_servos(model, actuators)
    return model


def _settled(
    model: mujoco.MjModel,
    arm: Arm,
    dofs: IntArray,
    ctrl: Array,
    actuators: tuple[int, ...],
    start: mujoco.MjData | None = None,
) -> mujoco.MjData:
    """The gripper's state after its controls were held until nothing moves."""
    data = mujoco.MjData(model) if start is None else copy.copy(start)
    if start is None:
        data.qpos[:] = arm.home_qpos
    data.ctrl[model.actuator_ctrladr[list(actuators)]] = ctrl
    begin = data.time
    while data.time < begin + _SETTLE_TIMEOUT_S:
        mujoco.mj_step(model, data, 10)
        if data.time > begin + _MIN_SETTLE_S and np.abs(data.qvel[dofs]).max() < _SETTLED_SPEED:
            break
    mujoco.mj_forward(model, data)
    return data


def _pads(
    model: mujoco.MjModel, states: list[mujoco.MjData], palm: frozenset[int]
) -> tuple[tuple[int, int], tuple[frozenset[int], frozenset[int]], int, int]:
    """The two geoms that meet when the gripper closes and separate most when it opens; their sides; both states."""
    last = min(palm)
    sides = [frozenset(b for b in range(model.nbody) if is_below(model, b, root)) for root in branches(model, last)]
    solid = (model.geom_contype | model.geom_conaffinity) != 0
    geoms = [[int(g) for g in np.flatnonzero(np.isin(model.geom_bodyid, list(s)) & solid)] for s in (*sides, palm)]
    pairs = [
        (pair, (first, second))
        for (first, some), (second, others) in combinations(zip((*sides, palm), geoms, strict=True), 2)
        for pair in product(some, others)
    ]
    if not pairs:
        raise ModelError("no gripper: nothing behind the tip can touch anything")
    distance = np.array([[pad_distance(model, data, pair) for data in states] for pair, _ in pairs])
    best = int(np.argmax(np.ptp(distance, axis=1) - _GAP_WEIGHT * distance.min(axis=1)))
    pads, chosen = pairs[best]
    return pads, chosen, int(distance[best].argmin()), int(distance[best].argmax())


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
