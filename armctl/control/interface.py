"""The interface of a controller: torque from state and setpoint."""

from __future__ import annotations

import copy
import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, Self, TypeGuard, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from armctl import _core
from armctl.core.errors import InputError
from armctl.core.faces import face, gains_of, show_arguments
from armctl.core.other_names import check_keywords
from armctl.core.trajectory import Setpoint, TickReference
from armctl.core.validation import Array, as_array, flag, instance, integer, number, shown, vector
from armctl.model.arm.arm import Arm, check_arm

WRENCH_SIZE = 6
MAX_PERIOD_S = 1.0  # of control
MAX_JOINTS = 1000
_NO_WRENCH = np.zeros(0)
_STATE_HINT = "armctl.State(q, v) is one"


class State(NamedTuple):
    """The measurements of a controller at a tick.

    Attributes:
        q: (n,) measured positions, rad.
        v: (n,) measured velocities, rad/s.
        t: Time, s.
        dt: The control period, s, during which the torque is held constant; 0 means continuous time.
        continuous: Whether the arm moves continuously during the control period, as a real arm does. If False, the control
            period is one step of the simulator.
        wrench: (6,) N and N m, the measured wrench of the environment on the tip: force first, world axes, at the tip. None if
            nobody measures it: a simulation does for controllers with the attribute `needs_wrench = True`.
        deflection: (2, n) rad and rad/s, of the springs of elastic joints, motor minus link, as joint torque sensors give it.
            None if nobody measures it: a simulation does for controllers with the attribute `needs_deflection = True`.
    """

    q: Array
    v: Array
    t: float = 0.0
    dt: float = 0.0
    continuous: bool = False
    wrench: Array | None = None
    deflection: Array | None = None


