"""Arm: n joints in series and one tip, inside a MuJoCo model whose arm actuators are torque motors."""

from __future__ import annotations

import copy
import html
import math
import threading
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from armctl import _core
from armctl.core import units
from armctl.core.errors import InputError, LimitError
from armctl.core.limits import Limits
from armctl.core.other_names import with_hints
from armctl.core.pose import Pose
from armctl.core.tables import Table
from armctl.core.validation import Array, IntArray, inertia_tensor, instance, matrix, number, vector
from armctl.model.arm.actuation import Actuation
from armctl.model.arm.arm_equations import ArmEquations
from armctl.model.arm.core_model import frames, tips
from armctl.model.arm.dynamics import Dynamics, core_model, make_dynamics
from armctl.model.arm.joint_map import JointMap
from armctl.model.arm.mechanics import Mechanics
from armctl.model.arm.pinocchio_model import PinocchioModel, TipFrame, build_pinocchio_model
from armctl.model.mjmodel.edit import add_payload
from armctl.model.mjmodel.queries import joints_above

_NOT_PICKLED = ("_thread_dynamics", "core_model")  # a process makes its own
_TWO_TURNS = 4.0 * math.pi  # rad (m)
_GEAR_ROUNDING = 1e-9  # relative, of a torque limit that was divided by a gear and multiplied by it


class Recipe(Protocol):
    """How a model was made from its file."""

    def model(self, edit: Callable[[mujoco.MjSpec], None]) -> mujoco.MjModel:
        """The model made once more, after an edit of the specification. All its elements are numbered as in the arm's."""
        ...


class _ThreadDynamics(threading.local):
    """Equations of motion for each thread: their scratch memory must not be shared."""

    def __init__(self, model: mujoco.MjModel, pinocchio_model: PinocchioModel, home_qpos: Array):
        self.dynamics = make_dynamics(model, pinocchio_model)
        self._arguments = (model, pinocchio_model, home_qpos)

    @cached_property
    def mechanics(self) -> Mechanics:
        return Mechanics(*self._arguments)


