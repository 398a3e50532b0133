"""Rods of closed loops: links whose end is pinned to another limb, which are no limbs of their own."""

from collections.abc import Sequence

import mujoco
import numpy as np

from armctl.model.mjmodel.closed_loops import LoopGroup
from armctl.model.mjmodel.couplings import bodies_of_loop
from armctl.model.mjmodel.queries import Joints, joints_above, welded_behind
from armctl.model.mjmodel.transmissions import Transmissions


def without_rods(analysis: Transmissions, runs: Sequence[Joints]) -> list[Joints]:
    """The runs of joints of a model but those that end where a closed loop pins them to another one.

    The one that continues behind the pin is the limb; of two that end there it is the one that carries a site, or else the one
    that ends farther from the base.
    """
    if not analysis.loops:
        return list(runs)
    pins = _pins(analysis)
    whole = [run for run in runs if not any(other != run and other[: len(run)] == run for other in runs)]
    limbs = [run for run in whole if not any(_is_rod(analysis, run, pin, whole) for pin in pins)]
    return [run for run in runs if any(limb[: len(run)] == run for limb in limbs)]


def _pins(analysis: Transmissions) -> list[tuple[int, int]]:
    """The two bodies of each loop, in both orders."""
    groups: dict[LoopGroup, None] = dict.fromkeys(analysis.loops.values())
    pairs = [bodies_of_loop(analysis.model, equality) for group in groups for equality in group.equalities]
    return [*pairs, *((second, first) for first, second in pairs)]


def _is_rod(analysis: Transmissions, run: Joints, pin: tuple[int, int], runs: Sequence[Joints]) -> bool:
    """Whether the first body of a pin is at the end of a run, and the second is of another run, whose rod it is."""
    model = analysis.model
    body, partner = pin
    if not run or body not in _end(model, run):
        return False
    above = joints_above(model, partner)
    for other in runs:
        if not above or other == run or above[-1] not in other:
            continue
        if partner not in _end(model, other) or _rank(analysis, other) > _rank(analysis, run):
            return True
    return False


def _end(model: mujoco.MjModel, run: Joints) -> list[int]:
    """The bodies that the last joint of a run moves as one."""
    return welded_behind(model, int(model.jnt_bodyid[run[-1]]))


def _rank(analysis: Transmissions, run: Joints) -> tuple[bool, float]:
    """Whether the end of a run carries a site that no equality uses, and how far from the run's base it reaches, m."""
    model = analysis.model
    bodies = _end(model, run)
    on_sites = model.eq_objtype == int(mujoco.mjtObj.mjOBJ_SITE)
    used = {*model.eq_obj1id[on_sites].tolist(), *model.eq_obj2id[on_sites].tolist()}
    has_site = any(int(model.site_bodyid[site]) in bodies for site in range(model.nsite) if site not in used)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    geoms = np.isin(model.geom_bodyid, bodies)
    points = np.concatenate([data.xpos[bodies], data.geom_xpos[geoms]])
    return has_site, float(np.linalg.norm(points - data.xanchor[run[0]], axis=1).max())
