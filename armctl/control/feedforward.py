"""What all laws with a model share: the reference as a sampled arm sees it, and the torque of one control period."""

from __future__ import annotations

from armctl.control.interface import State
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array
from armctl.robot.dynamics import Dynamics


def sampled(setpoint: Setpoint) -> tuple[Array, Array]:
    """The velocity that will be measured on the way, and the acceleration to be made over the coming period.

    Args:
        setpoint: Where the arm should be.

    Returns:
        (n,) rad/s and (n,) rad/s^2; the setpoint's own where nobody sampled it.
    """
    _, v, a, v_tick, a_tick = setpoint
    return (v, a) if v_tick is None or a_tick is None else (v_tick, a_tick)


def inverse(dynamics: Dynamics, state: State, a: Array) -> Array:
    """The torque that makes an arm accelerate over a control period, dry friction left out.

    Args:
        dynamics: Of the arm.
        state: The measured state at the period's beginning.
        a: (n,) rad/s^2, the change of velocity over the period by its length.

    Returns:
        (n,) N m.
    """
    q, v, _, dt, continuous = state
    return dynamics.held(q, v, a, dt) if continuous else dynamics.inverse(q, v, a, dt)


def torque(dynamics: Dynamics, state: State, a: Array, v_ref: Array, a_ref: Array) -> Array:
    """As `inverse`, and dry friction.

    Args:
        dynamics: Of the arm.
        state: The measured state at the period's beginning.
        a: (n,) rad/s^2, the change of velocity over the period by its length.
        v_ref: (n,) rad/s.
        a_ref: (n,) rad/s^2.

    Returns:
        (n,) N m.
    """
    tau = inverse(dynamics, state, a)
    return tau + friction(dynamics, state, v_ref, a_ref) if dynamics.has_friction else tau


def friction(dynamics: Dynamics, state: State, v_ref: Array, a_ref: Array) -> Array:
    """The torque against dry friction as the reference meets it, so that measurement noise does not make it chatter.

    Args:
        dynamics: Of the arm.
        state: The measured state at the period's beginning.
        v_ref: (n,) rad/s.
        a_ref: (n,) rad/s^2.

    Returns:
        (n,) N m.
    """
    q, _, _, dt, continuous = state
    return dynamics.friction(q, v_ref + 0.5 * dt * a_ref, a_ref) if continuous else dynamics.friction(q, v_ref, a_ref, dt)