@dataclass(frozen=True, eq=False)
class Arm(ArmEquations):
    """An arm, or several that move together, such as two arms or the fingers of a hand.

    Returned by `armctl.load`; immutable, with read-only arrays.

    Arguments `q`, `v`, `a` and `tau` of its methods are (n,) positions, velocities, accelerations and torques of its joints.

    Attributes:
        name: The name it was loaded by.
        model: The compiled MuJoCo model; treat it as read-only: simulations copy it.
        actuation: Its n joints: names, limits, couplings, and addresses in the arrays of MuJoCo.
        tip: The name of the site, body or geom at the end; of several tips the first one.
        home: (n,) rad, the rest position.
        home_qpos: (nq,) the whole model at home; joints outside the chain are held there.
        home_ctrl: (nctrl,) the controls of the whole model at home; the arm's own are zero.
        notes: The assumptions made when it was loaded, one sentence each.
        sources: The source of each kind of limit, such as `{"tau_max": "forcerange"}`.
        default_limits: The kinds of limits that armctl chose, at least for some joints, because nothing says them.
        recipe: How its model was made, for plants with further elements; None for an arm of a compiled model.
        unchecked_links: The links of the robot without a collision shape that they need: as long as there are any, no motion is
            proved free of contact. Empty if contacts can be checked.
        further_tips: The tips besides the first one, of a robot with several.
        base: "fixed", or "planar" or "free" as `load` was asked for: then its first three or six joints move the base.
    """

    if not TYPE_CHECKING:
        __getattr__ = with_hints(
            {
                "inverse_kinematics": "armctl.solve_ik(arm, target)",
                "ik": "armctl.solve_ik(arm, target)",
                "solve_ik": "armctl.solve_ik(arm, target)",
                "forward_kinematics": "arm.fk(q)",
                "fkine": "arm.fk(q)",
                "ikine": "armctl.solve_ik(arm, target)",
                "jacob0": "arm.jacobian(q)",
                "jacob0_dot": "arm.jacobian_derivative(q, v)",
                "hessian0": "arm.jacobian_derivative(q, v), with a speed of 1 of one joint for each layer",
                "jacobm": "arm.manipulability(q)",
                "inertia": "arm.mass_matrix(q)",
                "crba": "arm.mass_matrix(q)",
                "M": "arm.mass_matrix(q)",
                "rne": "arm.inverse_dynamics(q, v, a)",
                "rnea": "arm.inverse_dynamics(q, v, a)",
                "nle": "arm.coriolis(q, v) @ v + arm.gravity(q)",
                "gravload": "arm.gravity(q)",
                "aba": "arm.forward_dynamics(q, v, tau)",
                "accel": "arm.forward_dynamics(q, v, tau)",
                "com": "arm.center_of_mass(q)",
                "qlim": "arm.limits",
                "dof": "arm.n",
                "nq": "arm.n",
                "nv": "arm.n",
            }
        )

    name: str
    model: mujoco.MjModel
    actuation: Actuation
    tip: str
    home: Array
    pinocchio_model: PinocchioModel
    home_qpos: Array
    home_ctrl: Array
    tip_body: int
    T_body_tip: Pose
    notes: tuple[str, ...]
    sources: dict[str, str]
    default_limits: frozenset[str]
    recipe: Recipe | None = None
    unchecked_links: tuple[str, ...] = ()
    further_tips: tuple[TipFrame, ...] = ()
    base: str = "fixed"

    @property
    def n(self) -> int:
        """How many joints it has."""
        return len(self.actuation.joint_names)

    @property
    def tips(self) -> tuple[str, ...]:
        """The names of all tips. Calls that take no tip mean the first one."""
        return (self.tip, *(each.name for each in self.further_tips))

    @property
    def tip_frames(self) -> tuple[TipFrame, ...]:
        """All tips, as frames in bodies of the model."""
        return (TipFrame(self.tip, self.tip_body, self.T_body_tip), *self.further_tips)

    def joints_to(self, tip: str) -> tuple[int, ...]:
        """Which of the n joints move a tip.

        Args:
            tip: Its name.

        Returns:
            Their indices in q, ascending.

        Raises:
            UnknownNameError: The arm has no such tip.
        """
        body = self.tip_frames[self._tip_number(tip)].body
        joints = np.array(joints_above(self.model, body))
        moved = self.joint_map.moved[np.isin(self.joint_map.joints, joints)].any(axis=0)
        return tuple(np.flatnonzero(moved).tolist())

    @cached_property
    def last_bodies(self) -> tuple[int, ...]:
        """For each tip, the body that the last of the joints to it moves: what is behind that body moves with the tip."""
        moved = self.moved_bodies
        found = []
        for frame in self.tip_frames:
            body = frame.body
            while body not in moved:
                body = int(self.model.body_parentid[body])
            found.append(body)
        return tuple(found)

    @cached_property
    def moved_bodies(self) -> frozenset[int]:
        """The bodies that carry the n joints, and the passive ones of closed loops."""
        return frozenset(self.model.dof_bodyid[self.joint_map.dof_adr[self.joint_map.moving_rows]].tolist())

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The n joints, from the base to the first tip, then those that move the other tips only."""
        return self.actuation.joint_names

    @property
    def joint_map(self) -> JointMap:
        """How the n joints move all joints that are coupled to them."""
        return self.actuation.joint_map

    @property
    def limits(self) -> Limits:
        """The limits of the n joints."""
        return self.actuation.limits

    @property
    def qpos_adr(self) -> IntArray:
        """(n,) addresses of the joints in `MjData.qpos`."""
        return self.actuation.qpos_adr

    @property
    def dof_adr(self) -> IntArray:
        """(n,) addresses of the joints in `MjData.qvel`."""
        return self.actuation.dof_adr

    @property
    def ctrl_adr(self) -> IntArray:
        """(n,) addresses of the joints' motors in `MjData.ctrl`."""
        return self.actuation.ctrl_adr

    @property
    def motor_torque_limits(self) -> Array:
        """(n,) N m, the largest torques in a simulation: `limits.tau_max`, or less where the model's motor is weaker."""
        own = np.abs(self.gear) * self.model.actuator_forcerange[self.actuation.motor_adr, 1]
        return np.where(self.limits.tau_max > own * (1 + _GEAR_ROUNDING), own, self.limits.tau_max)

    @property
    def gear(self) -> Array:
        """(n,) joint torque per unit of control."""
        return self.actuation.gear

    @property
    def dt(self) -> float:
        """The model's time step, s.

        Raises:
            InputError: It was changed to 0, a negative number or NaN.
        """
        return number("model.opt.timestep", self.model.opt.timestep, 1e-12)

    @property
    def units(self) -> tuple[str, ...]:
        """The unit of each joint: "rad", or "m" for a slide joint."""
        return self.actuation.units

    @property
    def torque_units(self) -> tuple[str, ...]:
        """The unit of each joint's torque: "N m", or "N" for a slide joint."""
        return self.actuation.torque_units

    def checked(self, what: str, q: ArrayLike, tolerance: float = 1e-9) -> Array:
        """Joint positions from a caller, checked.

        Args:
            what: The name of the argument, for the error.
            tolerance: rad by which they may be outside; such positions are clamped.

        Returns:
            (n,) rad, inside the limits.

        Raises:
            InputError: A wrong length or a number that is not finite.
            LimitError: A position outside its limits.
        """
        given = vector(what, q, self.n)
        low = self.limits.q_min
        high = self.limits.q_max
        if ((given >= low) & (given <= high)).all():
            return given if self.joint_map.closure is None else self._closed(what, given)
        margin = number("tolerance", tolerance, 0.0)
        outside = (given < low - margin) | (given > high + margin)
        if outside.any():
            i = int(outside.argmax())
            excess = float(max(low[i] - given[i], given[i] - high[i]))
            raise LimitError(f"{what}: {self._outside(i, float(given[i]))}{units.question(self.units[i], excess)}")
        inside = self.limits.clamp(given)
        return inside if self.joint_map.closure is None else self._closed(what, inside)

    def _closed(self, what: str, q: Array) -> Array:
        """Joint positions at which closed loops close, with passive joints in their limits; LimitError for others."""
        assert self.joint_map.closure is not None
        _, reason = self.joint_map.closure.first_refusal(q[None])
        if reason:
            raise LimitError(f"{what}: {reason}")
        return q

    def check_units(self, what: str, q: ArrayLike, remedy: str = "") -> None:
        """Refuses joint positions that are too far outside the limits to be rad or m, for calls that accept positions outside.

        Half a turn, or a metre, outside is taken for degrees, or millimetres.

        Args:
            what: The name of the argument, for the error.
            q: (n,), or an array (T, n), rad (m for a slide joint); NaN passes.
            remedy: What to do, for the error; by default how to convert them.

        Raises:
            InputError: A wrong number of columns.
            LimitError: A position is far outside its limits.
        """
        if isinstance(q, np.ndarray) and q.dtype == np.float64 and q.ndim in (1, 2) and q.shape[-1] == self.n:
            given = q if q.ndim == 2 else q[None]
        else:
            rows = q if isinstance(q, np.ndarray) and q.ndim == 2 else [vector(what, q, self.n, finite=False)]
            given = matrix(what, rows, self.n, finite=False)
        if ((given >= self.limits.q_min) & (given <= self.limits.q_max)).all():
            return
        excess = np.maximum(self.limits.q_min - given, given - self.limits.q_max)
        far = excess > units.far(self.units)
        if far.any():
            row = int(far.any(axis=1).argmax())
            i = int(far[row].argmax())
            question = units.question(self.units[i], float(excess[row, i]), remedy)
            raise LimitError(f"{what}: {self._outside(i, float(given[row, i]))}{question}")

    def _outside(self, i: int, value: float) -> str:
        low = self.limits.q_min[i]
        high = self.limits.q_max[i]
        unit = self.units[i]
        return f"{self.joint_names[i]}: {value:g} {unit} is outside [{low:.3f}, {high:.3f}] {unit}"

    def fk_many(self, q: ArrayLike, tip: str | None = None) -> tuple[Array, Array]:
        """Forward kinematics of many positions at once.

        Args:
            q: (T, n) rad.
            tip: One of `tips`; the first one if left out.

        Returns:
            Tip positions (T, 3) m and rotation matrices (T, 3, 3), in the world.

        Raises:
            UnknownNameError: The arm has no such tip.
        """
        given = matrix("q", q, self.n)
        if tip is None or tip == self.tip:
            return tips(self.core_model, given)
        return frames(self.core_model, given, *self.pinocchio_model.carried(self._tip_number(tip)))

    @property
    def _dynamics(self) -> Dynamics:
        return self._thread_dynamics.dynamics

    @property
    def _mechanics(self) -> Mechanics:
        return self._thread_dynamics.mechanics

    @cached_property
    def _thread_dynamics(self) -> _ThreadDynamics:
        return _ThreadDynamics(self.model, self.pinocchio_model, self.home_qpos)

    @cached_property
    def core_model(self) -> _core.ArmModel:
        """Its model for the compiled core, in continuous time, compared with Pinocchio at the first use."""
        return core_model(self.model, self.pinocchio_model)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in _NOT_PICKLED}

    def qpos(self, q: Array) -> Array:
        """The whole model's positions with the arm at q and all else at home.

        Returns:
            (nq,) for `MjData.qpos`.
        """
        qpos = self.home_qpos.copy()
        self.joint_map.set_positions(qpos, vector("q", q, self.n))
        return qpos

    def qvel(self, v: Array, q: Array | None = None) -> Array:
        """The whole model's speeds with the arm moving and all else at rest.

        Args:
            q: (n,) rad, where it moves: needed for an arm with closed loops only.

        Returns:
            (nv,) for `MjData.qvel`.
        """
        qvel = np.zeros(self.model.nv)
        at = None if q is None else vector("q", q, self.n)
        qvel[self.joint_map.dof_adr] = self.joint_map.speeds(vector("v", v, self.n), at)
        return qvel

    def with_limits(self, limits: Limits) -> Arm:
        """The same arm with other limits, such as lower speeds near people.

        The motors of its simulations obey a lower `tau_max`. Where `tau_max` is above what the model's motor gives, motions are
        planned with it, and the motor's own limit holds in simulation: `motor_torque_limits` has the smaller of both.

        Args:
            limits: The new limits of its n joints.

        Raises:
            InputError: The argument is no Limits, or has another number of joints.
        """
        instance("limits", limits, Limits, "dataclasses.replace(arm.limits, v_max=0.5 * arm.limits.v_max) returns one")
        if len(limits.q_min) != self.n:
            raise InputError(f"limits: expected {self.n} joints for {self.name:.80}, got {len(limits.q_min)}")
        return replace(self, actuation=replace(self.actuation, limits=limits))

    def with_payload(
        self,
        mass: float,
        center: ArrayLike = (0.0, 0.0, 0.0),
        inertia: ArrayLike = (0.0, 0.0, 0.0),
        *,
        tip: str | None = None,
        coulomb_friction: ArrayLike = 0.0,
        viscous_friction: ArrayLike = 0.0,
    ) -> Arm:
        """The same arm with a known payload at a tip: the model that a controller should use.

        Args:
            mass: kg, of a payload that is rigidly attached to the tip.
            center: (3,) m, its center of mass, in the tip's frame.
            inertia: kg m^2 about its center of mass, in the tip's axes: a (3, 3) matrix, or (3,) moments along the axes. Left
                out, the payload is a point mass.
            tip: The one of `tips` that carries it; the first one if left out.
            coulomb_friction: N m of dry friction added to the model's, on each joint or (n,) for each.
            viscous_friction: N m s/rad of damping added to the model's, on each joint or (n,) for each.

        Returns:
            The arm. A simulation of it carries the payload as well: do not give the plant the same payload again.

        Raises:
            InputError: The mass or the friction of a joint becomes negative, a number is not finite, a list has a wrong length,
                or no body has the inertia, or has it without a mass.
            UnknownNameError: The arm has no such tip.
        """
        frame = self.tip_frames[0 if tip is None else self._tip_number(tip)]
        model = copy.copy(self.model)
        for what, value, column in (
            ("coulomb_friction", coulomb_friction, model.dof_frictionloss),
            ("viscous_friction", viscous_friction, model.dof_damping),
        ):
            is_one = isinstance(value, (int, float)) or getattr(value, "ndim", 1) == 0
            added = np.full(self.n, number(what, value)) if is_one else vector(what, value, self.n)  # type: ignore[arg-type]
            total = column[self.dof_adr] + added
            if total.min() < 0.0:
                i = int(total.argmin())
                least = added[i] - total[i]
                raise InputError(f"{what}: {self.joint_names[i]:.60}: expected at least {least:g}, got {added[i]:g}")
            column[self.dof_adr] = total
        mass = number("mass", mass, 0.0)
        tensor = inertia_tensor("inertia", inertia)
        if mass > 0.0:
            add_payload(model, frame.body, frame.T_body_tip, mass, vector("center", center, 3), tensor)
        elif tensor.any():
            raise InputError("inertia: given for a payload without mass; give the mass in kg as well")
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return with_model(self, model)

    def __repr__(self) -> str:
        tips = f"tips {', '.join(map(repr, self.tips))}" if self.further_tips else f"tip {self.tip!r}"
        base = "" if self.base == "fixed" else f", {self.base} base"
        return f"Arm({self.name!r}, {self.n} joints, {tips}{base})"

    def _repr_html_(self) -> str:
        columns = {"home": self.home, **{f.name: getattr(self.limits, f.name) for f in fields(self.limits)}}
        rows = [
            [str(i), name, unit, *(f"{column[i]:.4g}" for column in columns.values())]
            for i, (name, unit) in enumerate(zip(self.joint_names, self.units, strict=True))
        ]
        page = f"<p>{html.escape(repr(self))}</p>"
        if self.further_tips:
            places = {tip: ", ".join(f"{x:.4g}" for x in self.fk(self.home, tip).position) for tip in self.tips}
            moving = {tip: ", ".join(map(str, self.joints_to(tip))) for tip in self.tips}
            tips = [[tip, places[tip], moving[tip]] for tip in self.tips]
            page += Table(["tip", "at home, m", "moved by q"], tips).html()
        return page + Table(["q", "joint", "unit", *columns], rows).html()


