"""Commands: the moves of one arm, simulated or real."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Unpack

from numpy.typing import ArrayLike

from armctl.control.interface import State
from armctl.core.errors import InputError
from armctl.core.log import Log
from armctl.core.pose import Pose
from armctl.core.region import Region
from armctl.core.result import MoveResult
from armctl.core.target import Target, TargetLike
from armctl.core.tip_targets import TipTargets
from armctl.core.trajectory import Trajectory
from armctl.core.validation import Array, flag, number
from armctl.model.arm.arm import Arm, check_one_tip
from armctl.model.collision.checker import CollisionChecker
from armctl.model.collision.checkers import KEEP_WITHIN_RAD, read_kept_region
from armctl.model.collision.world import World
from armctl.model.mjmodel.target_marker import TARGET, set_target, target_pose
from armctl.plan.ik.tree_problem import read_tasks
from armctl.plan.motion.checks import read_duration
from armctl.plan.motion.move_back import move_back
from armctl.plan.motion.move_cartesian import (
    Arc,
    Line,
    PathOptions,
    is_tool_path,
    move_c,
    move_l,
    move_path,
    read_path,
)
from armctl.plan.motion.move_j import move_j
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.piecewise import Pieces
from armctl.plan.planner.free_space import FreeSpace
from armctl.plan.stream.gate import Gate, GateScene
from armctl.run.execution.arm_gate import ArmGate
from armctl.run.execution.arm_world import ArmWorld
from armctl.run.execution.move import (
    ControlledArm,
    PlannedMove,
    plan_by_tip,
    plan_free,
    plan_into,
    plan_lasting,
    plan_lines_by_tip,
    plan_move,
    plan_to,
)
from armctl.run.execution.obstacles import Carried, Obstacles
from armctl.run.execution.path_move_options import PathMoveOptions, shows_options

if TYPE_CHECKING:
    from armctl.report.render.video import Film
    from armctl.run.execution.follow import StreamRun


class Commands:
    """One arm in its scene, commanded by Cartesian or joint targets; the base of `Simulation`.

    Every command starts where the last one ended.

    Attributes:
        arm: The model of the arm, whose limits hold for all motions.
        model: The MuJoCo model of the scene.
        data: Its MjData, for reading.
    """

    def __init__(self, controlled: ControlledArm):
        """Commands for an arm on its drive."""
        self._controlled = controlled
        self.arm = controlled.arm
        self.model = controlled.drive.model
        self.data = controlled.drive.data
        self._obstacles = Obstacles(self.arm, self.data)
        self._carried: Carried | None = None

    @property
    def world(self) -> World:
        """What is seen around the arm, besides its scene.

        All moves that avoid contact keep clear of it, in its state when they are planned; the physics of a simulation does not
        contain it.
        """
        if self._obstacles.world is None:
            self._obstacles.world = ArmWorld(self.arm, partial(self._controlled.drive.tip_pose, self.arm))
        return self._obstacles.world

    @property
    def log(self) -> Log | None:
        """The last run, also if an error or Ctrl-C ended it; None before the first.

        After `step` it holds all steps since the last run or reset.
        """
        return self._controlled.log

    @property
    def dt(self) -> float:
        """The tick, s: the plant's step and the control period."""
        return self._controlled.drive.dt

    @property
    def state(self) -> State:
        """The state of the arm now; that of a simulation is the true one."""
        return self._controlled.drive.state

    @property
    def tip(self) -> Pose:
        """The pose of the tip now, T_world_tip; of several tips that of the first one."""
        return self._controlled.drive.tip_pose(self.arm)

    @property
    def tips(self) -> dict[str, Pose]:
        """The poses of all tips now, T_world_tip, by name."""
        return {tip: self._controlled.drive.tip_pose(self.arm, tip) for tip in self.arm.tips}

    @property
    def target(self) -> Array:
        """(3,) m, where the green target is now.

        Raises:
            ModelError: The arm was loaded from a compiled MjModel without a body named "target".
        """
        return target_pose(self.model, self.data).position

    def run(self, trajectory: Trajectory, dwell: float = 0.0) -> Log:
        """Follows a trajectory that starts now. One that ends moving gives a warning, because its reference stops dead.

        Args:
            trajectory: The motion; it starts where the arm is, or where its last reference ended. A trajectory of your own that
                starts elsewhere, such as a step, gives a warning.
            dwell: s to hold its end.

        Returns:
            Every tick of it. A run that diverges ends early, and `log.failure` gives the reason.

        Raises:
            InputError: It is no motion or a motion of other joints, it starts elsewhere, or the dwell time is negative or too
                long for a log.
            SimulationError: The controller failed; `error.log` contains the ticks until then.
        """
        return self._controlled.run(trajectory, number("dwell", dwell, 0.0))

    def move_to(
        self,
        target: TargetLike | Region | TipTargets,
        *,
        speed: float = 1.0,
        avoid: bool = True,
        allow: Iterable[tuple[str, str]] = (),
        keep: str | Region | None = None,
        keep_within: float = KEEP_WITHIN_RAD,
        duration: float | None = None,
    ) -> MoveResult:
        """Moves the tip to a target by inverse kinematics and a jerk-limited motion of the joints.

        Args:
            target: T_world_tip, (3,) m if any orientation is accepted, a Target with tolerances, or a Region, of which `member`
                of the result says where the tip went; or targets by tip, as for `solve_ik`, of which all are reached at the
                same time.
            speed: Fraction of the full speed, in (0, 1].
            avoid: Whether to plan around all bodies at their current positions; otherwise the move is straight. An arm whose
                links lack a collision shape is refused where there is anything around it that it could touch.
            allow: Pairs of names of bodies or geoms that may touch.
            keep: "x", "y" or "z": the axis of the tip that keeps the direction it has now, as for a glass; or a Region of one
                part in which the tip stays on the way, such as a plane or an arc. It needs `avoid`.
            keep_within: rad that this axis may tilt.
            duration: s, how long the motion takes; as short as possible if left out.

        Returns:
            The result. No error is raised if the target cannot be reached: `ok` is False, and `reason` gives the reason.

        Raises:
            InputError: An argument has a wrong length or a number that is not finite or out of its bounds.
            SimulationError: The controller failed; `error.log` contains the ticks until then.
        """
        if isinstance(target, Mapping):
            return self._move_by_tip(target, speed, avoid, allow, keep, read_duration(duration))
        check_one_tip(self.arm)
        region = target if isinstance(target, Region) else None
        goal = Target.read(self.tip if isinstance(target, Region) else target)
        checker = self._checker(avoid, allow)
        kept = read_kept_region(self.arm, keep, keep_within, self._start)
        if kept is not None and checker is None:
            raise InputError("keep: the tip keeps an axis or a region only with avoid=True, which plans the whole motion")
        space = None if checker is None else FreeSpace(checker, keep=kept)
        if region is not None:
            plan = partial(plan_into, self._loaded_arm, region, self._start, speed, space)
        else:
            plan = partial(plan_to, self._loaded_arm, goal, self._start, speed, space)
        return self._move(goal, partial(plan_lasting, self.arm, plan, read_duration(duration)))

    def move_j(
        self,
        q: ArrayLike,
        *,
        speed: float = 1.0,
        avoid: bool = True,
        allow: Iterable[tuple[str, str]] = (),
        duration: float | None = None,
    ) -> MoveResult:
        """Moves the joints to a configuration, on a straight line in joint space.

        Args:
            q: (n,) rad, inside the limits.
            speed: Fraction of the full speed, in (0, 1].
            avoid: Whether to plan around all bodies at their current positions; otherwise the move is straight.
            allow: Pairs of names of bodies or geoms that may touch.
            duration: s, how long the motion takes; as short as possible if left out.

        Returns:
            The result, measured at the tip. A duration that is too short is not started, and `reason` says the shortest.

        Raises:
            LimitError: A position outside the limits.
            SimulationError: The controller failed; `error.log` contains the ticks until then.
        """
        configuration = self.arm.checked("q", q)
        goal = Target.read(self.arm.fk(configuration))
        self.arm.limits.at_speed(speed)
        checker = self._checker(avoid, allow)

        def plan() -> PlannedMove:
            if checker is not None:
                return plan_free(self._loaded_arm, goal, self._start, configuration, speed, FreeSpace(checker))
            return plan_move(self.arm, goal, lambda: move_j(self._loaded_arm, self._start, configuration, speed=speed))

        return self._move(goal, partial(plan_lasting, self.arm, plan, read_duration(duration)))

    @shows_options
    def move_l(self, target: TargetLike | TipTargets, **options: Unpack[PathMoveOptions]) -> MoveResult:
        """Moves the tip to a target on a straight line.

        Args:
            target: T_world_tip, (3,) m if any orientation is accepted, or a Target with tolerances; or targets by tip, of an
                arm with several: each tip moves on a line of its own.
            **options: `speed`, `tip_speed`, `tip_angular_speed`, `duration`, `avoid` and `allow`, as in `PathMoveOptions`.

        Returns:
            The result. A line that leaves the workspace or the limits, or touches something, is not started, and `reason` says
            where.

        Raises:
            SimulationError: The controller failed; `error.log` contains the ticks until then.
        """
        if isinstance(target, Mapping):
            return self._move_tips_along(target, **options)
        check_one_tip(self.arm)
        goal = Target.read(target)
        end = goal.position if goal.pose is None else goal.pose
        return self._move_along(goal, partial(move_l, self._loaded_arm, self._start, end), **options)

    @shows_options
    def move_c(
        self, via: Pose | ArrayLike, target: TargetLike, *, angle: float | None = None, **options: Unpack[PathMoveOptions]
    ) -> MoveResult:
        """Moves the tip on an arc through one point to another.

        Args:
            via: T_world_tip or (3,) m, a point on the arc.
            target: T_world_tip, (3,) m if any orientation is accepted, or a Target with tolerances.
            angle: rad, the angle on the circle; None stops at the target. 2 pi is the full circle.
            **options: `speed`, `tip_speed`, `tip_angular_speed`, `duration`, `avoid` and `allow`, as in `PathMoveOptions`.

        Raises:
            InputError: An argument of a wrong shape or out of its bounds, or the points are on one line.
            SimulationError: The controller failed; `error.log` contains the ticks until then.
        """
        check_one_tip(self.arm)
        goal = Target.read(target)
        end = goal.position if goal.pose is None else goal.pose
        planner = partial(move_c, self._loaded_arm, self._start, via, end, angle=angle)
        return self._move_along(goal, planner, ends_at_target=angle is None, **options)

    @shows_options
    def move_path(
        self,
        path: Sequence[Line | Arc | Pose | ArrayLike] | Region | ArrayLike,
        *,
        normals: ArrayLike | None = None,
        free: str | None = None,
        cone: float = 0.0,
        blend: float = 0.0,
        **options: Unpack[PathMoveOptions],
    ) -> MoveResult:
        """Moves the tip along lines and arcs with rounded corners, or on a tool path, as `armctl.move_path`.

        Args:
            path: Lines and arcs; a pose or a point is a line to it. Of a tool path points, poses or a Region; the tip has to be
                at its first point.
            normals: (N, 3) or (3,), of a tool path, out of the surface: the free axis points against them.
            free: "x", "y" or "z": the axis of the tip about which the tool may turn.
            cone: rad, by which this axis may tilt.
            blend: m, the radius around each corner in which it is rounded; not of a tool path.
            **options: `speed`, `tip_speed`, `tip_angular_speed`, `duration`, `avoid` and `allow`, as in `PathMoveOptions`.

        Raises:
            InputError: An argument of a wrong shape or out of its bounds, or the path is empty.
            SimulationError: The controller failed; `error.log` contains the ticks until then.
        """
        check_one_tip(self.arm)
        if is_tool_path(path, normals, free, cone):
            tool = {"normals": normals, "free": free, "cone": cone}
            planner = partial(move_path, self._loaded_arm, self._start, path, blend=blend, **tool)
            return self._move_along(Target.read(self.tip), planner, ends_at_target=False, **options)
        parts = read_path(path)
        last = parts[-1]
        ends_at_target = not (isinstance(last, Arc) and last.angle is not None)
        planner = partial(move_path, self._loaded_arm, self._start, parts, blend=blend)
        return self._move_along(Target.read(last.target), planner, ends_at_target=ends_at_target, **options)

    def move_back(
        self, log: Log | None = None, *, speed: float = 1.0, avoid: bool = True, allow: Iterable[tuple[str, str]] = ()
    ) -> MoveResult:
        """Moves the joints back along the path of the last run, to where it began.

        Args:
            log: The run; it ended where the arm is. The last one if left out, so that a second call goes forward again.
            speed: Fraction of the speed of that run, in (0, 1].
            avoid: Whether the way back is refused if it touches anything, where everything is now.
            allow: Pairs of names of bodies or geoms that may touch.

        Returns:
            The result, measured at the tip.

        Raises:
            InputError: Nothing has run yet, or the run is one of another arm, has no reference, or ended elsewhere.
            SimulationError: The controller failed; `error.log` contains the ticks until then.
        """
        run = self.log if log is None else log
        if run is None:
            raise InputError("log: nothing has run yet, so there is no way back; move first")
        planner = partial(move_back, self._loaded_arm, run, self._start)
        return self._move_along(Target.read(self.tip), planner, ends_at_target=False, speed=speed, avoid=avoid, allow=allow)

    def gate(self, *, speed: float = 1.0, clearance: float = 0.0) -> Gate:
        """A gate in front of this arm, for what a policy or a program wants: it looks where everything is at each call.

        Args:
            speed: Factor on the limits, in (0, 1].
            clearance: m, that a motion keeps.

        Raises:
            InputError: A number out of its bounds.
            ModelError: A link has no collision shape, or the scene has a height field that the arm could touch.

        Example:
            >>> answer = sim.gate().admit(sim.state.q, q=sim.arm.home)
            >>> sim.run(answer.motion)
        """
        return ArmGate(self.arm, self._scene, speed=speed, clearance=clearance)

    def follow(self, target: str | Callable[[float], Pose | ArrayLike] = TARGET, *, duration: float = 10.0) -> Log:
        """Follows a moving target: reads it 50 times per second, and respects all joint limits.

        If the target is out of reach, the tip moves to the closest point.

        Args:
            target: The name of a body of the model, whose position is followed; or a function of the time since the start, s,
                that returns T_world_tip or (3,) m.
            duration: How long, s, at least a tick.

        Returns:
            Every tick of it. `log.target` is the target at the end, which `Report` compares with the tip.

        Raises:
            InputError: A negative time, or a function that raises, or returns neither a pose nor three finite numbers.
            UnknownNameError: The model has no such body.
            SimulationError: The controller failed; `error.log` contains the ticks until then.
        """
        from armctl.run.execution.follow import follow

        return follow(self._controlled, target, number("duration", duration, self.dt), self._refusal)

    def streaming(self) -> StreamRun:
        """Opens a stream of targets, from a policy or a device, for a `with`.

        Example::

            with sim.streaming() as run:
                run.stream.push(run.stream.t, q)
                run.advance(1 / 30)

        Returns:
            The run: its `stream` takes targets, and its `advance` lets time pass.

        Raises:
            LimitError: The arm is outside its limits.
        """
        from armctl.run.execution.follow import StreamRun

        return StreamRun(self._controlled, self._refusal)

    def _refusal(self, pieces: Pieces) -> str:
        """Why a motion of a stream may not be made; empty if it may."""
        return ""

    def record(
        self, path: str | os.PathLike[str], *, size: tuple[int, int] = (640, 480), quality: str = "fast", speed: float = 1.0
    ) -> Film:
        """Makes a video of the last run: the arm, the target, and the path of the tip.

        Args:
            path: The video, .mp4 or .gif; its folder is made.
            size: Width and height in pixels, even, in [16, 8192].
            quality: "fast", for software rendering, or "full", with shadows and smooth edges.
            speed: Simulated time per film time, in [0.01, 100]: 1 is real time, 0.5 is slow motion.

        Raises:
            InputError: Nothing has run yet, or the path has another file extension.
        """
        if self.log is None:
            raise InputError("log: nothing has run yet, so there is nothing to film; move first")
        from armctl.report.render.video import record  # cameras and encoders are loaded when a video is made

        return record(self.log, self.arm, path, size=size, quality=quality, speed=speed)

    @property
    def _start(self) -> Array:
        return self._controlled.start

    def _move_by_tip(
        self,
        targets: TipTargets,
        speed: float,
        avoid: bool,
        allow: Iterable[tuple[str, str]],
        keep: str | Region | None,
        duration: float | None,
    ) -> MoveResult:
        if keep is not None:
            raise InputError("keep: it is for a single target; give the tips poses")
        read_tasks(self.arm, targets, None)  # wrong targets are an error before anything moves
        checker = self._checker(avoid, allow)
        space = None if checker is None else FreeSpace(checker)
        goal = Target.read(self.tip)
        plan = partial(
            plan_lasting, self.arm, partial(plan_by_tip, self._loaded_arm, targets, self._start, speed, space), duration
        )
        return self._controlled.move(self._controlled.planned(goal, plan))

    def _move(self, goal: Target, plan: Callable[[], PlannedMove]) -> MoveResult:
        set_target(self.model, self.data, goal.position, None if goal.pose is None else goal.pose.quat)
        return self._controlled.move(self._controlled.planned(goal, plan))

    def _move_along(
        self,
        goal: Target,
        planner: Callable[..., JointTrajectory],
        *,
        avoid: bool = True,
        allow: Iterable[tuple[str, str]] = (),
        ends_at_target: bool = True,
        **speeds: Unpack[PathOptions],
    ) -> MoveResult:
        checker = self._checker(avoid, allow)
        planner = partial(planner, **speeds)
        return self._move(goal, partial(plan_move, self.arm, goal, planner, ends_at_target=ends_at_target, checker=checker))

    def _move_tips_along(
        self, targets: TipTargets, *, avoid: bool = True, allow: Iterable[tuple[str, str]] = (), **speeds: Unpack[PathOptions]
    ) -> MoveResult:
        read_tasks(self.arm, targets, None)  # wrong targets are an error before anything moves
        checker = self._checker(avoid, allow)
        arm = self._loaded_arm
        planner = partial(move_l, arm, self._start, targets, **speeds)
        plan = partial(plan_lines_by_tip, arm, targets, self._start, planner, checker)
        return self._controlled.move(self._controlled.planned(Target.read(self.tip), plan))

    def _checker(self, avoid: bool, allow: Iterable[tuple[str, str]]) -> CollisionChecker | None:
        """What a move must not touch, where everything is now; None if it may touch anything."""
        if not flag("avoid", avoid):
            return None
        return self._obstacles.checker(allow, self._held)

    def _scene(self) -> GateScene:
        return GateScene(self._loaded_arm, self._obstacles.checker((), self._held))

    @property
    def _loaded_arm(self) -> Arm:
        """The arm with what it has picked and what the world attaches to its tips, as plans need it."""
        carried = self._carried
        own = self.arm if carried is None or carried.name not in self._held else carried.loaded
        world = self._obstacles.world
        return own if world is None else world.snapshot().loaded_arm(own)

    @property
    def _held(self) -> dict[str, int]:
        """The bodies that move with a tip, and the number of the body of that tip."""
        return {}
