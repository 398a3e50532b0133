"""The tasks and limits that armctl adds to mink's quadratic program. This imports mink: load it late."""

from __future__ import annotations

from typing import NamedTuple

import mink
import numpy as np
from mink.tasks import BaseTask

from armctl._core import Constraint, IkErrorModel
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.model.collision.checkers import collision_checker
from armctl.plan.ik.problem import ik_chain

# The weight of the rotation is divided by 1 + this times the position error in reaches, as far as the target is out of reach:
# there the position comes first.
POSITION_PRIORITY = 10.0
REACHING_DAMPING = 3e-4  # squared, of the step that tells whether a target is in reach
MIN_ROOM = 0.01  # share of a joint's longest move: one with less is at its bound
MIN_DAMPING = 1e-5
ERROR_DAMPING = 0.05  # per reach of error
SINGULAR_VALUE = 0.05  # below it damping rises ...
SINGULAR_DAMPING = 1e-3  # ... up to this
MIN_GAIN_REACHES = 1e-8  # a step that gains less at a target out of reach is not made
FLAT_CURVATURE = 1e-3  # the posture acts only in directions less curved than this ...
FAR_ERROR_REACHES = 0.01  # ... and at targets nearer than this
NULL_DAMPING = 1e-10
MIN_NULL_SHARE = 0.01  # a shorter part of the desired step frees no joint from its bound
MIN_STEP = 1e-300  # of a joint, as a divisor
APPROACH_SHARE = 0.5  # of the free distance that may be used up in one step
RECOVERY_SPEED = 0.1  # m/s, with which bodies that are too near are moved apart
DISTANCE_ROUNDING = 1e-9  # m
MAX_MOVE = 10.0  # rad (m), of a joint in one step
CLEARANCE_SAMPLES = 16  # configurations in which it is looked how far apart pairs can be


class _ErrorModel(NamedTuple):
    """A convex quadratic model of half the squared error, in the units of the joints."""

    size: float  # root of the squared error, reaches
    descent: Array  # (n,) its negative gradient
    jacobian: Array  # (k, n) of the error
    curvature: Array  # (n,) eigenvalues of its Hessian
    V: Array  # (n, n) eigenvectors
    damping: float


