"""calibration_poses: the poses that show the geometry of an arm best, and the way to them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError, PlanError
from armctl.core.pose import Pose
from armctl.core.validation import Array, choice, flag, frozen, integer, number
from armctl.lab.identification.arm_estimate import counted
from armctl.lab.identification.calibrate import DEFAULT_PARAMETERS, SENSORS, identifiable, rows_of, sample, separable
from armctl.lab.identification.kinematic_parameters import KinematicChain
from armctl.model.arm.arm import Arm, check_arm
from armctl.model.collision.checkers import collision_checker

_CANDIDATES = 400
_TRIES = 20 * _CANDIDATES
_RANGE_SHARE = 0.9  # of the limits
_MAX_POSES = 300
_MAX_CLEARANCE_M = 0.5
_REGULARIZATION = 1e-9  # of the largest information, until all parameters are shown
_MIN_GAIN = 1e-6  # in the logarithm of the determinant, for which a pose is exchanged
_MAX_PASSES = 20


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationPoses:
    """Poses for `calibrate_geometry`.

    Attributes:
        q: (K, n) rad. The straight line in joint space from `start` to each is proved free.
        start: (n,) rad, the configuration between the poses.
        clearance: m, more than which the arm keeps from everything at each pose and on each of these lines; nan for an arm
            with links that have no shape.
        names: The parameters that the poses show.
        condition_number: Of the Jacobian with columns of equal length; below 100 is good.
        information: The D-optimal criterion: geometric mean over the parameters of the information, relative to as many random
            poses; 2 means that errors are smaller by the square root of 2.
    """

    q: Array
    start: Array
    clearance: float
    names: tuple[str, ...]
    condition_number: float
    information: float


def calibration_poses(
    arm: Arm,
    count: int = 30,
    *,
    sensor: str = "world",
    positions_only: bool = True,
    parameters: Sequence[str] | None = None,
    clearance: float = 0.01,
    visible: Callable[[Pose], bool] | None = None,
    start: ArrayLike | None = None,
    seed: int = 0,
) -> CalibrationPoses:
    """Chooses measuring poses for a small volume of the confidence ellipsoid (D-optimal), free of collisions on the way.

    Candidates are random configurations; poses are exchanged as long as the determinant of the information matrix grows
    (Fedorov, "Theory of Optimal Experiments", 1972; for robots Daney, Papegay, Madeline, "Choosing measurement poses for robot
    calibration with the local convergence method and tabu search", 2005).

    Args:
        count: The number K of poses.
        sensor: "world" if the tip is measured in the world of the model, "fixed" for a sensor beside the arm, "hand" for a
            camera on the last link.
        positions_only: Whether positions are measured, without orientations.
        parameters: Kinds ("offsets", "lengths") or single names of what `calibrate_geometry` will fit; by default all.
        clearance: m to keep from everything.
        visible: A function that tells whether the sensor can measure the tip at a pose T_world_tip. By default it always can.
        start: (n,) rad, the configuration from which each pose is reached on a straight line in joint space; home by default.
        seed: Seed of the candidates.

    Returns:
        The configurations, with the information that they give.

    Raises:
        InputError: An argument is of another kind or out of its bounds, or there are too few poses for the parameters.
        ModelError: A joint of the arm follows another one, or no clearance can be proved in this scene.
        LimitError: The start is outside the limits.
        PlanError: There are too few free poses that can be measured, or they do not show all parameters.
    """
    check_arm(arm)
    count = integer("count", count, 4, _MAX_POSES)
    sensor = choice("sensor", sensor, SENSORS)
    positions_only = flag("positions_only", positions_only)
    clearance = number("clearance", clearance, 0.0, _MAX_CLEARANCE_M)
    start = arm.limits.clamp(arm.home) if start is None else arm.checked("start", start)
    rng = np.random.default_rng(integer("seed", seed, 0))
    chain = KinematicChain(arm, sensor == "hand")
    wanted = chain.select(DEFAULT_PARAMETERS[sensor] if parameters is None else parameters, positions_only)
    known = [wanted[i] for i in separable(chain, wanted, positions_only).kept]
    least = -(-len(known) // (3 if positions_only else 6)) + 1
    if count < least:
        raise InputError(f"count: {len(known)} parameters need at least {least} poses, got {count}")
    q = _candidates(arm, start, clearance, visible, rng, count)
    J = rows_of(chain, known, q, positions_only)
    lengths = np.linalg.norm(np.concatenate(J), axis=0)
    J = J / lengths
    chosen = exchanged(J, count)
    dependent = identifiable(chain, known, q[chosen], positions_only).dependent
    if dependent:
        names = counted(tuple(known[i].name for i in dependent))
        raise PlanError(f"{arm.name:.80}: no {count} free poses that can be measured show {names}; leave them out")
    random_poses = np.mean([_log_information(J[first : first + count]) for first in range(0, len(J) - count + 1, count)])
    return CalibrationPoses(
        q=frozen(q[chosen]),
        start=frozen(np.array(start)),
        clearance=float("nan") if arm.unchecked_links else clearance,
        names=tuple(parameter.name for parameter in known),
        condition_number=float(np.linalg.cond(np.concatenate(J[chosen]))),
        information=float(np.exp((_log_information(J[chosen]) - random_poses) / max(len(known), 1))),
    )


def _candidates(
    arm: Arm, start: Array, clearance: float, visible: Callable[[Pose], bool] | None, rng: np.random.Generator, count: int
) -> Array:
    checker = collision_checker(arm)
    checker.require_provable_among_obstacles()
    near = checker.at(start, clearance)
    if near:
        raise PlanError(f"{arm.name:.80}: at the start, {near:.200} within {1e3 * clearance:g} mm; give another start")
    found: list[Array] = []
    for q in sample(arm, rng, _TRIES, _RANGE_SHARE):
        if visible is not None and not visible(arm.fk(q)):
            continue
        if checker.line_hit(start, q, clearance) is None:
            found.append(q)
        if len(found) == _CANDIDATES:
            break
    if len(found) < count:
        raise PlanError(f"{arm.name:.80}: only {len(found)} of {_TRIES} random poses are free and visible; {count} are needed")
    return np.array(found)


def exchanged(J: Array, count: int) -> list[int]:
    """The indices of the poses with the largest determinant of the information: greedy choice, then exchange."""
    information = J.transpose(0, 2, 1) @ J
    total = _REGULARIZATION * np.trace(information.sum(axis=0)) * np.eye(J.shape[2])
    chosen: list[int] = []
    for _ in range(count):
        chosen.append(_best(J, total, chosen))
        total = total + information[chosen[-1]]
    for _ in range(_MAX_PASSES):
        before = _log_information(J[chosen])
        for place in range(count):
            rest = chosen[:place] + chosen[place + 1 :]
            chosen[place] = _best(J, information[rest].sum(axis=0) + _REGULARIZATION * np.eye(J.shape[2]), rest)
        if _log_information(J[chosen]) < before + _MIN_GAIN:
            break
    return chosen


def _best(J: Array, total: Array, taken: list[int]) -> int:
    """The pose that adds most to the determinant: det(A + J^T J) = det(A) det(I + J A^-1 J^T)."""
    gain = np.linalg.slogdet(np.eye(J.shape[1]) + J @ np.linalg.solve(total, J.transpose(0, 2, 1)))[1]
    gain[taken] = -np.inf
    return int(gain.argmax())


def _log_information(J: Array) -> float:
    """The logarithm of the determinant of the information matrix."""
    rows = np.concatenate(J)
    return float(np.linalg.slogdet(rows.T @ rows)[1])
