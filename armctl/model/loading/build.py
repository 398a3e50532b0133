"""Third stage of loading: build the arm of a prepared model."""

import copy
from collections.abc import Sequence
from dataclasses import fields, replace

import mujoco
import numpy as np

from armctl.core.limits import Limits
from armctl.core.validation import Array, frozen
from armctl.model.arm.actuation import Actuation
from armctl.model.arm.arm import Arm, Recipe
from armctl.model.arm.joint_map import JointMap
from armctl.model.arm.pinocchio_model import TipFrame, build_pinocchio_model
from armctl.model.loading.arm_plan import ArmPlan
from armctl.model.loading.home import closed_home, home_controls, home_qpos
from armctl.model.loading.joint_limits import joint_limits, position_limits
from armctl.model.mjmodel.queries import joints_above
from armctl.model.mjmodel.target_marker import set_target_start

_TARGET_OFFSET = 0.3  # rad (m) from home at every joint: where a target that armctl adds is reached


def make_arm(
    name: str,
    model: mujoco.MjModel,
    plan: ArmPlan,
    notes: Sequence[str],
    recipe: Recipe | None,
    unchecked_links: tuple[str, ...] = (),
) -> Arm:
    """The arm of a prepared model, which is completed in place: the target's start, no controls in the keyframes."""
    arm = _arm(name, model, plan, notes, recipe)
    set_target_start(model, _target_start(arm))
    model.key_ctrl[:, arm.ctrl_adr] = 0.0  # they hold angles for what are torques now
    return replace(arm, home_ctrl=home_controls(model), unchecked_links=unchecked_links)


def arm_to(arm: Arm, tip: str) -> Arm:
    """The chain to one tip of an arm with several, without closed loops; brakes hold the other joints in a simulation."""
    frame = arm.tip_frames[arm.tips.index(tip)]
    model = copy.copy(arm.model)
    own = list(arm.joints_to(tip))
    whole = arm.joint_map
    whole.require_no_loops()
    chain = [joint for joint in joints_above(model, frame.body) if joint in whole.joints]
    moved = [joint for joint, row in zip(whole.joints, whole.moved, strict=True) if row[own].any() and joint not in chain]
    rows = [whole.joints.index(joint) for joint in (*chain, *moved)]
    joint_map = JointMap(
        joints=(*chain, *moved),
        leaders=frozen(np.array([rows.index(leader) for leader in whole.leaders[own]])),
        fixed_ratio=frozen(whole.fixed_ratio[np.ix_(rows, own)]),
        offset=frozen(whole.offset[rows]),
        qpos_adr=frozen(whole.qpos_adr[rows]),
        dof_adr=frozen(whole.dof_adr[rows]),
    )
    actuation = arm.actuation
    part = replace(
        arm,
        model=model,
        actuation=Actuation(
            joint_names=tuple(actuation.joint_names[i] for i in own),
            joint_map=joint_map,
            limits=Limits(**{field.name: getattr(actuation.limits, field.name)[own] for field in fields(Limits)}),
            units=tuple(actuation.units[i] for i in own),
            qpos_adr=frozen(actuation.qpos_adr[own]),
            dof_adr=frozen(actuation.dof_adr[own]),
            ctrl_adr=frozen(actuation.ctrl_adr[own]),
            motor_adr=frozen(actuation.motor_adr[own]),
            gear=frozen(actuation.gear[own]),
        ),
        tip=frame.name,
        tip_body=frame.body,
        T_body_tip=frame.T_body_tip,
        further_tips=(),
        home=frozen(arm.home[own]),
        pinocchio_model=build_pinocchio_model(model, len(chain), joint_map, arm.home_qpos, [frame]),
    )
    set_target_start(model, _target_start(part), before=_target_start(arm))
    return part


def _target_start(arm: Arm) -> Array:
    """(3,) m, where a target that armctl adds starts."""
    return arm.fk(arm.limits.clamp(arm.home + _TARGET_OFFSET)).position


def _arm(name: str, model: mujoco.MjModel, plan: ArmPlan, notes: Sequence[str], recipe: Recipe | None) -> Arm:
    """An arm in a model, with the controls of keyframes that are not cleared yet."""
    qpos = home_qpos(model, plan.joints)
    joint_map = JointMap.from_transmissions(model, plan.joints, plan.transmissions, plan.loops, qpos)
    closed = joint_map if joint_map.closure is not None else None
    if closed is not None:
        qpos = closed_home(model, joint_map, position_limits(model, plan.transmissions), qpos)
    limits, sources, defaults = joint_limits(
        model, plan.transmissions, qpos, plan.tau_max, plan.datasheet, plan.dc_motors, closed
    )
    actuation = Actuation.from_model(model, joint_map, plan.transmissions, limits)
    home = frozen(limits.clamp(qpos[actuation.qpos_adr]))  # joints that others follow may have narrower limits than their range
    whole = qpos.copy()
    joint_map.set_positions(whole, home)
    tip = plan.tip
    frames = [TipFrame(each.name, each.body, each.T_body_tip) for each in (tip, *plan.further_tips)]
    return Arm(
        name=name,
        model=model,
        actuation=actuation,
        tip=tip.name,
        home=home,
        pinocchio_model=build_pinocchio_model(model, plan.chain_length, joint_map, whole, frames),
        home_qpos=frozen(whole),
        home_ctrl=home_controls(model),
        tip_body=tip.body,
        T_body_tip=tip.T_body_tip,
        notes=(*notes, *plan.notes, *plan.info_notes),
        sources={"tau_max": plan.tau_source} | sources,
        default_limits=defaults,
        recipe=recipe,
        further_tips=tuple(frames[1:]),
        base=plan.base,
    )
