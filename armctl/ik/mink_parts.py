"""What armctl adds to mink's quadratic program: the tip's task and the clearance limit. Imports mink: load it late."""

from __future__ import annotations

from collections.abc import Iterator

import mink
import mujoco
import numpy as np
import pinocchio as pin
from mink.tasks import BaseTask

from armctl.arm import Arm
from armctl.arrays import Array
from armctl.ik.pairs import avoidable_pairs
from armctl.ik.problem import FREE_X, POSITION, chain_of

ROTATION_WEIGHT = 0.5  # of a radian, beside an error of one reach;
YIELD = 10.0  # it yields to a position error: at a target out of reach the position comes first
DAMPING, ERROR_DAMPING = 1e-5, 0.05
FLAT, FAR = 1e-3, 0.01  # the posture fades out of directions as curved as this, and at targets as far as that
SEARCH_DAMPING = 2e-2  # of the squared error, where second order is left out
SINGULAR, SINGULAR_DAMPING = 0.05, 1e-3  # below this singular value damping rises, up to that
FARTHEST = 100.0  # reaches
NULL_PASSES, NO_ROOM = 4, 0.01
APPROACH = 0.5  # of the free distance may be used up in one step
RECOVERY = 0.1  # m/s, how fast what is too near is moved apart


class TipTask(BaseTask):
    """Brings the tip to a target and, as far as that leaves freedom, the joints to a posture.

    The objective is the second-order model of half the squared error: J^T J and the curvature of the chain, which grows with
    the error. It is what makes the arm stand still at the nearest reach of a target it cannot reach, where J^T J alone
    overshoots. Negative curvature counts by its size (Dauphin and others: "Identifying and attacking the saddle point problem",
    NeurIPS 2014). Damping rises near singularities, with the smallest singular value (Nakamura, Hanafusa: "Inverse kinematic
    solutions with singularity robustness for robot manipulator control", J. Dyn. Sys., Meas., Control 108(3), 1986), and it
    damps towards a step in the null space that leads to the posture, so that neither bends the other. Lengths are in reaches.
    """

    def __init__(self, arm: Arm, posture: Array):
        """The task of an arm.

        Args:
            arm: The arm.
            posture: (n,) rad, where the joints go as far as the tip lets them.
        """
        self._arm, self._posture, self._reach = arm, posture, chain_of(arm).reach
        self._scale = np.repeat([1 / self._reach, 1.0], 3)[:, None]
        self._upper = np.triu(np.ones((arm.n, arm.n), bool))
        self._block = np.ix_(arm.dof_adr, arm.dof_adr)
        self.bounds = (np.full(arm.n, -np.inf), np.full(arm.n, np.inf))  # of the step
        self.settles = True  # at a target out of reach; a search that starts again elsewhere gets there faster without
        self.asked, self.target, self.posture_share = POSITION, np.zeros(12), 0.0

    def _tip(self, configuration: mink.Configuration) -> tuple[Array, Array, Array, Array]:
        """Joint positions, weighted error to the target, weighted Jacobian, and axes of the arm's joints."""
        q, target = configuration.data.qpos[self._arm.qpos_adr], self.target
        J = self._arm.rigid_body.jacobian(q)
        position, R = self._arm.rigid_body.tip(q)
        off = (target[9:] - position) / self._reach
        distance = float(np.sqrt(off @ off))
        off *= min(1.0, FARTHEST / max(distance, 1e-300))
        weight = ROTATION_WEIGHT / (1 + YIELD * min(1.0, distance))
        axes, J = J[3:], J * self._scale
        J[3:] *= weight
        if self.asked == POSITION:
            return q, off, J[:3], axes
        if self.asked < FREE_X:
            turn = pin.log3(target[:9].reshape(3, 3) @ R.T)
        else:
            k = self.asked - FREE_X
            axis, wanted = R[:, k], target[k:9:3]
            cross = np.cross(axis, wanted)
            sin = float(np.sqrt(cross @ cross))
            turn = cross * (np.arctan2(sin, axis @ wanted) / sin) if sin > 1e-9 else np.pi * (axis @ wanted < 0) * R[:, k - 1]
            J[3:] -= np.outer(axis, axis @ J[3:])
        return q, np.concatenate([off, weight * turn]), J, axes

    def compute_qp_objective(self, configuration: mink.Configuration) -> mink.Objective:
        """The task's part of the quadratic program.

        Args:
            configuration: Where the model is.

        Returns:
            H (nv, nv) and c (nv,).
        """
        q, error, J, axes = self._tip(configuration)
        H, c = np.zeros((configuration.nv, configuration.nv)), np.zeros(configuration.nv)
        normal, pull = J.T @ J, error @ J
        if self.settles:
            upper = _second_order(error, J, axes)
            curvature, V = np.linalg.eigh(normal - np.where(self._upper, upper, upper.T))
            curvature = np.abs(curvature)
            normal = (V * curvature) @ V.T
            smallest = np.linalg.eigvalsh(J @ J.T if len(J) <= len(q) else J.T @ J)[0]
            size = float(np.sqrt(error @ error))
            damping = (
                DAMPING + min(ERROR_DAMPING * size, SINGULAR_DAMPING) + SINGULAR_DAMPING * max(0.0, 1 - smallest / SINGULAR**2)
            )
            share = self.posture_share * max(0.0, 1 - size / FAR)
            if share > 0 and len(J) < len(q):
                low, high = self.bounds
                flat = np.maximum(0.0, 1 - curvature / FLAT) ** 2
                step = _null_step(J, share * (self._posture - q), low, high)
                pull = pull + damping * (V * flat) @ (step @ V)
        else:
            damping = SEARCH_DAMPING * min(1.0, float(error @ error))
        normal.flat[:: len(q) + 1] += damping
        H[self._block], c[self._arm.dof_adr] = normal, -pull
        return mink.Objective(H, c)


