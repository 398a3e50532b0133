"""RobotMirror: a model whose joints are where a robot measures them."""

import copy
from collections import deque

import mujoco
import numpy as np

from armctl.control.interface import State
from armctl.core.pose import Pose
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm, TipFrame

_REST_WINDOW_S = 0.05  # over which rest is judged: a measured speed is noise
_MIN_REST_WINDOW_S = 0.02


class RobotMirror:
    """A copy of an arm's model and its data; the joints are as measured, what is carried with them, and all else as at home."""

    def __init__(self, arm: Arm, rest_speed: float, t: float, q: Array, v: Array):
        """A mirror with a first reading, at t s of the robot's clock; joints slower than `rest_speed` rad/s are at rest."""
        self.model = copy.copy(arm.model)
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:] = arm.home_qpos
        self.t0 = t  # s of the robot's clock, the first reading
        self._joint_map = arm.actuation.joint_map
        self._rest_speed = rest_speed
        self._past: deque[tuple[float, Array]] = deque()
        self._v = v
        self._carried: tuple[int, TipFrame, Pose] | None = None  # a free body of the model, and where a tip has it
        self.show(t, q, v)

    def show(self, t: float, q: Array, v: Array) -> None:
        """Takes a reading: t s of the robot's clock, q and v, (n,)."""
        self._v = v
        self._past.append((t, q))
        while len(self._past) > 2 and t - self._past[1][0] > _REST_WINDOW_S:
            self._past.popleft()
        self._joint_map.set_positions(self.data.qpos, q)
        self._joint_map.set_speeds(self.data.qvel, np.nan_to_num(v), q)
        self.data.time = t - self.t0
        mujoco.mj_kinematics(self.model, self.data)
        if self._carried is not None:
            body, frame, T_tip_body = self._carried
            T_world_frame = Pose(self.data.xpos[frame.body], self.data.xquat[frame.body])
            self.place(body, T_world_frame @ frame.T_body_tip @ T_tip_body)

    def carry(self, body: int, frame: TipFrame, T_tip_body: Pose) -> None:
        """Lets a free body of the model move with a tip from now on."""
        self._carried = (body, frame, T_tip_body)

    def put_down(self, body: int, pose: Pose) -> None:
        """Lets a body stand at T_world_body."""
        self._carried = None
        self.place(body, pose)

    def place(self, body: int, pose: Pose) -> None:
        """Moves a free body of the model to T_world_body."""
        first = int(self.model.jnt_qposadr[self.model.body_jntadr[body]])
        self.data.qpos[first : first + 7] = [*pose.position, *pose.quat]
        mujoco.mj_kinematics(self.model, self.data)

    def state(self, dt: float) -> State:
        """The last reading, of a robot with a tick of dt s."""
        return State(self._past[-1][1], self._v, float(self.data.time), dt, True)

    def is_still(self) -> bool:
        """Whether the positions of the joints have not changed for a moment."""
        t, q = self._past[-1]
        window = t - self._past[0][0]
        if window < _MIN_REST_WINDOW_S:
            return False
        return bool(np.abs(q - self._past[0][1]).max() < self._rest_speed * window)
