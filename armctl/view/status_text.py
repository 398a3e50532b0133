"""The sentences that describe a session's status on the page and in the native window."""

import html
from collections.abc import Sequence

import numpy as np

from armctl.core.target import TOLERANCE
from armctl.core.units import length_text
from armctl.view.realtime.history import HistorySamples
from armctl.view.realtime.status import Activity, Status

MIN_SHOWN_MM = 1e-2  # the scale of the chart is logarithmic: smaller errors are drawn at this value
_RELEASE_HINT = "; release the target to plan around"


def describe(status: Status, *, is_held: bool = False) -> str:
    """What a session does, in a sentence; `is_held` says whether somebody holds the target with a mouse."""
    error_mm = 1e3 * status.position_error
    match status.activity:
        case Activity.FAILED | Activity.DIVERGED:
            return f"{status.failure}; press reset"
        case Activity.PAUSED:
            return "paused"
        case Activity.PLANNING:
            return "planning a path around what is in the way"
        case Activity.BLOCKED:
            return status.refusal + (_RELEASE_HINT if is_held else "")
        case Activity.OUT_OF_REACH:
            return _out_of_reach(status)
        case Activity.AT_TARGET:
            targets = "targets" if len(status.aimed) > 1 else "target"
            return f"at the {targets}, error {error_text(status.position_error)}"
        case Activity.SAGGING:
            payload = f" and {status.payload:g} kg" if status.payload else ""
            return f"steady-state error {error_text(status.position_error)} with {status.controller}{payload}"
        case Activity.FOLLOWING:
            reach = f"; {_out_of_reach(status)}" if status.reach_errors else ""
            how = "following" if status.path is None else "on the planned path"
            to_go = f", {error_mm:.0f} mm to go" if error_mm >= 1.0 else ""
            return f"{how}{to_go}{reach}"


def error_text(error: float) -> str:
    """A distance of the tip, m, as every place of the page shows it."""
    return length_text(error) if 1e3 * error >= MIN_SHOWN_MM else f"<{MIN_SHOWN_MM:g} mm"


def readings(samples: HistorySamples, joint_names: Sequence[str], real_time_factor: float) -> str:
    """Three numbers side by side, as HTML: the tip's distance from its reference, the motor nearest to its limit, the clock."""
    shares = np.abs(samples.torque_share[-1])
    busiest = int(np.argmax(shares))
    cells = (
        (html.escape(error_text(samples.to_reference[-1])), "from reference"),
        (f"{100 * shares[busiest]:.0f} %", f"torque of {html.escape(joint_names[busiest])}"),
        (f"{real_time_factor:.2f}", "times real time"),
    )
    columns = "".join(f'<div style="flex: 1"><b style="font-size: 1.3em">{value}</b><br>{what}</div>' for value, what in cells)
    return f'<div style="display: flex; gap: 0.8em; margin: 0 0.8em 0.6em; font-size: 0.85em; line-height: 1.4">{columns}</div>'


def describe_contacts(status: Status) -> str:
    """The contacts and the largest force; empty without contacts."""
    if not len(status.contacts):
        return ""
    forces = np.linalg.norm(status.contacts[:, 1], axis=1)
    return f"{len(forces)} contact{'s' if len(forces) > 1 else ''}, largest force {forces.max():.3g} N"


def is_only_orientation_out_of_reach(status: Status) -> bool:
    return bool(status.reach_errors) and max(status.reach_errors.values()) < TOLERANCE


def _out_of_reach(status: Status) -> str:
    if not status.reach_errors or is_only_orientation_out_of_reach(status):
        return "this orientation is out of reach here"
    if len(status.targets) == 1:
        return f"out of reach by {length_text(max(status.reach_errors.values()))}"
    far = {tip: error for tip, error in status.reach_errors.items() if error >= TOLERANCE}
    return ", ".join(f"{tip} is out of reach by {length_text(error)}" for tip, error in far.items())
