"""What couples the joints of a model besides the links: tendons and equality constraints."""

from collections.abc import Collection

import mujoco
import numpy as np

from armctl.core.validation import shown
from armctl.model.mjmodel.queries import joint_name, name_of

JOINT_EQUALITY = int(mujoco.mjtEq.mjEQ_JOINT)
LOOP_EQUALITIES = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))


class Couplings:
    """The equalities and tendons of a compiled model and the degrees of freedom they act on, found once."""

    def __init__(self, model: mujoco.MjModel, left_out: Collection[int] = (), remarks: dict[int, str] | None = None):
        """Finds what each equality and each tendon acts on.

        `left_out` are equalities that do not count; `remarks` on others end the sentences about them.
        """
        self.model = model
        self._remarks = remarks or {}
        active = [e for e in range(model.neq) if model.eq_active0[e] and e not in left_out]
        self._dofs_of_equality = {e: frozenset(dofs_of_equality(model, e)) for e in active}
        self._dofs_of_tendon = {t: frozenset(dofs_of_tendon(model, t)) for t in range(model.ntendon)}
        self._equalities = _by_dof(self._dofs_of_equality)
        self._tendons = _by_dof(self._dofs_of_tendon)

    def joint_equalities(self, joint: int) -> list[int]:
        """The active equalities between this joint and another joint, or a constant."""
        found = self._equalities.get(int(self.model.jnt_dofadr[joint]), [])
        return [equality for equality in found if self.model.eq_type[equality] == JOINT_EQUALITY]

    def reason(self, joint: int, coupled: frozenset[int]) -> str:
        """The sentence why a joint does not move independently of all but those `coupled` to it; empty if it does.

        A tendon that only drives or limits these couples nothing else.
        """
        own = {int(self.model.jnt_dofadr[other]) for other in coupled}
        return self._equality_reason(joint, own) or self._tendon_reason(joint, own)

    def _equality_reason(self, joint: int, own: set[int]) -> str:
        model = self.model
        for equality in self._equalities.get(int(model.jnt_dofadr[joint]), []):
            if model.eq_type[equality] == JOINT_EQUALITY and own.issuperset(self._dofs_of_equality[equality]):
                continue
            label = shown(name_of(model, mujoco.mjtObj.mjOBJ_EQUALITY, equality))
            name = shown(joint_name(model, joint))
            if model.eq_type[equality] in LOOP_EQUALITIES:
                remark = self._remarks.get(equality, "")
                return f"the equality {label} closes a loop over joint {name}" + (f", and {remark}" if remark else "")
            return f"joint {name} is coupled to another by the equality {label}"
        return ""

    def _tendon_reason(self, joint: int, own: set[int]) -> str:
        model = self.model
        for tendon in self._tendons.get(int(model.jnt_dofadr[joint]), []):
            is_limited = bool(model.tendon_limited[tendon])
            has_force = _has_passive_force(model, tendon)
            has_variable_arm = not tendon_coefficients(model, tendon)
            on_tendon = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_TENDON)
            is_driven = bool(np.any(on_tendon & (model.actuator_trnid[:, 0] == tendon)))
            if not (is_driven or is_limited or has_force):  # one that only measures a length couples nothing
                continue
            label = shown(name_of(model, mujoco.mjtObj.mjOBJ_TENDON, tendon))
            name = shown(joint_name(model, joint))
            if own.issuperset(self._dofs_of_tendon[tendon]):
                if has_force or has_variable_arm:
                    return (
                        f"joint {name} is pulled by the tendon {label}, and armctl does not model its spring, friction or bends"
                    )
            elif is_limited or has_force or has_variable_arm:
                return f"joint {name} is coupled to others by the tendon {label}"
            else:
                return f"joint {name} shares the pull of the tendon {label} with other joints in no fixed ratio"
        return ""


def dofs_of_tendon(model: mujoco.MjModel, tendon: int) -> list[int]:
    """The addresses in `MjData.qvel` of the degrees of freedom that change a tendon's length."""
    wraps = _wraps_of(model, tendon)
    joints = [w for w in wraps if model.wrap_type[w] == int(mujoco.mjtWrap.mjWRAP_JOINT)]
    sites = [w for w in wraps if model.wrap_type[w] == int(mujoco.mjtWrap.mjWRAP_SITE)]
    dofs = {int(model.jnt_dofadr[model.wrap_objid[w]]) for w in joints}
    above = [_dofs_above(model, int(model.site_bodyid[model.wrap_objid[w]])) for w in sites]
    if above:  # a joint that moves all sites of the tendon does not change its length
        dofs |= set.union(*above) - set.intersection(*above)
    return sorted(dofs)


def dofs_of_equality(model: mujoco.MjModel, equality: int) -> list[int]:
    """The addresses in `MjData.qvel` of the degrees of freedom that an equality acts on; all of them for an unknown type."""
    kind = int(model.eq_type[equality])
    ends = (int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality]))
    if kind == JOINT_EQUALITY:
        return [int(model.jnt_dofadr[j]) for j in ends if j >= 0]
    if kind == int(mujoco.mjtEq.mjEQ_TENDON):
        return [dof for tendon in ends if tendon >= 0 for dof in dofs_of_tendon(model, tendon)]
    if kind in LOOP_EQUALITIES:
        bodies = bodies_of_loop(model, equality)
        return sorted(_dofs_above(model, bodies[0]) ^ _dofs_above(model, bodies[1]))
    return list(range(model.nv))


def bodies_of_loop(model: mujoco.MjModel, equality: int) -> tuple[int, int]:
    """The two bodies that a connect or weld equality holds together."""
    first = int(model.eq_obj1id[equality])
    second = int(model.eq_obj2id[equality])
    if model.eq_objtype[equality] == int(mujoco.mjtObj.mjOBJ_SITE):
        return int(model.site_bodyid[first]), int(model.site_bodyid[second])
    return first, second


def tendon_coefficients(model: mujoco.MjModel, tendon: int) -> dict[int, float]:
    """What each joint adds to a tendon's length, m/rad; empty if the tendon runs over sites, so that its arms vary."""
    wraps = _wraps_of(model, tendon)
    if any(model.wrap_type[wrap] != mujoco.mjtWrap.mjWRAP_JOINT for wrap in wraps):
        return {}
    return {int(model.wrap_objid[wrap]): float(model.wrap_prm[wrap]) for wrap in wraps}


def _wraps_of(model: mujoco.MjModel, tendon: int) -> range:
    first = int(model.tendon_adr[tendon])
    return range(first, first + int(model.tendon_num[tendon]))


def _by_dof(dofs_of: dict[int, frozenset[int]]) -> dict[int, list[int]]:
    """The elements that act on each degree of freedom, in ascending order."""
    found: dict[int, list[int]] = {}
    for element, dofs in dofs_of.items():
        for dof in dofs:
            found.setdefault(dof, []).append(element)
    return found


def _has_passive_force(model: mujoco.MjModel, tendon: int) -> bool:
    """Whether a tendon exerts a force of its own, apart from its limits."""
    passive = (
        model.tendon_stiffness[tendon],
        model.tendon_damping[tendon],
        model.tendon_frictionloss[tendon],
        model.tendon_armature[tendon],
    )
    return any(np.any(x) for x in passive)


def _dofs_above(model: mujoco.MjModel, body: int) -> set[int]:
    dofs: set[int] = set()
    while body > 0:
        first = int(model.body_dofadr[body])
        dofs |= set(range(first, first + int(model.body_dofnum[body])))
        body = int(model.body_parentid[body])
    return dofs
