"""Families of gains: those of a control law as a function of a few factors on its default gains."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from armctl.control import CONTROLLERS
from armctl.control.gains import margin_gains
from armctl.control.impedance import IMPEDANCE_BANDWIDTH
from armctl.control.interface import Controller
from armctl.control.lqr import LQR
from armctl.control.observer_gains import feedback_estimate, observer_gains
from armctl.core.defaults import DEFAULT_BANDWIDTH
from armctl.core.validation import Array, frozen
from armctl.model.arm.arm import Arm

PD_LAWS = ("pd", "pd-feedforward", "pd-gravity")
_BANDWIDTH_LAWS = {
    "computed-torque": DEFAULT_BANDWIDTH,
    "operational-space": DEFAULT_BANDWIDTH,
    "impedance": IMPEDANCE_BANDWIDTH,
    "qp": DEFAULT_BANDWIDTH,
    "mpc": DEFAULT_BANDWIDTH,
}
_OBSERVER_LAWS = ("computed-torque-observer", "computed-torque-learning")
LAWS = (*PD_LAWS, *_BANDWIDTH_LAWS, *_OBSERVER_LAWS, "lqr")
_LIMIT = np.log(1e4)  # of the factors on the default gains
_LIMITS = {"damping_ratio": np.log((0.5, 2.0))}  # logarithms, of laws with a model: their errors must not oscillate
_GROWTH = {"damping_ratio": 0.0, "integral_time": -1.0}  # with the bandwidth, as exponents; all others grow in proportion


@dataclass(frozen=True, slots=True, eq=False)
class GainFamily:
    """The gains of a law as a function of x, the logarithms of factors on its default gains."""

    size: int  # of x
    joints: tuple[tuple[int, ...], ...]  # the elements of x that belong to each joint, or to all joints together
    limits: Array  # (size, 2) bounds of x
    softened: Sequence[int]  # the elements of x that may be smaller in a design's start
    scaling: Array  # (size,) how all gains grow with the bandwidth: x for a factor f on it is log(f) x scaling
    gains: Callable[[Array], dict[str, float | Array]]  # the arguments of the constructor at x
    make: Callable[..., Controller]

    def controller(self, x: Array) -> Controller:
        return self.make(**self.gains(x))


def gain_family(arm: Arm, law: str, dt: float) -> GainFamily:
    """The gains of a law, one of `LAWS`, on an arm with a control period dt, s."""
    make: Callable[..., Controller] = CONTROLLERS[law]
    if law in PD_LAWS:
        default = margin_gains(arm, dt)
        n = arm.n

        def pd(x: Array) -> dict[str, float | Array]:
            return {
                "stiffness": frozen(default.stiffness * np.exp(x[:n])),
                "damping": frozen(default.damping * np.exp(x[n:])),
            }

        joints = tuple((i, n + i) for i in range(n))
        free = np.tile([-_LIMIT, _LIMIT], (2 * n, 1))
        return GainFamily(2 * n, joints, free, range(n), np.repeat([2.0, 1.0], n), pd, lambda **gains: make(arm, **gains))
    defaults = _default_gains(arm, law, dt)

    def scalars(x: Array) -> dict[str, float | Array]:
        return {name: value * float(np.exp(each)) for (name, value), each in zip(defaults.items(), x, strict=True)}

    indices = range(len(defaults))
    limits = [_LIMITS[name] - np.log(value) if name in _LIMITS else (-_LIMIT, _LIMIT) for name, value in defaults.items()]
    softened = [i for i, name in enumerate(defaults) if law in _OBSERVER_LAWS and name == "observer_bandwidth"]
    growth = np.array([_GROWTH.get(name, 1.0) for name in defaults])
    return GainFamily(
        len(defaults), (tuple(indices),), np.array(limits), softened, growth, scalars, lambda **gains: make(arm, **gains)
    )


def _default_gains(arm: Arm, law: str, dt: float) -> dict[str, float]:
    """The gains of a law without gains for each joint."""
    if law == "lqr":
        return LQR(arm).effective_gains(dt)
    if law in _OBSERVER_LAWS:
        found = observer_gains(arm, dt)
        return {"bandwidth": found.feedback, "damping_ratio": found.damping_ratio, "observer_bandwidth": found.disturbance}
    bandwidth = _BANDWIDTH_LAWS[law]
    gains = {"bandwidth": bandwidth, "damping_ratio": 1.0}
    if law == "computed-torque":
        gains["estimate_bandwidth"] = feedback_estimate(arm, dt, bandwidth)
    return gains
