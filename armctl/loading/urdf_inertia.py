"""Corrects masses and inertias that a URDF leaves out or gets wrong, so that MuJoCo can simulate it; notes each change."""

from __future__ import annotations

import mujoco
import numpy as np

from armctl.core.validation import Array

# Of a moving link without any: a ball of 1 g with a radius of 5 cm.
MIN_MASS_KG = 1e-3
MIN_INERTIA_KG_M2 = 1e-6
_MIN_RELATIVE_SPREAD = 1e-7  # of the greatest second moment: MuJoCo refuses an inertia at the limit of what is possible

_NO_INERTIA = (np.nan, 0.0, 0.0, 0.0, 0.0, 0.0)  # no full inertia, as MuJoCo writes it


def correct_inertias(spec: mujoco.MjSpec) -> list[str]:
    """Gives every link the nearest inertia that a body can have, and moving links without a mass a small one, with notes."""
    unphysical = [body.name for body in spec.bodies if body.explicitinertial and _correct_inertia(body)]
    moving = {body.name: _welded(body) for body in spec.bodies if body.joints}
    massless = [name for name, parts in moving.items() if not any(map(_has_mass, parts))]
    inferred = [part.name for parts in moving.values() for part in parts if not part.explicitinertial and part.geoms]
    for name in massless:
        _give_mass(moving[name][0])
    sentences = {
        "the inertia of {} is one that no body has: armctl uses the nearest possible one": unphysical,
        f"no mass or inertia given for {{}}: {MIN_MASS_KG:g} kg and {MIN_INERTIA_KG_M2:g} kg m^2 at least are used": massless,
        "no inertial given for {}: mass and inertia are those of the collision shapes at 1000 kg/m^3": inferred,
    }
    return [sentence.format(", ".join(names)) for sentence, names in sentences.items() if names]


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
    if np.isnan(xx):
        return False
    given = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if np.abs(given).max() <= mujoco.mjMINVAL:
        body.fullinertia = _NO_INERTIA
        return False
    near = nearest_inertia(given)
    body.fullinertia = (*near.diagonal(), near[0, 1], near[0, 2], near[1, 2])
    return near is not given


def _give_mass(body: mujoco.MjsBody) -> None:
    body.explicitinertial = True
    body.mass = max(body.mass, MIN_MASS_KG)
    body.ipos = np.nan_to_num(body.ipos)
    body.inertia = np.full(3, MIN_INERTIA_KG_M2)
    body.fullinertia = _NO_INERTIA


def _has_mass(body: mujoco.MjsBody) -> bool:
    """Whether a link has both mass and inertia for MuJoCo."""
    if not body.explicitinertial:
        return bool(body.geoms)
    return body.mass > mujoco.mjMINVAL and body.fullinertia[0] > mujoco.mjMINVAL


def _welded(body: mujoco.MjsBody) -> list[mujoco.MjsBody]:
    """A link and those fixed to it."""
    return [body] + [part for child in body.bodies if not child.joints for part in _welded(child)]
