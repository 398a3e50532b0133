"""Hybrid force/motion control: forces along some axes of the tip, motion along the others."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from armctl.control import feedforward
from armctl.control.gains import MAX_BANDWIDTH
from armctl.control.interface import Clock, State, explains_wrong_arguments, measured_wrench
from armctl.control.task_space import POSE_SIZE, consistent_inverse, task_rows, tip_error
from armctl.core.errors import InputError, UnknownNameError
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, choice, number, shown
from armctl.robot.arm import Arm, check_arm
from armctl.robot.dynamics import Dynamics

AXES = ("x", "y", "z", "rx", "ry", "rz")
FRAMES = ("world", "tip")
DEFAULT_BANDWIDTH = 30.0  # rad/s. Contact forces disturb the motion axes, so it is higher than for free motion.
_FORCE_FILTER = 300.0  # rad/s; about 3 ms against the noise of force sensors
_VELOCITY_FILTER = 100.0  # rad/s; velocities that are differenced from positions are ten times less noisy after it
_WRENCH_FILTER = 40.0  # rad/s. The wrench on motion axes is compensated; faster, it would resonate with a face on a wall.
# Of the measured forces on motion axes. Where a tip sticks, friction is a strong damper. Compensated completely but late, it
# would act like a mass, and the tip would swing slowly along the surface.
_COMPENSATED_SHARE = 0.8
_APPROACH_RATE = 40.0  # 1/s, the bandwidth of the speed in an approach; stable with a delay of 4 ms
_DAMPING_RATE = 30.0  # 1/s, the damping of the tip in contact divided by its mass
_INTEGRAL_RATE = 20.0  # 1/s. Below the damping rate, the integral of a lightly damped wall is stable.
# While the tip moves into a soft wall, its damping explains a part of the error. If all of that part is integrated, the force
# overshoots; if nothing of it is, the force is late on the softest walls.
_EXPLAINED_SHARE = 0.75
_MAX_INTEGRATED_ERROR = 0.08  # of the target. On a soft wall the force rises slowly; the bound prevents windup.
_RISE_TIME_S = 0.02  # time constant of the commanded force after the first contact
# Friction is compensated at this share of the speed that a frictionless mass would have. With all of it, the force loop that is
# closed over the friction is unstable on walls ten times stiffer than MuJoCo's default with a delay of 4 ms.
_YIELDING_RATIO = 0.1
# While there is less force than the contact threshold, the command is this multiple of the measured force. Above 1 it makes the
# force grow on any wall that the slow tip touches; without contact it is zero.
_DETECTION_GAIN = 2.0
_CONTACT_RATIO = 0.1  # of the target, the default contact threshold
_LOST_RATIO = 0.2  # of the contact threshold; below it for _LOST_TIME_S the contact is lost
_LOST_TIME_S = 0.01
# 1/s. A mass m that meets a wall of damping rate b at speed v exerts the force m b v at once. For MuJoCo's contacts b is
# 2 / solref[0], 100 /s by default and 330 /s for one ten times stiffer.
_WALL_DAMPING_RATE = 330.0
_IMPACT_RATIO = 0.7  # of the target, the force of such an impact
_MIN_IMPACT_RATIO = 0.1  # where dry friction is larger
_MAX_APPROACH_SPEED = 0.05  # m/s
_MAX_LEVER_M = 0.2  # a hand may touch a wall this far from the tip, where its effective mass is larger
_MIN_MOBILITY_RATIO = 0.1  # of the mobility of the tip, a lower bound for that of another point


class HybridForce:
    """Hybrid force/motion control with contact transition.

        tau = ID(q, v, a_ref + posture + J# a_task) + J^T (A^T f - w)

    After Khatib, "A unified approach for motion and force control of robot manipulators: the operational space formulation"
    (1987). Along a force axis the tip approaches slowly until it measures a contact. The commanded force then rises from the
    measured to the target force, with integral action and damping. Along all other axes the tip follows its reference like
    operational space control, and the measured wrench w on motion axes, such as friction on a
    surface, is compensated. The reference along a force axis
    is ignored, so the position of the wall need not be known. An axis with target 0 yields from the beginning.

    It needs `state.wrench`. Arms of less than six joints control the position of the tip, not its orientation.

    Attributes:
        frame: "world" or "tip", the frame of the axes.
        bandwidth: rad/s, of the tip's error along motion axes.
        damping_ratio: 1 is critically damped.
        approach_speed: m/s; None for one that follows from target and effective mass.
        contact_force: N, the measured force that counts as a contact; None for a tenth of the target.
    """

    name = "hybrid-force"
    needs_wrench = True

    def __init__(
        self,
        arm: Arm,
        force: Mapping[str, float],
        *,
        frame: str = "world",
        bandwidth: float = DEFAULT_BANDWIDTH,
        damping_ratio: float = 1.0,
        approach_speed: float | None = None,
        contact_force: float | None = None,
    ):
        """A hybrid force controller for an arm.

        Args:
            arm: The arm whose model it uses.
            force: The target force, N along "x", "y", "z" and N m about "rx", "ry", "rz"; all other axes follow the motion.
                `{"z": -20.0}` presses down with 20 N.
            frame: "world" for axes of the world, "tip" for axes that turn with the tip.
            bandwidth: rad/s, of the tip's error along motion axes.
            damping_ratio: 1 is critically damped.
            approach_speed: m/s (rad/s about an axis) until the tip touches. By default the impact on a wall ten times stiffer
                than MuJoCo's default is weaker than the target; at most 0.05 m/s.
            contact_force: N, the measured force that counts as a contact; a tenth of the target by default. Choose it above
                the noise and the bias of the sensor.

        Raises:
            InputError: No axis, a force that is not a finite number, or a gain that is negative or not finite.
            UnknownNameError: There is no such axis or frame.
        """
        check_arm(arm)
        self.frame = choice("frame", frame, FRAMES)
        self.bandwidth = number("bandwidth", bandwidth, 0.0, MAX_BANDWIDTH)
        self.damping_ratio = number("damping_ratio", damping_ratio, 0.0, MAX_BANDWIDTH)
        self.approach_speed = None if approach_speed is None else number("approach_speed", approach_speed, 1e-6, 10.0)
        self.contact_force = None if contact_force is None else number("contact_force", contact_force, 1e-6)
        self._arm = arm
        self._rows = task_rows(arm)
        self._dynamics = Dynamics(arm.model, arm.pinocchio_model)
        self._clock = Clock()
        self._axes: dict[str, _ForceAxis] = {}
        self._velocity = np.zeros(arm.n)
        self._wrench = np.zeros(POSE_SIZE)
        self.force = force

    @property
    def force(self) -> dict[str, float]:
        """The target forces along the force axes, N and N m. It can be replaced during a run; other axes move."""
        return {name: axis.target for name, axis in self._axes.items()}

    @force.setter
    def force(self, force: Mapping[str, float]) -> None:
        if not isinstance(force, Mapping) or not force:
            raise InputError(f"force: expected a table of axes, got {shown(force)}; {{'z': -20.0}} presses down with 20 N")
        axes = {}
        for name, target in force.items():
            if name not in AXES:
                raise UnknownNameError.of("axis", name, AXES)
            axis = self._axes.get(name, _ForceAxis())
            axis.target = number(f"force along {name}", target)
            axes[name] = axis
        self._axes = axes

    @property
    def in_contact(self) -> bool:
        """Whether every force axis is in contact."""
        return all(axis.touches for axis in self._axes.values() if axis.target)

    @explains_wrong_arguments
    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque for the coming control period.

        Args:
            state: The measured state, with its wrench.
            setpoint: Where the arm should be; ignored along force axes.

        Returns:
            (n,) N m.

        Raises:
            InputError: The state has no wrench.
        """
        wrench = measured_wrench(state, self.name)
        q = state.q
        q_ref = setpoint.q
        v_ref, a_ref = feedforward.sampled(setpoint)
        if not self._clock.follows(state):
            self._restart(state)
        self._velocity = self._velocity + _weight(_VELOCITY_FILTER, state.dt) * (state.v - self._velocity)
        v = self._velocity
        error, J_ref, J = tip_error(self._arm, q, q_ref)
        M = self._dynamics.mass_matrix(q)
        A = self._axis_directions(q)
        J_task = J[self._rows]
        J_inverse = consistent_inverse(J_task, M)
        mobility = J @ np.linalg.solve(M, J.T)
        # (k, n), the velocity of the joints at unit speed along each axis
        rates = A[:, self._rows] @ J_inverse.T
        masses = ((rates @ M) * rates).sum(axis=1)
        dry_friction = np.abs(rates) @ self._dynamics.friction_loss
        force = self._force_commands(A, wrench, J @ v, mobility, masses, dry_friction, state.dt)

        task = self.bandwidth**2 * error + 2 * self.damping_ratio * self.bandwidth * (J_ref @ v_ref - J @ v)
        task = task + A.T @ (force.acceleration - A @ (task + J @ a_ref))
        posture_bandwidth = 0.5 * self.bandwidth
        posture = posture_bandwidth**2 * (q_ref - q) + 2 * posture_bandwidth * (v_ref - v)
        a = a_ref + posture + J_inverse @ (task[self._rows] - J_task @ posture)
        # Friction is compensated at the speed at which the tip is to correct its errors: at that of the reference, which may
        # stand still, the friction of the joints would hold the tip where it is.
        correction = 0.5 * self.bandwidth * error
        correction = correction + A.T @ (force.speed - A @ correction)
        v_ref = v_ref + J_inverse @ correction[self._rows]
        tau = feedforward.inverse_dynamics(self._dynamics, state, a) + self._dynamics.damping * (v_ref - v)
        if self._dynamics.has_friction:
            v_ref = v_ref + J_inverse @ (A.T @ force.yielding)[self._rows]
            tau = tau + feedforward.friction(self._dynamics, state, v_ref, a_ref)
        return tau + J.T @ (A.T @ force.force - self._compensated_wrench(A, wrench, state.dt))

    def _restart(self, state: State) -> None:
        self._velocity = state.v.copy()
        self._wrench = np.zeros(POSE_SIZE)
        for axis in self._axes.values():
            axis.restart()

    def _axis_directions(self, q: Array) -> Array:
        """(k, 6), the unit twist of each force axis in the world."""
        R = self._arm.pinocchio_model.tip(q)[1] if self.frame == "tip" else np.eye(3)
        directions = np.zeros((6, 6))
        directions[:3, :3] = R.T
        directions[3:, 3:] = R.T
        return directions[[AXES.index(name) for name in self._axes]]

    def _force_commands(
        self, A: Array, wrench: Array, twist: Array, mobility: Array, masses: Array, dry_friction: Array, dt: float
    ) -> _ForceCommands:
        commands = []
        for k, axis in enumerate(self._axes.values()):
            direction = A[k]
            target = abs(axis.target)
            threshold = _CONTACT_RATIO * target if self.contact_force is None else self.contact_force
            approach_speed = self.approach_speed
            if approach_speed is None:
                # When the tip stops, the wall bears the force that moved the joints against their dry friction.
                impact = max(_IMPACT_RATIO * target - dry_friction[k], _MIN_IMPACT_RATIO * target)
                approach_speed = min(_MAX_APPROACH_SPEED, impact * _contact_mobility(mobility, direction) / _WALL_DAMPING_RATE)
            measured = -float(direction @ wrench)  # the tip exerts the opposite of the wrench on it
            commands.append(axis.command(measured, float(direction @ twist), float(masses[k]), approach_speed, threshold, dt))
        return _ForceCommands(*np.array(commands).T)

    def _compensated_wrench(self, A: Array, wrench: Array, dt: float) -> Array:
        """(6,) the measured wrench on motion axes in contact: friction, and the moment of a contact beside the tip."""
        if self.in_contact:
            self._wrench = self._wrench + _weight(_WRENCH_FILTER, dt) * (wrench - self._wrench)
        else:
            self._wrench = np.zeros(POSE_SIZE)
        compensated = self._wrench - A.T @ (A @ self._wrench)
        compensated[:3] *= _COMPENSATED_SHARE
        compensated[self._rows.stop :] = 0.0
        return compensated


class _ForceCommand(NamedTuple):
    """What one force axis commands: N, m/s^2, m/s.

    Attributes:
        force: The force.
        acceleration: The acceleration that damps or approaches.
        speed: The speed of the approach.
        yielding: The speed in contact at which dry friction is compensated.
    """

    force: float
    acceleration: float
    speed: float
    yielding: float


class _ForceCommands(NamedTuple):
    """The commands of all k force axes, each (k,)."""

    force: Array
    acceleration: Array
    speed: Array
    yielding: Array


class _ForceAxis:
    """The force loop along one axis: approach, contact, and back if the contact is lost.

    Attributes:
        target: N or N m that the tip should exert.
        touches: Whether there is contact.
    """

    def __init__(self) -> None:
        self.target = 0.0
        self.restart()

    def restart(self) -> None:
        """Begins with an approach."""
        self.touches = False
        self._measured = 0.0
        self._commanded = 0.0
        self._integral = 0.0
        self._lost_time = 0.0
        self._yielding = 0.0

    def command(
        self, measured: float, speed: float, mass: float, approach_speed: float, threshold: float, dt: float
    ) -> _ForceCommand:
        """The command for the coming control period.

        Args:
            measured: N, what the tip exerts.
            speed: m/s, of the tip.
            mass: kg, the effective mass of a tip that moves along the axis only.
            approach_speed: m/s.
            threshold: N, above it there is contact.
            dt: s, the control period.
        """
        self._measured += _weight(_FORCE_FILTER, dt) * (measured - self._measured)
        sign = math.copysign(1.0, self.target)
        pressing = sign * self._measured
        if self.target == 0.0:
            self.touches = True
        elif not self.touches and pressing > threshold:
            self.touches = True
            self._commanded = self._measured
            self._integral = 0.0
            self._lost_time = 0.0
        elif self.touches:
            self._lost_time = self._lost_time + dt if pressing < _LOST_RATIO * threshold else 0.0
            if self._lost_time > _LOST_TIME_S:
                self.touches = False
                self._integral = 0.0
        if self.touches:
            return self._contact(speed, mass, dt)
        return self._approach(sign * approach_speed, speed, sign * max(pressing, 0.0), dt)

    def _approach(self, approach_speed: float, speed: float, felt: float, dt: float) -> _ForceCommand:
        error = approach_speed - speed
        self._integral += dt * error
        acceleration = _APPROACH_RATE * error + 0.25 * _APPROACH_RATE**2 * self._integral  # both poles at half the rate
        return _ForceCommand(_DETECTION_GAIN * felt, acceleration, approach_speed, 0.0)

    def _contact(self, speed: float, mass: float, dt: float) -> _ForceCommand:
        self._commanded += _weight(1 / _RISE_TIME_S, dt) * (self.target - self._commanded)
        bound = _MAX_INTEGRATED_ERROR * abs(self.target)
        error = self._commanded - self._measured
        damping = _DAMPING_RATE * mass
        unexplained = error - _EXPLAINED_SHARE * damping * speed
        self._integral += _INTEGRAL_RATE * dt * min(max(unexplained, -bound), bound)
        free_speed = error / damping  # of a mass without friction under this error of the force
        self._yielding += _weight(_DAMPING_RATE, dt) * (_YIELDING_RATIO * free_speed - self._yielding)
        return _ForceCommand(self._commanded + self._integral, -_DAMPING_RATE * speed, 0.0, self._yielding)


def _weight(rate: float, dt: float) -> float:
    """The weight of a new sample in a low-pass of first order."""
    return -math.expm1(-rate * dt)


def _contact_mobility(mobility: Array, direction: Array) -> float:
    """The smallest mobility, 1/kg, of any point of the hand that may touch, in a direction.

    The mobility of a point at the lever r is that of the twist (n, r x n). It is smallest where the hand does not turn.

    Args:
        mobility: (6, 6) of the tip, J M^-1 J^T.
        direction: (6,) unit twist.
    """
    tip = float(direction @ mobility @ direction)
    coupling = mobility[3:, :3] @ direction[:3]
    turning = mobility[3:, 3:] + 1e-9 * np.trace(mobility) * np.eye(3)
    lever = -np.linalg.solve(turning, coupling)
    lever *= min(1.0, _MAX_LEVER_M / max(float(np.linalg.norm(lever)), 1e-12))
    return max(float(tip + 2 * lever @ coupling + lever @ turning @ lever), _MIN_MOBILITY_RATIO * tip)
