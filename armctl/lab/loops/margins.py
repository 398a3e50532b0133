"""Margins of a controller over the workspace of an arm."""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import degrees, isfinite, nan

import numpy as np
from numpy.typing import ArrayLike

from armctl.control.interface import Controller, traits
from armctl.core.defaults import MIN_DAMPING_RATIO
from armctl.core.errors import InputError
from armctl.core.limits import smallest_configuration
from armctl.core.result import Verdict
from armctl.core.tables import Table
from armctl.core.validation import Array, frozen, integer, matrix, shown
from armctl.lab.loops.linearization import Linearizer
from armctl.lab.loops.loop import Loop, Mode
from armctl.lab.loops.stability import CoarseMargins, LoopMargins
from armctl.model.arm.arm import Arm, check_arm
from armctl.run.execution.move import read_controller
from armctl.run.sim.plant import NOMINAL, Plant, read_plant

_MAX_CONFIGURATIONS = 10_000
_SEED = 20_000  # of the random configurations: the same for every controller, and not those that gains are designed for
_STARTS = 120  # further configurations at which a search for the worst one may begin
SEARCH_STEPS = 30  # of each search
_SEARCHES = 2  # for each margin, from the worst configurations so far


@dataclass(frozen=True, slots=True, eq=False)
class WorstMargin:
    """The worst value of one margin, and where it occurs."""

    value: float
    q: Array  # (n,) rad, the configuration
    plant: str  # the plant, in words


@dataclass(frozen=True, slots=True, eq=False)
class Margins(Verdict):
    """The worst margins of an arm with a controller, over configurations and plants. True if no loop is unstable or vibrates.

    Attributes:
        ok: Whether the closed loop is stable everywhere, and no vibration has a damping ratio below 0.1.
        dt: s, the control period of the plant with the least delay margin.
        delay: The smallest delay margin, s.
        gain: The gain margin nearest to 1 as a ratio: the lower or the upper one.
        lower_gain: The largest lower gain margin, a factor below 1 on all torques that makes the loop unstable; 0 if none does.
        upper_gain: The smallest upper gain margin, a factor above 1; infinite if none makes the loop unstable.
        phase: The smallest phase margin, rad.
        peak_sensitivity: The largest Ms.
        damping: The smallest damping ratio of `Loop.vibrations`; infinite if there are none, 0 of an unstable loop.
        frequency: rad/s, of that vibration; NaN if there is none.
        slowest_pole: 1/s, the lowest rate with which an error decays: that of the slowest closed-loop pole.
        bandwidth: rad/s, that of the controller, for comparison; NaN if it has none.
        chatter: N m (N), the largest torque noise that the plant's sensors cause, over all joints: see `Loop.chatter`.
        loops: How many loops were examined, with the two worst ones of the searches.
        reason: The reason if it is not ok; empty if it is.
    """

    ok: bool
    robot: str
    controller: str
    dt: float
    delay: WorstMargin
    gain: WorstMargin
    lower_gain: WorstMargin
    upper_gain: WorstMargin
    phase: WorstMargin
    peak_sensitivity: WorstMargin
    damping: WorstMargin
    frequency: float
    slowest_pole: WorstMargin
    bandwidth: float
    chatter: WorstMargin
    loops: int
    reason: str

    def __str__(self) -> str:
        if not self.ok:
            return f"{self.controller} on {self.robot}: {self.reason}"
        damping = f", least damping ratio {self.damping.value:.2g}" if isfinite(self.damping.value) else ""
        chatter = f", torque noise {self.chatter.value:.2g} N m" if self.chatter.value else ""
        return (
            f"{self.controller} on {self.robot}, worst of {self.loops} loops: delay margin {1e3 * self.delay.value:.3g} ms, "
            f"gain margin {self.gain_in_words}, phase margin {degrees(self.phase.value):.3g} deg, "
            f"Ms {self.peak_sensitivity.value:.3g}, slowest pole {self.pole_in_words}{damping}{chatter}"
        )

    def __repr__(self) -> str:
        rows = [f"  {name}: {text}, at q = {where:.60}" for name, text, where, _ in self._rows()]
        head = f"Margins of {self.controller:.40} on {self.robot:.40}, worst of {self.loops} loops"
        return "\n".join([head + (f": {self.reason}" if self.reason else ""), *rows])

    def _repr_html_(self) -> str:
        title = f"{self.controller} on {self.robot}, {self.loops} loops" + (f": {self.reason}" if self.reason else "")
        return f"<p>{html.escape(title)}</p>{Table(['margin', 'worst', 'at q', 'plant'], self._rows()).html()}"

    def _rows(self) -> list[list[str]]:
        """Name, value, configuration and plant of each margin."""
        values = {
            "delay margin": (f"{1e3 * self.delay.value:.3g} ms", self.delay),
            "gain margin": (self.gain_in_words, self.gain),
            "phase margin": (f"{degrees(self.phase.value):.3g} deg", self.phase),
            "Ms": (f"{self.peak_sensitivity.value:.3g}", self.peak_sensitivity),
            "slowest pole": (self.pole_in_words, self.slowest_pole),
            "least damping": (f"{self.damping.value:.2g}", self.damping),
            "torque noise": (f"{self.chatter.value:.2g} N m", self.chatter),
        }
        return [[name, text, str(worst.q.round(2).tolist()), worst.plant] for name, (text, worst) in values.items()]

    @property
    def pole_in_words(self) -> str:
        """The rate of the slowest pole, beside the bandwidth if the controller has one."""
        pole = f"{self.slowest_pole.value:.3g} 1/s"
        return f"{pole} (bandwidth {self.bandwidth:.3g} rad/s)" if isfinite(self.bandwidth) else pole

    @property
    def gain_in_words(self) -> str:
        """The upper gain margin, after the lower one if there is one."""
        upper = f"{self.upper_gain.value:.3g}"
        return f"{self.lower_gain.value:.3g} (lower) and {upper} (upper)" if self.lower_gain.value > 0.0 else upper

    def to_dict(self) -> dict[str, object]:
        """All figures for JSON; an infinite margin is None."""
        figures: dict[str, object] = {
            "ok": self.ok,
            "reason": self.reason,
            "robot": self.robot,
            "controller": self.controller,
            "dt": self.dt,
            "loops": self.loops,
            "frequency": self.frequency if isfinite(self.frequency) else None,
            "bandwidth": self.bandwidth if isfinite(self.bandwidth) else None,
        }
        for name in (
            "delay",
            "gain",
            "lower_gain",
            "upper_gain",
            "phase",
            "peak_sensitivity",
            "damping",
            "slowest_pole",
            "chatter",
        ):
            worst: WorstMargin = getattr(self, name)
            value = worst.value if isfinite(worst.value) else None
            figures[name] = {"value": value, "q": worst.q.tolist(), "plant": worst.plant}
        return figures