def with_model(arm: Arm, model: mujoco.MjModel) -> Arm:
    """An arm with another MuJoCo model of the same robot."""
    chain = arm.pinocchio_model.chain_length
    body = build_pinocchio_model(model, chain, arm.joint_map, arm.home_qpos, arm.tip_frames)
    return replace(arm, model=model, pinocchio_model=body)


def check_arm(arm: object) -> None:
    """Raises InputError if an argument is not an arm."""
    instance("arm", arm, Arm, f"armctl.load({arm if isinstance(arm, str) else 'panda'!r}) returns one")


def check_driven(arm: Arm) -> None:
    """Raises InputError for what is no arm, and for one on a free base, which no motor holds."""
    check_arm(arm)
    if arm.base == "free":
        raise InputError(
            f"arm: no motor holds the free base of {arm.name:.60}: its joints have kinematics, plans and timing, but no "
            "torques; load it with base='planar', or held, to simulate and control it"
        )


def check_one_tip(arm: Arm) -> None:
    """Raises InputError for what is no arm with one tip."""
    check_arm(arm)
    if arm.further_tips:
        names = ", ".join(map(repr, arm.tips))
        raise InputError(
            f"arm: it has the tips {names:.200}, and a pose is for one; load it with tip={arm.tip!r:.80}, or give joint "
            "positions, which move all"
        )
