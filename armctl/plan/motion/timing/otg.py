"""Time-optimal, jerk-limited profiles between two states, by ruckig; for rest to rest with a closed form as the fallback.

Ruckig: Berscheid and Kroeger, "Jerk-limited Real-time Trajectory Generation with Arbitrary Target States", RSS 2021. Its end
states are accurate to 1e-8 only, and it fails for some extreme limits; `solve_pieces` corrects both. Where a start is beyond a
limit, ruckig first brakes into the limits.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import ruckig

from armctl.core.errors import PlanError
from armctl.core.limits import Limits
from armctl.core.validation import Array
from armctl.plan.motion.timing.turning_points import brakes_inside, turns_inside
from armctl.plan.motion.trajectory.limit_check import stretch_needed
from armctl.plan.motion.trajectory.piecewise import DEGREE, Pieces, basis, standing, time_scaled

_SOLVED = {ruckig.Result.Working, ruckig.Result.Finished}
_TOGETHER = ruckig.Synchronization.Time
_SEPARATELY = ruckig.Synchronization.No
MIN_PIECE_S = 1e-12
_TIGHTENING = (1e-9, 1e-7, 1e-5)  # relative; slightly tighter limits avoid a rounding failure inside ruckig
_NEGLIGIBLE = 1e-8  # share of a limit that a correction of the end state may add without a check
_DERIVATIVE_FACTORS = ((3.0, 4.0, 5.0), (6.0, 12.0, 20.0), (6.0, 24.0, 60.0))  # of x^3, x^4 and x^5 at x = 1
_MAX_DETOUR = 5e-10  # rad (m), of a correction of velocity and acceleration
_DETOUR_FACTORS = (0.2, 0.0173)  # of a quintic that changes nothing but the velocity, or the acceleration, at x = 1
MAX_EXCESS = 3e-7  # of the duration that velocity, acceleration and jerk limits would need more; of jerk it is three times that
_MAX_SLOWDOWNS = 4
LONGER = (1.0, 1.1, 1.3, 1.7, 2.5, 4.0)  # times the shortest duration: tried for goals that move, near position limits
_MAX_STRETCH = 1.2  # of a move from rest to rest; a straight line in closed form replaces one that needs more


class JointState(NamedTuple):
    """Position, velocity and acceleration of joints, each (n,), as arrays or, for ruckig, as lists."""

    q: Array | list[float]
    v: Array | list[float]
    a: Array | list[float]


def at_rest(q: Array) -> JointState:
    zero = np.zeros_like(q)
    return JointState(q, zero, zero)


Bounds = tuple[Array, Array, Array]  # v_max, a_max and j_max, each (n,)


class Phases(NamedTuple):
    """For each joint the durations, s, and the jerks, rad/s^3, of its phases of constant jerk."""

    durations: list[tuple[float, ...]]
    jerks: list[tuple[float, ...]]


class PhaseNodes(NamedTuple):
    """Durations of phases, and position, velocity, acceleration and jerk at their starts, each (P, ..., n)."""

    steps: Array
    q: Array
    v: Array
    a: Array
    jerks: Array


class Profile:
    """A time-optimal, jerk-limited profile of n joints. Immutable."""

    __slots__ = ("_a_max", "_trajectory", "_v_max", "duration")

    def __init__(self, trajectory: ruckig.Trajectory, v_max: list[float], a_max: list[float]):
        self._trajectory = trajectory
        self._v_max = v_max
        self._a_max = a_max
        self.duration: float = trajectory.duration

    def at(self, t: float) -> tuple[list[float], list[float], list[float]]:
        """Positions, velocities and accelerations at a time within the duration."""
        return self._trajectory.at_time(t)

    def stays_inside(self, q_min: list[float], q_max: list[float]) -> bool:
        """Whether the profile keeps position limits, by the turning points of every phase.

        Plain Python, because it is called in real time and NumPy takes longer for so few numbers.
        """
        for profile, low, high, v_max, a_max in zip(
            self._trajectory.profiles[0], q_min, q_max, self._v_max, self._a_max, strict=True
        ):
            q = profile.p
            start = q[0]
            end = q[7]
            least, most = (start, end) if start < end else (end, start)
            # It cannot leave [least, most] by more than it can cover, there and back, in the time that is left over.
            spare = 0.5 * (v_max * self.duration - (most - least))
            brake = profile.brake
            if brake.duration > 0.0 and not brakes_inside(brake, start, low, high):
                return False
            if low + spare <= least and most + spare <= high:
                continue
            least = min(q)
            most = max(q)
            if least < low or most > high:
                return False
            t = profile.t
            longest = max(t[0], t[1], t[2], t[4], t[5], t[6], 0.0 if profile.a[3] == 0.0 else t[3])
            bulge = a_max * longest * longest / 8  # how far a curve of this acceleration can leave its chord
            if (least - bulge < low or most + bulge > high) and not turns_inside(profile, low, high):
                return False
        return True

    def phases(self) -> Phases:
        profiles = self._trajectory.profiles[0]
        return Phases([(*p.brake.t, *p.t) for p in profiles], [(*p.brake.j, *p.j) for p in profiles])

    def pieces(self, start: JointState) -> Pieces:
        """The profile as piecewise polynomials; its end is as accurate as ruckig's."""
        first = JointState(*(np.asarray(x)[None] for x in start))
        durations = []
        jerks = []
        for phases, phase_jerks in zip(*self.phases(), strict=True):
            # a joint that arrives before the others stands still from then on
            rest = self.duration - sum(phases)
            durations.append((*phases, rest if rest > MIN_PIECE_S else 0.0))
            jerks.append((*phase_jerks, 0.0))
        nodes = phase_nodes([Phases(durations, jerks)], first)
        return _pieces(PhaseNodes(*(x[:, 0] for x in nodes)))


