"""Families of gains: those of a control law as a function of a few factors on its default gains."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from armctl.control import CONTROLLERS
from armctl.control.interface import Controller
from armctl.core.errors import UnknownNameError
from armctl.core.validation import Array, frozen
from armctl.model.arm.arm import Arm

_LIMIT = np.log(1e4)  # of the factors on the default gains
_LIMITS = {"damping_ratio": np.log((0.5, 2.0))}  # logarithms, of laws with a model: their errors must not oscillate
# With the bandwidth, as exponents; all others grow in proportion.
_GROWTH = {"stiffness": 2.0, "damping_ratio": 0.0, "integral_time": -1.0}
_SOFTENED = ("stiffness", "observer_bandwidth")


@dataclass(frozen=True, slots=True, eq=False)
class GainFamily:
    """The gains of a law as a function of x, the logarithms of factors on its default gains."""

    size: int  # of x
    is_joint_by_joint: bool  # whether each joint has gains of its own
    joints: tuple[tuple[int, ...], ...]  # the elements of x that belong to each joint, or to all joints together
    limits: Array  # (size, 2) bounds of x
    softened: Sequence[int]  # the elements of x that may be smaller in a design's start
    scaling: Array  # (size,) how all gains grow with the bandwidth: x for a factor f on it is log(f) x scaling
    gains: Callable[[Array], dict[str, float | Array]]  # the arguments of the constructor at x
    make: Callable[..., Controller]

    def controller(self, x: Array) -> Controller:
        return self.make(**self.gains(x))


def gain_family(arm: Arm, law: str, dt: float) -> GainFamily:
    """The gains of a tunable law, a name of `CONTROLLERS`, on an arm with a control period dt, s."""
    row = CONTROLLERS[law]
    if row.tunable_gains is None:
        raise UnknownNameError.from_known("law", law, tunable_laws())
    defaults = row.tunable_gains(arm, dt)
    slices: dict[str, slice] = {}
    size = 0
    for name, value in defaults.items():
        slices[name] = slice(size, size + np.size(value))
        size = slices[name].stop

    def gains(x: Array) -> dict[str, float | Array]:
        return {name: _scaled(value, x[slices[name]]) for name, value in defaults.items()}

    limits = np.empty((size, 2))
    scaling = np.empty(size)
    for name, value in defaults.items():
        limits[slices[name]] = _LIMITS[name] - np.log(value) if name in _LIMITS else (-_LIMIT, _LIMIT)
        scaling[slices[name]] = _GROWTH.get(name, 1.0)
    indices = np.arange(size)
    softened = np.concatenate([indices[slices[name]] for name in defaults if name in _SOFTENED] or [indices[:0]])
    is_joint_by_joint = any(np.ndim(value) for value in defaults.values())
    joints = indices.reshape(-1, arm.n).T if is_joint_by_joint else indices[None]
    return GainFamily(
        size=size,
        is_joint_by_joint=is_joint_by_joint,
        joints=tuple(map(tuple, joints.tolist())),
        limits=limits,
        softened=softened.tolist(),
        scaling=scaling,
        gains=gains,
        make=partial(row, arm),
    )


def tunable_laws() -> list[str]:
    """The names of the controllers that `tune` takes."""
    return [name for name, row in CONTROLLERS.items() if row.tunable_gains is not None]


def _scaled(value: float | Array, x: Array) -> float | Array:
    """A gain times exp(x)."""
    if isinstance(value, np.ndarray):
        return frozen(value * np.exp(x))
    return value * float(np.exp(x[0]))
