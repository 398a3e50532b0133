"""PD: a spring and a damper at every joint, alone, with gravity compensation, and with dynamic feedforward."""

from __future__ import annotations

from dataclasses import replace

from numpy.typing import ArrayLike

from armctl import _core
from armctl.control.gain_attribute import Gain, joint_gain, scalar_gain
from armctl.control.gains import (
    DELAY_MARGINS_S,
    MAX_BANDWIDTH,
    FeedbackGains,
    bandwidth_gains,
    margin_gains,
)
from armctl.control.interface import ArmController, checked_period
from armctl.core.defaults import MIN_DELAY_MARGIN_S
from armctl.core.validation import Array, number
from armctl.model.arm.arm import Arm


class PD(ArmController):
    """Joint PD: tau = stiffness (q_ref - q) + damping (v_ref - v).

    It uses neither gravity nor inertia, so it has a steady-state error under gravity and a tracking error in motion.

    Default gains are as high as a delay margin of 5 ms (and of 2.5 control periods) and a peak sensitivity of 1.7 permit in all
    configurations (`margin_gains`), so they depend on the control period: the attributes show those for the period of the arm's
    model. Gains that you give or assign do not depend on it.
    """

    name = "pd"
    stiffness: Gain[Array] = joint_gain()
    damping: Gain[Array] = joint_gain()
    delay_margin: Gain[float] = scalar_gain(*DELAY_MARGINS_S)

    def __init__(
        self,
        arm: Arm,
        *,
        bandwidth: float | None = None,
        damping_ratio: float = 1.0,
        stiffness: ArrayLike | None = None,
        damping: ArrayLike | None = None,
        delay_margin: float = MIN_DELAY_MARGIN_S,
    ):
        """A PD controller for an arm.

        Args:
            bandwidth: rad/s, the natural frequency of each joint's closed loop at its median inertia. The gains follow from
                margins if neither it nor stiffness nor damping is given.
            damping_ratio: 1 is critically damped; of gains that follow from a bandwidth.
            stiffness: (n,) or one number for all joints, N m/rad (Kp); replaces the one that follows from the bandwidth.
            damping: (n,) or one number for all joints, N m s/rad (Kd); replaces the one that follows from the damping ratio.
            delay_margin: s, of the gains that follow from margins: give a larger one if the delay of the robot is unknown.
        """
        super().__init__(arm)
        damping_ratio = number("damping_ratio", damping_ratio, 0.0, MAX_BANDWIDTH)
        self.delay_margin = delay_margin
        self._has_default_gains = bandwidth is None and stiffness is None and damping is None
        if self._has_default_gains:
            self._default = margin_gains(arm, arm.dt, self.delay_margin)
        else:
            self._default = bandwidth_gains(arm, bandwidth, damping_ratio, stiffness, damping)
        self.stiffness = self._default.stiffness
        self.damping = self._default.damping
        self._default = replace(self._default, stiffness=self.stiffness, damping=self.damping)

    def _make_law(self, dt: float, continuous: bool) -> _core.Law:
        gains = self.gains_at(dt)
        return _core.PD(stiffness=gains.stiffness, damping=gains.damping)

    def gains_at(self, dt: float) -> FeedbackGains:
        """The gains for a control period; those that were given or assigned do not depend on it.

        Args:
            dt: s, the control period; 0 means continuous time.
        """
        dt, _ = checked_period(dt, False)
        default = margin_gains(self._arm, dt, self.delay_margin) if self._has_default_gains and dt else self._default
        return FeedbackGains(
            stiffness=default.stiffness if self.stiffness is self._default.stiffness else self.stiffness,
            damping=default.damping if self.damping is self._default.damping else self.damping,
            gravity_excess=default.gravity_excess,
        )


class PDFeedforward(PD):
    """PD with dynamic feedforward: tau = ID(q_ref, v_ref, a_ref) + stiffness (q_ref - q) + damping (v_ref - v).

    After An, Atkeson, Hollerbach, Model-Based Control of a Robot Manipulator (1988), chapter 5. The model is evaluated on the
    reference only, so measurement noise does not pass through it and the loop is that of PD. With an exact model, of which the
    discrete form of `ComputedTorque` is the inverse, only rounding errors remain.
    """

    name = "pd-feedforward"

    def _make_law(self, dt: float, continuous: bool) -> _core.Law:
        gains = self.gains_at(dt)
        model = self._model(dt, continuous)
        return _core.PDFeedforward(model, stiffness=gains.stiffness, damping=gains.damping)


class PDGravity(PD):
    """PD with gravity compensation: tau = g(q) + stiffness (q_ref - q) + damping (v_ref - v).

    After Takegaki and Arimoto, "A new feedback method for dynamic control of manipulators" (1981). At rest the error is zero if
    the model's gravity is exact; in motion there is a tracking error.
    """

    name = "pd-gravity"

    def _make_law(self, dt: float, continuous: bool) -> _core.Law:
        gains = self.gains_at(dt)
        return _core.PDGravity(self._arm.core_model, stiffness=gains.stiffness, damping=gains.damping)
