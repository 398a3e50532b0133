"""Pose: where a frame is and how it is turned."""

from __future__ import annotations

import math
import warnings
from functools import cache
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import ArmctlWarning, InputError
from armctl.core.validation import Array, array, as_array, frozen, instance, number, shown, vector

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

# Rounding to three digits: E is at most 0.5e-3 in each element, so R R^T of R + E differs from I by at most 2 sqrt(3) max|E| +
# 3 max|E|^2. What differs by more was made otherwise: scaled, sheared, or of other numbers.
ROUNDED_DIGITS = 3
_MAX_ELEMENT_ROUNDING = 0.5 * 10.0**-ROUNDED_DIGITS
MAX_NOT_ORTHONORMAL = 2.0 * math.sqrt(3.0) * _MAX_ELEMENT_ROUNDING + 3.0 * _MAX_ELEMENT_ROUNDING**2
_EXACT = 1e-12  # what products of rotations differ by from a rotation; it is left as it is
_MAX_SQUARED = 1e100  # the squares of larger numbers overflow
_MAX_LAST_ROW_ERROR = 1e-9  # of a homogeneous transform's last row from 0 0 0 1


class Pose:
    """A rigid transform T_a_b: the position and orientation of frame b in frame a.

    Frozen. Poses multiply with `@`, names cancel: `T_world_tip = T_world_base @ T_base_tip`.

    Attributes:
        position: (3,) m.
        quat: (4,) unit quaternion, wxyz, with w >= 0.
        rotation: (3, 3) rotation matrix.
        rows: (4, 3) the rows of the rotation and, last, the position: one block of memory.
    """

    __slots__ = ("position", "quat", "rotation", "rows")

    position: Array
    quat: Array
    rotation: Array
    rows: Array

    def __init__(self, position: ArrayLike, quat: ArrayLike | None = None, *, rpy: ArrayLike | None = None):
        """A pose from a position and, if given, one orientation.

        Args:
            position: (3,) m.
            quat: (4,) wxyz; it is normalised. Left out, the orientation is the identity.
            rpy: (3,) rad, fixed-axis roll, pitch, yaw: R = Rz(yaw) Ry(pitch) Rx(roll). Angles above 2 pi give a warning.

        Raises:
            InputError: A wrong length, a number that is not finite, a zero quaternion, or both quat and rpy.
        """
        if quat is not None and rpy is not None:
            raise InputError("Pose: both quat and rpy given; give one")
        if quat is not None and as_array("quat", quat).shape == (3, 3):
            raise InputError("quat: a (3, 3) array is no quaternion; Pose.from_rotation takes a rotation matrix")
        if rpy is not None:
            angles = vector("rpy", rpy, 3)
            if np.abs(angles).max() > 2 * np.pi:
                warnings.warn(
                    ArmctlWarning(f"rpy: {shown(rpy)} is taken in radians; np.radians converts degrees"), stacklevel=2
                )
            wxyz = _quat_from_rpy(angles)
        else:
            wxyz = vector("quat", (1.0, 0.0, 0.0, 0.0) if quat is None else quat, 4)
        largest = float(np.abs(wxyz).max())
        if largest > _MAX_SQUARED:
            wxyz = wxyz / largest
        norm = float(np.linalg.norm(wxyz))
        if norm < 1e-9:
            raise InputError("quat: its norm is zero, so it is no orientation; [1, 0, 0, 0] is the identity")
        wxyz = _canonical(wxyz / norm)
        self._fill(vector("position", position, 3), wxyz, matrix_from_quat(wxyz))

    def _fill(self, position: ArrayLike, quat: Array, rotation: Array) -> None:
        rows = np.empty((4, 3))
        rows[:3] = rotation
        rows[3] = position
        object.__setattr__(self, "rows", frozen(rows))
        object.__setattr__(self, "rotation", rows[:3])
        object.__setattr__(self, "position", rows[3])
        object.__setattr__(self, "quat", frozen(quat))

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"a Pose is frozen; make a new one instead of setting {name!r}")

    __delattr__ = __setattr__  # type: ignore[assignment]

    def __reduce__(self):
        return computed_pose, (np.array(self.position), np.array(self.rotation))

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> Pose:
        """A pose from a homogeneous transform.

        Args:
            matrix: (4, 4). A rotation that is rounded, to three digits or more, becomes the nearest one.

        Raises:
            InputError: Another shape, a number that is not finite, or no rigid transform.
        """
        T = array("matrix", matrix, 2)
        if T.shape != (4, 4):
            raise InputError(f"matrix: expected shape (4, 4), got {T.shape}")
        rows = read_transforms("matrix", T[None])[0]
        return computed_pose(rows[9:], rows[:9].reshape(3, 3))

    @classmethod
    def from_rotation(cls, position: ArrayLike, rotation: ArrayLike) -> Pose:
        """A pose from a position and a rotation matrix.

        Args:
            position: (3,) m.
            rotation: (3, 3). One that is rounded, to three digits or more, becomes the nearest rotation.

        Raises:
            InputError: Another shape, a number that is not finite, or a matrix that is no rotation.
        """
        R = array("rotation", rotation, 2)
        if R.shape != (3, 3):
            raise InputError(f"rotation: expected shape (3, 3), got {R.shape}")
        return computed_pose(vector("position", position, 3), read_rotations("rotation", R[None])[0])

    def turned_about(self, point: ArrayLike, axis: ArrayLike, angle: float) -> Pose:
        """This pose after everything has turned about a line, as a handle does with its door.

        Args:
            point: (3,) m, on the line.
            axis: (3,) its direction.
            angle: rad.

        Raises:
            InputError: A wrong length, a number that is not finite, or an axis of zeros.
        """
        turn = Pose.from_axis_angle([0.0, 0.0, 0.0], axis, angle).rotation
        center = vector("point", point, 3)
        return computed_pose(center + turn @ (self.position - center), turn @ self.rotation)

    @property
    def matrix(self) -> Array:
        """(4, 4) homogeneous transform."""
        T = np.eye(4)
        T[:3, :3] = self.rotation
        T[:3, 3] = self.position
        return frozen(T)

    @property
    def rpy(self) -> Array:
        """(3,) rad, fixed-axis roll, pitch, yaw; at pitch = +-pi/2 the roll is zero."""
        R = self.rotation
        pitch = math.atan2(-R[2, 0], math.hypot(R[0, 0], R[1, 0]))
        if abs(R[2, 0]) > 1 - 1e-12:
            return frozen(np.array([0.0, pitch, math.atan2(-R[0, 1], R[1, 1])]))
        return frozen(np.array([math.atan2(R[2, 1], R[2, 2]), pitch, math.atan2(R[1, 0], R[0, 0])]))

    @classmethod
    def from_axis_angle(cls, position: ArrayLike, axis: ArrayLike, angle: float) -> Pose:
        """A pose from a position and a rotation about an axis.

        Args:
            position: (3,) m.
            axis: (3,), of any length above 0.
            angle: rad.

        Raises:
            InputError: A wrong length, a number that is not finite, or an axis of zeros.
        """
        direction = vector("axis", axis, 3)
        length = float(np.linalg.norm(direction))
        if not 1.0 / _MAX_SQUARED < length < _MAX_SQUARED:
            raise InputError(f"axis: {shown(direction.tolist())} has no direction; give a vector such as [0, 0, 1]")
        rotation = rotation_from_vector(direction / length * number("angle", angle))
        return computed_pose(vector("position", position, 3), rotation)

    @property
    def axis_angle(self) -> tuple[Array, float]:
        """The axis, a unit vector (3,), and the angle of the rotation, rad, in [0, pi]; about z where there is none."""
        w = rotation_vector(self.rotation)
        angle = float(np.linalg.norm(w))
        return frozen(w / angle if angle > 0.0 else np.array([0.0, 0.0, 1.0])), angle

    @classmethod
    def from_euler(cls, position: ArrayLike, order: str, angles: ArrayLike) -> Pose:
        """A pose from a position and three rotations, one after the other.

        Args:
            position: (3,) m.
            order: Three axes as of SciPy: "xyz" turns about fixed axes, which is `rpy`; "ZYX" about those of the turned frame.
            angles: (3,) rad.

        Raises:
            InputError: A wrong length, a number that is not finite, or another order.
        """
        rotation = _euler().from_euler(_checked_order(order), vector("angles", angles, 3)).as_matrix()
        return computed_pose(vector("position", position, 3), rotation)

    def euler(self, order: str) -> Array:
        """The angles of three rotations that give the orientation, one after the other.

        Args:
            order: Three axes as of SciPy: "xyz" turns about fixed axes, "ZYX" about those of the turned frame.

        Returns:
            (3,) rad; where the first and the last axis coincide, one of their angles is zero.

        Raises:
            InputError: Another order.
        """
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # SciPy's about coinciding axes, which the docstring says
            return frozen(np.asarray(_euler().from_matrix(self.rotation).as_euler(_checked_order(order)), dtype=np.float64))

    @classmethod
    def exp(cls, twist: ArrayLike) -> Pose:
        """The pose that a constant twist in its own axes reaches from the identity in 1 s, along a screw.

        Args:
            twist: (6,) m and rad, linear part first.

        Raises:
            InputError: A wrong length, or a number that is not finite.
        """
        reached = _pinocchio().exp6(vector("twist", twist, 6))
        return computed_pose(reached.translation.copy(), reached.rotation.copy())

    def log(self) -> Array:
        """(6,) m and rad: the shortest twist, linear part first, whose `exp` is this pose."""
        return frozen(np.array(_pinocchio().log6(_pinocchio().SE3(self.rotation, self.position)).vector))

    def interpolated(self, other: Pose, share: float) -> Pose:
        """A pose on the way to another one: the position on a line, the orientation about one axis, as `move_l` goes.

        Args:
            other: The pose at the end, in the same frame.
            share: Of the way, from 0 to 1. Along a screw goes `self @ Pose.exp(share * (self.inverse() @ other).log())`.

        Raises:
            InputError: No pose, or a share out of bounds.
        """
        instance("other", other, Pose, "armctl.Pose(position) makes one")
        share = number("share", share, 0.0, 1.0)
        turn = rotation_from_vector(share * rotation_vector(self.rotation.T @ other.rotation))
        return computed_pose(self.position + share * (other.position - self.position), self.rotation @ turn)

    def __matmul__(self, other: Pose) -> Pose:
        if not isinstance(other, Pose):
            return NotImplemented
        return computed_pose(self.rotation @ other.position + self.position, self.rotation @ other.rotation)

    def inverse(self) -> Pose:
        """T_b_a of this T_a_b."""
        return computed_pose(-self.rotation.T @ self.position, self.rotation.T)

    def transform(self, point: ArrayLike) -> Array:
        """A point given in b, in a.

        Args:
            point: (3,) m, in b.

        Returns:
            (3,) m, in a.
        """
        return self.rotation @ vector("point", point, 3) + self.position

    def distance(self, other: Pose) -> tuple[float, float]:
        """How far another pose is.

        Args:
            other: The other pose, in the same frame.

        Returns:
            The distance in m and the angle in rad, 0 to pi.
        """
        instance("other", other, Pose, "armctl.Pose(position) makes one")
        return float(np.linalg.norm(other.position - self.position)), rotation_angle(self.rotation.T @ other.rotation)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Pose):
            return NotImplemented
        return bool(np.array_equal(self.position, other.position) and np.array_equal(self.rotation, other.rotation))

    def __hash__(self) -> int:
        return hash((self.position.tobytes(), self.rotation.tobytes()))

    def __repr__(self) -> str:
        return f"Pose({_rounded(self.position)}, quat={_rounded(self.quat)})"