@runtime_checkable
class Controller(Protocol):
    """Any object with a method `torque`. It may have the attributes of `Traits`, too; reports show its `name`.

    A controller with memory resets it if `state.t` is not one `state.dt` later than in the previous call.
    """

    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque for the coming control period.

        Args:
            setpoint: Where the arm should be.

        Returns:
            (n,) N m; the simulation clips it to the arm's limits.
        """
        ...


class Traits(NamedTuple):
    """What a controller is besides its torque. Each is read from the controller's attribute of the same name, if it has one.

    Attributes:
        name: In reports; by default that of the class.
        needs_wrench: Whether it reads `State.wrench`.
        needs_deflection: Whether it reads `State.deflection`.
        foresee: Takes the reference of the coming ticks before each call of `torque`; None if the controller does not plan.
        yields: Whether the arm leaves its reference by design, as under impedance control.
        applied: Takes the torques (n,) N m that the motors got, where they are not those of the last call of `torque`, such as
            within a robot's limit of their rate; None if the controller does not care.
    """

    name: str
    needs_wrench: bool = False
    needs_deflection: bool = False
    foresee: Callable[[TickReference], None] | None = None
    yields: bool = False
    applied: Callable[[Array], None] | None = None


class ControllerWrapper:
    """A controller that runs others, and is besides its torque what they are.

    Attributes:
        traits: Those of the controller that it runs, or of all together.
    """

    traits: Traits


def traits(controller: object) -> Traits:
    """What a controller is besides its torque."""
    if isinstance(controller, ControllerWrapper):
        return controller.traits
    return Traits(
        name=getattr(controller, "name", type(controller).__name__),
        needs_wrench=getattr(controller, "needs_wrench", False),
        needs_deflection=getattr(controller, "needs_deflection", False),
        foresee=getattr(controller, "foresee", None),
        yields=getattr(controller, "yields", False),
        applied=getattr(controller, "applied", None),
    )


def has_torque(given: object) -> TypeGuard[Controller]:
    """Whether an object is a controller; a class of controllers is none."""
    return not isinstance(given, type) and callable(getattr(given, "torque", None))


class Clock:
    """Tells a controller with memory whether a tick directly follows the previous one."""

    def __init__(self) -> None:
        """A clock that has not seen any tick."""
        self._next = math.nan

    def follows(self, state: State) -> bool:
        """Whether a state is one control period later than the state of the previous call; False in the first call."""
        follows = abs(state.t - self._next) <= 0.5 * state.dt
        self._next = state.t + state.dt
        return follows

    def expect(self, t: float) -> None:
        """Sets the time of the next tick, s, after ticks that this clock did not see."""
        self._next = t


def checked_period(dt: float, continuous: bool) -> tuple[float, bool]:
    """The arguments of `CompiledController.make_law`, checked."""
    return number("dt", dt, 0.0, MAX_PERIOD_S), flag("continuous", continuous)


_TorqueMethod = TypeVar("_TorqueMethod", bound=Callable[..., Array])


def explains_wrong_arguments(torque: _TorqueMethod) -> _TorqueMethod:
    """Decorates a `torque` method: a call with wrong arguments raises an InputError.

    The arguments are checked only after an exception, because a controller runs in every tick.
    """

    @functools.wraps(torque)
    def torque_or_input_error(controller: Any, state: State, setpoint: Setpoint) -> Array:
        try:
            return torque(controller, state, setpoint)
        except (AttributeError, TypeError, ValueError):
            _check_arguments(state, setpoint)
            raise

    return torque_or_input_error  # type: ignore[return-value]


class CompiledController(ABC):
    """A controller whose law is one object of the compiled core, which `torque` and the tick loop of a simulation both call.

    A simulation then runs all ticks without Python, and many runs on several threads. The gains that armctl's controllers take
    are attributes of the same names, and may be assigned between runs. A subclass that overrides `torque` is called
    at every tick, like a controller without a compiled law.

    A law of your own is a C function, for example one that `numba.cfunc` compiles: `make_law` then returns an
    `armctl.CFunctionLaw`.
    """

    needs_wrench = False

    def __init__(self, n: int):
        """A controller at the start of a run.

        Args:
            n: The number of joints.
        """
        self._n = integer("n", n, 1, MAX_JOINTS)
        self._clock = Clock()
        self._law: _core.Law | None = None
        self._period: tuple[float, bool] | None = None
        self._ahead: tuple[Array, ...] = ()  # the reference of the next ticks, of a law that plans

    def __init_subclass__(cls, **keywords: Any) -> None:
        """A class of controllers, whose signature has the arguments of its constructor."""
        super().__init_subclass__(**keywords)
        show_arguments(cls)

    def __setattr__(self, name: str, value: object) -> None:
        """Sets an attribute; a public one is a gain, so the law is made anew, with the same memory, when it is next needed."""
        object.__setattr__(self, name, value)
        if not name.startswith("_"):
            object.__setattr__(self, "_period", None)

    def __repr__(self) -> str:
        return face(self, **gains_of(self))

    @property
    def n(self) -> int:
        """The number of joints."""
        return self._n

    @abstractmethod
    def make_law(self, dt: float, continuous: bool) -> _core.Law:
        """A law with the present gains, at the start of a run.

        Args:
            dt: s, the control period; 0 means continuous time.
            continuous: Whether the arm moves continuously during the control period.
        """

    @property
    def is_compiled(self) -> bool:
        """Whether the compiled law is the whole law, so that a simulation need not call `torque`."""
        return type(self).torque is CompiledController.torque and "torque" not in vars(self) and not self.is_time_varying

    @property
    def is_time_varying(self) -> bool:
        """Whether `begin` has to be called in every tick, because the gains depend on the time."""
        return False

    @property
    def memory(self) -> Array:
        """What the law keeps from tick to tick, which may be written; empty before the first tick."""
        return np.zeros(0) if self._law is None else self._law.memory

    def applied(self, tau: ArrayLike) -> None:
        """Takes the torques that the motors got, where they are not those of the last call of `torque`.

        A law that estimates the motion expects what these torques do; without a call of `torque` before, nothing is done.

        Args:
            tau: (n,) N m.

        Raises:
            InputError: A wrong shape, or a number that is not finite.
        """
        torques = vector("tau", tau, self._n)
        if self._law is not None:
            self._law.applied(torques)

    def fresh(self) -> Self:
        """The same law with a memory of its own, for a run at the same time."""
        other = copy.copy(self)
        other._clock = Clock()
        return other

    def __getstate__(self) -> dict[str, Any]:
        """The state of a copy, or of one in another process: it begins a run."""
        return self.__dict__ | {"_law": None, "_period": None}

    def begin(self, state: State) -> _core.Law:
        """Prepares for a tick.

        Args:
            state: The measured state. The memory is reset unless this state follows that of the previous tick.

        Returns:
            The law, until a gain or the control period changes.

        Raises:
            InputError: It is no `State`, its control period is no number in [0, 1] s, or `make_law` gives no law for
                these joints.
        """
        instance("state", state, State, _STATE_HINT)
        law = self.law_for(state.dt, state.continuous)
        if not self._clock.follows(state):
            law.reset()
        return law

    def law_for(self, dt: float, continuous: bool) -> _core.Law:
        """The law for a control period: the present one, or a new one with its memory.

        Args:
            dt: s, the control period; 0 means continuous time.
            continuous: Whether the arm moves continuously during the control period.

        Raises:
            InputError: The period is no number in [0, 1] s, or `make_law` gives no law for these joints.
        """
        period = (dt, continuous)
        if self._law is None or self._period != period:
            return self._replace_law(self.make_law(*checked_period(*period)), period)
        return self._law

    def _replace_law(self, law: _core.Law, period: tuple[float, bool]) -> _core.Law:
        """Takes a law for a control period, and gives it the memory of the present one."""
        if not isinstance(law, _core.Law):
            raise InputError(f"make_law: expected a law, such as armctl.CFunctionLaw, got {shown(law)}")
        if law.n != self._n:
            raise InputError(f"make_law: expected a law for {self._n} joints, got one for {law.n}")
        if law.needs_wrench and not self.needs_wrench:
            raise InputError(f"needs_wrench: the law of {traits(self).name} reads the wrench; set it to True in the class")
        if self._law is not None and law.memory.shape == self._law.memory.shape:
            law.memory[:] = self._law.memory
        self._law = law
        self._period = period
        return law

    def _take_ahead(self) -> tuple[Array, ...]:
        """The reference of the next ticks, for one call of the law; empty unless somebody gave it."""
        ahead = self._ahead
        self._ahead = ()
        return ahead

    def finish(self, t: float) -> None:
        """Notes that the law computed further ticks without `begin`.

        Args:
            t: s, the time of the next tick.
        """
        self._clock.expect(number("t", t))

    @explains_wrong_arguments
    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque for the coming control period.

        Returns:
            (n,) N m.

        Raises:
            InputError: An argument is no `State` or no `Setpoint`, a vector has a wrong length, or the state has no wrench and
                the controller needs one.
        """
        n = self._n
        sampled = setpoint.v_tick is not None and setpoint.a_tick is not None
        columns = (
            state.q,
            state.v,
            setpoint.q,
            setpoint.v,
            setpoint.a,
            setpoint.v_tick if sampled else setpoint.v,
            setpoint.a_tick if sampled else setpoint.a,
        )
        rows = np.empty((8, n))
        for k, column in enumerate(columns):
            if len(column) != n:  # type: ignore[arg-type]
                raise InputError(f"state and setpoint: every vector needs {n} numbers, one has {len(column)}")  # type: ignore[arg-type]
            rows[k] = column
        law = self.begin(state)
        wrench = measured_wrench(state, traits(self).name) if self.needs_wrench else _NO_WRENCH
        tau = rows[7]
        reference = rows[2:7]
        ahead = self._take_ahead()
        if ahead:
            reference = np.vstack([reference, *ahead])
        law.torque(rows[0], rows[1], reference, wrench, tau)
        return tau


