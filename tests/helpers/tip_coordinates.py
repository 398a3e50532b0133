"""Where a tip is in the frame of a region, by MuJoCo's kinematics and SciPy's angles."""

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

import armctl


class TipJudge:
    """Places a tip by MuJoCo alone; how it sits on its body is measured once, at home.

    Args:
        arm: The arm.
    """

    def __init__(self, arm: armctl.Arm):
        self._arm = arm
        self._data = mujoco.MjData(arm.model)
        self._on_body = np.eye(4)
        self._on_body = np.linalg.inv(self.pose(arm.home)) @ _matrix(arm.fk(arm.home))

    def pose(self, q: np.ndarray) -> np.ndarray:
        """T_world_tip at q (n,), (4, 4)."""
        self._data.qpos[:] = self._arm.qpos(q)
        mujoco.mj_kinematics(self._arm.model, self._data)
        place = np.eye(4)
        place[:3, :3] = self._data.xmat[self._arm.tip_body].reshape(3, 3)
        place[:3, 3] = self._data.xpos[self._arm.tip_body]
        return place @ self._on_body

    def coordinates(self, frame: armctl.Pose, tip: armctl.Pose, q: np.ndarray) -> np.ndarray:
        """(N, 6) x, y, z, roll, pitch, yaw of the displacements from a frame at configurations (N, n), `tip` without one."""
        inverse_frame = np.linalg.inv(_matrix(frame))
        inverse_tip = np.linalg.inv(_matrix(tip))
        found = np.array([inverse_frame @ self.pose(each) @ inverse_tip for each in q])
        return np.hstack([found[:, :3, 3], Rotation.from_matrix(found[:, :3, :3]).as_euler("xyz")])


def _matrix(pose: armctl.Pose) -> np.ndarray:
    place = np.eye(4)
    place[:3, :3] = pose.rotation
    place[:3, 3] = pose.position
    return place
