"""GripperModel: what grips behind the tip of an arm, found in the model: actuators, pads, and the control for each width."""

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

_STEPS = 12  # widths in the table
_SETTLE = 1.0  # s for the jaws to come to rest at each
_STILL = 1e-4  # rad/s, m/s
_LEAST_OPENING = 1e-3  # m
_GAP_WEIGHT = 3.0  # how much a gap that stays when closed speaks against two geoms being the pads
_SERVO_SHARE = 0.1  # of its range that makes a servo of a motor push with all its force
_FAR = 1.0  # m: as far as distances are looked for


@dataclass(frozen=True, eq=False)
class GripperModel:
    """A gripper of one actuator, or of two that move together.

    Attributes:
        actuators: Their numbers.
        dofs: Where everything that moves with it is in `MjData.qvel`.
        pads: The two geoms that meet when it closes; the width is the distance between them.
        sides: The bodies of either pad's side.
        width: (k,) m, rising from closed to open.
        ctrl: (k, actuators) the controls that make each width.
        length: (k, actuators) the actuators' lengths at each width.
        force_max: N between the pads that the actuators can make; infinite where the model sets no limit.
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
        """The controls for a width.

        Args:
            width: m.

        Returns:
            (actuators,).
        """
        return np.array([np.interp(width, self.width, column) for column in self.ctrl.T])

    def actuator_force(self, force: float) -> Array:
        """The actuators' forces that press the pads together, by virtual work: sum f dl = -F dw.

        Args:
            force: N between the pads.

        Returns:
            (actuators,) in the actuators' units.
        """
        slope = np.ptp(self.width) / (self.length[-1] - self.length[0])
        return -force * slope / len(self.actuators)


def find_gripper_model(arm: Arm) -> GripperModel:
    """The gripper behind an arm's tip.

    The model is closed and opened alone, without gravity, to see which of its geoms meet and how wide each control opens it.

    Args:
        arm: The arm.

    Returns:
        The gripper.

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
    table = [(1 - s) * corners[closed] + s * corners[opened] for s in np.linspace(0, 1, _STEPS)]
    data = states[closed]
    width, length = np.zeros(_STEPS), np.zeros((_STEPS, len(actuators)))
    for k, ctrl in enumerate(table):
        data = _settled(model, arm, dofs, ctrl, actuators, data)
        width[k], length[k] = pad_distance(model, data, pads), data.actuator_length[list(actuators)]
    width[:] = np.maximum.accumulate(width) + 1e-12 * np.arange(_STEPS)
    if np.ptp(width) < _LEAST_OPENING:
        raise ModelError(f"{arm.name}: no gripper: what is behind the tip {arm.tip!r} neither opens nor closes")
    jaws = GripperModel(actuators, dofs, pads, sides, frozen(width), frozen(np.array(table)), frozen(length), np.inf)
    strongest = np.array([_force_limit(model, a) for a in actuators])
    return replace(jaws, force_max=float(np.min(strongest / np.abs(jaws.actuator_force(1.0)))))


def pad_distance(model: mujoco.MjModel, data: mujoco.MjData, pads: tuple[int, int]) -> float:
    """How far two geoms are apart.

    Args:
        model: The model.
        data: Its state, positions computed.
        pads: The geoms.

    Returns:
        m; 0 where they touch.
    """
    return max(0.0, mujoco.mj_geomDistance(model, data, *pads, _FAR, None))


def make_servos(model: mujoco.MjModel, actuators: tuple[int, ...]) -> None:
    """Makes position servos of those actuators that are motors, in place; of others, sets the range where they have none.

    Args:
        model: The model.
        actuators: The actuators.

    Raises:
        ModelError: A motor without limits, or one on a tendon.
    """
    for a in actuators:
        stiffness, ctrl, joint = -float(model.actuator_biasprm[a, 1]), int(model.actuator_ctrladr[a]), -1
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
            model.actuator_ctrllimited[ctrl], model.actuator_ctrlrange[ctrl] = 1, (low, high)


def _make_servo(model: mujoco.MjModel, actuator: int, joint: int) -> None:
    """Makes a critically damped servo of a motor, which pushes with all its force at a tenth of its range."""
    bound, gear = _force_limit(model, actuator), float(model.actuator_gear[actuator, 0])
    if not np.isfinite(bound):
        raise ModelError(f"the gripper's actuator {actuator_name(model, actuator)!r} is a motor without a force limit")
    stiffness = bound / (_SERVO_SHARE * abs(gear) * float(np.ptp(model.jnt_range[joint])))
    inertia = float(model.dof_M0[model.jnt_dofadr[joint]]) / gear**2
    model.actuator_gaintype[actuator] = mujoco.mjtGain.mjGAIN_FIXED
    model.actuator_biastype[actuator] = mujoco.mjtBias.mjBIAS_AFFINE
    model.actuator_gainprm[actuator, 0] = stiffness
    model.actuator_biasprm[actuator, :3] = 0.0, -stiffness, -2.0 * np.sqrt(stiffness * inertia)
    model.actuator_forcelimited[actuator], model.actuator_forcerange[actuator] = 1, (-bound, bound)


def _last_body(arm: Arm) -> int:
    return int(arm.model.dof_bodyid[arm.dof_adr[-1]])


def _behind(arm: Arm) -> tuple[frozenset[int], IntArray]:
    """The bodies that the last joint carries, and the degrees of freedom among them."""
    model, last = arm.model, _last_body(arm)
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
    """A copy of the model in which the gripper moves alone: no gravity, all else braked and out of touch."""
    model = copy.copy(arm.model)
    model.opt.gravity[:] = 0.0
    brake(model, np.setdiff1d(np.arange(model.nv), dofs))
    other = ~np.isin(model.geom_bodyid, list(bodies))
    model.geom_contype[other] = model.geom_conaffinity[other] = 0
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
    """The gripper's state after its controls have been held until nothing moves."""
    data = mujoco.MjData(model) if start is None else copy.copy(start)
    if start is None:
        data.qpos[:] = arm.home_qpos
    data.ctrl[model.actuator_ctrladr[list(actuators)]] = ctrl
    begin = data.time
    while data.time < begin + _SETTLE:
        mujoco.mj_step(model, data, 10)
        if data.time > begin + 0.1 * _SETTLE and np.abs(data.qvel[dofs]).max() < _STILL:
            break
    mujoco.mj_forward(model, data)
    return data


def _pads(
    model: mujoco.MjModel, states: list[mujoco.MjData], palm: frozenset[int]
) -> tuple[tuple[int, int], tuple[frozenset[int], frozenset[int]], int, int]:
    """The two geoms that meet when the gripper closes and part most when it opens; their sides; which state is which."""
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
    """The greatest force of an actuator, in its own units; infinite where the model sets none."""
    limits = [np.inf]
    if model.actuator_forcelimited[actuator]:
        limits.append(float(np.abs(model.actuator_forcerange[actuator]).min()))
    ctrl, is_motor = int(model.actuator_ctrladr[actuator]), not model.actuator_biasprm[actuator].any()
    if is_motor and model.actuator_ctrllimited[ctrl]:
        gain = float(model.actuator_gainprm[actuator, 0])
        limits.append(abs(gain) * float(np.abs(model.actuator_ctrlrange[ctrl]).min()))
    joint = int(model.actuator_trnid[actuator, 0])
    if is_on_joint(model, actuator) and model.jnt_actfrclimited[joint]:
        gear = abs(float(model.actuator_gear[actuator, 0]))
        limits.append(float(np.abs(model.jnt_actfrcrange[joint]).min()) / gear)
    return min(limits)
