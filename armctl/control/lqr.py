"""LQR: the linear quadratic regulator of the linearized arm, at a configuration or along a motion."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from armctl import _core
from armctl.control.gain_attribute import Gain, joint_gain, optional_gain, scalar_gain
from armctl.control.gains import DELAY_MARGINS_S, required_delay, sampled_inertia
from armctl.control.interface import ArmController, checked_period
from armctl.control.observer_gains import EstimateWeights, feedback_estimate
from armctl.core.defaults import MIN_DELAY_MARGIN_S
from armctl.core.errors import InputError
from armctl.core.trajectory import Trajectory, check_motion
from armctl.core.validation import Array, frozen, number
from armctl.model.arm.arm import Arm

_STEP = 1e-5  # rad, rad/s and rad/s^2, of the central differences of inverse dynamics
_NODE_INTERVAL_S = 0.02  # along a motion; the inertia changes by a few percent in that time
_MAX_TRACKING_INDEX = 100.0  # of the observer, above which it takes over the measured position
# Bandwidth x required delay with the margins of the default gains, for the observer at its slowest (`feedback_estimate`).
_BANDWIDTH_TIMES_DELAY = 0.62


class LQRGains(NamedTuple):
    """The linear quadratic problem of a controller at a configuration, and its solution.

    The state x has the errors of positions and velocities of the joints, and with integral action the sums of the position
    errors x dt: x[k + 1] = A x[k] + B tau[k]. The cost is the sum of x Q x + 2 x N tau + tau R tau.

    Attributes:
        A: (m, m), m = 2n, or 3n with integral action.
        B: (m, n).
        Q: (m, m).
        R: (n, n).
        N: (m, n); zero with Bryson's rule.
        K: (n, m), the gains: tau = -K x, besides the torque of the reference.
        P: (m, m), the cost of a state x is x P x.
    """

    A: Array
    B: Array
    Q: Array
    R: Array
    N: Array
    K: Array
    P: Array


class LQR(ArmController):
    """Linear quadratic regulator: the state feedback that minimizes a quadratic cost of errors and torques.

    tau = ID(q, v, a_ref + G (e, e_dot, integral of e)), in which G gives the gains K of the linearized arm: those of the
    discrete Riccati equation at a configuration; along a motion, those of the time-varying one, at the point of the motion that
    is nearest to the reference. Elsewhere the accelerations of the feedback remain the same. A filter estimates position and
    velocity, a steady-state Kalman filter (LQG). The integral waits while a motor is saturated.

    The weights follow from Bryson's rule if `max_error` is given: 1 / max^2 for each error and torque (Bryson and Ho, Applied
    Optimal Control, 1975, 5.2). Otherwise they are inertias, bandwidth^4 M for errors and M^-1 for the torques that accelerate
    the arm, so that all joints have the same bandwidth in all configurations, and the bandwidth follows from the delay margin.
    """

    name = "lqr"
    max_error: Gain[Array] = joint_gain()
    max_velocity: Gain[Array] = joint_gain()
    max_torque: Gain[Array] = joint_gain()
    integral_time: Gain[float] = scalar_gain()
    bandwidth: Gain[float | None] = optional_gain(1e-3)
    observer_bandwidth: Gain[float | None] = optional_gain()
    delay_margin: Gain[float] = scalar_gain(*DELAY_MARGINS_S)

    def __init__(
        self,
        arm: Arm,
        motion: Trajectory | None = None,
        *,
        q: ArrayLike | None = None,
        max_error: ArrayLike = 0.0,
        max_velocity: ArrayLike = 0.0,
        max_torque: ArrayLike = 0.0,
        integral_time: float = 0.1,
        bandwidth: float | None = None,
        observer_bandwidth: float | None = None,
        delay_margin: float = MIN_DELAY_MARGIN_S,
    ):
        """A linear quadratic regulator for an arm.

        Args:
            arm: The arm whose model it uses.
            motion: The motion along which the gains vary; None for one configuration.
            q: (n,) rad, the configuration without a motion; home by default.
            max_error: (n,) or one number, rad: gives weights by Bryson's rule; 0 if it is not used.
            max_velocity: (n,) or one number, rad/s, of Bryson's rule; 0 for no weight.
            max_torque: (n,) or one number, N m, of Bryson's rule; 0 for the torque limits.
            integral_time: s: an error that lasts as long costs as much by its integral as by itself. 0 for no integral action.
            bandwidth: rad/s, without Bryson's rule; None if it follows from the delay margin.
            observer_bandwidth: rad/s, the root of acceleration noise / noise of the encoders, for which the Kalman filter is;
                0 to use measured velocities; None if it follows from the delay margin.
            delay_margin: s, of gains that follow from it.

        Raises:
            InputError: An argument has a wrong type, length or value, or there are a motion and a configuration.
            LimitError: The configuration is outside the limits.
        """
        super().__init__(arm)
        if motion is not None:
            if q is not None:
                raise InputError("q: the gains are those along the motion; give a motion or a configuration, not both")
            check_motion(motion, arm.joint_names, what="motion")
        self._motion = motion
        self._q = arm.limits.clamp(arm.home) if q is None else arm.checked("q", q)
        self.max_error = max_error
        self.max_velocity = max_velocity
        self.max_torque = max_torque
        self.integral_time = integral_time
        self.bandwidth = bandwidth
        self.observer_bandwidth = observer_bandwidth
        self.delay_margin = delay_margin

    def gains(self, dt: float | None = None, continuous: bool = False) -> tuple[LQRGains, ...]:
        """The problem and its solution, at the configuration or at each point of the motion at which the gains change.

        Args:
            dt: s, the control period; that of the arm by default.
            continuous: Whether the arm moves continuously during the control period.

        Returns:
            One for a configuration.

        Raises:
            InputError: The control period is no number above 0 up to 1 s, or no gains minimize the cost.
        """
        dt, continuous = checked_period(self._arm.dt if dt is None else dt, continuous)
        if dt == 0.0:
            raise InputError("dt: need a control period above 0 s; the gains are those of a discrete controller")
        return tuple(node.gains for node in self._nodes(dt, continuous))

    def _make_law(self, dt: float, continuous: bool) -> _core.Law:
        """A law with the present gains, at the start of a run; in continuous time, with the gains of the arm's period."""
        nodes = self._nodes(dt or self._arm.dt, continuous)
        return _core.LQR(
            self._model(dt, continuous),
            **self._kalman_weights(dt),
            torque_limit=self._arm.limits.tau_max,
            dt=dt,
            continuous=continuous,
            nodes=np.array([node.q for node in nodes]),
            feedback=np.array([node.feedback for node in nodes]),
        )

    def _nodes(self, dt: float, continuous: bool) -> list[_Node]:
        """The gains at the configuration, or along the motion by the Riccati recursion from its end."""
        rest = np.zeros(self.n)
        points = [(self._q, rest, rest)]
        ticks = 1
        if self._motion is not None:
            count = 1 + max(1, int(np.ceil(self._motion.duration / _NODE_INTERVAL_S)))
            sampled = self._motion.sample(np.linspace(0.0, self._motion.duration, count))
            points = list(zip(sampled.q, sampled.v, sampled.a, strict=True))
            ticks = max(1, round(self._motion.duration / (count - 1) / dt))
        model = self._model(dt, continuous)
        damping = np.diag(sampled_inertia(self._arm).damping)
        nodes: list[_Node] = []
        for point in reversed(points):
            arm = _linearized(model, *point)
            cancelled = np.hstack([arm.stiffness, arm.damping - damping, np.zeros_like(damping)])
            gains = self._minimized(arm, cancelled, dt, 0.5 if continuous else 1.0, nodes[-1].gains.P if nodes else None, ticks)
            # What inverse dynamics cancels is part of the gains. Damping is not: it is that of the reference's velocity.
            feedback = np.zeros((self.n, 3 * self.n))
            feedback[:, : gains.K.shape[1]] = gains.K
            feedback += cancelled
            nodes.append(_Node(point[0], gains, np.asarray(np.linalg.solve(arm.inertia, feedback), dtype=np.float64)))
        return nodes[::-1]

    def _minimized(
        self, arm: _LinearModel, cancelled: Array, dt: float, position_step: float, later: Array | None, ticks: int
    ) -> LQRGains:
        """The gains of the stationary problem, or those some ticks before the cost of a state was x later x."""
        from scipy.linalg import LinAlgError, cholesky, solve_discrete_are, solve_triangular

        n = self.n
        acceleration = -np.linalg.solve(arm.inertia, np.hstack([arm.stiffness, arm.damping, -np.eye(n)]))
        inertia = _symmetric(arm.inertia)
        has_integral = self.integral_time > 0.0
        m = (3 if has_integral else 2) * n
        A = np.eye(m)
        A[:n, n : 2 * n] = dt * np.eye(n)
        A[2 * n :, :n] = dt * np.eye(m - 2 * n, n)
        A[:n, : 2 * n] += position_step * dt**2 * acceleration[:, : 2 * n]
        A[n : 2 * n, : 2 * n] += dt * acceleration[:, : 2 * n]
        B = np.zeros((m, n))
        B[:n] = position_step * dt**2 * acceleration[:, 2 * n :]
        B[n : 2 * n] = dt * acceleration[:, 2 * n :]
        Q = np.zeros((m, m))
        F = np.zeros((n, m))  # tau - F x is what the cost counts: without the torques that only hold the arm
        if self.max_error.any():
            if not self.max_error.all():
                raise InputError(f"max_error: every joint needs one above 0, got {self.max_error.tolist()!s:.120}")
            Q[:n, :n] = np.diag(_bryson(self.max_error))
            Q[n : 2 * n, n : 2 * n] = np.diag(_bryson(self.max_velocity))
            R = np.diag(_bryson(np.where(self.max_torque > 0.0, self.max_torque, self._arm.limits.tau_max)))
        else:
            Q[:n, :n] = self.effective_gains(dt)["bandwidth"] ** 4 * inertia
            R = _symmetric(np.asarray(np.linalg.inv(inertia), dtype=np.float64))
            F += cancelled[:, :m]
        if has_integral:
            Q[2 * n :, 2 * n :] = Q[:n, :n] / self.integral_time**2
        # In the coordinates L^T x and L^-1 tau, with M = L L^T, all joints are unit masses, however much their inertias differ.
        L = cholesky(inertia, lower=True)
        scale = np.kron(np.eye(m // n), L.T)
        inverse = np.kron(np.eye(m // n), solve_triangular(L, np.eye(n), lower=True).T)
        a = scale @ (A + B @ F) @ inverse
        b = scale @ B @ L
        q = _symmetric(inverse.T @ Q @ inverse)
        r = _symmetric(L.T @ R @ L)
        try:
            with np.errstate(all="ignore"):  # of weights beyond the range of floats, which the next lines find
                cholesky(r)
                p = solve_discrete_are(a, b, q, r) if later is None else inverse.T @ later @ inverse
                k = np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
                for _ in range(0 if later is None else ticks):
                    k = np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
                    p = _symmetric(q + a.T @ p @ (a - b @ k))
            if not np.isfinite(k).all():
                raise LinAlgError
        except (LinAlgError, ValueError):
            raise InputError(
                "max_error, max_velocity, max_torque: no gains minimize the cost of these weights; every joint needs a finite "
                "torque above 0, and ratios of error and torque within about 1e6 of those of the others"
            ) from None
        return LQRGains(
            A=frozen(A),
            B=frozen(B),
            Q=frozen(_symmetric(Q + F.T @ R @ F)),
            R=frozen(R),
            N=frozen(-F.T @ R),
            K=frozen(L @ k @ scale - F),
            P=frozen(scale.T @ p @ scale),
        )

    def effective_gains(self, dt: float) -> dict[str, float]:
        """Bandwidths, rad/s, and integral time, s, as arguments of the constructor: those given, or those of the delay margin.

        Args:
            dt: s, the control period.

        Returns:
            One number for each name.
        """
        dt = number("dt", dt, 0.0)
        bandwidth = self.bandwidth
        if bandwidth is None:
            bandwidth = _BANDWIDTH_TIMES_DELAY / required_delay(dt, self.delay_margin)
        observer = self.observer_bandwidth
        if observer is None:
            observer = feedback_estimate(self._arm, dt, 0.0 if self.max_error.any() else bandwidth) if dt else 0.0
        return {"bandwidth": bandwidth, "observer_bandwidth": observer, "integral_time": self.integral_time}

    def _kalman_weights(self, dt: float) -> EstimateWeights:
        """The gains of the stationary Kalman filter of a double integrator, after Kalata, "The tracking index" (1984)."""
        index = min((self.effective_gains(dt)["observer_bandwidth"] * dt) ** 2, _MAX_TRACKING_INDEX)
        root = 0.25 * (4.0 + index - np.sqrt(8.0 * index + index**2))
        position = 1.0 - root**2
        return {"position_weight": position, "velocity_weight": 2.0 * (2.0 - position) - 4.0 * root}


class _LinearModel(NamedTuple):
    """Derivatives of inverse dynamics by acceleration, position and velocity, each (n, n)."""

    inertia: Array
    stiffness: Array
    damping: Array


class _Node(NamedTuple):
    """A configuration, its gains, and those of the accelerations, (n, 3n)."""

    q: Array
    gains: LQRGains
    feedback: Array


def _linearized(model: _core.ArmModel, q: Array, v: Array, a: Array) -> _LinearModel:
    n = len(q)

    def torques(changes: Array) -> Array:
        tau = np.empty((3 * n, n))
        _core.inverse_dynamics(model, q + changes[:, n : 2 * n], v + changes[:, 2 * n :], a + changes[:, :n], tau)
        return tau

    steps = _STEP * np.eye(3 * n)
    columns = (torques(steps) - torques(-steps)).T / (2 * _STEP)
    return _LinearModel(*np.split(columns, 3, axis=1))


def _symmetric(matrix: Array) -> Array:
    return np.asarray(0.5 * (matrix + matrix.T), dtype=np.float64)


def _bryson(largest: Array) -> Array:
    """Weights (n,) by Bryson's rule; none where there is no largest value."""
    return np.divide(1.0, largest**2, out=np.zeros_like(largest), where=largest > 0.0)
