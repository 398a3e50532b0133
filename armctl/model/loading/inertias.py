"""Inertias that no body can have, and moving bodies without mass or inertia: what takes their place."""

import copy
from collections.abc import Iterable

import mujoco
import numpy as np

from armctl.core.note import Note
from armctl.core.validation import Array
from armctl.model.mjmodel.queries import body_name

# Of a moving link without any: a ball of 1 g with a radius of 5 cm.
MIN_MASS_KG = 1e-3
MIN_INERTIA_KG_M2 = 1e-6
_MIN_RELATIVE_SPREAD = 1e-7  # of the greatest second moment: MuJoCo refuses an inertia at the limit of what is possible
_MAX_NAMES = 8
_MASS = '<mass value="..."/>'
_INERTIA = '<inertia ixx="..." ixy="..." .../>'

_NO_INERTIA = (np.nan, 0.0, 0.0, 0.0, 0.0, 0.0)  # no full inertia, as MuJoCo writes it


def correct_inertias(spec: mujoco.MjSpec) -> list[str]:
    """Makes all inertias of a specification possible, in place; one sentence for each kind of change.

    Each body gets the nearest inertia that a body can have, and a moving body without mass or inertia a small one. Where
    the compiler's settings already balance, bound or infer inertias, these apply.
    """
    compiler = spec.compiler
    if compiler.balanceinertia or compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE:
        return []
    unphysical = [body.name for body in spec.bodies if body.explicitinertial and _correct_inertia(body)]
    without: dict[str, list[str]] = {}
    is_bounded = compiler.boundmass > 0.0 or compiler.boundinertia > 0.0
    for body in [] if is_bounded else spec.bodies:
        parts = _welded(body)
        if not body.joints or any(_has_mass(part) and _has_inertia(part) for part in parts):
            continue
        lacks = " or ".join(what for what, has in (("mass", _has_mass(body)), ("inertia", _has_inertia(body))) if not has)
        without.setdefault(lacks, []).append(body.name)
        _complete(body)
    return _sentences(unphysical, without)


def corrected_model(model: mujoco.MjModel) -> tuple[mujoco.MjModel, list[str]]:
    """A compiled model with possible inertias, as `correct_inertias`; the model itself if all are possible."""
    corrected: dict[int, Array] = {}
    for body in range(1, model.nbody):
        if not np.isfinite(model.body_inertia[body]).all() or not model.body_inertia[body].any():
            continue
        given = np.diag(model.body_inertia[body])
        near = nearest_inertia(given)
        if near is not given:
            corrected[body] = near.diagonal()
    if not corrected:
        return model, []
    result = copy.copy(model)
    for body, inertia in corrected.items():
        result.body_inertia[body] = inertia
    mujoco.mj_setConst(result, mujoco.MjData(result))
    return result, _sentences([body_name(model, body) for body in corrected], {})


def inferred_inertias(spec: mujoco.MjSpec) -> list[str]:
    """One sentence on the moving links whose inertia MuJoCo infers from their shapes, or none."""
    moving = [part for body in spec.bodies if body.joints for part in _welded(body)]
    names = [part.name for part in moving if not part.explicitinertial and part.geoms]
    if not names:
        return []
    text = f"no inertial given for {_listed(names)}: mass and inertia are those of the collision shapes at 1000 kg/m^3"
    return [Note(text, f"write <inertial>{_MASS}{_INERTIA}</inertial> into these links")]


def nearest_inertia(inertia: Array) -> Array:
    """The nearest inertia (3, 3) that a distribution of mass has: its moments positive, the sum of two at least the third.

    Nearest by the second moments of mass, `trace(I)/2 - I`, which must have no negative eigenvalue.
    """
    spread, axes = np.linalg.eigh(0.5 * np.trace(inertia) * np.eye(3) - inertia)
    floor = _MIN_RELATIVE_SPREAD * np.abs(spread).max()
    if spread[0] >= 0.0 and spread[0] + spread[1] > floor:  # the latter is the least moment
        return inertia
    spread = np.maximum(spread, floor)
    return axes @ np.diag(spread.sum() - spread) @ axes.T


def _correct_inertia(body: mujoco.MjsBody) -> bool:
    """Makes a link's inertia physically possible; returns whether that changed it."""
    xx, yy, zz, xy, xz, yz = body.fullinertia
    is_full = not np.isnan(xx)
    given = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) if is_full else np.diag(body.inertia)
    if not np.isfinite(given).all():
        return False  # the compiler's error says so
    if np.abs(given).max() <= mujoco.mjMINVAL:
        body.fullinertia = _NO_INERTIA
        return False
    near = nearest_inertia(given)
    if near is given:
        return False
    if is_full:
        body.fullinertia = (*near.diagonal(), near[0, 1], near[0, 2], near[1, 2])
    else:
        body.inertia = near.diagonal()
    return True


def _has_mass(body: mujoco.MjsBody) -> bool:
    return body.mass > mujoco.mjMINVAL if body.explicitinertial else bool(body.geoms)


def _has_inertia(body: mujoco.MjsBody) -> bool:
    if not body.explicitinertial:
        return bool(body.geoms)
    is_full = not np.isnan(body.fullinertia[0])
    return bool((np.array(body.fullinertia[:3] if is_full else body.inertia) > mujoco.mjMINVAL).all())


def _complete(body: mujoco.MjsBody) -> None:
    """Gives a body without mass or inertia the small one that it lacks."""
    keeps_inertia = _has_inertia(body)
    body.explicitinertial = True
    body.mass = max(body.mass, MIN_MASS_KG)
    body.ipos = np.nan_to_num(body.ipos)
    if not keeps_inertia:
        body.inertia = np.full(3, MIN_INERTIA_KG_M2)
        body.fullinertia = _NO_INERTIA


def _welded(body: mujoco.MjsBody) -> list[mujoco.MjsBody]:
    return [body] + [part for child in body.bodies if not child.joints for part in _welded(child)]


def _sentences(unphysical: Iterable[str], without: dict[str, list[str]]) -> list[str]:
    values = {
        "mass": f"{MIN_MASS_KG:g} kg is used",
        "inertia": f"{MIN_INERTIA_KG_M2:g} kg m^2 is used",
        "mass or inertia": f"{MIN_MASS_KG:g} kg and {MIN_INERTIA_KG_M2:g} kg m^2 are used",
    }
    impossible = _listed(list(unphysical))
    notes: list[str] = []
    if impossible:
        text = f"the inertia of {impossible} is impossible (ixx > iyy + izz, or negative): armctl uses the nearest possible one"
        notes.append(Note(text, 'correct <inertia ixx="..." ixy="..." .../> of these links from the CAD model'))
    elements = {"mass": _MASS, "inertia": _INERTIA, "mass or inertia": _MASS + _INERTIA}
    for lacks, names in without.items():
        advice = f"write {elements[lacks]} into the <inertial> of these links"
        notes.append(Note(f"no {lacks} given for {_listed(names)}: {values[lacks]}", advice))
    return notes


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else ""
    return ", ".join(f"{name or 'a body without a name':.60}" for name in names[:_MAX_NAMES]) + more
