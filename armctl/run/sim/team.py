"""Team: several arms of one model in one simulation, each with its own target, controller and result."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from armctl.control.computed_torque import ComputedTorque
from armctl.control.interface import Controller
from armctl.core.errors import InputError, ModelError, PlanError, UnknownNameError
from armctl.core.log import Log
from armctl.core.pose import Pose
from armctl.core.result import MoveResult
from armctl.core.target import Target, TargetLike
from armctl.core.trajectory import Trajectory
from armctl.core.validation import flag, number, shown
from armctl.model.arm.arm import Arm
from armctl.model.collision.checkers import collision_checker, read_pairs
from armctl.model.mjmodel.queries import has_obstacles
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.planner.move_free import configurations_for
from armctl.plan.planner.team_planner import ArmGroup, plan_together
from armctl.run.execution.move import PlannedMove, plan_to, read_controller
from armctl.run.execution.obstacles import touched_by
from armctl.run.sim.plant import Plant, read_plant
from armctl.run.sim.simulated_arms import SimulatedArms
from armctl.run.sim.stepper import Stepper

if TYPE_CHECKING:
    from armctl.run.sim.gripper.gripper import Gripper

_Value = TypeVar("_Value")


class Team:
    """Several arms in one simulation. The name of its tip identifies an arm; arms without a command hold their positions.

    After Ctrl-C or a failing controller, `logs` contains all ticks until then, and the next command continues from there.

    Attributes:
        arms: The arms by the names of their tips.
        data: Its MjData, for reading.
    """

    def __init__(
        self, arms: Sequence[Arm], controllers: Mapping[str, Controller | str] | None = None, plant: Plant | None = None
    ):
        """A simulation with all arms at home, at rest.

        Args:
            arms: Arms of one model, from `armctl.load_arms`.
            controllers: A controller or its name by tip; computed torque for tips that are left out.
            plant: How the simulated arms differ from their models; a payload and pushes are not possible.

        Raises:
            InputError: No arms, arms of different models, something that is no controller, or a plant with a payload or pushes.
            UnknownNameError: There is no such tip or controller.
        """
        known = isinstance(arms, Sequence) and all(isinstance(arm, Arm) and arm.model is arms[0].model for arm in arms)
        if not known or not arms:
            raise InputError("arms: expected arms of one model; armctl.load_arms returns them")
        plant = read_plant(plant)
        if plant.payload or plant.pushes:
            raise InputError("plant: a team has no single tip for a payload or pushes; leave them out")
        self.arms = {arm.tip: arm for arm in arms}
        given = self._by_tip("controllers", {} if controllers is None else controllers, "{tip: 'pd'}")
        laws = {
            tip: read_controller(given[tip], arm) if tip in given else ComputedTorque(arm) for tip, arm in self.arms.items()
        }
        self._arms = SimulatedArms(arms, laws, Stepper(arms, plant))
        self.model = self._arms.stepper.model
        self.data = self._arms.stepper.data
        self._grippers: dict[str, Gripper] = {}

    @property
    def controllers(self) -> dict[str, Controller]:
        """The controller of each arm, by tip. Controllers can be replaced between two commands."""
        return self._arms.controllers

    @property
    def logs(self) -> dict[str, Log]:
        """The log of each arm's last run by tip, also if an error or Ctrl-C ended it; empty before the first."""
        return self._arms.logs

    def tip(self, name: str) -> Pose:
        """The pose of a simulated tip now, T_world_tip.

        Raises:
            UnknownNameError: There is no such tip.
        """
        return self._arms.tip_pose(self._known(name))

    def gripper(self, name: str) -> Gripper:
        """The gripper behind a tip.

        Raises:
            UnknownNameError: There is no such tip.
            ModelError: There is no gripper behind it.
        """
        arm = self.arms[self._known(name)]
        if name not in self._grippers:
            from armctl.run.sim.gripper.gripper import Gripper

            self._grippers[name] = Gripper(arm, self._arms.stepper, self._arms.hold)
        return self._grippers[name]

    def reset(self) -> None:
        """Sets time to 0, all arms at home and at rest."""
        for gripper in self._grippers.values():
            gripper.reset()
        self._arms.reset()

    def run(self, trajectories: Mapping[str, Trajectory], dwell: float = 0.0) -> dict[str, Log]:
        """Follows a trajectory for each tip; all start now.

        Args:
            trajectories: The motions by tip.
            dwell: s to hold the ends of the motions.

        Returns:
            A log for each arm, also for those that held their positions.

        Raises:
            UnknownNameError: There is no such tip.
            SimulationError: A controller failed; `error.log` contains the ticks of its arm until then.
        """
        trajectories = self._by_tip("trajectories", trajectories, "{tip: armctl.move_j(arm, arm.home, q)}")
        return self._arms.run(trajectories, number("dwell", dwell, 0.0))

    def move_to(
        self,
        targets: Mapping[str, TargetLike],
        *,
        speed: float = 1.0,
        avoid: bool = True,
        allow: Iterable[tuple[str, str]] = (),
    ) -> dict[str, MoveResult]:
        """Moves each tip to its target, all at the same time.

        With `avoid` the motions are planned together, around all bodies, and proved to touch neither each other
        nor anything else. If there are no such motions, no arm moves, and every `reason` says why.

        Args:
            targets: By tip: T_world_tip, (3,) m if any orientation is accepted, or a Target with tolerances.
            speed: Fraction of the full speed, in (0, 1].
            avoid: Whether to plan around all bodies at their current positions; otherwise each arm moves straight.
            allow: Pairs of names of bodies or geoms that may touch.

        Returns:
            The result of each arm. An arm whose target cannot be reached holds its position, and its `reason` says why.

        Raises:
            UnknownNameError: There is no such tip.
            SimulationError: A controller failed; `error.log` contains the ticks of its arm until then.
        """
        goals = {tip: Target.read(target) for tip, target in self._by_tip("targets", targets, "{tip: [0.4, 0, 0.3]}").items()}
        if flag("avoid", avoid):
            moves = self._planned_together(goals, speed, allow)
        else:
            moves = {tip: self._planned(tip, goal, speed) for tip, goal in goals.items()}
        return self._arms.move(moves)

    def _planned_together(
        self, goals: Mapping[str, Target], speed: float, allow: Iterable[tuple[str, str]]
    ) -> dict[str, PlannedMove]:
        """Moves of all arms that are proved together; refusals of all if there are none."""
        if self._arms.drive.blocked or not goals:
            return {tip: self._planned(tip, goal, speed) for tip, goal in goals.items()}
        group = ArmGroup.from_arms(list(self.arms.values()), speed)
        if group.unchecked_links and not has_obstacles(self.model, group.joint_map.joints):
            return {tip: self._planned(tip, goal, speed) for tip, goal in goals.items()}
        held = {tip: gripper.held for tip, gripper in self._grippers.items() if gripper.held}
        carried = {self.model.body(body).id: self.arms[tip].tip_body for tip, body in held.items()}
        kept = [pair for body in held.values() for pair in touched_by(self.model, self.data, body)]
        checker = collision_checker(group, np.array(self.data.qpos), [*read_pairs(allow), *kept], carried)
        starts = {tip: self._arms.start(tip) for tip in self.arms}
        found = {
            # Whether a configuration is free depends on the other arms: `plan_together` checks their combinations.
            tip: configurations_for(self.arms[tip], starts[tip], goal, np.random.default_rng(0), lambda q: True)
            for tip, goal in goals.items()
        }
        solutions = {tip: configurations for tip, (configurations, _) in found.items() if configurations}
        refusals = {tip: reason for tip, (_, reason) in found.items()}
        motions: dict[str, JointTrajectory] = {}
        try:
            checker.require_provable()
            motions = plan_together(checker, self.arms, starts, solutions, speed)
        except (PlanError, ModelError) as error:
            refusals |= {tip: str(error) for tip in solutions}
        return {tip: PlannedMove(goal, motions.get(tip), refusals[tip]) for tip, goal in goals.items()}

    def _planned(self, tip: str, goal: Target, speed: float) -> PlannedMove:
        return self._arms.planned(goal, lambda: plan_to(self.arms[tip], goal, self._arms.start(tip), speed))

    def _by_tip(self, what: str, given: Mapping[str, _Value], example: str) -> Mapping[str, _Value]:
        if not isinstance(given, Mapping):
            raise InputError(f"{what}: {shown(given)} is not a mapping by tip such as {example}")
        for tip in given:
            self._known(tip)
        return given

    def _known(self, tip: object) -> str:
        if not isinstance(tip, str) or tip not in self.arms:
            raise UnknownNameError.from_known("tip", tip, self.arms)  # type: ignore[arg-type]
        return tip
