"""MPPI: sampling MPC of the tip on MuJoCo's own step, for contact tasks; and `push`, which brings an object to a pose.

G. Williams, A. Aldrich, E. A. Theodorou, "Model predictive path integral control: from theory to parallel computation", Journal
of Guidance, Control, and Dynamics 40(2), 2017.
"""

from __future__ import annotations

import copy
import inspect
import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypedDict, Unpack

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from armctl.core.errors import InputError
from armctl.core.faces import with_options
from armctl.core.pose import Pose
from armctl.core.result import Verdict
from armctl.core.validation import Array, instance, integer, matrix, number, vector
from armctl.model.arm.arm import Arm
from armctl.model.mjmodel.queries import body_named, placed
from armctl.plan.motion.torque_limits import InverseDynamics
from armctl.plan.motion.trajectory.joint_trajectory import JointTrajectory
from armctl.plan.motion.trajectory.piecewise import hermite
from armctl.run.sim.simulation import Simulation

_STEP_S = 0.004  # of the rollouts; contacts are then a little softer than those of the simulation
_SERVO_BANDWIDTH = 150.0  # rad/s, of the joints in the rollouts
_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
_MIN_ORIENTED = 5  # joints, with which the tip keeps the direction of its z axis
_ORTHONORMAL = 1e-6
_SHARE_OF_TOLERANCE = 0.9  # within which pushing ends: the object may creep a little further
_MIN_GAP_M = 1e-6
_LAST_WEIGHT = 0.5  # of the error at the end of the horizon
_APPROACH_WEIGHT = 0.2
_IK_STEPS = 3  # from each interval to the next
_IK_LENGTH_M = 0.2  # by which turns of the tip are converted to distances
_IK_DAMPING_M = 5e-3


class Rollouts(NamedTuple):
    """K simulated futures at H times.

    Attributes:
        model: The model that was simulated.
        qpos: (K, H, nq) of the model.
        tip: (K, H, 3) m.
    """

    model: mujoco.MjModel
    qpos: Array
    tip: Array

    def pose(self, body: str) -> tuple[Array, Array]:
        """Where a loose body is.

        Args:
            body: Its name.

        Returns:
            Its positions (K, H, 3), m, and quaternions (K, H, 4).

        Raises:
            InputError: The body is not loose.
            UnknownNameError: There is no such body.
        """
        first = _free_joint(self.model, body)
        return self.qpos[..., first : first + 3], self.qpos[..., first + 3 : first + 7]