class ProfileSolver:
    """Computes profiles of n joints with given limits. It holds ruckig's work space; no result depends on earlier calls."""

    def __init__(self, v_max: Array, a_max: Array, j_max: Array, lows: tuple[Array, Array] | None = None):
        """Limits (n,); `lows` are the lowest velocities and accelerations, where they are not the negative of the greatest."""
        n = len(v_max)
        self.bounds = (v_max, a_max, j_max)
        self.lows = lows
        if lows is not None:
            self.bounds = (np.maximum(v_max, -lows[0]), np.maximum(a_max, -lows[1]), j_max)
        self.highs = (v_max, a_max, j_max)
        self._n = n
        self._v_max = self.bounds[0].tolist()
        self._a_max = self.bounds[1].tolist()
        self._ruckig = ruckig.Ruckig(n)
        self._input = ruckig.InputParameter(n)
        self._zero = [0.0] * n
        self._set_limits(1.0)

    @property
    def smaller_sides(self) -> Bounds:
        """Limits that hold in both directions."""
        if self.lows is None:
            return self.bounds
        v_max, a_max, j_max = self.highs
        return np.minimum(v_max, -self.lows[0]), np.minimum(a_max, -self.lows[1]), j_max

    @classmethod
    def from_limits(cls, limits: Limits) -> ProfileSolver:
        lows = (limits.v_low, limits.a_low) if limits.depends_on_sign else None
        return cls(limits.v_max, limits.a_max, limits.j_max, lows)

    def solve(self, start: JointState, goal: JointState, together: bool = True, shortest: float = 0.0) -> Profile | None:
        """The fastest profile between two states that lasts at least so many seconds, or None if ruckig finds none.

        All joints arrive at the same time, or else each as soon as it can.
        """
        inp = self._input
        inp.minimum_duration = shortest if shortest > 0.0 else None
        inp.current_position, inp.current_velocity, inp.current_acceleration = start
        inp.target_position, inp.target_velocity, inp.target_acceleration = goal
        inp.synchronization = _TOGETHER if together else _SEPARATELY
        return self._calculated()

    def to_rest(self, start: JointState, goal: list[float], q_min: list[float], q_max: list[float]) -> Profile | None:
        """The fastest profile to rest at a goal that stays inside position limits; None if there is none.

        All joints arrive at the same time; where one would leave its limits, each moves by itself.
        """
        for together in (True, False):
            profile = self.solve(start, JointState(goal, self._zero, self._zero), together)
            if profile is not None and profile.stays_inside(q_min, q_max):
                return profile
        return None

    def to_moving(self, start: JointState, goal: JointState, q_min: list[float], q_max: list[float]) -> Profile | None:
        """The fastest profile to a state in motion, or a longer one, that stays inside position limits; None if there is none.

        All joints arrive at the same time: one that came sooner would have left the goal again.
        """
        fastest = self.solve(start, goal)
        if fastest is None or fastest.stays_inside(q_min, q_max):
            return fastest
        for factor in LONGER[1:]:
            profile = self.solve(start, goal, shortest=factor * fastest.duration)
            if profile is not None and profile.stays_inside(q_min, q_max):
                return profile
        return None

    def stop(self, start: JointState) -> Profile | None:
        """The fastest stop of each joint by itself, or None if ruckig finds none."""
        return self.to_velocity(start, self._zero, together=False)

    def to_velocity(self, start: JointState, velocity: list[float], together: bool = True) -> Profile | None:
        """The fastest profile to a velocity, without acceleration, wherever the joints are then; None if ruckig finds none."""
        inp = self._input
        inp.minimum_duration = None
        inp.current_position, inp.current_velocity, inp.current_acceleration = start
        inp.target_velocity = velocity
        inp.target_acceleration = self._zero
        inp.synchronization = _TOGETHER if together else _SEPARATELY
        inp.control_interface = ruckig.ControlInterface.Velocity
        profile = self._calculated()
        inp.control_interface = ruckig.ControlInterface.Position
        return profile

    def cruise(self, start: JointState, goal: list[float], speeds: list[float]) -> Profile | None:
        """The fastest profile of each joint by itself to rest at a goal, no faster than so many rad/s."""
        self._input.max_velocity = speeds
        if self.lows is not None:
            self._input.min_velocity = [-speed for speed in speeds]
        profile = self.solve(start, JointState(goal, self._zero, self._zero), together=False)
        self._set_limits(1.0)
        return profile

    def _calculated(self) -> Profile | None:
        trajectory = ruckig.Trajectory(self._n)
        try:
            solved = self._ruckig.calculate(self._input, trajectory) in _SOLVED
        except (ruckig.RuckigError, ValueError):  # ValueError: a result code that is missing in the binding
            solved = any(self._solves_within(1 - share, trajectory) for share in _TIGHTENING)
            self._set_limits(1.0)
        return Profile(trajectory, self._v_max, self._a_max) if solved else None

    def _solves_within(self, share: float, trajectory: ruckig.Trajectory) -> bool:
        self._set_limits(share)
        try:
            return self._ruckig.calculate(self._input, trajectory) in _SOLVED
        except (ruckig.RuckigError, ValueError):  # ValueError: a result code that is missing in the binding
            return False

    def _set_limits(self, share: float) -> None:
        v_max, a_max, j_max = self.highs
        self._input.max_velocity = (share * v_max).tolist()
        self._input.max_acceleration = (share * a_max).tolist()
        self._input.max_jerk = (share * j_max).tolist()
        if self.lows is not None:
            self._input.min_velocity = (share * self.lows[0]).tolist()
            self._input.min_acceleration = (share * self.lows[1]).tolist()


