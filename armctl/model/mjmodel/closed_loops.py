"""Closed loops of links: which joints a connect or weld equality ties together, and which of them have no motor."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from armctl.core.errors import few_names
from armctl.core.validation import Array, shown
from armctl.model.mjmodel.couplings import JOINT_EQUALITY, LOOP_EQUALITIES, bodies_of_loop, dofs_of_equality
from armctl.model.mjmodel.queries import SCALAR, joint_name, name_of

# Relative, of the derivatives of a loop: numbers of files are rounded, and the axes of a plane of links never exactly parallel.
_RANK = 1e-4


@dataclass(frozen=True)
class LoopGroup:
    """Loops that share joints, and the joints that move in them."""

    equalities: tuple[int, ...]  # the connect and weld equalities
    ties: tuple[int, ...]  # equalities between two passive joints
    couplings: tuple[int, ...]  # equalities between two joints of the loops that a motor moves
    drivers: tuple[int, ...]  # joints that a motor moves, or that follow such a joint at a fixed ratio
    passive: tuple[int, ...]  # joints without a motor, which the loops move
    reason: str = ""  # why the motors do not determine where its joints are; empty if they do

    @property
    def joints(self) -> tuple[int, ...]:
        return tuple(sorted((*self.drivers, *self.passive)))


def loop_equalities(model: mujoco.MjModel) -> list[int]:
    """The active connect and weld equalities over hinges and slides; those that pull at a mocap body are not among them."""
    found = []
    for equality in range(model.neq):
        if not model.eq_active0[equality] or model.eq_type[equality] not in LOOP_EQUALITIES:
            continue
        kinds = model.jnt_type[model.dof_jntid[dofs_of_equality(model, equality)]]
        is_pulled = any(model.body_mocapid[body] >= 0 for body in bodies_of_loop(model, equality))
        if len(kinds) and np.isin(kinds, SCALAR).all() and not is_pulled:
            found.append(equality)
    return found


def pinned_bodies(model: mujoco.MjModel) -> set[frozenset[int]]:
    """The pairs of bodies that closed loops hold together, each by the first body of its rigid piece."""
    return {frozenset(model.body_weldid[list(bodies_of_loop(model, each))].tolist()) for each in loop_equalities(model)}


def find_loops(model: mujoco.MjModel, mimics_of: Callable[[int], dict[int, float] | str | None]) -> list[LoopGroup]:
    """The loops of a model, those that share joints together.

    `mimics_of` says of a joint which joints move as one with it if a motor moves it, and their speeds per its own; None if it
    has no motor; or why it cannot be driven.
    """
    groups = []
    for equalities in _connected(model, loop_equalities(model)):
        joints = sorted({int(model.dof_jntid[dof]) for e in equalities for dof in dofs_of_equality(model, e)})
        driven: dict[int, dict[int, float]] = {}
        passive: list[int] = []
        reason = ""
        while joints:
            joint = joints.pop(0)
            mimics = mimics_of(joint)
            if isinstance(mimics, str):
                reason = reason or mimics
            elif mimics is None:
                passive.append(joint)
                joints += [each for each in _tied_to(model, joint) if each not in (*joints, *passive, *driven)]
            else:
                driven[joint] = mimics
        ties = tuple(e for e in range(model.neq) if _ties(model, e, passive))
        couplings = tuple(e for e in range(model.neq) if _ties(model, e, list(driven)))
        group = LoopGroup(
            equalities=tuple(equalities),
            ties=ties,
            couplings=couplings,
            drivers=tuple(sorted(driven)),
            passive=tuple(sorted(passive)),
            reason=reason,
        )
        groups.append(group if reason else replace(group, reason=_why_not_determined(model, group, driven)))
    return groups


def _connected(model: mujoco.MjModel, equalities: list[int]) -> list[list[int]]:
    """Equalities in sets that share no joint with each other; a joint equality between two joints connects them, too."""
    links = [e for e in range(model.neq) if model.eq_active0[e] and model.eq_type[e] == JOINT_EQUALITY]
    sets: list[tuple[set[int], list[int]]] = []
    for equality in [*equalities, *links]:
        dofs = set(dofs_of_equality(model, equality))
        members = [equality] if equality in equalities else []
        others = []
        for each in sets:
            if each[0] & dofs:
                dofs |= each[0]
                members += each[1]
            else:
                others.append(each)
        sets = [*others, (dofs, members)]
    return [sorted(members) for _, members in sets if members]


def _tied_to(model: mujoco.MjModel, joint: int) -> list[int]:
    """The joints that equalities tie to a joint."""
    ends = [(int(model.eq_obj1id[e]), int(model.eq_obj2id[e])) for e in range(model.neq) if _ties(model, e, range(model.njnt))]
    return [other for pair in ends if joint in pair for other in pair if other != joint]


def _ties(model: mujoco.MjModel, equality: int, joints: Iterable[int]) -> bool:
    """Whether an equality ties two of some joints to each other."""
    ends = (int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality]))
    return bool(model.eq_active0[equality]) and model.eq_type[equality] == JOINT_EQUALITY and set(ends) <= set(joints)


def _why_not_determined(model: mujoco.MjModel, group: LoopGroup, driven: dict[int, dict[int, float]]) -> str:
    """Why the motors of a group do not determine its joints: too few of them, or too many; empty if they do."""
    names = few_names([joint_name(model, joint) for joint in group.drivers])
    if not group.passive:
        return f"all of its joints have motors ({names}), so that none is free to follow; delete the motor of one"
    reasons = []
    for qpos in (model.qpos0, *model.key_qpos):
        by_joint = _derivatives(model, group, qpos)
        by_passive = by_joint[:, list(group.passive)]
        by_motor = np.array([sum(ratio * by_joint[:, j] for j, ratio in mimics.items()) for mimics in driven.values()])
        both = np.column_stack([by_passive, *by_motor])
        rank = _rank(by_passive, both)
        if rank < len(group.passive):
            free = few_names([joint_name(model, joint) for joint in group.passive])
            motors = f"the motors of {names}" if names else "motors"
            why = "springs or stops hold them, or the loop is stretched"
            reasons.append(f"{motors} do not determine where {free} are at home: {why}; add motors or equalities")
        elif _rank(both, both) > rank:
            reasons.append(f"it has more motors ({names}) than it can move independently; delete the motor of one joint")
        else:
            return ""
    return reasons[0]


def _rank(part: Array, whole: Array) -> int:
    """The rank of some columns of a matrix, relative to the matrix."""
    largest = np.linalg.norm(whole, 2) if whole.size else 0.0
    return int((np.linalg.svd(part, compute_uv=False) > _RANK * largest).sum()) if largest else 0


def _derivatives(model: mujoco.MjModel, group: LoopGroup, qpos: Array) -> Array:
    """(rows, njnt) how the equalities of a group change with each joint, at qpos (nq,)."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_fwdPosition(model, data)
    wanted = np.isin(data.efc_id, (*group.equalities, *group.ties)) & (
        data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
    )
    full = np.zeros((data.nefc, model.nv))
    if mujoco.mj_isSparse(model):
        mujoco.mju_sparse2dense(full, data.efc_J, data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind)
    else:
        full[:] = data.efc_J.reshape(data.nefc, model.nv)
    return full[wanted][:, model.jnt_dofadr]


def label_of(model: mujoco.MjModel, equality: int) -> str:
    """The name of an equality, for a message."""
    return shown(name_of(model, mujoco.mjtObj.mjOBJ_EQUALITY, equality))
