"""Third stage of loading: build the arm of a prepared model."""

from collections.abc import Sequence
from dataclasses import replace

import mujoco

from armctl.core.validation import frozen
from armctl.model.arm.actuation import Actuation
from armctl.model.arm.arm import Arm, Recipe
from armctl.model.arm.joint_map import JointMap
from armctl.model.arm.pinocchio_model import TipFrame, build_pinocchio_model
from armctl.model.loading.arm_plan import ArmPlan
from armctl.model.loading.home import closed_home, home_controls, home_qpos
from armctl.model.loading.joint_limits import joint_limits, position_limits
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
    near_home = arm.limits.clamp(arm.home + _TARGET_OFFSET)
    set_target_start(model, arm.fk(near_home).position)
    model.key_ctrl[:, arm.ctrl_adr] = 0.0  # they hold angles for what are torques now
    return replace(arm, home_ctrl=home_controls(model), unchecked_links=unchecked_links)


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