def margins(
    arm: Arm, controller: Controller | str, configurations: int | ArrayLike = 20, plants: Sequence[Plant] = ()
) -> Margins:
    """Linearizes the loop of an arm and a controller at many configurations, and finds the worst margins.

    A search by random steps then begins at the configuration with the least delay margin, and one at that with the largest Ms.

    Args:
        configurations: How many there are: home and random ones, always the same, for which no default gains are designed; or
            the configurations themselves, (k, n) rad, without a search.
        plants: The simulated plants; by default the one that does not differ from the model.

    Returns:
        The worst margins, and the configurations at which they occur.

    Raises:
        InputError: An argument has a wrong type or value.
        LimitError: A configuration outside the limits.
        ModelError: The controller fails at a configuration, or no linear model describes it.
        UnknownNameError: There is no such controller.
    """
    check_arm(arm)
    law = read_controller(controller, arm)
    if not isinstance(plants, Sequence):
        raise InputError(f"plants: expected a list of plants, such as [armctl.Plant(payload=1.0)], got {shown(plants)}")
    linearizers = [Linearizer(arm, read_plant(plant)) for plant in (plants or (NOMINAL,))]
    loops = judged_loops(linearizers, law, configurations)
    return _worst(arm, law, loops, [loop.margins() for loop in loops])


def judged_loops(linearizers: Sequence[Linearizer], law: Controller, configurations: int | ArrayLike) -> list[Loop]:
    """The loops of a controller at `judged_configurations`, and the worst ones that searches find if those are not given."""
    cases = [(linearizer, q) for linearizer in linearizers for q in judged_configurations(linearizer.arm, configurations)]
    loops = [linearizer.loop_at(law, q) for linearizer, q in cases]
    if _dimensions(configurations):
        return loops
    cases += [(linearizer, q) for linearizer in linearizers for q in search_starts(linearizer.arm, loops[0])]
    known = loops + [linearizer.loop_at(law, q) for linearizer, q in cases[len(loops) :]]
    found = [loop.coarse_margins() for loop in known]
    return loops + [loop for _, loop in worst_loops([linearizer for linearizer, _ in cases], law, known, found)]


def worst_loops(
    linearizers: Sequence[Linearizer], law: Controller, loops: Sequence[Loop], found: Sequence[CoarseMargins]
) -> list[tuple[Linearizer, Loop]]:
    """The worst loops that searches find; they begin at the worst of these loops, whose linearizers and margins are given."""
    worst: list[tuple[Linearizer, Loop]] = []
    for score in (lambda margins: float(margins.delay.min()), lambda margins: -float(margins.peak_sensitivity.max())):
        for i in np.argsort([score(each) for each in found])[: _SEARCHES if loops[0].has_static_law else 1]:
            worst.append((linearizers[i], _worst_loop(linearizers[i], law, loops[i].q, score)))
    return worst


