"""What armctl adds to mink's quadratic program: the tip's task and the clearance limit. Imports mink: load it late."""

from __future__ import annotations

from collections.abc import Iterator

import mink
import mujoco
import numpy as np
from mink.tasks import BaseTask

from armctl.core.validation import Array
from armctl.ik.collision_pairs import avoidable_pairs
from armctl.ik.problem import POSITION, chain_of, compiled
from armctl.robot.arm import Arm

YIELD = 10.0  # a rotation yields to a position error: at a target out of reach the position comes first
DAMPING, ERROR_DAMPING = 1e-5, 0.05
IDLE = 1e-8  # reaches by which a step must bring the tip nearer to a target out of reach
FLAT, FAR = 1e-3, 0.01  # the posture fades out of directions as curved as this, and at targets as far as that
SEARCH_DAMPING = 2e-2  # of the squared error, where second order is left out
SINGULAR, SINGULAR_DAMPING = 0.05, 1e-3  # below this singular value damping rises, up to that
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
        self._arm, self._posture, self._chain = arm, posture, chain_of(arm)
        self._block = np.ix_(arm.dof_adr, arm.dof_adr)
        self._hessian, self._pull, self._jacobian = np.empty((arm.n, arm.n)), np.empty(arm.n), np.empty((6, arm.n))
        self._scratch = compiled().scratch(arm.pinocchio_model.chain_length, arm.n)
        self._gain: Array | None = None  # (n,) reaches nearer for a joint's step, at a target far off
        self.bounds = (np.full(arm.n, -np.inf), np.full(arm.n, np.inf))  # of the step
        self.settles = True  # at a target out of reach; a search that starts again elsewhere gets there faster without
        self.asked, self.target, self.posture_share = POSITION, np.zeros(12), 0.0

    def is_idle(self, dq: Array) -> bool:
        """Whether a step brings the tip all but nothing nearer to a target that is out of reach.

        Args:
            dq: (n,) rad, the step from where `compute_qp_objective` was called.

        Returns:
            True where to stand still is as good.
        """
        return self._gain is not None and bool(abs(self._gain @ dq) < IDLE)

    def _squared_error(self, q: Array) -> tuple[float, Array, Array, Array]:
        """Half the squared error around q (n,): its root, its Hessian, its negative gradient, and the Jacobian of the error."""
        chain, H, pull, J = self._chain, self._hessian, self._pull, self._jacobian
        args = chain.rows, chain.reach, self.target, self.asked, YIELD, self.settles, chain.units(q), H, pull, J
        size = compiled().objective(*args, self._scratch)
        if self.asked == POSITION:
            J = J[:3]
        if chain.slides:
            H, pull, J = H / np.outer(chain.unit, chain.unit), pull / chain.unit, J / chain.unit
        return size, H, pull, J

    def _null_step(self, wish: Array) -> Array:
        """What of a wished step (n,) leaves the error as it is, within the bounds."""
        unit, step = self._chain.unit, np.empty_like(wish)
        low, high = self.bounds
        compiled().null_step(self.asked, wish / unit, low / unit, high / unit, step, self._scratch)
        return step * unit

    def compute_qp_objective(self, configuration: mink.Configuration) -> mink.Objective:
        """The task's part of the quadratic program.

        Args:
            configuration: Where the model is.

        Returns:
            H (nv, nv) and c (nv,).
        """
        q = configuration.data.qpos[self._arm.qpos_adr]
        size, hessian, pull, J = self._squared_error(q)
        if self.settles:
            curvature, V = np.linalg.eigh(hessian)
            curvature = np.abs(curvature)
            hessian = (V * curvature) @ V.T
            smallest = np.linalg.eigvalsh(J @ J.T if len(J) <= len(q) else J.T @ J)[0]
            damping = (
                DAMPING + min(ERROR_DAMPING * size, SINGULAR_DAMPING) + SINGULAR_DAMPING * max(0.0, 1 - smallest / SINGULAR**2)
            )
            share = self.posture_share * max(0.0, 1 - size / FAR)
            if share > 0 and len(J) < len(q):
                flat = np.maximum(0.0, 1 - curvature / FLAT) ** 2
                pull = pull + damping * (V * flat) @ (self._null_step(share * (self._posture - q)) @ V)
        else:
            damping = SEARCH_DAMPING * min(1.0, size**2)
        self._gain = pull / size if size > FAR else None
        H, c = np.zeros((configuration.nv, configuration.nv)), np.zeros(configuration.nv)
        H[self._block], c[self._arm.dof_adr] = hessian, -pull
        H[self._arm.dof_adr, self._arm.dof_adr] += damping
        return mink.Objective(H, c)


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
        lever = np.where(arm.pinocchio_model.is_slide, 1.0, chain_of(arm).reach) @ np.abs(
            arm.joint_map.ratio[: arm.pinocchio_model.chain_length]
        )
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
        joint_map = self._arm.joint_map
        configuration.data.qpos[joint_map.qpos_adr] = joint_map.positions(q + dq)
        configuration.update()
        rows, bounds = [], []
        for pair, distance, gradient in self._distances(configuration.data, 0.5 * self._clearance + 1e-6):
            if distance < self._floor[pair] - 1e-9:
                gradient = joint_map.reduced(gradient)
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
