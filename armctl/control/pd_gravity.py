"""PD and PID with gravity compensation: gravity from the model, everything else from feedback."""

from __future__ import annotations

from dataclasses import replace

from numpy.typing import ArrayLike

from armctl import _core
from armctl.control.gain_attribute import Gain, joint_gain
from armctl.control.gains import FeedbackGains, max_locked_inertia
from armctl.control.pd import PD
from armctl.core.validation import Array
from armctl.robot.arm import Arm

# Of given gains: relative to Kp Kd / m, the stability limit of the integral gain of a mass m with a spring Kp and a damper Kd
# (Routh-Hurwitz).
INTEGRAL_GAIN_RATIO = 0.25


class PDGravity(PD):
    """PD with gravity compensation: tau = g(q) + stiffness (q_ref - q) + damping (v_ref - v).

    After Takegaki and Arimoto, "A new feedback method for dynamic control of manipulators" (1981). At rest the error is zero if
    the model's gravity is exact; in motion there is a tracking error.

    Attributes:
        stiffness: (n,) N m/rad (Kp).
        damping: (n,) N m s/rad (Kd).
    """

    name = "pd-gravity"

    def _make_law(self, dt: float, continuous: bool) -> _core.Law:
        """A law with the present gains, at the start of a run."""
        gains = self.gains_at(dt)
        return _core.PDGravity(self._arm.core_model, stiffness=gains.stiffness, damping=gains.damping)


class PIDGravity(PDGravity):
    """PID with gravity compensation: PD with gravity compensation, plus an integral term against constant disturbances.

    Anti-windup by conditional integration (Astrom and Hagglund, Advanced PID Control, 2006, 3.5): a joint does not integrate
    while its motor is at its limit and the error has the same sign. The integral starts at zero in each run.

    Attributes:
        stiffness: (n,) N m/rad (Kp).
        damping: (n,) N m s/rad (Kd).
        integral_gain: (n,) N m/(rad s) (Ki).
    """

    name = "pid-gravity"
    _is_integrating = True
    integral_gain: Gain[Array] = joint_gain()

    def __init__(
        self,
        arm: Arm,
        *,
        bandwidth: float | None = None,
        damping_ratio: float = 1.0,
        stiffness: ArrayLike | None = None,
        damping: ArrayLike | None = None,
        integral_gain: ArrayLike | None = None,
    ):
        """A PID controller with gravity compensation for an arm.

        Args:
            arm: The arm; its model gives the gravity torque, its torque limits are used by the anti-windup.
            bandwidth: rad/s, the natural frequency of each joint's closed loop at its median inertia. The gains follow from
                margins if neither it nor stiffness nor damping is given.
            damping_ratio: 1 is critically damped; of gains that follow from a bandwidth.
            stiffness: (n,) or one number for all joints, N m/rad; replaces the one that follows from the bandwidth.
            damping: (n,) or one number for all joints, N m s/rad; replaces the one that follows from the damping ratio.
            integral_gain: (n,) or one number for all joints, N m/(rad s). If other gains are given, the default is a quarter of
                stiffness x damping / the largest inertia of the joint.

        Raises:
            InputError: A gain is negative, not finite or of the wrong length.
        """
        super().__init__(arm, bandwidth=bandwidth, damping_ratio=damping_ratio, stiffness=stiffness, damping=damping)
        if integral_gain is None and not self._has_default_gains:
            integral_gain = INTEGRAL_GAIN_RATIO * self.stiffness * self.damping / max_locked_inertia(arm)
        self.integral_gain = self._default.integral_gain if integral_gain is None else integral_gain
        if integral_gain is None:
            self._default = replace(self._default, integral_gain=self.integral_gain)

    def _make_law(self, dt: float, continuous: bool) -> _core.Law:
        """A law with the present gains, at the start of a run."""
        gains = self.gains_at(dt)
        return _core.PIDGravity(
            self._arm.core_model,
            stiffness=gains.stiffness,
            damping=gains.damping,
            integral_gain=self._integral_gain(gains),
            torque_limit=self._arm.limits.tau_max,
            dt=dt,
        )

    def _integral_gain(self, gains: FeedbackGains) -> Array:
        return gains.integral_gain if self.integral_gain is self._default.integral_gain else self.integral_gain
