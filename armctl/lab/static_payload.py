"""The payload that an arm's torque limits hold, beside the one that its maker rates it for."""

import numpy as np

from armctl.core.validation import Array
from armctl.model.arm.arm import Arm
from armctl.model.loading.catalog import datasheet_of

_POSES = 300  # random configurations in which the torque limits are compared with gravity
_WORST_PERCENT = 5.0  # of the configurations, which do not count: stretched out, most arms hold less than they are rated for
# A maker rates an arm for motion, so its motors hold more than the rated payload at rest: 1.5 to 2.7 times that of the Panda,
# UR5e, iiwa 14 and Gen3. Torque limits far outside this range are not those of the motors.
_MIN_RATED_SHARE = 0.75
_MAX_RATED_SHARE = 4.0
# Arms hold 0.2 to 1.8 times the mass of their links at rest: torque limits that hold more than this are doubtful.
_MAX_OWN_MASSES = 5.0


def static_payloads(arm: Arm) -> Array:
    """(k,) kg, the greatest point mass at the tip that the torque limits hold, in random configurations; below 0 if none.

    Holding a mass m takes the torques g(q) + m c(q), where c = -J_v^T (gravity vector) is the torque for 1 kg.
    """
    payloads = []
    for q in arm.limits.random(arm.home, _POSES, np.random.default_rng(0)):
        own = arm.gravity(q)
        per_kg = -arm.jacobian(q)[:3].T @ arm.model.opt.gravity
        margin = arm.limits.tau_max - np.sign(per_kg) * own
        with np.errstate(divide="ignore"):
            payloads.append(float(np.min(np.where(per_kg == 0.0, np.inf, margin / np.abs(per_kg)))))
        if np.any(np.abs(own) > arm.limits.tau_max):
            payloads[-1] = -1.0
    return np.array(payloads)


def static_payload(payloads: Array) -> float:
    """kg, of `static_payloads`: what the torque limits hold in all but the worst 5 % of configurations."""
    is_unlimited = np.isinf(np.percentile(payloads, _WORST_PERCENT, method="higher"))  # between inf and inf, numpy gives NaN
    return float(np.percentile(payloads, _WORST_PERCENT, method="lower" if is_unlimited else "linear"))


def doubt_about_torque_limits(arm: Arm, payload: float) -> str:
    """Why the limits cannot be those of the motors: the static payload, kg, beside the rated one or, unrated, the arm's mass.

    The text is empty without doubt, and for a weight that loads no joint.
    """
    row = datasheet_of(arm.name)
    if row is None or row.payload is None or row.rating not in arm.notes:
        own = float(arm.model.body_subtreemass[arm.model.jnt_bodyid[arm.joint_map.joints[0]]])
        if not _MAX_OWN_MASSES * own < payload < np.inf:
            return ""
        source = arm.sources["tau_max"]
        return f"the torque limits ({source}) hold {payload:.3g} kg at the tip of an arm of {own:.3g} kg: they are too strong"
    share = payload / row.payload
    if _MIN_RATED_SHARE <= share <= _MAX_RATED_SHARE:
        return ""
    side = "weak" if share < _MIN_RATED_SHARE else "strong"
    held = f"hold {payload:.3g} kg" if payload > 0 else "do not hold the arm itself"
    return f"the torque limits ({arm.sources['tau_max']}) {held} at the tip, rated for {row.payload:g} kg: they are too {side}"