def _null_step(J: Array, wish: Array, low: Array, high: Array) -> Array:
    """The part of a wished step (n,) in the null space of J, shortened to its bounds; joints at theirs take no part."""
    free = np.ones(len(wish), bool)
    for _ in range(NULL_PASSES):
        part = J[:, free]
        if part.shape[1] <= len(J):
            break
        step = np.zeros_like(wish)
        step[free] = wish[free] - part.T @ np.linalg.solve(part @ part.T + 1e-12 * np.eye(len(J)), part @ wish[free])
        room = np.maximum(0.0, np.where(step > 0, high, -low)) / np.maximum(np.abs(step), 1e-300)
        if room.min() > NO_ROOM:
            return min(1.0, room.min()) * step
        free &= room > NO_ROOM
    return np.zeros_like(wish)


def _second_order(error: Array, J: Array, axes: Array) -> Array:
    """What the chain's own curvature takes off J^T J: error . d^2 tip / dq_i dq_j, (n, n), its upper triangle.

    For joints i <= j of a serial chain d^2 p / dq_i dq_j = z_i x dp/dq_j; a rotation vector bends by half its cross product.
    """
    bend = _cross(error[:3], axes).T @ J[:3]
    return bend if len(error) == 3 else bend + 0.5 * _cross(error[3:], axes).T @ J[3:]


def _cross(vector: Array, columns: Array) -> Array:
    """vector x each column."""
    x, y, z = vector.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ columns


class Clearance(mink.Limit):
    """Keeps pairs of geoms apart: in one step their distance may shrink by half of what is free at most.

    The rule is Faverjon's and Tournassoud's ("A local based approach for path planning of manipulators with a high number of
    degrees of freedom", ICRA 1987).
    """

    def __init__(self, arm: Arm, clearance: float):
        """The limit of an arm.

        Args:
            arm: The arm; its model decides which pairs can be avoided.
            clearance: m, the distance to keep.
        """
        self._arm, self._model, self._clearance = arm, arm.model, clearance
        self._pairs = avoidable_pairs(arm, clearance)
        self._floor = np.full(len(self._pairs), 0.5 * clearance)
        lever = np.where(arm.rigid_body.is_slide, 1.0, chain_of(arm).reach)
        self._speed = float(lever @ np.where(np.isfinite(arm.limits.v_max), arm.limits.v_max, 0.0))

    def compute_qp_inequalities(self, configuration: mink.Configuration, dt: float) -> mink.Constraint:
        """One row for each pair that is close enough to touch within two steps.

        Args:
            configuration: Where the model is.
            dt: The step, s.

        Returns:
            G (k, nv) and h (k,) of G dq <= h.
        """
        self._floor[:] = 0.5 * self._clearance
        rows, bounds = [], []
        for pair, distance, gradient in self._distances(configuration.data, self._clearance + 2 * self._speed * dt):
            self._floor[pair] = min(distance, self._floor[pair])
            free = distance - self._clearance
            rows.append(-gradient)
            bounds.append(APPROACH * free if free > 0 else max(free, -RECOVERY * dt))
        return mink.Constraint(np.array(rows), np.array(bounds)) if rows else mink.Constraint()

    def cuts(self, configuration: mink.Configuration, q: Array, dq: Array) -> mink.Constraint:
        """What a step must be held to in addition, because elsewhere on two bodies it would bring them too near.

        No pair may come nearer than half the clearance, nor nearer at all if it is.

        Args:
            configuration: mink's; it is moved to the end of the step.
            q: (n,) rad, where `compute_qp_inequalities` was called.
            dq: (n,) rad, the step.

        Returns:
            G (k, n) and h (k,), none if the step is clear.
        """
        configuration.data.qpos[self._arm.qpos_adr] = q + dq
        configuration.update()
        rows, bounds = [], []
        for pair, distance, gradient in self._distances(configuration.data, 0.5 * self._clearance + 1e-6):
            if distance < self._floor[pair] - 1e-9:
                gradient = gradient[self._arm.dof_adr]
                rows.append(-gradient)
                bounds.append(distance - self._floor[pair] - gradient @ dq)
        return mink.Constraint(np.array(rows), np.array(bounds)) if rows else mink.Constraint()

    def _distances(self, data: mujoco.MjData, far: float) -> Iterator[tuple[int, float, Array]]:
        """The pairs nearer than `far`: their number, distance and its derivative by the model's joints (nv,)."""
        model, ends = self._model, np.empty(6)
        first, second = np.empty((3, model.nv)), np.empty((3, model.nv))
        for pair in self._close(data, far):
            one, other = self._pairs[pair].tolist()
            distance = mujoco.mj_geomDistance(model, data, one, other, far, ends)
            span = ends[3:] - ends[:3]
            length = float(np.sqrt(span @ span))
            if distance < far and length > 1e-9:
                mujoco.mj_jac(model, data, first, None, ends[:3], model.geom_bodyid[one])
                mujoco.mj_jac(model, data, second, None, ends[3:], model.geom_bodyid[other])
                yield pair, distance, (np.sign(distance) / length) * (span @ (second - first))

    def _close(self, data: mujoco.MjData, far: float) -> list[int]:
        """The pairs whose bounding spheres are nearer than `far`; planes and height fields have none."""
        one, other = self._pairs[:, 0], self._pairs[:, 1]
        gap = np.linalg.norm(data.geom_xpos[one] - data.geom_xpos[other], axis=1)
        bound = self._model.geom_rbound
        unbounded = (bound[one] == 0) | (bound[other] == 0)
        return np.flatnonzero(unbounded | (gap - bound[one] - bound[other] < far)).tolist()