class ArmController(CompiledController):
    """The base of armctl's own controllers, for an arm."""

    def __new__(cls, *args: object, **keywords: object) -> Self:
        """A controller, not yet constructed; a TypeError says which keyword it does not take."""
        check_keywords(cls, keywords)
        return super().__new__(cls)

    def __init__(self, arm: Arm):
        """A controller at the start of a run."""
        check_arm(arm)
        super().__init__(arm.n)
        self._arm = arm

    def make_law(self, dt: float, continuous: bool) -> _core.Law:
        """A law with the present gains, at the start of a run.

        Args:
            dt: s, the control period; 0 means continuous time.
            continuous: Whether the arm moves continuously during the control period.
        """
        return self._make_law(*checked_period(dt, continuous))

    @abstractmethod
    def _make_law(self, dt: float, continuous: bool) -> _core.Law:
        """`make_law` with checked arguments."""

    def _model(self, dt: float, continuous: bool) -> _core.ArmModel:
        return self._arm.core_model.for_period(dt, continuous)


def _check_arguments(state: Any, setpoint: Any) -> None:
    instance("state", state, State, _STATE_HINT)
    instance("setpoint", setpoint, Setpoint, "armctl.Setpoint(q, v, a) is one")
    values = {
        "state.q": state.q,
        "state.v": state.v,
        "setpoint.q": setpoint.q,
        "setpoint.v": setpoint.v,
        "setpoint.a": setpoint.a,
    }
    for name, value in values.items():
        if not isinstance(value, np.ndarray) or value.ndim != 1 or value.dtype != np.float64:
            raise InputError(f"{name}: {shown(value)} is not a vector of floats; numpy.array([...], dtype=float) is one")
    sizes = {name: value.size for name, value in values.items()}
    if len(set(sizes.values())) > 1:
        raise InputError(f"state and setpoint: all vectors must have the same length, got {sizes}")


def measured_wrench(state: State, controller: str) -> Array:
    """The wrench of a state, (6,) N and N m; InputError if nobody measures it."""
    if state.wrench is None:
        raise InputError(f"state.wrench: {controller} needs the measured wrench (6,); a Simulation measures it")
    if as_array("state.wrench", state.wrench).shape != (WRENCH_SIZE,):
        raise InputError(f"state.wrench: {controller} needs the measured wrench (6,), got {shown(state.wrench)}")
    return np.ascontiguousarray(state.wrench, dtype=np.float64)


def has_compiled_law(controller: Controller, n: int) -> TypeGuard[CompiledController]:
    """Whether a controller computes its torque by a compiled law for n joints and nothing else."""
    return isinstance(controller, CompiledController) and controller.n == n and controller.is_compiled
