"""Drives: which actuator moves a joint, and which other joints go along with it because an equality ties them to it.

A mimic joint, a pair of fingers on one motor, a telescope: joints that an equality ties to each other at fixed ratios are one
degree of freedom, and an arm counts them as one joint. MuJoCo's equalities give way a little; armctl takes them for rigid.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from armctl.core.errors import ModelError
from armctl.mjmodel.couplings import coupling, tendon_coefficients
from armctl.mjmodel.queries import SCALAR, Chain, actuator_name, is_damper, is_on_joint, joint_name, name_of

_TIES = int(mujoco.mjtEq.mjEQ_JOINT)


@dataclass(frozen=True)
class Tie:
    """How a joint follows another.

    Attributes:
        ratio: Its speed for one of the other's.
        offset: rad (m), where it is when the other is at zero.
    """

    ratio: float
    offset: float


@dataclass(frozen=True)
class Transmission:
    """What moves a joint.

    Attributes:
        joint: The joint.
        actuator: Its actuator.
        moments: What a unit of the actuator's force makes on each joint that it acts on, N m.
        ties: The joints that move as one with it, itself first, and how they follow it.
    """

    joint: int
    actuator: int
    moments: dict[int, float]
    ties: dict[int, Tie]

    @property
    def gear(self) -> float:
        """What a unit of the actuator's force makes on the joint, by virtual work, all that follow included, N m."""
        return sum(moment * self.ties[joint].ratio for joint, moment in self.moments.items())


def transmission_of(model: mujoco.MjModel, joint: int) -> Transmission | str:
    """What moves a joint.

    Args:
        model: The compiled model.
        joint: Its number.

    Returns:
        Its drive; where armctl can drive it by no one actuator, the reason in words.
    """
    name = joint_name(model, joint)
    if model.jnt_type[joint] not in SCALAR:
        return f"joint {name!r} is a ball joint, not a hinge or slide"
    ties = _ties(model, joint)
    if isinstance(ties, str):
        return ties
    reason = next(filter(None, (coupling(model, j, frozenset(ties)) for j in ties)), "")
    if reason:
        return reason
    drives: dict[tuple[int, ...], Transmission] = {}
    for actuator in range(model.nu):
        moments = moments_of(model, actuator)
        if moments and moments.keys() <= ties.keys() and not is_damper(model, actuator):
            drives.setdefault(tuple(moments), Transmission(joint, actuator, moments, ties))
    others = ", ".join(repr(joint_name(model, j)) for j in ties if j != joint)
    if len(drives) == 1:
        return drives.popitem()[1]
    if drives:
        names = " and ".join(repr(actuator_name(model, drive.actuator)) for drive in drives.values())
        return f"joint {name!r} and {others} are tied to each other by equalities, yet several actuators move them: {names}"
    return f"joint {name!r} has no actuator of its own" + (f", nor has {others}, tied to it by equalities" if others else "")


def moments_of(model: mujoco.MjModel, actuator: int) -> dict[int, float]:
    """What a unit of an actuator's force makes on each joint it acts on, as far as that is the same everywhere.

    Args:
        model: The compiled model.
        actuator: Its number.

    Returns:
        Joint to N m; empty for an actuator on a ball joint, a body, a site, a crank or a tendon that is led around something.
    """
    target, gear = int(model.actuator_trnid[actuator, 0]), float(model.actuator_gear[actuator, 0])
    if is_on_joint(model, actuator):
        return {target: gear} if model.jnt_type[target] in SCALAR else {}
    if model.actuator_trntype[actuator] != mujoco.mjtTrn.mjTRN_TENDON:
        return {}
    return {joint: gear * coefficient for joint, coefficient in tendon_coefficients(model, target).items()}


def _ties(model: mujoco.MjModel, joint: int) -> dict[int, Tie] | str:
    """All joints that equalities tie to one, at fixed ratios; the reason where these are not fixed."""
    ties, waiting, used = {joint: Tie(1.0, 0.0)}, [joint], set()
    while waiting:
        here = waiting.pop()
        for equality in range(model.neq):
            ends = int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])
            if model.eq_type[equality] != _TIES or not model.eq_active0[equality] or here not in ends or equality in used:
                continue
            used.add(equality)
            label = name_of(model, mujoco.mjtObj.mjOBJ_EQUALITY, equality)
            offset, ratio, *curve = model.eq_data[equality, :5].tolist()
            name, leader = joint_name(model, ends[0]), joint_name(model, ends[1]) if ends[1] >= 0 else ""
            if ends[1] < 0 or ratio == 0:
                return f"joint {name!r} is locked by the equality {label!r}"
            if np.any(curve):
                return f"joint {name!r} is tied to {leader!r} by a curve, not a ratio, in the equality {label!r}"
            there = ends[1] if here == ends[0] else ends[0]
            if there in ties:
                return f"joint {name!r} is tied to {leader!r} twice over by the equality {label!r}"
            zero = model.qpos0[model.jnt_qposadr[list(ends)]]  # first = offset + ratio second, both counted from here
            offset += float(zero[0] - ratio * zero[1])
            tie = ties[here]
            if here == ends[1]:
                ties[there] = Tie(ratio * tie.ratio, ratio * tie.offset + offset)
            else:
                ties[there] = Tie(tie.ratio / ratio, (tie.offset - offset) / ratio)
            waiting.append(there)
    return ties


def chain_transmissions(model: mujoco.MjModel, joints: Chain) -> list[Transmission]:
    """The drives of a chain, from the base to the tip: a joint that follows another has none of its own.

    Args:
        model: The compiled model.
        joints: The chain.

    Returns:
        One drive for each degree of freedom; its joint is the first one in the chain.

    Raises:
        ModelError: A joint cannot be driven by one actuator.
    """
    drives: list[Transmission] = []
    for joint in joints:
        if not any(joint in drive.ties for drive in drives):
            drive = transmission_of(model, joint)
            if isinstance(drive, str):
                raise ModelError(drive)
            drives.append(drive)
    return drives
