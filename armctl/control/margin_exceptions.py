"""Which controllers do not satisfy the bounds of the default gains on an arm, and why."""

from typing import NamedTuple

import numpy as np

from armctl.control.gains import (
    MAX_GRAVITY_EXCESS,
    PdLoops,
    margin_gains,
    sample_configurations,
    sampled_inertia,
)
from armctl.control.impedance import Impedance
from armctl.core.defaults import MAX_PEAK_SENSITIVITY
from armctl.model.arm.arm import Arm

_PERIODS_S = (0.001, 0.002, 0.004)
# Gravity stiffness / stiffness. A loop that compensates gravity has this sensitivity at low frequency, and more where it peaks.
_MAX_GRAVITY_RATIO = 0.5


class MarginException(NamedTuple):
    """Controllers whose default gains do not satisfy the bounds on an arm."""

    controllers: tuple[str, ...]  # their names
    reason: str  # the rest of a sentence that begins with their names

    def __str__(self) -> str:
        *others, last = self.controllers
        names = f"{', '.join(others)} and {last}" if others else last
        return f"{names}{self.reason}"


def margin_exceptions(arm: Arm) -> tuple[MarginException, ...]:
    """What the default gains of an arm do not satisfy; none if every controller has sufficient margins.

    It follows from inertia and gravity at sampled configurations, not from the loops themselves, as `armctl.margins` does.
    """
    found = []
    peaks = {dt: pd_peak_sensitivity(arm, dt) for dt in _PERIODS_S}
    excesses = {dt: margin_gains(arm, dt).gravity_excess for dt in _PERIODS_S}
    missed = [dt for dt in _PERIODS_S if peaks[dt] > MAX_PEAK_SENSITIVITY or excesses[dt] > MAX_GRAVITY_EXCESS]
    if missed:
        periods = ", ".join(f"{1e3 * dt:g}" for dt in missed)
        reason = (
            f": no robust gains on this arm at control periods of {periods} ms (Ms {max(peaks.values()):.1f}): gravity needs "
            f"{max(excesses.values()):.1f} times the stiffness that can be damped; use a controller with a model"
        )
        found.append(MarginException(("pd", "pd-feedforward", "pd-gravity"), reason))
    ratio = _impedance_gravity_ratio(arm)
    if ratio > _MAX_GRAVITY_RATIO:
        reason = (
            f": its stiffness is too low for this arm (Ms above {MAX_PEAK_SENSITIVITY:g}): gravity acts as a negative "
            f"stiffness {ratio:.1f} times as large; pass a higher one"
        )
        found.append(MarginException(("impedance",), reason))
    return tuple(found)


def pd_peak_sensitivity(arm: Arm, dt: float) -> float:
    """The largest sensitivity of a joint under the default PD: see `PdLoops`."""
    gains = margin_gains(arm, dt)
    return PdLoops(sampled_inertia(arm), gains.stiffness, gains.damping, dt).peak_sensitivity


def _impedance_gravity_ratio(arm: Arm) -> float:
    """The largest gravity stiffness relative to the springs of the default impedance, in any direction and configuration."""
    controller = Impedance(arm)
    tip_stiffness = np.asarray(controller.stiffness, dtype=np.float64)
    largest = 0.0
    for q, gravity in zip(sample_configurations(arm), sampled_inertia(arm).gravity_stiffness, strict=True):
        stiffness = controller.joint_stiffness(q, tip_stiffness)
        L = np.linalg.cholesky(stiffness + 1e-12 * np.trace(stiffness) * np.eye(arm.n))
        scaled = np.linalg.solve(L, np.linalg.solve(L, 0.5 * (gravity + gravity.T)).T)
        largest = max(largest, float(np.abs(np.linalg.eigvalsh(scaled)).max()))
    return largest
