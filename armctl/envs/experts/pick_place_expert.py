"""PickPlaceExpert: picks the object as `Simulation.pick`, and carries it to the goal."""

from collections.abc import Callable

import mujoco
import numpy as np

from armctl.core.validation import Array
from armctl.envs.batch import Batch
from armctl.envs.experts.expert import CartesianExpert, Command, next_time
from armctl.envs.tasks.pick_place import PickPlace
from armctl.model.mjmodel.queries import placed
from armctl.plan.grasp.attempts import Ways
from armctl.plan.grasp.handled_bodies import find_body
from armctl.plan.grasp.handling_scene import HandlingScene
from armctl.plan.grasp.plan_pick import plan_pick
from armctl.plan.ik.solve import solve_ik
from armctl.plan.motion.move_j import move_j
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory

_CARRYING_SPEED = 0.25  # reaches per second
_CLOSE = 0.004  # m
_STILL = 2e-3  # change of the opening in a step, below which the gripper has closed
_MIN_CLOSING_TIME = 0.3  # s
_LOST = 0.5  # heights of the object, between it and where the gripper holds it
_UP = np.array([0.0, 0.0, 1.0])


class PickPlaceExpert(CartesianExpert):
    """Follows the motions that `plan_pick` plans, closes the gripper between them, and carries the object to the goal."""

    def __init__(self, batch: Batch, row: int):
        super().__init__(batch, row)
        task = batch.task
        assert isinstance(task, PickPlace)
        self.table = task.table
        self._task = task
        # m, both on lines: no farther than the tool moves above the table
        self._ways = Ways(approach=task.table.lift - task.table.low, lift=task.height, speed=1.0)
        self._phase = self._raise
        self._opening = 1.0
        self._motions: list[JointTrajectory] = []
        self._time = 0.0
        self._closing_steps = 0
        self._last_opening = 1.0
        self._held_at = np.zeros(3)  # (3,) m, the object in the gripper when it was lifted, from the end of the tool

    def begin(self) -> None:
        super().begin()
        self._opening = 1.0
        self._pick()

    def next(self) -> Command:
        return Command(self._phase(), self._opening)

    def _pick(self) -> None:
        """Plans how to pick the object; without a plan the arm stays, and the episode fails."""
        data = placed(self.arm.model, self.batch.rows.simulated.data(self.row).qpos)
        mujoco.mj_comPos(self.arm.model, data)
        model = self._task.gripper
        body = find_body(self.arm, data, None, self._task.object, self.arm.fk(self._q))
        scene = HandlingScene(arm=self._task.handling_arm, gripper=model, body=body, qpos=np.array(data.qpos), snapshot=None)
        plan = plan_pick(scene, self._task.grip_frames, self._q, self._ways, _UP)
        if isinstance(plan, str):
            self._phase = self._stay
            return
        self._motions = [plan.to_body.motion, plan.approach.motion, plan.lift.motion]
        # Controls from closed to open, at which the widths are those of the model
        self._opening = float(np.interp(plan.opening, model.width, np.linspace(0.0, 1.0, len(model.width))))
        self._follow(self._approach)

    def _follow(self, phase: Callable[[], Array]) -> None:
        self._phase = phase
        self._time = 0.0

    def _stay(self) -> Array:
        return self._q

    def _raise(self) -> Array:
        """Moves up with an open gripper, from where the object was lost."""
        self._opening = 1.0
        place = self.above_table(self.position, self.table.lift)
        if self.is_at(place, _CLOSE):
            self._pick()
        return self.go(place)

    def _approach(self) -> Array:
        if self._followed():
            self._motions.pop(0)
            self._time = 0.0
            if len(self._motions) == 1:
                self._phase = self._close
                self._closing_steps = 0
                self._last_opening = self._opening
        return self._q

    def _close(self) -> Array:
        self._opening = 0.0
        self._closing_steps += 1
        now = float(self.batch.rows.opening[self.row])
        is_still = abs(now - self._last_opening) < _STILL
        self._last_opening = now
        if is_still and self._closing_steps * self.batch.step_time > _MIN_CLOSING_TIME:
            self._follow(self._lift)
        return self._q

    def _lift(self) -> Array:
        if self._followed():
            upright = solve_ik(self.arm, self.table.pose(self.end), self._q, free_axis=self.table.tool.axis)
            self._motions = [move_j(self.arm, self._q, upright.q if upright.ok else self._q)]
            self._follow(self._turn)
        return self._q

    def _turn(self) -> Array:
        """Tilts the tool as it is tilted everywhere above the table."""
        if self._followed():
            self.start_here()
            self._held_at = self.object - self.end
            self._phase = self._carry
        return self._q

    def _carry(self) -> Array:
        held_at = self.object - self.end
        if np.linalg.norm(held_at - self._held_at) > _LOST * self._task.height:
            self._phase = self._raise
        return self.go(self.goal - held_at, _CARRYING_SPEED)

    def _followed(self) -> bool:
        """Goes on along the first motion; whether the tip is at its end."""
        motion = self._motions[0]
        self._time = next_time(self.batch, motion, self._max_turns, self._time, self.batch.rows.target[self.row])
        self._q = np.array(motion(self._time).q)
        away = self.arm.fk(motion(motion.duration).q).position - self.batch.rows.tip[self.row, :3]
        return self._time >= motion.duration and float(np.linalg.norm(away)) < _CLOSE
