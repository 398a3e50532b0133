"""Gate: what a policy, a person or a program wants becomes a motion that is proved, or a refusal."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.pose import Pose
from armctl.core.region import Region
from armctl.core.target import Target, TargetLike
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, matrix, number, shown, vector
from armctl.model.arm.arm import Arm, check_one_tip
from armctl.model.collision.checker import CollisionChecker
from armctl.model.collision.checkers import checkable
from armctl.model.collision.world_snapshot import WorldLike, read_world
from armctl.plan.ik.differential import DifferentialIk
from armctl.plan.ik.solve import solve_ik
from armctl.plan.motion.checks import planning_arm, start_state
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.limit_check import REST_SPEED
from armctl.plan.motion.trajectory.path_stop import remaining
from armctl.plan.motion.trajectory.piecewise import Pieces, sample, standing
from armctl.plan.stream.admission import Admission, GateAnswer
from armctl.plan.stream.committed_motion import LIVE_CLEARANCE_M
from armctl.plan.stream.refusal import Refusal, contact_refusal
from armctl.plan.stream.stream import MAX_AHEAD_S, MAX_TARGETS
from armctl.plan.stream.twist import twist_targets


class GateScene(NamedTuple):
    """What a gate looks at."""

    arm: Arm  # with what it carries
    checker: CollisionChecker  # of what it must not touch


class Gate:
    """Between what wants an arm to move and its motors: only motions that are proved pass.

    In: a target, a chunk of targets, a velocity of the tip, or a whole motion, with the state from which the arm begins. Out: a
    whole motion that keeps every limit, is proved clear of the world, of the arm itself and of what it carries, and ends at
    rest; or a refusal with the bodies, the time, the distance, and the nearest safe pose. Calls are independent.

    ```python
    gate = armctl.Gate(arm)
    print(gate.admit(setpoint, q=chunk, times=times))
    ```

    A world may change between two calls; `gate.admit(motion, at=t)` says whether the motion that runs may go on in it. It is no
    safety function: it knows the bodies that it is told.

    Attributes:
        arm: The arm, with its limits at the gate's speed.
        clearance: m.
    """

    def __init__(self, arm: Arm, world: WorldLike | None = None, *, speed: float = 1.0, clearance: float = LIVE_CLEARANCE_M):
        """A gate.

        Args:
            arm: The arm, in its scene.
            world: What is around the arm besides its scene, and what it carries: a World, of which each call takes the newest
                state, or a snapshot of one.
            speed: Factor on the limits, in (0, 1].
            clearance: m, that a motion keeps. One that begins nearer to something keeps half of the distance there.

        Raises:
            InputError: An argument of the wrong kind, or an arm without limits on velocity, acceleration or jerk.
            ModelError: A link has no collision shape, or the scene has a height field that the arm could touch.
        """
        self.arm = planning_arm(arm, number("speed", speed, 1e-3, 1.0))
        self.clearance = number("clearance", clearance, 0.0)
        self._world = world
        self._scene()

    @cached_property
    def _ik(self) -> DifferentialIk:
        """Made at its first use, because its imports take long."""
        return DifferentialIk(self.arm)

    def _look(self) -> GateScene:
        """What is around the arm now."""
        world = read_world(self._world)
        return GateScene(self.arm if world is None else world.loaded_arm(self.arm), checkable(self.arm, world))

    def _scene(self) -> GateScene:
        """What is around the arm now, in which motions can be proved."""
        scene = self._look()
        scene.checker.require_provable()
        return scene

    def refusal(self, pieces: Pieces) -> str:
        """Why a motion, given as polynomials from now on, is not proved clear; empty if it is. For `Stream(refusal=...)`."""
        refused = contact_refusal(self._scene().checker, pieces, self.clearance)
        return "" if refused is None else refused.reason

    def admit(
        self,
        state: ArrayLike | Setpoint | JointTrajectory,
        *,
        at: float = 0.0,
        q: ArrayLike | None = None,
        tip: TargetLike | Region | Sequence[TargetLike | Region] | None = None,
        twist: tuple[ArrayLike, ArrayLike] | None = None,
        times: ArrayLike | None = None,
    ) -> GateAnswer:
        """Makes a motion of what is asked for, or says why there is none.

        At most one of q, tip and twist is given; none asks whether the motion that `state` is may be made, or may go on. A
        chunk is followed as by `Stream.push_chunk`. Where that breaks a limit, or is not proved, slower motions through the
        same targets are tried; then the longest beginning of it that is proved is found.

        Args:
            state: Where the arm is when the motion begins: (n,) rad at rest, or a setpoint; or the motion on which it is, which
                ends at rest, as long as nothing better is proved.
            at: s into that motion.
            q: (n,) rad, a target of the joints; or (K, n), a chunk, with times.
            tip: A target of the tip, T_world_tip, (3,) m if any orientation is accepted, or a Region; or a list of K of them,
                with times.
            twist: The velocity of the tip, (3,) m/s and (3,) rad/s in world axes, for 0.2 s.
            times: (K,) s from now, increasing, when the arm is at each target of a chunk.

        Returns:
            The motion that may be sent, and if it is not what was asked for, why not and what is safe instead.

        Raises:
            InputError: Several of q, tip and twist, or none without a motion, a wrong shape or type, a number that is not
                finite, times that do not increase, or a motion of other joints or that does not end at rest.
            LimitError: The state is outside the position limits, or so fast that no stop inside the limits is possible.
        """
        given = {"q": q, "tip": tip, "twist": twist}
        what = [name for name, value in given.items() if value is not None]
        if len(what) > 1:
            raise InputError(f"admit: expected one of q, tip and twist, got {' and '.join(what)}")
        running = _running(self.arm, state, at)
        if running is None and not what:
            raise InputError("admit: nothing is asked for; give one of q, tip and twist, or a motion as the state")
        start = start_state(self.arm, state if running is None else _first(running))  # type: ignore[arg-type]
        admission = Admission(*self._scene(), self.clearance, start, running)
        if admission.blocked is not None:
            return admission.refused(admission.blocked, start.q)
        if twist is not None:
            linear, angular = _twist(twist)
            targets = twist_targets(self.arm, self._ik, start.q, linear, angular)
            return admission.chunk(targets.t, targets.q)
        if tip is not None:
            return self._tip(admission, tip, times)
        if q is not None:
            return self._joints(admission, q, times)
        assert running is not None
        return admission.motion(running)

    def _joints(self, admission: Admission, q: ArrayLike, times: ArrayLike | None) -> GateAnswer:
        values = np.asarray(q)
        if values.ndim < 2 and times is None:
            return admission.targets(None, vector("q", q, self.arm.n)[None])
        targets = matrix("q", q, self.arm.n)
        return admission.targets(_checked_times(times, len(targets), "q"), targets)

    def _tip(
        self, admission: Admission, tip: TargetLike | Region | Sequence[TargetLike | Region], times: ArrayLike | None
    ) -> GateAnswer:
        check_one_tip(self.arm)
        if times is None:
            goals = [_goal(tip)]  # type: ignore[arg-type]
        else:
            if isinstance(tip, (Pose, Region)) or not isinstance(tip, (Sequence, np.ndarray)):
                raise InputError("tip: a chunk with times is a list of targets of the tip")
            goals = [_goal(each) for each in tip]
        seconds = None if times is None else _checked_times(times, len(goals), "tip")
        last = admission.start.q
        found = []
        for k, goal in enumerate(goals):
            solution = solve_ik(self.arm, goal, last)
            last = solution.q
            if not solution.ok:
                which = "" if seconds is None else f"target {k}: "
                return admission.refused(Refusal(f"{which}{solution.reason}"), last)
            found.append(last)
        return admission.targets(seconds, np.array(found))


def _goal(tip: TargetLike | Region) -> Target | Region:
    return tip if isinstance(tip, Region) else Target.read(tip)


def _running(arm: Arm, state: ArrayLike | Setpoint | JointTrajectory, at: float) -> Pieces | None:
    """What is left of a motion of the arm's joints that ends at rest; None if the state is no motion."""
    if not isinstance(state, JointTrajectory):
        if at:
            raise InputError(f"at: {shown(at)}: only of a motion; give a JointTrajectory as the state")
        return None
    if state.joint_names != arm.joint_names:
        raise InputError(
            f"state: the motion moves {', '.join(state.joint_names):.80}, the arm has {', '.join(arm.joint_names):.80}"
        )
    if np.abs(state(state.duration).v).max() > REST_SPEED:
        raise InputError("state: the motion does not end at rest; append a stop")
    time = number("at", at, 0.0, state.duration)
    if time == state.duration:
        return standing(state(time).q)
    return state.pieces if time == 0.0 else remaining(state.pieces, time)


