"""Second stage of loading: make a model whose arms have torque motors, from a specification or from a compiled model."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco

from armctl.loading.catalog import Source
from armctl.loading.describe import ArmPlan
from armctl.loading.motors import make_motors, make_motors_in_model
from armctl.loading.neighbor_contacts import overlapping_neighbors
from armctl.mjmodel.edit import add_payload_bodies, payload_body
from armctl.mjmodel.queries import body_name
from armctl.mjmodel.target_marker import add_target, find_target
from armctl.mjmodel.transmissions import Transmissions


@dataclass(frozen=True, eq=False)
class PreparedModel:
    """A model with torque motors.

    Attributes:
        model: The compiled model.
        plans: The arms; their bodies are numbered as in this model.
        notes: What was changed besides the motors, one sentence each; they are reported as warnings.
        quiet_notes: Changes that need no warning, one sentence each.
    """

    model: mujoco.MjModel
    plans: tuple[ArmPlan, ...]
    notes: tuple[str, ...]
    quiet_notes: tuple[str, ...]


def make_arm_model(source: Source, spec: mujoco.MjSpec, analysis: Transmissions, plans: Sequence[ArmPlan]) -> PreparedModel:
    """Gives the arms torque motors, adds the target and compiles; `spec` is changed in place.

    Args:
        source: Where the model comes from, for errors.
        spec: The specification that `analysis.model` was compiled from.
        analysis: The analysis of the compiled model.
        plans: The arms.

    Raises:
        ModelError: MuJoCo cannot compile the result.
    """
    original = analysis.model
    bodies = {body.id: body for body in spec.bodies}
    notes: list[str] = []
    excluded: list[str] = []
    for plan in plans:
        notes += make_motors(spec, analysis, plan.transmissions, plan.tau_max)
    for plan in plans:
        for first, second in overlapping_neighbors(original, plan.joints):
            spec.add_exclude(bodyname1=first, bodyname2=second)
            excluded.append(f"contact of {first} with {second} left out: neighbours that overlap at home")
    add_target(spec)
    add_payload_bodies(spec, original, {plan.tip.body: bodies[plan.tip.body] for plan in plans})
    model = source.compile(spec)
    renumbered = tuple(plan.with_tip_body(bodies[plan.tip.body].id) for plan in plans)
    return PreparedModel(model, renumbered, tuple(notes), tuple(excluded))


def make_arm_model_from_compiled(analysis: Transmissions, plans: Sequence[ArmPlan]) -> PreparedModel:
    """Gives the arms torque motors in a copy of the compiled model.

    A compiled model cannot get further elements, so there are no excluded contacts, no target and no body for payloads.

    Args:
        analysis: The analysis of the compiled model, which is not changed.
        plans: The arms.

    Raises:
        ModelError: An actuator has an activation state, a delay or a plugin, which a compiled model cannot lose.
    """
    original = analysis.model
    model = copy.copy(original)
    notes: list[str] = []
    for plan in plans:
        notes += make_motors_in_model(model, analysis, plan.transmissions, plan.tau_max)
        for first, second in overlapping_neighbors(original, plan.joints):
            notes.append(f"{first} and {second} overlap at home, and their contact brakes the joint; exclude it in the MJCF")
        if payload_body(original, plan.tip.body) is None:
            body = body_name(original, plan.tip.body)
            notes.append(f"gravcomp lifts {body} and would lift a payload with it; give the MjSpec for right payloads")
    mujoco.mj_setConst(model, mujoco.MjData(model))
    quiet = [] if find_target(model) else ["the model has no target marker, and a compiled model cannot get one"]
    return PreparedModel(model, tuple(plans), tuple(notes), tuple(quiet))
