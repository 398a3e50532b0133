"""Second stage of loading: make a model whose arm has torque motors, from a specification or from a compiled model."""

import copy
from collections.abc import Callable, Collection
from dataclasses import dataclass

import mujoco

from armctl.core.errors import few_names
from armctl.core.note import Note
from armctl.model.loading.actuators import mend_solver
from armctl.model.loading.arm_plan import ArmPlan
from armctl.model.loading.catalog import Source
from armctl.model.loading.motors import adapt_keyframes, make_motors, make_motors_in_model
from armctl.model.loading.neighbor_contacts import overlapping_neighbors, touching_links, unavoidable_contacts
from armctl.model.mjmodel.edit import add_payload_bodies, payload_body
from armctl.model.mjmodel.queries import Joints, body_name, name_of
from armctl.model.mjmodel.target_marker import add_target, find_target
from armctl.model.mjmodel.transmissions import Transmissions

_MAX_NAMES_CHARACTERS = 200  # of links in a note
# MuJoCo's mjMAXIMP: of the loops of an arm, whose closure all but the simulation takes as exact
_STIFF_IMPEDANCE = 0.9999


@dataclass(frozen=True, eq=False)
class PreparedModel:
    """A model with torque motors."""

    model: mujoco.MjModel
    plan: ArmPlan  # the arm; its bodies are numbered as in this model
    notes: tuple[str, ...]  # what was changed besides the motors, one sentence each; they are reported as warnings
    info_notes: tuple[str, ...]  # changes that need no warning, one sentence each
    unchecked_links: tuple[str, ...] = ()  # links without a collision shape that they need
    shape_note: str = ""  # what is noted about them, one sentence; empty if there are none


def make_arm_model(
    source: Source,
    spec: mujoco.MjSpec,
    analysis: Transmissions,
    plan: ArmPlan,
    links_without_contact_rules: Collection[str] = (),
    edit: Callable[[mujoco.MjSpec], None] | None = None,
) -> PreparedModel:
    """Gives the arm torque motors, adds the target and compiles; `spec`, from which `analysis.model` came, is changed.

    `links_without_contact_rules` are bodies of which no file says which of them may touch: those that touch at home
    may. `edit` is the last change.
    """
    original = analysis.model
    bodies = {body.id: body for body in spec.bodies}
    notes = make_motors(spec, analysis, plan.transmissions, plan.tau_max, plan.dc_motors)
    excluded = mend_solver(original, spec.option)
    loops = {each.id: each for each in spec.equalities}
    for equality in _loops_of(plan):
        loops[equality].solref = (2 * spec.option.timestep, 1.0)
        loops[equality].solimp[:3] = (_STIFF_IMPEDANCE, _STIFF_IMPEDANCE, loops[equality].solimp[2])
    excluded += _stiff_notes(original, plan)
    adapt_keyframes(spec, analysis, [plan.transmissions])
    neighbors = overlapping_neighbors(original, plan.joints)
    for first, second in neighbors:
        spec.add_exclude(bodyname1=first, bodyname2=second)
        excluded.append(
            f"contact of {first} with {second} left out: neighbours that overlap at home; in MuJoCo alone their friction "
            "brakes the joint"
        )
    for first, second in unavoidable_contacts(original, plan.joints):
        if (first, second) not in neighbors:
            spec.add_exclude(bodyname1=first, bodyname2=second)
        notes.append(f"{first} overlaps with {second} wherever the arm is; their contact is left out")
    if links_without_contact_rules:
        notes += _exclude_touching(spec, original, plan.joints, links_without_contact_rules)
    add_target(spec)
    add_payload_bodies(spec, original, {tip.body: bodies[tip.body] for tip in (plan.tip, *plan.further_tips)})
    if edit is not None:
        edit(spec)
    model = source.compile(spec)
    renumbered = plan.renumbered(lambda body: bodies[body].id)
    return PreparedModel(model=model, plan=renumbered, notes=tuple(notes), info_notes=tuple(excluded))


def _loops_of(plan: ArmPlan) -> list[int]:
    """The equalities that close loops over the joints of an arm."""
    return [equality for loop in plan.loops for equality in (*loop.equalities, *loop.ties, *loop.couplings)]


def _stiff_notes(model: mujoco.MjModel, plan: ArmPlan) -> list[str]:
    """One sentence on loops that a simulation holds more stiffly than the file says, or none."""
    names = [name_of(model, mujoco.mjtObj.mjOBJ_EQUALITY, equality) for equality in _loops_of(plan)]
    if not names:
        return []
    return [f"the constraints of {few_names(names)} are as stiff as the time step permits: the loops count as rigid"]


def _exclude_touching(spec: mujoco.MjSpec, model: mujoco.MjModel, joints: Joints, links: Collection[str]) -> list[str]:
    """Excludes the contacts of links that touch at home, in place; one sentence, or none."""
    present = {frozenset((exclude.bodyname1, exclude.bodyname2)) for exclude in spec.excludes}
    pairs = [pair for pair in touching_links(model, joints, links) if frozenset(pair) not in present]
    for first, second in pairs:
        spec.add_exclude(bodyname1=first, bodyname2=second)
    if not pairs:
        return []
    names = ", ".join(f"{first} with {second}" for first, second in pairs)
    shown_names = names if len(names) <= _MAX_NAMES_CHARACTERS else f"{names[:_MAX_NAMES_CHARACTERS]}..."
    noun = "pair of links" if len(pairs) == 1 else "pairs of links"
    text = f"contacts of {len(pairs)} {noun} left out, since they touch at home ({shown_names}); srdf= can give the right pairs"
    return [Note(text, "list the pairs in an SRDF, or as <contact><exclude .../></contact> (MJCF)")]


def make_arm_model_from_compiled(analysis: Transmissions, plan: ArmPlan) -> PreparedModel:
    """Gives the arm torque motors in a copy of the compiled model.

    A compiled model cannot get further elements, so there are no excluded contacts, no target and no body for payloads.
    """
    original = analysis.model
    model = copy.copy(original)
    notes = make_motors_in_model(model, analysis, plan.transmissions, plan.tau_max, plan.dc_motors)
    for first, second in overlapping_neighbors(original, plan.joints):
        notes.append(f"{first} and {second} overlap at home, and their contact brakes the joint; exclude it in the MJCF")
    if payload_body(original, plan.tip.body) is None:
        body = body_name(original, plan.tip.body)
        notes.append(f"gravcomp lifts {body} and would also lift a payload; pass the MjSpec for correct payloads")
    loops = _loops_of(plan)
    model.eq_solref[loops] = (2 * model.opt.timestep, 1.0)
    model.eq_solimp[loops, :2] = _STIFF_IMPEDANCE
    mujoco.mj_setConst(model, mujoco.MjData(model))
    mended = mend_solver(model, model.opt)
    quiet = _stiff_notes(original, plan)
    quiet += [] if find_target(model) else ["the model has no target marker, and a compiled model cannot get one"]
    return PreparedModel(model=model, plan=plan, notes=tuple(notes), info_notes=(*mended, *quiet))
