"""What controllers in task space share: the tip's error, and the dynamically consistent inverse of its Jacobian."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from armctl.core.validation import Array
from armctl.robot.arm import Arm

_DAMPING = 1e-3  # of the greatest mobility of the tip: less than that counts as singular


def tip_error(arm: Arm, q: Array, q_ref: Array) -> tuple[Array, Array, Array]:
    """Where the tip should be, as seen from where it is.

    Args:
        arm: The arm.
        q: (n,) rad, where it is.
        q_ref: (n,) rad, where it should be.

    Returns:
        (6,) m and rad (a rotation vector in world axes), and the Jacobians (6, n) at q_ref and at q.
    """
    body = arm.pinocchio_model
    J_ref = body.jacobian(q_ref)
    position, rotation = (np.array(x) for x in body.tip(q_ref))
    J = body.jacobian(q)
    here, R = body.tip(q)
    return np.concatenate([position - here, pin.log3(rotation @ R.T)]), J_ref, J


def consistent_inverse(J: Array, M: Array) -> Array:
    """M^-1 J^T (J M^-1 J^T)^-1: forces in the null space of its transpose do not move the tip.

    Khatib, "A unified approach for motion and force control of robot manipulators: the operational space formulation" (1987),
    with damping where the tip can hardly move.

    Args:
        J: (6, n).
        M: (n, n) kg m^2.

    Returns:
        (n, 6).
    """
    M_inv_Jt = np.linalg.solve(M, J.T)
    mobility = J @ M_inv_Jt
    damping = _DAMPING**2 * np.trace(mobility)
    return M_inv_Jt @ np.linalg.inv(mobility + damping * np.eye(6))
