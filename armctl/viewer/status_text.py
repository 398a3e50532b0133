"""The sentences that describe a session's status on the page and in the native window."""

from __future__ import annotations

from armctl.core.target import TOLERANCE
from armctl.sim.realtime import Activity, Status

_MIN_SHOWN_MM = 1e-3


def describe(status: Status) -> str:
    """What the session does, in one line."""
    error_mm = 1e3 * status.position_error
    match status.activity:
        case Activity.FAILED | Activity.DIVERGED:
            return f"{status.failure}; press reset"
        case Activity.PAUSED:
            return "paused"
        case Activity.OUT_OF_REACH:
            return _out_of_reach(status)
        case Activity.AT_TARGET:
            return f"at the target, error {max(error_mm, _MIN_SHOWN_MM):.2g} mm"
        case Activity.SAGGING:
            payload = f" and {status.payload:g} kg" if status.payload else ""
            return f"steady-state error {error_mm:.1f} mm with {status.controller}{payload}"
        case Activity.FOLLOWING:
            reach = f"; {_out_of_reach(status)}" if status.reach_error is not None else ""
            return f"following, {error_mm:.0f} mm to go{reach}"


def _out_of_reach(status: Status) -> str:
    if status.reach_error is None or status.reach_error < TOLERANCE:
        return "this orientation is out of reach here"
    return f"out of reach by {1e3 * status.reach_error:.0f} mm"
