"""propose_filter: a notch or low-pass and gains for a required margin, for any law."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armctl.control.interface import CompiledController, Controller, traits
from armctl.control.torque_filter import LowPass, Notch, TorqueFilter
from armctl.core.defaults import MAX_PEAK_SENSITIVITY
from armctl.core.result import Verdict
from armctl.core.validation import Array, number
from armctl.lab.loops.linearization import Linearizer
from armctl.lab.loops.loop import Loop
from armctl.lab.loops.stability import LoopMargins
from armctl.model.arm.arm import Arm, check_arm
from armctl.run.execution.move import read_controller
from armctl.run.sim.plant import Plant, read_plant

_QUALITIES = (0.5, 1.0, 2.0, 4.0)  # of notches: wide ones forgive a wrong frequency, narrow ones delay less
_LOW_PASS_SHARES = (0.5, 1.0, 2.0)  # of the resonance
_FACTORS = (4.0, 2.8, 2.0, 1.4, 1.0, 0.7, 0.5, 0.35, 0.25, 0.18, 0.125)  # of the bandwidth
# How gains follow the bandwidth of a loop: their names, and the power of the factor.
_POWERS = {"bandwidth": 1, "damping": 1, "stiffness": 2}
_MAX_DAMPING_RATIO = 0.3  # of what counts as a resonance
_MAX_NYQUIST_SHARE = 0.8
# Stiffness and damping of springs, as shares of the given ones: margins hold for all of them, since a resonance that peaks just
# below a bound would exceed it on the real arm.
_DOUBTS = ((1.0, 1.0), (0.9, 0.7), (1.1, 0.7))
_RESONANCES = 2  # the least damped ones get notches


@dataclass(frozen=True, slots=True, eq=False)
class FilterProposal(Verdict):
    """A law with a filter and gains, and its margins. True if they are as required.

    Attributes:
        ok: Whether the margins are as required.
        controller: The law with the new gains, in a `TorqueFilter` if a filter helps; the given one if not ok.
        filters: The filters; empty if none helps.
        factor: Of the bandwidth: stiffness grows with its square. 1 for a law without such gains.
        before: The margins of the given law, the worst ones if springs are 10 % softer or stiffer and less damped.
        after: Those of the proposed one, likewise.
        reason: The reason if it is not ok; empty if it is.
    """

    ok: bool
    controller: Controller
    filters: tuple[Notch | LowPass, ...]
    factor: float
    before: LoopMargins
    after: LoopMargins
    reason: str

    def __str__(self) -> str:
        if not self.ok:
            return f"{traits(self.controller).name}: {self.reason}"
        filters = ", ".join(map(str, self.filters)) or "no filter"
        margins = [f"{1e3 * each.delay_margin:.3g} ms, Ms {each.peak_sensitivity:.3g}" for each in (self.before, self.after)]
        return f"{filters}, bandwidth x {self.factor:g}: delay margin {margins[1]}; before {margins[0]}"


def propose_filter(
    arm: Arm,
    controller: Controller | str,
    q: ArrayLike,
    plant: Plant | None = None,
    *,
    delay_margin: float = 5e-3,
    peak_sensitivity: float = MAX_PEAK_SENSITIVITY,
) -> FilterProposal:
    """Proposes a notch or a low-pass, and gains, so that the loop is as fast as margins permit.

    For an arm with springs that were measured, such as by `TwoMass.plant`. Each resonance of the arm that the law does not damp
    is tried with notches of different widths, and with low-passes near it. For each of them the largest bandwidth is taken at
    which the linear loop keeps the margins; the filter that permits the largest one wins, the greater margin between equals.

    Args:
        controller: Any law. Its gains follow the bandwidth if they are called `stiffness`, `damping` or `bandwidth`, otherwise
            they stay.
        q: (n,) rad, the configuration; check others with `margins`.
        plant: How the arm differs from the model.
        delay_margin: s, the smallest permitted one.
        peak_sensitivity: The largest permitted Ms, above 1.

    Returns:
        The proposal; not ok, with a reason, if nothing keeps the margins.

    Raises:
        InputError: An argument has a wrong type, length or value.
        LimitError: A position outside the limits.
        ModelError: The controller fails, or no linear model describes it.
        UnknownNameError: There is no such controller.
    """
    check_arm(arm)
    law = read_controller(controller, arm)
    q = arm.checked("q", q)
    delay_margin = number("delay_margin", delay_margin, 0.0)
    peak_sensitivity = number("peak_sensitivity", peak_sensitivity, 1.0)
    linearizers = [Linearizer(arm, each) for each in _doubtful(read_plant(plant))]
    given = linearizers[0].loop_at(law, q)
    before = _worst(linearizers, law, q)
    best: FilterProposal | None = None
    for filters in _candidates(_resonances(given), given.dt):
        for factor in _FACTORS if _gains(law) else (1.0,):
            if best is not None and factor < best.factor:
                break
            scaled = _scaled(law, factor)
            proposed = TorqueFilter(arm, scaled, filters) if filters else scaled
            after = _worst(linearizers, proposed, q)
            if not after or after.delay_margin < delay_margin or after.peak_sensitivity > peak_sensitivity:
                continue
            is_better = best is None or (factor, -after.peak_sensitivity) > (best.factor, -best.after.peak_sensitivity)
            if is_better:
                best = FilterProposal(
                    ok=True, controller=proposed, filters=filters, factor=factor, before=before, after=after, reason=""
                )
            break
    if best is None:
        reason = f"no filter and no lower gains give a delay margin of {1e3 * delay_margin:g} ms and Ms {peak_sensitivity:g}"
        return FilterProposal(ok=False, controller=law, filters=(), factor=1.0, before=before, after=before, reason=reason)
    return best


def _doubtful(plant: Plant) -> list[Plant]:
    if not np.any(plant.elasticity):
        return [plant]
    stiffness = np.asarray(plant.elasticity)
    return [
        replace(plant, elasticity=share * stiffness, elastic_damping=damping * plant.elastic_damping)
        for share, damping in _DOUBTS
    ]


def _worst(linearizers: list[Linearizer], law: Controller, q: Array) -> LoopMargins:
    """The worst margins of a law; those of an unstable loop if there is one."""
    found = [linearizer.loop_at(law, q).robustness() for linearizer in linearizers]
    worst = max(found, key=lambda each: (not each.ok, each.peak_sensitivity))
    if not worst:
        return worst
    return replace(
        worst, delay_margin=min(each.delay_margin for each in found), phase_margin=min(each.phase_margin for each in found)
    )


def _candidates(resonances: Array, dt: float) -> Iterator[tuple[Notch | LowPass, ...]]:
    """Filters to try: none, notches at the resonances, and a low-pass near the lowest one."""
    yield ()
    if not len(resonances):
        return
    for quality in _QUALITIES:
        for count in range(1, len(resonances) + 1):
            yield tuple(Notch(float(w), quality) for w in resonances[:count])
    for share in _LOW_PASS_SHARES:
        w = share * float(resonances.min())
        if w < _MAX_NYQUIST_SHARE * np.pi / dt:
            yield (LowPass(w),)


def _resonances(loop: Loop) -> Array:
    """rad/s, vibrations of the arm without the law, the least damped one first."""
    poles = loop._arm.poles()
    rates = np.log(poles[(np.abs(poles) > 0.0) & (poles.imag > 0.0)]) / loop.dt
    size = np.abs(rates)
    damping = -rates.real / size
    is_one = (damping < _MAX_DAMPING_RATIO) & (size > 2 * np.pi) & (size < _MAX_NYQUIST_SHARE * np.pi / loop.dt)
    return size[is_one][damping[is_one].argsort()][:_RESONANCES]


def _gains(law: Controller) -> dict[str, Any]:
    if not isinstance(law, CompiledController):
        return {}
    return {name: getattr(law, name) for name in _POWERS if getattr(law, name, None) is not None}


def _scaled(law: Controller, factor: float) -> Controller:
    if factor == 1.0 or not isinstance(law, CompiledController):
        return law
    scaled = law.fresh()
    for name, value in _gains(law).items():
        setattr(scaled, name, value * factor ** _POWERS[name])
    return scaled