def computed_pose(position: Array, rotation: Array) -> Pose:
    """A pose from a computed position (3,) and rotation (3, 3), which are known to be right: no checks, and the same bits."""
    pose = Pose.__new__(Pose)
    wxyz = np.empty(4)
    _mujoco().mju_mat2Quat(wxyz, rotation.ravel())
    pose._fill(position, _canonical(wxyz), rotation)
    return pose


def read_rotations(what: str, R: Array) -> Array:
    """A caller's matrices (N, 3, 3) as rotations: rounded ones become the nearest rotation, others are an InputError."""
    errors = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    determinants = np.linalg.det(R)
    wrong = ~((errors <= MAX_NOT_ORTHONORMAL) & (determinants > 0.0))
    if wrong.any():
        i = int(wrong.argmax())
        which = what if len(R) == 1 else f"{what}: element {i}"
        raise InputError(f"{which}: no rotation: {_why_no_rotation(R[i], float(determinants[i]))}")
    inexact = errors > _EXACT
    if not inexact.any():
        return R
    rotations = np.array(R)
    rotations[inexact] = nearest_rotations(R[inexact])
    return rotations


def _why_no_rotation(R: Array, determinant: float) -> str:
    lengths = np.linalg.norm(R, axis=1)
    if np.abs(lengths - 1.0).max() > MAX_NOT_ORTHONORMAL:
        return f"its rows have the lengths {shown(lengths.round(4).tolist())}, expected 1; remove a scale before"
    cosines = np.abs(R @ R.T - np.eye(3)).max()
    if cosines > MAX_NOT_ORTHONORMAL:
        return f"its rows are not perpendicular: the cosine between two is {cosines:.2g}, at most {MAX_NOT_ORTHONORMAL:.2g}"
    return f"it mirrors: its determinant is {determinant:.2g}, expected 1; z must be the cross product of x and y"