class TipTask(BaseTask):
    """Brings the tip to a target and, as far as that leaves freedom, the joints to a posture.

    The objective is the second-order model of half the squared error: J^T J and the curvature of the chain, which grows with
    the error. With it the arm stands still at the nearest reachable point of a target out of reach, where J^T J alone
    overshoots. Negative curvature counts by its absolute value (Dauphin and others: "Identifying and attacking the saddle
    point problem", NeurIPS 2014). Damping rises near singularities, with the smallest singular value (Nakamura, Hanafusa:
    "Inverse kinematic solutions with singularity robustness for robot manipulator control", J. Dyn. Sys., Meas., Control
    108(3), 1986), and it damps towards a step in the null space that leads to the posture, so that neither disturbs the
    other. Lengths are in reaches.

    Where speed limits cut off single joints, the others go on and turn the tip. So a step that is too fast is shortened as a
    whole, as far as the linearized step reaches the target, and is then that of Gauss and Newton without a priority of the
    position, which reduces all components of the error alike.

    On a Panda 5 s after a point 4 m out of reach was set, joints still move at 2.6 rad/s with mink's FrameTask, and at 0 here.
    """

    def __init__(self, arm: Arm, posture: Array):
        """The task of an arm whose joints approach `posture` (n,)."""
        self._arm = arm
        self._posture = posture
        self._chain = ik_chain(arm)
        self._block = np.ix_(arm.dof_adr, arm.dof_adr)
        self._hessian = np.empty((arm.n, arm.n))
        self._gradient = np.empty(arm.n)
        self._jacobian = np.empty((6, arm.n))
        self._squared_error = IkErrorModel(self._chain.core)
        self._gain: Array | None = None  # (n,) reaches gained per unit of a joint's step, at a target far away
        self.low = np.full(arm.n, -np.inf)  # bounds of the step
        self.high = np.full(arm.n, np.inf)
        self.longest = np.full(arm.n, np.inf)  # (n,) what the speed limits permit each joint to move in the step
        self.constraint = Constraint.POSITION
        self.target = np.zeros(12)
        self.posture_share = 0.0  # of the way to the posture in one step

    def is_idle(self, dq: Array) -> bool:
        """Whether the step dq (n,) from the last objective brings the tip no nearer to a target that is out of reach."""
        return self._gain is not None and bool(abs(self._gain @ dq) < MIN_GAIN_REACHES)

    def compute_qp_objective(self, configuration: mink.Configuration) -> mink.Objective:
        """The Hessian H (nv, nv) and gradient c (nv,) of the task's part of the program."""
        q = configuration.data.qpos[self._arm.qpos_adr]
        model = self._modelled(q, 1.0)
        is_partial = model.size > FAR_ERROR_REACHES or self._kept_share(model) < 1
        if is_partial and self.constraint != Constraint.POSITION:
            missed = _missed_share(model, self.low, self.high)
            model = self._modelled(q, missed)
            model = model._replace(descent=(missed + (1 - missed) * self._kept_share(model)) * model.descent)
        unit = self._chain.unit
        descent = model.descent
        share = self.posture_share * max(0.0, 1 - model.size / FAR_ERROR_REACHES)
        if share > 0 and len(model.jacobian) < len(q):
            flatness = np.maximum(0.0, 1 - model.curvature / FLAT_CURVATURE) ** 2
            desired = share * (self._posture - q) / unit
            step = unit * null_step(model.jacobian * unit, desired, self.low / unit, self.high / unit)
            descent = descent + model.damping * (model.V * flatness) @ (step @ model.V)
        self._gain = descent / model.size if model.size > FAR_ERROR_REACHES else None
        H = np.zeros((configuration.nv, configuration.nv))
        c = np.zeros(configuration.nv)
        H[self._block] = (model.V * model.curvature) @ model.V.T
        H[self._arm.dof_adr, self._arm.dof_adr] += model.damping
        c[self._arm.dof_adr] = -descent
        return mink.Objective(H, c)

    def _modelled(self, q: Array, missed: float) -> _ErrorModel:
        """The model of the squared error at q (n,) if a step to the target leaves that share of it."""
        unit = self._chain.unit
        J = self._jacobian if self.constraint != Constraint.POSITION else self._jacobian[:3]
        # The root of the squared error, the Hessian and negative gradient of half of it, and the Jacobian of the error.
        size = self._squared_error.linearize(
            self.target,
            self.constraint,
            missed * POSITION_PRIORITY,
            self._chain.to_units(q),
            self._hessian,
            self._gradient,
            self._jacobian,
        )
        hessian = self._hessian
        if missed < 1:
            linear = J.T @ J
            hessian = linear + missed * (hessian - linear)
        descent = self._gradient.copy()
        if self._chain.has_slides:
            hessian = hessian / np.outer(unit, unit)
            descent /= unit
            J = J / unit
        eigenvalues, V = np.linalg.eigh(hessian)
        smallest = np.linalg.eigvalsh(J @ J.T if len(J) <= len(q) else J.T @ J)[0]
        damping = (
            MIN_DAMPING
            + missed * min(ERROR_DAMPING * size, SINGULAR_DAMPING)
            + SINGULAR_DAMPING * max(0.0, 1 - smallest / SINGULAR_VALUE**2)
        )
        return _ErrorModel(size, descent, J, np.abs(eigenvalues), V, damping)

    def _kept_share(self, model: _ErrorModel) -> float:
        """The share of the model's step that the speed limits permit all joints, at most 1."""
        step = model.V @ ((model.descent @ model.V) / (model.curvature + model.damping))
        return min(1.0, float((self.longest / np.maximum(np.abs(step), MIN_STEP)).min()))


def _missed_share(model: _ErrorModel, low: Array, high: Array) -> float:
    """The share in [0, 1] of the squared error that no linearized step of the joints reduces.

    Joints at their bounds (n,) take no part in a direction that is closed to them. The step is damped, so that the share
    rises steadily near a singularity.
    """
    J = model.jacobian
    free = np.arange(len(model.descent))
    step = np.zeros_like(model.descent)
    least = MIN_ROOM * np.maximum(high, -low)
    while len(free):
        gram = J[:, free].T @ J[:, free]
        gram.flat[:: len(free) + 1] += REACHING_DAMPING
        part = np.linalg.solve(gram, model.descent[free])
        is_open = np.where(part > 0, high[free], -low[free]) >= least[free]
        if is_open.all():
            step[free] = part
            break
        free = free[is_open]
    moved = J @ step
    left = model.size**2 - 2 * model.descent @ step + moved @ moved
    return min(1.0, max(0.0, float(left)) / model.size**2)


