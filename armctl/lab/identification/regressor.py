"""The torques of an arm as a linear function of its parameters: inertia, rotor inertia, friction and offsets.

tau = inverse_dynamics(q, v, a) + W(q, v, a) (x - x_model)
"""

from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from armctl.core.errors import ModelError
from armctl.core.validation import Array, IntArray
from armctl.lab.identification.pseudo_inertia import PARAMETERS, pseudo_inertia
from armctl.model.arm.arm import Arm
from armctl.model.arm.dynamics import Dynamics
from armctl.model.mjmodel.queries import joint_name, last_joint_above

_INERTIAL_NAMES = ("mass", "m cx", "m cy", "m cz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
_JOINT_NAMES = ("rotor inertia", "viscous friction", "Coulomb friction")
_RELATIVE_PRIOR = 0.3  # standard deviation of a link's parameters before any data, relative to its mass and size
_MIN_MASS_SHARE = 0.02  # of the arm's mass: the least mass from which prior deviations follow
_MIN_LENGTH_M = 0.03
_FRICTION_PRIOR = 0.1  # of the torque limit, for Coulomb friction and offset, and for viscous friction at 1 rad/s
_ROTOR_PRIOR = 0.3  # of the joint's inertia
_QR_RANK_TOLERANCE = 1e-7  # of the QR factor's largest diagonal element
_STATES = 200  # random ones, from which structural properties and typical torques follow
_STATE_ACCELERATION = 5.0  # rad/s^2 (m/s^2)
_MAX_STATE_SPEED = 3.0  # rad/s (m/s)
_MAX_POSITION = np.pi  # rad (m), of joints without limits


class Layout(NamedTuple):
    """Where each kind of parameter is in the vector of all of them, for n joints."""

    n: int
    has_friction: bool
    has_stribeck: bool

    @property
    def size(self) -> int:
        return self.offset.stop

    @property
    def rotor(self) -> slice:
        return slice(PARAMETERS * self.n, (PARAMETERS + 1) * self.n)

    @property
    def viscous(self) -> slice:
        return self._next(self.rotor, self.has_friction)

    @property
    def coulomb(self) -> slice:
        return self._next(self.viscous, self.has_friction)

    @property
    def stribeck(self) -> slice:
        """Breakaway torque above Coulomb friction."""
        return self._next(self.coulomb, self.has_stribeck)

    @property
    def offset(self) -> slice:
        return self._next(self.stribeck, True)

    def link(self, i: int) -> slice:
        return slice(PARAMETERS * i, PARAMETERS * (i + 1))

    def _next(self, before: slice, present: bool) -> slice:
        return slice(before.stop, before.stop + self.n if present else before.stop)


class FrictionShape(NamedTuple):
    """The speeds at which friction changes, each (n,) rad/s."""

    smoothing: Array  # dry friction is proportional to v / smoothing, clipped to [-1, 1]
    stribeck: Array  # the breakaway torque decays as exp(-(v / stribeck)^2)


class ArmRegressor:
    """The regressor of an arm, the values of its parameters in the model, and how far they may be off."""

    def __init__(self, arm: Arm, friction: str):
        n = arm.n
        if not arm.joint_map.is_plain:
            followers = np.setdiff1d(np.arange(len(arm.joint_map.joints)), arm.joint_map.leaders)
            name = joint_name(arm.model, arm.joint_map.joints[followers[0]])
            raise ModelError(
                f"{name:.80}: it follows another joint, and there is no regressor for that; identify arms without it"
            )
        self.arm = arm
        self.layout = Layout(n, friction != "none", friction == "stribeck")
        self.dynamics = Dynamics(arm.model, arm.pinocchio_model)
        self._pin_model = arm.pinocchio_model.pin_model
        self._data = self._pin_model.createData()
        self._lifted = _lifted_shares(arm)
        self.model_values = self._model_values()
        self.start = self.model_values.copy()
        if self.layout.has_friction:
            self.start[self.layout.coulomb] = self.dynamics.friction_loss
        self.prior = self._prior()

    @property
    def names(self) -> tuple[str, ...]:
        joints = self.arm.joint_names
        names = [f"{what} behind {joint}" for joint in joints for what in _INERTIAL_NAMES]
        kinds = [_JOINT_NAMES[0]]
        if self.layout.has_friction:
            kinds += _JOINT_NAMES[1:]
        if self.layout.has_stribeck:
            kinds.append("breakaway torque")
        kinds.append("torque offset")
        return (*names, *(f"{what} of {joint}" for what in kinds for joint in joints))

    def rows(self, q: Array, v: Array, a: Array, shape: FrictionShape) -> Array:
        """W of many states, (T, n, p)."""
        layout = self.layout
        n = layout.n
        W = np.zeros((len(q), n, layout.size))
        zero = np.zeros(n)
        for k in range(len(q)):
            Y = pin.computeJointTorqueRegressor(self._pin_model, self._data, q[k], v[k], a[k]).reshape(n, -1)
            W[k, :, : PARAMETERS * n] = Y
            if self._lifted.any():
                Y = pin.computeJointTorqueRegressor(self._pin_model, self._data, q[k], zero, zero).reshape(n, -1)
                W[k, :, : PARAMETERS * n] -= Y * np.repeat(self._lifted, PARAMETERS)
        joints = np.arange(n)
        W[:, joints, layout.rotor.start + joints] = a
        W[:, joints, layout.offset.start + joints] = 1.0
        self.set_friction(W, v, self.dry_friction(v, shape))
        return W

    def set_friction(self, W: Array, v: Array, dry: Array) -> None:
        """Writes the columns of viscous friction at v, and those of `dry_friction`, into W."""
        layout = self.layout
        joints = np.arange(layout.n)
        if layout.has_friction:
            W[:, joints, layout.viscous.start + joints] = v
            W[:, joints, layout.coulomb.start + joints] = dry[:, :, 0]
        if layout.has_stribeck:
            W[:, joints, layout.stribeck.start + joints] = dry[:, :, 1]

    def dry_friction(self, v: Array, shape: FrictionShape) -> Array:
        """(T, n, 1 or 2): Coulomb friction, and with Stribeck friction the breakaway torque, for 1 N m of each."""
        sign = np.clip(v / shape.smoothing, -1.0, 1.0)
        if not self.layout.has_stribeck:
            return sign[:, :, None]
        return np.stack([sign, sign * np.exp(-((v / shape.stribeck) ** 2))], axis=2)

    def model_torques(self, q: Array, v: Array, a: Array) -> Array:
        """(T, n) N m by the model, without dry friction."""
        return np.array([self.dynamics.inverse_dynamics(*row) for row in zip(q, v, a, strict=True)])

    def random_states(self) -> tuple[Array, Array, Array]:
        """Positions, velocities and accelerations, each (200, n), over the whole range of the arm."""
        limits = self.arm.limits
        n = self.arm.n
        rng = np.random.default_rng(0)
        home = limits.clamp(self.arm.home)
        low = np.maximum(limits.q_min, home - _MAX_POSITION)
        high = np.minimum(limits.q_max, home + _MAX_POSITION)
        speed = np.minimum(limits.v_max, _MAX_STATE_SPEED)
        q = rng.uniform(low, high, (_STATES, n))
        return q, speed * rng.uniform(-1, 1, (_STATES, n)), _STATE_ACCELERATION * rng.uniform(-1, 1, (_STATES, n))

    def _model_values(self) -> Array:
        layout = self.layout
        values = np.zeros(layout.size)
        for i in range(layout.n):
            values[layout.link(i)] = self._pin_model.inertias[i + 1].toDynamicParameters()
        values[layout.rotor] = self._pin_model.armature
        if layout.has_friction:
            values[layout.viscous] = self.dynamics.damping
        return values

    def _prior(self) -> Array:
        layout = self.layout
        links = self.model_values[: PARAMETERS * layout.n].reshape(layout.n, PARAMETERS)
        least = _MIN_MASS_SHARE * max(float(links[:, 0].sum()), 1e-6)
        prior = np.empty(layout.size)
        for i, link in enumerate(links):
            mass = max(float(link[0]), least)
            length = max(np.sqrt(max(float(np.trace(pseudo_inertia(link)[:3, :3])), 0.0) / mass), _MIN_LENGTH_M)
            scale = np.concatenate([[mass], np.full(3, mass * length), np.full(6, mass * length**2)])
            prior[layout.link(i)] = _RELATIVE_PRIOR * scale
        inertia = np.diag(self.dynamics.mass_matrix(self.arm.limits.clamp(self.arm.home)))
        limits = self.arm.limits.tau_max
        strength = np.where(np.isfinite(limits), limits, self.torque_scale())
        rotor = np.maximum(_ROTOR_PRIOR * inertia, self.model_values[layout.rotor])
        prior[layout.rotor] = rotor
        if layout.has_friction:
            prior[layout.viscous] = np.maximum(_FRICTION_PRIOR * strength, self.dynamics.damping)
            prior[layout.coulomb] = np.maximum(_FRICTION_PRIOR * strength, self.dynamics.friction_loss)
        if layout.has_stribeck:
            prior[layout.stribeck] = _FRICTION_PRIOR * strength
        prior[layout.offset] = _FRICTION_PRIOR * strength
        return prior

    def torque_scale(self) -> Array:
        """(n,) N m, typical torques: those of random states by the model, at most the torque limits."""
        torques = self.model_torques(*self.random_states())
        rms = np.sqrt((torques**2).mean(axis=0))
        return np.minimum(np.maximum(rms, 1e-3 * max(float(rms.max()), 1e-9)), self.arm.limits.tau_max)


def pivoted_qr(W: Array) -> tuple[Array, IntArray, int]:
    """R and the order of the columns of a QR factorization with pivoting, and the rank."""
    from scipy.linalg import qr

    factors: Any = qr(W, mode="r", pivoting=True)
    R, order = factors
    diagonal = np.abs(np.diag(R))
    return R, np.asarray(order, dtype=np.int64), int((diagonal > _QR_RANK_TOLERANCE * diagonal[0]).sum())


def condition_number(W: Array) -> float:
    """The condition number with columns of equal length; infinite if a column is zero."""
    lengths = np.linalg.norm(W, axis=0)
    if not (lengths > 0).all():
        return float("inf")
    singular = np.linalg.svd(W / lengths, compute_uv=False)
    return float(singular[0] / singular[-1]) if singular[-1] > 0 else float("inf")


def _lifted_shares(arm: Arm) -> Array:
    """(n,) the share of each link's weight that MuJoCo's gravity compensation lifts."""
    shares = np.zeros(arm.n)
    if arm.pinocchio_model.gravity_support is None:
        return shares
    owners = np.asarray(last_joint_above(arm.model, arm.joint_map.joints))
    for i in range(arm.n):
        bodies = np.flatnonzero((owners == i) & (arm.model.body_mass > 0))
        lifted = arm.model.body_gravcomp[bodies]
        if len(lifted) and np.ptp(lifted) > 0:
            name = arm.joint_names[i]
            raise ModelError(f"{arm.name:.80}: gravity compensation lifts only a part of the link behind {name:.80}")
        shares[i] = lifted[0] if len(lifted) else 0.0
    return shares