def solve_pieces(
    solver: ProfileSolver, start: JointState, goal: JointState, max_excess: float = MAX_EXCESS, shortest: float = 0.0
) -> Pieces:
    """The fastest move between two states that lasts at least `shortest` s, as polynomials that end exactly at the goal.

    From rest to rest there always is one, inside the limits. Otherwise it may exceed velocity, acceleration and jerk limits by
    rounding, at most by the factor 1 + max_excess, and by what the start makes unavoidable; PlanError if there is none.
    """
    rests = not any(np.any(x) for x in (start.v, start.a, goal.v, goal.a))
    profile = solver.solve(start, goal, shortest=shortest)
    if profile is not None:
        pieces = ending_at(profile.pieces(start), goal)
        bounds = solver.bounds if rests else unavoidable_bounds(solver.bounds, start)
        stretch = 1.0
        added = zip(pieces.correction, solver.bounds, strict=True)
        is_negligible = all((change <= _NEGLIGIBLE * bound).all() for change, bound in added)
        if not is_negligible or _clock_error(profile.duration, solver.bounds) > _NEGLIGIBLE:
            stretch = stretch_needed(pieces.corrected, bounds)
        if stretch <= 1 + max_excess:
            return pieces.corrected
        if rests and stretch <= _MAX_STRETCH:
            return slowed_to_bounds(pieces.corrected, solver.bounds)
    if rests:
        return straight_rest_to_rest(np.asarray(start.q), np.asarray(goal.q), solver.smaller_sides)
    pieces = _solved_in_own_units(solver, start, goal, shortest)
    if pieces is None:
        raise PlanError("no jerk-limited move joins the two states; start and end slower")
    if stretch_needed(pieces, unavoidable_bounds(solver.bounds, start)) > 1 + max_excess:
        raise PlanError("the move between two states is too short or too long to be computed accurately; move them apart")
    return pieces


