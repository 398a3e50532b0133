"""Equations of motion of an arm: mass matrix, Coriolis and gravity torques, inverse and forward dynamics.

    tau = M(q) a + bias(q, v) + passive(q, v) + friction(q, v, a)

Pinocchio computes M and bias; M includes armature. Passive forces are joint springs, damping and gravity compensation. The
compiled core computes what depends on the control period.
"""

from __future__ import annotations

from functools import cached_property

import mujoco
import numpy as np
import pinocchio as pin

from armctl import _core
from armctl.core.errors import ModelError
from armctl.core.validation import Array
from armctl.model.arm.core_model import inverse_dynamics, make_core_model, tips
from armctl.model.arm.passive_forces import DryFriction, PassiveForces, PassiveJoints
from armctl.model.arm.pinocchio_model import PinocchioModel
from armctl.model.mjmodel.queries import joint_name

_TOLERANCE = 1e-9  # relative, between the core and Pinocchio, as between Pinocchio and MuJoCo
# Rows and columns of a tensor's elements in the order of Pinocchio's parameters: xx, xy, yy, xz, yz, zz.
TENSOR_ELEMENTS = (np.array([0, 0, 1, 0, 1, 2]), np.array([0, 1, 1, 2, 2, 2]))
_CHECKED_STATES = 3

rnea = pin.rnea  # the innermost call of a control period: a look-up in the module takes a noticeable share of it


