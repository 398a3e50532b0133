"""plan_pick and plan_place: the motions that pick a body, and that put it down, each proved over its whole duration."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from armctl.core.errors import PlanError
from armctl.core.handling import Grasp
from armctl.core.pose import Pose
from armctl.core.validation import Array, IntArray
from armctl.model.arm.arm import Arm
from armctl.model.collision.checker import CollisionChecker
from armctl.model.gripper.grip_frames import GripFrames
from armctl.plan.grasp.attempts import Failures, ProvedMotion, Ways, line, longest_line, moved
from armctl.plan.grasp.candidates import FINGER_GAP_M, candidates
from armctl.plan.grasp.configurations import Configurations, Reached
from armctl.plan.grasp.handling_scene import SUPPORT_GAP_M, HandlingScene
from armctl.plan.ik.solve import solve_ik
from armctl.plan.planner.free_space import FreeSpace
from armctl.plan.planner.move_free import move_free_with

_MAX_POSES = 1000  # that are tried
_RAISED_M = 5e-3  # by which a body is raised to tell what it stands on from what it stands beside
_NARROW_GAP_M = 0.012  # on either side of the body, of a gripper that opens no farther among other things


class PickPlan(NamedTuple):
    """The motions that pick a body."""

    grasp: Grasp
    opening: float  # m, between the pads on the way to the body
    to_body: ProvedMotion  # to where the open gripper stands off
    approach: ProvedMotion  # on a line
    lift: ProvedMotion  # on a line, with the body


class PlacePlan(NamedTuple):
    """The motions that put a body down."""

    pose: Pose  # T_world_body
    opening: float  # m, between the pads afterwards
    to_place: ProvedMotion  # to above the place, with the body
    lower: ProvedMotion  # on a line, with the body
    retreat: ProvedMotion  # on a line, with the open gripper


class HeldAt(NamedTuple):
    """Where a gripper has a body."""

    width: float  # m, between the pads
    T_tip_body: Pose


def plan_pick(scene: HandlingScene, frames: GripFrames, q_start: Array, ways: Ways, up: Array) -> PickPlan | str:
    """The motions that pick a body with the best grasp that the arm can make; a sentence if there is none."""
    tried = candidates(scene.body.parts, scene.body.pose, frames, up, _MAX_POSES)
    configurations = Configurations(scene.arm, tried.tips, tried.costs, q_start)
    refusal = ""
    narrow = float(tried.widths.min()) + 2.0 * _NARROW_GAP_M
    for opening in _openings(frames.width_max, narrow):
        checker = scene.standing(opening)
        checker.require_provable()
        hit = checker.hit(q_start)
        if hit >= 0:
            refusal = refusal or "the arm is in contact before it moves: {1} touches {0}".format(*checker.names(hit))
            continue
        guarded = scene.guarded(checker, np.array([], np.int64), carried=False)
        failures = Failures()
        pick = _PickAttempt(scene, ways, up, checker, guarded, failures)
        for reached in configurations.free(guarded, failures):
            plan = pick.plan(reached, tried.grasp(reached.row, reached.tip), q_start, opening)
            if plan is not None:
                return plan
        refusal = refusal or failures.text("grasps")
    return refusal


def _openings(width_max: float, narrow: float) -> Sequence[float]:
    """The widths, m, to which a gripper is opened: fully, and narrower if there is no room for that."""
    return (width_max,) if narrow >= width_max else (width_max, narrow)


class _PickAttempt(NamedTuple):
    """Tries one grasp."""

    scene: HandlingScene
    ways: Ways
    up: Array
    checker: CollisionChecker  # with the body standing
    guarded: CollisionChecker  # the same, for lines
    failures: Failures

    def plan(self, reached: Reached, grasp: Grasp, q_start: Array, opening: float) -> PickPlan | None:
        """The motions of a grasp at a configuration; None, and a failure more, if one of them cannot be made."""
        scene = self.scene
        arm = scene.arm
        T_tip_body = grasp.tip.inverse() @ scene.body.pose
        too_heavy = scene.too_heavy(reached.q, T_tip_body)
        if too_heavy:
            self.failures.add_line(too_heavy)
            return None
        back = longest_line(
            arm, reached.q, grasp.tip, -self.ways.approach * grasp.pointing, self.ways.speed, self.guarded, self.failures
        )
        if back is None:
            return None
        approach = line(arm, back.end, grasp.tip, self.ways.speed, self.guarded, self.failures)
        if approach is None:
            return None
        obstruction = scene.obstruction(approach.end, grasp.width)
        if obstruction:
            self.failures.add_obstruction(obstruction)
            return None
        carried = scene.carried(approach.end, grasp.width, T_tip_body)
        support = scene.near_body(carried, approach.end, SUPPORT_GAP_M)
        held = scene.guarded(carried, support, carried=True)
        hit = held.hit(approach.end)
        if hit >= 0:
            self.failures.add_contact(held, hit)
            return None
        loaded = scene.loaded_arm(T_tip_body)
        lift = longest_line(loaded, approach.end, grasp.tip, self.ways.lift * self.up, self.ways.speed, held, self.failures)
        if lift is None:
            return None
        to_body = _free_motion(arm, self.checker, q_start, back.end, self.ways.speed, self.failures)
        return None if to_body is None else PickPlan(grasp, opening, to_body, approach, lift)


def _free_motion(
    arm: Arm, checker: CollisionChecker, start: Array, goal: Array, speed: float, failures: Failures
) -> ProvedMotion | None:
    space = FreeSpace(checker)
    try:
        motion = move_free_with(space, arm, start, goal, speed=speed)
    except PlanError as error:
        failures.add_line(str(error))
        return None
    return ProvedMotion(motion, space.least_distance(motion))


def plan_place(
    scene: HandlingScene,
    frames: GripFrames,
    poses: Sequence[Pose],
    q_start: Array,
    held: HeldAt,
    ways: Ways,
    up: Array,
) -> PlacePlan | str:
    """The motions that put a held body down at one of some poses, the first ones preferred; a sentence if there are none."""
    arm = scene.arm
    tips = np.array([(pose @ held.T_tip_body.inverse()).matrix for pose in poses])
    carried = scene.carried(q_start, held.width, held.T_tip_body)
    carried.require_provable()
    support = scene.near_body(carried, q_start, SUPPORT_GAP_M)
    leaving = scene.leaving(carried, support)
    failures = Failures()
    attempt = _PlaceAttempt(scene, frames, ways, up, held, carried, leaving, failures)
    costs = np.linspace(0.0, 1.0, len(poses))
    everything = scene.guarded(carried, scene.pairs_of_body(carried), carried=True)
    for reached in Configurations(arm, tips, costs, q_start).free(everything, failures):
        plan = attempt.plan(reached, poses[reached.row], q_start)
        if plan is not None:
            return plan
    return failures.text("poses")


class _PlaceAttempt(NamedTuple):
    """Tries one pose of the body."""

    scene: HandlingScene
    frames: GripFrames
    ways: Ways
    up: Array
    held_at: HeldAt
    carried: CollisionChecker  # with the body in the gripper
    leaving: CollisionChecker  # the same, and the body may touch what it touches now
    failures: Failures

    def plan(self, reached: Reached, wanted: Pose, q_start: Array) -> PlacePlan | None:
        """The motions that put the body down at a configuration; None, and a failure more, if one cannot be made."""
        scene = self.scene
        arm = scene.loaded_arm(self.held_at.T_tip_body)
        tip = reached.tip
        pose = tip @ self.held_at.T_tip_body
        support = self._support(reached.q, tip)
        if support is None:
            return None
        held = scene.guarded(self.carried, support, carried=True)
        hit = held.hit(reached.q)
        if hit >= 0:
            self.failures.add_contact(held, hit)
            return None
        raised = longest_line(arm, reached.q, tip, self.ways.lift * self.up, self.ways.speed, held, self.failures)
        if raised is None:
            return None
        lower = line(arm, raised.end, tip, self.ways.speed, held, self.failures)
        if lower is None:
            return None
        retreat = self._retreat(pose, tip, lower.end)
        if retreat is None:
            return None
        to_place = _free_motion(arm, self.leaving, q_start, raised.end, self.ways.speed, self.failures)
        if to_place is None:
            return None
        return PlacePlan(wanted, retreat[0], to_place, lower, retreat[1])

    def _support(self, q: Array, tip: Pose) -> IntArray | None:
        """What the body may touch at its place: what it is near to there, and leaves when it is raised a little.

        None if it is deep inside of something, or beside something: that is as near when the body is raised.
        """
        above = solve_ik(self.scene.arm, moved(tip, _RAISED_M * self.up), q)
        if not above.ok:
            self.failures.add_line(above.reason)
            return None
        support = self.scene.near_body(self.carried, q, SUPPORT_GAP_M)
        beside = self.scene.near_body(self.carried, above.q, SUPPORT_GAP_M)
        for pair in support.tolist():
            if pair in beside or self.carried.depth(q, pair) > SUPPORT_GAP_M:
                self.failures.add_contact(self.carried, pair)
                return None
        return support

    def _retreat(self, pose: Pose, tip: Pose, q: Array) -> tuple[float, ProvedMotion] | None:
        """How far the gripper opens, m, and its line away from the body."""
        scene = self.scene
        pointing = tip.rotation @ self.frames.pointing
        for opening in _openings(self.frames.width_max, self.held_at.width + 2.0 * max(_NARROW_GAP_M, FINGER_GAP_M)):
            standing = scene.standing(opening, pose)
            touching = scene.near_body(standing, q, SUPPORT_GAP_M)
            guarded = scene.guarded(standing, touching, carried=False)
            hit = guarded.hit(q)
            if hit >= 0:
                self.failures.add_contact(guarded, hit)
                continue
            away = longest_line(scene.arm, q, tip, -self.ways.approach * pointing, self.ways.speed, guarded, self.failures)
            if away is not None:
                return opening, away
        return None