class _RolloutModel:
    """The model of the rollouts: that of the arm, with a servo at each joint."""

    def __init__(self, arm: Arm, q: Array):
        """Servos with gains for the inertia of the joints at q, (n,) rad."""
        model = copy.copy(arm.model)
        model.opt.timestep = _STEP_S
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        actuator_of = {int(address): i for i, address in enumerate(model.actuator_ctrladr)}
        servos = np.array([actuator_of[int(address)] for address in arm.ctrl_adr])
        inertia = 1.0 / np.diag(np.linalg.inv(arm.mass_matrix(q)))
        self.model = model
        self._ctrl_adr = arm.ctrl_adr
        self._gear = arm.gear
        self._stiffness = _SERVO_BANDWIDTH**2 * inertia / self._gear**2
        model.actuator_gaintype[servos] = mujoco.mjtGain.mjGAIN_FIXED
        model.actuator_biastype[servos] = mujoco.mjtBias.mjBIAS_AFFINE
        model.actuator_dyntype[servos] = mujoco.mjtDyn.mjDYN_NONE
        model.actuator_ctrllimited[servos] = 0
        model.actuator_gainprm[servos, 0] = self._stiffness
        model.actuator_biasprm[servos, 1] = -self._stiffness
        model.actuator_biasprm[servos, 2] = -2.0 * self._stiffness / _SERVO_BANDWIDTH
        data = placed(model, arm.qpos(arm.home))
        mujoco.mj_comPos(model, data)
        mujoco.mj_transmission(model, data)
        self._length = data.actuator_length[servos] - self._gear * arm.home  # at q = 0, by a linear transmission
        self._ctrl = np.array(arm.home_ctrl)

    def controls(self, references: Array, rates: Array, torque: Array, count: int) -> Array:
        """(count, T, nu) for references (count T, n), their rates, and the torque that they need."""
        lead = 2.0 / _SERVO_BANDWIDTH * rates
        servo_ctrl = self._length + self._gear * (references + lead) + torque / self._gear / self._stiffness
        ctrl = np.tile(self._ctrl, (count, len(references) // count, 1))
        ctrl[:, :, self._ctrl_adr] = servo_ctrl.reshape(*ctrl.shape[:2], -1)
        return ctrl


class MPPI:
    """Sampling MPC for contact tasks: the tip takes the velocity that the best of many simulated futures have on average.

    A plan has one velocity of the tip for each interval of the horizon, in the directions of some axes; the joints follow, and
    with five of them or more the tip keeps the direction of its z axis. Random variations of the last plan are simulated with
    MuJoCo from the true state of everything, and averaged with weights that fall exponentially with their cost. The same seed
    gives the same bits with any number of threads.

    Attributes:
        simulation: The arm in its scene, and the controller that follows the plans.
        cost: The cost (K,) of K `Rollouts`.
        plans: How many plans were made.
    """

    def __init__(
        self,
        simulation: Simulation,
        cost: Callable[[Rollouts], Array],
        *,
        axes: ArrayLike = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
        speed: float = 0.15,
        horizon: float = 0.8,
        interval: float = 0.1,
        samples: int = 32,
        temperature: float = 0.1,
        seed: int = 0,
        threads: int | None = None,
    ):
        """A controller that begins where the arm is, which must be at rest.

        Args:
            simulation: The arm in its scene.
            cost: The cost (K,) of K futures.
            axes: (m, 3) directions in which the tip moves, orthonormal, in the world.
            speed: m/s, of the tip.
            horizon: s.
            interval: s, of one velocity, and from one plan to the next.
            samples: How many futures are simulated for a plan.
            temperature: Of the weights, relative to the mean cost above the least: less listens to fewer futures.
            seed: Of the variations.
            threads: How many threads simulate; by default one per core.

        Raises:
            InputError: An argument has a wrong type or value, or the springs of the plant's elastic joints are not in the arm.
        """
        instance("simulation", simulation, Simulation, "armctl.Simulation(arm) is one")
        arm = simulation.arm
        self.simulation = simulation
        self.cost = cost
        self.plans = 0
        self._axes = matrix("axes", axes, 3)
        if np.abs(self._axes @ self._axes.T - np.eye(len(self._axes))).max() > _ORTHONORMAL:
            raise InputError("axes: expected directions of length 1 at right angles, such as [[1, 0, 0], [0, 1, 0]]")
        if not callable(cost):
            raise InputError("cost: expected a function of Rollouts that returns one number for each of them")
        if simulation.data.qpos.shape != (arm.model.nq,):
            raise InputError("simulation: its plant has elastic joints, which the model of the arm does not have")
        self._speed = number("speed", speed, 1e-4)
        self._interval = number("interval", interval, 10 * _STEP_S, 1.0)
        self._samples = integer("samples", samples, 4)
        self._temperature = number("temperature", temperature, 1e-6)
        self._rng = np.random.default_rng(integer("seed", seed, 0))
        self._mean = np.zeros((max(2, round(number("horizon", horizon, interval) / interval)), len(self._axes)))
        self._velocity = np.zeros(len(self._axes))
        self._inverse_dynamics = InverseDynamics(arm)
        self._axis = simulation.tip.rotation[:, 2]
        self._q = np.array(simulation.state.q)
        self._v = np.zeros(arm.n)
        self._position = arm.fk(self._q).position
        self._rollout_model = _RolloutModel(arm, self._q)
        count = (os.cpu_count() or 1) if threads is None else integer("threads", threads, 1)
        from mujoco.rollout import Rollout

        self._data = [mujoco.MjData(self._rollout_model.model) for _ in range(count)]
        self._rollout = Rollout(nthread=count)

    def plan(self) -> JointTrajectory:
        """Plans the motion of the next interval, which begins with the position and velocity at the end of the last one."""
        horizon, axes = self._mean.shape
        self._mean = np.vstack([self._mean[1:], self._mean[-1:]])
        noise = self._rng.normal(size=(self._samples, horizon, axes))
        # Half of the samples keep their direction: they come far. The first one is the plan itself, the second one stops.
        noise[::2] = noise[::2, :1]
        samples = self._mean + 0.5 * self._speed * noise
        samples[0] = self._mean
        samples[1] = 0.0
        samples *= np.minimum(1.0, self._speed / np.maximum(np.linalg.norm(samples, axis=2, keepdims=True), 1e-12))
        cost = vector("cost", self.cost(self._simulated(samples)), self._samples)
        weights = np.exp(-(cost - cost.min()) / max(self._temperature * float(cost.mean() - cost.min()), 1e-300))
        self._mean = np.tensordot(weights / weights.sum(), samples, axes=1)
        self.plans += 1
        return self._next_motion()

    def run(self, until: Callable[[Simulation], bool], timeout: float) -> bool:
        """Plans and moves.

        Args:
            until: Whether to stop; asked before each plan.
            timeout: s of simulated time, after which it stops.

        Returns:
            The last answer of `until`.

        Raises:
            SimulationError: The arm diverged, or the controller failed.
        """
        ticks = max(1, round(self._interval / self.simulation.dt))
        for _ in range(int(np.ceil(number("timeout", timeout, 0.0) / self._interval))):
            if until(self.simulation):
                return True
            motion = self.plan()
            for k in range(ticks):
                state = self.simulation.measured_state
                self.simulation.step(self.simulation.controller.torque(state, motion(k * self.simulation.dt)))
        return until(self.simulation)

    def _simulated(self, velocities: Array) -> Rollouts:
        """The futures of velocities (K, H, axes) of the tip."""
        arm = self.simulation.arm
        count = len(velocities)
        before = np.concatenate([np.broadcast_to(self._velocity, (count, 1, velocities.shape[2])), velocities[:, :-1]], axis=1)
        tips = self._position + np.cumsum(0.5 * self._interval * (before + velocities), axis=1) @ self._axes
        q = self._joints(tips)
        nodes = np.concatenate([np.broadcast_to(self._q, (count, 1, arm.n)), q], axis=1)
        model = self._rollout_model.model
        steps = round(self._interval / model.opt.timestep)
        shares = (np.arange(steps) + 1.0)[:, None] / steps
        change = np.diff(nodes, axis=1)[:, :, None]
        references = (nodes[:, :-1, None] + shares * change).reshape(-1, arm.n)
        rates = np.repeat(change / self._interval, steps, axis=2).reshape(-1, arm.n)
        # What the servos need to move the arm without a lag is part of their controls.
        torque = self._inverse_dynamics.total(references, rates, np.zeros_like(rates))
        ctrl = self._rollout_model.controls(references, rates, torque, count)
        initial = np.empty(mujoco.mj_stateSize(model, _STATE))
        mujoco.mj_getState(model, self.simulation.data, initial, _STATE)
        states = np.asarray(self._rollout.rollout(model, self._data, np.tile(initial, (count, 1)), ctrl)[0], dtype=np.float64)
        qpos = states[:, steps // 2 - 1 :: steps // 2, 1 : 1 + model.nq]
        joints = qpos[:, :, arm.qpos_adr].reshape(-1, arm.n)
        return Rollouts(model, qpos, arm.fk_many(joints)[0].reshape(*qpos.shape[:2], 3))

    def _joints(self, tips: Array) -> Array:
        """Configurations (K, H, n) for positions of the tip (K, H, 3), each by damped least squares from the one before it."""
        arm = self.simulation.arm
        count, horizon, _ = tips.shape
        q = np.empty((count, horizon, arm.n))
        last = np.tile(self._q, (count, 1))
        for k in range(horizon):
            blocked = np.zeros(last.shape, dtype=bool)  # joints that would leave their range; the others make up for them
            for _ in range(_IK_STEPS):
                position, rotation = arm.fk_many(last)
                J = np.array([arm.jacobian(each) for each in last]) * ~blocked[:, None]
                error = tips[:, k] - position
                if arm.n >= _MIN_ORIENTED:
                    axis = rotation[:, :, 2]
                    J[:, 3:] -= axis[:, :, None] * (axis[:, None] @ J[:, 3:])
                    error = np.hstack([error, _IK_LENGTH_M * np.cross(axis, self._axis)])
                J = J[:, : error.shape[1]]
                J[:, 3:] *= _IK_LENGTH_M
                step = np.linalg.solve(J @ J.transpose(0, 2, 1) + _IK_DAMPING_M**2 * np.eye(error.shape[1]), error[:, :, None])
                moved = last + (J.transpose(0, 2, 1) @ step)[:, :, 0]
                last = arm.limits.clamp(moved)
                blocked |= last != moved
            q[:, k] = last
        return q

    def _next_motion(self) -> JointTrajectory:
        """The first interval of the plan."""
        arm = self.simulation.arm
        q = self._q
        v = self._v
        tip = self._position + 0.5 * self._interval * (self._velocity + self._mean[0]) @ self._axes
        self._velocity = self._mean[0]
        self._q = self._joints(tip[None, None])[0, 0]
        reached = arm.fk(self._q).position - self._position
        self._position = self._position + (self._axes @ reached) @ self._axes  # stays in the plane of the axes
        ahead = self._joints((self._position + self._interval * self._velocity @ self._axes)[None, None])[0, 0]
        self._v = np.clip((ahead - self._q) / self._interval, -arm.limits.v_max, arm.limits.v_max)
        rest = np.zeros((2, arm.n))
        pieces = hermite(np.array([0.0, self._interval]), np.array([q, self._q]), np.array([v, self._v]), rest)
        return JointTrajectory(*pieces, arm.joint_names, arm.limits, units=arm.units)


class MPPIOptions(TypedDict, total=False):
    """The options of `MPPI`, for `push`.

    Attributes:
        speed: m/s, of the tip.
        horizon: s.
        interval: s, of one velocity, and from one plan to the next.
        samples: How many futures are simulated for a plan.
        temperature: Of the weights, relative to the mean cost above the least.
        seed: Of the variations.
        threads: How many threads simulate; by default one per core.
    """

    speed: float
    horizon: float
    interval: float
    samples: int
    temperature: float
    seed: int
    threads: int | None


@dataclass(frozen=True)
class PushResult(Verdict):
    """What `push` reached. True if the object is at its goal.

    Attributes:
        ok: Whether both errors are within their tolerances.
        reason: Why not; empty if it is.
        position_error: m.
        angle_error: rad.
        duration: s of simulated time.
        plans: How many plans were made.
    """

    ok: bool
    reason: str
    position_error: float
    angle_error: float
    duration: float
    plans: int


_DEFAULTS = {name: inspect.signature(MPPI).parameters[name].default for name in MPPIOptions.__annotations__}


@with_options(MPPIOptions, _DEFAULTS)
def push(
    simulation: Simulation,
    body: str,
    goal: Pose,
    *,
    tolerance: float = 0.01,
    angle_tolerance: float = 0.1,
    timeout: float = 60.0,
    **options: Unpack[MPPIOptions],
) -> PushResult:
    """Pushes a loose object on a horizontal surface to a pose, with the tip at the height where it is.

    Args:
        simulation: The arm in its scene, at rest, its tip beside the object.
        body: The object.
        goal: Where it should be.
        tolerance: m.
        angle_tolerance: rad.
        timeout: s of simulated time, after which it stops.
        **options: Those of `MPPI`.

    Returns:
        What was reached; `simulation.log` has all ticks.

    Raises:
        InputError: An argument has a wrong type or value, or the body is not loose.
        UnknownNameError: There is no such body.
        SimulationError: The arm diverged, or the controller failed.
    """
    instance("simulation", simulation, Simulation, "armctl.Simulation(arm) is one")
    instance("goal", goal, Pose, "armctl.Pose([x, y, z], rpy=[0, 0, yaw]) is one")
    most = np.array([number("tolerance", tolerance, 1e-6), number("angle_tolerance", angle_tolerance, 1e-6)])
    cost = _PushCost(simulation.arm.model, body, goal)

    def errors() -> Array:
        place = simulation.data.body(body)
        return np.array(cost.errors(np.array(place.xpos), np.array(place.xquat)))

    mppi = MPPI(simulation, cost, **options)
    began = simulation.state.t
    is_there = mppi.run(lambda _: bool((errors() < _SHARE_OF_TOLERANCE * most).all()), timeout)
    gap, angle = errors().tolist()
    return PushResult(
        ok=is_there,
        reason="" if is_there else f"{body} is {1e3 * gap:.1f} mm and {angle:.2f} rad from its goal after {timeout:g} s",
        position_error=gap,
        angle_error=angle,
        duration=simulation.state.t - began,
        plans=mppi.plans,
    )


class _PushCost:
    """The mean distance of an object from its goal, and that of the tip from where it pushes."""

    def __init__(self, model: mujoco.MjModel, body: str, goal: Pose):
        self.body = body
        self.goal = goal
        _free_joint(model, body)
        self.radius = float(model.geom_rbound[model.geom_bodyid == body_named(model, body)].max())

    def errors(self, position: Array, quat: Array) -> tuple[Array, Array]:
        """The distances, m, and angles, rad, of poses (..., 3) and (..., 4) from the goal."""
        gap = np.linalg.norm(position - self.goal.position, axis=-1)
        return gap, 2.0 * np.arccos(np.clip(np.abs(quat @ self.goal.quat), 0.0, 1.0))

    def __call__(self, futures: Rollouts) -> Array:
        position, quat = futures.pose(self.body)
        gap, angle = self.errors(position, quat)
        error = np.sqrt(gap**2 + (self.radius * angle) ** 2)
        # The tip is drawn to a point inside the object, on the side away from the goal; less, the nearer the object is to it.
        away = (position - self.goal.position) / np.maximum(gap, _MIN_GAP_M)[..., None]
        approach = np.linalg.norm(futures.tip - position - 0.5 * self.radius * away, axis=-1)
        share = np.minimum(gap / self.radius, 1.0)
        return np.mean(error + _LAST_WEIGHT * error[:, -1:] + _APPROACH_WEIGHT * share * approach, axis=1)


def _free_joint(model: mujoco.MjModel, body: str) -> int:
    instance("body", body, str, "such as 'box'")
    joint = int(model.body_jntadr[body_named(model, body)])
    if joint < 0 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
        raise InputError(f"body: {body!r:.80} is not loose; give it a mass in the scene")
    return int(model.jnt_qposadr[joint])