def search_starts(arm: Arm, loop: Loop) -> Array:
    """(k, n) rad, further configurations at which searches for the worst one may begin.

    There are none for a law with memory: it takes long to linearize, and its inverse dynamics make all configurations similar.
    """
    count = _STARTS if loop.has_static_law else 0
    return arm.limits.random(arm.limits.clamp(arm.home), count, np.random.default_rng(_SEED + 1)).reshape(-1, arm.n)


def _worst_loop(linearizer: Linearizer, law: Controller, start: Array, score: Callable[[CoarseMargins], float]) -> Loop:
    """The loop with the smallest score that a search from a configuration finds."""

    def coarse(q: Array) -> float:
        return score(linearizer.loop_at(law, q).coarse_margins())

    rng = np.random.default_rng(_SEED)
    return linearizer.loop_at(law, smallest_configuration(linearizer.arm.limits, coarse, [start], SEARCH_STEPS, rng))


def judged_configurations(arm: Arm, configurations: int | ArrayLike) -> Array:
    """(k, n) rad, the configurations at which a controller is judged: home and random ones, or the given ones, checked."""
    if _dimensions(configurations) > 0:
        given = matrix("configurations", configurations, arm.n)  # type: ignore[arg-type]
        integer("configurations", len(given), 1, _MAX_CONFIGURATIONS)
        return np.array([arm.checked("configurations", q) for q in given])
    count = integer("configurations", configurations, 1, _MAX_CONFIGURATIONS)  # type: ignore[arg-type]
    home = arm.limits.clamp(arm.home)
    return np.vstack([home, arm.limits.random(home, count - 1, np.random.default_rng(_SEED))])


def _dimensions(value: object) -> int:
    """The number of dimensions; 0 for what is no array, which is no number either."""
    try:
        return np.ndim(value)  # type: ignore[arg-type]
    except Exception:  # a caller's object may raise anything while NumPy converts it
        return 0


def _worst(arm: Arm, law: Controller, loops: list[Loop], found: list[LoopMargins]) -> Margins:
    least = [loop.least_damped() for loop in loops]
    ratios = [each.damping_ratio for each in least]
    delays = [each.delay_margin for each in found]
    gains = [each.gain_margin for each in found]
    return Margins(
        ok=min(ratios) >= MIN_DAMPING_RATIO,
        robot=arm.name,
        controller=traits(law).name,
        dt=loops[int(np.argmin(delays))].dt,
        delay=_worst_of(loops, delays),
        gain=_worst_of(loops, gains, lambda values: np.argmin(np.maximum(values, 1 / np.array(values)))),
        lower_gain=_worst_of(loops, [each.lower_gain_margin for each in found], np.argmax),
        upper_gain=_worst_of(loops, [each.upper_gain_margin for each in found]),
        phase=_worst_of(loops, [each.phase_margin for each in found]),
        peak_sensitivity=_worst_of(loops, [each.peak_sensitivity for each in found], np.argmax),
        damping=_worst_of(loops, ratios),
        frequency=least[int(np.argmin(ratios))].frequency,
        slowest_pole=_worst_of(loops, [loop.slowest_pole for loop in loops]),
        bandwidth=_bandwidth(law),
        chatter=_worst_of(loops, [float(np.sqrt(np.mean(loop.chatter() ** 2))) for loop in loops], np.argmax),
        loops=len(loops),
        reason=_reason(loops, found, least),
    )


def _bandwidth(law: Controller) -> float:
    """rad/s, the attribute `bandwidth` of a controller; NaN if it has none that is a positive number."""
    value = getattr(law, "bandwidth", None)
    return float(value) if isinstance(value, (int, float)) and value > 0.0 else nan


def _reason(loops: list[Loop], found: list[LoopMargins], least: list[Mode]) -> str:
    """Why loops are not ok: the first unstable one, or else the one that vibrates most."""
    bad = [(loop, each.reason) for loop, each in zip(loops, found, strict=True) if not each]
    if not bad:
        vibrating = sorted((mode, i) for i, mode in enumerate(least) if mode.damping_ratio < MIN_DAMPING_RATIO)
        bad = [(loops[i], f"the closed loop vibrates, at {mode} (below {MIN_DAMPING_RATIO:g}),") for mode, i in vibrating]
    if not bad:
        return ""
    loop, reason = bad[0]
    reason += f" at q = {loop.q.round(3).tolist()!s:.120}, plant {loop.plant:.80}"
    return reason + (f", and in {len(bad) - 1} more of {len(loops)} loops" if len(bad) > 1 else "")


def _worst_of(loops: list[Loop], values: list[float], worst: Callable[[list[float]], np.intp] = np.argmin) -> WorstMargin:
    i = int(worst(values))
    return WorstMargin(values[i], frozen(loops[i].q.copy()), loops[i].plant)