class Dynamics:
    """The equations of motion of an arm; everything outside its chain stands still.

    An object has its own scratch memory: use it in one thread at a time.
    """

    def __init__(self, model: mujoco.MjModel, pinocchio_model: PinocchioModel):
        joint_map = pinocchio_model.joint_map
        if type(self) is Dynamics:
            joint_map.require_no_loops()
        passive = PassiveForces(model, joint_map)
        self._joint_map = joint_map
        self._passive = passive
        self._dry_friction = DryFriction.from_model(model, joint_map)
        self.damping = passive.damping  # (n,) N m s/rad, linear viscous damping of the joints
        self.friction_loss = self._dry_friction.loss  # (n,) N m, dry friction of the joints
        self._model = pinocchio_model.pin_model
        self._data = self._model.createData()
        # In LOCAL, the faster one, Pinocchio adds mimic joints to what an earlier call left behind.
        self._convention = pin.Convention.LOCAL if joint_map.is_plain else pin.Convention.WORLD
        self._gravity_support = pinocchio_model.gravity_support
        self._support_data = self._gravity_support.createData() if self._gravity_support is not None else None
        self._models = (model, pinocchio_model)
        self._step: tuple[float, _core.ArmModel] | None = None  # the control period, s, of the last step, and the core's model
        self._payload_basis = _payload_basis(pinocchio_model.T_last_tip)
        followers = np.setdiff1d(np.arange(len(joint_map.joints)), joint_map.leaders)
        self._is_upper = np.triu(np.ones((len(joint_map.leaders), len(joint_map.leaders)), bool))
        self._followers = tuple(joint_name(model, joint_map.joints[k]) for k in followers)

    def mass_matrix(self, q: Array) -> Array:
        """M(q) with armature, (n, n) kg m^2, symmetric."""
        M = pin.crba(self._model, self._data, q, self._convention)  # guarantees the upper triangle only
        return np.where(self._is_upper, M, M.T)

    def bias(self, q: Array, v: Array) -> Array:
        """Coriolis, centrifugal and gravity torques, MuJoCo's `qfrc_bias`, (n,) N m."""
        return pin.nonLinearEffects(self._model, self._data, q, v).copy()

    def gravity(self, q: Array) -> Array:
        """The torque that holds the arm at rest: gravity minus gravity compensation, plus springs; (n,) N m."""
        tau = pin.computeGeneralizedGravity(self._model, self._data, q).copy()
        return self._with_position_forces(tau, q)

    def inverse_dynamics(self, q: Array, v: Array, a: Array) -> Array:
        """Torque for an acceleration in continuous time, without dry friction; (n,) N m."""
        tau = rnea(self._model, self._data, q, v, a)
        if self._passive.is_damped:
            tau = tau + self._passive.damping_torque(v)
        return self._with_position_forces(tau, q)

    def discrete_inverse_dynamics(self, q: Array, v: Array, a: Array, dt: float) -> Array:
        """Inverse of MuJoCo's discrete step: the torque for which (v_next - v) / dt is exactly a; no dry friction; (n,) N m.

        This is what `mj_inverse` computes with `mjENBL_INVDISCRETE`. RK4 has no such inverse: it gets the continuous one.
        With dt = 0 this is `inverse_dynamics`.
        """
        if not dt:
            return self.inverse_dynamics(q, v, a)
        if self._step is None or self._step[0] != dt:  # it rarely changes between calls
            self._step = (dt, self._core_model.for_period(dt, False))
        return inverse_dynamics(self._step[1], q[None], v[None], a[None])[0]

    def forward_dynamics(self, q: Array, v: Array, tau: Array) -> Array:
        """Acceleration in continuous time, without dry friction: the inverse of `inverse_dynamics`; (n,) rad/s^2."""
        return self._solve_mass_matrix(q, tau - self.inverse_dynamics(q, v, np.zeros_like(v)))

    def payload_regressor(self, q: Array, v: Array, a: Array) -> Array:
        """(n, 10): the first four times [m, m cx, m cy, m cz] are the torque of a point mass m at c in the tip's frame.

        The last six times [Ixx, Ixy, Iyy, Ixz, Iyz, Izz] are that of an inertia about c in the tip's axes. The inertia m c c^T
        about the tip is not linear in m and m c and is left out: it is small if c is. ModelError if a joint of the arm follows
        another: Pinocchio has no regressor for that.
        """
        if self._followers:
            raise ModelError(f"{self._followers[0]}: no payload can be identified where one joint follows another")
        regressor = pin.computeJointTorqueRegressor(self._model, self._data, q, v, a)
        return regressor.reshape(len(q), -1)[:, -10:] @ self._payload_basis

    def friction(self, v: Array, a: Array) -> Array:
        """The torque that overcomes dry friction in continuous time, by MuJoCo's law (`DryFriction`); (..., n) N m."""
        return self._dry_friction.torque(v, a)

    def explicit_acceleration(self, q: Array, v: Array, a: Array, dt: float) -> Array:
        """The acceleration before forces that are implicit in velocity, on which dry friction acts; (n,) rad/s^2.

        Where damping is large and inertia small, it is many times the acceleration of the step.
        """
        if not dt:
            return a
        continuous = inverse_dynamics(self._core_model, q[None], v[None], a[None])[0]  # without implicit forces the same bits
        implicit = self.discrete_inverse_dynamics(q, v, a, dt) - continuous
        return a + self._solve_mass_matrix(q, implicit) if implicit.any() else a

    @cached_property
    def _core_model(self) -> _core.ArmModel:
        return core_model(*self._models)

    def _solve_mass_matrix(self, q: Array, tau: Array) -> Array:
        """M(q)^-1 tau."""
        if not self._joint_map.is_plain:  # Pinocchio does not factorize M with mimic joints
            return np.asarray(np.linalg.solve(self.mass_matrix(q), tau), dtype=np.float64)
        pin.crba(self._model, self._data, q)
        pin.cholesky.decompose(self._model, self._data)
        return pin.cholesky.solve(self._model, self._data, tau)

    def _with_position_forces(self, tau: Array, q: Array) -> Array:
        """A torque plus that of the springs, minus gravity compensation."""
        if self._passive.has_springs:
            tau = tau + self._passive.spring_torque(q)
        if self._gravity_support is not None:
            tau = tau - self._support(q)
        return tau

    def _support(self, q: Array) -> Array:
        """The torque of gravity on what gravity compensation lifts, (n,) N m."""
        return pin.computeGeneralizedGravity(self._gravity_support, self._support_data, q)


