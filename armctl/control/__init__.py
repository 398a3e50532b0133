"""Controllers: one method `torque(state, setpoint)`. The list of those that have a name.

What a row names is imported when it is used, so that the help of the command line can list them all at once.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from armctl.core.defaults import DEFAULT_BANDWIDTH, IMPEDANCE_BANDWIDTH
from armctl.core.errors import UnknownNameError

if TYPE_CHECKING:
    from armctl.control.interface import Controller
    from armctl.core.validation import Array
    from armctl.model.arm.arm import Arm

TunableGains = Mapping[str, "float | Array"]


@dataclass(frozen=True)
class NamedController:
    """A controller that has a name. A call makes one for an arm.

    Attributes:
        law: The module of this package, and the class in it.
        summary: What it does, for lists.
        tunable_gains: The default gains that `tune` scales, for an arm and a control period, s: numbers, or (n,) for the
            joints. None for a controller that is not tuned.
        arguments: Of its constructor, besides the arm.
    """

    law: tuple[str, str]
    summary: str
    tunable_gains: Callable[[Arm, float], TunableGains] | None = None
    arguments: Mapping[str, object] = field(default_factory=dict)

    def __call__(self, arm: Arm, **arguments: Any) -> Controller:
        """A controller for an arm.

        Args:
            arguments: Of the constructor; its defaults if left out.
        """
        module, name = self.law
        law: Callable[..., Controller] = getattr(importlib.import_module(f"{__name__}.{module}"), name)
        return law(arm, **{**self.arguments, **arguments})


def _joint_gains(arm: Arm, dt: float) -> TunableGains:
    from armctl.control.gains import margin_gains

    default = margin_gains(arm, dt)
    return {"stiffness": default.stiffness, "damping": default.damping}


def _error_gains(_arm: Arm, _dt: float) -> TunableGains:
    return {"bandwidth": DEFAULT_BANDWIDTH, "damping_ratio": 1.0}


def _impedance_gains(_arm: Arm, _dt: float) -> TunableGains:
    return {"bandwidth": IMPEDANCE_BANDWIDTH, "damping_ratio": 1.0}


def _estimated_gains(arm: Arm, dt: float) -> TunableGains:
    from armctl.control.observer_gains import feedback_estimate

    return {**_error_gains(arm, dt), "estimate_bandwidth": feedback_estimate(arm, dt, DEFAULT_BANDWIDTH)}


def _observer_gains(arm: Arm, dt: float) -> TunableGains:
    from armctl.control.observer_gains import observer_gains

    found = observer_gains(arm, dt)
    return {"bandwidth": found.feedback, "damping_ratio": found.damping_ratio, "observer_bandwidth": found.disturbance}


def _lqr_gains(arm: Arm, dt: float) -> TunableGains:
    from armctl.control.lqr import LQR

    return LQR(arm).effective_gains(dt)


CONTROLLERS: dict[str, NamedController] = {
    "pd": NamedController(("pd", "PD"), "PD of each joint", _joint_gains),
    "pd-feedforward": NamedController(("pd", "PDFeedforward"), "PD and the torque of the reference", _joint_gains),
    "pd-gravity": NamedController(("pd", "PDGravity"), "PD and the torque of gravity", _joint_gains),
    "computed-torque": NamedController(
        ("computed_torque", "ComputedTorque"), "inverse dynamics, for the control period", _estimated_gains
    ),
    "computed-torque-textbook": NamedController(
        ("computed_torque", "ComputedTorque"), "inverse dynamics in continuous time", arguments={"form": "textbook"}
    ),
    "computed-torque-observer": NamedController(
        ("computed_torque_observer", "ComputedTorqueObserver"),
        "inverse dynamics that compensates payloads and friction",
        _observer_gains,
    ),
    "computed-torque-learning": NamedController(
        ("computed_torque_learning", "ComputedTorqueLearning"), "inverse dynamics that learns the payload", _observer_gains
    ),
    "qp": NamedController(
        ("computed_torque_qp", "ComputedTorqueQP"), "inverse dynamics within limits of torque and velocity", _error_gains
    ),
    "lqr": NamedController(("lqr", "LQR"), "linear-quadratic regulator with integral action", _lqr_gains),
    "mpc": NamedController(("mpc", "MPC"), "plans torques ahead, within their limits", _error_gains),
    "operational-space": NamedController(
        ("operational_space", "OperationalSpace"), "inverse dynamics of the tip", _error_gains
    ),
    "impedance": NamedController(("impedance", "Impedance"), "the tip as mass, spring and damper", _impedance_gains),
}


def controller_by_name(name: str, arm: Arm) -> Controller:
    """A controller with its default gains, by its name in `CONTROLLERS`."""
    if name not in CONTROLLERS:
        raise UnknownNameError.from_known("controller", name, CONTROLLERS)
    from armctl.model.arm.arm import check_driven

    check_driven(arm)
    return CONTROLLERS[name](arm)
