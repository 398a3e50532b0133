"""The tasks and limits that armctl adds to mink's quadratic program. This imports mink: load it late."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import mink
import mujoco
import numpy as np
from mink.tasks import BaseTask

from armctl.core.validation import Array
from armctl.ik.collision_pairs import avoidable_pairs
from armctl.ik.problem import compiled, packed_chain
from armctl.robot.arm import Arm

# The weight of the rotation is divided by 1 + this times the position error in reaches: at a target out of reach the position
# comes first.
POSITION_PRIORITY = 10.0
MIN_DAMPING = 1e-5
ERROR_DAMPING = 0.05  # per reach of error
SINGULAR_VALUE = 0.05  # below it damping rises ...
SINGULAR_DAMPING = 1e-3  # ... up to this
MIN_GAIN_REACHES = 1e-8  # a step that gains less at a target out of reach is not made
FLAT_CURVATURE = 1e-3  # the posture acts only in directions less curved than this ...
FAR_ERROR_REACHES = 0.01  # ... and at targets nearer than this
SEARCH_DAMPING = 2e-2  # times the squared error, if the second order is left out
APPROACH_SHARE = 0.5  # of the free distance that may be used up in one step
RECOVERY_SPEED = 0.1  # m/s, with which bodies that are too near are moved apart
MIN_NORMAL_LENGTH = 1e-9  # m: two nearest points closer than this give no direction
DISTANCE_ROUNDING = 1e-9  # m


class TipTask(BaseTask):
    """Brings the tip to a target and, as far as that leaves freedom, the joints to a posture.

    The objective is the second-order model of half the squared error: J^T J and the curvature of the chain, which grows with
    the error. With it the arm stands still at the nearest reachable point of a target out of reach, where J^T J alone
    overshoots. Negative curvature counts by its absolute value (Dauphin and others: "Identifying and attacking the saddle
    point problem", NeurIPS 2014). Damping rises near singularities, with the smallest singular value (Nakamura, Hanafusa:
    "Inverse kinematic solutions with singularity robustness for robot manipulator control", J. Dyn. Sys., Meas., Control
    108(3), 1986), and it damps towards a step in the null space that leads to the posture, so that neither disturbs the
    other. Lengths are in reaches.

    On a Panda 5 s after a point 4 m out of reach was set, joints still move at 2.6 rad/s with mink's FrameTask, and at 0 here.
    """

    def __init__(self, arm: Arm, posture: Array):
        """The task of an arm whose joints approach `posture` (n,)."""
        self._arm = arm
        self._posture = posture
        self._chain = packed_chain(arm)
        self._block = np.ix_(arm.dof_adr, arm.dof_adr)
        self._hessian = np.empty((arm.n, arm.n))
        self._gradient = np.empty(arm.n)
        self._jacobian = np.empty((6, arm.n))
        self._scratch = compiled().scratch(arm.pinocchio_model.chain_length, arm.n)
        self._gain: Array | None = None  # (n,) reaches gained per unit of a joint's step, at a target far away
        self.low = np.full(arm.n, -np.inf)  # bounds of the step
        self.high = np.full(arm.n, np.inf)
        self.converges_out_of_reach = True  # a search that restarts elsewhere is faster without
        self.constraint = compiled().POSITION
        self.target = np.zeros(12)
        self.posture_share = 0.0  # of the way to the posture in one step

    def is_idle(self, dq: Array) -> bool:
        """Whether the step dq (n,) from the last objective brings the tip no nearer to a target that is out of reach."""
        return self._gain is not None and bool(abs(self._gain @ dq) < MIN_GAIN_REACHES)

    def _error_model(self, q: Array) -> _ErrorModel:
        """Half the squared error around q (n,)."""
        kernel = compiled()
        chain = self._chain
        size = kernel.objective(
            chain.rows,
            chain.reach,
            self.target,
            self.constraint,
            POSITION_PRIORITY,
            self.converges_out_of_reach,
            chain.to_units(q),
            self._hessian,
            self._gradient,
            self._jacobian,
            self._scratch,
        )
        jacobian = self._jacobian[:3] if self.constraint == kernel.POSITION else self._jacobian
        if not chain.has_slides:
            return _ErrorModel(size, self._hessian, self._gradient, jacobian)
        unit = chain.unit
        return _ErrorModel(size, self._hessian / np.outer(unit, unit), self._gradient / unit, jacobian / unit)

    def _null_step(self, desired: Array) -> Array:
        """The part of a desired step (n,) that leaves the error as it is, within the bounds."""
        unit = self._chain.unit
        step = np.empty_like(desired)
        compiled().null_step(self.constraint, desired / unit, self.low / unit, self.high / unit, step, self._scratch)
        return step * unit

    def compute_qp_objective(self, configuration: mink.Configuration) -> mink.Objective:
        """The Hessian H (nv, nv) and gradient c (nv,) of the task's part of the program."""
        q = configuration.data.qpos[self._arm.qpos_adr]
        size, hessian, descent, jacobian = self._error_model(q)
        if self.converges_out_of_reach:
            eigenvalues, V = np.linalg.eigh(hessian)
            curvature = np.abs(eigenvalues)
            hessian = (V * curvature) @ V.T
            redundant = len(jacobian) < len(q)
            gram = jacobian @ jacobian.T if len(jacobian) <= len(q) else jacobian.T @ jacobian
            smallest = np.linalg.eigvalsh(gram)[0]
            damping = (
                MIN_DAMPING
                + min(ERROR_DAMPING * size, SINGULAR_DAMPING)
                + SINGULAR_DAMPING * max(0.0, 1 - smallest / SINGULAR_VALUE**2)
            )
            share = self.posture_share * max(0.0, 1 - size / FAR_ERROR_REACHES)
            if share > 0 and redundant:
                flatness = np.maximum(0.0, 1 - curvature / FLAT_CURVATURE) ** 2
                descent = descent + damping * (V * flatness) @ (self._null_step(share * (self._posture - q)) @ V)
        else:
            damping = SEARCH_DAMPING * min(1.0, size**2)
        self._gain = descent / size if size > FAR_ERROR_REACHES else None
        H = np.zeros((configuration.nv, configuration.nv))
        c = np.zeros(configuration.nv)
        H[self._block] = hessian
        H[self._arm.dof_adr, self._arm.dof_adr] += damping
        c[self._arm.dof_adr] = -descent
        return mink.Objective(H, c)


