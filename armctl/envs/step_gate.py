"""StepGate: what a policy asks for in a step passes only if the way of the joints until they rest is proved clear."""

from __future__ import annotations

import numpy as np

from armctl import _core
from armctl.core.errors import InputError
from armctl.core.shapes import Ball
from armctl.core.validation import Array
from armctl.envs.batch_simulation import BatchSimulation
from armctl.envs.tasks.task import Task
from armctl.model.collision.checker import CollisionChecker
from armctl.model.collision.checkers import collision_checker
from armctl.model.collision.world import World
from armctl.plan.motion.trajectory.piecewise import Pieces, standing
from armctl.plan.stream.committed_motion import LIVE_CLEARANCE_M
from armctl.plan.stream.refusal import contact_refusal, quick_refusal

_MOVING = (_core.ActionMode.joint_delta, _core.ActionMode.joint_target, _core.ActionMode.cartesian_delta)
_SHARES = (0.5, 0.25)  # of the way to a target that is refused, tried one after the other
_LONGEST_S = 10.0  # in which a reference comes to rest, or is refused
_TICKS_AT_ONCE = 10  # until the next look at whether the reference rests
_AT_REST = 1e-5  # rad, rad/s (m, m/s): what is left of the way to the target, which a reference approaches for ever


class StepGate:
    """Between a policy and the joint targets of a batch.

    The targets move as actions say, and a reference approaches them. An action passes as it is if the whole way of the
    reference to its rest at the new targets is proved; else the targets move a part of the way, or stay: the way to rest at the
    targets before is proved already.
    """

    def __init__(self, task: Task, rows: BatchSimulation):
        """A gate in front of a batch.

        InputError if the actions move no joint targets, or the task is to touch something; ModelError if a link has no shape.
        """
        mode = rows.mode
        if mode.kind not in _MOVING or mode.is_smooth:
            raise InputError("gate: the actions must be joint_delta, joint_target or cartesian_delta, whose ways can be proved")
        if task.object:
            raise InputError(f"gate: {task.name} is to touch something; only Reach, ReachPast and Track have a gate")
        self.refusals = [""] * rows.count  # why the last action of each episode did not pass as it was; empty if it did
        self._task = task
        self._rows = rows
        self._is_absolute = mode.kind == _core.ActionMode.joint_target
        self._trace = rows.tick_by_tick()
        self._checkers: list[CollisionChecker] = [self._checker(None)] * rows.count

    def reset(self, row: int, obstacle: Array | None) -> None:
        """Starts an episode with an obstacle (3,) m."""
        self.refusals[row] = ""
        self._checkers[row] = self._checker(obstacle)

    def admit(self) -> None:
        """Changes the actions of the next step, and the targets, where they would not be proved."""
        for row in range(self._rows.count):
            self.refusals[row] = self._admit(row)

    def _admit(self, row: int) -> str:
        rows = self._rows
        before = rows.target[row].copy()
        wanted = rows.target_after(row)
        way = self._way(row, wanted)
        if not self._is_refused(row, way):
            return ""
        reason = self._reason(row, way)
        target = before
        for share in _SHARES:
            nearer = before + share * (wanted - before)
            if not self._is_refused(row, self._way(row, nearer)):
                target = nearer
                break
        low = rows.limits[0]
        rows.target[row] = target
        rows.action[row] = 2.0 * (target - low) / (rows.limits[1] - low) - 1.0 if self._is_absolute else 0.0
        return reason

    def _way(self, row: int, target: Array) -> Pieces | None:
        """The way of the reference, tick by tick, until it rests at a target (n,); None if it does not."""
        dt = self._task.arm.dt
        q, v = self._rows.reference(row)
        way = [q.copy()]
        goal = target.copy()
        nothing = np.zeros(len(q))
        while max(np.abs(goal - q).max(), np.abs(v).max()) > _AT_REST:
            if len(way) * dt > _LONGEST_S:
                return None
            for _ in range(_TICKS_AT_ONCE):
                self._trace.rehearse(nothing, goal, q, v)
                way.append(q.copy())
        if len(way) == 1:
            return standing(q)
        samples = np.array(way)
        coefficients = np.zeros((len(way) - 1, 6, len(q)))
        coefficients[:, 0] = samples[:-1]
        coefficients[:, 1] = np.diff(samples, axis=0) / dt
        return Pieces(dt * np.arange(len(way), dtype=np.float64), coefficients)

    def _is_refused(self, row: int, way: Pieces | None) -> bool:
        return way is None or quick_refusal(self._checkers[row], way, self._clearance(row, way)) is not None

    def _reason(self, row: int, way: Pieces | None) -> str:
        """Why a way that is refused is."""
        if way is None:
            return f"the arm would not come to rest within {_LONGEST_S:g} s"
        refused = contact_refusal(self._checkers[row], way, self._clearance(row, way))
        return "" if refused is None else refused.reason

    def _clearance(self, row: int, way: Pieces) -> float:
        """m, that a way keeps: one that begins nearer to something keeps half of the distance there."""
        _, distance = self._checkers[row].nearest(way.coefficients[0, 0])
        return LIVE_CLEARANCE_M if distance > LIVE_CLEARANCE_M else 0.5 * max(distance, 0.0)

    def _checker(self, obstacle: Array | None) -> CollisionChecker:
        arm = self._task.arm
        world = None
        if obstacle is not None:
            geom = arm.model.body_geomadr[arm.model.body(self._task.obstacle).id]
            world = World().add(f"{self._task.obstacle} ball", Ball(float(arm.model.geom_size[geom, 0])), obstacle)
        checker = collision_checker(arm, world=world)
        checker.require_provable()
        return checker
