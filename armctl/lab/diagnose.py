"""What is doubtful in a robot's file, and what to write into it."""

from __future__ import annotations

import os
import warnings
from collections.abc import Collection, Iterator
from dataclasses import dataclass

import mujoco
import numpy as np

from armctl.core.errors import ArmctlWarning, ModelError
from armctl.core.note import Severity
from armctl.core.validation import Array
from armctl.lab.static_payload import doubt_about_torque_limits, static_payload, static_payloads
from armctl.model.arm.arm import Arm
from armctl.model.loading.load import load
from armctl.model.mjmodel.queries import acts, body_name, joint_name

_MAX_MASS_RATIO = 1000.0  # greatest mass of a link over the smallest


@dataclass(frozen=True)
class Finding:
    """One thing that is doubtful in a robot's file.

    Attributes:
        severity: An error if the arm cannot be used, a warning if results can be wrong, a note for an assumption.
        text: What was found.
        advice: What to write or to pass instead; empty if there is no advice.
    """

    severity: Severity
    text: str
    advice: str = ""

    def __str__(self) -> str:
        return f"{self.severity}: {self.text}" + (f"\n    {self.advice}" if self.advice else "")


@dataclass(frozen=True)
class Diagnosis:
    """What `diagnose` found.

    Attributes:
        findings: Errors first, then warnings, then notes.
        payload: kg, the static payload at the tip that the torque limits hold in all but the worst 5 % of random
            configurations; NaN if the robot could not be loaded.
    """

    name: str
    findings: tuple[Finding, ...]
    payload: float

    @property
    def ok(self) -> bool:
        """Whether there is no error."""
        return not self.reason

    @property
    def reason(self) -> str:
        """The first error; empty if there is none."""
        return next((finding.text for finding in self.findings if finding.severity is Severity.ERROR), "")

    def __bool__(self) -> bool:
        return self.ok

    def __str__(self) -> str:
        counts = [(severity, sum(f.severity == severity for f in self.findings)) for severity in Severity]
        head = f"{self.name}: " + ", ".join(f"{n} {severity}" + ("" if n == 1 else "s") for severity, n in counts)
        return "\n".join([head, *map(str, self.findings)])


def diagnose(
    robot: str | os.PathLike[str] | mujoco.MjSpec | mujoco.MjModel,
    *,
    tip: str | None = None,
    base: str | None = None,
    srdf: str | os.PathLike[str] | None = None,
    shapes: str | None = None,
) -> Diagnosis:
    """Examines a robot's file: what is missing, impossible or assumed, and what to write.

    Args:
        robot: A name, the path of a file, an MjSpec or an MjModel.
        tip: The site, body or geom at the end of the arm; left out, armctl finds it.
        base: The body at the start of the chain, "planar" or "free", as for `load`.
        srdf: The path of an SRDF. Left out, armctl uses the one beside a URDF.
        shapes: "capsules" or "visual": the collision shape of links that need one and have none; left out, they get none.

    Returns:
        The findings. A file that does not load is a finding, too.

    Raises:
        UnknownNameError: No robot, or nothing in the model, has that name.
    """
    name = os.path.basename(os.fspath(robot)) if isinstance(robot, (str, os.PathLike)) else "model"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            arm = load(robot, tip=tip, base=base, srdf=srdf, shapes=shapes)
        except ModelError as error:
            return Diagnosis(name, (Finding(Severity.ERROR, str(error)),), float("nan"))
    noted = [each.message.note for each in caught if isinstance(each.message, ArmctlWarning) and each.message.note is not None]
    capacity = static_payloads(arm)
    found = [Finding(note.severity, note, note.advice) for note in noted]
    found += _torque_findings(arm, capacity)
    found += _contact_findings(arm)
    found += _mass_findings(arm)
    found += _assumptions(arm, set(noted), is_tip_given=tip is not None)
    severities = list(Severity)
    found.sort(key=lambda finding: severities.index(finding.severity))
    return Diagnosis(arm.name, tuple(found), static_payload(capacity))


