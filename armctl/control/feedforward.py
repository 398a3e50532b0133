"""What all model-based controllers share: the reference of a sampled system, and the model's torque for one control period."""

from __future__ import annotations

from armctl.control.interface import State
from armctl.core.trajectory import Setpoint
from armctl.core.validation import Array
from armctl.robot.dynamics import Dynamics


def sampled(setpoint: Setpoint) -> tuple[Array, Array]:
    """The velocity that a sampled system measures on the reference, and the acceleration over the coming period.

    Both are the setpoint's own v and a if the reference was not sampled on ticks.
    """
    v_tick = setpoint.v_tick
    a_tick = setpoint.a_tick
    return (setpoint.v, setpoint.a) if v_tick is None or a_tick is None else (v_tick, a_tick)


def inverse_dynamics(dynamics: Dynamics, state: State, a: Array) -> Array:
    """The torque that changes the velocity by a dt over the coming control period, without dry friction; (n,) N m."""
    q, v, _, dt, continuous, _ = state
    return dynamics.inverse_midpoint(q, v, a, dt) if continuous else dynamics.discrete_inverse_dynamics(q, v, a, dt)


def inverse_dynamics_with_friction(dynamics: Dynamics, state: State, a: Array, v_ref: Array, a_ref: Array) -> Array:
    """As `inverse_dynamics`, with damping and dry friction of the reference motion; (n,) N m.

    The arm's own damping then helps the feedback. Compensated at the measured velocity, large damping would be a large positive
    feedback.
    """
    tau = inverse_dynamics(dynamics, state, a) + dynamics.damping * (v_ref - state.v)
    return tau + friction(dynamics, state, v_ref, a_ref) if dynamics.has_friction else tau


def friction(dynamics: Dynamics, state: State, v_ref: Array, a_ref: Array) -> Array:
    """The torque against dry friction on the reference motion; (n,) N m.

    It uses the reference velocity, because the sign of a noisy measured velocity would make the torque chatter.
    """
    q, _, _, dt, continuous, _ = state
    if continuous:
        return dynamics.friction(v_ref + 0.5 * dt * a_ref, a_ref)
    return dynamics.discrete_friction(q, v_ref, a_ref, dt)