def nearest_rotations(M: Array) -> Array:
    """The rotations nearest to matrices (..., 3, 3): Umeyama (1991)."""
    U, _, Vt = np.linalg.svd(M)
    U[..., 2] *= np.linalg.det(U @ Vt)[..., None]
    return U @ Vt


def read_transforms(what: str, T: Array) -> Array:
    """A caller's homogeneous transforms (N, 4, 4) as rows (N, 12): rotation row by row, position. InputError as above."""
    wrong = np.abs(T[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1) > _MAX_LAST_ROW_ERROR
    if wrong.any():
        i = int(wrong.argmax())
        which = what if len(T) == 1 else f"{what}: element {i}"
        transposed = np.abs(T[i, :, 3] - [0.0, 0.0, 0.0, 1.0]).max() <= _MAX_LAST_ROW_ERROR
        hint = "it is transposed" if transposed else "the position is the last column"
        raise InputError(f"{which}: no rigid transform: its last row is {shown(T[i, 3].tolist())}, expected 0, 0, 0, 1; {hint}")
    return np.concatenate([read_rotations(what, T[:, :3, :3]).reshape(-1, 9), T[:, :3, 3]], axis=1)


def _rounded(values: Array) -> list[float]:
    return [round(float(x), 6) + 0.0 for x in values]  # + 0.0 turns -0.0 into 0.0


def rotation_vector(R: Array) -> Array:
    """The rotation vector (3,), axis times angle in rad, of a rotation matrix; it is accurate at 0 and at pi, its longest."""
    return _pinocchio().log3(R)


def rotation_angle(R: Array) -> float:
    """The angle of a rotation matrix, in rad, in [0, pi]."""
    return float(np.linalg.norm(rotation_vector(R)))


def rotation_from_vector(w: Array) -> Array:
    """The rotation matrix of a rotation vector (3,), rad."""
    return _pinocchio().exp3(w)


@cache
def _pinocchio() -> ModuleType:
    """Pinocchio, imported when a rotation vector is first needed: `armctl.Pose` alone loads in half the time without it."""
    import pinocchio

    return pinocchio


def _euler() -> type[Rotation]:
    """SciPy's rotations, imported when angles of Euler are first needed."""
    from scipy.spatial.transform import Rotation

    return Rotation


def _checked_order(order: str) -> str:
    """A caller's order of three axes: InputError if it is none, such as one with the same axis twice in a row."""
    is_order = isinstance(order, str) and len(order) == 3 and (order.islower() or order.isupper())
    if not is_order or set(order.lower()) - set("xyz") or order[0] == order[1] or order[1] == order[2]:
        raise InputError(f"order: {shown(order)} are no three axes; give 'xyz' for fixed axes, or 'ZYX' for turned ones")
    return order


@cache
def _mujoco() -> ModuleType:
    """MuJoCo, imported when a quaternion is first computed."""
    import mujoco

    return mujoco


def _canonical(wxyz: Array) -> Array:
    """Of q and -q, the same rotation, the one with w >= 0."""
    return -wxyz if wxyz[0] < 0 else wxyz


def _quat_from_rpy(rpy: Array) -> Array:
    cr, cp, cy = np.cos(rpy / 2)
    sr, sp, sy = np.sin(rpy / 2)
    return np.array(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


def matrix_from_quat(wxyz: Array) -> Array:
    """The rotation matrix (3, 3) of a unit quaternion (4,); those (3, 3, N) of the columns of (4, N)."""
    w, x, y, z = wxyz
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