def unavoidable_bounds(bounds: Bounds, start: JointState) -> Bounds:
    """Limits that a motion from a state can keep: where the state leads beyond one, the least excess.

    A joint with velocity v and acceleration a comes to v + a |a| / (2 j_max) until its acceleration is zero.
    """
    v_max, a_max, j_max = bounds
    v = np.asarray(start.v)
    a = np.asarray(start.a)
    coasting = np.abs(v + a * np.abs(a) / (2 * j_max))
    return np.maximum(v_max, np.maximum(np.abs(v), coasting)), np.maximum(a_max, np.abs(a)), j_max


def _solved_in_own_units(limited: ProfileSolver, start: JointState, goal: JointState, shortest: float) -> Pieces | None:
    """The fastest move between two states in its own units of time and position; None if ruckig finds none.

    Ruckig's tolerances are absolute. With the unit of time that the states need at full jerk, and for each joint the unit of
    position that makes this jerk 1, they are relative to the move, however short it is.
    """
    v_max, a_max, j_max = limited.highs
    q = np.asarray(start.q)
    way = np.asarray(goal.q) - q
    times = [np.cbrt(np.abs(way) / j_max)]
    for state in (start, goal):
        times += [np.sqrt(np.abs(state.v) / j_max), np.abs(state.a) / j_max]
    time = float(np.max(times))
    if time == 0.0:
        return standing(q)
    length = j_max * time**3
    to_velocity = time / length
    to_acceleration = time**2 / length
    lows = None if limited.lows is None else (limited.lows[0] * to_velocity, limited.lows[1] * to_acceleration)
    solver = ProfileSolver(v_max * to_velocity, a_max * to_acceleration, np.ones_like(j_max), lows)
    first = JointState(np.zeros_like(q), start.v * to_velocity, start.a * to_acceleration)
    last = JointState(way / length, goal.v * to_velocity, goal.a * to_acceleration)
    profile = solver.solve(first, last, shortest=shortest / time)
    if profile is None:
        return None
    knots, coefficients = ending_at(profile.pieces(first), last).corrected
    coefficients = coefficients * (length / time ** np.arange(DEGREE + 1.0)[:, None])
    coefficients[:, 0] += q
    return ending_at(Pieces(knots * time, coefficients), goal).corrected


class Corrected(NamedTuple):
    """A move with a corrected end, and the largest velocity, acceleration and jerk that the correction adds, each (n,)."""

    corrected: Pieces
    correction: tuple[Array, Array, Array]


