"""The interface of a controller: torque from state and setpoint."""

from __future__ import annotations

import copy
import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, Self, TypeGuard, TypeVar, runtime_checkable

import numpy as np

from armctl.core.errors import InputError
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array, flag, instance, number, shown

WRENCH_SIZE = 6
_MAX_PERIOD_S = 1.0
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
    """

    q: Array
    v: Array
    t: float = 0.0
    dt: float = 0.0
    continuous: bool = False
    wrench: Array | None = None


@runtime_checkable
class Controller(Protocol):
    """Any object with a method `torque`. Reports show its attribute `name`, if it has one.

    A controller with memory resets it if `state.t` is not one `state.dt` later than in the previous call.
    """

    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque for the coming control period.

        Args:
            state: The measured state.
            setpoint: Where the arm should be.

        Returns:
            (n,) N m; the simulation clips it to the arm's limits.
        """
        ...


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
    """The arguments of `KernelController.parameters`, checked.

    Args:
        dt: s, the control period; 0 means continuous time.
        continuous: Whether the arm moves continuously during the control period.

    Returns:
        Both.

    Raises:
        InputError: The control period is no number in [0, 1] s, or `continuous` is not True or False.
    """
    return number("dt", dt, 0.0, _MAX_PERIOD_S), flag("continuous", continuous)


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


class KernelController(ABC):
    """A controller whose law is one compiled kernel, which `torque` and the compiled loop of a simulation both call.

    A kernel is a function compiled by numba in nopython mode,

        kernel(params, q, v, reference, memory, tau)

    with the constants of a run, the measured positions and velocities (n,), the reference of the tick (5, n) with the rows q,
    v, a, v_tick, a_tick of a `Setpoint`, the memory of the controller, and the torque (n,), which it writes. All are contiguous
    arrays of float64. Memory is zero at the first tick of a run; it may also contain scratch. A kernel must not keep state
    anywhere else, must not raise, and has to terminate for any numbers, also if they are not finite. If the controller has
    `needs_wrench = True`, its memory begins with the measured wrench of the tick, (6,) as `State.wrench`.

    A simulation then runs all ticks without Python, and many runs on several threads. Gains may be assigned between runs. A
    subclass that overrides `torque` runs in the Python loop, like a controller without a kernel.
    """

    needs_wrench = False

    def __init__(self, n: int):
        """A controller whose memory is empty.

        Args:
            n: The number of joints.
        """
        self._n = n
        self._clock = Clock()
        self._memory: Array | None = None
        self._period: tuple[float, bool] | None = None
        self._parameters = np.zeros(0)

    def __setattr__(self, name: str, value: object) -> None:
        """Sets an attribute; a public one is a gain, so the parameters of the kernel follow from the new value."""
        object.__setattr__(self, name, value)
        if not name.startswith("_"):
            object.__setattr__(self, "_period", None)

    @property
    def n(self) -> int:
        """The number of joints."""
        return self._n

    @property
    @abstractmethod
    def kernel(self) -> Callable[..., None]:
        """The compiled function. It is imported here, because numba takes long to load."""

    @abstractmethod
    def parameters(self, dt: float, continuous: bool) -> Array:
        """The constants of a run.

        Args:
            dt: s, the control period.
            continuous: Whether the arm moves continuously during the control period.

        Returns:
            A new vector, the first argument of the kernel.
        """

    @property
    def is_compiled(self) -> bool:
        """Whether the kernel is the whole law, so that a simulation need not call `torque`."""
        return type(self).torque is KernelController.torque and "torque" not in vars(self) and not self.is_time_varying

    @property
    def is_time_varying(self) -> bool:
        """Whether `begin` has to be called in every tick, because the parameters depend on the time."""
        return False

    @property
    def memory_size(self) -> int:
        """How many numbers of memory the kernel needs; 0 for a law without memory and scratch."""
        return 0

    @property
    def memory(self) -> Array:
        """The memory that `torque` uses, (memory_size,)."""
        if self._memory is None:
            self._memory = np.zeros(self.memory_size)
        return self._memory

    def fresh(self) -> Self:
        """The same law with a memory of its own, for a run at the same time."""
        other = copy.copy(self)
        other._clock = Clock()
        other._memory = None
        return other

    def begin(self, state: State) -> tuple[Array, Array]:
        """Prepares for a tick.

        Args:
            state: The measured state. The memory is reset unless this state follows that of the previous tick.

        Returns:
            The parameters and the memory for the kernel, until the control period changes.

        Raises:
            InputError: It is no `State`.
        """
        instance("state", state, State, _STATE_HINT)
        if self._period != (state.dt, state.continuous):
            self._parameters = self.parameters(state.dt, state.continuous)
            self._period = (state.dt, state.continuous)
        memory = self.memory
        if not self._clock.follows(state):
            memory[:] = 0.0
        return self._parameters, memory

    def finish(self, t: float) -> None:
        """Notes that the kernel computed further ticks, with the arrays that `begin` returned.

        Args:
            t: s, the time of the next tick.

        Raises:
            InputError: It is not a finite number.
        """
        self._clock.expect(number("t", t))

    @explains_wrong_arguments
    def torque(self, state: State, setpoint: Setpoint) -> Array:
        """The torque for the coming control period.

        Args:
            state: The measured state.
            setpoint: Where the arm should be.

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
        parameters, memory = self.begin(state)
        if self.needs_wrench:
            memory[:WRENCH_SIZE] = measured_wrench(state, controller_name(self))
        tau = rows[7]
        self.kernel(parameters, rows[0], rows[1], rows[2:7], memory, tau)
        return tau


def _check_arguments(state: Any, setpoint: object) -> None:
    instance("state", state, State, _STATE_HINT)
    if not isinstance(setpoint, Setpoint):
        raise InputError(f"setpoint: expected Setpoint, got {shown(setpoint)}; armctl.Setpoint(q, v, a) is one")
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
    """The wrench of a state, (6,) N and N m.

    Raises:
        InputError: Nobody measures it, or it does not have 6 numbers.
    """
    if state.wrench is None:
        raise InputError(f"state.wrench: {controller} needs the measured wrench (6,); a Simulation measures it")
    if np.shape(state.wrench) != (WRENCH_SIZE,):
        raise InputError(f"state.wrench: {controller} needs the measured wrench (6,), got {shown(state.wrench)}")
    return state.wrench


def controller_name(controller: Controller) -> str:
    """The name of a controller in reports: its `name`, or that of its class."""
    return getattr(controller, "name", type(controller).__name__)


def has_compiled_law(controller: Controller, n: int) -> TypeGuard[KernelController]:
    """Whether a controller computes its torque by a kernel for n joints and nothing else.

    Args:
        controller: The controller.
        n: Joints of the arms.

    Returns:
        True if the kernel is its whole law.
    """
    return isinstance(controller, KernelController) and controller.n == n and controller.is_compiled
