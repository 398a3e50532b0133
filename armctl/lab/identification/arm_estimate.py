"""ArmEstimate: the identified parameters of an arm, what supports them, and models with them."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.result import Verdict
from armctl.core.validation import Array, as_array, vector
from armctl.lab.identification.identified_model import IdentifiedArm, consistent_model
from armctl.lab.identification.regressor import FrictionShape
from armctl.model.arm.arm import Arm, with_model
from armctl.model.arm.passive_forces import set_dry_friction

# rad/s (m/s). Where dry friction acts fully below this speed, MuJoCo's law knows it better than filtered velocities do.
_MIN_SHAPE_SPEED = 0.1
_MANY_NAMES = 3  # more names are counted in a sentence


@dataclass(frozen=True, slots=True, eq=False)
class Validation(Verdict):
    """Measured and predicted torques on the part of a recording that the fit did not use.

    Attributes:
        ok: Whether the prediction is good enough on every joint.
        reason: The joint with a prediction that is not good enough; empty if there is none.
        t: (K,) s.
        measured: (K, n) N m, low-pass filtered as in the fit.
        predicted: (K, n) N m, by parameters that were fitted to the other part.
        by_model: (K, n) N m, by the arm's model before identification.
        rms: (n,) N m, RMS of measured - predicted.
        model_rms: (n,) N m, RMS of measured - by_model.
        relative: (n,) rms divided by the standard deviation of the measured torque.
    """

    ok: bool
    reason: str
    t: Array
    measured: Array
    predicted: Array
    by_model: Array
    rms: Array
    model_rms: Array
    relative: Array

    def __str__(self) -> str:
        known = ", ".join(f"{100 * share:.1f}" for share in self.relative)
        return f"held-out torque error [{known}] % of its standard deviation" + (f"; {self.reason}" if self.reason else "")


@dataclass(frozen=True, slots=True, eq=False)
class ArmEstimate(IdentifiedArm):
    """The parameters of an arm, identified from a recording. True if the recording supports them.

    Single parameters of a link are partly without effect on any torque; those stay near the model's values. Base parameters are
    the combinations that torques depend on.

    Attributes:
        ok: Whether the motion excited all parameters that matter, and the prediction of held-out torques is good.
        reason: The reason if it is not ok; empty if it is.
        friction: The friction model: "none", "coulomb+viscous" or "stribeck".
        inertia: (n, 10) of the link behind each joint, in the frame of the joint in `arm.pinocchio_model`: m, m c (3), Ixx,
            Ixy, Iyy, Ixz, Iyz, Izz, in kg, kg m and kg m^2; inertia about the origin of that frame.
        inertia_error: (n, 10) standard errors; as large as the prior uncertainty if the motion does not excite them.
        consistent: (n,) bool, whether a rigid body can have these parameters.
        rotor_inertia: (n,) kg m^2, reflected to the joint (MuJoCo's armature).
        rotor_inertia_error: (n,) standard errors.
        viscous_friction: (n,) N m s/rad.
        viscous_error: (n,) standard errors.
        coulomb_friction: (n,) N m.
        coulomb_error: (n,) standard errors; as large as the prior uncertainty if no joint speed shows the full friction.
        breakaway: (n,) N m above Coulomb friction at low speed; 0 unless friction is "stribeck".
        friction_speeds: Dry friction is proportional to v / smoothing, clipped to [-1, 1]; breakaway decays as
            exp(-(v / stribeck)^2).
        torque_offset: (n,) N m, of the torque measurement; not a part of the model.
        delay: s, by which torques are recorded later than positions.
        cutoff: Hz, of the zero-phase filter, chosen from the data.
        base_names: Names of the base parameters, each by the parameter that leads the combination.
        base_values: Their values, SI units.
        base_errors: Their standard errors.
        unexcited: Names of relevant base parameters that the motion did not excite.
        condition_number: Of the regressor of the base parameters, with columns of equal length.
        findings: The largest differences from the arm's model, one sentence each.
        validation: Measured and predicted torques on held-out data.
    """

    ok: bool
    reason: str
    arm: Arm
    friction: str
    inertia: Array
    inertia_error: Array
    consistent: Array
    rotor_inertia: Array
    rotor_inertia_error: Array
    viscous_friction: Array
    viscous_error: Array
    coulomb_friction: Array
    coulomb_error: Array
    breakaway: Array
    friction_speeds: FrictionShape
    torque_offset: Array
    delay: float
    cutoff: float
    base_names: tuple[str, ...]
    base_values: Array
    base_errors: Array
    unexcited: tuple[str, ...]
    condition_number: float
    findings: tuple[str, ...]
    validation: Validation

    def __str__(self) -> str:
        lines = [f"{self.arm.name}: " + ("identified" if self.ok else f"not identified: {self.reason}")]
        lines.append(
            f"{len(self.base_names)} base parameters, condition number {self.condition_number:.3g}, "
            f"cut-off {self.cutoff:.3g} Hz, delay {1e3 * self.delay:.2f} ms"
        )
        lines.append(str(self.validation))
        lines += self.findings
        return "\n".join(lines)

    def friction_torque(self, v: Array) -> Array:
        """The torque that overcomes the identified friction.

        Args:
            v: (n,) rad/s.

        Returns:
            (n,) N m, viscous, Coulomb and breakaway friction together.

        Raises:
            InputError: v has another shape.
        """
        v = vector("v", v, self.arm.n)
        return self.viscous_friction * v + self._dry_friction(v)

    def _dry_friction(self, v: Array) -> Array:
        speeds = self.friction_speeds
        breakaway = self.breakaway * np.exp(-((v / speeds.stribeck) ** 2))
        return (self.coulomb_friction + breakaway) * np.clip(v / speeds.smoothing, -1.0, 1.0)

    def torque(self, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> Array:
        """The torque of a motion with the identified inertia, rotor inertia and all friction; no torque offset.

        Args:
            q: rad, (n,), or (T, n) for many states.
            v: rad/s, in the same shape.
            a: rad/s^2, in the same shape.

        Returns:
            N m, in the same shape.

        Raises:
            InputError: A wrong shape, a number that is not finite, or nothing was identified.
        """
        shapes = [as_array(name, value).shape for name, value in zip("qva", (q, v, a), strict=True)]
        shape = shapes[0]
        if len(shape) not in (1, 2) or shapes != [shape, shape, shape]:
            raise InputError(f"q, v, a: need three arrays of one shape, got {shapes[0]}, {shapes[1]} and {shapes[2]}")
        known = self.applied_to(self.arm)
        states = [
            [vector(name, row, self.arm.n) for row in np.atleast_2d(value)]
            for name, value in zip("qva", (q, v, a), strict=True)
        ]
        torques = [known.inverse_dynamics(*state) + self._dry_friction(state[1]) for state in zip(*states, strict=True)]
        return np.reshape(torques, shape)

    def _identified(self, arm: Arm) -> Arm:
        if not self.consistent.all():
            wrong = [name for name, fits in zip(self.arm.joint_names, self.consistent, strict=True) if not fits]
            raise InputError(f"estimate: no body can have the inertia behind {', '.join(wrong):.120}; use consistent=True")
        model = copy.copy(arm.model)
        consistent_model(arm, model, self.inertia)
        model.dof_armature[arm.dof_adr] = self.rotor_inertia
        if self.friction != "none":
            model.dof_damping[arm.dof_adr] = self.viscous_friction
        mujoco.mj_setConst(model, mujoco.MjData(model))
        if self.friction != "none":
            speed = self.friction_speeds.smoothing
            slope = np.where(speed > _MIN_SHAPE_SPEED, self.coulomb_friction / speed, 0.0)  # 0: by the joint's inertia
            set_dry_friction(model, arm.joint_map, self.coulomb_friction, slope)
        return with_model(arm, model)

    def to_dict(self) -> dict[str, object]:
        """The figures as plain values for JSON."""
        validation = self.validation
        parts = ("inertia", "consistent", "rotor_inertia", "viscous_friction", "coulomb_friction", "breakaway", "torque_offset")
        return {
            "ok": self.ok,
            "reason": self.reason,
            "robot": self.arm.name,
            "joints": list(self.arm.joint_names),
            "friction": self.friction,
            **{part: getattr(self, part).tolist() for part in parts},
            "delay_s": self.delay,
            "cutoff_hz": self.cutoff,
            "condition_number": self.condition_number,
            "unexcited": list(self.unexcited),
            "findings": list(self.findings),
            "held_out_rms": validation.rms.tolist(),
            "held_out_rms_of_model": validation.model_rms.tolist(),
            "held_out_relative": validation.relative.tolist(),
        }


def counted(names: tuple[str, ...]) -> str:
    """Names for a sentence, the first few of many."""
    if len(names) <= _MANY_NAMES:
        return ", ".join(names)
    return f"{', '.join(names[:_MANY_NAMES])} and {len(names) - _MANY_NAMES} more"