def _torque_findings(arm: Arm, payloads: Array) -> Iterator[Finding]:
    """Torque limits that are too weak or too strong for the arm."""
    source = arm.sources["tau_max"]
    home = arm.gravity(arm.home)
    for name, torque, limit, unit in zip(arm.joint_names, home, arm.limits.tau_max, arm.torque_units, strict=True):
        if abs(torque) > limit:
            text = f"holding {name} still at home takes {abs(torque):.3g} {unit}; its limit is {limit:.3g} {unit} ({source})"
            yield Finding(Severity.ERROR, text, "correct the torque limit or the masses behind this joint")
    weak = float(np.mean(payloads < 0))
    if weak > 0:
        text = f"the torque limits ({source}) cannot hold the arm itself in {100 * weak:.0f} % of random configurations"
        yield Finding(Severity.WARNING, text, "compare effort or forcerange, and the masses, with the data sheet")
    low = static_payload(payloads)
    middle = float(np.median(payloads))
    doubt = doubt_about_torque_limits(arm, low)
    if doubt:
        yield Finding(Severity.WARNING, doubt, "take effort or forcerange from the data sheet")
    elif np.isfinite(middle) and low >= 0:
        yield Finding(Severity.NOTE, f"the torque limits ({source}) hold {low:.3g} kg at the tip (median {middle:.3g} kg)")


def _contact_findings(arm: Arm) -> Iterator[Finding]:
    model = arm.model
    data = mujoco.MjData(model)
    data.qpos[:] = arm.home_qpos
    mujoco.mj_forward(model, data)
    pairs = {tuple(sorted(int(model.geom_bodyid[g]) for g in contact.geom)) for contact in data.contact if acts(contact)}
    for first, second in sorted(pairs):
        text = f"{body_name(model, first)} and {body_name(model, second)} overlap at home"
        yield Finding(
            Severity.WARNING,
            text,
            "write <contact><exclude body1=... body2=.../></contact>, or <disable_collisions> in an SRDF",
        )


def _mass_findings(arm: Arm) -> Iterator[Finding]:
    """Masses that differ too much, and joints without rotor inertia."""
    model = arm.model
    joints = list(arm.joint_map.joints)
    masses = {int(body): float(model.body_mass[body]) for body in model.jnt_bodyid[joints] if model.body_mass[body] > 0}
    if masses and max(masses.values()) > _MAX_MASS_RATIO * min(masses.values()):
        heavy = max(masses, key=masses.__getitem__)
        light = min(masses, key=masses.__getitem__)
        text = (
            f"the masses of the links differ by more than {_MAX_MASS_RATIO:g} times: {masses[heavy]:.3g} kg of "
            f"{body_name(model, heavy)}, {masses[light]:.3g} kg of {body_name(model, light)}"
        )
        yield Finding(Severity.WARNING, text, "check their units: kg, and meshes in m rather than mm")
    bare = [joint_name(model, joint) for joint in joints if model.dof_armature[model.jnt_dofadr[joint]] == 0]
    if bare:
        text = f"no rotor inertia at {', '.join(bare):.200}: light links then react too fast to a torque"
        yield Finding(Severity.NOTE, text, 'write armature="gear^2 x rotor inertia" at these joints (MJCF)')


def _assumptions(arm: Arm, warned: Collection[str], is_tip_given: bool) -> Iterator[Finding]:
    """What armctl chose because the file does not say it."""
    if not is_tip_given:
        yield Finding(Severity.NOTE, f"the tip is {arm.tip!r:.80}, chosen by armctl", "tip= names another site or body")
    assumed = [name for name in arm.sources if name in arm.default_limits]
    if assumed:
        text = f"{', '.join(assumed)}: defaults, at least for some joints"
        remedy = "arm.with_limits(...) sets them"
        yield Finding(Severity.NOTE, text, f"a URDF's <limit velocity=...>, or {remedy}" if "v_max" in assumed else remedy)
    for note in arm.notes:
        if note not in warned:
            yield Finding(Severity.NOTE, note)
