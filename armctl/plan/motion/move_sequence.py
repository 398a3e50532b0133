"""move_sequence: motions of any kind one after another, the corners between them rounded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce
from itertools import pairwise

import numpy as np

from armctl.core.errors import InputError
from armctl.core.validation import Array, instance, number
from armctl.model.arm.arm import Arm, check_arm
from armctl.plan.motion.checks import read_duration
from armctl.plan.motion.given_duration import lasting
from armctl.plan.motion.timing.path_timing import slowed_down
from armctl.plan.motion.torque_limits import MotionPath, within_torque
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.limit_check import is_inside
from armctl.plan.motion.trajectory.path_stop import REST_SPEED
from armctl.plan.motion.trajectory.piecewise import Pieces, joints_of, overlapped

_SAMPLES = 200  # of half a motion, between which the corner's begin is looked for
_MIN_OVERLAP_S = 1e-3


def move_sequence(
    arm: Arm, motions: Sequence[JointTrajectory], *, blend: float = 0.0, duration: float | None = None
) -> JointTrajectory:
    """Motions of any kind one after another, the corners between them rounded.

    A motion begins while the one before it still comes to rest, and both are added up in joint space. The path leaves that of
    the motions only where the tip of both is within the blend radius of the corner, and only while the one slows down and the
    other accelerates. Where the sum would exceed a limit on speed, acceleration, jerk or torque, it goes slower; if that takes
    longer than to stop at the corners, it stops. Obstacles are not considered: `check_clearance` tells whether all is free.

    Args:
        motions: Motions of its joints, each from rest where the one before it ends.
        blend: m, the radius around each corner; 0 stops there.
        duration: s, how long all of them take together; as short as possible if left out.

    Raises:
        InputError: An argument of the wrong kind or value, or a motion that does not start where the one before it ends, or
            does not rest there.
        PlanError: A motor cannot hold the arm in a corner, however slowly it moves, or the duration is too short.
    """
    check_arm(arm)
    seconds = read_duration(duration)
    radius = number("blend", blend, 0.0)
    parts = list(motions) if isinstance(motions, Sequence) else []
    if not parts:
        raise InputError("motions: give a list of at least one motion, such as [move_j(arm, q0, q1), move_l(arm, q1, target)]")
    for part in parts:
        instance("motions", part, JointTrajectory, "give motions of armctl")
    plain = reduce(JointTrajectory.then, parts)
    if plain.joint_names != arm.joint_names:
        raise InputError(f"motions: they move {', '.join(plain.joint_names):.80}, the arm has {', '.join(arm.joint_names):.80}")
    for k, (before, after) in enumerate(pairwise(parts)):
        if max(np.abs(before(before.duration).v).max(), np.abs(after(0.0).v).max()) > REST_SPEED:
            raise InputError(f"motions: the arm does not rest between motions {k} and {k + 1}, so there is no corner to round")
    if radius == 0.0:
        return _lasting(arm, plain, seconds)
    pieces = parts[0].pieces
    for before, after in pairwise(parts):
        pieces = _rounded(arm, pieces, after.pieces, min(_ramp(arm, before, radius, True), _ramp(arm, after, radius, False)))
    whole = JointTrajectory(*pieces, arm.joint_names, arm.limits, slowed=plain.slowed, units=arm.units)
    if not is_inside(pieces, arm.limits):
        slower = slowed_down(MotionPath(whole), arm.limits, pieces.knots, None)
        whole = replace(whole, knots=slower.knots, coefficients=joints_of(slower).coefficients)
    rounded = within_torque(arm, whole)
    return _lasting(arm, rounded if rounded.duration < plain.duration else plain, seconds)


def _lasting(arm: Arm, motion: JointTrajectory, duration: float | None) -> JointTrajectory:
    """A sequence that lasts so many seconds: one that starts or ends in motion cannot be slowed down as a whole."""
    if duration is not None and max(np.abs(motion(t).v).max() for t in (0.0, motion.duration)) > REST_SPEED:
        raise InputError("duration: the sequence starts or ends in motion, whose speed is given; leave the duration out")
    return lasting(arm, motion, duration)


def _ramp(arm: Arm, motion: JointTrajectory, radius: float, at_end: bool) -> float:
    """How long before its end, or after its start, a motion is within a radius of its corner and only slows down or speeds up.

    At most half its duration, so that the corners of a motion do not meet.
    """
    times = np.linspace(0.0, 0.5 * motion.duration, _SAMPLES)
    q, v, _ = motion.sample(motion.duration - times if at_end else times)[:3]
    corner = arm.fk(q[0]).position
    outside = np.linalg.norm(arm.fk_many(q)[0] - corner, axis=1) > radius
    speed = np.linalg.norm(v / arm.limits.v_max, axis=1)
    past_ramp = np.append(np.diff(speed) < 0.0, False)
    beyond = outside | past_ramp
    return float(times[max(int(beyond.argmax()) - 1, 0)] if beyond.any() else times[-1])


def _rounded(arm: Arm, first: Pieces, second: Pieces, overlap: float) -> Pieces:
    """Both with the overlap, or with less if the corner would leave the position limits."""
    unlimited: Array = np.full(arm.n, np.inf)
    positions_only = replace(arm.limits.plain, v_max=unlimited, a_max=unlimited, j_max=unlimited)
    while overlap > _MIN_OVERLAP_S:
        pieces = overlapped(first, second, overlap)
        if is_inside(pieces, positions_only):
            return pieces
        overlap *= 0.5
    return overlapped(first, second, 0.0)
