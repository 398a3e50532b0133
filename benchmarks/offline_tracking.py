"""The best tracking of a motion with weak motors, planned offline: a judge of controllers, which see less of the future."""

import daqp
import numpy as np

import armctl

JOINT_INTERVAL_S = 0.003  # of a constant acceleration, per joint of the arm; with shorter ones the optimum is a little lower
_STEP = 1e-5  # rad, rad/s and rad/s^2, of central differences
_SOFT = 8  # daqp's flag of a constraint that may be exceeded at a cost
_SPEED_TOLERANCE = 1e-3  # of a limit of velocity at which a motion passes exactly
TORQUE_TOLERANCE = 0.01  # of a torque limit, by which the optimum may exceed it: it is to be below what any controller reaches
_EXCESS_COST = 1.0  # m, per excess of a torque relative to its limit


def offline_error(arm: armctl.Arm, motion: armctl.JointTrajectory, start: armctl.Log, iterations: int = 15) -> float:
    """The RMS error of the tip, m, of accelerations within the limits of torque and velocity of an arm.

    Sequential quadratic programs with a trust region minimize it over the whole motion at once, from the motion of a log. The
    torques are within their limits at both ends of each interval, or exceed them by the tolerance at most. The optimum is a
    local one, and inf if no motion within the limits was found.
    """
    count = max(2, round(motion.duration / (JOINT_INTERVAL_S * arm.n)))
    h = motion.duration / count
    n = arm.n
    ref = motion.sample(np.linspace(0.0, motion.duration, count + 1))
    tip_ref = arm.fk_many(ref.q)[0]
    speed_of = h * np.tril(np.ones((count + 1, count)), -1)
    node, interval = np.indices((count + 1, count))
    position_of = np.where(node > interval, h * h * (node - interval - 0.5), 0.0)

    def evaluate(a: np.ndarray):
        q, v = ref.q[0] + position_of @ a, speed_of @ a
        tip = arm.fk_many(q)[0]
        tau = [[arm.inverse_dynamics(*each) for each in zip(q[end:][:count], v[end:], a, strict=False)] for end in (0, 1)]
        tau = np.array(tau)
        excess = max(np.abs(tau / arm.limits.tau_max).max() - 1.0, 0.0)
        return np.sqrt(np.mean(np.sum((tip - tip_ref) ** 2, axis=1))), excess, q, v, tip - tip_ref, tau

    times = np.linspace(0.0, motion.duration, count + 1)
    v_start = np.column_stack([np.interp(times, start.t, v) for v in start.v.T])
    a = (v_start[1:] - v_start[:-1]) / h
    best = evaluate(a)
    radius = 50.0  # rad/s^2
    for _ in range(iterations):
        _, _, q, v, tip_error, tau = best
        rows = [_torque_rows(arm, q[end:], v[end:], a, position_of[end:], speed_of[end:]) for end in (0, 1)]
        rows.append(np.kron(speed_of[1:], np.eye(n)))
        v_max = (1.0 + _SPEED_TOLERANCE) * arm.limits.v_max
        low = np.concatenate([(-arm.limits.tau_max - tau).ravel(), (-v_max - v[1:]).ravel()])
        high = np.concatenate([(arm.limits.tau_max - tau).ravel(), (v_max - v[1:]).ravel()])
        J = np.array([arm.jacobian(each)[:3] for each in q])
        E = np.einsum("kij,kl->kilj", J, position_of).reshape(-1, count * n)
        H = 1e3 * (E.T @ E) + 1e-6 * np.eye(count * n)
        f = 1e3 * (E.T @ tip_error.ravel())
        sense = np.repeat([0, _SOFT], [count * n, len(low)]).astype(np.int32)
        gain = 0.0
        while gain == 0.0 and radius > 1e-2:
            box = np.full(count * n, radius)
            x = daqp.solve(H, f, np.vstack(rows), np.concatenate([box, high]), np.concatenate([-box, low]), sense)[0]
            found = evaluate(a + x.reshape(count, n))
            gain = max(_merit(best) - _merit(found), 0.0)
            radius *= 2.0 if gain else 0.25
        if gain == 0.0:
            break
        a = a + x.reshape(count, n)
        best = found
        if gain < 1e-3 * best[0]:
            break
    return best[0] if best[1] < TORQUE_TOLERANCE else np.inf


def _merit(found) -> float:
    """The error, m, and a penalty for torques outside of their limits."""
    return found[0] + _EXCESS_COST * found[1]


def _torque_rows(arm, q, v, a, position_of, speed_of) -> np.ndarray:
    """(k n, k n) derivatives of the torques at nodes by the accelerations of the intervals."""
    count, n = a.shape
    result = np.zeros((count, n, count, n))
    for k in range(count):
        for j, step in enumerate(_STEP * np.eye(3 * n)):
            ends = [
                arm.inverse_dynamics(*(x + s * d for x, d in zip((q[k], v[k], a[k]), step.reshape(3, n), strict=True)))
                for s in (1, -1)
            ]
            slope = (ends[0] - ends[1]) / (2 * _STEP)
            if j < 2 * n:
                result[k, :, :, j % n] += np.outer(slope, (position_of, speed_of)[j // n][k])
            else:
                result[k, :, k, j - 2 * n] += slope
    return result.reshape(count * n, count * n)
