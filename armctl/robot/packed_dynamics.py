"""The dynamics of an arm as one vector for compiled kernels, compared with Pinocchio before its first use."""

from __future__ import annotations

import mujoco
import numpy as np
import pinocchio as pin

from armctl.core.errors import ModelError
from armctl.core.validation import Array
from armctl.robot.dynamics import Dynamics, Integrator
from armctl.robot.passive_forces import DryFriction, PassiveForces
from armctl.robot.pinocchio_model import PinocchioModel

_TOLERANCE = 1e-9  # relative, as between Pinocchio and MuJoCo
_CHECKED_STATES = 3
_ROTATION_SIZE = 9


class PackedDynamics:
    """The vectors that `dynamics_kernel` reads, for any control period. Immutable."""

    def __init__(self, model: mujoco.MjModel, pinocchio_model: PinocchioModel):
        """Packs the dynamics of an arm, and compares the compiled kernels with Pinocchio.

        Args:
            model: The compiled MuJoCo model, `arm.model`.
            pinocchio_model: The arm's Pinocchio model, `arm.pinocchio_model`.

        Raises:
            ModelError: A compiled result differs from Pinocchio's.
        """
        joint_map = pinocchio_model.joint_map
        passive = PassiveForces(model, joint_map)
        friction = DryFriction.of(model, joint_map)
        integrator = Integrator.of(model)
        self.n = len(joint_map.leaders)
        self._joints = len(joint_map.joints)
        self._has_implicit_coriolis = integrator.implicit_coriolis and joint_map.is_plain
        self._has_implicit_nonlinear = self._has_implicit_coriolis or (
            integrator.implicit_damping and passive.has_nonlinear_damping
        )
        self._has_implicit_damping = integrator.implicit_damping and passive.is_damped
        drives = [
            pinocchio_model.pin_model.armature,
            passive.damping,
            passive.quadratic_damping,
            passive.cubic_damping,
            passive.damping * integrator.implicit_damping,
            friction.loss,
            friction.gain,
            friction.rate,
        ]
        self._header = _header(pinocchio_model, passive, friction)
        slides = model.jnt_type[list(joint_map.joints)] == int(mujoco.mjtJoint.mjJNT_SLIDE)
        rows = [_joint_row(pinocchio_model, passive, j, bool(slides[j])) for j in range(len(joint_map.joints))]
        self._rows = np.concatenate([*rows, np.column_stack(drives).ravel(), joint_map.ratio.ravel()])
        self._check(Dynamics(model, pinocchio_model), pinocchio_model)

    def vector(self, dt: float, continuous: bool = False) -> Array:
        """The model for a control period.

        Args:
            dt: s; 0 for continuous time.
            continuous: Whether the arm moves continuously during the period; if not, the period is one step of MuJoCo.

        Returns:
            A new vector for the functions of `dynamics_kernel`. It is writable: numba compiles again for read-only arrays.
        """
        from armctl.robot import dynamics_kernel as kernel

        header = self._header.copy()
        header[kernel.STEP] = 0.0 if continuous else dt
        header[kernel.HALF_STEP] = 0.5 * dt if continuous else 0.0
        header[kernel.IMPLICIT_NONLINEAR] = self._has_implicit_nonlinear
        header[kernel.IMPLICIT_CORIOLIS] = self._has_implicit_coriolis
        header[kernel.IMPLICIT_IN_VELOCITY] = self._has_implicit_nonlinear or self._has_implicit_damping
        return np.concatenate([header, self._rows])

    def work_size(self) -> int:
        """How many numbers of scratch memory the kernels need for this arm."""
        from armctl.robot import dynamics_kernel as kernel

        return int(self._header[kernel.JOINTS]) * kernel.WORK_COLUMNS + self.n * self.n + self.n

    def tips(self, q: Array) -> tuple[Array, Array]:
        """The tip at many positions.

        Args:
            q: (T, n) rad.

        Returns:
            Positions (T, 3) m, and quaternions (T, 4) wxyz with w >= 0, in the world.
        """
        from armctl.robot import tips_kernel as kernel

        positions = np.empty((len(q), 3))
        quats = np.empty((len(q), 4))
        work = np.empty(self.work_size() + _ROTATION_SIZE)
        scratch = np.empty(kernel.scratch_size(self._joints))
        kernel.tips(self.vector(0.0), np.require(q, requirements=["C", "W"]), scratch, work, positions, quats)
        return positions, quats

    def _check(self, dynamics: Dynamics, pinocchio_model: PinocchioModel) -> None:
        from armctl.robot.dynamics_check_kernel import evaluate

        rng = np.random.default_rng(0)
        packed = self.vector(0.0)
        work = np.zeros(self.work_size())
        tau = np.zeros(self.n)
        M = np.zeros((self.n, self.n))
        J = np.zeros((6, self.n))
        position = np.zeros(3)
        for _ in range(_CHECKED_STATES):
            q, v, a = rng.uniform(-1.0, 1.0, (3, self.n))
            evaluate(packed, q, v, a, work, tau, M, J, position)
            pairs = {
                "inverse dynamics": (tau, dynamics.inverse_dynamics(q, v, a)),
                "mass matrix": (M, dynamics.mass_matrix(q)),
                "tip Jacobian": (J, pinocchio_model.jacobian(q)),
                "tip position": (position, pinocchio_model.tip(q)[0]),
            }
            for what, (compiled, reference) in pairs.items():
                error = float(np.abs(compiled - reference).max() / max(1.0, np.abs(reference).max()))
                if not error <= _TOLERANCE:
                    raise ModelError(f"the compiled {what} differs by {error:.2g} from Pinocchio's (at most {_TOLERANCE:g})")


