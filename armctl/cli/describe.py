"""Arms, serial chains and the end of a run, in words and as plain data."""

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from armctl.control.computed_torque import ComputedTorque
from armctl.control.margin_exceptions import margin_exceptions
from armctl.control.observer_gains import max_unknown_payload
from armctl.core import units
from armctl.core.json_values import json_value
from armctl.core.log import Log
from armctl.core.tables import Table
from armctl.core.validation import Array
from armctl.lab.loops.linearization import linearize
from armctl.lab.static_payload import doubt_about_torque_limits, static_payload, static_payloads
from armctl.model.arm.arm import Arm
from armctl.model.loading.base import BASE_JOINTS
from armctl.model.loading.chain import SerialChain
from armctl.model.mjmodel.queries import body_name

TABLE_COLUMNS = 100  # of a table of a robot with several tips


def facts(arm: Arm) -> dict[str, Any]:
    """An arm as plain data for JSON; what is infinite becomes None."""
    data = {
        "name": arm.name,
        "joint_names": list(arm.joint_names),
        "units": list(arm.units),
        "base": arm.base,
        "tip": arm.tip,
        "tip_at_home": arm.fk(arm.home).position.tolist(),
        "tip_body": body_name(arm.model, arm.tip_body),
        "tip_offset": arm.T_body_tip.position.tolist(),
        "tips": {tip: _tip_facts(arm, tip) for tip in arm.tips},
        "home": arm.home.tolist(),
        "limits": {f.name: getattr(arm.limits, f.name).tolist() for f in fields(arm.limits)},
        "sources": dict(arm.sources),
        "mass_kg": float(sum(inertia.mass for inertia in arm.pinocchio_model.pin_model.inertias)),
        "timestep_s": arm.dt,
        "notes": list(arm.notes),
    } | ({} if _why_no_control_facts(arm) else _control_facts(arm))
    return json_value(data)


def _tip_facts(arm: Arm, tip: str) -> dict[str, Any]:
    """Where a tip is at home, and the joints that move it."""
    return {
        "at_home": arm.fk(arm.home, tip).position.tolist(),
        "joints": [arm.joint_names[i] for i in arm.joints_to(tip)],
    }


def _why_no_control_facts(arm: Arm) -> str:
    """One sentence; empty if there are facts about what its motors hold."""
    if arm.base == "free":
        return "no motor holds the free base, so there are no payloads, controllers and simulations"
    return "" if arm.joint_map.closure is None else "payloads and margins are not computed for an arm with closed loops"


def _control_facts(arm: Arm) -> dict[str, Any]:
    """What the motors of an arm hold, and its default gains."""
    law = ComputedTorque(arm)
    return {
        "static_payload_kg": static_payload(static_payloads(arm)),
        "unknown_payload_kg": max_unknown_payload(arm),
        "margin_exceptions": [{"controllers": each.controllers, "text": str(each)} for each in margin_exceptions(arm)],
        "bandwidth_rad_per_s": law.bandwidth,
        "slowest_pole_per_s": linearize(arm, law, arm.limits.clamp(arm.home)).slowest_pole,
    }


def describe(arm: Arm, data: dict[str, Any]) -> str:
    """The `facts` of an arm in words: joints and limits in a table, several tips in another; and where the limits are from."""
    noun = "joint" if arm.n == 1 else "joints"
    moving = f"{arm.name}: {arm.n} {noun}, {data['mass_kg']:.2f} kg moving"
    base = [] if arm.base == "fixed" else [f"base: {arm.base}, moved by q[{span(range(len(BASE_JOINTS[arm.base])))}]"]
    if arm.further_tips:
        lines = [f"{moving}, {len(arm.tips)} tips", *base, *_tips_in_words(arm), ""]
    else:
        lines = [f"{moving}, tip {arm.tip!r} at {_place(arm, arm.tip)} m at home", _tip_offset(arm), *base]
    lines += _joints_in_words(arm)
    lines.append("units: rad, rad/s, rad/s^2, rad/s^3, N m (m and N for a slide joint)")
    lines += [f"{name} from: {source}" for name, source in arm.sources.items() if name != "q_min"]
    lines += [f"note: {note}" for note in arm.notes]
    if reason := _why_no_control_facts(arm):
        return "\n".join([*lines, reason])
    return "\n".join([*lines, *_control_in_words(arm, data)])


def span(joints: Sequence[int]) -> str:
    """Indices in short: [0, 1, 2, 5] is "0-2, 5"."""
    spans: list[list[int]] = []
    for joint in joints:
        if spans and joint == spans[-1][-1] + 1:
            spans[-1].append(joint)
        else:
            spans.append([joint])
    return ", ".join(str(each[0]) if len(each) == 1 else f"{each[0]}-{each[-1]}" for each in spans)


def _place(arm: Arm, tip: str) -> str:
    return _vector(arm.fk(arm.home, tip).position)


def _vector(numbers: Array) -> str:
    return f"[{', '.join(f'{x:.4f}' for x in np.round(numbers, 4) + 0.0)}]"  # the sum turns -0 into 0