def _first(pieces: Pieces) -> Setpoint:
    """The state at the beginning of a motion."""
    return Setpoint(*(x[0] for x in sample(pieces, np.zeros(1))))


def _checked_times(times: ArrayLike | None, count: int, what: str) -> Array:
    """Times of a chunk, s from now."""
    if times is None:
        raise InputError("times: a chunk needs the time of each target, s from now")
    t = vector("times", times)
    if len(t) != count:
        raise InputError(f"{what}: {count} targets for {len(t)} times; each target needs one")
    if not 1 <= len(t) <= MAX_TARGETS:
        raise InputError(f"times: a chunk has 1 to {MAX_TARGETS} targets, got {len(t)}")
    if t[0] <= 0.0 or (np.diff(t) <= 0).any():
        raise InputError("times: they must be greater than 0 and increase from target to target")
    if t[-1] > MAX_AHEAD_S:
        raise InputError(f"times: {t[-1]:g} s is more than {MAX_AHEAD_S:g} s ahead")
    return t


def _twist(twist: tuple[ArrayLike, ArrayLike]) -> tuple[Array, Array]:
    """A velocity of the tip: m/s and rad/s."""
    if not isinstance(twist, (tuple, list)) or len(twist) != 2:
        raise InputError("twist: expected two parts, (3,) m/s and (3,) rad/s, such as ([0.1, 0, 0], [0, 0, 0])")
    return vector("twist: linear", twist[0], 3), vector("twist: angular", twist[1], 3)
