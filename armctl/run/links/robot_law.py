"""The controller of a robot: whether its link can bear it, and what its process needs."""

from __future__ import annotations

import numpy as np

from armctl.control.interface import Controller, traits
from armctl.core import hooks
from armctl.core.errors import InputError, LinkError
from armctl.core.validation import number
from armctl.model.arm.arm import Arm
from armctl.run.execution.move import read_controller
from armctl.run.links.envelope import Envelope
from armctl.run.links.host import LinkHost
from armctl.run.links.link import Link
from armctl.run.links.process import RemoteHost
from armctl.run.links.torque_interface import TorqueLink
from armctl.run.links.torque_loop import LinkLaw

DEFAULT_ERROR_MAX = 0.1  # rad


def link_law(
    arm: Arm, link: Link, controller: Controller | str | None, envelope: Envelope, error_max: float | None
) -> LinkLaw | None:
    """What the process of a link needs for a controller; None without one, where the robot's own servo follows.

    Raises:
        InputError: The controller is none, or no robot can have it, or the error is not above 0.
        UnknownNameError: There is no such controller.
        LinkError: The robot takes no torques.
    """
    if controller is None:
        if error_max is not None:
            raise InputError("error_max: it is a bound for controller=, without which the robot's own servo follows")
        return None
    law = read_controller(controller, arm)
    own = traits(law)
    interface = link.torque
    if interface is None or not isinstance(link, TorqueLink):
        raise LinkError(
            f"controller: {link.name} takes no torques; leave it out, and the robot's own servo follows the motions"
        )
    if len(interface.torque_limits) != arm.n:
        raise LinkError(f"torque: the robot takes torques of {len(interface.torque_limits)} joints, the model has {arm.n}")
    if own.needs_deflection or own.foresee is not None:
        lacking = "the deflection of its joints" if own.needs_deflection else "the reference of coming ticks"
        raise InputError(f"controller: {own.name:.80} needs {lacking}, which a link does not give; a Simulation does")
    if error_max is None:
        error_max = np.inf if own.yields else DEFAULT_ERROR_MAX
    return LinkLaw(
        arm=arm,
        controller=law,
        interface=interface,
        envelope=envelope,
        error_max=number("error_max", error_max, np.finfo(float).tiny) if np.isfinite(error_max) else np.inf,
        rest_speed=link.rest_speed,
    )


def check_that_link_bears(law: LinkLaw, host: LinkHost | RemoteHost, dt: float) -> float:
    """s, the delay of the link, at which a law has sufficient margins.

    Raises:
        LinkError: The delay cannot be measured, or the law has too small margins at it.
    """
    delay = host.measure_delay()
    lag = law.interface.lag if law.interface.delay is not None else 0.0  # a measured delay contains it
    refusal = hooks.why_not_borne(law.arm, law.controller, host.read().q, dt, delay, lag)
    if refusal:
        raise LinkError(refusal)
    return delay
