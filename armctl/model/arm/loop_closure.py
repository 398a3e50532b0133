"""LoopClosure: where the passive joints of an arm with closed loops are, and how they move with the driven ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin

from armctl import _core
from armctl.core import units
from armctl.core.errors import LimitError, ModelError, few_names
from armctl.core.validation import Array, BoolArray, IntArray, frozen
from armctl.model.arm.joint_frames import JointFrames, joint_frames
from armctl.model.mjmodel.closed_loops import LoopGroup, label_of
from armctl.model.mjmodel.couplings import bodies_of_loop
from armctl.model.mjmodel.queries import Joints, joint_name, joint_range, last_joint_above

_WELD = int(mujoco.mjtEq.mjEQ_WELD)
_MAX_HALVINGS = 10


@dataclass(frozen=True, eq=False)
class LoopClosure:
    """The closed loops of an arm with m joints, of which n are driven.

    The positions of the passive joints are the solution of the loops' equations, and nothing but a function of q.
    """

    arguments: dict[str, Any]  # of the compiled core's
    label: str  # what closes the loops, for messages
    passive: IntArray  # which of the m joints no motor drives
    names: tuple[str, ...]  # of these joints
    unit: tuple[str, ...]  # of these joints
    q_min: Array  # rad (m), of these joints
    q_max: Array
    moved: BoolArray  # (m, n) which joints each of the n moves

    @property
    def refusal(self) -> str:
        """The sentence of what is not computed for an arm with closed loops."""
        known = "kinematics, dynamics, solve_ik, motions and simulations do"
        return f"{self.label}: this function does not know closed loops; {known}"

    @cached_property
    def core(self) -> _core.LoopClosure:
        """The closure of the compiled core."""
        return _core.LoopClosure(**self.arguments)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "core"}

    def closed_rows(self, q: Array) -> tuple[int, Array, Array]:
        """How many of the configurations q (T, n), from the first on, close the loops, and what they are there.

        The positions (T, m) of all joints, and their speeds (T, m, n) per speed of the driven ones.
        """
        m, n = self.moved.shape
        positions = np.empty((len(q), m))
        ratios = np.empty((len(q), m, n))
        count = _core.close_loops(self.core, np.ascontiguousarray(q), positions, ratios.reshape(len(q), m * n))
        return count, positions, ratios

    def at(self, q: Array) -> tuple[Array, Array]:
        """The positions (..., m) of all joints, and their speeds (..., m, n) per speed of the driven ones, for q (..., n).

        LimitError where the loops do not close.
        """
        rows = q.reshape(-1, q.shape[-1])
        count, positions, ratios = self.closed_rows(rows)
        if count < len(rows):
            raise LimitError(f"q: {self._open_at(rows[count])}")
        return positions.reshape(*q.shape[:-1], -1), ratios.reshape(*q.shape[:-1], *self.moved.shape)

    def acceleration(self, q: Array, v: Array) -> Array:
        """(m,) the accelerations of all joints at the speeds v (n,) of the driven ones whose own accelerations are zero."""
        found = np.empty((1, len(self.moved)))
        _core.loop_accelerations(self.core, np.ascontiguousarray(q[None]), np.ascontiguousarray(v[None]), found)
        return found[0]

    def ratio_derivative(self, q: Array, v: Array) -> Array:
        """(m, n) the time derivative of the speed ratios at q and v (n,).

        The accelerations c(v) = B(v, v) are quadratic in v, and its columns are B(v, e_i) = (c(v + e_i) - c(v - e_i)) / 4.
        """
        units_of_speed = np.eye(len(q))
        columns = [self.acceleration(q, v + each) - self.acceleration(q, v - each) for each in units_of_speed]
        return 0.25 * np.column_stack(columns)

    def near_reference(self, displacement: Array) -> Array:
        """(n,) rad (m), the reference, or on the way from it by a displacement (n,) the first half at which the loops close."""
        q = self.arguments["reference_q"]
        for halving in range(_MAX_HALVINGS):
            moved = q + 0.5**halving * displacement
            if self.closed_rows(moved[None])[0]:
                return moved
        return q

    def inward(self, home: Array, q: Array) -> Array:
        """Configurations (k, n), each moved towards home (n,), in halvings of its way, to where the loops close.

        Passive joints are inside their limits there. Home is such a configuration.
        """
        found = np.array(q)
        for row in found:
            way = row - home
            for halving in range(_MAX_HALVINGS):
                row[:] = home + 0.5**halving * way
                if not self.first_refusal(row[None])[1]:
                    break
            else:
                row[:] = home
        return found

    def first_refusal(self, q: Array) -> tuple[int, str]:
        """The first configuration of q (T, n) at which the loops do not close or a passive joint leaves its limits, and why.

        The number of configurations and no reason if there is none.
        """
        count, positions, _ = self.closed_rows(q)
        own = positions[:count, self.passive]
        outside = (own < self.q_min - _core.PASSIVE_LIMIT_TOLERANCE) | (own > self.q_max + _core.PASSIVE_LIMIT_TOLERANCE)
        if outside.any():
            row = int(outside.any(axis=1).argmax())
            k = int(outside[row].argmax())
            bounds = f"[{self.q_min[k]:.3f}, {self.q_max[k]:.3f}] {self.unit[k]}"
            return row, f"the passive joint {self.names[k]} would be at {own[row, k]:.4g} {self.unit[k]}, outside {bounds}"
        return (count, self._open_at(q[count])) if count < len(q) else (count, "")

    def first_break(self, knots: Array, coefficients: Array) -> float | None:
        """s, where a motion of the driven joints is not proved to keep the loops closed and the passive joints in their limits.

        None if it is, over the whole continuous motion. `coefficients` (K, degree + 1, n), of degree 1 to 5, are those of
        powers of the time since each of the `knots` (K + 1,) s.
        """
        return _core.first_break(self.core, np.ascontiguousarray(knots), np.ascontiguousarray(coefficients))

    def _open_at(self, q: Array) -> str:
        numbers = ", ".join(f"{x:.4g}" for x in q)
        return f"{self.label} cannot be closed, or only in a singular position, at [{numbers}]"


def build_loop_closure(
    model: mujoco.MjModel, joints: Joints, ratio: Array, offset: Array, groups: Sequence[LoopGroup], qpos: Array
) -> LoopClosure:
    """The closure of loops over some joints, whose driven ones have positions `ratio` q + `offset`.

    The loops stay on the branch on which `qpos` (nq,) closes them; if it does not, on that of the model's `qpos0`. ModelError
    if neither closes them, or where they do not determine the passive joints.
    """
    row_of = {joint: row for row, joint in enumerate(joints)}
    passive = [row_of[joint] for group in groups for joint in group.passive]
    at = joint_frames(model, joints, qpos)
    equalities = [equality for group in groups for equality in group.equalities]
    ties = [tie for group in groups for tie in group.ties]
    ends = [_loop_ends(model, joints, at, equality) for equality in equalities]
    leaders = [int(model.eq_obj2id[tie]) for tie in ties]
    followers = [int(model.eq_obj1id[tie]) for tie in ties]
    names = [joint_name(model, joints[row]) for row in passive]
    slides = at.is_slide[passive]
    label = f"the loop of the equality {label_of(model, equalities[0])}"
    if len(equalities) > 1:
        label = f"the loops of the equalities {few_names([label_of(model, each) for each in equalities])}"
    ranges = np.array([joint_range(model, joints[row]) for row in passive])
    arguments: dict[str, Any] = {
        "rotations": np.array([placement.rotation for placement in at.placements]),
        "translations": np.array([placement.translation for placement in at.placements]),
        "slides": at.is_slide.astype(np.int64),
        "parents": np.array(at.parents, np.int64),
        "offsets": offset,
        "ratio": ratio,
        "passive": np.array(passive, np.int64),
        "low": np.ascontiguousarray(ranges[:, 0]),
        "high": np.ascontiguousarray(ranges[:, 1]),
        "first_joints": np.array([first for first, _, _, _ in ends], np.int64),
        "first_placements": np.array([placement for _, placement, _, _ in ends]),
        "second_joints": np.array([second for _, _, second, _ in ends], np.int64),
        "second_placements": np.array([placement for _, _, _, placement in ends]),
        "holds_axes": np.array([model.eq_type[each] == _WELD for each in equalities], np.int64),
        "followers": np.array([row_of[joint] for joint in followers], np.int64),
        "leaders": np.array([row_of[joint] for joint in leaders], np.int64),
        "terms": np.array([_terms(model, tie) for tie in ties]).reshape(-1, 5),
        "length": _length(at),
    }
    closure = LoopClosure(
        arguments=arguments,
        label=label,
        passive=frozen(np.array(passive)),
        names=tuple(names),
        unit=units.of_joints(slides),
        q_min=frozen(ranges[:, 0]),
        q_max=frozen(ranges[:, 1]),
        moved=frozen(_moved(joints, ratio, groups)),
    )
    closure.arguments.update(_reference(model, joints, closure, qpos))
    return closure


def _reference(model: mujoco.MjModel, joints: Joints, closure: LoopClosure, qpos: Array) -> dict[str, Array]:
    """Where the loops are closed first: the driven positions `reference_q` (n,), and those of all joints, `reference` (m,)."""
    ratio = closure.arguments["ratio"]
    offset = closure.arguments["offsets"]
    addresses = model.jnt_qposadr[list(joints)]
    for start in (qpos, model.qpos0):
        positions = start[addresses]
        q = np.linalg.pinv(ratio) @ (positions - offset)
        q[np.abs(q) < np.finfo(float).eps] = 0.0
        arguments = closure.arguments | {"reference_q": q, "reference": positions.copy()}
        count, closed, _ = _closed(arguments, q)
        if count:
            return {"reference_q": q, "reference": closed}
    raise ModelError(
        f"{closure.label}: no position of {few_names(closure.names)} closes it near the model's keyframe or its zero, or it is "
        "singular there; write a keyframe in which it is closed"
    )


def _closed(arguments: dict[str, Any], q: Array) -> tuple[int, Array, Array]:
    m, n = arguments["ratio"].shape
    positions = np.empty((1, m))
    ratios = np.empty((1, m * n))
    count = _core.close_loops(_core.LoopClosure(**arguments), q[None], positions, ratios)
    return count, positions[0], ratios


def _moved(joints: Joints, ratio: Array, groups: Sequence[LoopGroup]) -> BoolArray:
    """(m, n) which joints each of the n moves: the passive joints of a loop are moved by all of its drivers."""
    moved = ratio != 0.0
    for group in groups:
        drivers = moved[[joints.index(joint) for joint in group.drivers]].any(axis=0)
        for joint in group.passive:
            moved[joints.index(joint)] = drivers
    return moved


def _loop_ends(model: mujoco.MjModel, joints: Joints, at: JointFrames, equality: int) -> tuple[int, Array, int, Array]:
    """The two frames that an equality holds together: the joint that carries each, -1 for the base, and its place.

    Source: MuJoCo's XML reference, equality/connect and equality/weld, and the layout of `eq_data`.
    """
    data = model.eq_data[equality]
    first, second = bodies_of_loop(model, equality)
    if model.eq_objtype[equality] == int(mujoco.mjtObj.mjOBJ_SITE):
        placements = [
            _pose(model.site_pos[k], model.site_quat[k]) for k in (model.eq_obj1id[equality], model.eq_obj2id[equality])
        ]
    elif model.eq_type[equality] == _WELD:
        placements = [_pose(data[3:6], data[6:10]), _pose(data[0:3], np.array([1.0, 0.0, 0.0, 0.0]))]
    else:
        unit = np.array([1.0, 0.0, 0.0, 0.0])
        placements = [_pose(data[0:3], unit), _pose(data[3:6], unit)]
    owners = last_joint_above(model, joints)
    found = []
    for body, placement in zip((first, second), placements, strict=True):
        T_world_body = pin.SE3(at.data.xmat[body].reshape(3, 3).copy(), at.data.xpos[body].copy())
        T_world_frame = T_world_body * placement
        owner = owners[body]
        T = T_world_frame if owner < 0 else at.frames[owner].actInv(T_world_frame)
        found.append((owner, np.concatenate([T.rotation.ravel(), T.translation])))
    return *found[0], *found[1]


def _pose(position: Array, quat: Array) -> pin.SE3:
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, np.asarray(quat, np.float64))
    return pin.SE3(rotation.reshape(3, 3), np.array(position, np.float64))


def _terms(model: mujoco.MjModel, tie: int) -> Array:
    """The terms (5,) of a joint equality between positions: MuJoCo's is one of displacements from `qpos0`, and linear here."""
    offset, ratio = model.eq_data[tie, :2].tolist()
    zero = model.qpos0[model.jnt_qposadr[[int(model.eq_obj1id[tie]), int(model.eq_obj2id[tie])]]]
    return np.array([offset + zero[0] - ratio * zero[1], ratio, 0.0, 0.0, 0.0])


def _length(at: JointFrames) -> float:
    """m, the longest way from a joint to the next."""
    lengths = [float(np.linalg.norm(each.translation)) for each in at.placements]
    between = [length for length, above in zip(lengths, at.parents, strict=True) if above >= 0]
    return max(between, default=0.0) or 1.0