def _tip_offset(arm: Arm) -> str:
    """Where the tip is on its body: a tip has the name of a site, or of the body that it belongs to."""
    offset = arm.T_body_tip.position
    body = body_name(arm.model, arm.tip_body)
    if not offset.any():
        return f"tip: the origin of body {body!r}"
    distance = 1e3 * float(np.linalg.norm(offset))
    return f"tip: {distance:.1f} mm from the origin of body {body!r}, at {_vector(offset)} m in its frame"


def _tips_in_words(arm: Arm) -> list[str]:
    """A table of the tips: where each is at home, and which joints of q move it."""
    rows = [(tip, _place(arm, tip), span(arm.joints_to(tip))) for tip in arm.tips]
    return Table(("tip", "at home, m", "moved by q"), rows).text(TABLE_COLUMNS).split("\n")


def _joints_in_words(arm: Arm) -> list[str]:
    """A table of the joints and their limits; with their indices in q if there are several tips."""
    limits = arm.limits
    columns = (arm.home, limits.q_min, limits.q_max, limits.v_max, limits.a_max, limits.j_max, limits.tau_max)
    index = len(str(arm.n - 1)) + 1 if arm.further_tips else 0
    figures = f"{'home':>8} {'q_min':>8} {'q_max':>8} {'v_max':>8} {'a_max':>8} {'j_max':>8} {'tau_max':>8}"
    longest = max(5, *map(len, arm.joint_names))
    width = max(5, min(longest, TABLE_COLUMNS - index - len(figures) - 1)) if arm.further_tips else longest
    lines = [f"{'q':<{index}}{'joint':{width}} {figures}" if index else f"{'joint':{width}} {figures}"]
    for i, name in enumerate(arm.joint_names):
        head = f"{i:<{index}}{name:{width}}" if index else f"{name:{width}}"
        if len(name) > width:  # the name has a line of its own
            lines.append(head)
            head = " " * (index + width)
        lines.append(f"{head} " + " ".join(f"{column[i]:8.4g}" for column in columns))
    return lines


def _control_in_words(arm: Arm, data: dict[str, Any]) -> list[str]:
    """What the motors of an arm hold at its first tip, and its default gains."""
    lines = []
    for i in np.flatnonzero(arm.motor_torque_limits < arm.limits.tau_max).tolist():
        own = f"{arm.motor_torque_limits[i]:.4g} {arm.actuation.torque_units[i]}"
        lines.append(f"note: the motor of {arm.joint_names[i]} gives {own} in simulations, less than its tau_max")
    at_tip = f"at the tip {arm.tip!r}" if arm.further_tips else "at the tip"
    payload = data["static_payload_kg"]
    if payload is None:
        lines.append(f"static payload {at_tip}: not limited, for no joint carries a weight there")
    else:
        doubt = doubt_about_torque_limits(arm, payload)
        lines.append(doubt or f"static payload {at_tip}, in 95 % of configurations: {max(payload, 0.0):.3g} kg")
    unknown = data["unknown_payload_kg"]
    lines.append(
        "default computed-torque-observer and -learning, with an unknown payload within 5 cm of the tip: they keep their delay "
        f"margin up to {unknown:.3g} kg, and are stable up to {2 * unknown:.3g} kg"
    )
    lines.append(
        f"default computed-torque at home: slowest pole {data['slowest_pole_per_s']:.3g} 1/s, bandwidth "
        f"{data['bandwidth_rad_per_s']:.3g} rad/s"
    )
    return lines + [f"default gains, {exception['text']}" for exception in data["margin_exceptions"]]


def describe_end(log: Log) -> str:
    """The end of a run in words: a table of its joints, and the tip."""
    kinds = units.label(log.units), units.label(log.units, "/s"), units.label(units.of_torque(log.units))
    heads = [f"{f'{what}, {unit}':>10}" for what, unit in zip(("q", "v", "torque"), kinds, strict=True)]
    lines = [f"{'joint':20} {' '.join(heads)}"]
    for i, name in enumerate(log.joint_names):
        cells = zip((log.q, log.v, log.tau), (4, 4, 3), heads, strict=True)
        lines.append(f"{name:20} " + " ".join(f"{column[-1, i]:{len(head)}.{digits}f}" for column, digits, head in cells))
    place = ", ".join(f"{x:.4f}" for x in log.tip[-1])
    return "\n".join([*lines, f"after {log.t[-1]:.3f} s the tip is at [{place}] m" + (log.failure and f"; {log.failure}")])


def describe_chains(robot: str, chains: list[SerialChain]) -> str:
    """The chains of a robot in words: a table with base, tip and joints; a rejected chain comes with the reason."""
    usable = sum(chain.ok for chain in chains)
    rows = []
    for chain in chains:
        said = f"rejected: {chain.reason}" if chain.reason else f"{len(chain.joint_names)}: {' '.join(chain.joint_names)}"
        said += f", with {' '.join(chain.followers)}" if chain.followers else ""
        rows.append((chain.base, chain.tip, said))
    found = f"{robot}: {usable} chains that load(robot, base=..., tip=...) accepts, {len(chains) - usable} that it rejects"
    return f"{found}\n{Table(('base', 'tip', 'joints'), rows).text()}"
