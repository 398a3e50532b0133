"""Third stage of loading: build the arms of a prepared model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from armctl.core.limits import Limits
from armctl.core.validation import Array, frozen
from armctl.loading.describe import ArmPlan
from armctl.loading.home import clear_keyframe_controls, home_controls, home_qpos
from armctl.loading.limits import joint_limits
from armctl.mjmodel.target_marker import set_target_start
from armctl.robot.actuation import Actuation
from armctl.robot.arm import Arm, Recipe
from armctl.robot.joint_map import JointMap
from armctl.robot.pinocchio_model import PinocchioModel, build_pinocchio_model

_TARGET_OFFSET = 0.3  # rad (m) from home at every joint: where a target that armctl adds is reached


@dataclass(frozen=True, eq=False)
class _Parts:
    """What an arm consists of, before the model's keyframes and target are set."""

    plan: ArmPlan
    actuation: Actuation
    pinocchio_model: PinocchioModel
    home: Array
    home_qpos: Array
    sources: dict[str, str]


def make_arms(
    name: str, model: mujoco.MjModel, plans: Sequence[ArmPlan], notes: Sequence[str], recipe: Recipe | None
) -> tuple[Arm, ...]:
    """The arms of a prepared model, which is completed in place: the target's start, no controls in the keyframes."""
    qpos = home_qpos(model, tuple(joint for plan in plans for joint in plan.joints))
    parts = [_parts(model, plan, qpos) for plan in plans]
    first = parts[0]
    near_home = first.actuation.limits.clamp(first.home + _TARGET_OFFSET)
    set_target_start(model, first.pinocchio_model.tip(near_home)[0])
    clear_keyframe_controls(model, np.concatenate([part.actuation.ctrl_adr for part in parts]))
    ctrl = home_controls(model)
    return tuple(
        Arm(
            name=name,
            model=model,
            actuation=part.actuation,
            tip=part.plan.tip.name,
            home=part.home,
            pinocchio_model=part.pinocchio_model,
            home_qpos=part.home_qpos,
            home_ctrl=ctrl,
            tip_body=part.plan.tip.body,
            T_body_tip=part.plan.tip.T_body_tip,
            notes=(*notes, *part.plan.notes, *part.plan.quiet_notes),
            sources=part.sources,
            recipe=recipe,
        )
        for part in parts
    )


def _parts(model: mujoco.MjModel, plan: ArmPlan, qpos: Array) -> _Parts:
    joint_map = JointMap.from_transmissions(model, plan.joints, plan.transmissions)
    limits, sources = joint_limits(model, plan.transmissions, qpos, plan.tau_max, plan.datasheet, plan.dc_motors)
    actuation = Actuation.from_model(model, joint_map, plan.transmissions, limits)
    home = _home(limits, qpos[actuation.qpos_adr])
    whole = qpos.copy()
    joint_map.set_positions(whole, home)
    tip = plan.tip
    return _Parts(
        plan=plan,
        actuation=actuation,
        pinocchio_model=build_pinocchio_model(model, len(plan.joints), joint_map, whole, tip.body, tip.T_body_tip),
        home=home,
        home_qpos=frozen(whole),
        sources={"tau_max": plan.tau_source} | sources,
    )


def _home(limits: Limits, q: Array) -> Array:
    """The home configuration: joints that others follow may have narrower limits than their own range."""
    return frozen(limits.clamp(q))
