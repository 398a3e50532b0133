"""What task-space controllers share: the rows of a twist, and the dynamically consistent inverse of the tip's Jacobian."""

import numpy as np

from armctl._core import SINGULARITY_DAMPING
from armctl.core.validation import Array
from armctl.model.arm.arm import Arm

POSE_SIZE = 6


def task_rows(arm: Arm) -> slice:
    """The rows of a twist that an arm can control: position only, if it has fewer than six joints."""
    return slice(0, POSE_SIZE if arm.n >= POSE_SIZE else 3)


def consistent_inverse(J: Array, M: Array) -> Array:
    """M^-1 J^T (J M^-1 J^T)^-1, (n, k): torques in the null space of its transpose do not accelerate the tip.

    Khatib, "A unified approach for motion and force control of robot manipulators: the operational space formulation" (1987),
    with damping near singular configurations.
    """
    M_inv_Jt = np.linalg.solve(M, J.T)
    mobility = J @ M_inv_Jt
    damping = SINGULARITY_DAMPING**2 * np.trace(mobility)
    return M_inv_Jt @ np.linalg.inv(mobility + damping * np.eye(len(J)))


def arm_length(arm: Arm) -> float:
    """The sum of the distances from joint to joint, and from the last one to the tip, m."""
    model = arm.pinocchio_model
    links = [placement.translation for placement in list(model.pin_model.jointPlacements)[2:]]
    return float(sum(np.linalg.norm(link) for link in [*links, model.T_last_tip[:3, 3]]))
