"""What couples the joints of a model beside the links themselves: tendons and equality constraints."""

from __future__ import annotations

import mujoco
import numpy as np

from armctl.mjmodel.queries import joint_name, name_of

_TIES = int(mujoco.mjtEq.mjEQ_JOINT)
_CLOSES_LOOP = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))


def coupling(model: mujoco.MjModel, joint: int, tied: frozenset[int]) -> str:
    """Why a joint does not move freely of all others.

    Args:
        model: The compiled model.
        joint: Its number.
        tied: The joints that move as one with it, at fixed ratios: a tendon that only drives or limits these couples nothing
            else.

    Returns:
        The tendon or equality that couples it, in words; empty where none does.
    """
    dof, name = int(model.jnt_dofadr[joint]), joint_name(model, joint)
    own = {int(model.jnt_dofadr[j]) for j in tied}
    for equality in range(model.neq):
        dofs = dofs_of_equality(model, equality)
        if not model.eq_active0[equality] or dof not in dofs or (model.eq_type[equality] == _TIES and own.issuperset(dofs)):
            continue
        label = name_of(model, mujoco.mjtObj.mjOBJ_EQUALITY, equality)
        if model.eq_type[equality] in _CLOSES_LOOP:
            return f"the equality {label!r} closes a loop over joint {name!r}"
        return f"joint {name!r} is coupled to another by the equality {label!r}"
    for tendon in range(model.ntendon):
        dofs, label = dofs_of_tendon(model, tendon), name_of(model, mujoco.mjtObj.mjOBJ_TENDON, tendon)
        is_limited, resists, bends = (
            model.tendon_limited[tendon],
            _resists(model, tendon),
            not tendon_coefficients(model, tendon),
        )
        if dof not in dofs or not (_is_driven(model, tendon) or is_limited or resists):
            continue
        if own.issuperset(dofs):
            if resists or bends:
                return f"joint {name!r} is pulled by the tendon {label!r}, whose spring, friction or bends armctl does not know"
        elif is_limited or resists or bends:
            return f"joint {name!r} is coupled to others by the tendon {label!r}"
        else:
            return f"joint {name!r} shares the pull of the tendon {label!r} with other joints, which divide it as they please"
    return ""


def dofs_of_tendon(model: mujoco.MjModel, tendon: int) -> list[int]:
    """The degrees of freedom that change a tendon's length.

    Args:
        model: The compiled model.
        tendon: Its number.

    Returns:
        Their addresses in `MjData.qvel`.
    """
    wraps = range(int(model.tendon_adr[tendon]), int(model.tendon_adr[tendon]) + int(model.tendon_num[tendon]))
    joints = [w for w in wraps if model.wrap_type[w] == int(mujoco.mjtWrap.mjWRAP_JOINT)]
    sites = [w for w in wraps if model.wrap_type[w] == int(mujoco.mjtWrap.mjWRAP_SITE)]
    dofs = {int(model.jnt_dofadr[model.wrap_objid[w]]) for w in joints}
    above = [_dofs_above(model, int(model.site_bodyid[model.wrap_objid[w]])) for w in sites]
    return sorted(dofs | (set.union(*above) - set.intersection(*above) if above else set()))


def dofs_of_equality(model: mujoco.MjModel, equality: int) -> list[int]:
    """The degrees of freedom that an equality acts on.

    Args:
        model: The compiled model.
        equality: Its number.

    Returns:
        Their addresses in `MjData.qvel`; all of them for a kind that armctl does not know.
    """
    kind, ends = int(model.eq_type[equality]), (int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality]))
    if kind == _TIES:
        return [int(model.jnt_dofadr[j]) for j in ends if j >= 0]
    if kind == int(mujoco.mjtEq.mjEQ_TENDON):
        return [dof for tendon in ends if tendon >= 0 for dof in dofs_of_tendon(model, tendon)]
    if kind in _CLOSES_LOOP:
        of_site = model.eq_objtype[equality] == int(mujoco.mjtObj.mjOBJ_SITE)
        first, second = (_dofs_above(model, int(model.site_bodyid[i]) if of_site else i) for i in ends)
        return sorted(first ^ second)
    return list(range(model.nv))


def tendon_coefficients(model: mujoco.MjModel, tendon: int) -> dict[int, float]:
    """What each joint adds to the length of a tendon, as far as that is the same everywhere.

    Args:
        model: The compiled model.
        tendon: Its number.

    Returns:
        Joint to m/rad; empty for a tendon that is led around something.
    """
    wraps = range(int(model.tendon_adr[tendon]), int(model.tendon_adr[tendon]) + int(model.tendon_num[tendon]))
    if any(model.wrap_type[wrap] != mujoco.mjtWrap.mjWRAP_JOINT for wrap in wraps):
        return {}
    return {int(model.wrap_objid[wrap]): float(model.wrap_prm[wrap]) for wrap in wraps}


def _is_driven(model: mujoco.MjModel, tendon: int) -> bool:
    """Whether an actuator pulls at a tendon; one that is only measured couples nothing."""
    on_tendon = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_TENDON)
    return bool(np.any(on_tendon & (model.actuator_trnid[:, 0] == tendon)))


def _resists(model: mujoco.MjModel, tendon: int) -> bool:
    """Whether a tendon makes any force by itself, its limits aside."""
    passive = model.tendon_stiffness[tendon], model.tendon_damping[tendon], model.tendon_frictionloss[tendon]
    return any(np.any(x) for x in (*passive, model.tendon_armature[tendon]))


def _dofs_above(model: mujoco.MjModel, body: int) -> set[int]:
    dofs: set[int] = set()
    while body > 0:
        first = int(model.body_dofadr[body])
        dofs |= set(range(first, first + int(model.body_dofnum[body])))
        body = int(model.body_parentid[body])
    return dofs
