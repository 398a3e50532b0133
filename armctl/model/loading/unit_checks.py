"""Signs that a file has other units than its reader takes: degrees for radians, radians for degrees, millimetres for metres."""

import math
from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from armctl.core.note import Note, Severity
from armctl.core.validation import Array, shown
from armctl.model.mjmodel.queries import joint_name

_MAX_PLAIN_TURN_RAD = 4.0 * math.pi + 0.1  # two turns each way; beyond, only numbers of half turns are those of a joint
_UNLIMITED_RAD = 1000.0  # and more stands for "no limit"
_HALF_TURN_TOLERANCE = 1e-3  # of the number, as files round multiples of pi
_CERTAIN_DEGREES = 100.0  # 16 turns; from here on the multiples of pi are too dense to tell
# Ranges of two turns and of four turns in radians, read as degrees.
_TYPICAL_SMALL_RANGE_RAD = math.radians(4.0 * math.pi) + 0.01
_GREATEST_SMALL_RANGE_RAD = math.radians(8.0 * math.pi) + 0.01
_MAX_REACH_M = 40.0  # the longest arms of cranes and space stations reach 17 to 40 m
_UNLIMITED_M = 1000.0  # and more stands for "no limit"
_MAX_NAMES = 6


def unit_doubts(model: mujoco.MjModel, joints: Sequence[int], tip_body: int, tip_offset: Array) -> list[Note]:
    """A sentence with a remedy for each unit that an arm's file seems to have wrong.

    Args:
        model: The compiled model.
        joints: The arm's joints, from the base to the tip.
        tip_body: The body in whose frame `tip_offset` is given.
        tip_offset: (3,) the position of the tip there, m.
    """
    doubts = [*_degrees(model, joints), *_small_ranges(model, joints), *_millimetres(model, joints, tip_body, tip_offset)]
    return [Note(doubt, severity=Severity.ERROR) for doubt in doubts]


def _degrees(model: mujoco.MjModel, joints: Sequence[int]) -> Iterator[str]:
    """Hinges with limits of so many radians that they must be degrees."""
    bounds = {joint: model.jnt_range[joint].tolist() for joint in _limited(model, joints, mujoco.mjtJoint.mjJNT_HINGE)}
    found = [joint for joint, (low, high) in bounds.items() if _is_degrees(low) or _is_degrees(high)]
    if found:
        low, high = bounds[found[0]]
        turns = (high - low) / (2.0 * math.pi)
        yield (
            f"{_named(model, found)} may turn by {low:g} to {high:g} rad, {turns:.3g} turns: are these degrees? "
            'write radians, or <compiler angle="degree"/> (MJCF; a URDF takes radians)'
        )


def _is_degrees(bound: float) -> bool:
    size = abs(bound)
    if not _MAX_PLAIN_TURN_RAD < size < _UNLIMITED_RAD:
        return False
    half_turns = size / math.pi
    return size >= _CERTAIN_DEGREES or abs(half_turns - round(half_turns)) > _HALF_TURN_TOLERANCE * half_turns


def _small_ranges(model: mujoco.MjModel, joints: Sequence[int]) -> Iterator[str]:
    """All hinges have ranges of a few degrees: numbers in radians, read as degrees."""
    limited = _limited(model, joints, mujoco.mjtJoint.mjJNT_HINGE)
    if not limited:
        return
    widths = model.jnt_range[limited, 1] - model.jnt_range[limited, 0]
    if 0.0 < float(np.median(widths)) <= _TYPICAL_SMALL_RANGE_RAD and widths.max() <= _GREATEST_SMALL_RANGE_RAD:
        yield (
            f"{_named(model, limited)} may turn by at most {math.degrees(widths.max()):.3g} degrees ({widths.max():.3g} rad): "
            'are these numbers radians? write <compiler angle="radian"/> (MJCF), or degrees; a URDF takes radians'
        )


def _millimetres(model: mujoco.MjModel, joints: Sequence[int], tip_body: int, tip_offset: Array) -> Iterator[str]:
    """Lengths that no arm has."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    tip = data.xpos[tip_body] + data.xmat[tip_body].reshape(3, 3) @ tip_offset
    points = np.vstack([data.xanchor[list(joints)], tip])
    reach = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    if reach > _MAX_REACH_M:
        yield f"the arm is {reach:.4g} m long from its first joint to its tip: are these millimetres? write metres"
    slides = _limited(model, joints, mujoco.mjtJoint.mjJNT_SLIDE)
    travels = {joint: float(np.abs(model.jnt_range[joint]).max()) for joint in slides}
    long = [joint for joint, travel in travels.items() if _MAX_REACH_M < travel < _UNLIMITED_M]
    if long:
        yield f"{_named(model, long)} may slide to {travels[long[0]]:.4g} m: are these millimetres? write metres"


def _limited(model: mujoco.MjModel, joints: Sequence[int], kind: mujoco.mjtJoint) -> list[int]:
    return [joint for joint in joints if model.jnt_type[joint] == kind and model.jnt_limited[joint]]


def _named(model: mujoco.MjModel, joints: Sequence[int]) -> str:
    names = ", ".join(shown(joint_name(model, joint)) for joint in joints[:_MAX_NAMES])
    more = f" and {len(joints) - _MAX_NAMES} more" if len(joints) > _MAX_NAMES else ""
    return f"{'joint' if len(joints) == 1 else 'joints'} {names}{more}"
