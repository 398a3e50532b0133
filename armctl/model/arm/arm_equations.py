"""Kinematics and equations of motion of an arm, as methods of `Arm`."""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import ArmctlWarning, InputError, LimitError, UnknownNameError
from armctl.core.pose import Pose, computed_pose
from armctl.core.validation import Array, choice, vector

if TYPE_CHECKING:
    from armctl.model.arm.dynamics import Dynamics
    from armctl.model.arm.mechanics import Mechanics
    from armctl.model.arm.pinocchio_model import PinocchioModel

_TWO_TURNS = 4.0 * math.pi  # rad (m)
_AXES = {"all": slice(0, 6), "translation": slice(0, 3), "rotation": slice(3, 6)}


class ArmEquations:
    """The methods of an arm that compute poses, Jacobians, forces and energies at a state of its joints."""

    if TYPE_CHECKING:
        name: str
        pinocchio_model: PinocchioModel

        @property
        def n(self) -> int: ...
        @property
        def tips(self) -> tuple[str, ...]: ...
        @property
        def _dynamics(self) -> Dynamics: ...
        @property
        def _mechanics(self) -> Mechanics: ...
        def check_units(self, what: str, q: ArrayLike, remedy: str = "") -> None: ...

    def fk(self, q: ArrayLike, tip: str | None = None, *, body: str | None = None) -> Pose:
        """Forward kinematics: T_world_tip. It warns about positions of more than two turns that may be degrees.

        Args:
            tip: One of `tips`; the first one if left out.
            body: Instead of a tip, any body of the MuJoCo model: T_world_body. What the arm does not move is at home.

        Raises:
            UnknownNameError: The arm has no such tip, or the model no such body.
            InputError: Both a tip and a body are given.
        """
        given = vector("q", q, self.n)
        if (np.abs(given) > _TWO_TURNS).any():
            try:
                self.check_units("q", given)
            except LimitError as error:
                warnings.warn(ArmctlWarning(str(error)), stacklevel=2)
        if body is not None:
            return computed_pose(*self._mechanics.pose(given, self._frame(tip, body)))
        if tip is None:
            return computed_pose(*self.pinocchio_model.tip(given))
        return computed_pose(*self.pinocchio_model.further_tip(given, self._tip_number(tip)))

    def jacobian(self, q: ArrayLike, tip: str | None = None, *, body: str | None = None) -> Array:
        """The Jacobian of a tip: its twist is J(q) v.

        Args:
            tip: One of `tips`; the first one if left out.
            body: Instead of a tip, any body of the MuJoCo model: the twist of its frame.

        Returns:
            (6, n), linear first, world axes, at the tip.

        Raises:
            UnknownNameError: The arm has no such tip, or the model no such body.
            InputError: Both a tip and a body are given.
        """
        given = vector("q", q, self.n)
        if body is not None:
            return self._mechanics.jacobian(given, self._frame(tip, body))
        return self.pinocchio_model.jacobian(given, 0 if tip is None else self._tip_number(tip))

    def jacobian_derivative(self, q: ArrayLike, v: ArrayLike, tip: str | None = None, *, body: str | None = None) -> Array:
        """The time derivative of the Jacobian: the acceleration of the tip is J(q) a + jacobian_derivative(q, v) v.

        It is linear in v: at unit speed of joint k alone it is the partial derivative of J with respect to q_k, a layer of the
        kinematic Hessian.

        Args:
            tip: One of `tips`; the first one if left out.
            body: Instead of a tip, any body of the MuJoCo model.

        Returns:
            (6, n), linear first, world axes, at the tip.

        Raises:
            UnknownNameError: The arm has no such tip, or the model no such body.
            InputError: Both a tip and a body are given.
        """
        given = vector("q", q, self.n)
        return self._mechanics.jacobian_derivative(given, vector("v", v, self.n), self._frame(tip, body))

    def manipulability(self, q: ArrayLike, tip: str | None = None, *, axes: str = "all") -> float:
        """Yoshikawa's manipulability, in proportion to the volume of the twists by joint velocities of length 1.

        Yoshikawa, Manipulability of robotic mechanisms, Int. J. of Robotics Research 4 (1985).

        Args:
            tip: One of `tips`; the first one if left out.
            axes: "all", "translation" or "rotation": which rows of the Jacobian.

        Returns:
            sqrt(det(J J^T)): 0 where the arm is singular, and everywhere if it has fewer joints than rows.

        Raises:
            UnknownNameError: The arm has no such tip.
            InputError: There are no such axes.
        """
        J = self.jacobian(q, tip)[_AXES[choice("axes", axes, _AXES)]]
        return float(np.prod(np.linalg.svd(J, compute_uv=False))) if J.shape[0] <= J.shape[1] else 0.0

    def mass_matrix(self, q: ArrayLike) -> Array:
        """The joint-space mass matrix M(q), armature included, as MuJoCo's `mj_fullM`.

        If joints follow a joint of the arm, M contains their inertia: it is the mass matrix of the n joints of the arm.

        Returns:
            (n, n) kg m^2, symmetric and positive definite.
        """
        return self._dynamics.mass_matrix(vector("q", q, self.n))

    def gravity(self, q: ArrayLike) -> Array:
        """The joint torque that holds the arm at rest at q.

        This is gravity, minus gravity compensation in the model (`gravcomp`), plus the torque of joint springs. It equals
        `inverse_dynamics(q, 0, 0)`, and is the derivative of `potential_energy`.

        Returns:
            (n,) N m.
        """
        return self._dynamics.gravity(vector("q", q, self.n))

    def coriolis(self, q: ArrayLike, v: ArrayLike) -> Array:
        """The Coriolis matrix C(q, v): the Coriolis and centrifugal joint torque is C(q, v) v.

        By Christoffel symbols, so that dM/dt - 2 C is skew-symmetric (Siciliano, Robotics (2009), section 7.2.1).

        Returns:
            (n, n) N m s/rad.
        """
        return self._mechanics.coriolis(vector("q", q, self.n), vector("v", v, self.n))

    def inverse_dynamics(
        self, q: ArrayLike, v: ArrayLike, a: ArrayLike, wrench: ArrayLike | None = None, *, tip: str | None = None
    ) -> Array:
        """The joint torque for an acceleration of the arm, in continuous time.

            tau = mass_matrix(q) a + coriolis(q, v) v + gravity(q) + damping(v) - jacobian(q)^T wrench

        Included are armature, joint damping, joint springs and gravity compensation of the MuJoCo model. Dry friction
        (`frictionloss`), contacts and the forces at joint limits are not included: they are constraint forces, which the state
        and the acceleration do not determine. Without these three it is MuJoCo's `mj_inverse`.

        Args:
            wrench: (6,) N and N m that the environment exerts on a tip: force first, world axes, at the tip; none if left out.
            tip: The one of `tips` on which the wrench acts; the first one if left out.

        Returns:
            (n,) N m.

        Raises:
            UnknownNameError: The arm has no such tip.
        """
        given = vector("q", q, self.n)
        tau = self._dynamics.inverse_dynamics(given, vector("v", v, self.n), vector("a", a, self.n))
        return tau if wrench is None and tip is None else tau - self._wrench_torque(given, wrench, tip)

    def forward_dynamics(
        self, q: ArrayLike, v: ArrayLike, tau: ArrayLike, wrench: ArrayLike | None = None, *, tip: str | None = None
    ) -> Array:
        """The acceleration for a joint torque, in continuous time: the inverse of `inverse_dynamics`.

        It includes and leaves out the same forces, so `forward_dynamics(q, v, inverse_dynamics(q, v, a))` is a. Torque limits
        are not applied.

        Args:
            wrench: (6,) N and N m that the environment exerts on a tip: force first, world axes, at the tip; none if left out.
            tip: The one of `tips` on which the wrench acts; the first one if left out.

        Returns:
            (n,) rad/s^2.

        Raises:
            UnknownNameError: The arm has no such tip.
        """
        given = vector("q", q, self.n)
        torque = vector("tau", tau, self.n)
        if wrench is not None or tip is not None:
            torque = torque + self._wrench_torque(given, wrench, tip)
        return self._dynamics.forward_dynamics(given, vector("v", v, self.n), torque)

    def kinetic_energy(self, q: ArrayLike, v: ArrayLike) -> float:
        """The kinetic energy v^T M(q) v / 2, armature included.

        Returns:
            J.
        """
        given = vector("v", v, self.n)
        return 0.5 * float(given @ self.mass_matrix(q) @ given)

    def potential_energy(self, q: ArrayLike) -> float:
        """The potential energy of gravity and of joint springs; its derivative is `gravity(q)`.

        Gravity counts from the origin of the world, for the bodies that the joints move. What gravity compensation in the model
        (`gravcomp`) lifts does not count.

        Returns:
            J.
        """
        return self._mechanics.potential_energy(vector("q", q, self.n))

    def center_of_mass(self, q: ArrayLike) -> Array:
        """The center of mass of all bodies that the joints move.

        Returns:
            (3,) m, in the world.
        """
        return self._mechanics.center_of_mass(vector("q", q, self.n))

    def center_of_mass_jacobian(self, q: ArrayLike) -> Array:
        """The Jacobian of `center_of_mass`: its velocity is this matrix times v.

        Returns:
            (3, n), world axes.
        """
        return self._mechanics.center_of_mass_jacobian(vector("q", q, self.n))

    @property
    def inertial_parameters(self) -> Array:
        """The inertial parameters of the links, in which the torque of `inverse_dynamics` is linear.

        Returns:
            (10 k,): m, m cx, m cy, m cz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz of what each of the k joints carries directly; k is n, or
            more where joints follow others. They are in the frame of the joint, which turns about, or slides along, its z axis,
            with the inertia about the origin.
        """
        return self._mechanics.parameters

    def regressor(self, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> Array:
        """The dynamic regressor Y(q, v, a) of the links: their torque is Y times `inertial_parameters`.

        It is `inverse_dynamics` without armature, damping, joint springs and gravity compensation.
        Siciliano, Robotics (2009), section 7.2.2.

        Returns:
            (n, 10 k).
        """
        return self._mechanics.regressor(vector("q", q, self.n), vector("v", v, self.n), vector("a", a, self.n))

    def _wrench_torque(self, q: Array, wrench: ArrayLike | None, tip: str | None) -> Array:
        """The joint torque that a wrench on a tip exerts, (n,) N m."""
        if wrench is None:
            raise InputError("tip: given without a wrench; give wrench=(6,), force first")
        return self.jacobian(q, tip).T @ vector("wrench", wrench, 6)

    def _frame(self, tip: str | None, body: str | None) -> int:
        if body is None:
            return self._mechanics.tip_frame(0 if tip is None else self._tip_number(tip))
        if tip is not None:
            raise InputError(f"body: give a tip or a body, got the tip {tip!r:.60} and the body {body!r:.60}")
        return self._mechanics.frame(body)

    def _tip_number(self, tip: str) -> int:
        """Which of the tips has a name."""
        if not isinstance(tip, str) or tip not in self.tips:
            raise UnknownNameError.from_known(f"tip of {self.name:.60}", tip, self.tips)
        return self.tips.index(tip)