def null_step(J: Array, desired: Array, low: Array, high: Array) -> Array:
    """The part of a desired step (n,) in the null space of J (k, n), shortened to its bounds; joints at theirs take no part.

    With the tiny damping only that part of the step is left that changes no error.
    """
    step = np.zeros_like(desired)
    free = np.arange(len(desired))
    while len(free) > len(J):
        gram = J[:, free].T @ J[:, free]
        part = np.linalg.solve(gram + NULL_DAMPING * np.eye(len(free)), NULL_DAMPING * desired[free])
        room = np.maximum(np.where(part > 0, high[free], -low[free]), 0.0)
        shares = room / np.maximum(np.abs(part), MIN_STEP)
        if shares.min() > MIN_NULL_SHARE:
            step[free] = min(1.0, shares.min()) * part
            break
        free = free[shares > MIN_NULL_SHARE]
    return step


class ClearanceLimit(mink.Limit):
    """Keeps pairs of geoms apart: in one step their distance may shrink by at most half of what is free.

    The rule is that of Faverjon and Tournassoud ("A local based approach for path planning of manipulators with a high number
    of degrees of freedom", ICRA 1987). Distances are those of `armctl.model.collision`, with everything outside the arm at
    home.
    """

    def __init__(self, arm: Arm, clearance: float):
        """The limit of an arm that keeps `clearance`, m, where it can; ModelError as for `require_provable`."""
        self._arm = arm
        self._checker = collision_checker(arm)
        self._checker.require_provable()
        self._clearances = self._attainable(clearance)
        self._floor = 0.5 * self._clearances  # m, the least distances that a step may end at
        self._still = np.zeros(arm.n)

    def compute_qp_inequalities(self, configuration: mink.Configuration, dt: float) -> mink.Constraint:
        """G (k, nv) and h (k,) with one row for each pair that a step can bring nearer by more than it may."""
        arm = self._arm
        q = configuration.data.qpos[arm.qpos_adr]
        np.multiply(0.5, self._clearances, out=self._floor)
        near = self._checker.near(q, np.minimum(arm.limits.v_max * dt, MAX_MOVE), APPROACH_SHARE, self._clearances)
        if not len(near.pairs):
            return mink.Constraint()
        self._floor[near.pairs] = np.minimum(near.distances, self._floor[near.pairs])
        free = near.distances - self._clearances[near.pairs]
        G = np.zeros((len(free), configuration.nv))
        G[:, arm.dof_adr] = -near.gradients
        return mink.Constraint(G, np.where(free > 0, APPROACH_SHARE * free, np.maximum(free, -RECOVERY_SPEED * dt)))

    def violations(self, q: Array, dq: Array) -> mink.Constraint:
        """G (k, n) and h (k,) that shorten a step dq (n,) from q whose end is too near something; inactive if none is.

        No pair may come nearer than half its clearance, or nearer at all if it already is.
        """
        near = self._checker.near(q + dq, self._still, 1.0, self._floor - DISTANCE_ROUNDING)
        if not len(near.pairs):
            return mink.Constraint()
        return mink.Constraint(-near.gradients, near.distances - self._floor[near.pairs] - near.gradients @ dq)

    def _attainable(self, clearance: float) -> Array:
        """(K,) m, the clearance of each pair: less for pairs that are never so far apart."""
        arm = self._arm
        checker = self._checker
        farthest = np.full(len(checker.geometry.pairs), -np.inf)
        everywhere = np.full_like(farthest, 2.0 * clearance + DISTANCE_ROUNDING)
        for q in [arm.home, *arm.limits.random(arm.home, CLEARANCE_SAMPLES, np.random.default_rng(0))]:
            near = checker.near(q, np.zeros(arm.n), 1.0, everywhere)
            distances = np.full_like(farthest, 2.0 * clearance)
            distances[near.pairs] = near.distances
            farthest = np.maximum(farthest, distances)
        return np.minimum(clearance, 0.5 * np.maximum(farthest, 0.0))