class _ErrorModel(NamedTuple):
    """Half the squared error: its root, Hessian, negative gradient, and the Jacobian of the error."""

    size: float
    hessian: Array
    descent: Array
    jacobian: Array


class _Distance(NamedTuple):
    """The distance of a pair of geoms, by its number, and the derivative by the model's joints (nv,)."""

    pair: int
    distance: float
    gradient: Array


class ClearanceLimit(mink.Limit):
    """Keeps pairs of geoms apart: in one step their distance may shrink by at most half of what is free.

    The rule is that of Faverjon and Tournassoud ("A local based approach for path planning of manipulators with a high number
    of degrees of freedom", ICRA 1987).
    """

    def __init__(self, arm: Arm, clearance: float):
        """The limit of an arm that keeps `clearance`, m; its model decides which pairs can be avoided."""
        self._arm = arm
        self._model = arm.model
        self._clearance = clearance
        self._pairs = avoidable_pairs(arm, clearance)
        self._floor = np.full(len(self._pairs), 0.5 * clearance)  # m, the least distance that a step may end at
        lever = np.where(arm.pinocchio_model.is_slide, 1.0, packed_chain(arm).reach)
        speed_per_joint = lever @ np.abs(arm.joint_map.ratio[: arm.pinocchio_model.chain_length])
        self._max_speed = float(speed_per_joint @ np.where(np.isfinite(arm.limits.v_max), arm.limits.v_max, 0.0))

    def compute_qp_inequalities(self, configuration: mink.Configuration, dt: float) -> mink.Constraint:
        """G (k, nv) and h (k,) with one row for each pair that is close enough to touch within two steps."""
        self._floor[:] = 0.5 * self._clearance
        rows = []
        bounds = []
        for pair, distance, gradient in self._distances(configuration.data, self._clearance + 2 * self._max_speed * dt):
            self._floor[pair] = min(distance, self._floor[pair])
            free = distance - self._clearance
            rows.append(-gradient)
            bounds.append(APPROACH_SHARE * free if free > 0 else max(free, -RECOVERY_SPEED * dt))
        return mink.Constraint(np.array(rows), np.array(bounds)) if rows else mink.Constraint()

    def violations(self, configuration: mink.Configuration, q: Array, dq: Array) -> mink.Constraint:
        """G (k, n) and h (k,) that shorten a step dq (n,) from q whose end is too near something; inactive if none is.

        No pair may come nearer than half the clearance, or nearer at all if it already is. `configuration` is moved to the end
        of the step.
        """
        joint_map = self._arm.joint_map
        configuration.data.qpos[joint_map.qpos_adr] = joint_map.positions(q + dq)
        configuration.update()
        rows = []
        bounds = []
        for pair, distance, gradient in self._distances(configuration.data, 0.5 * self._clearance + 1e-6):
            if distance < self._floor[pair] - DISTANCE_ROUNDING:
                reduced = joint_map.reduced(gradient)
                rows.append(-reduced)
                bounds.append(distance - self._floor[pair] - reduced @ dq)
        return mink.Constraint(np.array(rows), np.array(bounds)) if rows else mink.Constraint()

    def _distances(self, data: mujoco.MjData, far: float) -> Iterator[_Distance]:
        """The pairs nearer than `far`, m."""
        model = self._model
        ends = np.empty(6)
        first = np.empty((3, model.nv))
        second = np.empty((3, model.nv))
        for pair in self._close(data, far):
            one, other = self._pairs[pair].tolist()
            distance = mujoco.mj_geomDistance(model, data, one, other, far, ends)
            span = ends[3:] - ends[:3]
            length = float(np.sqrt(span @ span))
            if distance < far and length > MIN_NORMAL_LENGTH:
                mujoco.mj_jac(model, data, first, None, ends[:3], model.geom_bodyid[one])
                mujoco.mj_jac(model, data, second, None, ends[3:], model.geom_bodyid[other])
                yield _Distance(pair, distance, (np.sign(distance) / length) * (span @ (second - first)))

    def _close(self, data: mujoco.MjData, far: float) -> list[int]:
        """The pairs whose bounding spheres are nearer than `far`; planes and height fields have none."""
        one = self._pairs[:, 0]
        other = self._pairs[:, 1]
        gap = np.linalg.norm(data.geom_xpos[one] - data.geom_xpos[other], axis=1)
        bound = self._model.geom_rbound
        unbounded = (bound[one] == 0) | (bound[other] == 0)
        return np.flatnonzero(unbounded | (gap - bound[one] - bound[other] < far)).tolist()