def ending_at(pieces: Pieces, goal: JointState) -> Corrected:
    """A move with its end state corrected by a quintic.

    The quintic extends over the whole move. Where it would lead the joints off their way to correct velocity and acceleration
    alone, because the move is long, a second one corrects these in the last pieces.
    """
    knots = pieces.knots
    zero = np.zeros(pieces.coefficients.shape[2])
    if knots[-1] == 0.0:
        return Corrected(pieces, (zero, zero, zero))
    end = np.array(basis(float(knots[-1] - knots[-2]))) @ pieces.coefficients[-1]
    q = np.asarray(goal.q) - end[0]
    v = np.asarray(goal.v) - end[1]
    a = np.asarray(goal.a) - end[2]
    rest = (knots[-1] - knots[:-1])[:, None]
    detour = (_DETOUR_FACTORS[0] * np.abs(v) * rest + _DETOUR_FACTORS[1] * np.abs(a) * rest**2).max(axis=1)
    first = int(np.argmax(np.append(detour[:-1] <= _MAX_DETOUR, True)))
    if first == 0:
        added, largest = _quintic(knots, q, v, a)
    else:
        added, largest = _quintic(knots, q, zero, zero)
        at_end, largest_at_end = _quintic(knots[first:] - knots[first], zero, v, a)
        added[first:] += at_end
        largest = tuple(x + y for x, y in zip(largest, largest_at_end, strict=True))
    return Corrected(Pieces(knots, pieces.coefficients + added), largest)  # type: ignore[arg-type]


def _quintic(knots: Array, q: Array, v: Array, a: Array) -> tuple[Array, tuple[Array, ...]]:
    """The quintic from zero at knots[0] = 0 to a state (n,) at the last knot.

    Returns its coefficients (m, 6, n), and its largest velocity, acceleration and jerk, each (n,).
    """
    duration = float(knots[-1])
    v = v * duration
    a = a * duration**2
    quintic = np.zeros((DEGREE + 1, len(q)))  # of powers of t / duration
    quintic[3] = 10 * q - 4 * v + 0.5 * a
    quintic[4] = -15 * q + 7 * v - a
    quintic[5] = 6 * q - 3 * v + 0.5 * a
    coefficients = np.zeros((len(knots) - 1, DEGREE + 1, len(q)))
    x = knots[:-1] / duration
    for power in range(DEGREE + 1):
        for order in range(max(power, 3), DEGREE + 1):
            term = math.comb(order, power) * x ** (order - power)
            coefficients[:, power] += term[:, None] * quintic[order] / duration**power
    size = np.abs(quintic[3:])
    return coefficients, tuple(np.array(f) @ size / duration**order for order, f in enumerate(_DERIVATIVE_FACTORS, start=1))


def _clock_error(duration: float, bounds: Bounds) -> float:
    """How much of a limit the rounding of times can add: 262 s into a motion, a phase of 6 ns lasts 6e-14 s too long."""
    v_max, a_max, j_max = bounds
    return float(np.spacing(duration) * max((j_max / a_max).max(), (a_max / v_max).max()))


def slowed_to_bounds(pieces: Pieces, bounds: Bounds) -> Pieces:
    """A move, slowed down to keep limits on velocity, acceleration and jerk; unchanged if it does."""
    for attempt in range(1, _MAX_SLOWDOWNS + 1):
        stretch = stretch_needed(pieces, bounds)
        if stretch <= 1 + MAX_EXCESS:
            break
        # times are rounded anew, which may add to a limit what the last attempt took away: take more each time
        pieces = time_scaled(pieces, stretch**-attempt)
    return pieces


