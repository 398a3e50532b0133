"""calibrate_geometry: joint offsets, lengths, axes, frames and hand-eye transforms of an arm from measured poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from armctl.core.defaults import CONFIDENCE
from armctl.core.errors import InputError
from armctl.core.pose import Pose, computed_pose, nearest_rotations
from armctl.core.validation import Array, choice, frozen, matrix
from armctl.lab.identification.arm_estimate import counted
from armctl.lab.identification.identified_model import IdentifiedArm, place_bodies
from armctl.lab.identification.kinematic_parameters import KinematicChain, Parameter
from armctl.model.arm.arm import Arm, check_arm

SENSORS = ("world", "fixed", "hand")
DEFAULT_PARAMETERS = {
    "world": ("offsets", "base", "tool", "lengths", "axes"),
    "fixed": ("offsets", "sensor", "marker", "lengths", "axes"),
    "hand": ("offsets", "sensor", "marker", "lengths", "axes"),
}
_MIN_POSES = 4
_RANDOM_CONFIGURATIONS = 200
_MAX_DISTANCE = np.pi  # rad (m) from home, of random configurations of joints without limits
# Share of a column's length that other columns leave over. Below it, poses do not separate a parameter from others: 0.1 mm of
# noise would move it by 0.1 m or rad. One value for all poses of the arm and for those that are measured, because the digits of
# a file leave a share of 1e-6 where the exact geometry of the arm has none.
_SEEN_TOLERANCE = 1e-3
_MIN_SHARE = 1e-3  # of a parameter in a combination that is named
_WEIGHTINGS = 4  # of positions and rotations by the noise that the fit before found
_ROTATION_ARM_M = 0.5  # in the first weighting: a rotation's error counts as that of a point so far away
_MAX_LOSS = 1.05  # by which the error at poses that were left out may grow before the file counts as better


@dataclass(frozen=True, slots=True, eq=False)
class GeometryEstimate(IdentifiedArm):
    """The geometry of an arm, calibrated from measured poses. True if the poses support it.

    Attributes:
        ok: Whether the poses show all parameters, and the file does not predict poses better that were left out of the fit.
        reason: The reason if it is not ok; empty if it is.
        arm: The arm before.
        names: The p parameters that were fitted, such as "joint2 offset". A length is a shift of a joint in its parent link's
            frame ("joint2 x"), an axis a turn of a joint's axis about that of its own link ("joint2 rx"). "base" is the pose of
            the base in the world, "tool" that of the tip in its link.
        values: (p,) m or rad, added to those of the file.
        errors: (p,) standard errors.
        intervals: (p, 2) the 95 % confidence intervals (Student's t).
        covariance: (p, p).
        inseparable: Parameters that no pose of this arm separates from others, each with these others in a sentence; they keep
            the value of the file, so the others have errors of their own only if that value is right.
        unseen: Names of parameters that other poses would show and these do not; they keep the value of the file.
        condition_number: Of the Jacobian with columns of equal length.
        noise: m and rad, standard deviation of a measured coordinate and rotation; the second is NaN for positions.
        accuracy_before: m, ISO 9283's AP at the measured poses with the geometry of the file: the largest distance.
        accuracy_after: m, the same with the calibrated geometry, each pose predicted by a fit to the others.
        rms_before: m, RMS distance with the geometry of the file.
        rms_after: m, RMS distance with the calibrated geometry, each pose predicted by a fit to the others.
        sensor: Where a fixed sensor is in the world, or one on the hand in the tip's frame; None if it measures in the world.
        marker: Where the marker is in the tip's frame, or in the world if the sensor is on the hand; None as above.
    """

    ok: bool
    reason: str
    arm: Arm
    names: tuple[str, ...]
    values: Array
    errors: Array
    intervals: Array
    covariance: Array
    inseparable: tuple[str, ...]
    unseen: tuple[str, ...]
    condition_number: float
    noise: tuple[float, float]
    accuracy_before: float
    accuracy_after: float
    rms_before: float
    rms_after: float
    sensor: Pose | None
    marker: Pose | None

    def __str__(self) -> str:
        lines = [f"{self.arm.name}: " + ("calibrated" if self.ok else f"not calibrated: {self.reason}")]
        lines.append(
            f"pose accuracy AP {1e3 * self.accuracy_before:.3g} mm before, {1e3 * self.accuracy_after:.3g} mm after; "
            f"RMS {1e3 * self.rms_before:.3g} and {1e3 * self.rms_after:.3g} mm; condition number {self.condition_number:.3g}"
        )
        for name, value, error in zip(self.names, self.values, self.errors, strict=True):
            lines.append(f"{name:>30} {1e3 * value:9.3f} +- {1e3 * error:.3f} mm or mrad")
        lines += self.inseparable
        return "\n".join(lines)

    _WHAT = "calibrated"

    def _identified(self, arm: Arm) -> Arm:
        chain = KinematicChain(arm)
        by_name = {parameter.name: parameter for parameter in chain.parameters}
        return chain.corrected([by_name[name] for name in self.names], self.values)

    def _complete(self, spec: mujoco.MjSpec, identified: Arm) -> None:
        place_bodies(spec, self.arm, identified)


class Measurement(NamedTuple):
    """Measured positions (K, 3) m and rotations (K, 3, 3), or None where only positions are measured."""

    position: Array
    rotation: Array | None


class Columns(NamedTuple):
    """Parameters that can be told apart, and for each other one the indices of those it cannot be told from."""

    kept: list[int]
    dependent: dict[int, list[int]]


class _GeometryFit:
    """Parameters fitted to measured poses by weighted least squares."""

    def __init__(self, chain: KinematicChain, parameters: Sequence[Parameter], q: Array, measured: Measurement):
        self._chain = chain
        self._parameters = parameters
        self._q = q
        self._measured = measured
        kinds = 1 if measured.rotation is None else 2
        self.noise = np.array([1.0, 1.0 / _ROTATION_ARM_M])[:kinds]  # (2,) m and rad, estimated from the residuals
        self.x = np.zeros(len(parameters))  # (p,) m or rad
        for _ in range(_WEIGHTINGS - 1 if kinds == 2 else 0):
            e, J = self._solved()
            free = self._by_kind(1.0 - np.einsum("kii->ki", _hat(J, len(q))))
            self.noise = self.noise * np.sqrt(self._by_kind(e**2) / np.maximum(free, np.finfo(float).tiny))
        e, J = self._solved()
        self.freedom = max(len(e) - len(parameters), 1)
        lengths = np.linalg.norm(J, axis=0)
        self.condition_number = float(np.linalg.cond(J / lengths)) if len(parameters) else 1.0
        inverse = np.linalg.pinv(J / lengths)
        factor = float(e @ e) / self.freedom  # by which the residuals are larger than the weights say
        self.covariance = factor * (inverse @ inverse.T) / np.outer(lengths, lengths)  # (p, p)
        rest = np.linalg.pinv(np.eye(3 * kinds) - _hat(J, len(q))) @ e.reshape(len(q), -1, 1)
        # (K, 3) m, errors of positions, each predicted by a fit to the other poses.
        self.left_out = rest[:, :3, 0] * self.noise[0]
        self.noise = self.noise * np.sqrt(factor)

    def _solved(self) -> tuple[Array, Array]:
        """Fits the parameters with weights by the noise; weighted residuals and their Jacobian."""
        from scipy.optimize import least_squares

        solve: Any = least_squares
        if len(self.x):
            self.x = solve(lambda x: self._rows(x)[0], self.x, lambda x: self._rows(x)[1], method="lm").x
        return self._rows(self.x)

    def _by_kind(self, squares: Array) -> Array:
        """Sums of squares of positions, and of rotations if they are measured."""
        return squares.reshape(len(self._q), len(self.noise), 3).sum(axis=(0, 2))

    def _rows(self, x: Array) -> tuple[Array, Array]:
        """Weighted residuals, predicted minus measured, pose by pose, and their Jacobian."""
        predicted = self._chain.predict(self._q, self._parameters, x)
        e = [(predicted.position - self._measured.position) / self.noise[0]]
        J = [predicted.position_by / self.noise[0]]
        if self._measured.rotation is not None:
            from scipy.spatial.transform import Rotation

            turn = predicted.rotation @ self._measured.rotation.transpose(0, 2, 1)
            e.append(Rotation.from_matrix(turn).as_rotvec() / self.noise[1])
            J.append(predicted.rotation_by / self.noise[1])
        rows = np.concatenate(e, axis=1).ravel()
        return rows, np.concatenate(J, axis=1).reshape(len(rows), len(x))


def calibrate_geometry(
    arm: Arm,
    q: ArrayLike,
    measured: ArrayLike | Sequence[Pose],
    *,
    sensor: str = "world",
    parameters: Sequence[str] | None = None,
) -> GeometryEstimate:
    """Calibrates the geometry of an arm from joint positions and measured poses or positions of its tip.

    Least squares with the exact Jacobian. Poses weigh positions and rotations by the noise that the residuals show. Errors of
    the joint positions count as noise. Parameters that no pose separates from those named before them stay as in the file.

    Sources: Hollerbach, Khalil, Gautier, "Model identification", in Springer Handbook of Robotics (2016); Shah, "Solving the
    robot-world/hand-eye calibration problem using the Kronecker product" (2013), for the start.

    Args:
        q: (K, n) rad, joint positions of at least four poses; `calibration_poses` chooses good ones.
        measured: (K, 3) m, measured positions of the tip or of a marker behind it, or K poses with orientation.
        sensor: "world" if the tip is measured in the world of the model; "fixed" for a sensor somewhere beside the arm (laser
            tracker, camera, fixture), which measures a marker somewhere on the last link; "hand" for a camera on the last link,
            which measures a marker somewhere in the world. The poses of sensor and marker are then found, too.
        parameters: What is fitted: kinds ("offsets", "base", "tool", "lengths", "axes", "sensor", "marker") or single names
            such as "joint2 x". By default all that the sensor allows; ["sensor", "marker"] is hand-eye calibration alone.

    Returns:
        The estimate. It is not ok, with a reason, if the poses do not show a parameter, or the file predicts the tip better.

    Raises:
        InputError: An argument is of another kind or shape, or no parameter has that name.
        ModelError: A joint of the arm follows another one, or two joints move one body.
    """
    check_arm(arm)
    sensor = choice("sensor", sensor, SENSORS)
    q = matrix("q", q, arm.n)
    read = _read(measured, len(q))
    chain = KinematicChain(arm, sensor == "hand")
    wanted = chain.select(DEFAULT_PARAMETERS[sensor] if parameters is None else parameters, read.rotation is None)
    if sensor != "world":
        chain.place_outer_frames(*_outer_frames(chain, q, read))
    structural = separable(chain, wanted, read.rotation is None)
    known = [wanted[i] for i in structural.kept]
    seen = identifiable(chain, known, q, read.rotation is None)
    fitted = [known[i] for i in seen.kept]
    unseen = tuple(known[i].name for i in seen.dependent)
    before = _GeometryFit(chain, [p for p in fitted if p.kind in ("sensor", "marker")], q, read)
    fit = _GeometryFit(chain, fitted, q, read)
    from scipy.special import stdtrit

    errors = np.sqrt(np.diag(fit.covariance))
    half = float(stdtrit(fit.freedom, 0.5 + 0.5 * CONFIDENCE)) * errors
    distances = [np.linalg.norm(each.left_out, axis=1) for each in (before, fit)]
    rms = [float(np.sqrt(np.mean(each**2))) for each in distances]
    ends = (chain.frame_pose(0, fitted, fit.x).inverse(), chain.frame_pose(arm.n + 3, fitted, fit.x))
    mount, marker = reversed(ends) if sensor == "hand" else ends
    reason = ""
    if unseen:
        reason = f"the poses do not show {counted(unseen)}; measure those of armctl.calibration_poses, or take fewer parameters"
    elif rms[1] > _MAX_LOSS * rms[0]:
        reason = (
            f"the file predicts the measured positions better ({1e3 * rms[0]:.3g} mm RMS) than the fit ({1e3 * rms[1]:.3g} mm)"
        )
    return GeometryEstimate(
        ok=not reason,
        reason=reason,
        arm=arm,
        names=tuple(parameter.name for parameter in fitted),
        values=frozen(fit.x),
        errors=frozen(errors),
        intervals=frozen(np.column_stack([fit.x - half, fit.x + half])),
        covariance=frozen(fit.covariance),
        inseparable=tuple(
            f"{wanted[i].name}: no pose "
            + (f"separates it from {counted(tuple(wanted[k].name for k in others))}" if others else "shows it")
            for i, others in structural.dependent.items()
        ),
        unseen=unseen,
        condition_number=fit.condition_number,
        noise=(float(fit.noise[0]), float(fit.noise[1]) if len(fit.noise) > 1 else float("nan")),
        accuracy_before=float(distances[0].max()),
        accuracy_after=float(distances[1].max()),
        rms_before=rms[0],
        rms_after=rms[1],
        sensor=None if sensor == "world" else mount,
        marker=None if sensor == "world" else marker,
    )


def _hat(J: Array, poses: int) -> Array:
    """(K, r, r), the blocks of the hat matrix: how much each pose determines its own prediction."""
    blocks = np.linalg.qr(J)[0].reshape(poses, len(J) // poses, J.shape[1])
    return blocks @ blocks.transpose(0, 2, 1)


def sample(arm: Arm, rng: np.random.Generator, count: int, share: float = 1.0) -> Array:
    """(count, n) random configurations within a share of the limits."""
    limits = arm.limits
    low = np.maximum(limits.q_min, arm.home - _MAX_DISTANCE)
    high = np.minimum(limits.q_max, arm.home + _MAX_DISTANCE)
    middle = 0.5 * (low + high)
    return middle + share * (rng.uniform(low, high, (count, arm.n)) - middle)


def separable(chain: KinematicChain, parameters: Sequence[Parameter], positions_only: bool) -> Columns:
    """Which parameters any poses of the arm tell apart: those that random ones within its limits do."""
    q = sample(chain.arm, np.random.default_rng(0), _RANDOM_CONFIGURATIONS)
    return identifiable(chain, parameters, q, positions_only)


def identifiable(chain: KinematicChain, parameters: Sequence[Parameter], q: Array, positions_only: bool) -> Columns:
    """Which parameters poses tell apart: a column of the Jacobian that earlier ones explain is in its null space with them."""
    J = np.concatenate(rows_of(chain, parameters, q, positions_only))
    lengths = np.linalg.norm(J, axis=0)
    J = J / np.maximum(lengths, _SEEN_TOLERANCE * lengths.max(initial=np.finfo(float).tiny))
    kept: list[int] = []
    dependent: dict[int, list[int]] = {}
    for i in range(len(parameters)):
        share = np.linalg.lstsq(J[:, kept], J[:, i])[0]
        if np.linalg.norm(J[:, i] - J[:, kept] @ share) > _SEEN_TOLERANCE:
            kept.append(i)
        else:
            dependent[i] = [kept[k] for k in np.flatnonzero(np.abs(share) > _MIN_SHARE)]
    return Columns(kept, dependent)


def rows_of(chain: KinematicChain, parameters: Sequence[Parameter], q: Array, positions_only: bool) -> Array:
    """(K, 3 or 6, p), derivatives of measured poses by errors at the file's geometry; a rad counts as much as 0.5 m."""
    predicted = chain.predict(q, parameters, np.zeros(len(parameters)))
    if positions_only:
        return predicted.position_by
    return np.concatenate([predicted.position_by, _ROTATION_ARM_M * predicted.rotation_by], axis=1)


def _read(measured: ArrayLike | Sequence[Pose], count: int) -> Measurement:
    poses: Any = measured
    if isinstance(measured, Sequence) and len(measured) and all(isinstance(each, Pose) for each in measured):
        read = Measurement(np.array([T.position for T in poses]), np.array([T.rotation for T in poses]))
    else:
        read = Measurement(matrix("measured", poses, 3), None)
    if len(read.position) != count or count < _MIN_POSES:
        raise InputError(
            f"measured: expected at least {_MIN_POSES} poses, as many as rows of q, got {len(read.position)} and {count}"
        )
    return read


def _outer_frames(chain: KinematicChain, q: Array, measured: Measurement) -> tuple[Pose, Pose]:
    """The ends of the chain, by linear equations with the geometry of the file, to start from."""
    tip = KinematicChain(chain.arm).predict(q, (), np.zeros(0))
    eye = np.broadcast_to(np.eye(3), tip.rotation.shape)
    p = measured.position
    if measured.rotation is None:
        # A fixed sensor: R^T p + b = tip + R_tip offset. One on the hand: tip = marker - R_tip (R p + offset).
        turned = -tip.rotation if chain.on_hand else eye
        columns = np.concatenate([np.einsum("kij,kl->kijl", turned, p).reshape(-1, 3, 9), eye, -tip.rotation], axis=2)
        found = np.asarray(np.linalg.lstsq(columns.reshape(-1, 15), tip.position.ravel())[0], float)
        R = nearest_rotations(found[:9].reshape(3, 3))
        if chain.on_hand:
            return Pose(-found[9:12]), computed_pose(found[12:], R)
        return computed_pose(-R.T @ found[9:12], R.T), Pose(found[12:])
    rotation = measured.rotation
    if chain.on_hand:
        rotation = rotation.transpose(0, 2, 1)
        p = -(rotation @ p[:, :, None])[:, :, 0]
    # vec(R_first) is proportional to the sum of kron(R_tip, R_measured) times vec(R_last^T).
    U, _, Vt = np.linalg.svd(np.einsum("kab,kcd->acbd", tip.rotation, rotation).reshape(9, 9))
    first = U[:, 0].reshape(3, 3, order="F")
    sign = np.sign(np.linalg.det(first))
    R = nearest_rotations(sign * first)
    columns = np.concatenate([R @ tip.rotation, eye], axis=2).reshape(-1, 6)
    found = np.asarray(np.linalg.lstsq(columns, (p - tip.position @ R.T).ravel())[0], float)
    last = nearest_rotations(sign * Vt[0].reshape(3, 3, order="F")).T
    return computed_pose(found[3:], R), computed_pose(found[:3], last)