class ClosedDynamics(Dynamics):
    """The same of an arm with closed loops, from those of its tree of m joints.

    With the positions p(q) of all joints, their speeds J v and accelerations J a + c, torques of the tree become those of the
    arm by J^T. Source: Featherstone, Rigid Body Dynamics Algorithms (2008), section 8.
    """

    def __init__(self, model: mujoco.MjModel, pinocchio_model: PinocchioModel):
        super().__init__(model, pinocchio_model)
        self._passive_joints = PassiveJoints(model, self._joint_map)
        self._all_joints = np.triu(np.ones((len(self._joint_map.joints),) * 2, bool))

    def mass_matrix(self, q: Array) -> Array:
        """As that of a tree."""
        M = pin.crba(self._model, self._data, self._joint_map.positions(q), pin.Convention.WORLD)
        ratio = self._joint_map.ratio_at(q)
        return ratio.T @ np.where(self._all_joints, M, M.T) @ ratio

    def bias(self, q: Array, v: Array) -> Array:
        """Coriolis, centrifugal and gravity torques, (n,) N m."""
        return self._rigid(q, v, np.zeros_like(v))[0]

    def gravity(self, q: Array) -> Array:
        """As that of a tree."""
        zero = np.zeros_like(q)
        return self._with_position_forces(self._rigid(q, zero, zero)[0], q)

    def inverse_dynamics(self, q: Array, v: Array, a: Array) -> Array:
        """As that of a tree."""
        tau, ratio = self._rigid(q, v, a)
        tau = tau + self._passive.damping_torque(v) + self._passive_joints.damping_torque(ratio @ v) @ ratio
        return self._with_position_forces(tau, q)

    def payload_regressor(self, q: Array, v: Array, a: Array) -> Array:
        """ModelError: Pinocchio has no regressor of a closed loop."""
        assert self._joint_map.closure is not None
        raise ModelError(self._joint_map.closure.refusal)

    def _rigid(self, q: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """The torque (n,) that moves the masses, and the speeds (m, n) of all joints per speed of the driven ones."""
        joint_map = self._joint_map
        ratio = joint_map.ratio_at(q)
        tau = rnea(self._model, self._data, joint_map.positions(q), ratio @ v, joint_map.accelerations(a, q, v))
        return tau @ ratio, ratio

    def _support(self, q: Array) -> Array:
        all_positions = self._joint_map.positions(q)
        lifted = pin.computeGeneralizedGravity(self._gravity_support, self._support_data, all_positions)
        return lifted @ self._joint_map.ratio_at(q)


def make_dynamics(model: mujoco.MjModel, pinocchio_model: PinocchioModel) -> Dynamics:
    """The equations of motion of an arm, with or without closed loops."""
    kind = Dynamics if pinocchio_model.joint_map.closure is None else ClosedDynamics
    return kind(model, pinocchio_model)


def core_model(model: mujoco.MjModel, pinocchio_model: PinocchioModel) -> _core.ArmModel:
    """The model of an arm for the compiled core, in continuous time; `for_period` makes that of a control period.

    ModelError if the core's dynamics differ from Pinocchio's.
    """
    core = make_core_model(model, pinocchio_model)
    _check(core, make_dynamics(model, pinocchio_model), pinocchio_model)
    return core


def _check(core: _core.ArmModel, dynamics: Dynamics, pinocchio_model: PinocchioModel) -> None:
    n = core.n
    tau = np.zeros(n)
    M = np.zeros((n, n))
    J = np.zeros((6, n))
    rng = np.random.default_rng(0)
    closure = pinocchio_model.joint_map.closure
    for _ in range(_CHECKED_STATES):
        q, v, a = rng.uniform(-1.0, 1.0, (3, n))
        if closure is not None:
            q = closure.near_reference(q)
        _core.inverse_dynamics(core, q[None], v[None], a[None], tau[None])
        _core.mass_matrices(core, q[None], M.reshape(1, -1))
        _core.tip_jacobians(core, q[None], J.reshape(1, -1))
        pairs = {
            "inverse dynamics": (tau, dynamics.inverse_dynamics(q, v, a)),
            "mass matrix": (M, dynamics.mass_matrix(q)),
            "tip Jacobian": (J, pinocchio_model.jacobian(q)),
            "tip position": (tips(core, q[None])[0][0], pinocchio_model.tip(q)[0]),
        }
        for what, (result, reference) in pairs.items():
            error = float(np.abs(result - reference).max() / max(1.0, np.abs(reference).max()))
            if not error <= _TOLERANCE:
                raise ModelError(f"the core's {what} differs by {error:.2g} from Pinocchio's (at most {_TOLERANCE:g})")


def _payload_basis(T_last_tip: Array) -> Array:
    """(10, 10): Pinocchio's ten inertial parameters in the last joint's frame from m, m c and the inertia about c in the tip's.

    With p = r + R c, a point mass has first moment m p and second moment S = m p p^T, of which I = tr(S) 1 - S. An inertia I
    about c is R I R^T in the last joint's axes, wherever c is.
    """
    R = T_last_tip[:3, :3]
    r = T_last_tip[:3, 3]
    basis = np.zeros((10, 10))
    for k in range(4):
        m = 1.0 if k == 0 else 0.0
        h = np.zeros(3) if k == 0 else R[:, k - 1]
        S = m * np.outer(r, r) + np.outer(r, h) + np.outer(h, r)
        inertia = np.trace(S) * np.eye(3) - S
        basis[:, k] = [m, *(m * r + h), *inertia[TENSOR_ELEMENTS]]
    for k, (i, j) in enumerate(zip(*TENSOR_ELEMENTS, strict=True)):
        inertia = np.zeros((3, 3))
        inertia[[i, j], [j, i]] = 1.0
        basis[4:, 4 + k] = (R @ inertia @ R.T)[TENSOR_ELEMENTS]
    return basis