def straight_rest_to_rest(start: Array, goal: Array, bounds: Bounds) -> Pieces:
    """The fastest move on a straight line in joint space from rest to rest, in closed form.

    The profile has seven phases: Biagiotti and Melchiorri, "Trajectory Planning for Automatic Machines and Robots", 2008, 3.4.
    """
    way = goal - start
    length = float(np.abs(way).max())
    with np.errstate(divide="ignore", over="ignore"):
        along = [float((bound / np.abs(way)).min()) * length for bound in bounds]
    if length == 0.0 or not all(map(math.isfinite, along)):
        return standing(start)
    v = along[0]
    a = along[1]
    j = along[2]
    ramp = min(a / j, math.sqrt(v / j), (length / (2 * j)) ** (1 / 3))
    # the acceleration lasts until the speed limit or until half of the way, whichever comes first
    a = j * ramp
    flat = max(0.0, min(v / a - ramp, -1.5 * ramp + math.sqrt(0.25 * ramp**2 + length / a)))
    v = a * (ramp + flat)
    cruise = max(0.0, length / v - 2 * ramp - flat)
    steps = np.array([ramp, flat, ramp, cruise, ramp, flat, ramp])
    jerks = j * np.array([1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0])
    nodes = phase_nodes([Phases([tuple(steps)], [tuple(jerks)])], JointState(*np.zeros((3, 1, 1))))
    line = _pieces(PhaseNodes(*(x[:, 0] for x in nodes)))
    covered = np.array(basis(float(line.knots[-1] - line.knots[-2]))[0]) @ line.coefficients[-1]
    coefficients = line.coefficients * (way / covered)
    coefficients[:, 0] += start
    return slowed_to_bounds(Pieces(line.knots, coefficients), bounds)


def phase_nodes(phases: list[Phases], start: JointState) -> PhaseNodes:
    """The states at the start of each phase of K profiles that start from (K, n) states, each (P, K, n)."""
    steps = np.moveaxis(np.array([each.durations for each in phases]), -1, 0)
    jerks = np.moveaxis(np.array([each.jerks for each in phases]), -1, 0)
    q = np.empty_like(steps)
    v = np.empty_like(steps)
    a = np.empty_like(steps)
    now = start
    for i, (h, j) in enumerate(zip(steps, jerks, strict=True)):
        q[i] = now.q
        v[i] = now.v
        a[i] = now.a
        now = JointState(q[i] + h * (v[i] + h * (a[i] / 2 + h * j / 6)), v[i] + h * (a[i] + h * j / 2), a[i] + h * j)
    return PhaseNodes(steps, q, v, a, jerks)


def phase_polynomials(nodes: PhaseNodes) -> Array:
    """The positions during phases as polynomials on [0, 1], (P K, 4, n) coefficients, constant first."""
    steps = nodes.steps
    powers = [nodes.q, nodes.v * steps, nodes.a * steps**2 / 2, nodes.jerks * steps**3 / 6]
    return np.stack(powers, axis=2).reshape(-1, len(powers), steps.shape[-1])


def _pieces(nodes: PhaseNodes) -> Pieces:
    """Cubic pieces from phases (P, n), cut wherever the jerk of any joint changes."""
    steps = nodes.steps
    starts = np.vstack([np.zeros_like(steps[:1]), np.cumsum(steps, axis=0)])
    knots = np.unique(starts)
    knots = np.append(knots[:-1][np.diff(knots) > MIN_PIECE_S], knots[-1])
    if len(knots) == 1:
        knots = np.zeros(2)
    knots[0] = 0.0  # also where the first phase is too short for a piece
    joints = np.arange(steps.shape[1])
    middle = 0.5 * (knots[1:] + knots[:-1])
    phase = np.minimum((starts[1:, None] <= middle[:, None]).sum(axis=0), len(steps) - 1)
    u = knots[:-1, None] - starts[phase, joints]
    j = nodes.jerks[phase, joints]
    q = nodes.q[phase, joints]
    v = nodes.v[phase, joints]
    a = nodes.a[phase, joints]
    zero = np.zeros_like(u)
    rows = (q + u * (v + u * (a / 2 + u * j / 6)), v + u * (a + u * j / 2), (a + u * j) / 2, j / 6, zero, zero)
    return Pieces(knots, np.stack(rows, axis=1))