def _header(pinocchio_model: PinocchioModel, passive: PassiveForces, friction: DryFriction) -> Array:
    from armctl.robot import dynamics_kernel as kernel

    header = np.zeros(kernel.HEADER)
    header[kernel.JOINTS] = len(pinocchio_model.joint_map.joints)
    header[kernel.CHAIN_LENGTH] = pinocchio_model.chain_length
    header[kernel.IS_PLAIN] = pinocchio_model.joint_map.is_plain
    header[kernel.HAS_LIFT] = pinocchio_model.gravity_support is not None
    header[kernel.HAS_SPRINGS] = passive.has_springs
    header[kernel.HAS_FRICTION] = bool(friction.loss.any())
    header[kernel.GRAVITY : kernel.GRAVITY + 3] = pinocchio_model.pin_model.gravity.linear
    header[kernel.TIP : kernel.TIP + 9] = pinocchio_model.T_last_tip[:3, :3].ravel()
    header[kernel.TIP + 9 : kernel.TIP + 12] = pinocchio_model.T_last_tip[:3, 3]
    return header


def _joint_row(pinocchio_model: PinocchioModel, passive: PassiveForces, j: int, slides: bool) -> Array:
    """The row of a joint; joint j of the arm is joint j + 1 of Pinocchio, whose joint 0 is the world."""
    from armctl.robot import dynamics_kernel as kernel

    pin_model = pinocchio_model.pin_model
    placement = pin_model.jointPlacements[j + 1]
    body = pin_model.inertias[j + 1]
    row = np.zeros(kernel.JOINT_COLUMNS)
    row[kernel.PLACEMENT : kernel.PLACEMENT + 9] = placement.rotation.ravel()
    row[kernel.PLACEMENT + 9 : kernel.PLACEMENT + 12] = placement.translation
    row[kernel.IS_SLIDE] = slides
    row[kernel.PARENT] = pin_model.parents[j + 1] - 1
    row[kernel.MASS] = body.mass
    row[kernel.CENTER : kernel.CENTER + 3] = body.lever
    row[kernel.INERTIA : kernel.INERTIA + 6] = _six(body)
    if pinocchio_model.gravity_support is not None:
        lifted = pinocchio_model.gravity_support.inertias[j + 1]
        row[kernel.LIFTED_MASS] = lifted.mass
        row[kernel.LIFTED_MOMENT : kernel.LIFTED_MOMENT + 3] = lifted.mass * lifted.lever
    row[kernel.STIFFNESS : kernel.STIFFNESS + 3] = passive.stiffness[j]
    row[kernel.SPRING_REST] = passive.rest[j]
    row[kernel.OFFSET] = pinocchio_model.joint_map.offset[j]
    return row


def _six(body: pin.Inertia) -> Array:
    """The inertia about the center of mass as xx yy zz xy xz yz."""
    return body.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
